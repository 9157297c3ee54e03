"""Samples in engineering units, as returned by the drivers and the DAQ client."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NoReturn, Self

import numpy as np

from drivers.link import LinkTimeoutError
from rig.base.errors import InputError
from rig.base.samples import Columns
from rig.base.wire import Block, Continuity, row_tick, row_times_s
from rig.serve.transport import RigLostError
from rig.serve.waiting import Deadline

RIG_LOST = "the link to the rig is lost"
"""Beginning of the reason for an end that is not that of the run."""


class StreamEndedError(EOFError):
    """The stream has ended; the message gives the reason."""


def raise_end(reason: str) -> NoReturn:
    """Raise the error for the end of a stream.

    Raises:
        RigLostError: The rig was lost.
        StreamEndedError: The run has ended, or the reader was closed.
    """
    raise (RigLostError if reason.startswith(RIG_LOST) else StreamEndedError)(reason)


@dataclass(frozen=True, slots=True, repr=False)
class Samples(Columns):
    """Consecutive samples of channels: `samples["disk_x"]` in `samples.unit("disk_x")`, or `samples.to_si()`.

    Attributes:
        index: Number of the first row since the start of the rig's stream, at `rate_hz`.
        tick: Time of the first row, rounded [ticks of the simulated clock]; `times_s` is exact.
        rate_hz: Sample rate [Hz].
        tick_rate_hz: Ticks per second [Hz].
        names: Channel of each column.
        units: Unit of each column.
        values: Engineering values, float64, shape (rows, columns).
        gap: Number of rows missing before the first one.
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
    def from_block(cls, block: Block, names: tuple[str, ...], units: tuple[str, ...], values: np.ndarray) -> Self:
        """Return the rows of a block as columns, with these values in these units."""
        return cls(block.index, block.tick, block.rate_hz, block.tick_rate_hz, names, units, values)

    def __repr__(self) -> str:
        missing = f"; {self.gap} missing before)" if self.gap else ")"
        return Columns.__repr__(self).removesuffix(")") + missing

    @property
    def times_s(self) -> np.ndarray:
        """Simulated time of each row [s], shape (rows,)."""
        return row_times_s(self.tick, self.rate_hz, self.tick_rate_hz, len(self.values))

    def rows(self, start: int, stop: int) -> Samples:
        """Return the rows from `start` to before `stop`."""
        return replace(
            self,
            index=self.index + start,
            tick=row_tick(self.tick, self.rate_hz, self.tick_rate_hz, start),
            values=self.values[start:stop],
            gap=0 if start else self.gap,
        )


_MAX_LATENESS_S = 5.0
"""Rows that are older than this belong to another run; younger ones are duplicates or late."""


def follow(rows: Continuity, samples: Samples, key: str = "") -> Samples | None:
    """Return the new rows of a stream in which rows may come late or twice.

    Args:
        rows: Record of the rows received before; updated.
        samples: The next rows.
        key: Name of the stream.

    Returns:
        The rows that were not received before, with the gap before them; None without new rows.
    """
    stale, lost = rows.stale, rows.lost.get(key, 0)
    rows.follow(key, samples.index, len(samples), late_rows=_MAX_LATENESS_S * samples.rate_hz)
    stale = rows.stale - stale
    if stale == len(samples):
        return None
    return replace(samples.rows(stale, len(samples)), gap=rows.lost[key] - lost)


class RowBuffer:
    """Buffer of rows that wait to be read.

    Args:
        max_rows: Capacity [rows]; beyond it the oldest are dropped, and the next ones report the gap. None: no limit.
    """

    def __init__(self, max_rows: int | None = None) -> None:
        self._max_rows = max_rows
        self._parts: deque[Samples] = deque()
        self.rows = 0
        self.dropped = 0
        """Rows dropped unread."""

    def add(self, samples: Samples) -> None:
        """Append rows."""
        self._parts.append(samples)
        self.rows += len(samples)
        while self._max_rows is not None and self.rows > self._max_rows and len(self._parts) > 1:
            oldest = self._parts.popleft()
            self.rows -= len(oldest)
            self.dropped += len(oldest)
            following = self._parts[0]
            if following.index > oldest.index:
                self._parts[0] = replace(following, gap=following.gap + len(oldest) + oldest.gap)

    def take(self, rows: int | None, *, ended: bool) -> Samples | None:
        """Remove and return the oldest rows, or None if there are too few.

        Fewer rows are returned before a gap and at the end.

        Args:
            rows: Number of rows; None for one part as it was added.
            ended: Whether no more rows will be added.
        """
        parts = self._parts
        if not parts:
            return None
        run, count = 1, len(parts[0])
        if rows is not None:
            while count < rows and run < len(parts) and _is_contiguous(parts[run - 1], parts[run]):
                count += len(parts[run])
                run += 1
            if count < rows and run == len(parts) and not ended:
                return None
        whole = merge_samples(*[parts.popleft() for _ in range(run)])
        if rows is not None and count > rows:
            parts.appendleft(whole.rows(rows, count))
            whole = whole.rows(0, rows)
        self.rows -= len(whole)
        return whole

    def put_back(self, samples: Samples) -> None:
        """Put rows back in front of all others."""
        self._parts.appendleft(samples)
        self.rows += len(samples)

    def clear(self) -> None:
        """Remove all rows."""
        self._parts.clear()
        self.rows = 0


ALL_AVAILABLE = sys.maxsize
"""Number of rows for `RowReader.read` with `whole=False`: all that have arrived."""


class RowReader:
    """Reader of one stream; another thread, or the read itself, adds the rows.

    Args:
        name: Name of the reader in errors.
        max_rows: Capacity [rows]; beyond it the oldest rows are dropped. None: no limit.
    """

    def __init__(self, name: str, max_rows: int | None = None) -> None:
        self._reader_name = name
        self._changed = threading.Condition()
        self._buffer = RowBuffer(max_rows)
        self._ended: str | None = None

    def add(self, samples: Samples) -> None:
        """Append rows."""
        with self._changed:
            self._buffer.add(samples)
            self._changed.notify_all()

    def put_back(self, samples: Samples) -> None:
        """Put back rows that were read: they are read next."""
        with self._changed:
            self._buffer.put_back(samples)

    def read(self, rows: int | None = None, *, timeout_s: float = 5.0, whole: bool = True) -> Samples:
        """Return the next rows, without a gap inside; `gap` is the number of rows missing before them.

        Args:
            rows: Number of rows, at least 1; None for the next part as it arrives. Fewer are returned before a gap and
                at the end.
            timeout_s: Longest wait [s].
            whole: Whether to wait for all of them; False returns what has arrived, at least one row.

        Raises:
            LinkTimeoutError: The rows did not arrive in time; those that did can still be read.
            StreamEndedError: The stream has ended, and everything was read.
            RigLostError: The rig was lost, and everything was read.
        """
        self._check(rows)
        deadline = Deadline(timeout_s)
        with self._changed:
            while (ready := self._take(rows, whole=whole)) is None:
                if not self._wait(deadline):
                    raise self._timeout_error(rows, timeout_s)
            return ready

    def ready(self) -> Iterator[Samples]:
        """Yield the rows that have arrived, in pieces without a gap inside."""
        try:
            while True:
                yield self.read(ALL_AVAILABLE, timeout_s=0.0, whole=False)
        except (LinkTimeoutError, StreamEndedError, RigLostError):
            return

    def blocks(self, rows: int | None = None, *, timeout_s: float = 5.0) -> Iterator[Samples]:
        """Yield blocks of `rows` rows to the end of the stream; arguments and errors as for `read`."""
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
        """Return the rows that are ready, or None; the caller holds the lock."""
        ready = self._buffer.take(rows, ended=not whole or self._ended is not None)
        if ready is None and self._ended is not None:
            raise_end(self._ended)
        return ready

    def _wait(self, deadline: Deadline) -> bool:
        """Wait for more rows, and return False once the deadline has passed; the caller holds the lock."""
        return deadline.wait(self._changed)

    def _timeout_error(self, rows: int | None, timeout_s: float) -> LinkTimeoutError:
        wanted = "any" if rows in (None, ALL_AVAILABLE) else rows
        return LinkTimeoutError(f"{self._reader_name}: {self._buffer.rows} of {wanted} rows came in {timeout_s:g} s")


def _is_contiguous(one: Samples, other: Samples) -> bool:
    same = one.names == other.names and one.rate_hz == other.rate_hz
    return same and other.gap == 0 and other.index == one.index + len(one)


def merge_samples(*parts: Samples) -> Samples:
    """Merge samples that follow each other into one piece."""
    return parts[0] if len(parts) == 1 else replace(parts[0], values=np.concatenate([part.values for part in parts]))
