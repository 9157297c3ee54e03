"""Counts of received, lost and malformed data, as written at the end of a recording."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from recorder.files.payload import Payload
from rig.base.wire import EDGES, FAULTS, Gap
from rig.channels.faults.ledger import Declared

NS = 1_000_000_000


@dataclass(frozen=True)
class Counts:
    """Totals of one file, or the sum over several files.

    Attributes:
        first_time_ns: Simulated time of the first row [ns]; None before the first row.
        last_time_ns: Simulated time of the last row [ns].
        rows: Rows received by key.
        lost: Rows lost by key.
        declared: Rows among the lost that the rig reported as removed by a fault, by key.
        gaps: Number of gaps.
        missed: Messages that the transport dropped, by key.
        malformed: Number of payloads that do not fit the format of their key.
        size_bytes: Size on the disk [bytes].
        safe_time_ns: Simulated time up to which all data are on the disk [ns].
    """

    first_time_ns: int | None = None
    last_time_ns: int = 0
    rows: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    gaps: int = 0
    missed: dict[str, int] = field(default_factory=dict)
    malformed: int = 0
    size_bytes: int = 0
    safe_time_ns: int = 0
    declared: dict[str, int] = field(default_factory=dict)

    @property
    def undeclared_lost(self) -> int:
        """Number of rows lost without a fault that explains the loss."""
        return sum(max(0, lost - self.declared.get(key, 0)) for key, lost in self.lost.items())

    @property
    def extent_ns(self) -> int:
        """Simulated time from the first to the last row [ns]."""
        return 0 if self.first_time_ns is None else self.last_time_ns - self.first_time_ns

    def __add__(self, later: Counts) -> Counts:
        firsts = [each.first_time_ns for each in (self, later) if each.first_time_ns is not None]
        return Counts(
            first_time_ns=min(firsts, default=None),
            last_time_ns=max(self.last_time_ns, later.last_time_ns),
            rows=_sum(self.rows, later.rows),
            lost=_sum(self.lost, later.lost),
            gaps=self.gaps + later.gaps,
            missed=_sum(self.missed, later.missed),
            malformed=self.malformed + later.malformed,
            size_bytes=self.size_bytes + later.size_bytes,
            safe_time_ns=max(self.safe_time_ns, later.safe_time_ns),
            declared=_sum(self.declared, later.declared),
        )


def _sum(first: dict[str, int], second: dict[str, int]) -> dict[str, int]:
    return {key: first.get(key, 0) + second.get(key, 0) for key in {**first, **second}}


class Tally:
    """Counter of arriving payloads, row numbers and times.

    Attributes:
        gaps, missed, malformed, first_time_ns, last_time_ns: As in `Counts`.
    """

    def __init__(self, tick_rate_hz: int, *, due: dict[str, int] | None = None, from_start: bool = False) -> None:
        """Start counting.

        Args:
            tick_rate_hz: Ticks per simulated second [Hz].
            due: Number of the first expected row by key, where a file continues another one.
            from_start: Expect row 0 first in every other stream; otherwise start with the first row that arrives.
        """
        self.gaps = self.malformed = self.last_time_ns = 0
        self.missed: dict[str, int] = {}
        self.first_time_ns: int | None = None
        self._continuity = Declared()
        self._tick_rate_hz = tick_rate_hz
        self._from_start = from_start
        for key, index in (due or {}).items():
            self._continuity.follow(key, index, 0)

    @property
    def next(self) -> dict[str, int]:
        """Number of the next expected row by key."""
        return self._continuity.next

    def time_ns(self, tick: int) -> int:
        """Return the simulated time of a tick, clamped to the range of a message time [ns]."""
        return max(0, min(tick * NS // self._tick_rate_hz, 1 << 62))

    def extent_ns(self, payload: Payload) -> tuple[int, int]:
        """Return the simulated times of the first and the last row of a block [ns].

        A document counts as one instant: its tick, or the time of the latest row if it has none.
        """
        tick, block = payload.tick, payload.block
        start_ns = self.last_time_ns if tick is None else self.time_ns(tick)
        if block is None or payload.key == EDGES:
            return start_ns, start_ns
        return start_ns, start_ns + round((len(block.values) - 1) * NS / block.rate_hz)

    def restore(self, payload: Payload) -> Payload:
        """Return a payload, its block with the row number and tick that it had before a fault changed them."""
        block = payload.block
        return payload if block is None else replace(payload, block=self._continuity.true(payload.key, block))

    def take(self, payload: Payload) -> Gap | None:
        """Count a payload and return the step of the row numbers before it, if any."""
        self.malformed += payload.malformed
        block, key = payload.block, payload.key
        if block is None:
            if key == FAULTS and payload.document is not None:
                self._continuity.declare(payload.document)
            return None
        start_ns, end_ns = self.extent_ns(self.restore(payload))
        if self._from_start and key not in self.next:
            self._continuity.follow(key, 0, 0)
        gap = self._continuity.take(key, block)
        self.gaps += gap is not None
        self.first_time_ns = start_ns if self.first_time_ns is None else min(start_ns, self.first_time_ns)
        if key != EDGES:
            self.last_time_ns = max(self.last_time_ns, end_ns)
        return gap

    def count_missed(self, key: str, messages: int) -> None:
        """Count messages that the transport dropped."""
        self.missed[key] = self.missed.get(key, 0) + messages

    def find_missing_rows(self, rows: dict[str, int]) -> dict[str, int]:
        """Return the streams that received fewer rows than the rig published.

        Args:
            rows: Number of the row after the last published one, by key.

        Returns:
            The entries of `rows` for the incomplete streams.
        """
        due = dict(self.next)
        return {key: end for key, end in rows.items() if due.get(key, end) < end}

    def end(self, rows: dict[str, int]) -> list[Gap]:
        """Count the rows missing at the end of each stream as gaps and return the gaps; see `find_missing_rows`."""
        ends = [self._continuity.follow(key, end, 0) for key, end in self.find_missing_rows(rows).items()]
        gaps = [gap for gap in ends if gap is not None]
        self.gaps += len(gaps)
        return gaps

    def counts(self, *, size_bytes: int, safe_time_ns: int = 0) -> Counts:
        """Return the totals up to now. Safe to call from any thread."""
        return Counts(
            first_time_ns=self.first_time_ns,
            last_time_ns=self.last_time_ns,
            rows=dict(self._continuity.received),
            lost=dict(self._continuity.lost),
            gaps=self.gaps,
            missed=dict(self.missed),
            malformed=self.malformed,
            size_bytes=size_bytes,
            safe_time_ns=safe_time_ns,
            declared=dict(self._continuity.declared),
        )
