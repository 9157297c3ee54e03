from __future__ import annotations

import os
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import recorder.files.payload
import recorder.session
import rig.base.wire
import rig.serve.stream_check
from recorder.contents.summary import Progress, Summary
from recorder.files.payload import Payload
from recorder.output.disk_limits import DiskLimits
from recorder.output.trigger import Capture, Trigger
from recorder.reader import Recording
from recorder.session import RIG_LOST, RecordingSession
from recorder.writer import RecordingWriter
from rig.base.errors import InputError
from rig.base.wire import (
    ALIVE,
    CATALOGUE,
    CLIENTS,
    EVENTS,
    FAULTS,
    STATUS,
    Gap,
    decode_document,
    encode_block,
    encode_document,
    get_schema,
    sensor_key,
    truth_key,
)
from rig.channels.table import default_table
from rig.serve.transport import NoReplyError
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.waiting import PATIENCE_S, until

from .recorder_stream import ScriptedClient, generate_stream, make_block, make_documents

pytestmark = pytest.mark.wallclock
PROBES = sensor_key("probes")


@pytest.fixture(autouse=True)
def _short_waits(monkeypatch):
    monkeypatch.setattr(recorder.session, "QUIET_S", 0.05)
    monkeypatch.setattr(recorder.session, "RECOVERY_S", 0.3)
    monkeypatch.setattr(recorder.session, "RETURN_S", 0.3)


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "run.mcap"


def play(client: ScriptedClient, items: list[tuple[str, bytes]]) -> Callable[[], None]:
    """Return an action that publishes all items."""

    def act() -> None:
        for item in items:
            client.publish(*item)

    return act


def record(
    session: RecordingSession, client: ScriptedClient, act: Callable[[], None], progress: list[Progress] | None = None
) -> Summary:
    """Run a session while another thread acts as the rig, as soon as the session has subscribed."""

    def wait_and_act() -> None:
        until(lambda: STATUS in client.subscribed, every_s=0.002)
        act()

    thread = threading.Thread(target=wait_and_act)
    thread.start()
    try:
        return session.run(None if progress is None else progress.append)
    finally:
        thread.join()


def test_records_to_the_end_of_the_stream(path):
    client = ScriptedClient()
    items = list(generate_stream(30))
    progress: list[Progress] = []
    summary = record(RecordingSession(client, path), client, play(client, items), progress)
    assert (summary.reason, summary.error, summary.path) == ("completed", "", path)
    assert summary.rows[PROBES] == 6000
    assert summary.lost == summary.missed == {}
    assert summary.gaps == summary.dropped == summary.malformed == 0
    assert summary.duration_s == pytest.approx(0.3 - 50e-6)
    assert summary.size_bytes == path.stat().st_size
    recording = Recording.open(path)
    assert recording.complete
    for key in {key for key, _ in items}:
        assert [p for _, p in recording.payloads(key)] == [p for k, p in items if k == key]
    assert progress[-1].lost == 0


def test_each_block_and_each_document_is_decoded_once(path, monkeypatch):
    decoded: list[bytes] = []

    def counted(decode: Callable[..., Any]) -> Callable[..., Any]:
        def count(payload: bytes, *rest: Any, **more: Any) -> Any:
            decoded.append(payload)
            return decode(payload, *rest, **more)

        return count

    client = ScriptedClient()
    fault_event = {"event": "fault", "tick": 0, "time_s": 0.0, "fault": 1}
    items = [(FAULTS, encode_document(fault_event)), *generate_stream(30)]
    act = play(client, items)

    def count_and_act() -> None:
        for module, name in (
            (rig.base.wire, "decode_block"),
            (recorder.files.payload, "decode_block"),
            (rig.serve.stream_check, "read_json"),
            (recorder.files.payload, "decode_document"),
        ):
            monkeypatch.setattr(module, name, counted(getattr(module, name)))
        act()

    record(RecordingSession(client, path), client, count_and_act)
    assert sorted(decoded) == sorted(payload for _, payload in items)


@pytest.mark.parametrize(("status", "short", "reason"), [(True, 0, "completed"), (False, 0, "late"), (True, 1, "late")])
def test_the_last_status_ends_a_session_only_with_all_rows(path, status, short, reason):
    client = ScriptedClient()
    *items, _ = generate_stream(3)
    end = {"event": "end", "tick": 30_000, "time_s": 0.03, "reason": "completed", "rows": {PROBES: 600 + short}}
    items.append((EVENTS, encode_document(end)))
    if status:
        items.append((STATUS, encode_document({"tick": 30_000, "time_s": 0.03, "state": "ended"})))
    session = RecordingSession(client, path, monotonic_s=lambda: 0.0)  # without a clock no silence lasts
    late = threading.Timer(0.3 if reason == "late" else 10.0, session.stop, ["late"])
    late.start()
    summary = record(session, client, play(client, items))
    late.cancel()
    assert (summary.reason, summary.rows[PROBES]) == (reason, 600)


def test_over_the_memory_transport(path):
    server = MemoryServer()
    for key, document in make_documents().items():
        server.answer(key, lambda _, document=document: encode_document(document))
    beats: list[dict] = []
    server.subscribe_reports(f"{CLIENTS}/*", lambda _, payload: beats.append(decode_document(payload)))
    server.announce()
    items = list(generate_stream(20))
    for item in items[:60]:
        server.publish(*item)

    def run() -> None:
        for item in items[60:]:
            server.publish(*item)

    with MemoryClient(server) as client:
        threading.Timer(0.2, run).start()
        summary = RecordingSession(client, path, name="recorder-7", history=True).run()
    assert summary.reason == "completed"
    recording = Recording.open(path)
    for key in {key for key, _ in items}:
        assert [p for _, p in recording.payloads(key)] == [p for k, p in items if k == key]
    assert {beat["name"] for beat in beats} == {"recorder-7"}
    # The last one reports to the rig that everything has arrived, so that it need not keep its cache.
    assert (beats[-1]["received_index"], beats[-1]["lost"]) == (4000, 0)


def test_blocks_overtaken_by_the_end_event_are_awaited(path):
    client = ScriptedClient()
    items = list(generate_stream(10))
    end = decode_document(items[-1][1]) | {"rows": {PROBES: 2000, truth_key("state"): 200}}
    late = [item for item in items if item[0] == PROBES][5:]

    def act() -> None:
        for item in items[:-1]:
            if item not in late:
                client.publish(*item)
        client.publish(EVENTS, encode_document(end))
        time.sleep(0.15)  # longer than the silence after which a whole stream ends
        for item in late:
            client.publish(*item)

    summary = record(RecordingSession(client, path), client, act)
    assert summary.reason == "completed"
    assert summary.rows[PROBES] == 2000
    assert summary.lost == {}


def test_missing_last_blocks_are_a_gap_at_the_end(path):
    client = ScriptedClient()
    items = [item for item in generate_stream(10) if item[0] in (PROBES, EVENTS)]
    end = decode_document(items[-1][1]) | {"rows": {PROBES: 2000}}

    def act() -> None:
        for item in items[:-3]:
            client.publish(*item)
        client.publish(EVENTS, encode_document(end))

    summary = record(RecordingSession(client, path), client, act)
    assert (summary.reason, summary.lost, summary.gaps) == ("completed", {PROBES: 400}, 1)
    assert Recording.open(path).gaps == [Gap(PROBES, 1600, 400)]


def test_gaps_and_transport_losses_are_in_summary_and_file(path):
    client = ScriptedClient()
    items = [item for number, item in enumerate(generate_stream(10)) if number not in (10, 11, 12)]

    def act() -> None:
        assert client.on_miss is not None
        for item in items[:-1]:
            client.publish(*item)
        client.on_miss(STATUS, 2)
        client.publish(*items[-1])

    summary = record(RecordingSession(client, path), client, act)
    assert summary.lost
    assert summary.missed == {STATUS: 2}
    assert summary.gaps == len(summary.lost) == 3
    gaps = Recording.open(path).gaps
    assert Gap(STATUS, -1, 2) in gaps
    assert {gap.key: gap.size for gap in gaps if gap.index >= 0} == summary.lost


def test_ends_after_a_simulated_time(path):
    client = ScriptedClient()
    blocks = [(PROBES, encode_block(make_block(PROBES, number))) for number in range(100, 150)]
    summary = record(RecordingSession(client, path, duration_s=0.2), client, play(client, blocks))
    assert summary.reason == "duration reached"
    assert summary.first_time_s == pytest.approx(1.0)
    assert summary.duration_s == pytest.approx(0.2 - 50e-6)
    assert Recording.open(path).complete


def test_a_time_to_record_ends_for_all_streams_at_the_same_block(path):
    client = ScriptedClient()
    items = list(generate_stream(60))
    summary = record(RecordingSession(client, path, duration_s=0.205), client, play(client, items[:-1]))
    assert summary.reason == "duration reached"
    streams = Recording.open(path).streams
    for group in default_table().groups:
        assert streams[sensor_key(group)].rows == 21 * 200
    assert streams[truth_key("state")].rows == 21 * 20
    assert summary.lost == {}


def test_streams_starting_a_block_apart_have_the_full_duration(path):
    client = ScriptedClient()
    items = [item for item in generate_stream(60) if get_schema(item[0])]
    place = items.index((sensor_key("hammer"), encode_block(make_block(sensor_key("hammer"), 3))))
    summary = record(RecordingSession(client, path, duration_s=0.2), client, play(client, items[place:]))
    streams = Recording.open(path).streams
    assert {streams[sensor_key(group)].rows for group in default_table().groups} == {4000}
    assert summary.duration_s == pytest.approx(0.21, abs=1e-3)


def test_a_restarted_rig_is_not_mixed_into_the_recording(path):
    client = ScriptedClient()
    items = list(generate_stream(20))[1:-1]

    def act() -> None:
        for item in items:
            client.publish(*item)
        client.on_alive(False)
        for item in items[:30]:  # before its token
            client.publish(*item)
        client.rig = "another rig"
        client.on_alive(True)
        for item in items[30:]:
            client.publish(*item)

    summary = record(RecordingSession(client, path), client, act)
    assert (summary.reason, summary.gaps, summary.lost) == (RIG_LOST, 0, {})
    recording = Recording.open(path)
    assert recording.complete
    for key in {key for key, _ in items if key != STATUS}:
        assert [p for _, p in recording.payloads(key)] == [p for k, p in items if k == key]


def test_an_internal_error_is_reported_and_the_file_finished(path, monkeypatch):
    client = ScriptedClient()
    blocks = [(PROBES, encode_block(make_block(PROBES, number))) for number in range(20)]
    real = RecordingWriter.take
    calls = [0]

    def breaks(self, payload: Payload) -> None:
        calls[0] += 1
        if calls[0] > 10:
            raise TypeError("a mistake")
        real(self, payload)

    monkeypatch.setattr(RecordingWriter, "take", breaks)
    summary = record(RecordingSession(client, path), client, play(client, blocks))
    assert "TypeError: a mistake" in summary.error
    assert summary.rows[PROBES] == 2000
    assert Recording.open(path).complete


def test_blocks_with_impossible_times_are_skipped_and_odd_documents_kept(path):
    client = ScriptedClient()
    head = struct.Struct("<qqddII")
    good = encode_block(make_block(PROBES, 0))
    wrong = []
    for tick, index, rate_hz, tick_rate_hz in (
        (2**62, 0, 20e3, 1e6),
        (-(2**62), 0, 20e3, 1e6),
        (0, 2**62, 20e3, 1e6),
        (0, -5, 20e3, 1e6),
        (0, 0, 0.0, 1e6),
        (0, 0, 1e-300, 1e6),
        (0, 0, float("inf"), 1e6),
        (0, 0, float("nan"), 1e6),
        (0, 0, 20e3, 0.0),
        (0, 0, 20e3, float("nan")),
    ):
        raw = bytearray(good)
        head.pack_into(raw, 4, tick, index, rate_hz, tick_rate_hz, *head.unpack_from(good, 4)[4:])
        wrong.append((PROBES, bytes(raw)))
    notes = [
        (EVENTS, b'{"event":"note","tick":' + b"9" * 400 + b',"text":"x"}'),
        (EVENTS, b'{"event":"note","tick":3,"text":"\\ud800 half","tags":["\\udfff"]}'),
        (EVENTS, b'{"event":"note","tick":9007199254740991,"text":"late"}'),
        (STATUS, b'{"tick":1e400,"time_s":NaN}'),
        (EVENTS, b'{"event":"start","tick":true}'),
        (EVENTS, b"9" * 5000),
    ]
    items = [(PROBES, good), *wrong, *notes, (PROBES, encode_block(make_block(PROBES, 1)))]
    summary = record(
        RecordingSession(client, path, duration_s=1.0), client, play(client, [*items, list(generate_stream(1))[-1]])
    )
    assert (summary.reason, summary.error) == ("completed", "")
    assert (summary.malformed, summary.refused) == (5, len(wrong))
    assert "cannot be of this rig" in summary.remarks[0]
    assert (summary.rows, summary.lost) == ({PROBES: 400}, {})
    recording = Recording.open(path)
    assert recording.samples("probes").index.tolist() == list(range(400))
    kept = [item for item in items if item not in wrong]
    for key, more in ((PROBES, 0), (EVENTS, 1), (STATUS, 0)):
        found = [payload for _, payload in recording.payloads(key)]
        assert found[: len(found) - more] == [payload for each, payload in kept if each == key]


def test_stop_keeps_everything_received(path):
    client = ScriptedClient()
    session = RecordingSession(client, path)
    blocks = [(PROBES, encode_block(make_block(PROBES, number))) for number in range(200)]

    def act() -> None:
        for block in blocks:
            client.publish(*block)
        session.stop("interrupted by SIGINT")

    summary = record(session, client, act)
    assert (summary.reason, summary.rows[PROBES]) == ("interrupted by SIGINT", 40_000)


def test_a_rig_that_returns_with_the_same_run_continues_with_a_gap(path):
    client = ScriptedClient()
    items = list(generate_stream(40))
    third = len(items) // 3

    def act() -> None:
        for item in items[:third]:
            client.publish(*item)
        client.on_alive(False)
        time.sleep(0.1)
        client.on_alive(True)
        for item in items[2 * third :]:
            client.publish(*item)

    summary = record(RecordingSession(client, path), client, act)
    assert (summary.reason, summary.good) == ("completed", False)
    recording = Recording.open(path)
    assert recording.streams[PROBES].rows + summary.lost[PROBES] == 8000
    assert summary.lost[PROBES] > 0
    assert recording.streams[PROBES].lost == summary.lost[PROBES]
    assert any("restored" in remark for remark in summary.remarks)


def test_a_lost_rig_closes_the_file_well(path):
    client = ScriptedClient()

    def act() -> None:
        for item in list(generate_stream(10))[:-1]:
            client.publish(*item)
        client.on_alive(False)

    summary = record(RecordingSession(client, path), client, act)
    assert summary.reason == RIG_LOST
    assert summary.losses == ("data that the rig may have sent after 0.100 s, where it was lost",)
    recording = Recording.open(path)
    assert recording.complete
    assert recording.end_reason == RIG_LOST
    assert recording.streams[PROBES].rows == 2000


def test_the_end_event_counts_even_if_the_rig_has_ended(path):
    client = ScriptedClient()

    def act() -> None:
        client.on_alive(False)
        for item in generate_stream(3):
            client.publish(*item)

    assert record(RecordingSession(client, path), client, act).reason == "completed"


def test_a_finished_run_is_recognised_by_its_status(path):
    client = ScriptedClient()
    summary = record(
        RecordingSession(client, path),
        client,
        lambda: client.publish(STATUS, encode_document({"tick": 5, "time_s": 5e-6, "state": "ended"})),
    )
    assert summary.reason == "ended before the recording began"
    assert summary.rows == {}


def test_a_full_inbox_refuses_blocks_counts_them_and_leaves_a_gap(path, monkeypatch):
    client = ScriptedClient()
    session = RecordingSession(client, path, inbox_bytes=20_000)
    gate = threading.Event()
    real, done = RecordingWriter.take, []

    def slow(self, payload: Payload) -> None:
        gate.wait(PATIENCE_S)
        real(self, payload)
        done.append(payload)

    monkeypatch.setattr(RecordingWriter, "take", slow)
    blocks = [(PROBES, encode_block(make_block(PROBES, number))) for number in range(50)]

    def act() -> None:
        for block in blocks[:-1]:
            client.publish(*block)
        gate.set()
        quiet = 0
        while quiet < 100:  # data being written also takes space
            before = len(done)
            time.sleep(0.002)
            quiet = quiet + 1 if len(done) == before and not session.waiting else 0
        client.publish(*blocks[-1])
        client.publish(EVENTS, encode_document({"event": "end", "tick": 0, "time_s": 0.0, "reason": "completed"}))

    summary = record(session, client, act)
    assert summary.dropped > 30
    assert summary.lost == {PROBES: 200 * summary.dropped}
    assert summary.rows[PROBES] == 200 * (50 - summary.dropped)
    assert Recording.open(path).metadata["end"]["dropped_payloads"] == str(summary.dropped)


def test_a_disk_error_ends_the_session_with_the_written_part(path, monkeypatch):
    client = ScriptedClient()
    calls = [0]
    real = os.fsync

    def full(number: int) -> None:
        calls[0] += 1
        if calls[0] > 2:
            raise OSError(28, "No space left on device")
        real(number)

    monkeypatch.setattr(os, "fsync", full)
    session = RecordingSession(client, path)
    stop = threading.Event()

    def act() -> None:
        for number in range(1000):
            client.publish(PROBES, encode_block(make_block(PROBES, number)))
            if stop.wait(0.01):
                return

    thread = threading.Thread(target=act)
    thread.start()
    try:
        summary = session.run()
    finally:
        stop.set()
        thread.join()
    assert summary.reason == "disk error"
    assert len(summary.losses) == 1
    assert summary.losses[0].startswith("all data after")
    assert "No space left on device" in summary.error
    assert summary.path == path.with_name("run.mcap.part")
    assert not path.exists()
    assert Recording.open(summary.path).streams[PROBES].rows > 0


def test_heartbeats_report_the_recorders_progress(path):
    client = ScriptedClient()
    summary = record(
        RecordingSession(client, path, name="recorder-1"),
        client,
        play(client, list(generate_stream(10))),
    )
    assert summary.reason == "completed"
    assert {key for key, _ in client.reported} == {f"{CLIENTS}/recorder-1"}
    last = decode_document(client.reported[-1][1])
    assert (last["name"], last["received_index"], last["lost"]) == ("recorder-1", 2000, 0)


@pytest.mark.parametrize("duration_s", [0.0, -1.0, float("nan")])
def test_impossible_durations_are_refused(path, duration_s):
    with pytest.raises(InputError, match="duration_s must be above 0"):
        RecordingSession(ScriptedClient(), path, duration_s=duration_s)


def test_the_destination_is_checked_before_subscribing(path):
    path.write_text("precious")
    client = ScriptedClient()
    with pytest.raises(InputError, match="a new file"):
        RecordingSession(client, path)
    assert client.subscribed == []
    assert path.read_text() == "precious"


def test_without_a_rig_there_is_no_file(path):
    client = ScriptedClient()
    del client.replies[CATALOGUE]
    with pytest.raises(NoReplyError):
        RecordingSession(client, path).run()
    assert list(path.parent.iterdir()) == []


def test_the_output_file_is_named(path):
    client, triggers = ScriptedClient(), tuple(map(Trigger.parse, ("hammer", "disk_x>1", "disk_x<0")))
    assert RecordingSession(client, path).first_files == [path]
    parts = RecordingSession(client, path, limits=DiskLimits(rotate_s=1.0)).first_files
    captures = RecordingSession(client, path, capture=Capture(triggers)).first_files
    assert [file.name.removeprefix(path.stem) for file in (*parts, *captures)] == [
        *(".0000.mcap", ".hammer-001.mcap", ".disk_x-001.mcap")
    ]


def test_the_summary_of_triggers_describes_the_files(path):
    client = ScriptedClient()
    capture = Capture((Trigger.parse("note"), Trigger.parse("P_N>-1e9")), pre_s=0.1, post_s=0.2)
    items = list(generate_stream(100))
    note = encode_document({"event": "note", "tick": 500_000, "time_s": 0.5, "text": "now"})
    items.insert(len(items) // 2, (EVENTS, note))
    progress: list[Progress] = []
    session = RecordingSession(client, path, capture=capture, limits=DiskLimits(budget_mb=50.0))
    summary = record(session, client, play(client, items), progress)
    (file,) = summary.files
    kept = Recording.open(file).streams
    assert summary.rows[PROBES] == kept[PROBES].rows < 10_000
    assert summary.duration_s == pytest.approx(kept[PROBES].last_time_s - kept[PROBES].first_time_s)
    assert summary.received_s == pytest.approx(1.0, abs=0.01)
    assert summary.fired == 1
    assert summary.remarks == ("P_N is above -1e+09 N already; waiting until it has been below",)


def test_without_a_trigger_nothing_is_counted_as_recorded(path):
    client = ScriptedClient()
    session = RecordingSession(client, path, capture=Capture((Trigger.parse("hammer"),)))
    summary = record(session, client, play(client, list(generate_stream(50))))
    assert (summary.files, summary.fired, summary.duration_s, summary.rows) == ((), 0, 0.0, {})
    assert summary.received_s == pytest.approx(0.5, abs=0.01)


def test_rotation_and_triggers_together_are_refused_by_name(path):
    with pytest.raises(InputError, match=r"^rotate_mb must be omitted .* around triggers; received 5\.0$"):
        RecordingSession(
            ScriptedClient(), path, capture=Capture((Trigger.parse("hammer"),)), limits=DiskLimits(rotate_mb=5.0)
        )


def test_a_transport_error_leaves_a_finished_file(path, monkeypatch):
    client = ScriptedClient()

    def fail(key: str, callback) -> None:
        assert key == ALIVE
        raise RuntimeError("the session is closed")

    monkeypatch.setattr(client, "watch", fail)
    with pytest.raises(RuntimeError, match="the session is closed"):
        RecordingSession(client, path).run()
    assert Recording.open(path).end_reason == "failed: the session is closed"
