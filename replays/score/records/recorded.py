"""Signals of a file that the DAQ under test recorded, in any format; the file need not fit into memory."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from recorder.reader import Recording
from replays.estimate.clock import find_rate
from replays.recordings.formats.mapping import ChannelMapping, FileOptions
from replays.recordings.formats.source import MAX_RATE_HZ, Entry, FileSignal, Source, even_rate_hz, open_source
from replays.score.records.rows import take_rows
from replays.score.records.scale import COUNTS
from rig.base import units
from rig.base.errors import InputError, UnknownNameError
from rig.base.files import open_file
from rig.base.wire import sensor_key
from rig.channels.table import Channel, Group

_PART = 1 << 16
_MAX_EARLY_ROWS = 1 << 18
"""Rows by which signals and their scales are found."""
_MAX_VALUE = 1e30
"""Largest value of a measurement, in any unit."""
_STEP_TOLERANCE = 0.2
"""Relative difference of steps of time stamps that count as equal."""
_REGULAR_PART = 0.9
"""Part of rows that a lower, even rate must explain."""
Pieces = Callable[[Sequence[int]], Iterable[np.ndarray]]


class RecordedTable:
    """Signals of a file with common time stamps.

    Attributes:
        rows: Number of rows.
        stamped: Whether there are time stamps.
    """

    def __init__(self, rows: int, columns: int, pieces: Pieces) -> None:
        """Store a function that yields stamps [s], or nan, and some columns, each shape (n, 1 + k)."""
        self.rows, self._columns, self._pieces = rows, columns, pieces

    def parts(self, columns: Sequence[int]) -> Iterator[np.ndarray]:
        """Yield stamps [s] and columns in parts of equal length, nan for values that no measurement has."""
        held, remaining = list[np.ndarray](), self.rows
        for piece in self._pieces(columns):
            piece, remaining = piece[:remaining], remaining - len(piece[:remaining])
            with np.errstate(invalid="ignore"):
                piece[:, 1:][~(np.abs(piece[:, 1:]) <= _MAX_VALUE)] = np.nan
            held.append(piece)
            if (rows := sum(map(len, held))) >= _PART:
                whole, cut = np.concatenate(held), rows // _PART * _PART
                yield from np.split(whole[:cut], cut // _PART)
                held = [whole[cut:].copy()]
        if held and len(rest := np.concatenate(held)):
            yield rest

    @cached_property
    def early(self) -> np.ndarray:
        """Stamps and all columns of the first rows, shape (n, 1 + columns)."""
        return self.stretch(0, _MAX_EARLY_ROWS)

    def stretch(self, row: int, rows: int) -> np.ndarray:
        """Return stamps and all columns of some rows, as far as there are any, shape (n, 1 + columns)."""
        return take_rows(self.parts(range(self._columns)), row, rows, 1 + self._columns)

    def changed(self, by_column: Mapping[int, tuple[float, float]]) -> RecordedTable:
        """Return a table whose values are size * (value - bias), by the column's size and bias."""

        def pieces(columns: Sequence[int]) -> Iterator[np.ndarray]:
            sizes, biases = np.array([by_column.get(column, (1.0, 0.0)) for column in columns]).reshape(-1, 2).T
            for piece in self._pieces(columns):
                yield np.column_stack([piece[:, :1], sizes * (piece[:, 1:] - biases)])

        return RecordedTable(self.rows, self._columns, pieces)

    def select_rows(self, column: int, step: int, first: int) -> RecordedTable:
        """Return a table of every `step`-th row from a row, or for step 1 of the rows with a value in a column."""

        def pieces(columns: Sequence[int]) -> Iterator[np.ndarray]:
            at = 0
            for part in self.parts([column, *columns]):
                rows = np.arange(at, at + len(part))
                at += len(part)
                yield np.delete(part[rows % step == first if step > 1 else np.isfinite(part[:, 1])], 1, axis=1)

        rows = len(range(first, self.rows, step)) if step > 1 else sum(map(len, pieces([])))
        return RecordedTable(rows, self._columns, pieces)

    @property
    def stamped(self) -> bool:
        """True if there are time stamps."""
        return not np.isnan(self.early[:1, 0]).any()

    @cached_property
    def rate_hz(self) -> float | None:
        """Rate by those steps of the stamps that are equal [Hz]; None if they are a minority.

        None also if the stamps do not ascend on the whole, or faster than a rate can be.
        """
        return find_rate(self.early[:, 0], MAX_RATE_HZ) if self.stamped else None


@dataclass(frozen=True)
class Recorded:
    """A signal that the DAQ under test recorded.

    Attributes:
        name: Name in the file.
        unit: Unit as spelled in the file, or empty.
        table: Table with its values.
        column: Column of the table.
        stated_hz: Rate that the file states [Hz]; None if it does not.
        lost_bits: Lowest bits of the counts that the signal leaves out by definition.
        group: Group of the file.
        timed: Whether its rate is that of the file; if not, it is unknown.
    """

    name: str
    unit: str
    table: RecordedTable
    column: int
    stated_hz: float | None
    lost_bits: int = 0
    group: str = ""
    timed: bool = True

    @property
    def rows(self) -> int:
        """Number of values."""
        return self.table.rows

    @property
    def early(self) -> np.ndarray:
        """First values, shape (n,)."""
        return self.table.early[:, 1 + self.column]

    @property
    def first_s(self) -> float | None:
        """Time stamp of the first value [s], or None."""
        return float(self.table.early[0, 0]) if self.table.stamped and self.rows else None

    @cached_property
    def values(self) -> np.ndarray:
        """All values in the unit of the file, nan for values that no measurement has, shape (rows,)."""
        return np.concatenate([part[:, 1] for part in self.table.parts([self.column])])

    @property
    def rate_hz(self) -> float | None:
        """Rate by the file [Hz]; None if unknown."""
        if not self.timed:
            return None
        stated_hz = self.stated_hz
        return self.table.rate_hz or stated_hz or (even_rate_hz(self.table.early[:, 0]) if self.table.stamped else None)


def open_recorded(path: Path, options: FileOptions | None = None, remarks: list[str] | None = None) -> list[Recorded]:
    """Return the signals of a file, in any format that `rig import` reads, or of a recording.

    Args:
        path: The file. The last row of a text without a line end is left out: its last number may be cut.
        options: How a text file is read.
        remarks: List to which lines about omitted rows are added.

    Raises:
        InputError: The file cannot be read, or has no signals.
    """
    if path.suffix == ".mcap":
        return _open_recording(path)
    source, tables = open_source(path, options or FileOptions()), dict[tuple[str, int], list[Entry]]()
    notes = [] if remarks is None else remarks
    notes += [remark for remark in source.remarks if "is cut" in remark]
    if source.format == "text" and not notes and not _ends_with_line_end(path):
        notes.append("the last line has no line end: its row is omitted, as its last number may be cut")
        source = replace(source, entries=tuple(replace(each, rows=each.rows - 1) for each in source.entries))
    for entry in source.entries:
        tables.setdefault((entry.group, entry.rows), []).append(entry)
    read = {key: RecordedTable(key[1], len(entries), _read_source(source, entries)) for key, entries in tables.items()}
    return [
        Recorded(
            entry.name, units.canonical(entry.unit), read[key := (entry.group, entry.rows)],
            tables[key].index(entry), entry.rate_hz, group=entry.group,
        )
        for entry in source.entries
    ]  # fmt: skip


def map_signals(
    signals: Sequence[Recorded], mapping: Mapping[str, ChannelMapping], channels: Mapping[str, Channel]
) -> list[Recorded]:
    """Return the signals that a mapping names, under the names and in the units of its channels.

    Args:
        signals: Signals of the file.
        mapping: Source, unit, bits, sensitivity, sign, factor and bias by channel; others than channels are omitted.
        channels: Channels of the session.

    Raises:
        InputError: A channel or a source is unknown, or two channels have one source.
    """
    mapped, changes = list[Recorded](), dict[int, dict[int, tuple[float, float]]]()
    for name, wanted in mapping.items():
        where = f"channels.{name}"
        if name not in channels:
            if wanted.to is None:
                raise UnknownNameError(where, "named as a channel of the session", name, channels)
            continue
        channel, group = channels[name], wanted.group
        signal = next((s for s in signals if s.name == wanted.source and group in (None, s.group)), None)
        if signal is None:
            raise UnknownNameError(f"{where}.source", "a signal of the file", wanted.source, [s.name for s in signals])
        if wanted.bias == "mean":
            raise InputError(f"{where}.bias", "a number: `rig score` judges it", wanted.bias)
        unit, size = wanted.unit or signal.unit, wanted.sign * wanted.factor
        if wanted.bits is not None:
            unit, size = "V", size * channel.adc_v / 2.0 ** (wanted.bits - 1)
        elif unit == "FS":
            unit, size = "V", size * channel.adc_v
        if wanted.sensitivity is not None:
            if units.get_quantity(unit) != "voltage":
                raise InputError(f"{where}.unit", "V or mV with a sensitivity", unit)
            per_unit_v = units.sensitivity_v(wanted.sensitivity, channel.unit, field=f"{where}.sensitivity")
            unit, size = channel.unit, size * units.size_si(unit) / per_unit_v
        changed = changes.setdefault(id(signal.table), {})
        if changed.setdefault(signal.column, (size, wanted.bias)) != (size, wanted.bias):
            raise InputError(f"{where}.source", "of one channel only", wanted.source)
        if wanted.unit and unit not in COUNTS:
            unit = units.parse(unit, field=f"{where}.unit", also=COUNTS)
        mapped.append(replace(signal, name=name, unit=unit))
    tables = {id(s.table): s.table.changed(changes[id(s.table)]) for s in mapped}
    return [replace(signal, table=tables[id(signal.table)]) for signal in mapped]


def separate_rates(signals: Sequence[Recorded], rate_hz: float) -> list[Recorded]:
    """Return signals of which those with values at a lower, even rate are in separate tables.

    A text file with several rates has blank cells where a signal has no value.

    Args:
        signals: Signals of a file.
        rate_hz: Row rate of a table that gives none [Hz].
    """
    tables, separated = dict[tuple[int, int, int, bytes], RecordedTable](), list[Recorded]()
    for signal in signals:
        rows, step = np.flatnonzero(np.isfinite(signal.early)), 1
        if len(rows) > 2 and (rows[-1] - rows[0]) >= len(rows):
            step = round(float(np.median(np.diff(rows))))
            first = int(np.bincount(rows % step).argmax())
            steps_s = np.diff(signal.table.early[rows, 0])
            if np.mean(rows % step == first) < _REGULAR_PART or (first and not signal.table.stamped):
                step = 1
            if step > 1 or np.all(np.abs(steps_s - np.median(steps_s)) < _STEP_TOLERANCE * np.median(steps_s)):
                key = id(signal.table), step, first, b"" if step > 1 else rows.tobytes()
                if key not in tables:
                    tables[key] = signal.table.select_rows(signal.column, step, first)
                signal = replace(signal, table=tables[key], stated_hz=(signal.rate_hz or rate_hz) / step)
        separated.append(signal)
    return separated


def _ends_with_line_end(path: Path) -> bool:
    with open_file(path) as file:
        file.seek(-1, 2)
        return file.read(1) in (b"\n", b"\r", b"\0")  # UTF-16 ends with the line end's upper byte


def _read_source(source: Source, entries: Sequence[Entry]) -> Pieces:
    kept: dict[int, list[np.ndarray]] = {}

    def whole(column: int) -> list[np.ndarray]:
        """Return stamps and values of one signal, on disk if there are many."""
        if column not in kept:
            kept[column] = [_spool(each) for each in _stack_columns([source.read(entries[column])]).T]
        return kept[column]

    def pieces(columns: Sequence[int]) -> Iterator[np.ndarray]:
        if source.pieces is not None:
            yield from map(_stack_columns, source.pieces([entries[column] for column in columns]))
            return
        arrays = [whole(columns[0])[0], *(whole(column)[1] for column in columns)]
        for begin in range(0, len(arrays[0]), _PART):
            yield np.column_stack([each[begin : begin + _PART] for each in arrays])

    return pieces


def _stack_columns(signals: Sequence[FileSignal]) -> np.ndarray:
    times_s = signals[0].times_s
    stamps = np.full(len(signals[0].values), np.nan) if times_s is None else times_s
    return np.column_stack([stamps, *(signal.physical for signal in signals)])


def _spool(values: np.ndarray) -> np.ndarray:
    """Return the same values, on disk if there are many."""
    if len(values) <= _MAX_EARLY_ROWS:
        return values
    with tempfile.TemporaryFile() as file:
        np.ascontiguousarray(values).tofile(file)
        return np.memmap(file, values.dtype, "r", shape=values.shape)


def _open_recording(path: Path) -> list[Recorded]:
    recording, signals = Recording.open(path), list[Recorded]()
    for group in recording.table.groups.values():
        stream = recording.streams.get(sensor_key(group.name))
        if stream is not None and stream.rows:
            rate_hz = next(recording.blocks(sensor_key(group.name))).rate_hz
            table = RecordedTable(stream.rows, len(group.channels), _read_recording(recording, group))
            signals += [Recorded(each.name, each.unit, table, n, rate_hz) for n, each in enumerate(group.channels)]
    if not signals:
        raise InputError("FILE", "a recording with samples", str(path))
    return signals


def _read_recording(recording: Recording, group: Group) -> Pieces:
    def pieces(columns: Sequence[int]) -> Iterator[np.ndarray]:
        scales, offsets = np.array([(group.channels[c].scale, group.channels[c].offset) for c in columns]).T
        for block in recording.blocks(sensor_key(group.name)):
            yield np.column_stack([block.times_s, block.values[:, columns] * scales + offsets])

    return pieces
