"""How far the compiling of the kernels has come: numba tells of each function that its cache does not have."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from typing import Any

from numba.core.event import Listener

from rig.cli.output.background_compiling import MARCH, SERIES, start_beside

_ENGINE_S = 40
"""Processor time that an engine takes, with the kernels that it calls, on a usual machine [s]."""


class Compiling(Listener):
    """Tells of it as it goes on.

    Kernels compile when they are first called, which may be in the middle of the work. How long that takes is known as
    processor time only: a busy machine needs several times as long.

    Args:
        begun: Told what is compiled, the first time.
        going_on: Told what is, whenever that changes, and an empty text when there is no more for now.
    """

    def __init__(self, begun: Callable[[str], None], going_on: Callable[[str], None]) -> None:
        self._begun, self._going_on = begun, going_on
        self._under_way: list[str] = []
        """Modules of the functions, each on the way of the one before."""
        self._told = self._began = False
        self._beside: subprocess.Popen[bytes] | None = None
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
        if ours[0].startswith(SERIES) and not self._began:
            self._began, self._beside = True, start_beside()
        name, spent_s = ".".join(ours[-1].split(".")[-2:]), self._spent_s + now_s - self._since_s
        text = f"compiling {name} ({spent_s:.0f} s of CPU; some {_ENGINE_S} s an engine)"
        if self._told:
            self._going_on(text)
        else:
            self._begun(f"{text}, once on this machine")
        self._told = True

    def on_end(self, event: Any) -> None:
        """A function is compiled."""
        module = self._under_way.pop()
        if not self._under_way:
            if module == MARCH and self._beside is not None:
                # The rest would be compiled here a second time.
                self._going_on("compiling in a second process")
                self._beside.wait()
            self._spent_s += time.process_time() - self._since_s
            if self._told:
                self._going_on("")
