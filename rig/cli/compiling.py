"""How far the compiling of the kernels has come: numba tells of each function that its cache does not have."""

from __future__ import annotations

import time
from typing import Any

from numba.core.event import Listener

from rig.cli.progress import Reporter

_ENGINE_S = 30
"""Processor time that an engine takes, with the kernels that it calls, on a usual machine [s]."""


class Compiling(Listener):
    """Tells a reporter.

    Kernels compile when they are first called, which may be in the middle of the work. How long that takes is known as
    processor time only: a busy machine needs several times as long.
    """

    def __init__(self, reporter: Reporter) -> None:
        self._reporter = reporter
        self._depth = 0
        self._spent_s = 0.0
        self._begin_s = 0.0
        self._name = ""

    def on_start(self, event: Any) -> None:
        """A function begins to be compiled, maybe on the way of another one."""
        if not self._depth:
            self._begin_s = time.process_time()
        self._depth += 1
        spent_s = self._spent_s + time.process_time() - self._begin_s
        module, first = event.data["dispatcher"].py_func.__module__, not self._name
        if first or not module.startswith("numba."):
            self._name = ".".join(module.split(".")[-2:])
        text = f"compiling {self._name} ({spent_s:.0f} s of CPU; some {_ENGINE_S} s an engine)"
        if first:
            self._reporter.show(f"{text}, once on this machine", every_s=0.0)
        else:
            self._reporter.show(text)

    def on_end(self, event: Any) -> None:
        """A function is compiled."""
        self._depth -= 1
        if not self._depth:
            self._spent_s += time.process_time() - self._begin_s
            self._reporter.show(self._reporter.doing)
