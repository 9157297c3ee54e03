"""Acquisition of one task: triggers, sample clock and buffer, in counts of the converter."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.daq import Daq
from drivers.daqmx.hardware.errors import Code
from drivers.sources import Source
from drivers.sources.samples import Samples, merge_samples
from rig.base.wire import row_tick


@dataclass(frozen=True, slots=True)
class Trigger:
    """Edge of a channel.

    Attributes:
        channel: Name in the channel table.
        level: Level [counts].
        rising: Whether the counts rise.
    """

    channel: str
    level: float
    rising: bool

    def find(self, before: np.ndarray, samples: Samples) -> np.ndarray:
        """Return the rows at which the level is crossed, from samples and the counts before each."""
        column, sign = samples.names.index(self.channel), 1 if self.rising else -1
        last, new = (sign * (counts[:, column] - self.level) for counts in (before, samples.values))
        return np.flatnonzero((last < 0) & (new >= 0))


@dataclass(frozen=True, slots=True)
class Plan:
    """Channels, rows and triggers of an acquisition.

    Attributes:
        columns: Number of channels that the program reads; the others are for triggers.
        step: Rows of the rig per sample.
        keep: Samples of a finite acquisition; None: continuous.
        max_rows: Size of the buffer [samples].
        start: Start trigger.
        reference: Reference trigger.
        pretrigger: Samples before the reference trigger.
        retrigger: Whether each start trigger acquires again.
        newest_only: Keep only the newest sample, for reads on demand.
        measure: Measurement of a counter, whose `feed` returns values of rows.
    """

    columns: int
    step: int = 1
    keep: int | None = None
    max_rows: int = 1
    start: Trigger | None = None
    reference: Trigger | None = None
    pretrigger: int = 0
    retrigger: bool = False
    newest_only: bool = False
    measure: Any = None


class Acquisition(Daq):
    """Samples of channels from a start on, numbered from 0.

    Args:
        source: Source of counts; `close` closes it too.
        channels: Names in the channel table, those of the triggers last.
        rate_hz: Rate of the source [Hz].
        plan: What to acquire.
    """

    def __init__(self, source: Source, channels: Sequence[str], rate_hz: float, plan: Plan) -> None:
        self._plan = plan
        self._armed = plan.start is not None
        self._pending: deque[Samples] | None = deque() if plan.reference is not None else None
        self._before: np.ndarray | None = None
        """Last row received."""
        self._remaining = plan.keep
        self._phase = 0
        self._first_row = 0
        """Row of the rig at sample 0."""
        self.acquired = 0
        """Samples that were put into the buffer."""
        self.complete = False
        """True if a finite acquisition has all of its samples."""
        self.failure: tuple[Code, str] | None = None
        """Error that ended the acquisition."""
        super().__init__(source, channels=channels, rate_hz=rate_hz, buffer_s=plan.max_rows * plan.step / rate_hz)

    @property
    def available(self) -> int:
        """Samples that can be read."""
        return self._buffer.rows

    @property
    def done(self) -> bool:
        """True if no more samples will come."""
        return self.complete or self.failure is not None or self.ended is not None

    def wait(self, *, timeout_s: float | None = None) -> bool:
        """Wait for a change; return whether no more samples will come."""
        with self._changed:
            return self.done or (self._changed.wait(timeout_s) and self.done)

    def _position(self, ready: Samples) -> int:
        return self._first_row + (ready.index + len(ready)) * self._plan.step

    def _add(self, samples: Samples) -> None:
        plan = self._plan
        if samples.gap and not self.done:
            self._fail(f"{samples.gap} samples were lost between the rig and the device")
        before = samples.values[:1] if self._before is None else self._before
        before = np.concatenate([before, samples.values[:-1]])
        self._before = samples.values[-1:]
        row = 0
        while row < len(samples) and not self.complete and self.failure is None:
            if self._armed and plan.start is not None:
                edges = plan.start.find(before[row:], samples.rows(row, len(samples)))
                if not len(edges):
                    break
                row, self._armed, self._phase = row + int(edges[0]), False, 0
            row += self._take_piece(samples.rows(row, len(samples)), before[row:])
        if self.done or self._armed or self._pending is not None or plan.newest_only or plan.measure is not None:
            # Nothing of this is unread, so a rig that waits for its readers may continue.
            self._source.report_position(samples.index + len(samples), room=self._room, lost=0)

    def _take_piece(self, piece: Samples, before: np.ndarray) -> int:
        """Acquire from rows after the start trigger; return the number of rows used."""
        plan = self._plan
        values = piece.values[:, : plan.columns] if plan.measure is None else plan.measure.feed(piece)
        rows, first = np.arange(self._phase, len(values), plan.step), self._phase
        self._phase = (self._phase - len(values)) % plan.step
        samples = replace(
            piece,
            tick=row_tick(piece.tick, piece.rate_hz, piece.tick_rate_hz, first),
            rate_hz=piece.rate_hz / plan.step,
            names=piece.names[: plan.columns],
            units=piece.units[: plan.columns],
            values=values[rows],
            gap=0,
        )
        if self._pending is not None and plan.reference is not None:
            edges = np.searchsorted(rows, plan.reference.find(before, piece))
            if (samples := self._hold(samples, edges)) is None:
                return len(piece)
        used = len(piece)
        if self._remaining is not None and len(samples) >= self._remaining:
            samples = samples.rows(0, self._remaining)
            used = int(rows[len(samples) - 1]) + 1 if plan.retrigger else used
            self._remaining, self._armed = plan.keep, plan.retrigger
            self.complete = not plan.retrigger
        elif self._remaining is not None:
            self._remaining -= len(samples)
        if len(samples):
            self._put(samples, piece.index)
        return used

    def _hold(self, samples: Samples, edges: np.ndarray) -> Samples | None:
        """Hold samples until the reference trigger; then return those from the first pretrigger sample on."""
        assert self._pending is not None
        held, need = sum(map(len, self._pending)), self._plan.pretrigger
        self._pending.append(samples)
        edges = edges[held + edges >= need]
        if not len(edges):
            while len(self._pending) > 1 and held + len(samples) - len(self._pending[0]) >= need:
                held -= len(self._pending.popleft())
            return None
        merged = merge_samples(*self._pending)
        self._pending = None
        return merged.rows(held + int(edges[0]) - need, len(merged))

    def _put(self, samples: Samples, row: int) -> None:
        plan = self._plan
        if self.acquired == 0:
            self._first_row = row
        if plan.newest_only:
            self._buffer.clear()
            samples = samples.rows(len(samples) - 1, len(samples))
        elif self._buffer.rows + len(samples) > plan.max_rows and (plan.keep is None or plan.retrigger):
            return self._fail("samples were not read before the buffer was full; read faster, or make it larger")
        self._buffer.add(replace(samples, index=self.acquired))
        self.acquired += len(samples)
        return None

    def _fail(self, detail: str) -> None:
        self.failure = Code.SAMPLES_NO_LONGER_AVAILABLE, detail
        self._buffer.clear()
