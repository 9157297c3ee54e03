"""Import contracts (pyproject.toml): each detects a breach; and the imports of `rig --help`.

A breach is an import added to the graph of all imports, so that the files are read once only. One breach is written to
a copy of the files, to show that a line of code has the same effect.
"""

from __future__ import annotations

import copy
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import grimp
import pytest
from importlinter import Contract
from importlinter.api import read_configuration
from importlinter.contracts.acyclic_siblings import AcyclicSiblingsContract
from importlinter.contracts.forbidden import ForbiddenContract
from importlinter.contracts.independence import IndependenceContract
from importlinter.contracts.layers import LayersContract
from importlinter.contracts.protected import ProtectedContract

from rig.cli.app import COMMANDS
from tests.house.allowance import AllowanceContract

ROOT = Path(__file__).parents[2]
HEAVY_MODULES = (
    "numba",
    "scipy",
    "zenoh",
    "mcap",
    "rerun",
    "matplotlib",
    "pyarrow",
    "can",
    "cantools",
    "isotp",
    "numpy",
    "pydantic",
    "rich",
)
CONFIGURATION = read_configuration(str(ROOT / "pyproject.toml"))
PACKAGES = CONFIGURATION["session_options"]["root_packages"]
TYPES: dict[str, type[Contract]] = {
    kind.type_name: kind
    for kind in (
        AcyclicSiblingsContract,
        AllowanceContract,
        ForbiddenContract,
        IndependenceContract,
        LayersContract,
        ProtectedContract,
    )
}

# Added import, and a word of the name of the contract that must detect it.
BREACHES = [
    # The rig is the bottom.
    ("rig.run.simulation", "replays.recordings.resimulation.experiment", "without its commands"),
    ("rig.physics.model", "recorder.reader", "without its commands"),
    ("rig.run.offline", "replays.sessions.session", "without its commands"),
    ("rig.serve.pacing", "recorder.contents.views", "without its commands"),
    ("rig.physics.kernels.laws.contact", "tests", "without its commands"),
    ("rig.serve.service", "replays.recordings.whirl", "without its commands"),
    ("rig.base.wire", "drivers.sources.samples", "without its commands"),
    ("recorder.reader", "rig.cli.output.tables", "Package layers"),
    ("replays.recordings.whirl", "tests", "Package layers"),
    ("drivers.daq", "recorder.reader", "Package layers"),
    # Layers inside the packages.
    ("rig.physics.engines.rk4", "rig.run.simulation", "Layers of rig"),
    ("rig.base.wire", "rig.serve.transport", "Layers of rig"),
    ("rig.physics.engines.tsit5", "rig.physics.engines.rk8", "Engines are independent"),
    ("drivers.link", "drivers.daq", "No import cycles"),
    ("drivers.can.bus.model", "drivers.can.gateway", "No import cycles"),
    ("drivers.protection.monitor", "drivers.protection.__main__", "No import cycles"),
    ("drivers.instruments.hammer.driver", "drivers.instruments.hammer.twin", "Layers of a device"),
    ("recorder.reader", "recorder.viewer.live", "No import cycles"),
    ("recorder.viewer.canvas", "recorder.viewer.painter", "No import cycles"),
    ("replays.recordings.whirl", "replays.studies.paper.document", "Layers of replays"),
    ("replays.report", "replays.recordings.whirl", "Layers of replays"),
    ("replays.studies.forces.laws", "replays.recordings.verdict", "Layers of replays"),
    ("replays.recordings.whirl", "replays.score.judgement", "Layers of replays"),
    ("replays.score.card.limits", "replays.campaigns.equipment.bench", "Layers of replays"),
    ("replays.campaigns.equipment.bench", "replays.campaigns.evidence", "No import cycles"),
    ("replays.campaigns.files.expectation", "replays.campaigns.files.run", "No import cycles"),
    ("replays.studies.bench", "recorder.reader", "Studies do not read"),
    ("replays.studies.ladder.quantity", "replays.studies.ladder.chart", "No import cycles"),
    ("rig.channels.sensors.noise", "rig.channels.sensors.conditioning", "No import cycles"),
    # Pairs of modules; the first must not import the second.
    ("recorder.contents.views", "rig.physics.kernels.signals", "no access to the model"),
    ("drivers.console", "rig.physics.model", "no access to the model"),
    ("drivers.instruments.hammer.driver", "drivers.instruments.hammer.twin", "do not import twins"),
    ("drivers.link.can", "drivers.console", "do not import twins"),
    ("drivers.daq", "drivers.can.gateway", "import the virtual CAN bus"),
    ("drivers.instruments.force.driver", "drivers.can.bus.hub", "import the virtual CAN bus"),
    ("recorder.reader", "drivers.can.bus.hub", "import the virtual CAN bus"),
    # Physics: other libraries, clocks, threads, processes; also through modules that it may import.
    ("rig.physics.kernels.laws.contact", "pandas", "Physics"),
    ("rig.physics.parameters", "pyarrow", "Physics"),
    ("rig.channels.table", "multiprocessing", "Physics"),
    ("rig.run.simulation", "concurrent", "Physics"),
    ("rig.run.simulation", "time", "Physics"),
    ("rig.physics.kernels.laws.contact", "zenoh", "Physics"),
    ("rig.channels.sensors.noise", "random", "Physics"),
    ("rig.base.checks", "socket", "Physics"),
    ("rig.base.errors", "threading", "Physics"),
    ("rig.physics.model", "rig.serve.pacing", "Physics"),
]


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph(*PACKAGES, include_external_packages=True, cache_dir=None)


def find_contract(words: str) -> Contract:
    """Return the only contract with these words in its name."""
    found: list[dict[str, Any]] = [each for each in CONFIGURATION["contracts_options"] if words in each["name"]]
    assert len(found) == 1, (words, [each["name"] for each in found])
    return TYPES[found[0]["type"]](found[0]["name"], CONFIGURATION["session_options"], found[0])


@pytest.mark.wallclock
def test_contracts_hold() -> None:
    done = lint(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


@pytest.mark.parametrize(("importer", "imported", "words"), BREACHES)
def test_contracts_detect_forbidden_imports(graph: grimp.ImportGraph, importer: str, imported: str, words: str) -> None:
    contract = find_contract(words)
    broken = copy.deepcopy(graph)
    assert importer in broken.modules, f"{importer} has moved: name another"
    if imported.partition(".")[0] in PACKAGES:
        assert imported in broken.modules, f"{imported} has moved: name another"
    elif imported not in broken.modules:
        broken.add_module(imported, is_squashed=True)
    assert not broken.direct_import_exists(importer=importer, imported=imported)
    broken.add_import(importer=importer, imported=imported, line_number=1, line_contents=f"import {imported}")
    assert not contract.check(broken, verbose=False).kept


def test_each_contract_detects_a_breach() -> None:
    for each in CONFIGURATION["contracts_options"]:
        assert [words for *_, words in BREACHES if words in each["name"]], f"no breach of: {each['name']}"


@pytest.mark.parametrize("package", ["rig", "replays"])
def test_contracts_ask_where_a_new_module_belongs(graph: grimp.ImportGraph, package: str) -> None:
    grown = copy.deepcopy(graph)
    grown.add_module(f"{package}.utils")
    check = find_contract(f"Layers of {package}").check(grown, verbose=False)
    assert not check.kept
    assert "utils" in str(check.metadata)


@pytest.mark.wallclock
def test_a_line_in_a_function_is_an_import(tmp_path: Path) -> None:
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            copied = tmp_path / path.relative_to(ROOT)
            copied.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copied)
    kernel = tmp_path / "rig/physics/kernels/laws/contact.py"
    kernel.write_text(kernel.read_text() + "\n\ndef _at() -> float:\n    from time import time\n\n    return time()\n")
    done = lint(tmp_path)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "1 broken" in done.stdout
    assert "rig.physics.kernels.laws.contact -> time" in done.stdout


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter as its command does on a folder, not on the installed packages."""
    code = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.wallclock
def test_help_of_every_command_imports_nothing_heavy() -> None:
    # These options are fields of the classes of commands and faults, which pydantic creates.
    by_fields = {"hammer", "speed", "release", "fault"}
    names = [name for commands in COMMANDS.values() for name in commands if name not in by_fields]
    assert {"run", "simulate", "record", "view", "demo"} <= set(names)
    code = f"""
import sys
from rig.cli.main import main
for arguments in [[], *([name] for name in {names!r})]:
    try:
        main([*arguments, "--help"])
    except SystemExit as end:
        assert end.code == 0, arguments
print("HEAVY", *sorted(set({HEAVY_MODULES!r}) & {{name.partition(".")[0] for name in sys.modules}}))
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Usage:") == len(names) + 1
    assert done.stdout.splitlines()[-1] == "HEAVY"
