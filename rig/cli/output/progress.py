"""Progress of long work on stderr: one live line on a terminal, else a line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any

from rig.base.text import printable
from rig.cli.output.tables import echo, progress_bar

_EVERY_S = 15.0
_BAR = 12
_CLOCK = 9
"""Characters of the elapsed time with the blanks beside it."""


@dataclass
class Reporter:
    """Told how far the work has come."""

    bar: Any = None
    """A `rich.progress.Progress` with its one task, or None for lines."""
    task: Any = None
    total: int | None = None
    done: int = 0
    doing: str = ""
    _percent: bool = False
    _printed_s: float = field(default_factory=time.monotonic)

    def begin(self, total: int) -> None:
        """There are this many steps."""
        self.total = total
        if self.bar is not None:
            from rich.progress import BarColumn

            self.bar.columns = (BarColumn(_BAR), *self.bar.columns[-2:])
            self.bar.update(self.task, total=total)

    def step(self, text: str) -> None:
        """One step is done; the next one is this."""
        self.done += 1
        self.doing = text
        self.show(text)

    def part(self, done: float, text: str) -> None:
        """So much of the whole is done, 0 to 1, of something without steps."""
        percent = int(100.0 * done)
        if self.total is None:
            self._percent = True
            self.begin(100)
        if percent > self.done:
            self.done = percent - 1
            self.step(text)

    def say(self, text: str) -> None:
        """This is being done."""
        self.doing = text
        self.show(text, every_s=0.0)

    def show(self, text: str, *, every_s: float = _EVERY_S) -> None:
        """A text for the live line, or for a line of its own if the last is so old [s]."""
        done = f"{self.done} %" if self._percent else f"{self.done} of {self.total}"
        line = f"{done}: {text}" if self.total else text
        if self.bar is not None:
            most = self.bar.console.width - _CLOCK - (_BAR if self.total else 0)
            self.bar.update(self.task, description=printable(line, most), completed=self.done)
        elif text and time.monotonic() - self._printed_s >= every_s:
            self._printed_s = time.monotonic()
            echo(line, err=True)


@contextmanager
def reporting(*, live: bool = True, compiles: bool = False) -> Iterator[Reporter]:
    """Show the progress of what is done inside.

    Args:
        live: With a live line, where there is a terminal.
        compiles: Kernels may be compiled, which is told while it lasts.
    """
    with _bar() if live and sys.stderr.isatty() else nullcontext(Reporter()) as reporter:
        if not compiles:
            yield reporter
            return
        from numba.core.event import install_listener

        from rig.cli.output.compiling import Compiling

        compiling = Compiling(
            lambda text: reporter.show(text, every_s=0.0), lambda text: reporter.show(text or reporter.doing)
        )
        with install_listener("numba:compile", compiling):
            yield reporter


@contextmanager
def _bar() -> Iterator[Reporter]:
    from rich.progress import TimeElapsedColumn

    with progress_bar(TimeElapsedColumn(), transient=True) as bar:
        yield Reporter(bar=bar, task=bar.add_task("", total=None))
