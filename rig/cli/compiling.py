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
        self._under_way: list[str] = []
        """Modules of the functions, each on the way of the one before."""
        self._told = False
        self._spent_s, self._since_s = 0.0, 0.0

    def on_start(self, event: Any) -> None:
        """A function begins to be compiled."""
        now_s = time.process_time()
        if not self._under_way:
            self._since_s = now_s
        self._under_way.append(event.data["dispatcher"].py_func.__module__)
        ours = [module for module in self._under_way if module.startswith(("rig.", "drivers."))]
        if not ours:
            return
        name, spent_s = ".".join(ours[-1].split(".")[-2:]), self._spent_s + now_s - self._since_s
        text = f"compiling {name} ({spent_s:.0f} s of CPU; some {_ENGINE_S} s an engine)"
        if self._told:
            self._reporter.show(text)
        else:
            self._reporter.show(f"{text}, once on this machine", every_s=0.0)
        self._told = True

    def on_end(self, event: Any) -> None:
        """A function is compiled."""
        self._under_way.pop()
        if not self._under_way:
            self._spent_s += time.process_time() - self._since_s
            if self._reporter.bar is not None:
                self._reporter.show(self._reporter.doing)
