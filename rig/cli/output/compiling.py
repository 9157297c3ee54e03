"""Progress of compiling the kernels, from numba's events for functions that are not in its cache."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba.core import config
from numba.core.event import Listener

from rig.cli.output.background_compiling import MARCH, SERIES, start_second_process
from rig.physics.kernel_cache import remove_old_kernels

_ENGINE_S = 40
"""Processor time to compile an engine with its kernels on a typical computer [s]."""


class Compiling(Listener):
    """Listener that reports the module under compilation.

    Kernels compile at their first call, which may be in the middle of the work. The expected time is processor time: a
    busy computer needs several times as long.

    Args:
        on_first_text: Called with the first text.
        on_text: Called with each further text, and with an empty text when compiling pauses.
    """

    def __init__(self, on_first_text: Callable[[str], None], on_text: Callable[[str], None]) -> None:
        self._on_first_text, self._on_text = on_first_text, on_text
        self._modules: list[str] = []
        """Modules of the functions under compilation, outermost first."""
        self._has_reported = self._process_started = False
        self._second_process: subprocess.Popen[bytes] | None = None
        self._spent_s, self._since_s = 0.0, 0.0

    def on_start(self, event: Any) -> None:
        """Report a function that begins to compile."""
        now_s = time.process_time()
        if not self._modules:
            self._since_s = now_s
        self._modules.append(event.data["dispatcher"].py_func.__module__)
        own_modules = [module for module in self._modules if module.startswith(("rig.", "drivers."))]
        if not own_modules:
            return
        if own_modules[0].startswith(SERIES) and not self._process_started:
            self._process_started, self._second_process = True, start_second_process()
        name, spent_s = ".".join(own_modules[-1].split(".")[-2:]), self._spent_s + now_s - self._since_s
        text = f"compiling {name} ({spent_s:.0f} s of CPU; some {_ENGINE_S} s an engine)"
        if self._has_reported:
            self._on_text(text)
        else:
            self._on_first_text(f"{text}, once on this machine")
            remove_old_kernels(Path(vars(config)["CACHE_DIR"]))
        self._has_reported = True

    def on_end(self, event: Any) -> None:
        """Report the end of a function's compilation."""
        module = self._modules.pop()
        if not self._modules:
            if module == MARCH and self._second_process is not None:
                # Otherwise the rest would be compiled twice.
                self._on_text("compiling in a second process")
                self._second_process.wait()
            self._spent_s += time.process_time() - self._since_s
            if self._has_reported:
                self._on_text("")
