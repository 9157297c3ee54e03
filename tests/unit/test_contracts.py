"""Who may import whom, and that `rig --help` waits for nothing heavy."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import rig
from rig.cli.app import app

ROOT = Path(__file__).parents[2]
PACKAGES = ("rig", "drivers", "recorder", "replays")
HEAVY = ("numba", "scipy", "zenoh", "mcap", "rerun", "matplotlib", "pyarrow", "can", "cantools", "isotp")


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    code = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A copy of what the contracts are about, to break."""
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


@pytest.mark.wallclock
def test_contracts_hold() -> None:
    done = lint(ROOT)
    assert done.returncode == 0, done.stdout
    assert "0 broken" in done.stdout


@pytest.mark.wallclock
@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("rig/kernels/contact.py", "import zenoh"),
        ("rig/simulation.py", "import time"),
        ("rig/engines/rk4.py", "from rig.simulation import Simulation"),
        ("recorder/views.py", "from rig.kernels.signals import ROW"),
        ("drivers/console.py", "from rig.model import build_model"),
        ("drivers/hammer/driver.py", "from drivers.hammer.twin import HammerTwin"),
        ("rig/service.py", "from replays.recordings.whirl import whirl_figures"),
    ],
)
def test_contracts_see_what_is_forbidden(copied: Path, module: str, line: str) -> None:
    path = copied / module
    path.write_text(path.read_text() + f"\n{line}\n")
    done = lint(copied)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "1 broken" in done.stdout


@pytest.mark.wallclock
def test_help_of_every_command_imports_nothing_heavy() -> None:
    names = [str(command.name) for command in app.registered_commands]
    assert {"run", "simulate", "record", "view", "demo"} <= set(names)
    code = f"""
import sys
from rig.cli.main import main
for arguments in [[], *([name] for name in {names!r})]:
    try:
        main([*arguments, "--help"])
    except SystemExit as end:
        assert end.code == 0, arguments
print("HEAVY", *sorted(set({HEAVY!r}) & {{name.partition(".")[0] for name in sys.modules}}))
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(rig.__file__).parents[1],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Usage:") == len(names) + 1
    assert done.stdout.splitlines()[-1] == "HEAVY"
