"""Progress of long work on stderr: one live line on a terminal, else a line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from rig.cli.tables import echo, progress_bar

_EVERY_S = 15.0


@dataclass
class Reporter:
    """Told how far the work has come."""

    bar: Any = None
    """A `rich.progress.Progress` with its one task, or None for lines."""
    task: Any = None
    total: int | None = None
    done: int = 0
    _printed_s: float = field(default_factory=time.monotonic)

    def begin(self, total: int) -> None:
        """There are this many steps."""
        self.total = total
        if self.bar is not None:
            self.bar.update(self.task, total=total)

    def step(self, text: str) -> None:
        """One step is done; the next one is this."""
        self.done += 1
        if self.bar is not None or time.monotonic() - self._printed_s > _EVERY_S:
            self.say(text)

    def part(self, done: float, text: str) -> None:
        """So much of the whole is done, 0 to 1, of something without steps."""
        percent = int(100.0 * done)
        if self.total is None:
            self.begin(100)
        if percent > self.done:
            self.done = percent - 1
            self.step(text)

    def say(self, text: str) -> None:
        """This is being done."""
        if self.bar is not None:
            self.bar.update(self.task, description=text, completed=self.done)
            return
        self._printed_s = time.monotonic()
        count = f"{self.done} of {self.total}: " if self.total else ""
        echo(f"{count}{text}", err=True)


def tell_of_compiling() -> None:
    """Say why nothing is seen at first, where the kernels were never compiled on this machine."""
    from rig.kernels import COMPILE_NOTICE, compiled_before

    if not compiled_before():
        echo(COMPILE_NOTICE, err=True)


@contextmanager
def reporting() -> Iterator[Reporter]:
    """Show the progress of what is done inside."""
    if not sys.stderr.isatty():
        yield Reporter()
        return
    from rich.progress import BarColumn, MofNCompleteColumn, TimeElapsedColumn

    columns = (BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn())
    with progress_bar(*columns, transient=True) as bar:
        yield Reporter(bar=bar, task=bar.add_task("", total=None))
