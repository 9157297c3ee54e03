"""The documents of a file held against one another: what two of them say of one thing they say alike.

Checksums tell what was changed behind the recorder's back bit by bit. A file that was written anew has good ones, and
only the several places in which it says the same thing tell that one of them was changed.
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
from recorder.files.payload import tick_in
from rig.base.errors import InputError
from rig.base.text import printable
from rig.base.wire import EDGES, EVENTS, SENSORS, STATUS, TRUTH, Gap
from rig.channels.table import ChannelTable, default_table
from rig.run.commands.channel import MAX_FAULT_S
from rig.run.commands.table import COMMANDS, SERVICE_COMMANDS, check_command

_SCENE, _PARAMETERS, _CATALOGUE, _OWN_TABLE = "scene.json", "parameters.json", "catalogue.json", "the scene's own table"
_CALIBRATION = (
    "signal", "unit", "sensitivity_v", "bias_v", "range_v", "bandwidth_hz", "filter_order", "highpass_hz", "noise_v",
    "adc_v", "adc_bits",
)  # fmt: skip
"""Fields of a channel that make counts of what it feels."""
_SET_BACK_S = 60.0
"""A clock that was set by less than this while it recorded is none that is to be doubted."""
_MOST_BLOCK = 25
"""Periods of the truth in the longest block of a run, which ends with a whole one."""
_SHOWN = 60


class Agreement:
    """What the documents of one file say, each thing with all places that say it.

    Attributes:
        replayed: What was recorded is a replay: rows, times and events run as it was played.
    """

    def __init__(self, file: RecordingFile) -> None:
        self._file = file
        self._ticks_hz = float(file.catalogue["tick_rate_hz"])
        self._said: dict[str, dict[str, Any]] = {}
        self._found: dict[str, None] = {}
        self._events: list[dict[str, Any]] = []
        self._noted: list[dict[str, Any]] = []
        self._off_time: dict[str, int] = {}
        self.replayed = "replayed" in file.scene
        document = file.scene.get("scene")
        self._imported = "import" in file.scene
        self._scene: dict[str, Any] = document if isinstance(document, dict) else {}
        self._identity()
        self._parameters()
        self._calibrations()

    def follow(self, key: str, time_ns: int, document: dict[str, Any]) -> None:
        """Take a document of the file, at the time of its message [ns]."""
        tick, time_s = tick_in(document), document.get("time_s")
        if tick is not None:
            told_s = time_s if isinstance(time_s, float | int) else tick / self._ticks_hz
            self.timed(key, time_ns, tick, off_s=abs(tick / self._ticks_hz - told_s))
        if key == EVENTS:
            self._events.append(document)
            self.replayed |= document["event"] == "start" and document.get("pace") == "replay"
        elif key == schemas.GAPS:
            self._noted.append(document)
        elif key == STATUS:
            self._say("scene", **{STATUS: document.get("scene")})
            engine = document.get("engine") or {}
            self._say("engine.name", **{STATUS: engine.get("name")})
            for level, value in (engine.get("levels") or {}).items():
                self._say(f"model.{level}", **{STATUS: value})

    def timed(self, key: str, time_ns: int, tick: int, *, off_s: float = 0.0) -> None:
        """Take the time of a message [ns] that names a tick, and by how much it is off a time in it [s]."""
        off_s = max(off_s, abs(time_ns / 1e9 - max(tick, 0) / self._ticks_hz))
        self._off_time[key] = self._off_time.get(key, 0) + (off_s > 1.5 / self._ticks_hz + 1e-8)

    def doubts(self, streams: Mapping[str, Any], steps: Mapping[str, list[Gap]]) -> list[str]:
        """What does not fit, in a line each.

        Args:
            streams: Extent of every stream by key.
            steps: Steps of the row numbers of every stream of which all payloads can be read.
        """
        filled = {key: one for key, one in streams.items() if one.rows}
        self._closing(filled)
        self._gaps(filled, steps)
        self._cut(filled)
        if not self._imported and not self.replayed:
            self._table()
            self._run(filled)
        found = [
            f"{what}: {' but '.join(f'{_shown(value)} in {where}' for where, value in _different(places))}"
            for what, places in self._said.items()
            if len(_different(places)) > 1
        ]
        found += [f"messages of {key} at another time than they say: {n}" for key, n in self._off_time.items() if n]
        return [*found, *self._found]

    def _say(self, what: str, **places: Any) -> None:
        """Note what is said of something, by place; None says nothing."""
        said = self._said.setdefault(what, {})
        for where, value in places.items():
            if value is None:
                continue
            if where in said and said[where] != value:
                where = f"{where} again"
            said.setdefault(where, value)

    def _doubt(self, text: str) -> None:
        self._found[text] = None

    # ---- what stands before the first message ----

    def _identity(self) -> None:
        """Scene, seed, parameter set and clock, as the metadata repeat them."""
        about, whole, scene = self._file.metadata["rig"], self._file.scene, self._scene
        seeds = {f"{_SCENE}, its scene": scene.get("seed"), _SCENE: whole.get("seed")}
        self._say("scene", **{_SCENE: whole.get("name"), f"{_SCENE}, its scene": scene.get("name")})
        self._say("scene", **{"its metadata": about["scene"]})
        seeds = {where: None if seed is None else str(seed) for where, seed in seeds.items()}
        self._say("seed", **{"its metadata": about["seed"]}, **seeds)
        name = self._file.parameters.get("set", "")
        self._say("parameter set", **{"its metadata": about["parameter_set"], _PARAMETERS: name})
        self._say("parameter set", **{_SCENE: scene.get("parameters")})
        self._say("ticks a second", **{"its metadata": _number(about.get("tick_rate_hz")), _CATALOGUE: self._ticks_hz})
        self._say("engine.name", **{_SCENE: (scene.get("engine") or {}).get("name")})
        for level, value in (scene.get("model") or {}).items():
            self._say(f"model.{level}", **{_SCENE: value})

    def _parameters(self) -> None:
        """What the scene sets, the parameters have, and what they have of the scene, it sets."""
        changes, values = self._scene.get("set") or {}, self._file.parameters["values"]
        for key, value in changes.items():
            self._say(key, **{_SCENE: value, _PARAMETERS: values.get(key, {}).get("value", "nothing")})
        for key, entry in values.items():
            if self._scene and entry.get("source") == f"scene {self._scene.get('name')}" and key not in changes:
                self._doubt(f"{key}: set by the scene in {_PARAMETERS} but not in {_SCENE}")

    def _calibrations(self) -> None:
        """The catalogue, as the topics and the text for people repeat it."""
        head = Head(self._file.catalogue, self._file.parameters, self._file.scene)
        for topic, about in self._file.about.items():
            for name, value in head.about(topic).items():
                if name in about and name != "formula":
                    self._say(f"{name} of {topic}", **{_CATALOGUE: value, "its topic": about[name]})
        text = self._file.attachments.get("README.txt", b"").decode(errors="replace")
        if not head.explained_by(text):
            self._doubt("README.txt says something else than catalogue.json")

    def _table(self) -> None:
        """The catalogue against the table that the scene says, unless it says another version of tables."""
        sensors = self._scene.get("sensors") or {}
        truth_hz = sensors.get("truth_rate_hz")
        for name, table in self._file.catalogue.get("truth", {}).items():
            self._say(f"rate of {TRUTH}/{name}", **{_CATALOGUE: table["rate_hz"], _SCENE: truth_hz})
        try:
            table = own_table(self._scene)
        except (ValueError, KeyError):
            self._doubt(f"{_SCENE}: the channel table of its scene cannot be read")
            return
        if table is None or table.version != self._file.table.version:
            return
        for line in calibration_off(self._file.table, table):
            self._doubt(f"{line} (calibration in {_CATALOGUE}, {_OWN_TABLE})")
        if "cut" in self._file.metadata:
            return
        for name, group in table.groups.items():
            here = self._file.table.groups[name].names if name in self._file.table.groups else ()
            if here != group.names:
                self._say(
                    f"channels of {name}",
                    **{_CATALOGUE: ", ".join(here) or "none", _OWN_TABLE: ", ".join(group.names)},
                )

    # ---- what stands behind the last one ----

    def _closing(self, streams: Mapping[str, Any]) -> None:
        """The closing metadata against the rows, the gaps that were noted, and the rig's own end."""
        end, metadata = self._file.metadata.get("end", {}), self._file.metadata
        if not self._file.complete or not end:
            return
        timed = [one for key, one in streams.items() if key != EDGES]
        if timed:
            here = min(one.start_s for one in streams.values()), max(one.last_time_s for one in timed)
            for which, time_s in zip(("first", "last"), here, strict=True):
                said = _number(end.get(f"{which}_time_s"))
                if said is not None and abs(said - time_s) > 2e-6:
                    self._doubt(f"{which} row: at {said:.6f} s in metadata end but at {time_s:.6f} s in the streams")
        rows = [gap for gap in self._noted if gap.get("kind") == "rows"]
        lost: dict[str, int] = {}
        for gap in rows:
            if gap["size"] > 0:
                lost[gap["key"]] = lost.get(gap["key"], 0) + gap["size"]
        self._say("gaps", **{"metadata end": _number(end.get("gaps")), schemas.GAPS: float(len(rows))})
        self._say("lost rows", **{"metadata end": _document(end.get("lost_rows")), schemas.GAPS: lost})
        missed: dict[str, int] = {}
        for gap in self._noted:
            if gap.get("kind") == "messages":
                missed[gap["key"]] = missed.get(gap["key"], 0) + gap["size"]
        self._say("missed messages", **{"metadata end": _document(end.get("missed_messages")), schemas.GAPS: missed})
        began, ended = _instant(metadata["rig"].get("created")), _instant(end.get("ended"))
        anew = {"cut", "recovered"} & set(metadata)  # which keep when the first file was begun
        if not anew and began is not None and ended is not None and ended < began - _SET_BACK_S:
            self._doubt(f"ended {end['ended']}, before it was begun {metadata['rig']['created']}")
        reasons = [event.get("reason") for event in self._events if event["event"] == "end"]
        if end.get("reason") == "completed":
            self._say("end", **{"metadata end": "completed", EVENTS: reasons[-1] if reasons else "no end of the run"})

    def _gaps(self, streams: Mapping[str, Any], steps: Mapping[str, list[Gap]]) -> None:
        """Steps of the row numbers against the gaps that were noted."""
        noted = [Gap(gap["key"], gap["index"], gap["size"]) for gap in self._noted if gap["index"] >= 0]
        for key, found in steps.items():
            inside = [
                gap
                for gap in noted
                if gap.key == key and key in streams and streams[key].first < gap.index + gap.size < streams[key].due
            ]
            for gap in found:
                if gap not in noted:
                    self._doubt(f"{gap.size} rows of {key} from {gap.index} on: no gap is noted where they are missing")
            for gap in inside:
                if gap not in found and gap.index > streams[key].first:
                    self._doubt(f"{gap.size} rows of {key} from {gap.index} on: noted as missing, and they are there")

    def _cut(self, streams: Mapping[str, Any]) -> None:
        """What a cut kept, as its metadata tell."""
        about = self._file.metadata.get("cut", {})
        low, high = (_number(about.get(name)) for name in ("from_s", "to_s"))
        for key, one in streams.items() if about else ():
            if low is not None and one.first_time_s < low - 1e-5 * abs(low) - 2e-6:
                self._doubt(f"{key} begins at {one.first_time_s:.6f} s, before the cut from {low:g} s on")
            if high is not None and one.last_time_s > high + 1e-5 * abs(high) + 2e-6:
                self._doubt(f"{key} ends at {one.last_time_s:.6f} s, behind the cut up to {high:g} s")
            if (only := {"sensors": SENSORS, "truth": TRUTH}.get(about.get("only", ""))) and not key.startswith(only):
                self._doubt(f"{key} is there, though the cut is of {about['only']} only")
        kept = _document(about.get("channels"))
        for name in self._file.table.channels if isinstance(kept, list) and kept else ():
            if name not in kept:
                self._doubt(f"{name} is there, though the cut is of {', '.join(map(str, kept))} only")
        due = _document(self._file.metadata.get("series", {}).get("due"))
        for key, row in due.items() if isinstance(due, dict) else ():
            if key in streams and isinstance(row, int) and streams[key].first < row:
                self._doubt(f"{key} begins with row {streams[key].first}, before row {row} that its series says is due")

    # ---- what happened ----

    def _run(self, streams: Mapping[str, Any]) -> None:
        """The events against the scene, and the rows against both."""
        for name in ("start", "end"):
            if sum(event["event"] == name for event in self._events) > 1:
                self._doubt(f"more than one {name} of the run among the events")
        last_s = max((one.last_time_s for key, one in streams.items() if key != EDGES), default=0.0)
        due_s = _number(self._scene.get("duration_s"))
        block_s = _MOST_BLOCK / ((self._scene.get("sensors") or {}).get("truth_rate_hz") or 10.0)
        if due_s is not None and last_s > due_s + block_s:
            self._doubt(f"rows up to {last_s:.6f} s of a scene that ends at {due_s:g} s")
        for event in self._events:
            if event["event"] == "start":
                self._say("scene", **{EVENTS: event.get("scene")})
                self._say("seed", **{EVENTS: None if event.get("seed") is None else str(event["seed"])})
            elif event["event"] == "end" and isinstance(event.get("tick"), int):
                self._ended(event, streams, due_s, block_s)
        self._causes(streams)

    def _ended(self, event: dict[str, Any], streams: Mapping[str, Any], due_s: float | None, block_s: float) -> None:
        """The rig's own end against the scene's and against the rows."""
        end_s = event["tick"] / self._ticks_hz
        if due_s is not None and event.get("reason") == "completed" and not -1e-6 <= end_s - due_s <= block_s:
            self._doubt(f"end: completed at {end_s:g} s in {EVENTS} but {due_s:g} s long in {_SCENE}")
        for key, one in streams.items():
            if one.last_time_s > end_s + 1.5e-6:
                self._doubt(f"{key} goes on to {one.last_time_s:.6f} s, behind the end of the run at {end_s:g} s")
            published = (event.get("rows") or {}).get(key)
            if published is not None and one.due > published:
                self._doubt(f"{key} goes on to row {one.due}, of {published} that the rig says it published")
        for other in self._events:
            if isinstance(other.get("tick"), int) and other["tick"] > event["tick"]:
                self._doubt(f"{other['event']} at {other['tick'] / self._ticks_hz:g} s, behind the end at {end_s:g} s")

    def _causes(self, streams: Mapping[str, Any]) -> None:
        """Each command took effect as it was given, and nothing took effect that was not."""
        asked: dict[tuple[str, int], list[tuple[str, Any]]] = {}
        for timed in self._scene.get("commands") or ():
            tick = round(timed["at_s"] * self._ticks_hz)
            asked.setdefault((timed["request"]["command"], tick), []).append((_SCENE, timed["request"]))
        told = [("scene.json, taken", one) for one in self._file.scene.get("taken", ())]
        told += [(EVENTS, event) for event in self._events if event["event"] == "command"]
        given: dict[Any, dict[str, Any]] = {}
        for where, one in told:
            about = f"command {one.get('id')}"
            for name in ("command", "tick", "request"):
                self._say(f"{about}: {name}", **{where: one.get(name)})
            given.setdefault(one.get("id"), one)
        for number, one in given.items():
            asked.setdefault((one["command"], one["tick"]), []).append(("its command", one["request"]))
            if one["command"] in SERVICE_COMMANDS:
                continue
            try:
                check_command(one["command"], one["request"])
            except InputError as error:
                self._doubt(f"command {number}, which no rig takes: {error}")
        met = [(one["event"], one["tick"], one) for one in self._events if isinstance(one.get("tick"), int)]
        effects = {at[:2]: at[2] for at in met}
        # A fault with a time ends by itself, also where it began before this file does.
        begun = [(*at, request) for at, causes in asked.items() for _, request in causes if at not in effects]
        for name, tick, one in [*begun, *met]:
            if name == "fault" and isinstance(one.get("for_s"), float | int) and 0.0 < one["for_s"] <= MAX_FAULT_S:
                over = tick + max(1, round(one["for_s"] * self._ticks_hz))
                known = {"id": one["fault"]} if "fault" in one else None
                asked.setdefault(("clear", over), []).append(("its end", known))
        for (name, tick), event in effects.items():
            if name not in COMMANDS or not self._scene:
                continue
            at = f"{name} at {tick / self._ticks_hz:g} s"
            causes = asked.get((name, tick), [])
            if not causes and not self._file.scene.get("forgotten"):
                self._doubt(f"{at} in {EVENTS} that neither the scene nor a command asks for")
            for where, request in causes if len(causes) == 1 and causes[0][1] is not None else ():
                for field, value in _complete(name, request).items():
                    if (field, value) == ("id", "all"):
                        continue  # each event has the number of one of the faults that end
                    self._say(f"{at}, {field}", **{where: value, EVENTS: event.get(field)})
        if not self._events or {"series", "recovered"} & set(self._file.metadata):
            return  # the events of a part may stand in the next one, or be lost
        even = [one for key, one in streams.items() if key != EDGES]
        if any(gap["key"] == EVENTS for gap in self._noted) or not even:
            return
        first_s, last_s = max(one.first_time_s for one in even), min(one.last_time_s for one in even)
        warned = {event["tick"] for event in self._events if event["event"] == "warning"}
        for name, tick in asked:
            inside = first_s < tick / self._ticks_hz < last_s
            if inside and name in COMMANDS and (name, tick) not in effects and tick not in warned:
                self._doubt(f"{name} at {tick / self._ticks_hz:g} s is asked for, and did not happen in {EVENTS}")


def own_table(scene: Mapping[str, Any]) -> ChannelTable | None:
    """The channel table that a scene document says: its own or the rig's, with its groups and rates; None without one.

    Raises:
        ValueError: Its own is none.
        KeyError: It has none of the groups that are on.
    """
    sensors = scene.get("sensors")
    if not isinstance(sensors, dict):
        return None
    own = scene.get("channels")
    table = default_table() if own is None else ChannelTable.model_validate(own)
    return table.only(tuple(sensors.get("groups") or ()), sensors.get("rate_hz") or None)


def calibration_off(table: ChannelTable, own: ChannelTable) -> list[str]:
    """How the channels of a recording differ from the table of its scene, a line each."""
    like, found = own.channels, list[str]()
    for name, channel in table.channels.items():
        if name not in like:
            found.append(f"{name}: not in the channel table of its scene")
            continue
        off = [
            f"{key} {getattr(channel, key)} instead of {getattr(like[name], key)}"
            for key in (*_CALIBRATION, "rate_hz")
            if getattr(channel, key) != getattr(like[name], key)
        ]
        if off:
            found.append(f"{name}: {', '.join(off)}")
    return found


def _complete(name: str, request: Mapping[str, Any]) -> dict[str, Any]:
    """A command with what it leaves to the defaults; empty where this version does not know it."""
    try:
        fields = {key: value for key, value in request.items() if key != "command"}
        return check_command(name, fields).model_dump(mode="json", exclude={"command"})
    except InputError:
        return {}


def _different(places: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """One place for each value that is said."""
    found: list[tuple[str, Any]] = []
    for where, value in places.items():
        if all(value != other for _, other in found):
            found.append((where, value))
    return found


def _shown(value: Any) -> str:
    return printable(f"{value:.9g}" if isinstance(value, float) else str(value), _SHOWN)


def _number(text: Any) -> float | None:
    try:
        value = float(text)
    except (TypeError, ValueError):
        return None
    return value if math.isfinite(value) else None


def _document(text: str | None) -> Any:
    """What stands in metadata as JSON; None where that is none."""
    try:
        return None if text is None else json.loads(text)
    except (ValueError, RecursionError):
        return None


def _instant(text: str | None) -> float | None:
    try:
        return None if text is None else datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError):
        return None
