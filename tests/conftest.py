"""How the tests are shared out where several run at once (`-n`), and what many of them use.

Tests that read the clock or start processes wait most of their time: the modules marked so as a whole make up two
queues, each gone through by one worker. Those within a process come at once; those that start real rigs come as soon as
other workers have compiled the kernels, each engine's once. All else is taken module by module, the longest first.
"""

from __future__ import annotations

import gc
import re
import signal
from functools import cache
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
COMPILING = "tests/parity/test_compiling.py"
LONGEST = (
    "tests/house/test_tools.py",
    "tests/unit/test_chart.py",
    "tests/physics/test_identification.py",
    "tests/unit/test_paper.py",
    "tests/physics/test_law_engines.py",
    "tests/hostile/test_texts.py",
    "tests/physics/test_stability.py",
    "tests/unit/test_import.py",
    "tests/unit/test_identification.py",
    "tests/unit/test_nuisance.py",
    "tests/physics/test_reference.py",
    "tests/hostile/test_files.py",
)
"""Modules that take more than 10 s, for which nobody is to wait at the end."""
_CLOCK = re.compile(r"^pytestmark = .*\bwallclock\b", re.MULTILINE)


def _module(nodeid: str) -> str:
    return nodeid.partition("::")[0]


@cache
def _queue(module: str) -> str | None:
    """The queue that a module waits in, if it waits."""
    path = ROOT / module
    if not path.is_file() or _CLOCK.search(path.read_text(encoding="utf-8")) is None:
        return None
    return "rigs" if module.startswith("tests/system/") else "clock"


def _place(nodeid: str) -> tuple[int, int]:
    """Where a test stands in the order: what waits, what compiles, what starts rigs, what takes long, all others."""
    module = _module(nodeid)
    if _queue(module) == "clock":
        return 0, 0
    if module == COMPILING:
        return 1, 0
    if _queue(module) == "rigs":
        return 2, 0
    if module in LONGEST:
        return 3, LONGEST.index(module)
    return 4, 0


def pytest_configure() -> None:
    # Whoever starts the tests in the background may have signals ignored, and what a test starts would inherit that.
    for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, usual)
    gc.disable()  # until the tests begin: what is imported and collected before is never garbage


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: _place(item.nodeid))


def pytest_collection_finish() -> None:
    # A million objects that stay: a full collection took 0.3 s to walk them, again and again.
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
            return nodeid if module == COMPILING else _queue(module) or module

    config.option.loadscopereorder = False  # the order is ours
    return ByModule(config, log)
