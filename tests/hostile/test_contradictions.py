"""Files with valid checksums that contradict themselves: each contradiction is reported in one line."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from recorder.contents.metadata import Head
from recorder.reader import Recording
from recorder.rewrite import cut, recover
from replays.recordings.parameters import parameter_doubts
from rig.base.wire import EVENTS, STATUS, Block, decode_block, encode_block, encode_document, get_schema
from rig.cli.main import main

from .files import PROBES, SESSIONS, Layout

Spoil = Callable[[Layout], object]
FORCES, STATE = "rig/sensors/forces", "rig/truth/state"


@pytest.fixture(scope="module")
def layout(tmp_path_factory: pytest.TempPathFactory) -> Layout:
    """A session with a status and the metadata of its topics."""
    found = Layout(Recording.open(SESSIONS / "hammer-5.2.mcap"))
    engine = {"name": "split", "levels": {"contact": "compliant"}}
    status = {"tick": 500_000, "time_s": 0.5, "scene": "hammer", "engine": engine}
    found.messages.insert(-1, (STATUS, encode_document(status), 500_000_000))
    return found


def attached(name: str, change: Callable[[dict[str, Any]], object]) -> Spoil:
    def spoil(layout: Layout) -> None:
        document = json.loads(layout.attachments[f"{name}.json"])
        change(document)
        layout.attachments[f"{name}.json"] = json.dumps(document).encode()

    return spoil


def scene(change: Callable[[dict[str, Any]], object]) -> Spoil:
    return attached("scene", lambda document: change(document["scene"]))


def metadata(name: str, **entries: str) -> Spoil:
    return lambda layout: layout.metadata.setdefault(name, {}).update(entries)


def edit_event(name: str, **fields: Any) -> Spoil:
    """Change an event, and its message's time with its tick; without fields, remove it."""

    def spoil(layout: Layout) -> None:
        for at, (topic, payload, time_ns) in enumerate(layout.messages):
            if topic == EVENTS and json.loads(payload)["event"] == name:
                changed = {**json.loads(payload), **fields}
                time_ns = changed["tick"] * 1000 if "tick" in fields else time_ns
                layout.messages[at : at + 1] = [(EVENTS, encode_document(changed), time_ns)] if fields else []
                return

    return spoil


def add_message(topic: str, document: dict[str, Any], time_ns: int = 0) -> Spoil:
    return lambda layout: layout.messages.insert(1, (topic, encode_document(document), time_ns))


def change_block(key: str, change: Callable[[Block, int], tuple[dict[str, Any], int]], *, number: int) -> Spoil:
    """Change fields of one block of a stream, and shift the time of its message [ns]."""

    def spoil(layout: Layout) -> None:
        at = [n for n, (topic, *_) in enumerate(layout.messages) if topic == key][number]
        topic, payload, time_ns = layout.messages[at]
        block = decode_block(payload, get_schema(key) or "")
        fields = {name: getattr(block, name) for name in ("tick", "index", "rate_hz", "tick_rate_hz", "values")}
        changed, later_ns = change(block, time_ns)
        layout.messages[at] = (topic, encode_block(Block(**{**fields, **changed})), time_ns + later_ns)

    return spoil


def append_block(layout: Layout) -> None:
    """Append one block to one group, with continued numbers and times, and adapt the closing counts."""
    at = [n for n, (topic, *_) in enumerate(layout.messages) if topic == PROBES][-1]
    block = decode_block(layout.messages[at][1], get_schema(PROBES) or "")
    again = Block(block.tick + 100_000, block.index + 500, block.rate_hz, block.tick_rate_hz, block.values)
    layout.messages.insert(at + 1, (PROBES, encode_block(again), again.tick * 1000))
    rows = json.loads(layout.metadata["end"]["rows"])
    rows[PROBES] += 500
    layout.metadata["end"] |= {"rows": json.dumps(rows), "last_time_s": "0.699800000"}


def read_readme(layout: Layout) -> bytes:
    """Return README.txt in the words of this version; the text of other versions is not checked."""
    documents = [json.loads(layout.attachments[f"{name}.json"]) for name in ("catalogue", "parameters", "scene")]
    return next(data for name, _, data in Head(*documents).attachments({}) if name == "README.txt")


def together(*spoils: Spoil) -> Spoil:
    return lambda layout: [spoil(layout) for spoil in spoils]


def channel(group: str, **fields: Any) -> Spoil:
    return attached("catalogue", lambda document: document["table"]["groups"][group]["channels"][0].update(fields))


GAP = {"kind": "rows", "key": PROBES, "index": 1000, "size": 7, "time_s": 0.0, "wall_s": 0.0}
MISSED_NOTE = {"kind": "messages", "key": PROBES, "index": -1, "size": 7, "time_s": 0.0, "wall_s": 0.0}
COMMAND = {"event": "command", "tick": 20_000, "id": 1, "command": "hammer", "request": {"force_n": 50.0}}
SPEED = {"event": "command", "tick": 100_000, "id": 1, "command": "speed", "request": {"speed_hz": 5.0}}

CONTRADICTIONS: dict[str, tuple[Spoil, str]] = {
    "scene, metadata": (metadata("rig", scene="drop"), "scene: hammer in scene.json but drop in its metadata"),
    "scene, inside": (scene(lambda s: s.update(name="drop")), "scene: hammer in scene.json but drop in scene.json, "),
    "scene, start": (edit_event("start", scene="drop"), "scene: hammer in scene.json but drop in rig/events"),
    "scene, status": (add_message(STATUS, {"scene": "drop"}), "scene: hammer in scene.json but drop in rig/status"),
    "seed, metadata": (metadata("rig", seed="2"), "seed: 2 in its metadata but 1 in scene.json"),
    "seed, inside": (scene(lambda s: s.update(seed=2)), "seed: 1 in its metadata but 2 in scene.json, its scene"),
    "seed, start": (edit_event("start", seed=2), "seed: 1 in its metadata but 2 in rig/events"),
    "set, metadata": (metadata("rig", parameter_set="dtu-2019"), "parameter set: dtu-2019 in its metadata but correc"),
    "set, scene": (scene(lambda s: s.update(parameters="as-printed")), "parameter set: corrected in its metadata but"),
    "ticks": (metadata("rig", tick_rate_hz="1000"), "tick rate: 1000 in its metadata but 1000000 in catalogue"),
    "parameter, scene": (
        scene(lambda s: s["set"].update({"contact.friction": 0.2})),
        "contact.friction: 0.2 in scene.json but 0.25 in parameters.json",
    ),
    "parameter, its source": (
        attached("parameters", lambda p: p["values"]["shaft.mass"].update(value=1.3, source="scene hammer")),
        "shaft.mass: set by the scene in parameters.json but not in scene.json",
    ),
    "parameter, set": (
        attached("parameters", lambda p: p["values"]["contact.friction"].update(value=0.3)),
        "contact.friction: 0.3 in parameters.json but 0.25 in the set corrected, of the same source",
    ),
    "model": (scene(lambda s: s["model"].update(contact="rigid")), "model.contact: rigid in scene.json but compliant"),
    "engine": (scene(lambda s: s["engine"].update(name="rk8")), "engine.name: rk8 in scene.json but split in rig/stat"),
    "calibration": (channel("probes", sensitivity_v=3.9794), "disk_x: sensitivity_v 3.9794 instead of 3.94"),
    "bandwidth": (channel("forces", bandwidth_hz=1000.0), "P_N: bandwidth_hz 1000.0 instead of"),
    "unit": (channel("forces", unit="kN"), "P_N: unit kN instead of N"),
    "rate": (scene(lambda s: s["sensors"].update(rate_hz=4000)), "rate_hz 5000 instead of 4000"),
    "channel renamed": (channel("probes", name="disk_z"), "disk_z: not in the channel table of its scene"),
    "group not told": (
        scene(lambda s: s["sensors"].update(groups=["probes"])),
        "P_N: not in the channel table of its scene",
    ),
    "group left out": (
        attached("catalogue", lambda c: c["table"]["groups"].pop("hammer")),
        "channels of hammer: none in catalogue.json but hammer",
    ),
    "truth rate": (scene(lambda s: s["sensors"].update(truth_rate_hz=200)), f"rate of {STATE}: 100 in catalogue.json"),
    "text": (
        lambda layout: layout.attachments.update({"README.txt": read_readme(layout) + b"x"}),
        "README.txt differs from catalogue.json",
    ),
    "hammer, scene": (
        scene(lambda s: s["commands"][0]["request"].update(force_n=120.0)),
        "hammer at 0.02 s, force_n: 120 in scene.json but 100 in rig/events",
    ),
    "hammer, time": (
        scene(lambda s: s["commands"][0].update(at_s=0.03)),
        "hammer at 0.02 s in rig/events without a scene entry or a command",
    ),
    "hammer, did not happen": (edit_event("hammer"), "hammer at 0.02 s is requested, but did not happen in rig/events"),
    "command, did not happen": (add_message(EVENTS, SPEED, 10**8), "speed at 0.1 s is requested, but did not happen"),
    "command, twice": (
        together(
            add_message(EVENTS, COMMAND, 20_000_000),
            attached("scene", lambda d: d.update(taken=[{**COMMAND, "request": {"force_n": 60.0}}])),
        ),
        "command 1: request: {'force_n': 60.0} in scene.json, taken but {'force_n': 50.0} in rig/events",
    ),
    "time of an event": (edit_event("hammer", time_s=0.03), f"{EVENTS} with contradictory times: 1"),
    "two starts": (
        add_message(EVENTS, {"event": "start", "tick": 0}),
        "more than one start of the run among the events",
    ),
    "end, metadata": (edit_event("end", reason="stopped"), "end: completed in metadata end but stopped in rig/events"),
    "end, none": (edit_event("end"), "end: completed in metadata end but no end of the run in rig/events"),
    "end, early": (edit_event("end", tick=500_000, time_s=0.5), "end: completed at 0.5 s in rig/events but 0.6 s long"),
    "end, behind": (edit_event("end", tick=500_000, time_s=0.5), f"{PROBES} continues to 0.599800 s, after the end"),
    "duration": (scene(lambda s: s.update(duration_s=0.1)), "rows up to 0.599800 s of a scene that ends at 0.1 s"),
    "published": (
        edit_event("end", rows={PROBES: 2999}),
        f"{PROBES} continues to row 3000, but the rig published 2999",
    ),
    "one group longer": (append_block, f"{PROBES} continues to row 3500, but the rig published 3000"),
    "first row": (metadata("end", first_time_s="0.1"), "first row: at 0.100000 s in metadata end but at 0.000000 s"),
    "last row": (metadata("end", last_time_s="9.9"), "last row: at 9.900000 s in metadata end but at 0.599800 s"),
    "begun and ended": (metadata("end", ended="2020-01-01T00:00:00+00:00"), "ended 2020-01-01T00:00:00+00:00, before"),
    "gaps": (metadata("end", gaps="3"), "gaps: 3 in metadata end but 0 in recorder/gaps"),
    "lost rows": (metadata("end", lost_rows=json.dumps({PROBES: 7})), f"lost rows: {{'{PROBES}': 7}} in metadata end"),
    "missed": (
        add_message("recorder/gaps", MISSED_NOTE),
        "missed messages: {} in metadata end but {'rig/sensors/probes': 7}",
    ),
    "gap that is none": (add_message("recorder/gaps", GAP), f"7 rows of {PROBES} from 1000 on: noted as missing, but"),
    "gap not noted": (
        change_block(PROBES, lambda block, _: ({"values": block.values[:-7]}, 0), number=2),
        f"7 rows of {PROBES} from 1493 on: missing, and no gap is noted",
    ),
    "time of a block": (
        change_block(FORCES, lambda block, _: ({"tick": block.tick + 5000}, 0), number=2),
        f"messages of {FORCES} with contradictory times: 1",
    ),
    "time and row number": (
        change_block(FORCES, lambda block, _: ({"tick": block.tick + 5000}, 5_000_000), number=2),
        f"1 blocks of {FORCES} have a time that does not fit their row number",
    ),
    "cut, from": (metadata("cut", from_s="0.2", to_s="inf"), f"{PROBES} begins at 0.000000 s, before the start"),
    "cut, to": (metadata("cut", from_s="-inf", to_s="0.3"), f"{PROBES} ends at 0.599800 s, after the end of the cut"),
    "cut, channels": (metadata("cut", channels='["disk_x"]'), "disk_y is present, although the cut keeps only disk_x"),
    "cut, only": (metadata("cut", only="truth"), f"{PROBES} is present, although the cut keeps only truth"),
    "series": (
        metadata("series", id="a", number="1", due=json.dumps({PROBES: 100})),
        f"{PROBES} begins with row 0, before row 100 stated by its series",
    ),
}  # fmt: skip


def doubts_of(path: Path) -> tuple[str, ...]:
    recording = Recording.open(path)
    return (*recording.doubts, *parameter_doubts(recording))


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_a_contradiction_in_a_file_is_reported_in_one_line(name: str, layout: Layout, tmp_path: Path) -> None:
    changed = copy.deepcopy(layout)
    spoil, message = CONTRADICTIONS[name]
    spoil(changed)
    found = doubts_of(changed.write(tmp_path / "x.mcap"))
    assert any(line.startswith(message) or message in line for line in found), found


def test_topic_metadata_is_compared_with_the_catalogue(layout: Layout, tmp_path: Path) -> None:
    changed = copy.deepcopy(layout)
    changed.about[PROBES] = {"scales": "[1.0]", "names": '["disk_x", "disk_y", "ring_x", "ring_y"]'}
    found = doubts_of(changed.write(tmp_path / "x.mcap"))
    assert len(found) == 1
    assert found[0].startswith(f"scales of {PROBES}: [")


@pytest.mark.parametrize("name", ["calibration", "parameter, scene", "parameter, set"])
def test_info_and_validate_report_a_contradiction_and_validate_exits_with_1(
    name: str, layout: Layout, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = copy.deepcopy(layout)
    changed.messages = [one for one in changed.messages if one[2] <= 10_000_000 or one[0] == EVENTS]
    spoil, message = CONTRADICTIONS[name]
    spoil(changed)
    path = changed.write(tmp_path / "x.mcap")
    for command, status in (("info", 1), ("validate", 1)):
        with pytest.raises(SystemExit) as end:
            main([command, str(path)])
        assert end.value.code == status
        assert message in capsys.readouterr().out.replace("\n", " ")


@pytest.mark.parametrize("path", [*sorted(SESSIONS.glob("*.mcap")), *sorted(Path("tests/recordings").glob("*.mcap"))])
def test_recordings_of_the_rig_have_no_contradiction(path: Path) -> None:
    assert doubts_of(path) == ()


def test_derived_recordings_have_no_contradiction(layout: Layout, tmp_path: Path) -> None:
    whole = layout.write(tmp_path / "whole.mcap")
    assert doubts_of(whole) == ()
    recording = Recording.open(whole)
    cut(recording, tmp_path / "a.mcap", from_s=0.1, to_s=0.3)
    cut(recording, tmp_path / "b.mcap", channels=("disk_x", "P_E"))
    cut(recording, tmp_path / "c.mcap", from_s=0.01, only="sensors")
    recover(whole, tmp_path / "d.mcap")
    for name in "abcd":
        assert doubts_of(tmp_path / f"{name}.mcap") == (), name
