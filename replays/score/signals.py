"""The two sides of a scorecard: what the rig sent, from its session, and what the DAQ recorded, from any file."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from drivers.daq import Aligner
from drivers.samples import Samples
from recorder.reader import Recording, join
from replays.recordings.formats.mapping import FileOptions
from replays.recordings.formats.source import Entry, Source, even_rate_hz, open_source
from rig import units
from rig.channels import Channel
from rig.errors import InputError, Words
from rig.wire import sensor_key

_PART = 1 << 16
_MOST = 1e30
"""Values that a measurement can have, in any unit."""
_ALIKE = 0.2
"""Part by which steps of time stamps that are alike may differ."""
_EARLY_S = 30.0
"""So much of a session is looked through for where a recording begins [s]."""


class Session:
    """What the rig sent.

    Attributes:
        path, recording: The file, and what is in it.
        channels: Its channels by name.
        groups: Its groups that have rows, with the names of their channels.
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

    def rate_hz(self, group: str) -> float:
        """Rows a second of a group [Hz]."""
        return next(self.recording.blocks(sensor_key(group))).rate_hz

    def early(self, group: str) -> np.ndarray:
        """Counts of the first seconds of a group, shape (n, channels)."""
        most, parts, rows = _EARLY_S * self.rate_hz(group), [], 0
        for part in Sent(self, [group]):
            parts.append(part)
            rows += len(part)
            if rows >= most:
                break
        return np.concatenate(parts)

    def whole(self, name: str) -> tuple[np.ndarray, float, float]:
        """All of one channel in its unit, time of the first row [s], and rate [Hz].

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
        return values[:, self.groups[group].index(name)], first_s, rate_hz


class Sent:
    """Rows of groups of one rate, those that all of them have: counts in chunks, int64, shape (n, channels).

    Attributes:
        first_s: Time of the first row, once there has been one [s].
    """

    def __init__(self, session: Session, groups: Sequence[str]) -> None:
        """Take a session, and which of its groups."""
        self._session, self._groups = session, groups
        self.names = [name for group in groups for name in session.groups[group]]
        self.first_s = math.nan
        self._starts: list[int] = []
        self._numbers: list[int] = []

    def __iter__(self) -> Iterator[np.ndarray]:
        keys = {sensor_key(group): group for group in self._groups}
        columns = {group: range(len(self._session.groups[group])) for group in self._groups}
        aligner = Aligner(columns, range(len(self.names)), _PART)
        rows, due = 0, None
        for key, block in self._session.recording.blocks_of(set(keys)):
            names = self._session.groups[keys[key]]
            units = ("",) * len(names)
            part = Samples(block.index, block.tick, block.rate_hz, block.tick_rate_hz, names, units, block.values)
            for joint in aligner.feed(keys[key], part):
                if due is None:
                    self.first_s = float(joint.times_s[0])
                if joint.index != due:
                    self._starts.append(rows)
                    self._numbers.append(joint.index)
                rows, due = rows + len(joint), joint.index + len(joint)
                yield joint.values.astype(np.int64)

    def numbers(self, places: np.ndarray) -> np.ndarray:
        """The rig's own numbers of rows by their places among these, as far as they were read, shape (n,)."""
        at = np.searchsorted(self._starts, places, side="right") - 1
        return np.array(self._numbers)[at] + places - np.array(self._starts)[at]


@dataclass(frozen=True)
class Recorded:
    """One signal that the DAQ under test recorded.

    Attributes:
        name: Its name in the file.
        unit: As the file spells it; empty where it tells none.
        rows: Number of values.
        rate_hz: As the file tells it [Hz]; None where it does not.
        read: Gives values in that unit, shape (rows,), and their time stamps [s] or None.
        channel: Calibration, where the file is a recording of this project.
    """

    name: str
    unit: str
    rows: int
    rate_hz: float | None
    read: Callable[[], tuple[np.ndarray, np.ndarray | None]]
    channel: Channel | None = None

    @cached_property
    def values(self) -> np.ndarray:
        """Values in its unit, nan where there is none that a measurement can have, shape (rows,)."""
        values = self.read()[0]
        with np.errstate(invalid="ignore"):
            return np.where(np.abs(values) <= _MOST, values, np.nan)

    @cached_property
    def times_s(self) -> np.ndarray | None:
        """Time stamps [s], shape (rows,); None where the file has none."""
        return self.read()[1]


def open_recorded(path: Path, options: FileOptions | None = None) -> list[Recorded]:
    """The signals of a file, in any format that `rig import` reads, or of a recording.

    Raises:
        InputError: It cannot be read, or has no signals.
    """
    if path.suffix == ".mcap":
        return _of_recording(path)
    source = open_source(path, options or FileOptions())
    return [_of_entry(source, entry) for entry in source.entries]


def _of_entry(source: Source, entry: Entry) -> Recorded:
    def read() -> tuple[np.ndarray, np.ndarray | None]:
        signal = source.read(entry)
        return signal.physical, signal.times_s

    return Recorded(entry.name, units.canonical(entry.unit), entry.rows, entry.rate_hz, read)


def _of_recording(path: Path) -> list[Recorded]:
    recording = Recording.open(path)
    found = []
    for key, stream in recording.streams.items():
        for group in recording.table.groups.values():
            if sensor_key(group.name) == key and stream.rows:
                rate_hz = next(recording.blocks(key)).rate_hz
                found += [
                    Recorded(each.name, each.unit, stream.rows, rate_hz, _reading(recording, each), each)
                    for each in group.channels
                ]
    if not found:
        raise InputError("FILE", "a recording with samples", str(path))
    return found


def _reading(recording: Recording, channel: Channel) -> Callable[[], tuple[np.ndarray, np.ndarray | None]]:
    def read() -> tuple[np.ndarray, np.ndarray | None]:
        samples = recording.samples(channel.group).only(channel.name)
        return samples.values[:, 0], samples.times_s

    return read


def rate_of(signal: Recorded) -> float | None:
    """Rate of a signal [Hz]: of those steps of its stamps that are alike, if most are; else as its file tells."""
    if signal.times_s is None or signal.rows < 2:
        return signal.rate_hz
    steps = np.diff(signal.times_s)
    usual = float(np.median(steps))
    alike = steps[np.abs(steps - usual) < _ALIKE * usual]
    if 2 * len(alike) > len(steps):
        return len(alike) / float(alike.sum())
    return signal.rate_hz or even_rate_hz(signal.times_s)


def in_parts(columns: Sequence[np.ndarray]) -> Iterator[tuple[np.ndarray, ...]]:
    """Columns of one length in parts."""
    for begin in range(0, len(columns[0]), _PART):
        yield tuple(column[begin : begin + _PART] for column in columns)
