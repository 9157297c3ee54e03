"""What the DAQ under test recorded: the signals of a file, whatever its format, that need not fit into memory."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from recorder.reader import Recording
from replays.recordings.formats.mapping import FileOptions
from replays.recordings.formats.source import Entry, Source, even_rate_hz, open_source
from rig import units
from rig.channels import Channel
from rig.errors import InputError
from rig.wire import sensor_key

_PART = 1 << 16
_KEPT = 1 << 20
"""Longer signals are kept on the disk."""
_MOST = 1e30
"""Values that a measurement can have, in any unit."""
_ALIKE = 0.2
"""Part by which steps of time stamps that are alike may differ."""


@dataclass(frozen=True)
class Recorded:
    """One signal that the DAQ under test recorded.

    Attributes:
        name: Its name in the file.
        unit: As the file spells it; empty where it tells none.
        rows: Number of values.
        told_hz: Rate as the file tells it [Hz]; None where it does not.
        read: Gives values in that unit, shape (rows,), and their time stamps [s] or None.
        lost_bits: Lowest bits of the counts that it leaves out by its definition.
        like: Another signal of the file that has the same stamps.
    """

    name: str
    unit: str
    rows: int
    told_hz: float | None
    read: Callable[[], tuple[np.ndarray, np.ndarray | None]]
    lost_bits: int = 0
    like: Recorded | None = None

    @cached_property
    def values(self) -> np.ndarray:
        """Values in its unit, nan where there is none that a measurement can have, shape (rows,)."""
        values, times_s = self.read()
        if self.like is None:
            self.__dict__["times_s"] = None if times_s is None else _spooled(times_s)
        del times_s
        for begin in range(0, len(values), _KEPT):
            part = values[begin : begin + _KEPT]
            with np.errstate(invalid="ignore"):
                part[~(np.abs(part) <= _MOST)] = np.nan
        return _spooled(values)

    @cached_property
    def times_s(self) -> np.ndarray | None:
        """Time stamps [s], shape (rows,); None where the file has none."""
        return self.read()[1] if self.like is None else self.like.times_s

    @cached_property
    def rate_hz(self) -> float | None:
        """Rate by its file [Hz]: of those steps of its stamps that are alike, if they are most of it; else as told."""
        if self.like is not None:
            return self.like.rate_hz
        if self.times_s is None or self.rows < 2:
            return self.told_hz
        times_s = self.times_s[:_KEPT]
        steps = np.diff(times_s)
        usual = float(np.median(steps))
        alike = steps[np.abs(steps - usual) < _ALIKE * usual]
        if 2.0 * alike.sum() > times_s[-1] - times_s[0]:
            return len(alike) / float(alike.sum())
        return self.told_hz or even_rate_hz(self.times_s)


def _spooled(values: np.ndarray) -> np.ndarray:
    """The same values, on the disk where there are many."""
    if len(values) <= _KEPT:
        return values
    with tempfile.TemporaryFile() as file:
        values.tofile(file)
        return np.memmap(file, values.dtype, "r", shape=values.shape)


def open_recorded(path: Path, options: FileOptions | None = None) -> list[Recorded]:
    """The signals of a file, in any format that `rig import` reads, or of a recording.

    Raises:
        InputError: It cannot be read, or has no signals.
    """
    if path.suffix == ".mcap":
        return _of_recording(path)
    source, first, found = open_source(path, options or FileOptions()), dict[tuple[str, int], Recorded](), []
    for entry in source.entries:
        like = first.get((entry.group, entry.rows))
        unit = units.canonical(entry.unit)
        found.append(Recorded(entry.name, unit, entry.rows, entry.rate_hz, _reading(source, entry), like=like))
        first.setdefault((entry.group, entry.rows), found[-1])
    return found


def _reading(source: Source, entry: Entry) -> Callable[[], tuple[np.ndarray, np.ndarray | None]]:
    def read() -> tuple[np.ndarray, np.ndarray | None]:
        signal = source.read(entry)
        return signal.physical, signal.times_s

    return read


def _of_recording(path: Path) -> list[Recorded]:
    recording, found = Recording.open(path), list[Recorded]()
    for key, stream in recording.streams.items():
        for group in recording.table.groups.values():
            like = None
            for channel in group.channels if sensor_key(group.name) == key and stream.rows else ():
                rate_hz = next(recording.blocks(key)).rate_hz
                read = _recalling(recording, channel)
                found.append(Recorded(channel.name, channel.unit, stream.rows, rate_hz, read, like=like))
                like = like or found[-1]
    if not found:
        raise InputError("FILE", "a recording with samples", str(path))
    return found


def _recalling(recording: Recording, channel: Channel) -> Callable[[], tuple[np.ndarray, np.ndarray | None]]:
    def read() -> tuple[np.ndarray, np.ndarray | None]:
        samples = recording.samples(channel.group).only(channel.name)
        return samples.values[:, 0], samples.times_s

    return read


def in_parts(columns: Sequence[np.ndarray]) -> Iterator[tuple[np.ndarray, ...]]:
    """Columns of one length in parts."""
    for begin in range(0, len(columns[0]), _PART):
        yield tuple(column[begin : begin + _PART] for column in columns)
