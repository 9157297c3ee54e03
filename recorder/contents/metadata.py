"""Metadata, attachments and topic calibration written before the first message of a recording."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from recorder.contents.counts import NS
from recorder.contents.views import View
from recorder.files import schemas
from recorder.files.records import COPY
from rig.base.errors import InputError, Words
from rig.base.wire import EDGES, SENSORS, TRUTH, sensor_key, truth_key
from rig.channels.table import ChannelTable, Group

_MAX_COMMANDS = 10_000
"""Largest number of earlier commands that a file repeats; the latest are kept."""


@dataclass(frozen=True)
class Beginning:
    """Additional content at the start of a file that continues or derives from another one.

    Attributes:
        from_start: Whether every stream must begin with row 0, so that rows missing at the start count as a gap.
        due: Number of the first expected row by key, where the file continues another one.
        metadata: Additional metadata records by name; entries under `rig` replace the default ones.
        attachments: Additional attachments by name.
    """

    from_start: bool = False
    due: dict[str, int] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)


class Commands:
    """Scene document with the commands accepted up to now, which makes a later file of a series self-contained."""

    def __init__(self, scene: dict[str, Any]) -> None:
        self._scene = scene
        self._commands = {entry.get("id"): entry for entry in scene.get("taken", [])}

    def follow(self, event: dict[str, Any] | None) -> None:
        """Add a command event to the scene; ignore all others."""
        if event is not None and event.get("event") == "command":
            if len(self._commands) >= _MAX_COMMANDS:
                self._commands.pop(next(iter(self._commands)))
            fields = ("id", "tick", "command", "request")
            self._commands.setdefault(event.get("id"), {name: event.get(name) for name in fields})

    @property
    def scene(self) -> dict[str, Any]:
        """Scene document with all commands up to now."""
        if not self._commands and "taken" not in self._scene:
            return self._scene
        return {**self._scene, "taken": list(self._commands.values())}


class Head:
    """Catalogue, parameter and scene documents, and the metadata and attachments derived from them.

    Attributes:
        table: Channel table of the catalogue.
        tick_rate_hz: Ticks per simulated second [Hz].
        streams: Keys of the streams in the catalogue.
    """

    def __init__(self, catalogue: dict[str, Any], parameters: dict[str, Any], scene: dict[str, Any]) -> None:
        """Read the three documents.

        Raises:
            InputError: The catalogue has no valid channel table or tick rate.
        """
        self._catalogue, self._parameters, self._scene = catalogue, parameters, scene
        try:
            self.table = ChannelTable.model_validate(catalogue["table"])
            self.tick_rate_hz = round(catalogue["tick_rate_hz"])
            if self.tick_rate_hz < 1:
                raise ValueError(f"tick rate {self.tick_rate_hz}")
        except (KeyError, TypeError, ValueError) as error:
            raise InputError("catalogue", "a document with a channel table and a tick rate", Words(error)) from None
        self._truth: dict[str, Any] = catalogue.get("truth", {})
        self.streams = [*map(sensor_key, self.table.groups), *map(truth_key, self._truth)]

    def group(self, key: str) -> Group | None:
        """Return the sensor channel group of a key; None for any other key."""
        return self.table.groups.get(key.removeprefix(SENSORS + "/")) if key.startswith(SENSORS + "/") else None

    def metadata(
        self, more: dict[str, dict[str, str]], *, view_rate_hz: float, wall_ns: int
    ) -> dict[str, dict[str, str]]:
        """Return the metadata records at the start of a file.

        Args:
            more: Additional records by name; entries under `rig` replace the default ones.
            view_rate_hz: Rate of the plot messages [Hz].
            wall_ns: Creation time [unix ns].
        """
        about = {
            "format": schemas.FORMAT,
            "version": schemas.VERSION,
            "created": instant(wall_ns),
            "log_time": "simulated time [ns]",
            "publish_time": "wall time of arrival [unix ns]",
            "tick_rate_hz": str(self.tick_rate_hz),
            "scene": str(self._scene.get("name", "")),
            "seed": str(self._scene.get("seed", "")),
            "parameter_set": str(self._parameters.get("set", "")),
            "view_rate_hz": f"{view_rate_hz:g}",
            **more.get("rig", {}),
        }
        return {**more, "rig": about}

    def attachments(self, metadata: dict[str, dict[str, str]]) -> Iterator[tuple[str, str, bytes]]:
        """Yield name, media type and content of each attachment; one of them repeats the metadata."""
        yield "README.txt", "text/plain", self._readme().encode()
        documents = {
            COPY: metadata,
            "catalogue.json": self._catalogue,
            "parameters.json": self._parameters,
            "scene.json": self._scene,
        }
        for name, document in documents.items():
            yield name, "application/json", json.dumps(document, indent=1, allow_nan=False).encode()

    def has_text(self, text: str) -> bool:
        """Return whether README.txt fits these documents; a text of another version always does."""
        return not text.startswith(_README) or text == self._readme()

    def about(self, key: str) -> dict[str, str]:
        """Return the metadata of a topic: one JSON list per property, in column order."""
        if key == EDGES:
            return {"names": '["edge"]', "units": '["ticks after `tick`"]'}
        group = self.group(key)
        if group is not None:
            return _calibration(group)
        if key.startswith((SENSORS + "/", TRUTH + "/")):
            columns = self._truth.get(key.removeprefix(TRUTH + "/"), {}).get("columns", [])
            return {
                name + "s": json.dumps([column.get(name, "") for column in columns])
                for name in ("name", "unit", "label")
            }
        return {}

    def _readme(self) -> str:
        lines = [_README]
        for group in self.table.groups.values():
            lines.append(f"\n{sensor_key(group.name)}: {group.title}; {group.rate_hz} Hz")
            lines += [
                f"  {channel.name} [{channel.unit}] = counts * {channel.scale:.9g} + {channel.offset:.9g}"
                f"   (volts = counts * {channel.lsb_v:.9g}; {channel.sensitivity_v:g} V per {channel.unit}, "
                f"{channel.bias_v:g} V at 0)   {channel.label}"
                for channel in group.channels
            ]
        for table, about in self._truth.items():
            lines.append(f"\n{truth_key(table)}: {about.get('rate_hz', '?')} Hz")
            lines += [
                f"  {column.get('name', '?')} [{column.get('unit', '?')}]   {column.get('label', '')}"
                for column in about.get("columns", [])
            ]
        lines += [f"\n{name}: {text}" for name, text in self._catalogue.get("reference", {}).items()]
        return "\n".join(lines) + "\n"


def describe_view(view: View, rate_hz: float) -> dict[str, str]:
    """Return the metadata of a topic of plot messages."""
    return {
        "sources": json.dumps([sensor_key(group) for group in view.groups]),
        "rate_hz": f"{rate_hz:g}",
        "filter": "none: every n-th row",
        "names": json.dumps(view.names),
        "arrays": json.dumps(view.slots),
    }


def instant(wall_ns: int) -> str:
    """Return a wall time [unix ns] in ISO 8601."""
    return datetime.fromtimestamp(wall_ns / NS, tz=UTC).isoformat()


def _calibration(group: Group) -> dict[str, str]:
    """Return the channel metadata: one JSON list per property, in column order."""
    channels = group.channels
    lists = {
        "names": [channel.name for channel in channels],
        "units": [channel.unit for channel in channels],
        "scales": [channel.scale for channel in channels],
        "offsets": [channel.offset for channel in channels],
        "volts_per_count": [channel.lsb_v for channel in channels],
        "labels": [channel.label for channel in channels],
    }
    about = {name: json.dumps(values) for name, values in lists.items()}
    return {**about, "rate_hz": str(group.rate_hz), "formula": "value [unit] = counts * scale + offset"}


_README = """\
A recording of the virtual rotor-stator rig.

log_time is simulated time in ns, publish_time the wall time of arrival in unix ns.

rig/sensors/GROUP: rig_msgs/msg/SampleBlock (ROS 2 CDR, its definition is in the file). int32 ADC counts, row after row,
    `columns` values a row, `rate_hz` rows a second; the first is number `index`, at `tick` / `tick_rate_hz` seconds.
    value = counts * scale + offset, from the channel's metadata (JSON lists in column order) or the table below.
rig/sensors/keyphasor_edges: rig_msgs/msg/TruthBlock of one column; edges at (`tick` + value) / `tick_rate_hz` seconds.
rig/truth/TABLE: rig_msgs/msg/TruthBlock, float64 rows of the model's true state; units in the channel's metadata.
rig/events, rig/status: std_msgs/msg/String; `data` is JSON, as the rig published it.
recorder/gaps: likewise, what never arrived: `size` rows from number `index` on, or `size` messages (kind "messages").
    No message there means that nothing was lost.
recorder/clock: likewise, pairs of simulated and wall time.
view/GROUP+GROUP: sensor_msgs/msg/JointState in engineering units at the viewing rate, every n-th row without a filter:
    for plots only. Lengths stand in `position`, forces in `effort`, all else in `velocity`; nan elsewhere.
view/events: rcl_interfaces/msg/Log of rig/events.

Attachments: catalogue.json (channel table with calibration), parameters.json, scene.json; metadata.json repeats the
    metadata at the start, which have no checksum of their own. The whole has one too (`data_section_crc`).
Metadata "rig" opens the file; metadata "end" closes it with the end reason and the counts.
Metadata "series": one of several files in a row; its number, the file before it, and the row due of each stream.
Metadata "trigger": recorded around a trigger only; what ended it stands in "end".
"cut", "recovered": what this file was made of.
A file without "end" was cut off; what stands in it is good.
"""
