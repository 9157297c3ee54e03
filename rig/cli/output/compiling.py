"""Progress of compiling the kernels, from numba's events for functions that are not in its cache."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from typing import Any

from numba.core.event import Listener

from rig.cli.output.background_compiling import MARCH, SERIES, start_second_process

_ENGINE_S = 40
"""Processor time to compile an engine with its kernels on a typical computer [s]."""


class Compiling(Listener):
    """Listener that reports the module under compilation.

    Kernels compile at their first call, which may be in the middle of the work. The expected time is processor time: a
    busy computer needs several times as long.

    Args:
        begun: Called with the first text.
        going_on: Called with each further text, and with an empty text when compiling pauses.
    """

    def __init__(self, begun: Callable[[str], None], going_on: Callable[[str], None]) -> None:
        self._begun, self._going_on = begun, going_on
        self._under_way: list[str] = []
        """Modules of the functions under compilation, outermost first."""
        self._told = self._began = False
        self._beside: subprocess.Popen[bytes] | None = None
        self._spent_s, self._since_s = 0.0, 0.0

    def on_start(self, event: Any) -> None:
        """Report a function that begins to compile."""
        now_s = time.process_time()
        if not self._under_way:
            self._since_s = now_s
        self._under_way.append(event.data["dispatcher"].py_func.__module__)
        ours = [module for module in self._under_way if module.startswith(("rig.", "drivers."))]
        if not ours:
            return
        if ours[0].startswith(SERIES) and not self._began:
            self._began, self._beside = True, start_second_process()
        name, spent_s = ".".join(ours[-1].split(".")[-2:]), self._spent_s + now_s - self._since_s
        text = f"compiling {name} ({spent_s:.0f} s of CPU; some {_ENGINE_S} s an engine)"
        if self._told:
            self._going_on(text)
        else:
            self._begun(f"{text}, once on this machine")
        self._told = True

    def on_end(self, event: Any) -> None:
        """Report the end of a function's compilation."""
        module = self._under_way.pop()
        if not self._under_way:
            if module == MARCH and self._beside is not None:
                # Otherwise the rest would be compiled twice.
                self._going_on("compiling in a second process")
                self._beside.wait()
            self._spent_s += time.process_time() - self._since_s
            if self._told:
                self._going_on("")
