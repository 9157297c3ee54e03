"""Samples in engineering units, as drivers and the DAQ client hand them out."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from rig.base.samples import Columns
from rig.base.wire import Continuity, row_tick, row_times_s


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
        whole = _join([parts.popleft() for _ in range(run)])
        if rows is not None and count > rows:
            parts.appendleft(whole.rows(rows, count))
            whole = whole.rows(0, rows)
        self.rows -= len(whole)
        return whole

    def clear(self) -> None:
        """Forget all."""
        self._parts.clear()
        self.rows = 0


def _follows(one: Samples, other: Samples) -> bool:
    same = one.names == other.names and one.rate_hz == other.rate_hz
    return same and other.gap == 0 and other.index == one.index + len(one)


def _join(parts: list[Samples]) -> Samples:
    if len(parts) == 1:
        return parts[0]
    return replace(parts[0], values=np.concatenate([part.values for part in parts]))
