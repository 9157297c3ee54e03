"""Recording around triggers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.contents.metadata import Beginning
from recorder.files.payload import Payload
from recorder.output.captures import Captures
from recorder.output.disk_limits import DiskLimits
from recorder.output.sink import Needs
from recorder.output.trigger import Capture, Trigger
from recorder.reader import Recording
from recorder.writer import RecordingWriter
from rig.base.errors import InputError
from rig.base.wire import CATALOGUE, EVENTS, PARAMETERS, SCENE, Block, encode_block, encode_document, sensor_key
from rig.channels.table import default_table

from .recorder_stream import TICK_RATE_HZ, make_block, make_documents

PROBES, FORCES = sensor_key("probes"), sensor_key("forces")


def captures(
    path: Path, *triggers: str, force: bool = False, limits: DiskLimits | None = None, **options: Any
) -> Captures:
    about = make_documents()

    def open_file(name: Path, scene: dict[str, Any], beginning: Beginning) -> RecordingWriter:
        return RecordingWriter(
            name,
            catalogue=about[CATALOGUE],
            parameters=about[PARAMETERS],
            scene=scene,
            view_rate_hz=0.0,
            beginning=beginning,
            force=force,
        )

    capture = Capture(tuple(Trigger.parse(text) for text in triggers), **options)
    limits = limits or DiskLimits(keep_free_mb=0.0)
    return Captures(path, capture, Needs(default_table(), TICK_RATE_HZ, about[SCENE], open_file, limits, force))


def event(name: str, time_s: float, **fields: Any) -> tuple[str, bytes]:
    return EVENTS, encode_document({"event": name, "tick": round(time_s * 1e6), "time_s": time_s, **fields})


def feed_blocks(file: Captures, blocks: range, events: dict[int, list[tuple[str, bytes]]] | None = None) -> None:
    """Feed blocks of 10 ms of probes and forces; events follow the block that contains them, as the rig sends them."""
    for number in blocks:
        for key in (PROBES, FORCES):
            file.take(Payload.read(key, encode_block(make_block(key, number)), number))
        for item in (events or {}).get(number, []):
            file.take(Payload.read(*item, number))


def extent(path: Path, key: str = PROBES) -> tuple[float, float]:
    stream = Recording.open(path).streams[key]
    return stream.first_time_s, stream.last_time_s


def test_an_impact_is_captured_with_the_time_before_and_after(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.2, post_s=0.5)
    feed_blocks(file, range(300), {100: [event("hammer", 1.0)]})
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
        assert payloads == [encode_block(make_block(key, number)) for number in range(first, 151)]
    assert [found["event"] for found in recording.events] == ["hammer"]
    assert recording.metadata["trigger"]["time_s"] == "1.000000000"
    assert file.counts().rows[PROBES] == 60_000


def test_without_a_trigger_there_is_no_file(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer")
    feed_blocks(file, range(100), {50: [event("speed", 0.5)]})
    file.finish("completed")
    assert file.files == list(tmp_path.iterdir()) == []


def _level_block(number: int, values: np.ndarray) -> tuple[str, bytes]:
    """Return a block of forces with the given P_E [N] and zero for the others."""
    group = default_table().groups["forces"]
    counts = np.zeros((200, 4), dtype=np.int32)
    counts[:, group.names.index("P_E")] = np.rint(values / group.channels[2].scale)
    return FORCES, encode_block(Block(number * 10_000, number * 200, 20_000.0, TICK_RATE_HZ, counts))


@pytest.mark.parametrize(
    ("trigger", "sign"), [("P_E>500", 1.0), ("P_E<-500", -1.0), ("|P_E| > 500", 1.0), ("|P_E|>5e2", -1.0)]
)
def test_a_level_trigger_fires_once_per_crossing(tmp_path, trigger, sign):
    file = captures(tmp_path / "run.mcap", trigger, pre_s=0.1, post_s=0.1)
    for number in range(200):
        time_s = (np.arange(200) + 200 * number) / 20_000
        # Above from the start, then below, then above from 1.2345 s on until the end.
        values = np.where((time_s < 0.3) | (time_s >= 1.2345), 600.0, 400.0)
        file.take(Payload.read(*_level_block(number, sign * values), number))
    file.finish("completed")
    assert file.fired == 1
    assert [path.name for path in file.files] == ["run.P_E-001.mcap"]
    fired = json.loads(Recording.open(file.files[0]).metadata["end"]["triggers"])
    assert fired == [{"trigger": trigger, "time_s": pytest.approx(1.2345, abs=1e-9)}]


@pytest.mark.parametrize(("again", "files", "end_s"), [("extend", 1, 1.8), ("ignore", 1, 1.5)])
def test_a_trigger_during_a_capture(tmp_path, again, files, end_s):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.1, post_s=0.5, again=again)
    feed_blocks(file, range(300), {100: [event("hammer", 1.0)], 130: [event("hammer", 1.3)]})
    file.finish("completed")
    assert len(file.files) == files
    assert extent(file.files[0])[1] == pytest.approx(end_s, abs=0.011)
    assert [fired["time_s"] for fired in json.loads(Recording.open(file.files[0]).metadata["end"]["triggers"])] == [
        1.0,
        1.3,
    ]


def test_the_time_before_a_trigger_is_complete_even_after_a_capture(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.5, post_s=0.2)
    feed_blocks(file, range(300), {100: [event("hammer", 1.0)], 150: [event("hammer", 1.5)]})
    file.finish("completed")
    assert [path.name for path in file.files] == ["run.hammer-001.mcap", "run.hammer-002.mcap"]
    assert extent(file.files[1])[0] == pytest.approx(1.0, abs=0.011)


def feed_pulses(file: Captures, rows: list[int], blocks: range) -> None:
    """Feed blocks of 10 ms of probes, at rest except for single rows of 0.3 mm."""
    group = default_table().groups["probes"]
    channel = group.channels[0]
    for number in blocks:
        counts = np.zeros((200, len(group.channels)), np.int32)
        counts[:, 0] = round(-channel.offset / channel.scale)
        counts[[row for row in rows if 0 <= row < 200], 0] = round((0.3 - channel.offset) / channel.scale)
        rows = [row - 200 for row in rows]
        block = Block(number * 10_000, number * 200, 20e3, TICK_RATE_HZ, counts)
        file.take(Payload.read(PROBES, encode_block(block), number))


def test_the_time_after_counts_from_the_last_crossing_even_in_one_block(tmp_path):
    file = captures(tmp_path / "run.mcap", "disk_x>0.2", pre_s=0.0, post_s=0.0205, again="extend")
    feed_pulses(
        file, [200, 220, 399], range(10)
    )  # the second block begins beyond the level: a crossing at a block's edge
    (path,) = file.files
    recording = Recording.open(path)
    assert recording.metadata["trigger"]["time_s"] == "0.010000000"
    assert extent(path) == (pytest.approx(0.01), pytest.approx(0.05 - 50e-6))
    assert [each["time_s"] for each in json.loads(recording.metadata["end"]["triggers"])] == [0.01, 0.01995]


def _forces(file: Captures, values_of: Callable[[np.ndarray], np.ndarray], blocks: range) -> None:
    for number in blocks:
        if not file.ended:
            file.take(Payload.read(*_level_block(number, values_of((np.arange(200) + 200 * number) / 20_000)), number))


def test_an_exceeded_level_is_reported_once(tmp_path):
    file = captures(tmp_path / "run.mcap", "P_E>500", "|P_E|<100")
    _forces(file, lambda time_s: np.where(time_s < 0.5, 3000.0, 3100.0), range(100))
    assert file.remarks == ("P_E is above 500 N already; waiting until it has been below",)
    assert file.fired == 0
    quiet = captures(tmp_path / "other.mcap", "|P_E|<100")
    _forces(quiet, lambda time_s: 0.0 * time_s, range(3))
    assert quiet.remarks == ("|P_E| is below 100 N already; waiting until it has been above",)


def _whirl(time_s: np.ndarray) -> np.ndarray:
    """Return a signal above 500 N twice per turn at 40 Hz, from 1 s to 6 s and from 7 s on."""
    whirling = ((time_s >= 1.0) & (time_s < 6.0)) | (time_s >= 7.0)
    return np.where(whirling, 1000.0 * np.sin(2 * np.pi * 40.0 * (time_s - 1.0)), 0.0)


def test_whirl_is_captured_at_its_start_only(tmp_path):
    file = captures(tmp_path / "run.mcap", "|P_E|>500", pre_s=0.1, post_s=0.5)
    _forces(file, _whirl, range(900))
    recordings = [Recording.open(path) for path in file.files]
    crossing_s = 1.0 + 1.0 / (12 * 40.0)  # where the sine is one half
    starts = [float(each.metadata["trigger"]["time_s"]) for each in recordings]
    assert starts == pytest.approx([crossing_s, 6.0 + crossing_s], abs=1e-4)
    for path, start_s in zip(file.files, starts, strict=True):
        assert extent(path, FORCES) == pytest.approx((start_s - 0.1, start_s + 0.5), abs=0.011)
    assert [each.metadata["end"]["reason"] for each in recordings] == ["captured", "captured"]


def test_an_extended_capture_has_a_maximum_length(tmp_path):
    file = captures(tmp_path / "run.mcap", "|P_E|>500", pre_s=0.1, post_s=0.5, again="extend", longest_s=2.0)
    _forces(file, _whirl, range(950))
    first, second = (Recording.open(path) for path in file.files)
    assert first.streams[FORCES].last_time_s - first.streams[FORCES].first_time_s == pytest.approx(2.0, abs=0.021)
    assert first.end_reason == second.end_reason == "captured, up to its longest length of 2 s"
    assert first.metadata["trigger"]["longest_s"] == "2"
    assert float(second.metadata["trigger"]["time_s"]) == pytest.approx(7.002, abs=1e-3)


def test_an_impact_extends_a_capture_and_a_level_does_not(tmp_path):
    file = captures(tmp_path / "run.mcap", "|P_E|>500", "hammer", pre_s=0.0, post_s=0.5)
    _forces(file, _whirl, range(130))
    file.take(Payload.read(*event("hammer", 1.3), 0))
    _forces(file, _whirl, range(130, 300))
    (path,) = file.files
    assert extent(path, FORCES)[1] == pytest.approx(1.8, abs=0.011)


def test_stored_and_received_rows_are_counted_separately(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.2, post_s=0.5)
    feed_blocks(file, range(300), {100: [event("hammer", 1.0)]})
    (kept,) = file.kept()
    assert kept.rows[PROBES] == Recording.open(file.files[0]).streams[PROBES].rows == 71 * 200
    assert kept.extent_ns / 1e9 == pytest.approx(0.71, abs=1e-3)
    assert file.counts().extent_ns / 1e9 == pytest.approx(3.0, abs=0.011)


def test_the_budget_holds_for_captures(tmp_path):
    file = captures(
        tmp_path / "run.mcap", "hammer", pre_s=0.1, post_s=1.0, limits=DiskLimits(budget_mb=5.0, keep_free_mb=0.0)
    )
    for number in range(3000):
        if not file.ended:
            feed_blocks(
                file, range(number, number + 1), {number: [event("hammer", number / 100)]} if not number % 150 else {}
            )
    file.finish(file.ended)
    assert file.ended == "the budget of 5 MB is used up"
    assert file.out_of_room
    assert 4_000_000 < sum(path.stat().st_size for path in tmp_path.iterdir()) <= 5_000_000
    assert all(Recording.open(path).complete for path in file.files)
    end = Recording.open(file.files[-1]).end_reason
    assert end in ("captured", "the budget of 5 MB is used up, before the capture was over")


def test_endless_triggers_use_bounded_memory(tmp_path):
    file = captures(tmp_path / "run.mcap", "note", pre_s=0.0, post_s=1.0)
    feed_blocks(file, range(5))
    for number in range(3000):
        file.take(Payload.read(*event("note", 0.04, text=str(number)), number))
    feed_blocks(file, range(5, 300))
    assert file.payload_count < 300
    end = Recording.open(file.files[0]).metadata["end"]
    assert (end["trigger_count"], len(json.loads(end["triggers"]))) == ("3000", 1000)


def test_an_event_far_ahead_does_not_block_the_buffer(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.1, post_s=0.1)
    file.take(Payload.read(*event("command", 1e6, id=1, command="speed", request={}), 0))
    feed_blocks(file, range(500))
    assert file.payload_count < 200


def test_delayed_streams_are_awaited(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.1, post_s=0.2)
    file.take(Payload.read(FORCES, encode_block(make_block(FORCES, 0)), 0))
    for number in range(100, 140):
        file.take(Payload.read(PROBES, encode_block(make_block(PROBES, number)), number))
        if number == 110:
            file.take(Payload.read(*event("hammer", 1.1), number))
    for number in range(100, 140):
        file.take(Payload.read(FORCES, encode_block(make_block(FORCES, number)), number))
    file.finish("completed")
    assert extent(file.files[0], FORCES) == extent(file.files[0], PROBES)


def test_the_number_of_captures_is_limited(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.1, post_s=0.1, count=2)
    feed_blocks(file, range(400), {at: [event("hammer", at / 100)] for at in (50, 100, 150, 200)})
    assert file.ended == "2 captures made"
    assert not file.out_of_room
    assert len(file.files) == 2


def test_a_capture_truncated_by_the_end_is_marked(tmp_path):
    file = captures(tmp_path / "run.mcap", "note", pre_s=0.1, post_s=5.0)
    feed_blocks(file, range(100), {50: [event("note", 0.5, text="now")]})
    file.finish("completed")
    assert Recording.open(file.files[0]).end_reason == "completed, before the capture was over"


def test_a_capture_contains_only_earlier_commands(tmp_path):
    file = captures(tmp_path / "run.mcap", "hammer", pre_s=0.2, post_s=0.2)
    commands = {
        at: [event("command", at / 100, id=at, command="speed", request={"speed_hz": 1.0})] for at in (10, 70, 95)
    }
    feed_blocks(file, range(300), {**commands, 100: [event("hammer", 1.0)]})
    file.finish("completed")
    recording = Recording.open(file.files[0])
    assert [entry["id"] for entry in recording.scene["taken"]] == [10, 70]
    assert [found["id"] for found in recording.events if found["event"] == "command"] == [95]


@pytest.mark.parametrize("text", ["", "hit", "P_E", "P_E=5", "P_E>x", "|P_E>5", "P_E>nan", ">5", "P_E>1e999"])
def test_invalid_triggers_are_refused(text):
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
        ({"longest_s": 2.0}, "longest_s must be at least pre_s and post_s, 2.5"),
        ({"longest_s": float("nan")}, "longest_s must be"),
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
