"""Measurements of counters on the pulses of a channel, such as the keyphasor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from nidaqmx.constants import UsageTypeCI

from drivers.daqmx.hardware.device import Terminal
from drivers.sources.samples import Samples
from rig.channels.orbit import find_edges
from rig.channels.table import Channel

_TURNAROUND = 1 << 32
"""Number of values of a counter of 32 bits."""


@dataclass
class Counter:
    """Counter with the edges of one signal.

    Args:
        usage: What it measures.
        channel: Row of the channel table of the signal.
        terminal: Level of the signal.
        rising: Whether rising edges count, or begin a period.
        count: Count at the start, for edges.
        up: Whether edges are added.
    """

    usage: UsageTypeCI
    channel: Channel
    terminal: Terminal
    rising: bool = True
    count: int = 0
    up: bool = True
    _last: Samples | None = None
    _rises: float | None = None
    _falls: float | None = None

    @property
    def clocked(self) -> bool:
        """True if there is a value for each row, and not for each period."""
        return self.usage is UsageTypeCI.COUNT_EDGES

    def feed(self, rows: Samples) -> np.ndarray:
        """Return the values of further rows, shape (values, 1), or (values, 2) for pulses.

        Args:
            rows: Counts of the converter, with the signal in the first column.
        """
        signal, times_s = rows.values[:, 0] * self.channel.scale + self.channel.offset, rows.times_s
        if (last := self._last) is not None:
            signal = np.concatenate([last.values[:, 0] * self.channel.scale + self.channel.offset, signal])
            times_s = np.concatenate([last.times_s, times_s])
        self._last, level = rows.rows(len(rows) - 1, len(rows)), self.terminal.level
        first, other = find_edges(signal, times_s, level), find_edges(-signal, times_s, -level)
        first, other = (first, other) if self.rising else (other, first)
        if self.clocked:
            sign = 1 if self.up else -1
            counts = self.count + sign * np.searchsorted(first, rows.times_s, side="right")
            self.count = (self.count + sign * len(first)) % _TURNAROUND
            return counts[:, None] % _TURNAROUND
        return self._measure(first, other)

    def _measure(self, begins: np.ndarray, others: np.ndarray) -> np.ndarray:
        values = []
        for time_s, begin in sorted([(t, True) for t in begins] + [(t, False) for t in others]):
            if not begin:
                self._falls = time_s
                continue
            if self._rises is not None:
                period_s = time_s - self._rises
                high_s = (time_s if self._falls is None else self._falls) - self._rises
                values.append({
                    UsageTypeCI.FREQUENCY: (1.0 / period_s,),
                    UsageTypeCI.PERIOD: (period_s,),
                    UsageTypeCI.PULSE_FREQ: (1.0 / period_s, high_s / period_s),
                    UsageTypeCI.PULSE_TIME: (high_s, period_s - high_s),
                }[self.usage])  # fmt: skip
            self._rises, self._falls = time_s, None
        width = 2 if self.usage in (UsageTypeCI.PULSE_FREQ, UsageTypeCI.PULSE_TIME) else 1
        return np.array(values, dtype=float).reshape(-1, width)
