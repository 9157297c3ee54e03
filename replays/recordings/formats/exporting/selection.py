"""Selection of exported channels: columns in tables of one rate each, read chunk by chunk."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from typing import Any, Literal

import numpy as np

from recorder.contents.inventory import Stream
from recorder.reader import Recording
from replays.recordings.formats.exporting.history import ExportEvent, list_events
from replays.recordings.formats.source import DOCUMENTS
from rig.base.errors import InputError, Words
from rig.base.text import find_similar, printable
from rig.base.wire import Block, sensor_key, truth_key
from rig.channels.table import Channel

Unit = Literal["engineering", "volts", "counts"]
ROWS = 1 << 14
"""Rows of a chunk."""
NO_VOLTS = "imported in its own unit"
"""Provenance of an imported channel without a known voltage."""


@dataclass(frozen=True)
class Column:
    """Column of an export.

    Attributes:
        name: Name of the channel; truth is named `truth.TABLE.COLUMN`.
        unit: Unit of the exported values.
        label: Description.
        source: Channel of the table, or None for truth.
        linear: Exported value = a * count + b; None for values exported unchanged (truth, counts).
    """

    name: str
    unit: str
    label: str
    source: Channel | None = None
    linear: tuple[float, float] | None = None

    @property
    def heading(self) -> str:
        """Name with unit."""
        return f"{self.name} [{self.unit}]"

    @property
    def full_scale(self) -> float:
        """Exported half range of the converter; 1 for truth."""
        if self.source is None:
            return 1.0
        half = 2.0 ** (self.source.adc_bits - 1)
        return half if self.linear is None else self.linear[0] * half

    @property
    def metadata(self) -> dict[str, str | int | float]:
        """Metadata of the column."""
        about: dict[str, str | int | float] = {"name": self.name, "unit": self.unit, "label": self.label}
        about["full_scale"] = self.full_scale
        about["offset_exported"] = 0.0 if self.linear is None else self.linear[1]
        if self.source is not None:
            channel = self.source
            about |= {
                "group": channel.group, "engineering_unit": channel.unit, "scale": channel.scale,
                "offset": channel.offset, "volts_per_count": channel.lsb_v, "sensitivity_v": channel.sensitivity_v,
                "bias_v": channel.bias_v, "bandwidth_hz": channel.bandwidth_hz, "highpass_hz": channel.highpass_hz,
                "adc_v": channel.adc_v, "adc_bits": channel.adc_bits, "calibration": channel.kind,
            } | channel.shape  # fmt: skip
        return about

    def describe(self, sensor: str) -> str:
        """Return description, sensor and calibration in one line.

        Args:
            sensor: Description of the group.
        """
        texts = [self.label]
        if (channel := self.source) is not None:
            texts += [sensor, f"{channel.adc_bits} bits over +-{channel.adc_v:g} V, to {channel.bandwidth_hz:g} Hz"]
            if channel.kind != NO_VOLTS:
                texts.append(f"{channel.sensitivity_v:g} V per {channel.unit}, {channel.bias_v:g} V at 0")
            texts.append(f"calibration {channel.kind}")
        return "; ".join(text for text in texts if text)


@dataclass(frozen=True)
class ExportStream:
    """Stream of a recording, as columns of a table."""

    key: str
    columns: tuple[int, ...]
    """Selected columns."""
    width: int
    """Number of columns of the stream."""


@dataclass(frozen=True)
class ExportChunk:
    """Consecutive rows of a table.

    Attributes:
        index: Number of the first row in the table, from 0.
        times_s: Simulated time of each row [s], shape (n,).
        values: Counts, or values for truth, float64, nan for rows that a stream lacks, shape (n, columns).
        present: Rows that any of the table's streams has, shape (n,).
    """

    index: int
    times_s: np.ndarray
    values: np.ndarray
    present: np.ndarray


@dataclass(frozen=True)
class ExportTable:
    """Columns at one rate.

    Attributes:
        name: Name of the sensor group, or of the rate.
        title: Description.
        columns: Columns.
        parts: Streams of the columns.
        rate_hz: Rows per second [Hz].
        first_s: Simulated time of the first row [s].
        rows: Number of rows from the first to the last, including missing ones.
        shift: Row number in the stream of the first row.
    """

    name: str
    title: str
    columns: tuple[Column, ...]
    parts: tuple[ExportStream, ...]
    rate_hz: float
    first_s: float
    rows: int
    shift: int

    def convert_column(self, c: int, chunk: ExportChunk) -> np.ndarray:
        """Return a column in the exported unit, float64, shape (n,); nan for missing values."""
        linear = self.columns[c].linear
        values = chunk.values[:, c]
        return values.copy() if linear is None else values * linear[0] + linear[1]

    def raw(self, c: int, chunk: ExportChunk) -> np.ndarray:
        """Return recorded values of a column, shape (n,): int32 counts, or float64 if some are missing."""
        values = chunk.values[:, c]
        present = values[chunk.present]
        if self.columns[c].source is not None and not np.isnan(present).any():
            return np.where(chunk.present, values, 0).astype(np.int32)
        return values.copy()


@dataclass(frozen=True)
class Selection:
    """Selected content of a recording.

    Attributes:
        recording: The recording.
        tables: Tables.
        unit: Unit of the sensors' values.
        from_s, to_s: Requested range, simulated time [s].
        notes: Processing of the values.
    """

    recording: Recording
    tables: tuple[ExportTable, ...]
    unit: Unit
    from_s: float = -math.inf
    to_s: float = math.inf
    notes: dict[str, str] = field(default_factory=dict)

    @cached_property
    def events(self) -> tuple[ExportEvent, ...]:
        """Impacts, commands and notes in the range, in order."""
        return list_events(self.recording, self.from_s, self.to_s)

    @property
    def documents(self) -> dict[str, str]:
        """The rig's catalogue, parameters and scene by name; the scene includes all commands sent to it."""
        texts = {name: self.recording.attachments[name].decode() for name in DOCUMENTS}
        if commands := self.recording.commands:
            texts["scene.json"] = json.dumps({**self.recording.scene, "taken": commands})
        return texts

    @cached_property
    def start(self) -> datetime:
        """Wall time of simulated time 0."""
        pairs = self.recording.clock
        if len(pairs):
            return datetime.fromtimestamp(float(pairs[0, 1] - pairs[0, 0]), tz=UTC)
        return datetime.fromisoformat(self.recording.metadata["rig"]["created"])

    @cached_property
    def metadata(self) -> dict[str, str]:
        """Metadata of the selection."""
        rig = self.recording.metadata["rig"]
        about = {
            "recording": self.recording.path.name,
            **{name: rig[name] for name in ("scene", "seed", "parameter_set")},
        }
        shown = {name: printable(str(text)) for name, text in about.items()}
        return {**shown, "start": self.start.isoformat(), "values": self.unit, **self.notes}

    def summary(self) -> str:
        """Return the metadata as text, line by line."""
        about, scene = self.metadata, self.recording.scene.get("scene") or {}
        title = f" ({printable(str(scene['title']))})" if scene.get("title") else ""
        seed = f", seed {about['seed']}" if about["seed"] else ""
        return "\n".join([
            f"Virtual rotor-stator rig, scene {about['scene']}{title}, parameter set {about['parameter_set']}{seed}",
            f"Time 0 is {about['start']}; from the recording {about['recording']}; sensors in {about['values']} values",
            *(f"{name}: {text}" for name, text in self.notes.items()),
        ])  # fmt: skip

    def sidecar(self) -> dict[str, Any]:
        """Return all metadata as a document, for formats without metadata."""
        tables = [
            {"name": table.name, "rate_hz": table.rate_hz, "first_s": table.first_s, "rows": table.rows,
             "columns": [column.metadata for column in table.columns]}
            for table in self.tables
        ]  # fmt: skip
        documents = {name.removesuffix(".json"): json.loads(text) for name, text in self.documents.items()}
        events = [event.document for event in self.events]
        return {**self.metadata, "tables": tables, "events": events, "documents": documents}

    @cached_property
    def missing(self) -> dict[str, int]:
        """Missing rows between the first and the last row of a table, by its name."""
        return {
            table.name: sum(table.rows - self._count_rows(part.key, table.shift, table.rows) for part in table.parts)
            for table in self.tables
        }

    def _count_rows(self, key: str, first: int, rows: int) -> int:
        """Return the number of distinct rows of a stream in a range, without allocating the range."""
        held, reached = 0, first
        for start, length in sorted((block.index, len(block.values)) for block in self.recording.blocks(key)):
            end = min(start + length, first + rows)
            held += max(0, end - max(start, reached))
            reached = max(reached, end)
        return held

    def is_complete(self, table: ExportTable) -> bool:
        """Return whether every stream of a table has all its rows."""
        return not self.missing[table.name]

    def chunks(self, table: ExportTable, rows: int = ROWS, *, sparse: bool = False) -> Iterator[ExportChunk]:
        """Yield rows of a table in order, including those of late blocks.

        Args:
            table: The table.
            rows: Rows per chunk.
            sparse: Skip chunks for which no stream has a row.
        """
        cursors = [_Cursor(self.recording, part, table) for part in table.parts]
        start = 0
        while start < table.rows:
            n = min(rows, table.rows - start)
            values = np.full((n, len(table.columns)), np.nan)
            present = np.zeros(n, dtype=bool)
            first = 0
            for cursor in cursors:
                width = len(cursor.part.columns)
                present |= cursor.fill(start, values[:, first : first + width])
                first += width
            times_s = table.first_s + np.arange(start, start + n) / table.rate_hz
            yield ExportChunk(index=start, times_s=times_s, values=values, present=present)
            start += n
            if sparse:
                start = max(start, min((cursor.next_row for cursor in cursors), default=start))


class _Cursor:
    """Single pass over the blocks of a stream."""

    def __init__(self, recording: Recording, part: ExportStream, table: ExportTable) -> None:
        self.part = part
        self._shift = table.shift
        self._columns = list(part.columns)
        self._blocks = recording.blocks(part.key)
        self._pending: list[Block] = []
        self._finished = False

    @property
    def next_row(self) -> int:
        """First row that may still come; beyond the table's end if all have come."""
        return min((block.index - self._shift for block in self._pending), default=1 << 62)

    def fill(self, start: int, values: np.ndarray) -> np.ndarray:
        """Copy the rows from `start` on into `values`; return which rows were present."""
        end = start + len(values)
        present = np.zeros(len(values), dtype=bool)
        waiting, self._pending = self._pending, []
        for block in waiting:
            self._put(block, start, end, values, present)
        while not self._finished:
            block = next(self._blocks, None)
            if block is None:
                self._finished = True
                break
            self._put(block, start, end, values, present)
            # A recovered block may have been recorded late: read slightly beyond the chunk.
            if block.index - self._shift >= end + ROWS // 4:
                break
        return present

    def _put(self, block: Block, start: int, end: int, values: np.ndarray, present: np.ndarray) -> None:
        first = block.index - self._shift
        low, high = max(first, start), min(first + len(block.values), end)
        if low < high:
            values[low - start : high - start] = block.values[low - first : high - first][:, self._columns]
            present[low - start : high - start] = True
        if first + len(block.values) > end:
            self._pending.append(block)


def select(
    recording: Recording,
    *,
    channels: Sequence[str] = (),
    truth: bool = False,
    unit: Unit = "engineering",
    from_s: float | None = None,
    to_s: float | None = None,
    merged: bool = False,
) -> Selection:
    """Select the content of an export.

    Args:
        recording: The recording.
        channels: Names of channels, of groups, or of truth (`truth.TABLE` or `truth.TABLE.COLUMN`); empty: all sensors.
        truth: Add all truth.
        unit: Unit of the sensors' values.
        from_s: Start, simulated time [s].
        to_s: End, simulated time [s].
        merged: Make one table per rate instead of one per group.

    Raises:
        InputError: An unknown channel, or a range that is empty or has no samples.
    """
    if from_s is not None and to_s is not None and not to_s > from_s:
        raise InputError("--to", f"after --from {from_s:g}", to_s)
    wanted = _selected_columns(recording, channels, truth=truth)
    streams = recording.streams
    tables: dict[tuple[str, float, int], list[ExportTable]] = {}
    for key, numbers in wanted.items():
        stream = streams.get(key)
        if stream is None or stream.rows == 0:
            if channels and any(key.endswith(name.removeprefix("truth.")) for name in channels):
                raise InputError("channels", "one with samples in the recording", key)
            continue
        table = _table(recording, key, numbers, stream, unit, from_s, to_s)
        if table is not None:
            offset = round((table.first_s - table.shift / table.rate_hz) * 1e9)
            tables.setdefault(("" if merged else key, table.rate_hz, offset), []).append(table)
    if not tables:
        held = [s for s in streams.values() if s.rows]
        if not held:
            raise InputError("file", "a recording with samples", str(recording.path))
        low, high = min(s.first_time_s for s in held), max(s.last_time_s for s in held)
        ends = [f"{word} {end:g} s" for word, end in (("from", from_s), ("to", to_s)) if end is not None]
        raise InputError("range", f"in the recording, {low:g} to {high:g} s", " ".join(ends) or Words("all of it"))
    return Selection(
        recording=recording, tables=tuple(_merge(alike) for alike in tables.values()), unit=unit,
        from_s=-math.inf if from_s is None else from_s, to_s=math.inf if to_s is None else to_s,
    )  # fmt: skip


def _selected_columns(recording: Recording, channels: Sequence[str], *, truth: bool) -> dict[str, list[int]]:
    """Return the selected column numbers by key."""
    groups = {name: list(group.names) for name, group in recording.table.groups.items()}
    truths = {
        name: [column["name"] for column in about["columns"]]
        for name, about in recording.catalogue.get("truth", {}).items()
    }
    if not channels:
        columns = {sensor_key(name): list(range(len(names))) for name, names in groups.items()}
        if truth:
            columns |= {truth_key(name): list(range(len(names))) for name, names in truths.items()}
        return columns
    places: dict[str, list[tuple[str, int]]] = {}
    for name, names in groups.items():
        places[name] = [(sensor_key(name), c) for c in range(len(names))]
    for name, names in groups.items():
        # A channel takes precedence over a group of the same name (the group `hammer` has one channel `hammer`).
        places |= {channel: [(sensor_key(name), c)] for c, channel in enumerate(names)}
    for name, names in truths.items():
        places[f"truth.{name}"] = [(truth_key(name), c) for c in range(len(names))]
        places |= {f"truth.{name}.{column}": [(truth_key(name), c)] for c, column in enumerate(names)}
    places["truth"] = [place for name in truths for place in places[f"truth.{name}"]]
    chosen: dict[str, set[int]] = {}
    for channel in [*channels, *(["truth"] if truth else [])]:
        if channel not in places:
            raise InputError("channels", _suggest(channel, groups, truths), channel)
        for key, c in places[channel]:
            chosen.setdefault(key, set()).add(c)
    order = [*(sensor_key(name) for name in groups), *(truth_key(name) for name in truths)]
    return {key: sorted(chosen[key]) for key in order if key in chosen}


def _suggest(channel: str, groups: dict[str, list[str]], truths: dict[str, list[str]]) -> str:
    """Return the names that an unknown name may have meant, for an error."""
    prefix, _, rest = channel.partition(".")
    table, _, column = rest.partition(".")
    if prefix == "truth" and table in truths:
        near = find_similar(column, truths[table])
        return f"truth.{table}.COLUMN with one of {', '.join(near or truths[table])}"
    if prefix == "truth":
        tables = ", ".join(f"truth.{name}" for name in truths)
        return f"one of {tables}" if truths else "one of the sensors: the recording has no truth"
    sensors = [*(name for group in groups.values() for name in group), *groups]
    near = find_similar(channel, sensors)
    if near:
        return f"a channel of the recording, such as {', '.join(near)}"
    return f"a channel of the recording, one of its groups ({', '.join(groups)}) or truth.TABLE"


def _table(
    recording: Recording,
    key: str,
    numbers: list[int],
    stream: Stream,
    unit: Unit,
    from_s: float | None,
    to_s: float | None,
) -> ExportTable | None:
    block = next(block for block in recording.blocks(key) if len(block.values))
    rate = block.rate_hz
    zero_s = block.start_s - block.index / rate  # time of the stream's row 0
    low, high = stream.first_time_s, stream.last_time_s
    # Tolerance for the rounding of times.
    first = math.ceil((max(low, -math.inf if from_s is None else from_s) - zero_s) * rate - 1e-6)
    last = math.floor((min(high, math.inf if to_s is None else to_s) - zero_s) * rate + 1e-6)
    if last < first:
        return None
    name = key.rsplit("/", 1)[-1]
    if key == sensor_key(name):
        group = recording.table.groups[name]
        columns = tuple(sensor_column(group.channels[c], unit) for c in numbers)
        title, width = group.title, len(group.channels)
    else:
        about = recording.catalogue["truth"][name]["columns"]
        columns = tuple(
            Column(name=f"truth.{name}.{about[c]['name']}", unit=about[c]["unit"], label=about[c].get("label", ""))
            for c in numbers
        )
        name, title, width = f"truth.{name}", f"True state of the model: {name}", len(about)
    part = ExportStream(key=key, columns=tuple(numbers), width=width)
    return ExportTable(
        name=name, title=title, columns=columns, parts=(part,), rate_hz=rate, first_s=zero_s + first / rate,
        rows=last - first + 1, shift=first,
    )  # fmt: skip


def sensor_column(channel: Channel, unit: Unit) -> Column:
    """Return a channel as an exported column."""
    name, label = channel.name, channel.label
    if unit == "volts" and channel.kind == NO_VOLTS:
        raise InputError("unit", f"engineering or counts, as the voltage of {name} is unknown", unit)
    if unit == "counts":
        return Column(name=name, unit="counts", label=label, source=channel)
    linear = (channel.lsb_v, 0.0) if unit == "volts" else (channel.scale, channel.offset)
    return Column(name=name, unit="V" if unit == "volts" else channel.unit, label=label, source=channel, linear=linear)


def _merge(tables: list[ExportTable]) -> ExportTable:
    if len(tables) == 1:
        return tables[0]
    first = min(table.shift for table in tables)
    last = max(table.shift + table.rows for table in tables)
    start = min(tables, key=lambda table: table.shift)
    return ExportTable(
        name="+".join(table.name for table in tables), title="; ".join(table.title for table in tables),
        columns=tuple(column for table in tables for column in table.columns),
        parts=tuple(part for table in tables for part in table.parts),
        rate_hz=start.rate_hz, first_s=start.first_s, rows=last - first, shift=first,
    )  # fmt: skip
