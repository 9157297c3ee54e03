"""What of a recording is exported: columns in tables of one rate each, read chunk by chunk."""

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
from replays.recordings.formats.exporting.history import ExportEvent, happenings
from replays.recordings.formats.source import DOCUMENTS
from rig.base.errors import InputError, Words
from rig.base.text import nearest, printable
from rig.base.wire import Block, sensor_key, truth_key
from rig.channels.table import Channel

Unit = Literal["engineering", "volts", "counts"]
ROWS = 1 << 14
"""Rows of a chunk."""
NO_VOLTS = "imported in its own unit"
"""Provenance of an imported channel of whose voltage nothing is known."""


@dataclass(frozen=True)
class Column:
    """One column of an export.

    Attributes:
        name: Name of the channel; truth is named `truth.TABLE.COLUMN`.
        unit: Unit of the exported values.
        label: What it is.
        source: Channel of the table, or None for truth.
        linear: Exported value = a * count + b; None for values that are exported as they are (truth, counts).
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
        """Exported value's distance from that of count 0 at the end of the converter's range; 1 for truth."""
        if self.source is None:
            return 1.0
        half = 2.0 ** (self.source.adc_bits - 1)
        return half if self.linear is None else self.linear[0] * half

    @property
    def metadata(self) -> dict[str, str | int | float]:
        """Everything that is known of it."""
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
            }  # fmt: skip
        return about

    def about(self, sensor: str) -> str:
        """What it is, by which sensor, and its calibration, in a line for a person.

        Args:
            sensor: What the group is.
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
    """One stream of a recording, as columns of a table."""

    key: str
    columns: tuple[int, ...]
    """Its columns that are wanted."""
    width: int
    """Columns that it has."""


@dataclass(frozen=True)
class ExportChunk:
    """Consecutive rows of a table.

    Attributes:
        index: Number of the first row in the table, from 0.
        times_s: Simulated time of each row [s], shape (n,).
        values: Counts, or values for truth, float64, nan where a stream has no such row, shape (n, columns).
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
        title: What it is.
        columns: Its columns.
        parts: The streams that they come from.
        rate_hz: Rows per second [Hz].
        first_s: Simulated time of its first row [s].
        rows: Number of rows from the first to the last, missing ones included.
        shift: Number of the stream's row that is its first.
    """

    name: str
    title: str
    columns: tuple[Column, ...]
    parts: tuple[ExportStream, ...]
    rate_hz: float
    first_s: float
    rows: int
    shift: int

    def exported(self, c: int, chunk: ExportChunk) -> np.ndarray:
        """Values of a column in the unit asked for, float64, shape (n,); nan where it has none."""
        linear = self.columns[c].linear
        values = chunk.values[:, c]
        return values.copy() if linear is None else values * linear[0] + linear[1]

    def raw(self, c: int, chunk: ExportChunk) -> np.ndarray:
        """What the recording holds: int32 counts where none is missing, else float64, shape (n,)."""
        values = chunk.values[:, c]
        present = values[chunk.present]
        if self.columns[c].source is not None and not np.isnan(present).any():
            return np.where(chunk.present, values, 0).astype(np.int32)
        return values.copy()


@dataclass(frozen=True)
class Selection:
    """What is exported of a recording.

    Attributes:
        recording: The recording.
        tables: Its tables.
        unit: What the sensors' values are given in.
        from_s, to_s: Ends that were asked for, simulated time [s].
        notes: What was done to the values.
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
        return happenings(self.recording, self.from_s, self.to_s)

    @property
    def documents(self) -> dict[str, str]:
        """The rig's catalogue, parameters and scene, by name; with the scene, all commands that were sent to it."""
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
        """What is known of the whole."""
        told = self.recording.metadata["rig"]
        about = {
            "recording": self.recording.path.name,
            **{name: told[name] for name in ("scene", "seed", "parameter_set")},
        }
        shown = {name: printable(str(text)) for name, text in about.items()}
        return {**shown, "start": self.start.isoformat(), "values": self.unit, **self.notes}

    def summary(self) -> str:
        """The same for a person, line by line."""
        about, scene = self.metadata, self.recording.scene.get("scene") or {}
        title = f" ({printable(str(scene['title']))})" if scene.get("title") else ""
        seed = f", seed {about['seed']}" if about["seed"] else ""
        return "\n".join([
            f"Virtual rotor-stator rig, scene {about['scene']}{title}, parameters {about['parameter_set']}{seed}",
            f"Time 0 is {about['start']}; from the recording {about['recording']}; sensors in {about['values']} values",
            *(f"{name}: {text}" for name, text in self.notes.items()),
        ])  # fmt: skip

    def sidecar(self) -> dict[str, Any]:
        """All metadata as a document, for formats that have no place for it."""
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
        """Rows that a stream of a table lacks, between the table's first and last, by the table's name."""
        return {
            table.name: sum(table.rows - self._held(part.key, table.shift, table.rows) for part in table.parts)
            for table in self.tables
        }

    def _held(self, key: str, first: int, rows: int) -> int:
        """Rows that a stream has out of so many, each counted once: what a table claims to span is not allocated."""
        held, reached = 0, first
        for start, length in sorted((block.index, len(block.values)) for block in self.recording.blocks(key)):
            end = min(start + length, first + rows)
            held += max(0, end - max(start, reached))
            reached = max(reached, end)
        return held

    def whole(self, table: ExportTable) -> bool:
        """Whether every stream of a table has all its rows."""
        return not self.missing[table.name]

    def chunks(self, table: ExportTable, rows: int = ROWS, *, sparse: bool = False) -> Iterator[ExportChunk]:
        """Rows of a table, in order; blocks that came later than a chunk are in it all the same.

        Args:
            table: The table.
            rows: Rows of a chunk.
            sparse: Pass over chunks of which no stream has a row.
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
    """Goes once through the blocks of a stream."""

    def __init__(self, recording: Recording, part: ExportStream, table: ExportTable) -> None:
        self.part = part
        self._shift = table.shift
        self._columns = list(part.columns)
        self._blocks = recording.blocks(part.key)
        self._ahead: list[Block] = []
        self._over = False

    @property
    def next_row(self) -> int:
        """First row that it may still have; beyond the table's end where there is none."""
        return min((block.index - self._shift for block in self._ahead), default=1 << 62)

    def fill(self, start: int, values: np.ndarray) -> np.ndarray:
        """Put rows from `start` on into `values`; gives which were there."""
        end = start + len(values)
        present = np.zeros(len(values), dtype=bool)
        waiting, self._ahead = self._ahead, []
        for block in waiting:
            self._put(block, start, end, values, present)
        while not self._over:
            block = next(self._blocks, None)
            if block is None:
                self._over = True
                break
            self._put(block, start, end, values, present)
            # A recovered block may have been recorded late: look a little further than the chunk.
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
            self._ahead.append(block)


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
    """Choose what of a recording is exported.

    Args:
        recording: The recording.
        channels: Names of channels, of groups, of truth (`truth.TABLE` or `truth.TABLE.COLUMN`); none: all sensors.
        truth: All truth as well.
        unit: What the sensors' values are given in.
        from_s: Start, simulated time [s].
        to_s: End, simulated time [s].
        merged: One table a rate instead of one a group.

    Raises:
        InputError: No such channel, an empty range, or nothing in it.
    """
    if from_s is not None and to_s is not None and not to_s > from_s:
        raise InputError("--to", f"after --from {from_s:g}", to_s)
    wanted = _wanted(recording, channels, truth=truth)
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


def _wanted(recording: Recording, channels: Sequence[str], *, truth: bool) -> dict[str, list[int]]:
    """Keys and numbers of their columns."""
    groups = {name: list(group.names) for name, group in recording.table.groups.items()}
    truths = {
        name: [column["name"] for column in about["columns"]]
        for name, about in recording.catalogue.get("truth", {}).items()
    }
    if not channels:
        found = {sensor_key(name): list(range(len(names))) for name, names in groups.items()}
        if truth:
            found |= {truth_key(name): list(range(len(names))) for name, names in truths.items()}
        return found
    places: dict[str, list[tuple[str, int]]] = {}
    for name, names in groups.items():
        places[name] = [(sensor_key(name), c) for c in range(len(names))]
    for name, names in groups.items():
        # A channel wins over a group of its name (the group `hammer` has the one channel `hammer`).
        places |= {channel: [(sensor_key(name), c)] for c, channel in enumerate(names)}
    for name, names in truths.items():
        places[f"truth.{name}"] = [(truth_key(name), c) for c in range(len(names))]
        places |= {f"truth.{name}.{column}": [(truth_key(name), c)] for c, column in enumerate(names)}
    places["truth"] = [place for name in truths for place in places[f"truth.{name}"]]
    chosen: dict[str, set[int]] = {}
    for channel in [*channels, *(["truth"] if truth else [])]:
        if channel not in places:
            raise InputError("channels", _near(channel, groups, truths), channel)
        for key, c in places[channel]:
            chosen.setdefault(key, set()).add(c)
    order = [*(sensor_key(name) for name in groups), *(truth_key(name) for name in truths)]
    return {key: sorted(chosen[key]) for key in order if key in chosen}


def _near(channel: str, groups: dict[str, list[str]], truths: dict[str, list[str]]) -> str:
    """What a name that is none could have been."""
    prefix, _, rest = channel.partition(".")
    table, _, column = rest.partition(".")
    if prefix == "truth" and table in truths:
        near = nearest(column, truths[table])
        return f"truth.{table}.COLUMN with one of {', '.join(near or truths[table])}"
    if prefix == "truth":
        tables = ", ".join(f"truth.{name}" for name in truths)
        return f"one of {tables}" if truths else "one of the sensors: the recording has no truth"
    sensors = [*(name for group in groups.values() for name in group), *groups]
    near = nearest(channel, sensors)
    if near:
        return f"one of the recording's, such as {', '.join(near)}"
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
    zero_s = block.start_s - block.index / rate  # of the stream's row 0
    low, high = stream.first_time_s, stream.last_time_s
    # A little room for the rounding of times.
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
    """A channel as an exported column."""
    name, label = channel.name, channel.label
    if unit == "volts" and channel.kind == NO_VOLTS:
        raise InputError("unit", f"engineering or counts, as nothing is known of the voltage of {name}", unit)
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
