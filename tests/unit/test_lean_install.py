"""What talks to a rig does without what the extra `full` brings, and what does not says so."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions

from rig.errors import FULL
from tests.processes import ROOT

LEAN = """
import sys

class Lean:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {full!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Lean())
"""
CLIENTS = (
    "drivers.daq", "drivers.console", "drivers.twins", "drivers.force.driver", "drivers.sources.can",
    "drivers.can.interface", "recorder.session", "recorder.reader", "recorder.rewrite", "replays.player",
    "rig.cli.record", "rig.cli.status", "rig.cli.info", "rig.cli.twins", "rig.transport.zenoh",
)  # fmt: skip


def lean(code: str) -> subprocess.CompletedProcess[str]:
    """A program on a machine without the extra."""
    program = LEAN.format(full=set(FULL)) + code
    return subprocess.run([sys.executable, "-c", program], cwd=ROOT, text=True, capture_output=True, timeout=120)


def test_the_extra_is_what_the_message_takes_it_for() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extra = {re.split(r"[>=<\[]", line)[0] for line in project["optional-dependencies"]["full"]}
    assert {name.lower() for module in FULL for name in packages_distributions()[module]} == extra


def test_clients_need_no_more_than_the_lean_install() -> None:
    done = lean("\n".join(f"import {module}" for module in CLIENTS))
    assert (done.returncode, done.stderr) == (0, "")


def test_what_needs_the_whole_rig_says_how_to_get_it() -> None:
    done = lean("from rig.cli.main import main; main(['simulate', 'hammer', '-o', 'never.csv'])")
    need = r"numba, which comes with the whole rig: pip install 'rotor-stator-rig\[full\]'"
    assert done.returncode == 2
    assert re.fullmatch(f"rig: this needs {need}\n", done.stderr)
    assert re.search(f"rig.simulate needs {need}", lean("import rig; rig.simulate('hammer')").stderr)
