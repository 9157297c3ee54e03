"""Recording around triggers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.reader import Recording
from recorder.trigger import Capture, Captures, Trigger
from recorder.writer import RecordingWriter
from rig.channels import default_table
from rig.errors import InputError
from rig.wire import CATALOGUE, EVENTS, PARAMETERS, SCENE, Block, encode_block, encode_document, sensor_key

from .recorder_stream import TICK_RATE_HZ, block_of, documents

PROBES, FORCES = sensor_key("probes"), sensor_key("forces")


def captures(path: Path, *triggers: str, force: bool = False, **options: Any) -> Captures:
    about = documents()

    def open_writer(name: Path, *, from_start: bool, **more: Any) -> RecordingWriter:
        return RecordingWriter(
            name, catalogue=about[CATALOGUE], parameters=about[PARAMETERS], view_rate_hz=0.0, force=force, **more
        )

    return Captures(
        path,
        Capture(tuple(Trigger.parse(text) for text in triggers), **options),
        table=default_table(),
        tick_rate_hz=TICK_RATE_HZ,
        scene=about[SCENE],
        open_writer=open_writer,
        force=force,
    )


def event(name: str, time_s: float, **fields: Any) -> tuple[str, bytes]:
    return EVENTS, encode_document({"event": name, "tick": round(time_s * 1e6), "time_s": time_s, **fields})


def feed(file: Captures, blocks: range, events: dict[int, list[tuple[str, bytes]]] | None = None) -> None:
    """Blocks of 10 ms of probes and forces; events behind the block that they are in, as the rig sends them."""
    for number in blocks:
        for key in (PROBES, FORCES):
            file.write(key, encode_block(block_of(key, number)), number)
        for item in (events or {}).get(number, []):
            file.write(*item, number)


def extent(path: Path, key: str = PROBES) -> tuple[float, float]:
    stream = Recording.open(path).streams[key]
    return stream.first_time_s, stream.last_time_s


def test_a_blow_is_captured_with_the_time_before_and_after_it(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.2, post_s=0.5)
    feed(file, range(300), {100: [event("hammer", 1.0)]})
    file.finish("completed")
    (path,) = file.files
    assert path.name == "run.hammer-001.mcap"
    recording = Recording.open(path)
    assert recording.complete
    assert recording.end_reason == "captured"
    for key in (PROBES, FORCES):
        # Whole blocks: the one that holds 0.8 s, and the one that holds 1.5 s.
        assert extent(path, key) == (pytest.approx(0.8, abs=0.01), pytest.approx(1.51 - 50e-6))
        payloads = [payload for _, payload in recording.payloads(key)]
        first = round(recording.streams[key].first_time_s * 100)
        assert payloads == [encode_block(block_of(key, number)) for number in range(first, 151)]
    assert [found["event"] for found in recording.events] == ["hammer"]
    assert recording.metadata["trigger"]["time_s"] == "1.000000000"
    assert file.counts().rows[PROBES] == 60_000


def test_without_a_trigger_there_is_no_file(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer")
    feed(file, range(100), {50: [event("speed", 0.5)]})
    file.finish("completed")
    assert file.files == list(tmp_path.iterdir()) == []


def _level_block(number: int, values: np.ndarray) -> tuple[str, bytes]:
    """Forces with P_E [N] as given and the others at zero."""
    group = default_table().groups["forces"]
    counts = np.zeros((200, 4), dtype=np.int32)
    counts[:, group.names.index("P_E")] = np.rint(values / group.channels[2].scale)
    return FORCES, encode_block(Block(number * 10_000, number * 200, 20_000.0, TICK_RATE_HZ, counts))


@pytest.mark.parametrize(
    ("trigger", "sign"), [("P_E>500", 1.0), ("P_E<-500", -1.0), ("|P_E| > 500", 1.0), ("|P_E|>5e2", -1.0)]
)
def test_a_level_fires_where_it_is_crossed_and_once(tmp_path, trigger, sign):
    file = captures(tmp_path / "run.mcap", trigger, pre_s=0.1, post_s=0.1)
    for number in range(200):
        time_s = (np.arange(200) + 200 * number) / 20_000
        # Above from the start, then below, then above from 1.2345 s on until the end.
        values = np.where((time_s < 0.3) | (time_s >= 1.2345), 600.0, 400.0)
        file.write(*_level_block(number, sign * values), number)
    file.finish("completed")
    assert file.fired == 1
    assert [path.name for path in file.files] == ["run.P_E-001.mcap"]
    fired = json.loads(Recording.open(file.files[0]).metadata["end"]["triggers"])
    assert fired == [{"trigger": trigger, "time_s": pytest.approx(1.2345, abs=1e-9)}]


@pytest.mark.parametrize(("again", "files", "end_s"), [("extend", 1, 1.8), ("ignore", 1, 1.5)])
def test_a_trigger_during_a_capture(tmp_path, again, files, end_s):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.1, post_s=0.5, again=again)
    feed(file, range(300), {100: [event("hammer", 1.0)], 130: [event("hammer", 1.3)]})
    file.finish("completed")
    assert len(file.files) == files
    assert extent(file.files[0])[1] == pytest.approx(end_s, abs=0.011)
    assert [fired["time_s"] for fired in json.loads(Recording.open(file.files[0]).metadata["end"]["triggers"])] == [
        1.0,
        1.3,
    ]


def test_the_time_before_a_trigger_is_whole_even_if_it_was_captured_before(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.5, post_s=0.2)
    feed(file, range(300), {100: [event("hammer", 1.0)], 150: [event("hammer", 1.5)]})
    file.finish("completed")
    assert [path.name for path in file.files] == ["run.hammer-001.mcap", "run.hammer-002.mcap"]
    assert extent(file.files[1])[0] == pytest.approx(1.0, abs=0.011)


def pulses(file: Captures, rows: list[int], blocks: range) -> None:
    """Probes of 10 ms blocks, at rest but for single rows of 0.3 mm."""
    group = default_table().groups["probes"]
    channel = group.channels[0]
    for number in blocks:
        counts = np.zeros((200, len(group.channels)), np.int32)
        counts[:, 0] = round(-channel.offset / channel.scale)
        counts[[row for row in rows if 0 <= row < 200], 0] = round((0.3 - channel.offset) / channel.scale)
        rows = [row - 200 for row in rows]
        file.write(PROBES, encode_block(Block(number * 10_000, number * 200, 20e3, TICK_RATE_HZ, counts)), number)


def test_the_time_after_counts_from_the_last_crossing_even_in_one_block(tmp_path):
    file = captures(tmp_path / "run.mcap", "disk_x>0.2", pre_s=0.0, post_s=0.0205)
    pulses(file, [200, 220, 399], range(10))  # the second block begins beyond the level: a crossing at a block's edge
    (path,) = file.files
    recording = Recording.open(path)
    assert recording.metadata["trigger"]["time_s"] == "0.010000000"
    assert extent(path) == (pytest.approx(0.01), pytest.approx(0.05 - 50e-6))
    assert [each["time_s"] for each in json.loads(recording.metadata["end"]["triggers"])] == [0.01, 0.01995]


def test_triggers_without_end_take_no_memory_without_end(tmp_path):
    file = captures(tmp_path / "run.mcap", "note", pre_s=0.0, post_s=1.0)
    feed(file, range(5))
    for number in range(3000):
        file.write(*event("note", 0.04, text=str(number)), number)
    feed(file, range(5, 300))
    assert len(file._ring) < 300
    end = Recording.open(file.files[0]).metadata["end"]
    assert (end["trigger_count"], len(json.loads(end["triggers"]))) == ("3000", 1000)


def test_an_event_of_a_far_time_does_not_hold_up_the_ring(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.1, post_s=0.1)
    file.write(*event("command", 1e6, id=1, command="speed", request={}), 0)
    feed(file, range(500))
    assert len(file._ring) < 200


def test_streams_that_are_behind_are_waited_for(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.1, post_s=0.2)
    file.write(FORCES, encode_block(block_of(FORCES, 0)), 0)
    for number in range(100, 140):
        file.write(PROBES, encode_block(block_of(PROBES, number)), number)
        if number == 110:
            file.write(*event("hammer", 1.1), number)
    for number in range(100, 140):
        file.write(FORCES, encode_block(block_of(FORCES, number)), number)
    file.finish("completed")
    assert extent(file.files[0], FORCES) == extent(file.files[0], PROBES)


def test_the_number_of_captures_is_limited(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.1, post_s=0.1, count=2)
    feed(file, range(400), {at: [event("hammer", at / 100)] for at in (50, 100, 150, 200)})
    assert file.ended == "2 captures made"
    assert not file.out_of_room
    assert len(file.files) == 2


def test_a_capture_that_the_end_cuts_short_says_so(tmp_path):
    file = captures(tmp_path / "run.mcap", "note", pre_s=0.1, post_s=5.0)
    feed(file, range(100), {50: [event("note", 0.5, text="now")]})
    file.finish("completed")
    assert Recording.open(file.files[0]).end_reason == "completed, before the capture was over"


def test_a_capture_knows_the_commands_before_it_and_no_others(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.2, post_s=0.2)
    commands = {
        at: [event("command", at / 100, id=at, command="speed", request={"speed_hz": 1.0})] for at in (10, 70, 95)
    }
    feed(file, range(300), {**commands, 100: [event("hammer", 1.0)]})
    file.finish("completed")
    recording = Recording.open(file.files[0])
    assert [entry["id"] for entry in recording.scene["taken"]] == [10, 70]
    assert [found["id"] for found in recording.events if found["event"] == "command"] == [95]


@pytest.mark.parametrize("text", ["", "hit", "P_E", "P_E=5", "P_E>x", "|P_E>5", "P_E>nan", ">5", "P_E>1e999"])
def test_what_is_no_trigger_is_refused(text):
    with pytest.raises(InputError, match="trigger must be one of hammer, speed"):
        Trigger.parse(text)


def test_an_unknown_channel_is_refused(tmp_path):
    with pytest.raises(InputError, match="trigger must be on one of disk_x"):
        captures(tmp_path / "run.mcap", "disk_z>1")


@pytest.mark.parametrize(
    ("options", "must"),
    [
        ({"pre_s": -1.0}, "pre_s must be"),
        ({"pre_s": 1e3}, "pre_s must be from 0 to 120"),
        ({"post_s": 0.0}, "post_s must be"),
        ({"count": 0}, "count must be"),
    ],
)
def test_impossible_captures_are_refused(options, must):
    with pytest.raises(InputError, match=must):
        Capture((Trigger.parse("hammer"),), **options)


def test_earlier_captures_are_not_replaced_without_force(tmp_path):
    old = tmp_path / "run.hammer-004.mcap"
    old.write_text("precious")
    with pytest.raises(InputError, match=r"run\.hammer-004\.mcap, which exists"):
        captures(tmp_path / "run.mcap", "hammer")
    assert old.read_text() == "precious"
    captures(tmp_path / "run.mcap", "hammer", force=True)
    assert not old.exists()
