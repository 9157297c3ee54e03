"""Cross-check of the documents in a recording: values that occur in several places must agree.

Checksums detect damage to the bytes of a file. They do not detect a file that was edited and written again with valid
checksums; such an edit shows only as a contradiction between places that repeat the same value.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from datetime import datetime
from typing import Any

from recorder.contents.metadata import Head
from recorder.contents.recording_file import RecordingFile
from recorder.files import schemas
from recorder.files.payload import get_tick
from rig.base.errors import InputError
from rig.base.text import printable
from rig.base.wire import EDGES, EVENTS, SENSORS, STATUS, TRUTH, Gap
from rig.channels.table import ChannelTable, default_table
from rig.run.commands.channel import MAX_FAULT_S
from rig.run.commands.table import COMMANDS, SERVICE_COMMANDS, check_command

_SCENE, _PARAMETERS, _CATALOGUE, _OWN_TABLE = "scene.json", "parameters.json", "catalogue.json", "the scene's own table"
_CALIBRATION = (
    "signal", "unit", "sensitivity_v", "bias_v", "range_v", "bandwidth_hz", "filter", "filter_order", "ripple_db",
    "group_delay_us", "highpass_hz", "noise_v", "adc_v", "adc_bits",
)  # fmt: skip
"""Channel fields that determine the conversion of a measured quantity to counts."""
_CLOCK_STEP_TOLERANCE_S = 60.0
"""Largest backward step of the wall clock that is not reported [s]; time synchronisation causes smaller ones."""
_MAX_BLOCK_PERIODS = 25
"""Periods of the truth rate in the longest block of a run; a run ends with a complete block."""
_MAX_VALUE_CHARS = 60


class ConsistencyCheck:
    """Values in the documents of one file, each with every place where it occurs.

    Attributes:
        replayed: Whether the recorded session is a replay, whose rows, times and events are those of the replayed file.
    """

    def __init__(self, file: RecordingFile) -> None:
        self._file = file
        self._ticks_hz = float(file.catalogue["tick_rate_hz"])
        self._values: dict[str, dict[str, Any]] = {}
        self._findings: dict[str, None] = {}
        self._events: list[dict[str, Any]] = []
        self._gap_records: list[dict[str, Any]] = []
        self._mistimed: dict[str, int] = {}
        self.replayed = "replayed" in file.scene
        document = file.scene.get("scene")
        self._imported = "import" in file.scene
        self._scene: dict[str, Any] = document if isinstance(document, dict) else {}
        self._add_identity()
        self._check_parameters()
        self._check_calibrations()

    def add_document(self, key: str, time_ns: int, document: dict[str, Any]) -> None:
        """Add a document of the file.

        Args:
            key: Topic of the message.
            time_ns: Simulated time of the message [ns].
            document: Decoded document.
        """
        tick, time_s = get_tick(document), document.get("time_s")
        if tick is not None:
            told_s = time_s if isinstance(time_s, float | int) else tick / self._ticks_hz
            self.check_time(key, time_ns, tick, off_s=abs(tick / self._ticks_hz - told_s))
        if key == EVENTS:
            self._events.append(document)
            self.replayed |= document["event"] == "start" and document.get("pace") == "replay"
        elif key == schemas.GAPS:
            self._gap_records.append(document)
        elif key == STATUS:
            self._state("scene", **{STATUS: document.get("scene")})
            engine = document.get("engine") or {}
            self._state("engine.name", **{STATUS: engine.get("name")})
            for level, value in (engine.get("levels") or {}).items():
                self._state(f"model.{level}", **{STATUS: value})

    def check_time(self, key: str, time_ns: int, tick: int, *, off_s: float = 0.0) -> None:
        """Compare the time of a message with the tick in it.

        Args:
            key: Topic of the message.
            time_ns: Simulated time of the message [ns].
            tick: Tick in the message.
            off_s: Known difference between the tick and another time in the message [s].
        """
        off_s = max(off_s, abs(time_ns / 1e9 - max(tick, 0) / self._ticks_hz))
        self._mistimed[key] = self._mistimed.get(key, 0) + (off_s > 1.5 / self._ticks_hz + 1e-8)

    def find_contradictions(self, streams: Mapping[str, Any], steps: Mapping[str, list[Gap]]) -> list[str]:
        """Return the contradictions in the file, one line each.

        Args:
            streams: Extent of every stream by key.
            steps: Steps of the row numbers by key, of the streams whose payloads can all be read.
        """
        filled = {key: stream for key, stream in streams.items() if stream.rows}
        self._check_end_metadata(filled)
        self._check_gaps(filled, steps)
        self._check_cut(filled)
        if not self._imported and not self.replayed:
            self._check_table()
            self._check_run(filled)
        contradictions = [
            f"{what}: {' but '.join(f'{_format_value(value)} in {where}' for where, value in _distinct_values(places))}"
            for what, places in self._values.items()
            if len(_distinct_values(places)) > 1
        ]
        contradictions += [f"messages of {key} with contradictory times: {n}" for key, n in self._mistimed.items() if n]
        return [*contradictions, *self._findings]

    def _state(self, what: str, **places: Any) -> None:
        """Add the value of a quantity at one or more places; None means that the place does not state it."""
        by_place = self._values.setdefault(what, {})
        for where, value in places.items():
            if value is None:
                continue
            if where in by_place and by_place[where] != value:
                where = f"{where} again"
            by_place.setdefault(where, value)

    def _report(self, text: str) -> None:
        self._findings[text] = None

    # ---- documents before the first message ----

    def _add_identity(self) -> None:
        """Add scene, seed, parameter set and clock from the metadata and from the documents."""
        about, whole, scene = self._file.metadata["rig"], self._file.scene, self._scene
        seeds = {f"{_SCENE}, its scene": scene.get("seed"), _SCENE: whole.get("seed")}
        self._state("scene", **{_SCENE: whole.get("name"), f"{_SCENE}, its scene": scene.get("name")})
        self._state("scene", **{"its metadata": about["scene"]})
        seeds = {where: None if seed is None else str(seed) for where, seed in seeds.items()}
        self._state("seed", **{"its metadata": about["seed"]}, **seeds)
        name = self._file.parameters.get("set", "")
        self._state("parameter set", **{"its metadata": about["parameter_set"], _PARAMETERS: name})
        self._state("parameter set", **{_SCENE: scene.get("parameters")})
        self._state("tick rate", **{"its metadata": _to_float(about.get("tick_rate_hz")), _CATALOGUE: self._ticks_hz})
        self._state("engine.name", **{_SCENE: (scene.get("engine") or {}).get("name")})
        for level, value in (scene.get("model") or {}).items():
            self._state(f"model.{level}", **{_SCENE: value})

    def _check_parameters(self) -> None:
        """Compare the values set by the scene with those of the parameter document, in both directions."""
        changes, values = self._scene.get("set") or {}, self._file.parameters["values"]
        for key, value in changes.items():
            self._state(key, **{_SCENE: value, _PARAMETERS: values.get(key, {}).get("value", "nothing")})
        for key, entry in values.items():
            if self._scene and entry.get("source") == f"scene {self._scene.get('name')}" and key not in changes:
                self._report(f"{key}: set by the scene in {_PARAMETERS} but not in {_SCENE}")

    def _check_calibrations(self) -> None:
        """Compare the calibration in the catalogue with the topic metadata and with README.txt."""
        head = Head(self._file.catalogue, self._file.parameters, self._file.scene)
        for topic, about in self._file.about.items():
            for name, value in head.about(topic).items():
                if name in about and name != "formula":
                    self._state(f"{name} of {topic}", **{_CATALOGUE: value, "its topic": about[name]})
        text = self._file.attachments.get("README.txt", b"").decode(errors="replace")
        if not head.has_text(text):
            self._report("README.txt differs from catalogue.json")

    def _check_table(self) -> None:
        """Compare the catalogue with the channel table of the scene, if both have the same version."""
        sensors = self._scene.get("sensors") or {}
        truth_hz = sensors.get("truth_rate_hz")
        for name, table in self._file.catalogue.get("truth", {}).items():
            self._state(f"rate of {TRUTH}/{name}", **{_CATALOGUE: table["rate_hz"], _SCENE: truth_hz})
        try:
            table = own_table(self._scene)
        except (ValueError, KeyError):
            self._report(f"{_SCENE}: the channel table of its scene cannot be read")
            return
        if table is None or table.version != self._file.table.version:
            return
        for line in calibration_off(self._file.table, table):
            self._report(f"{line} (calibration in {_CATALOGUE}, {_OWN_TABLE})")
        if "cut" in self._file.metadata:
            return
        for name, group in table.groups.items():
            here = self._file.table.groups[name].names if name in self._file.table.groups else ()
            if here != group.names:
                self._state(
                    f"channels of {name}",
                    **{_CATALOGUE: ", ".join(here) or "none", _OWN_TABLE: ", ".join(group.names)},
                )

    # ---- metadata after the last message ----

    def _check_end_metadata(self, streams: Mapping[str, Any]) -> None:
        """Compare the `end` metadata with the rows, the recorded gaps and the end event of the rig."""
        end, metadata = self._file.metadata.get("end", {}), self._file.metadata
        if not self._file.complete or not end:
            return
        clocked = [stream for key, stream in streams.items() if key != EDGES]
        if clocked:
            span_s = min(stream.start_s for stream in streams.values()), max(stream.last_time_s for stream in clocked)
            for which, time_s in zip(("first", "last"), span_s, strict=True):
                stated_s = _to_float(end.get(f"{which}_time_s"))
                if stated_s is not None and abs(stated_s - time_s) > 2e-6:
                    self._report(
                        f"{which} row: at {stated_s:.6f} s in metadata end but at {time_s:.6f} s in the streams"
                    )
        rows = [gap for gap in self._gap_records if gap.get("kind") == "rows"]
        lost: dict[str, int] = {}
        for gap in rows:
            if gap["size"] > 0:
                lost[gap["key"]] = lost.get(gap["key"], 0) + gap["size"]
        self._state("gaps", **{"metadata end": _to_float(end.get("gaps")), schemas.GAPS: float(len(rows))})
        self._state("lost rows", **{"metadata end": _load_json(end.get("lost_rows")), schemas.GAPS: lost})
        missed: dict[str, int] = {}
        for gap in self._gap_records:
            if gap.get("kind") == "messages":
                missed[gap["key"]] = missed.get(gap["key"], 0) + gap["size"]
        self._state("missed messages", **{"metadata end": _load_json(end.get("missed_messages")), schemas.GAPS: missed})
        began, ended = _parse_instant(metadata["rig"].get("created")), _parse_instant(end.get("ended"))
        derived = {"cut", "recovered"} & set(metadata)  # these keep the creation time of the original file
        if not derived and began is not None and ended is not None and ended < began - _CLOCK_STEP_TOLERANCE_S:
            self._report(f"ended {end['ended']}, before its start {metadata['rig']['created']}")
        reasons = [event.get("reason") for event in self._events if event["event"] == "end"]
        if end.get("reason") == "completed":
            self._state("end", **{"metadata end": "completed", EVENTS: reasons[-1] if reasons else "no end of the run"})

    def _check_gaps(self, streams: Mapping[str, Any], steps: Mapping[str, list[Gap]]) -> None:
        """Compare the steps of the row numbers with the recorded gaps."""
        noted = [Gap(gap["key"], gap["index"], gap["size"]) for gap in self._gap_records if gap["index"] >= 0]
        for key, found in steps.items():
            inside = [
                gap
                for gap in noted
                if gap.key == key and key in streams and streams[key].first < gap.index + gap.size < streams[key].due
            ]
            for gap in found:
                if gap not in noted:
                    self._report(f"{gap.size} rows of {key} from {gap.index} on: missing, and no gap is noted")
            for gap in inside:
                if gap not in found and gap.index > streams[key].first:
                    self._report(f"{gap.size} rows of {key} from {gap.index} on: noted as missing, but present")

    def _check_cut(self, streams: Mapping[str, Any]) -> None:
        """Compare the streams with the selection in the metadata of a cut."""
        about = self._file.metadata.get("cut", {})
        low, high = (_to_float(about.get(name)) for name in ("from_s", "to_s"))
        for key, stream in streams.items() if about else ():
            if low is not None and stream.first_time_s < low - 1e-5 * abs(low) - 2e-6:
                self._report(f"{key} begins at {stream.first_time_s:.6f} s, before the start of the cut at {low:g} s")
            if high is not None and stream.last_time_s > high + 1e-5 * abs(high) + 2e-6:
                self._report(f"{key} ends at {stream.last_time_s:.6f} s, after the end of the cut at {high:g} s")
            if (only := {"sensors": SENSORS, "truth": TRUTH}.get(about.get("only", ""))) and not key.startswith(only):
                self._report(f"{key} is present, although the cut keeps only {about['only']}")
        kept = _load_json(about.get("channels"))
        for name in self._file.table.channels if isinstance(kept, list) and kept else ():
            if name not in kept:
                self._report(f"{name} is present, although the cut keeps only {', '.join(map(str, kept))}")
        due = _load_json(self._file.metadata.get("series", {}).get("due"))
        for key, row in due.items() if isinstance(due, dict) else ():
            if key in streams and isinstance(row, int) and streams[key].first < row:
                self._report(f"{key} begins with row {streams[key].first}, before row {row} stated by its series")

    # ---- events ----

    def _check_run(self, streams: Mapping[str, Any]) -> None:
        """Compare the events with the scene, and the rows with both."""
        for name in ("start", "end"):
            if sum(event["event"] == name for event in self._events) > 1:
                self._report(f"more than one {name} of the run among the events")
        last_s = max((stream.last_time_s for key, stream in streams.items() if key != EDGES), default=0.0)
        due_s = _to_float(self._scene.get("duration_s"))
        block_s = _MAX_BLOCK_PERIODS / ((self._scene.get("sensors") or {}).get("truth_rate_hz") or 10.0)
        if due_s is not None and last_s > due_s + block_s:
            self._report(f"rows up to {last_s:.6f} s of a scene that ends at {due_s:g} s")
        for event in self._events:
            if event["event"] == "start":
                self._state("scene", **{EVENTS: event.get("scene")})
                self._state("seed", **{EVENTS: None if event.get("seed") is None else str(event["seed"])})
            elif event["event"] == "end" and isinstance(event.get("tick"), int):
                self._check_end(event, streams, due_s, block_s)
        self._check_effects(streams)

    def _check_end(self, end: dict[str, Any], streams: Mapping[str, Any], due_s: float | None, block_s: float) -> None:
        """Compare the end event with the duration of the scene and with the rows."""
        end_s = end["tick"] / self._ticks_hz
        if due_s is not None and end.get("reason") == "completed" and not -1e-6 <= end_s - due_s <= block_s:
            self._report(f"end: completed at {end_s:g} s in {EVENTS} but {due_s:g} s long in {_SCENE}")
        for key, stream in streams.items():
            if stream.last_time_s > end_s + 1.5e-6:
                self._report(f"{key} continues to {stream.last_time_s:.6f} s, after the end of the run at {end_s:g} s")
            published = (end.get("rows") or {}).get(key)
            if published is not None and stream.due > published:
                self._report(f"{key} continues to row {stream.due}, but the rig published {published}")
        for other in self._events:
            if isinstance(other.get("tick"), int) and other["tick"] > end["tick"]:
                self._report(f"{other['event']} at {other['tick'] / self._ticks_hz:g} s, after the end at {end_s:g} s")

    def _check_effects(self, streams: Mapping[str, Any]) -> None:
        """Check that each command took effect as sent, and that each effect has a command or a scene entry."""
        expected: dict[tuple[str, int], list[tuple[str, Any]]] = {}
        for timed in self._scene.get("commands") or ():
            tick = round(timed["at_s"] * self._ticks_hz)
            expected.setdefault((timed["request"]["command"], tick), []).append((_SCENE, timed["request"]))
        sources = [("scene.json, taken", command) for command in self._file.scene.get("taken", ())]
        sources += [(EVENTS, event) for event in self._events if event["event"] == "command"]
        accepted: dict[Any, dict[str, Any]] = {}
        for source, command in sources:
            about = f"command {command.get('id')}"
            for name in ("command", "tick", "request"):
                self._state(f"{about}: {name}", **{source: command.get(name)})
            accepted.setdefault(command.get("id"), command)
        for number, command in accepted.items():
            expected.setdefault((command["command"], command["tick"]), []).append(("its command", command["request"]))
            if command["command"] in SERVICE_COMMANDS:
                continue
            try:
                check_command(command["command"], command["request"])
            except InputError as error:
                self._report(f"command {number} is not valid: {error}")
        effective = [
            (event["event"], event["tick"], event) for event in self._events if isinstance(event.get("tick"), int)
        ]
        effects = {at[:2]: at[2] for at in effective}
        # A fault with a duration clears itself, even if it began before this file.
        pending = [(*at, request) for at, causes in expected.items() for _, request in causes if at not in effects]
        for name, tick, fields in [*pending, *effective]:
            if (
                name == "fault"
                and isinstance(fields.get("for_s"), float | int)
                and 0.0 < fields["for_s"] <= MAX_FAULT_S
            ):
                end_tick = tick + max(1, round(fields["for_s"] * self._ticks_hz))
                clear = {"id": fields["fault"]} if "fault" in fields else None
                expected.setdefault(("clear", end_tick), []).append(("its end", clear))
        for (name, tick), event in effects.items():
            if name not in COMMANDS or not self._scene:
                continue
            at = f"{name} at {tick / self._ticks_hz:g} s"
            causes = expected.get((name, tick), [])
            if not causes and not self._file.scene.get("forgotten"):
                self._report(f"{at} in {EVENTS} without a scene entry or a command")
            for where, request in causes if len(causes) == 1 and causes[0][1] is not None else ():
                for field, value in _fill_defaults(name, request).items():
                    if (field, value) == ("id", "all"):
                        continue  # the events carry the number of each fault that is cleared
                    self._state(f"{at}, {field}", **{where: value, EVENTS: event.get(field)})
        if not self._events or {"series", "recovered"} & set(self._file.metadata):
            return  # the events of one file of a series may be in the next file, or lost
        even = [stream for key, stream in streams.items() if key != EDGES]
        if any(gap["key"] == EVENTS for gap in self._gap_records) or not even:
            return
        first_s, last_s = max(stream.first_time_s for stream in even), min(stream.last_time_s for stream in even)
        warned = {event["tick"] for event in self._events if event["event"] == "warning"}
        for name, tick in expected:
            inside = first_s < tick / self._ticks_hz < last_s
            if inside and name in COMMANDS and (name, tick) not in effects and tick not in warned:
                self._report(f"{name} at {tick / self._ticks_hz:g} s is requested, but did not happen in {EVENTS}")


def own_table(scene: Mapping[str, Any]) -> ChannelTable | None:
    """Return the channel table of a scene document, limited to its groups and rate; None if it has no sensors.

    The table is the scene's own where it has one, else the rig's default.

    Raises:
        ValueError: The scene's own table is invalid.
        KeyError: The table has none of the groups that the scene selects.
    """
    sensors = scene.get("sensors")
    if not isinstance(sensors, dict):
        return None
    own = scene.get("channels")
    table = default_table() if own is None else ChannelTable.model_validate(own)
    return table.select_groups(tuple(sensors.get("groups") or ()), sensors.get("rate_hz") or None)


def calibration_off(table: ChannelTable, own: ChannelTable) -> list[str]:
    """Return the differences between the channels of a recording and those of its scene's table, one line each."""
    like, differences = own.channels, list[str]()
    for name, channel in table.channels.items():
        if name not in like:
            differences.append(f"{name}: not in the channel table of its scene")
            continue
        off = [
            f"{key} {getattr(channel, key)} instead of {getattr(like[name], key)}"
            for key in (*_CALIBRATION, "rate_hz")
            if getattr(channel, key) != getattr(like[name], key)
        ]
        if off:
            differences.append(f"{name}: {', '.join(off)}")
    return differences


def _fill_defaults(name: str, request: Mapping[str, Any]) -> dict[str, Any]:
    """Return a command with its defaults filled in; empty if this version does not know the command."""
    try:
        fields = {key: value for key, value in request.items() if key != "command"}
        return check_command(name, fields).model_dump(mode="json", exclude={"command"})
    except InputError:
        return {}


def _distinct_values(places: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return each distinct value with the first place where it occurs."""
    distinct: list[tuple[str, Any]] = []
    for where, value in places.items():
        if all(value != other for _, other in distinct):
            distinct.append((where, value))
    return distinct


def _format_value(value: Any) -> str:
    return printable(f"{value:.9g}" if isinstance(value, float) else str(value), _MAX_VALUE_CHARS)


def _to_float(text: Any) -> float | None:
    try:
        value = float(text)
    except (TypeError, ValueError):
        return None
    return value if math.isfinite(value) else None


def _load_json(text: str | None) -> Any:
    """Return the value of JSON text; None if the text is absent or invalid."""
    try:
        return None if text is None else json.loads(text)
    except (ValueError, RecursionError):
        return None


def _parse_instant(text: str | None) -> float | None:
    try:
        return None if text is None else datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError):
        return None
