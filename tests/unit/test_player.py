"""The player: payload by payload, on time, from any position, and changed only on request."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.console import Console
from recorder.reader import Recording, join
from replays.player.edit import Edit
from replays.player.messages import Track
from replays.player.play_range import Part
from replays.player.player import Player
from replays.player.timeline import By, Timeline
from rig.base import wire
from rig.base.errors import InputError, RefusedError
from rig.channels.table import ChannelTable
from rig.serve import served_run
from rig.serve.pacing import FreeRun, RealTime
from rig.serve.service import REPLAY_COMMANDS, Service
from rig.serve.transport.clients import Clients
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.unit.player_recording import (
    BLOCK_NS,
    BLOCKS,
    DURATION_NS,
    Payloads,
    group_by_key,
    order_by_key,
    write_recording,
)
from tests.unit.recorder_stream import generate_stream, make_documents
from tests.unit.service_fake import FakeSimulation
from tests.unit.test_pacing import FakeTime
from tests.waiting import PATIENCE_S, until

PROBES = wire.sensor_key("probes")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("player")


@pytest.fixture(scope="module")
def path(folder: Path) -> Path:
    return write_recording(folder / "whole.mcap")


@pytest.fixture(scope="module")
def track(path: Path) -> Track:
    return Track([path])


class Received:
    """Everything that was published, with its time."""

    def __init__(self, server: MemoryServer, time: FakeTime | None = None) -> None:
        self.all: list[tuple[str, bytes]] = []
        self.at_ns: list[int] = []
        self.summary: dict[str, Any] = {}
        self._time = time
        self.client = MemoryClient(server)
        self.client.subscribe("rig/**", self._take)

    def _take(self, key: str, payload: bytes) -> None:
        self.all.append((key, payload))
        self.at_ns.append(self._time.ns if self._time is not None else 0)

    @property
    def payloads(self) -> Payloads:
        return group_by_key(self.all)

    @property
    def events(self) -> list[dict[str, Any]]:
        return [wire.decode_document(payload) for payload in self.payloads.get(wire.EVENTS, [])]

    def blocks(self, key: str = PROBES) -> list[wire.Block]:
        schema = wire.get_schema(key)
        assert schema is not None
        return [wire.decode_block(payload, schema) for payload in self.payloads.get(key, [])]


def play(track: Track, **options: Any) -> tuple[Received, dict[str, Any]]:
    """Play to the end with a simulated clock; return the published messages and the summary."""
    time = FakeTime(oversleep_ns=700_000)
    server = MemoryServer()
    played = Received(server, time)
    clock = RealTime(now_ns=time.now_ns, sleep=time.sleep)
    played.begin_ns = time.ns  # type: ignore[attr-defined]
    summary = Player(track, server, clock, **options).run()
    return played, summary


# Order and deadlines.


@pytest.mark.parametrize("by", By)
def test_every_payload_is_played_once_in_the_order_of_its_key(track: Track, by: By) -> None:
    played = [(item.key, item.payload) for batch in Timeline(track, by).play(0) for item in batch]
    assert group_by_key(played) == group_by_key(generate_stream(BLOCKS))


def test_a_block_is_due_at_its_end_and_a_document_at_its_own_time(track: Track) -> None:
    for batch in Timeline(track).play(0):
        for item in batch:
            if item.block is None:
                assert item.due_ns == wire.decode_document(item.payload)["tick"] * 1000
            else:
                assert item.due_ns == item.block.tick * 1000 + BLOCK_NS


def test_deadlines_by_arrival_are_those_of_the_recorder(track: Track) -> None:
    due = [batch[0].due_ns for batch in Timeline(track, By.ARRIVAL).play(0)]
    assert np.all(np.diff(due) == 1_000_000)


def test_payloads_recorded_key_by_key_are_played_by_time(folder: Path) -> None:
    history = Track([write_recording(folder / "history.mcap", order_by_key())])
    due: list[int] = []
    played: list[tuple[str, bytes]] = []
    for batch in Timeline(history).play(0):
        due.append(batch[0].due_ns)
        played += [(item.key, item.payload) for item in batch]
    assert due == sorted(set(due))
    assert group_by_key(played) == group_by_key(generate_stream(BLOCKS))


@pytest.mark.parametrize("from_ms", [0, 5, 10, 333])
def test_a_range_contains_its_complete_blocks(track: Track, from_ms: int) -> None:
    to_ms = from_ms + 100
    played = [item for batch in Timeline(track).play(from_ms * 1_000_000, to_ms * 1_000_000) for item in batch]
    ticks = [item.block.tick for item in played if item.key == PROBES and item.block is not None]
    first = -(-from_ms // 10)
    assert ticks == [10_000 * number for number in range(first, to_ms // 10)]


@pytest.mark.parametrize("kind", ["whole", "cut off", "parts"])
def test_chunks_contain_every_message_once_with_its_time(folder: Path, path: Path, kind: str) -> None:
    files = [path]
    if kind == "cut off":
        files = [folder / "chunks.mcap.part"]
        files[0].write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif kind == "parts":
        written = list(generate_stream(BLOCKS))
        half = next(n for n, (key, _) in enumerate(written) if n > len(written) / 2 and key == PROBES)
        parts = {"first": written[:half], "second": written[half:]}
        files = [write_recording(folder / f"chunks-{name}.mcap", part) for name, part in parts.items()]
    recording = join(files)
    assert len(recording.chunks) > 4
    found = []
    for chunk in recording.chunks:
        messages = list(recording.read(chunk))
        times_ns = [time_ns for _, time_ns, _, _ in messages]
        assert (chunk.begin_ns, chunk.end_ns) == (min(times_ns), max(times_ns))
        found += messages
    assert found == list(recording.everything())


# A whole play.


def test_a_replay_is_the_recording_byte_for_byte(track: Track) -> None:
    played, summary = play(track)
    assert played.payloads == group_by_key(generate_stream(BLOCKS))
    assert summary["reason"] == "completed"
    assert summary["left_out"] == 0
    assert played.all[-1][0] == wire.EVENTS, "the end comes last"


@pytest.mark.parametrize("rate", [0.01, 1.0, 1000.0])
def test_late_sleeps_do_not_accumulate(track: Track, rate: float) -> None:
    played, summary = play(track, rate=rate)
    begin_ns = played.begin_ns  # type: ignore[attr-defined]
    for (key, payload), at_ns in zip(played.all, played.at_ns, strict=True):
        schema = wire.get_schema(key)
        if schema is not None:
            due_ns = begin_ns + (wire.decode_block(payload, schema).tick * 1000 + BLOCK_NS) / rate
            assert -1 <= at_ns - due_ns <= 700_001
    assert played.at_ns[-1] - begin_ns - DURATION_NS / rate <= 700_001
    assert summary["lateness_ms"]["max"] <= 0.701


def test_a_player_that_cannot_keep_up_reports_its_lag(track: Track) -> None:
    for slow_ns, behind in ((0, False), (20_000_000, True)):
        time = FakeTime(oversleep_ns=0)
        server = MemoryServer()
        MemoryClient(server).subscribe(
            PROBES, lambda *_, time=time, slow_ns=slow_ns: setattr(time, "ns", time.ns + slow_ns)
        )
        player = Player(track, server, RealTime(now_ns=time.now_ns, sleep=time.sleep))
        begin_ns = time.ns
        summary = player.run()
        late_s = (time.ns - begin_ns - DURATION_NS) / 1e9
        assert (summary["replay"]["behind_s"] > 0.5) == behind
        assert abs(summary["replay"]["behind_s"] - (late_s if behind else 0.0)) < 0.1
        assert any("late by" in text for text in player.status()["warnings"]) == behind


def test_documents_come_from_the_file_and_the_status_names_the_replay(track: Track) -> None:
    server = MemoryServer()
    player = Player(track, server, FreeRun(), paused=True)
    player.prepare()
    client = MemoryClient(server)
    for key in (wire.CATALOGUE, wire.PARAMETERS, wire.SCENE):
        assert client.request(key) == wire.encode_document(make_documents()[key])
    status = wire.decode_document(client.request(wire.STATUS))
    assert status["pace"] == "replay"
    assert status["replay"]["paused"] is True
    assert status["replay"]["files"] == [str(track.paths[0])]
    assert "replay of a recording" in status["warnings"][0]
    player.stop()
    player.run()


@pytest.mark.parametrize("cut", [0.35, 0.7, 0.97])
def test_a_truncated_file_is_played_to_its_last_message(folder: Path, path: Path, cut: float) -> None:
    short = folder / f"cut-{cut}.mcap"
    data = path.read_bytes()
    short.write_bytes(data[: int(cut * len(data))])
    played, summary = play(Track([short]))
    recording, whole = Recording.open(short), group_by_key(generate_stream(BLOCKS))
    assert 0 < recording.messages[PROBES] < BLOCKS
    for key, payloads in played.payloads.items():
        expected = whole[key][: recording.messages[key]]
        assert payloads[: len(expected)] == expected
        assert len(payloads) == len(expected) + (key == wire.EVENTS)
    assert played.events[-1]["event"] == "end"
    assert played.events[-1]["rows"][PROBES] == 200 * recording.messages[PROBES]
    assert summary["reason"] == "completed"


def test_parts_are_one_recording(folder: Path) -> None:
    payloads = list(generate_stream(BLOCKS))
    half = next(n for n, (key, _) in enumerate(payloads) if n > len(payloads) / 2 and key == PROBES)
    parts = [write_recording(folder / "a.mcap", payloads[:half]), write_recording(folder / "b.mcap", payloads[half:])]
    for order in (parts, parts[::-1]):
        played, _ = play(Track(order))
        assert played.payloads == group_by_key(payloads)


def test_a_cut_off_file_can_be_sought_in(folder: Path, path: Path) -> None:
    short = folder / "killed.mcap"
    data = path.read_bytes()
    short.write_bytes(data[: int(0.97 * len(data))])
    with running(Track([short]), paused=True) as (_, client_log, console):
        for position_s in (0.4, 0.1, 0.5):
            console.seek(position_s)
            console.step_blocks(1)
    assert [block.index for block in client_log.blocks()] == [200 * number for number in (40, 10, 50)]


# Parts, passes, numbers.


def test_a_range_begins_and_ends_with_events_of_its_own(track: Track) -> None:
    played, summary = play(track, part=Part(from_s=0.2, to_s=0.4))
    assert [event["event"] for event in played.events] == ["start", "end"]
    assert played.events[0]["time_s"] == 0.2
    assert played.events[0]["pace"] == "replay"
    assert played.events[-1]["rows"][PROBES] == 8000
    assert [block.index for block in played.blocks()] == [200 * number for number in range(20, 40)]
    assert summary["played_s"] == pytest.approx(0.2)


def test_passes_with_original_numbers_step_back(track: Track) -> None:
    played, summary = play(track, part=Part(from_s=0.1, to_s=0.3, loops=3))
    assert [block.index for block in played.blocks()] == 3 * [200 * number for number in range(10, 30)]
    assert [event["event"] for event in played.events] == ["start", "end"]
    assert summary["replay"]["pass"] == 3
    assert summary["played_s"] == pytest.approx(0.6)


def test_complete_passes_keep_every_payload_except_intermediate_ends(track: Track) -> None:
    played, summary = play(track, part=Part(loops=2))
    once = group_by_key(generate_stream(BLOCKS))
    for key, payloads in once.items():
        if key != wire.EVENTS:
            assert played.payloads[key] == 2 * payloads
    assert [event["event"] for event in played.events] == ["start", "start", "end"]
    assert summary["left_out"] == 1


def test_new_numbers_run_on_through_passes_and_belong_together(track: Track) -> None:
    played, _ = play(track, part=Part(from_s=0.1, to_s=0.3, start_s=0.2, loops=3), renumber=True)
    continuity = wire.Continuity()
    keys = [key for key in played.payloads if wire.get_schema(key) is not None]
    for key in keys:
        for block in played.blocks(key):
            assert continuity.follow(key, block.index, len(block.values)) is None
            if key != wire.EDGES:
                assert block.tick * block.rate_hz == block.index * block.tick_rate_hz
    probes = played.blocks()
    assert (probes[0].index, probes[0].tick) == (0, 0)
    assert len(probes) == 10 + 20 + 20
    recorded = [
        wire.decode_block(payload, wire.SAMPLE_SCHEMA) for payload in group_by_key(generate_stream(BLOCKS))[PROBES]
    ]
    numbers = [*range(20, 30), *range(10, 30), *range(10, 30)]
    for block, number in zip(probes, numbers, strict=True):
        assert np.array_equal(block.values, recorded[number].values)
    assert [event["event"] for event in played.events] == ["start", "end"]
    assert played.events[0]["tick"] == 0
    assert played.events[-1]["rows"][PROBES] == 50 * 200
    assert played.events[-1]["tick"] == 50 * 10_000


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (Part(from_s=-1.0), "from must be within the recording, 0 to 0.6 s"),
        (Part(to_s=9.0), "to must be within"),
        (Part(from_s=0.3, to_s=0.2), "to must be later than from"),
        (Part(from_s=0.3, start_s=0.2), "start must be within from and to"),
        (Part(from_s=0.301, to_s=0.302), "late enough for a whole block"),
        (Part(loops=0), "loop must be at least 1"),
    ],
)
def test_unknown_parts_are_refused(track: Track, part: Part, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Player(track, MemoryServer(), FreeRun(), part=part)


@pytest.mark.parametrize("rate", [0.0, 0.009, 1001.0, float("nan"), True, "1"])
def test_unsupported_rates_are_refused(track: Track, rate: Any) -> None:
    with pytest.raises(InputError, match=r"rate must be a number of 0\.01 to 1000"):
        Player(track, MemoryServer(), FreeRun(), rate=rate)


# Changes.


def edit(track: Track, **options: Any) -> Edit:
    return Edit(track.documents[wire.CATALOGUE], **options)


def test_a_renamed_key_keeps_its_payloads(track: Track) -> None:
    new = wire.sensor_key("probes2")
    played, _ = play(track, edit=edit(track, keys={PROBES: new}))
    assert PROBES not in played.payloads
    assert played.payloads[new] == group_by_key(generate_stream(BLOCKS))[PROBES]
    assert played.events[-1]["rows"][new] == 200 * BLOCKS


def test_channels_change_with_their_calibration(track: Track) -> None:
    table = ChannelTable.model_validate(track.documents[wire.CATALOGUE]["table"])
    first, second = table.groups["probes"].names[:2]
    force = table.groups["forces"].names[1]
    changed = edit(track, channels=[second, first, force], names={first: second, second: first})
    played, summary = play(track, edit=changed)
    now = ChannelTable.model_validate(changed.catalogue["table"])
    assert {name: group.names for name, group in now.groups.items()} == {"probes": (first, second), "forces": (force,)}
    assert now.channels[first].sensitivity_v == table.channels[second].sensitivity_v
    recorded = [
        wire.decode_block(payload, wire.SAMPLE_SCHEMA) for payload in group_by_key(generate_stream(BLOCKS))[PROBES]
    ]
    for block, before in zip(played.blocks(), recorded, strict=True):
        assert np.array_equal(block.values, before.values[:, [1, 0]])
        assert (block.index, block.tick) == (before.index, before.tick)
    assert wire.sensor_key("drive") not in played.payloads
    assert summary["left_out"] == (len(table.groups) - 2) * BLOCKS


def test_the_truth_can_stay_out(track: Track) -> None:
    played, _ = play(track, edit=edit(track, truth=False))
    whole = group_by_key(generate_stream(BLOCKS))
    assert {key for key in whole if key not in played.payloads} == {key for key in whole if key.startswith(wire.TRUTH)}
    assert edit(track, truth=False).catalogue["truth"] == {}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"keys": {"rig/sensors/nothing": "rig/sensors/a"}}, "remap must be from one of"),
        ({"keys": {PROBES: wire.truth_key("a")}}, "remap must be to a key for the same kind"),
        ({"keys": {PROBES: "elsewhere"}}, "remap must be to a key for the same kind"),
        ({"keys": {PROBES: wire.sensor_key("forces")}}, "remap must be to a key that nothing else has"),
        ({"channels": ["nothing"]}, "channels must be one of"),
        ({"channels": ["disk_x", "disk_x"]}, "channels must be at least one, each once"),
        ({"names": {"disk_x": "disk_y"}}, "rename must be to names that no other channel has"),
    ],
)
def test_changes_that_make_no_sense_are_refused(track: Track, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        edit(track, **options)


def test_swapped_keys_are_no_clash(track: Track) -> None:
    forces = wire.sensor_key("forces")
    played, _ = play(track, edit=edit(track, keys={PROBES: forces, forces: PROBES}))
    assert played.payloads[forces] == group_by_key(generate_stream(BLOCKS))[PROBES]


# Commands.


@contextmanager
def running(track: Track, **options: Any) -> Iterator[tuple[Player, Received, Console]]:
    server = MemoryServer()
    played = Received(server)
    clock = options.pop("clock", None) or RealTime()
    player = Player(track, server, clock, **options)
    player.prepare()
    thread = threading.Thread(target=lambda: played.summary.update(player.run()))
    thread.start()
    try:
        yield player, played, Console(MemoryClient(server), name="a test")
    finally:
        player.stop()
        thread.join(PATIENCE_S)
    assert not thread.is_alive()


def test_commands_of_a_rig_are_refused(track: Track) -> None:
    with running(track, paused=True) as (_, client_log, console):
        for command in (console.hammer, console.release, lambda: console.speed(5.0)):
            with pytest.raises(RefusedError, match="a replay does not accept"):
                command()
        assert client_log.all == []


def test_a_simulator_refuses_the_commands_of_a_replay() -> None:
    server = MemoryServer()
    service = Service(FakeSimulation(), server, FreeRun(), block_ticks=10_000)
    service.prepare()
    for name in REPLAY_COMMANDS:
        reply = wire.decode_document(MemoryClient(server).request(wire.command_key(name), b"{}"))
        assert reply["accepted"] is False
        assert f"{name} is for a recording that is replayed" in reply["error"]


def test_steps_while_paused(track: Track) -> None:
    with running(track, paused=True) as (player, client_log, console):
        assert console.step_blocks(2).time_s == pytest.approx(0.02)
        assert len(client_log.blocks()) == 2
        assert console.step(25_000).time_s == pytest.approx(0.04), "the last whole block"
        assert len(client_log.blocks()) == 4
        console.step(5_000)
        assert len(client_log.blocks()) == 5
        assert player.status()["replay"]["paused"] is True
        for fields in ({"ticks": 0}, {"ticks": 1.5}, {"blocks": True}, {}, {"ticks": 1, "blocks": 1}, {"x": 1}):
            request = json.dumps(fields).encode()
            assert b'"accepted":false' in client_log.client.request(wire.command_key("step"), request)


def test_playback_continues_after_a_seek(track: Track) -> None:
    with running(track, paused=True) as (_, client_log, console):
        console.step_blocks(1)
        assert console.seek(0.4).time_s == pytest.approx(0.4)
        console.step_blocks(1)
        assert console.seek(0.1).time_s == pytest.approx(0.1)
        console.step_blocks(1)
        assert [block.index for block in client_log.blocks()] == [0, 40 * 200, 10 * 200]
        for wrong in (-0.1, 0.6, 7.0):
            with pytest.raises(RefusedError, match=r"time_s must be a position from 0 to below 0\.6 s"):
                console.seek(wrong)
    assert client_log.summary["played_s"] == pytest.approx(0.03), "what was jumped over was not played"


def test_a_seek_with_new_numbers_leaves_no_gap(track: Track) -> None:
    with running(track, paused=True, renumber=True) as (_, client_log, console):
        for position_s in (0.4, 0.1, 0.5):
            console.step_blocks(3)
            console.seek(position_s)
        console.step_blocks(1)
        blocks = client_log.blocks()
        assert [block.index for block in blocks] == [200 * number for number in range(10)]
        assert [block.tick for block in blocks] == [10_000 * number for number in range(10)]


def test_pause_resume_rate_and_the_end(track: Track) -> None:
    with running(track, rate=0.01) as (player, client_log, console):
        console.pause()
        assert console.pause().command == "pause", "twice is no error"
        held = len(client_log.all)
        assert player.status()["replay"]["paused"] is True
        console.resume()
        with pytest.raises(RefusedError, match="step must be sent to a paused replay"):
            console.step(1000)
        with pytest.raises(RefusedError, match=r"rate must be a number of 0\.01 to 1000"):
            console.rate(0.0)
        console.rate(1000.0)
        until(lambda: bool(client_log.events) and client_log.events[-1]["event"] == "end")
        assert len(client_log.all) > held
        assert client_log.payloads == group_by_key(generate_stream(BLOCKS))


def test_a_stop_ends_the_stream_well(track: Track) -> None:
    with running(track, paused=True) as (_, client_log, console):
        console.step_blocks(3)
        console.stop()
        until(lambda: client_log.events[-1]["event"] == "end")
    assert client_log.events[-1]["reason"] == "stopped"
    assert client_log.events[-1]["rows"][PROBES] == 600


def test_a_burst_waits_for_the_clients_reports(track: Track, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(served_run, "_MAX_AHEAD_BLOCKS", 10)
    with running(track, clock=FreeRun(), paused=True) as (_, client_log, console):
        client = client_log.client
        client.report(f"{wire.CLIENTS}/slow", b'{"received_index": 0}')
        console.resume()
        until(lambda: len(client_log.blocks()) >= 11)
        client.report(f"{wire.CLIENTS}/slow", b'{"received_index": 1000}')
        assert len(client_log.blocks()) == 11, "ten blocks ahead, and the one that made it so"
        until(lambda: len(client_log.blocks()) >= 16)
        assert len(client_log.blocks()) == 16
        client.report(f"{wire.CLIENTS}/slow", b'{"received_index": 1000, "done": true}')
        until(lambda: len(client_log.blocks()) == BLOCKS)


def test_playback_starts_when_all_expected_clients_are_connected(track: Track) -> None:
    with running(track, clock=FreeRun(), wait_for=2) as (player, client_log, console):
        play = player.status()["replay"]
        assert (play["waiting_for"], play["paused"]) == (2, True)
        client_log.client.report(f"{wire.CLIENTS}/a", b'{"received_index": null}')
        console.step_blocks(2)
        assert len(client_log.blocks()) == 2, "one is not enough; it may be stepped and sought in"
        console.seek(0.0)
        client_log.client.report(f"{wire.CLIENTS}/b", b'{"received_index": null}')
        until(lambda: bool(client_log.events) and client_log.events[-1]["event"] == "end")
        assert player.status()["replay"]["waiting_for"] == 0
        assert len(client_log.blocks()) == 2 + BLOCKS


@pytest.mark.parametrize("ends", ["resume", "pause", "stop"])
def test_waiting_is_ended_by_commands(track: Track, ends: str) -> None:
    with running(track, rate=0.01, wait_for=1) as (player, client_log, console):
        getattr(console, ends)()
        assert player.status()["replay"]["paused"] is (ends != "resume")
        if ends != "stop":
            assert player.status()["replay"]["waiting_for"] == 0
            client_log.client.report(f"{wire.CLIENTS}/a", b'{"received_index": null}')
    assert client_log.events[-1]["reason"] == "stopped"
    assert client_log.blocks() == []


def test_the_wait_for_clients_is_limited(track: Track) -> None:
    server = MemoryServer()
    played = Received(server)
    with pytest.raises(RefusedError, match=r"0 of 1 clients were present after 0\.05 s"):
        Player(track, server, FreeRun(), wait_for=1, wait_s=0.05).run()
    assert [event["reason"] for event in played.events] == ["failed: 0 of 1 clients were present after 0.05 s"]


def test_the_scene_contains_earlier_commands_for_late_clients(folder: Path) -> None:
    command = {"event": "command", "id": 1, "tick": 200_000, "time_s": 0.2, "command": "hammer", "request": {}}
    payloads = list(generate_stream(BLOCKS))
    payloads.insert(len(payloads) // 2, (wire.EVENTS, wire.encode_document(command)))
    track = Track([write_recording(folder / "command.mcap", payloads)])
    with running(track, paused=True) as (_, client_log, console):
        for position_s, commands in ((0.1, []), (0.3, [{name: command[name] for name in track.commands[0]}])):
            console.seek(position_s)
            scene = wire.decode_document(client_log.client.request(wire.SCENE))
            assert scene.get("taken", []) == commands


# Dependencies.


def test_a_premature_end_event_keeps_its_position(folder: Path) -> None:
    late = {"event": "warning", "tick": 600_000, "time_s": 0.6, "text": "went on"}
    payloads = [*generate_stream(BLOCKS), (wire.EVENTS, wire.encode_document(late))]
    played, _ = play(Track([write_recording(folder / "on.mcap", payloads)]))
    assert [event["event"] for event in played.events] == ["start", "end", "warning", "end"]
    assert played.payloads[wire.EVENTS][:3] == group_by_key(payloads)[wire.EVENTS]


def test_late_documents_keep_their_position(folder: Path) -> None:
    command_events = [
        {"event": "command", "id": 1, "tick": tick, "time_s": tick / 1e6} for tick in (300_000, 295_000, 301_000)
    ]
    payloads = list(generate_stream(BLOCKS))
    for number, event in enumerate(command_events):
        payloads.insert(len(payloads) // 2 + number, (wire.EVENTS, wire.encode_document(event)))
    played, _ = play(Track([write_recording(folder / "late.mcap", payloads)]))
    assert [event.get("tick") for event in played.events] == [0, 300_000, 295_000, 301_000, 600_000]


def test_a_status_that_the_run_has_ended_comes_after_the_end(folder: Path) -> None:
    ended = wire.encode_document({"tick": 600_000, "time_s": 0.6, "state": "ended"})
    payloads = list(generate_stream(BLOCKS))
    payloads.insert(len(payloads) - 1, (wire.STATUS, ended))
    played, _ = play(Track([write_recording(folder / "status.mcap", payloads)]))
    assert [key for key, _ in played.all[-2:]] == [wire.EVENTS, wire.STATUS]
    assert played.payloads == group_by_key(payloads)


def test_a_file_that_is_damaged_while_it_is_played_ends_the_stream_and_says_so(folder: Path, path: Path) -> None:
    damaged = folder / "damaged.mcap"
    data = bytearray(path.read_bytes())
    damaged.write_bytes(data)
    server = MemoryServer()
    played = Received(server)
    player = Player(Track([damaged]), server, FreeRun())
    chunk = Track([path]).chunks[10]
    data[chunk.offset + chunk.length // 2] ^= 0xFF
    damaged.write_bytes(data)
    with pytest.raises(InputError, match="file must be an intact recording"):
        Track([damaged])
    with pytest.raises(InputError, match="file must be an intact recording"):
        player.run()
    assert played.events[-1]["event"] == "end"
    assert played.events[-1]["reason"].startswith("failed: file must be an intact recording")
    assert played.blocks(), "what came before went out"


def test_a_clock_reports_its_position() -> None:
    time = FakeTime()
    clock = RealTime(now_ns=time.now_ns, sleep=time.sleep)
    clock.start(500, 2_000_000_000)
    time.work(0.25)
    assert clock.position() == 500 + 500_000_000
    free = FreeRun(now_ns=time.now_ns)
    free.start(7, 1000)
    assert free.position() == 7
    free.release(9)
    assert free.position() == 9


def test_a_client_with_little_room_is_not_overrun() -> None:
    now = [0.0]
    clients = Clients(now_s=lambda: now[0])
    assert not clients.find_lagging(10**9, 10)
    clients.take(f"{wire.CLIENTS}/a", b'{"received_index": 1000}')
    assert clients.find_lagging(1101, 100)
    assert not clients.find_lagging(1100, 100)
    clients.take(f"{wire.CLIENTS}/b", b'{"received_index": 1000, "room": 60}')
    assert clients.find_lagging(1031, 100)
    assert not clients.find_lagging(1030, 100)
    assert clients.max_lag_rows(1030) == 30
    now[0] = 10.0
    assert not clients.find_lagging(10**6, 100), "who is not heard any more is not waited for"
    clients.take(f"{wire.CLIENTS}/c", b'{"received_index": 0, "room": "much"}')
    assert clients.malformed == 1
    clients.take(f"{wire.CLIENTS}/d", b'{"received_index": null, "room": 60}')
    assert clients.active_count == 1
    assert not clients.find_lagging(5000, 100), "it is measured from where it joined"
    assert clients.find_lagging(5031, 100)
    clients.take(f"{wire.CLIENTS}/d", b'{"received_index": 5031, "room": 60}')
    assert not clients.find_lagging(5061, 100)
    clients.take(f"{wire.CLIENTS}/d", b'{"received_index": 5031, "done": true}')
    assert clients.active_count == 0
