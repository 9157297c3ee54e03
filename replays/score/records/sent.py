"""Samples that the rig sent, from its session: all rows, every n-th one, or one channel as a signal."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from drivers.daq import Aligner
from drivers.sources.samples import Samples
from recorder.reader import join
from replays.score.records.rows import take_rows
from rig.base.errors import InputError, Words
from rig.base.wire import sensor_key
from rig.channels.generators import VoltageSource
from rig.channels.sampling import TICKS_HZ
from rig.channels.table import Channel
from rig.run.commands.table import TRIGGERS
from rig.run.scenes import Scene, parse_scene

Formula = Callable[[np.ndarray], np.ndarray]

_CHUNK_ROWS = 1 << 16
_SMOOTH = ("sine", "two-tone", "chirp", "multisine", "quiet", "recorded")
"""Test signals that are known between samples; the others jump, at an instant known to a sample only."""
MIN_SIGNAL_NOISES = 4.0
"""Smallest level of a channel's signal, over its noise, at which the signal must be found."""
_BEGIN_SEARCH_S = 30.0
"""Length of a session in which the start of a recording is searched [s]."""


class Session:
    """Samples that the rig sent, and their origin.

    Attributes:
        path, recording: The file, and its content.
        channels: Channels by name.
        groups: Groups that have rows, with the names of their channels.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        """Open a recording.

        Raises:
            InputError: It cannot be read, or has no samples.
        """
        self.recording = join(list(paths))
        self.path = paths[0]
        present = self.recording.streams
        self.groups = {
            name: group.names for name, group in self.recording.table.groups.items() if sensor_key(name) in present
        }
        table = self.recording.table.channels
        self.channels: dict[str, Channel] = {name: table[name] for names in self.groups.values() for name in names}
        if not self.channels:
            raise InputError("--against", "a recording with samples", str(self.path))
        self._kept: dict[str, tuple[np.ndarray, float, float]] = {}
        self._blocks: dict[str, np.ndarray] = {}
        self._stretches: dict[tuple[str, int, int], np.ndarray] = {}
        self._firsts: dict[str, tuple[int, float]] = {}
        self._early: dict[str, np.ndarray] = {}

    def _first(self, group: str) -> tuple[int, float]:
        """Return the number of a group's first row and its rate [Hz], kept for repeated use."""
        if group not in self._firsts:
            block = next(self.recording.blocks(sensor_key(group)))
            self._firsts[group] = int(block.index), block.rate_hz
        return self._firsts[group]

    def rate_hz(self, group: str) -> float:
        """Return the sampling rate of a group [Hz]."""
        return self._first(group)[1]

    @cached_property
    def scene(self) -> Scene | None:
        """Scene of the session; None if unknown."""
        try:
            return parse_scene(self.recording.scene.get("scene") or {})
        except InputError:
            return None

    @property
    def trigger_s(self) -> float | None:
        """Time at which the first command took effect, as a trigger of a DAQ [s], or None."""
        ticks = [event.get("tick") for event in self.recording.events if event.get("event") in TRIGGERS]
        return next((tick / TICKS_HZ for tick in ticks if tick is not None), None)

    @property
    def wall_s(self) -> float | None:
        """Wall time at which the recorder received what was sent at time zero [unix s]; None if unknown."""
        clock = self.recording.clock
        return float(np.median(clock[:, 1] - clock[:, 0])) if len(clock) else None

    def arrived_s(self, groups: Sequence[str], times_s: np.ndarray) -> np.ndarray:
        """Return the arrival times of rows of all of some groups, by their blocks [unix s], shape (n,)."""
        arrivals_s = []
        for group in groups:
            if group not in self._blocks:
                key, of = sensor_key(group), self.recording.everything()
                self._blocks[group] = np.array([(at, wall) for topic, at, wall, _ in of if topic == key]).T * 1e-9
            begins_s, wall_s = self._blocks[group]
            # The rounding of a row's time differs from that of its block's time.
            at = np.searchsorted(begins_s, times_s + 0.5 / self.rate_hz(group), side="right") - 1
            arrivals_s.append(wall_s[np.maximum(at, 0)])
        return np.max(arrivals_s, axis=0)

    @property
    def noisy(self) -> bool:
        """True if the samples have the channels' noise, which is assumed if unknown."""
        return self.scene is None or self.scene.sensors.noise

    def formulas(self) -> dict[str, Formula]:
        """Return the smooth test signals at the converters by channel: functions from times [s] to values [unit]."""
        if self.scene is None or self.scene.generator is None:
            return {}
        made = self.scene.sources()
        return {name: _formula(made[name]) for name in self.channels if made[name].signal.kind in _SMOOTH}

    def place(self, name: str) -> int:
        """Return the column of a channel in its group."""
        return self.groups[self.channels[name].group].index(name)

    def early(self, group: str) -> tuple[int, np.ndarray]:
        """Return the number of the first row of a group, and the counts of its first seconds, shape (n, channels)."""
        if group not in self._early:
            self._early[group] = self.stretch(group, 0, round(_BEGIN_SEARCH_S * self.rate_hz(group)))
        return self._first(group)[0], self._early[group]

    def rows(self, group: str) -> int:
        """Return the number of rows of a group."""
        return self.recording.streams[sensor_key(group)].rows

    def stretch(self, group: str, place: int, rows: int) -> np.ndarray:
        """Return the counts of some rows of a group from a place, as far as there are any, shape (n, channels)."""
        if (group, place, rows) not in self._stretches:
            parts = Sent(self, [group])
            self._stretches = {(group, place, rows): take_rows(parts, place, rows, len(parts.names))}
        return self._stretches[group, place, rows]

    def whole(self, name: str) -> tuple[np.ndarray, float, float]:
        """Return all values of a channel in its unit, the time of the first row [s], and the rate [Hz].

        Raises:
            InputError: Rows are missing.
        """
        group = self.channels[name].group
        if group not in self._kept:
            samples = self.recording.samples(group)
            if len(samples) < 2 or np.any(np.diff(samples.index) != 1):
                raise InputError("--against", "without lost rows on the analogue path", Words(f"{self.path}, {group}"))
            self._kept = {group: (samples.values, float(samples.times_s[0]), samples.rate_hz)}
        values, first_s, rate_hz = self._kept[group]
        return values[:, self.place(name)], first_s, rate_hz

    def is_loud(self, name: str, ends_s: Sequence[float]) -> bool:
        """Return whether a channel's signal is well above its noise between two times of the session [s]."""
        channel, (sent, first_s, rate_hz) = self.channels[name], self.whole(name)
        rows = [round((each - first_s) * rate_hz) for each in (min(ends_s), max(ends_s))] if ends_s else [0, len(sent)]
        part = sent[max(0, rows[0]) : max(0, rows[1])]
        least = MIN_SIGNAL_NOISES * math.hypot(channel.noise_v, channel.lsb_v) / abs(channel.sensitivity_v)
        return len(part) > 1 and float(np.std(part)) > least


def _formula(source: VoltageSource) -> Formula:
    channel = source.channel

    def value(times_s: np.ndarray) -> np.ndarray:
        volts = np.clip(source.volts(times_s), -channel.adc_v, channel.adc_v)
        return (volts - channel.bias_v) / channel.sensitivity_v

    return value


class Sent:
    """Rows that all of some groups of one rate have: counts in chunks, int64, shape (n, channels).

    Attributes:
        names: Channels of the columns.
        rate_hz: Rate of these rows [Hz].
        first_s: Time of the first row, once one has been read [s].
    """

    def __init__(self, session: Session, groups: Sequence[str], step: int = 1, phase: int = 0) -> None:
        """Select the rows of some groups whose number, modulo the step, is the phase."""
        self._session, self._groups, self._step, self._phase = session, groups, step, phase
        self.names = [name for group in groups for name in session.groups[group]]
        self.rate_hz, self.first_s = session.rate_hz(groups[0]) / step, math.nan
        self._starts: list[int] = []
        self._numbers: list[int] = []

    def __iter__(self) -> Iterator[np.ndarray]:
        keys = {sensor_key(group): group for group in self._groups}
        columns = {group: range(len(self._session.groups[group])) for group in self._groups}
        aligner = Aligner(columns, range(len(self.names)), _CHUNK_ROWS)
        rows, due = 0, None
        for key, block in self._session.recording.blocks_of(set(keys)):
            names = self._session.groups[keys[key]]
            units = ("",) * len(names)
            part = Samples(block.index, block.tick, block.rate_hz, block.tick_rate_hz, names, units, block.values)
            for joint in aligner.feed(keys[key], part):
                first = (self._phase - joint.index) % self._step
                number = (joint.index + first) // self._step
                if first >= len(joint):
                    continue
                if due is None:
                    self.first_s = float(joint.times_s[first])
                if number != due:
                    self._starts.append(rows)
                    self._numbers.append(number)
                values = joint.values[first :: self._step]
                rows, due = rows + len(values), number + len(values)
                yield values.astype(np.int64)

    def numbers(self, places: np.ndarray) -> np.ndarray:
        """Return the rig's numbers of rows by their places among these, as far as read, shape (n,)."""
        at = np.searchsorted(self._starts, places, side="right") - 1
        return (np.array(self._numbers)[at] + places - np.array(self._starts)[at]) * self._step + self._phase

    def since_s(self, places: np.ndarray) -> np.ndarray:
        """Return the times of rows after the first one, by their places [s], shape (n,)."""
        first = self.numbers(np.zeros(1, dtype=np.int64))
        return (self.numbers(places) - first) / (self.rate_hz * self._step)
