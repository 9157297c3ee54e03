"""Distribution of tests over workers (`-n`), and fixtures that many tests share.

Tests that read the clock or start processes wait most of their time. Modules marked in this way form three queues, each
processed by one worker. Tests within a process come first; the pages of the docs, and the tests that run an engine or
start real rigs, follow, when that engine is compiled. A second worker compiles all engines one after another, because
two that compile at the same time would both compile the shared parts. A third worker runs the tools and other modules
that need no engine until the default engine is compiled. All other modules follow, the longest first.

Without a file or folder, `pytest` leaves out the long tests (`tests.long_tests`); `pytest tests` runs all.
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
from tests import long_tests

ROOT = Path(__file__).parents[1]
SHIPPED_TABLE = "RIG_TESTS_SHIPPED_TABLE"
"""Environment: if set, tests run with the rig's own channel table; tests.unit.test_shipped_table sets it."""
if SHIPPED_TABLE not in os.environ:
    assert not table.default_table.cache_info().currsize
    table.TABLE = ROOT / "tests/channels.toml"
WORKER_SETTING = "rig_long_tests"
"""Key for workers: whether to run the long tests."""
COSTS = "RIG_TEST_COSTS"
"""Environment: file to which each test appends its processor time."""
COMPILING = "tests/parity/test_compiling.py"
TOOLS = "tests/house/test_tools.py"
PAGES = "tests/system/test_pages.py"
WITHOUT_ENGINE = (
    "tests/unit/test_laws_command.py",
    "tests/unit/test_magnets_command.py",
    "tests/unit/test_report.py",
    "tests/house/test_sizes.py",
    "tests/house/test_contracts.py",
    "tests/unit/test_score_track.py",
    "tests/unit/test_log_defects.py",
    "tests/unit/test_time_order.py",
    "tests/unit/test_recorder_health.py",
    "tests/unit/test_guess.py",
    "tests/unit/test_score_bits.py",
    "tests/unit/test_import_defects.py",
)
"""Modules that run no engine, for as long as the default engine compiles (75 s of processor time). A rig or a test that
runs an engine during this time would compile it as well, and take 40 s of processor time for it."""
LONG_MODULES = (
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
"""Modules that take more than 8 s and therefore must not start last."""
_CLOCK = re.compile(r"^pytestmark = .*\bwallclock\b", re.MULTILINE)
_ENGINE = re.compile(r"^from rig\.run\.simulation import .*\bSimulation\b", re.MULTILINE)


def _module(nodeid: str) -> str:
    return nodeid.partition("::")[0]


@cache
def _queue(module: str) -> str | None:
    """Return the queue of a module; None if it does not wait."""
    path = ROOT / module
    if not path.is_file() or _CLOCK.search(text := path.read_text(encoding="utf-8")) is None:
        return None
    if module == PAGES:
        return "pages"
    return "rigs" if module.startswith("tests/system/") or _ENGINE.search(text) else "clock"


def _place(nodeid: str) -> tuple[int, int]:
    """Return the position of a test: clock, engines, tests without engine, pages, rigs, long tests, all others."""
    module = _module(nodeid)
    if _queue(module) == "clock":
        return 0, 0
    if module == COMPILING:
        return 1, 0
    if module == TOOLS:
        return 2, 0
    if module in WITHOUT_ENGINE:
        return 3, WITHOUT_ENGINE.index(module)
    if (queue := _queue(module)) is not None:
        return 4, int(queue == "rigs")
    if module in LONG_MODULES:
        return 5, LONG_MODULES.index(module)
    return 6, 0


def pytest_configure(config: pytest.Config) -> None:
    # Tests start hundreds of programs. Without stored bytecode each compiles 300 files again: 0.6 s of processor time.
    # Only with workers, that is for the whole suite: the programs of `tests/mutants.py` need it off.
    if getattr(config.option, "numprocesses", None):
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        # Workers occupy all cores. A second thread in each would only wait for them: 15 % of the processor time.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # One cache for all processes that tests start. Without it, a program that uses the bus only would keep its machine
    # code elsewhere and compile for another 25 s.
    os.environ.setdefault("NUMBA_CACHE_DIR", str(numba.config.CACHE_DIR))
    # A shell that starts the tests in the background may have signals ignored, and child processes would inherit that.
    for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, usual)


def _runs_long_tests(config: pytest.Config) -> bool:
    """Return whether files or folders were given; a worker, which is always given some, asks the main process."""
    given = config.args_source is not pytest.Config.ArgsSource.TESTPATHS
    return getattr(config, "workerinput", {}).get(WORKER_SETTING, given)


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    node.workerinput[WORKER_SETTING] = _runs_long_tests(node.config)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not _runs_long_tests(config):
        items[:], left_out = long_tests.split(items)
        config.hook.pytest_deselected(items=left_out)
    items.sort(key=lambda item: _place(item.nodeid))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    if COSTS not in os.environ:
        return (yield)
    begin_s = long_tests.processor_time_s()
    try:
        return (yield)
    finally:
        long_tests.append_cost(Path(os.environ[COSTS]), item.nodeid, long_tests.processor_time_s() - begin_s)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    # Exclude imports and collected tests from garbage collection: one full pass over a million objects took 0.3 s.
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
        """Distribute one module at a time."""

        def _split_scope(self, nodeid: str) -> str:
            module = _module(nodeid)
            return _queue(module) or module

    config.option.loadscopereorder = False  # keep this order
    return ByModule(config, log)
