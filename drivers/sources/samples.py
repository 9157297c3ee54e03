"""Samples in engineering units, as drivers and the DAQ client hand them out."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from drivers.link import LinkTimeoutError
from rig.base.errors import InputError
from rig.base.samples import Columns
from rig.base.wire import Block, Continuity, row_tick, row_times_s
from rig.serve.waiting import Deadline


class StreamEndedError(EOFError):
    """Nothing more will come; the message says why."""


@dataclass(frozen=True, slots=True, repr=False)
class Samples(Columns):
    """Consecutive rows of some channels: `samples["disk_x"]` in its `samples.unit("disk_x")`, `samples.to_si()` in SI.

    Attributes:
        index: Number of the first row since the start of the rig's stream, at `rate_hz`.
        tick: Time of the first row, to the nearest [ticks of the simulated clock]; `times_s` is exact.
        rate_hz: Rows per second [Hz].
        tick_rate_hz: Ticks per second [Hz].
        names: Names of the columns, which are channels.
        units: Unit of each column.
        values: Engineering values, float64, shape (rows, columns).
        gap: Rows that are missing right before the first one.
    """

    index: int
    tick: int
    rate_hz: float
    tick_rate_hz: float
    names: tuple[str, ...]  # pyrefly: ignore[bad-override]
    units: tuple[str, ...]  # pyrefly: ignore[bad-override]
    values: np.ndarray  # pyrefly: ignore[bad-override]
    gap: int = 0

    @classmethod
    def of(cls, block: Block, names: tuple[str, ...], units: tuple[str, ...], values: np.ndarray | None = None) -> Self:
        """Return the rows of a block, with its values unless others are given, as columns."""
        chosen = block.values if values is None else values
        return cls(block.index, block.tick, block.rate_hz, block.tick_rate_hz, names, units, chosen)

    def __repr__(self) -> str:
        missing = f"; {self.gap} missing before them)" if self.gap else ")"
        return Columns.__repr__(self).removesuffix(")") + missing

    @property
    def times_s(self) -> np.ndarray:
        """Simulated time of each row [s], shape (rows,)."""
        return row_times_s(self.tick, self.rate_hz, self.tick_rate_hz, len(self.values))

    def rows(self, start: int, stop: int) -> Samples:
        """Some of the rows."""
        return replace(
            self,
            index=self.index + start,
            tick=row_tick(self.tick, self.rate_hz, self.tick_rate_hz, start),
            values=self.values[start:stop],
            gap=0 if start else self.gap,
        )


RESTART_S = 5.0
"""Rows that are further behind than this belong to another run, not to a block that came twice or late."""


def follow(rows: Continuity, samples: Samples, key: str = "") -> Samples | None:
    """Follow one stream of rows that may come late or twice.

    Args:
        rows: What has come; gets the new rows.
        samples: The next ones.
        key: The stream.

    Returns:
        The same rows without those that came before, with the gap before them; None where nothing is new.
    """
    stale, lost = rows.stale, rows.lost.get(key, 0)
    rows.follow(key, samples.index, len(samples), late_rows=RESTART_S * samples.rate_hz)
    stale = rows.stale - stale
    if stale == len(samples):
        return None
    return replace(samples.rows(stale, len(samples)), gap=rows.lost[key] - lost)


class Pile:
    """Rows that wait to be read.

    Args:
        most: Number of rows that are kept; beyond, the oldest go, and the next ones tell of the gap.
    """

    def __init__(self, most: int | None = None) -> None:
        self._most = most
        self._parts: deque[Samples] = deque()
        self.rows = 0
        self.dropped = 0
        """Rows that went unread."""

    def add(self, samples: Samples) -> None:
        """Put rows on top."""
        self._parts.append(samples)
        self.rows += len(samples)
        while self._most is not None and self.rows > self._most and len(self._parts) > 1:
            oldest = self._parts.popleft()
            self.rows -= len(oldest)
            self.dropped += len(oldest)
            following = self._parts[0]
            if following.index > oldest.index:
                self._parts[0] = replace(following, gap=following.gap + len(oldest) + oldest.gap)

    def take(self, rows: int | None, *, ended: bool) -> Samples | None:
        """The lowest rows, if there are as many as asked for, or all that there will be before a gap or the end.

        Args:
            rows: How many; None takes a part as it came.
            ended: Whether nothing more will be added.
        """
        parts = self._parts
        if not parts:
            return None
        run, count = 1, len(parts[0])
        if rows is not None:
            while count < rows and run < len(parts) and _follows(parts[run - 1], parts[run]):
                count += len(parts[run])
                run += 1
            if count < rows and run == len(parts) and not ended:
                return None
        whole = joined(*[parts.popleft() for _ in range(run)])
        if rows is not None and count > rows:
            parts.appendleft(whole.rows(rows, count))
            whole = whole.rows(0, rows)
        self.rows -= len(whole)
        return whole

    def put_back(self, samples: Samples) -> None:
        """Put rows that were taken below all others."""
        self._parts.appendleft(samples)
        self.rows += len(samples)

    def clear(self) -> None:
        """Forget all."""
        self._parts.clear()
        self.rows = 0


ALL = sys.maxsize
"""Number of rows for `RowReader.read`, without `whole`: all that have come."""


class RowReader:
    """Rows of one stream, read in order by one thread, while they come in on another or during the read.

    Args:
        name: Name of the reader in errors.
        most: Number of rows that wait to be read; beyond, the oldest are dropped. None: any number.
    """

    def __init__(self, name: str, most: int | None = None) -> None:
        self._reader_name = name
        self._changed = threading.Condition()
        self._pile = Pile(most)
        self._ended: str | None = None

    def add(self, samples: Samples) -> None:
        """Add rows behind all others."""
        with self._changed:
            self._pile.add(samples)
            self._changed.notify_all()

    def put_back(self, samples: Samples) -> None:
        """Put back rows that were read: they are read next."""
        with self._changed:
            self._pile.put_back(samples)

    def read(self, rows: int | None = None, *, timeout_s: float = 5.0, whole: bool = True) -> Samples:
        """Return the next rows, without a gap inside; `gap` is the number of rows missing right before them.

        Args:
            rows: Number of rows; None takes what comes next, at least one. Fewer come before a gap and at the end.
            timeout_s: Longest wait [s].
            whole: Whether to wait for all of them; False takes what has come, at least one.

        Raises:
            LinkTimeoutError: They did not come in time; those that did can still be read.
            StreamEndedError: The stream has ended and everything was read.
        """
        self._check(rows)
        deadline = Deadline(timeout_s)
        with self._changed:
            while (ready := self._take(rows, whole=whole)) is None:
                if not self._wait(deadline):
                    raise self._late(rows, timeout_s)
            return ready

    def ready(self) -> Iterator[Samples]:
        """Yield the rows that have come, in pieces without a gap inside."""
        try:
            while True:
                yield self.read(ALL, timeout_s=0.0, whole=False)
        except (LinkTimeoutError, StreamEndedError):
            return

    def blocks(self, rows: int | None = None, *, timeout_s: float = 5.0) -> Iterator[Samples]:
        """Read until the end."""
        while True:
            try:
                yield self.read(rows, timeout_s=timeout_s)
            except StreamEndedError:
                return

    @staticmethod
    def _check(rows: int | None) -> None:
        if rows is not None and rows < 1:
            raise InputError("rows", "at least 1", rows)

    def _take(self, rows: int | None, *, whole: bool = True) -> Samples | None:
        """Rows that are ready; the lock is held."""
        ready = self._pile.take(rows, ended=not whole or self._ended is not None)
        if ready is None and self._ended is not None:
            raise StreamEndedError(self._ended)
        return ready

    def _wait(self, deadline: Deadline) -> bool:
        """Wait for more to happen; False once the deadline has passed. The lock is held."""
        return deadline.wait(self._changed)

    def _late(self, rows: int | None, timeout_s: float) -> LinkTimeoutError:
        wanted = "any" if rows in (None, ALL) else rows
        return LinkTimeoutError(f"{self._reader_name}: {self._pile.rows} of {wanted} rows came in {timeout_s:g} s")


def _follows(one: Samples, other: Samples) -> bool:
    same = one.names == other.names and one.rate_hz == other.rate_hz
    return same and other.gap == 0 and other.index == one.index + len(one)


def joined(*parts: Samples) -> Samples:
    """Return rows, and those that follow them, as one."""
    return parts[0] if len(parts) == 1 else replace(parts[0], values=np.concatenate([part.values for part in parts]))
