"""Code compiled ahead, in another process or before a run, is the code that a run would compile."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

from rig.cli.output import background_compiling
from rig.physics.engines.split.condensed import set_step
from rig.physics.engines.taylor.series import sliding
from rig.run.simulation import Simulation

PROGRAM = """
import gc
from numba.core.dispatcher import Dispatcher
from rig.run.simulation import Simulation

def known():
    return {each: len(each.signatures) for each in gc.get_objects() if isinstance(each, Dispatcher)}

simulation = Simulation("hammer")
simulation.warm_up()
before = known()
simulation.submit("fault", {"channel": "probes", "kind": "hum", "amplitude_v": 0.1})
while simulation.tick < 500_000:
    frame = simulation.advance(simulation.block_ticks)
assert simulation.health()["engine"]["rolling_share"] > 0.3, "no whirl, which calls much for the first time"
print(*(each.py_func.__qualname__ for each, count in known().items() if count > before.get(each, 0)))
"""


def test_a_run_compiles_no_kernel_again() -> None:
    background_compiling.compile_last()
    compiled: dict[Dispatcher, list[object]] = {each: list(each.signatures) for each in (sliding, set_step)}
    assert all(len(signatures) == 1 for signatures in compiled.values())
    simulation = Simulation("hammer")
    simulation.advance(simulation.block_ticks)
    assert {kernel: list(kernel.signatures) for kernel in compiled} == compiled


def test_nothing_is_compiled_during_a_run() -> None:
    """A live rig would stop for it."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


def test_the_second_process_ignores_modules_in_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cache is indexed by the files' paths: code compiled from other files would never be used."""
    package = tmp_path / "rig"
    package.mkdir()
    (package / "__init__.py").write_text("raise SystemExit(7)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    child = background_compiling.start_second_process()
    assert child is not None
    assert child.wait() == 0
