"""Progress of long work on stderr: a live line on a terminal, otherwise occasional lines."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any

from rig.base.text import printable
from rig.cli.output.tables import echo, progress_bar

_LINE_PERIOD_S = 15.0
_BAR = 12
_CLOCK = 9
"""Width of the elapsed time with its spaces [characters]."""


@dataclass
class Reporter:
    """Display of the progress of a task."""

    bar: Any = None
    """A `rich.progress.Progress` with its one task, or None for lines."""
    task: Any = None
    total: int | None = None
    done: int = 0
    activity: str = ""
    _percent: bool = False
    _printed_s: float = field(default_factory=time.monotonic)

    def begin(self, total: int) -> None:
        """Set the number of steps."""
        self.total = total
        if self.bar is not None:
            from rich.progress import BarColumn

            self.bar.columns = (BarColumn(_BAR), *self.bar.columns[-2:])
            self.bar.update(self.task, total=total)

    def step(self, text: str) -> None:
        """Count a finished step, and show the next one."""
        self.done += 1
        self.activity = text
        self.show(text)

    def part(self, done: float, text: str) -> None:
        """Show the finished fraction, 0 to 1, of work without steps."""
        percent = int(100.0 * done)
        if self.total is None:
            self._percent = True
            self.begin(100)
        if percent > self.done:
            self.done = percent - 1
            self.step(text)

    def note(self, text: str) -> None:
        """Print a line that remains."""
        if self.bar is None:
            echo(text, err=True)
        else:
            self.bar.console.print(printable(text), markup=False, highlight=False)

    def show_activity(self, text: str) -> None:
        """Show the current activity."""
        self.activity = text
        self.show(text, every_s=0.0)

    def show(self, text: str, *, every_s: float = _LINE_PERIOD_S) -> None:
        """Show a text in the live line, or print it if the last line is older than `every_s`."""
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
    """Yield a `Reporter` that shows the progress of the block.

    Args:
        live: Use a live line on a terminal or in a notebook.
        compiles: Also show the compiling of kernels.
    """
    with _bar() if live and _is_live() else nullcontext(Reporter()) as reporter:
        if not compiles:
            yield reporter
            return
        from numba.core.event import install_listener

        from rig.cli.output.compiling import Compiling

        compiling = Compiling(
            lambda text: reporter.show(text, every_s=0.0), lambda text: reporter.show(text or reporter.activity)
        )
        with install_listener("numba:compile", compiling):
            yield reporter


@contextmanager
def show_progress(text: str = "") -> Iterator[Callable[[float], None]]:
    """Yield a function of the finished fraction, 0 to 1, that shows a progress bar on a terminal or in a notebook.

    Args:
        text: Description of the work.

    Example:
        >>> import rig
        >>> with rig.show_progress("impact") as progress:
        ...     run = rig.simulate("hammer", duration_s=0.05, progress=progress)
    """
    with reporting() as reporter:
        yield lambda done: reporter.part(done, text)


def _is_live() -> bool:
    """Return whether stderr shows a live line: a terminal, or the output of a notebook's cell."""
    if sys.stderr.isatty():
        return True
    if "IPython" not in sys.modules:
        return False
    from rich.console import Console

    return Console().is_jupyter


@contextmanager
def _bar() -> Iterator[Reporter]:
    from rich.progress import TimeElapsedColumn

    with progress_bar(TimeElapsedColumn(), transient=True) as bar:
        yield Reporter(bar=bar, task=bar.add_task("", total=None))
