"""Reading and writing of TDMS files, the format of LabVIEW, by npTDMS."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.estimate.spool import blocks, spool
from replays.recordings.formats.exporting import export
from replays.recordings.formats.readers.dialect import is_time, parse_heading
from replays.recordings.formats.source import Entry, FileSignal, Source, load_library, read_error

if TYPE_CHECKING:
    from replays.recordings.formats.exporting.selection import ExportChunk, ExportTable, Selection
    from replays.recordings.formats.mapping import FileOptions

_SENSOR_PROPERTIES = re.compile("sens|bias|gain|coupling|range", re.IGNORECASE)
"""Properties of a channel that describe its sensor or amplifier."""
_MAX_SCALES, _MAX_SUMS = 64, 8
"""Most scales of a channel, and most that add two others: npTDMS computes each of these for each use."""
_PIECE = 1 << 20
"""Rows that are read at a time."""
_RAW_INPUT = 0xFFFFFFFF
"""Input of the first scale: the raw values."""


@contextmanager
def _suppress_output() -> Iterator[None]:
    """Suppress the lines that npTDMS prints for a truncated file, which is reported once as an error."""
    handler = logging.getLogger("nptdms.reader").handlers
    level = [one.level for one in handler]
    for one in handler:
        one.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for one, before in zip(handler, level, strict=True):
            one.setLevel(before)


def look_into(path: Path, options: FileOptions) -> Source:
    """Open a TDMS file and list its signals.

    Raises:
        InputError: The file is not TDMS or is truncated, or npTDMS is missing.
    """
    nptdms = load_library("TDMS", "npTDMS", "nptdms")
    with _suppress_output():
        file = nptdms.TdmsFile.read_metadata(path)
    groups = [(group.name, group.channels()) for group in file.groups()]
    for each in (file, *file.groups(), *(channel for _, channels in groups for channel in channels)):
        kinds = [value for key, value in each.properties.items() if key.endswith("_Scale_Type")]
        count, sums = each.properties.get("NI_Number_Of_Scales", 0), sum(kind in ("Add", "Subtract") for kind in kinds)
        if count > _MAX_SCALES or sums > _MAX_SUMS:
            raise ValueError(f"{count} scales, {sums} of them sums")
    starts = [
        channel.properties["wf_start_time"]
        for _, channels in groups
        for channel in channels
        if len(channel) and "wf_start_time" in channel.properties
    ]
    start = min(starts) if starts else None
    if file.file_status.incomplete_final_segment:
        raise read_error(path, "TDMS", "it is truncated")
    entries, texts, stamps = [], list[str](), dict[str, Any]()
    for number, (name, channels) in enumerate(groups):
        stamps[name] = _time_channel(channels, options)
        for channel in channels:
            if channel is stamps[name]:
                continue
            if not len(channel) or (channel.dtype.kind not in "iuf"):
                texts += [channel.name] * bool(len(channel))
                continue
            unit = str(channel.properties.get("unit_string", channel.properties.get("NI_UnitDescription", "")))
            step = channel.properties.get("wf_increment")
            label = _label(channel.properties)
            rate = 1.0 / step if step else None
            entries.append(Entry(channel.name, name, unit, len(channel), rate, (name, channel.name), label, number))

    def read(entry: Entry) -> FileSignal:
        with nptdms.TdmsFile.open(path) as opened:
            times = stamps[entry.place[0]]
            return _signal(opened[entry.place[0]], entry.place[1], start, options, times and times.name)

    remarks = (f"non-numeric channels left out: {', '.join(texts)}",) if texts else ()
    about = {key: str(value) for key, value in file.properties.items() if isinstance(value, str | int | float)}
    zero = None if start is None or str(start).startswith("1904") else start.astype("datetime64[us]").item()
    return Source(
        path=path, format="TDMS", entries=tuple(entries), read=read, about=about, remarks=remarks,
        start=None if zero is None else zero.replace(tzinfo=UTC),
    )  # fmt: skip


def _label(properties: dict[str, Any]) -> str:
    """Return the description of a channel, and the properties of its sensor and amplifier."""
    texts = [str(properties.get("description", ""))]
    for key, value in properties.items():
        if _SENSOR_PROPERTIES.search(key) and not key.startswith(("rig_", "NI_")) and not key.endswith("_unit"):
            texts.append(f"{key} {value} {properties.get(f'{key}_unit', '')}".strip())
    return "; ".join(filter(None, texts))


def _time_channel(channels: Sequence[Any], options: FileOptions) -> Any:
    """Return the channel with the times of a group: the requested one, else one that is named as a time, or None."""
    if options.time_column is not None:
        return next((each for each in channels if each.name == options.time_column), None)
    rates = [each.properties.get("wf_increment") for each in channels]
    return None if any(rates) else next((each for each in channels if len(each) and is_time(each.name)), None)


def _signal(group: Any, name: str, start: Any, options: FileOptions, times_name: str | None) -> FileSignal:
    channel = group[name]
    properties = channel.properties
    scale, offset = 1.0, 0.0
    linear = (
        properties.get("NI_Number_Of_Scales") == 1
        and properties.get("NI_Scale[0]_Scale_Type") == "Linear"
        and properties.get("NI_Scaling_Status", "unscaled") == "unscaled"
    )
    rows = blocks(len(channel), size=_PIECE)
    if linear and np.dtype(channel.data_type.nptype).kind in "iu":
        values = spool(channel.read_data(each.start, each.stop - each.start, scaled=False) for each in rows)
        scale = float(properties["NI_Scale[0]_Linear_Slope"])
        offset = float(properties["NI_Scale[0]_Linear_Y_Intercept"])
    else:
        parts = (channel.read_data(each.start, each.stop - each.start) for each in rows)
        values = spool(part if part.dtype.kind in "iu" else part.astype(float) for part in parts)
    step = properties.get("wf_increment")
    if step:
        began = properties.get("wf_start_time", start)
        late_s = float((began - start) / np.timedelta64(1, "us")) * 1e-6 if start is not None else 0.0
        first_s = late_s + float(properties.get("wf_start_offset", 0.0))
        return FileSignal(values=values, scale=scale, offset=offset, rate_hz=1.0 / step, first_s=first_s)
    if times_name is None or len(group[times_name]) != len(values):
        return FileSignal(values=values, scale=scale, offset=offset)
    stamps = group[times_name]
    if stamps.dtype.kind == "M":
        times = np.asarray(stamps[:])
        times = (times - (times[0] if start is None else start)) / np.timedelta64(1, "us") * 1e-6
    else:
        unit = str(stamps.properties.get("unit_string", stamps.properties.get("NI_UnitDescription", "")))
        heading, named = parse_heading(times_name)
        _, size_s, zero = options.time_in_s(heading, unit or named, float(stamps.read_data(0, 1)[0]))
        parts = (stamps.read_data(each.start, each.stop - each.start) for each in blocks(len(stamps), size=_PIECE))
        times = spool((part.astype(float) - zero) * size_s for part in parts)
    return FileSignal(values=values, scale=scale, offset=offset, times_s=times)


class TdmsWriter(export.FormatWriter):
    """Writer of TDMS files: one group per sensor group; counts with a linear scale, which LabVIEW applies on reading.

    Events and the rig's documents are properties of the file.
    """

    def __init__(self, path: Path, selection: Selection) -> None:
        nptdms = load_library("TDMS", "npTDMS", "nptdms")
        self._api = nptdms
        self._selection = selection
        self._file = nptdms.TdmsWriter(path)
        self._file.open()
        self._described: set[str] = set()
        self._start = np.datetime64(selection.start.astimezone(UTC).replace(tzinfo=None), "us")

    def write(self, table: ExportTable, chunk: ExportChunk) -> None:
        """Write rows; missing ones are nan, as the format has no times."""
        api, new = self._api, table.name not in self._described
        about = {key: value for key, value in self._selection.metadata.items() if value != ""}
        about |= {"description": self._selection.summary(), **self._selection.documents}
        about["events"] = "\n".join(f"{event.time_s:.6f} s  {event.text}" for event in self._selection.events)
        objects: list[Any] = [api.RootObject(about if not self._described else {})]
        objects.append(api.GroupObject(table.name, {"description": table.title} if new else {}))
        for c, column in enumerate(table.columns):
            # Missing rows must be known before the first write, as counts have no nan.
            counts = column.source is not None and self._selection.is_complete(table)
            values = table.raw(c, chunk) if counts else table.convert_column(c, chunk)
            properties = self._properties(table, c, scaled=counts) if new else {}
            objects.append(api.ChannelObject(table.name, column.name, values, properties))
        self._described.add(table.name)
        self._file.write_segment(objects)

    def _properties(self, table: ExportTable, c: int, *, scaled: bool) -> dict[str, Any]:
        column = table.columns[c]
        first = np.timedelta64(round(table.first_s * 1e6), "us")
        properties: dict[str, Any] = {
            "unit_string": column.unit, "NI_UnitDescription": column.unit, "description": column.label or column.name,
            "wf_increment": 1.0 / table.rate_hz, "wf_start_time": self._start + first, "wf_start_offset": 0.0,
            "wf_xunit_string": "s", "wf_xname": "Time",
        }  # fmt: skip
        properties |= {f"rig_{key}": value for key, value in column.metadata.items() if value != ""}
        if scaled and column.linear is not None:
            properties |= {
                "NI_Scaling_Status": "unscaled", "NI_Number_Of_Scales": np.uint32(1),
                "NI_Scale[0]_Scale_Type": "Linear", "NI_Scale[0]_Linear_Slope": column.linear[0],
                "NI_Scale[0]_Linear_Y_Intercept": column.linear[1],
                "NI_Scale[0]_Linear_Input_Source": np.uint32(_RAW_INPUT),
            }  # fmt: skip
        return properties
