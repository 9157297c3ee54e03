"""How the tests are shared out where several run at once (`-n`), and what many of them use.

Tests that read the clock or start processes wait most of their time: the modules marked so as a whole make up two
queues, each gone through by one worker. Those within a process come at once, the few that run an engine last; those
that start real rigs come after them, when the engine that they run on is compiled. A second worker compiles all engines
one after another, for two that compile at the same time both compile what engines share. A third worker has the tools
and other modules that need no engine meanwhile, until the usual engine is compiled. All else is taken module by module,
the longest first.
"""

from __future__ import annotations

import gc
import os
import re
import signal
from collections.abc import Generator
from functools import cache
from pathlib import Path
from typing import Any

import numba
import pytest

import rig.physics.kernels  # noqa: F401 - names the cache of compiled code
from rig.channels import table

ROOT = Path(__file__).parents[1]
SHIPPED_TABLE = "RIG_TESTS_SHIPPED_TABLE"
"""Environment: if set, tests run with the rig's own channel table; tests.unit.test_shipped_table sets it."""
if SHIPPED_TABLE not in os.environ:
    assert not table.default_table.cache_info().currsize
    table.TABLE = ROOT / "tests/channels.toml"
COMPILING = "tests/parity/test_compiling.py"
TOOLS = "tests/house/test_tools.py"
WITHOUT_ENGINE = (
    "tests/unit/test_laws_command.py",
    "tests/unit/test_magnets_command.py",
    "tests/unit/test_report.py",
    "tests/house/test_sizes.py",
    "tests/house/test_contracts.py",
)
"""Modules that compile no engine, 28 s of processor time: rigs that started at once would compile theirs, too."""
LONGEST = (
    "tests/unit/test_score_track.py",
    "tests/unit/test_nuisance.py",
    "tests/unit/test_score.py",
    "tests/unit/test_score_faults.py",
    "tests/unit/test_paper.py",
    "tests/unit/test_blind_faults.py",
    "tests/physics/test_identification.py",
    "tests/parity/test_kernels.py",
    "tests/physics/test_stability.py",
    "tests/unit/test_identification.py",
    "tests/unit/test_ladder.py",
    "tests/unit/test_chart.py",
    "tests/unit/test_validation.py",
    "tests/unit/test_channel_faults.py",
    "tests/physics/test_sweep.py",
    "tests/system/test_client.py",
    "tests/unit/test_score_population.py",
    "tests/physics/test_sessions.py",
    "tests/system/test_validate.py",
    "tests/hostile/test_files.py",
    "tests/system/test_lockstep.py",
    "tests/unit/test_score_overlap.py",
    "tests/unit/test_generators.py",
    "tests/unit/test_score_quantities.py",
    "tests/unit/test_recorder_series.py",
    "tests/unit/test_pick.py",
    "tests/unit/test_faults.py",
    "tests/unit/test_lean_install.py",
    "tests/unit/test_recorder_rewrite.py",
)
"""Modules that take more than 8 s, for which nobody is to wait at the end."""
_CLOCK = re.compile(r"^pytestmark = .*\bwallclock\b", re.MULTILINE)
_ENGINE = re.compile(r"^from rig\.simulation import .*\bSimulation\b", re.MULTILINE)


def _module(nodeid: str) -> str:
    return nodeid.partition("::")[0]


@cache
def _queue(module: str) -> str | None:
    """The queue that a module waits in, if it waits."""
    path = ROOT / module
    if not path.is_file() or _CLOCK.search(path.read_text(encoding="utf-8")) is None:
        return None
    return "rigs" if module.startswith("tests/system/") else "clock"


@cache
def _runs_engine(module: str) -> bool:
    return _ENGINE.search((ROOT / module).read_text(encoding="utf-8")) is not None


def _place(nodeid: str) -> tuple[int, int]:
    """Where a test stands in the order: what waits, engines, what needs none, rigs, what takes long, all others."""
    module = _module(nodeid)
    if _queue(module) == "clock":
        return 0, int(_runs_engine(module))
    if module == COMPILING:
        return 1, 0
    if module == TOOLS:
        return 2, 0
    if module in WITHOUT_ENGINE:
        return 3, WITHOUT_ENGINE.index(module)
    if _queue(module) == "rigs":
        return 4, 0
    if module in LONGEST:
        return 5, LONGEST.index(module)
    return 6, 0


def pytest_configure(config: pytest.Config) -> None:
    # Tests start hundreds of programs, and without stored bytecode each compiles 300 files again: 0.6 s of processor
    # time. Only with workers, that is for the whole suite: `tests/mutants.py` needs its programs without.
    if getattr(config.option, "numprocesses", None):
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    # One cache for all processes that tests start: a program on a bus alone, which knows no kernels of the rig, would
    # keep its machine code elsewhere, and 25 s of compiling would come twice.
    os.environ.setdefault("NUMBA_CACHE_DIR", str(numba.config.CACHE_DIR))
    # Whoever starts the tests in the background may have signals ignored, and what a test starts would inherit that.
    for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, usual)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: _place(item.nodeid))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    # What is imported and collected stays: a million objects, and a full collection took 0.3 s to walk them.
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
        gc.set_threshold(100_000, *gc.get_threshold()[1:])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    from xdist.scheduler import LoadScopeScheduling

    class ByModule(LoadScopeScheduling):
        """Hands out a module at a time."""

        def _split_scope(self, nodeid: str) -> str:
            module = _module(nodeid)
            return _queue(module) or module

    config.option.loadscopereorder = False  # the order is ours
    return ByModule(config, log)
