"""Generated blocks, events and status documents for everything that receives a rig's streams.

A valid stream is mixed in. None of it may be lost, nothing else may be accepted if it can be distinguished from it, and
the receiver must neither stop nor grow.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recorder.session
from drivers.daq import Daq
from drivers.link import LinkTimeoutError
from drivers.sources.rig import RigSource
from drivers.sources.samples import Samples, StreamEndedError
from recorder.contents.summary import Summary
from recorder.output.disk_limits import DiskLimits
from recorder.output.trigger import Capture, Trigger
from recorder.reader import Recording, join
from recorder.session import RecordingSession
from recorder.viewer import live
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import default_table
from rig.serve.stream_check import BlockValidator, Catalogue
from rig.serve.transport.memory import MemoryClient, MemoryServer
from rig.serve.transport.zenoh import ZenohClient, ZenohServer
from tests.hostile import input_count
from tests.processes import free_endpoint
from tests.unit.recorder_stream import TRUTH_COLUMNS, ScriptedClient, make_block, make_documents
from tests.waiting import until

pytestmark = [pytest.mark.wallclock, pytest.mark.timeout(7200)]
KEYS = [wire.sensor_key(group) for group in default_table().groups] + [wire.truth_key(table) for table in TRUTH_COLUMNS]
PROBES = wire.sensor_key("probes")
HEAD = struct.Struct("<qqddII")
ODD_NUMBERS = [0, 1, -1, 2, 255, 2**31, 2**32 - 1, 2**40, 2**52, 2**53, 2**62, 2**63 - 1, -(2**63), 10**15, 10**18]
ODD_RATES = [0.0, -1.0, 1e-300, 1e300, float("inf"), float("nan"), 1.0, 19_999.0, 20_000.5, 1e6, 2000.0]
ODD_VALUES: list[Any] = [
    None, True, -1, 0, 1.5, 1e300, 2**62, "", "x", "[/]", "\x1b[2J", "9" * 400, [], {}, [[]], {"a": []}, [1, "2", None],
    {"rig/sensors/probes": -1}, {"rig/sensors/probes": "7"}, {"rig/sensors/probes": 0}, "\u202e", ["tag", 3], "end",
]  # fmt: skip
FIELDS = ("event", "tick", "time_s", "wall_s", "reason", "rows", "text", "tags", "id", "command", "request", "from")
NAMES = ("start", "command", "hammer", "speed", "note", "warning", "end")


class Truth:
    """Valid blocks of the rig, cheap to generate: those of the first instant, renumbered."""

    def __init__(self) -> None:
        self._first = {key: bytearray(wire.encode_block(make_block(key, 0))) for key in KEYS}
        self.rows = {key: len(make_block(key, 0).values) for key in KEYS}

    def payload(self, key: str, number: int) -> bytes:
        made = bytearray(self._first[key])
        struct.pack_into("<qq", made, 4, number * 10_000, number * self.rows[key])
        return bytes(made)


def forge_message(rng: np.random.Generator, truth: Truth, number: int, near: dict[str, set[int]]) -> tuple[str, bytes]:
    """Return key and payload of a message that the rig did not send, before its block `number` of each stream.

    Two forged blocks that follow each other and are both plausible look like a restarted rig. `near` holds the numbers
    of
    those since the last valid block, so that this does not occur.
    """
    key, kind = str(rng.choice(KEYS)), int(rng.integers(14))
    payload = bytearray(truth.payload(key, number))
    tick, index, rate_hz, tick_rate_hz, columns, size = HEAD.unpack_from(payload, 4)
    rows = truth.rows[key]
    if kind == 0:  # one field of the header
        fields: list[Any] = [tick, index, rate_hz, tick_rate_hz, columns, size]
        place = int(rng.integers(6))
        other = ODD_RATES[rng.integers(len(ODD_RATES))] if place in (2, 3) else ODD_NUMBERS[rng.integers(15)]
        fields[place] = other if place < 4 else abs(int(other)) % 2**32
        HEAD.pack_into(payload, 4, *fields)
        if tuple(fields) == (tick, index, rate_hz, tick_rate_hz, columns, size):
            payload.pop()
    elif kind == 1:  # other columns, complete
        columns = int(rng.choice([1, 2, 3, 5, 7, 40]))
        columns += columns == HEAD.unpack_from(payload, 4)[4]
        dtype = np.int32 if key.startswith(wire.SENSORS) else np.float64
        block = wire.Block(tick, index, rate_hz, tick_rate_hz, np.ones((rows, columns), dtype))
        return key, wire.encode_block(block)
    elif kind in (2, 3):  # far away, and consistent in itself
        step = int(rng.choice([1, -1])) * int(10 ** rng.uniform(0, 12))
        far = max(0, number + step + (step > 0))
        if far == number or is_crowded(near[key], far):
            return key, b"\x00"
        struct.pack_into("<qq", payload, 4, far * 10_000, far * rows)
    elif kind == 4:  # repeated
        past = max(0, number - int(rng.integers(1, 50)))
        return key, truth.payload(key, past) if past < number and not is_crowded(near[key], past) else b"\x00"
    elif kind == 5:  # of another kind
        dtype = np.float64 if key.startswith(wire.SENSORS) else np.int32
        values = np.ones((rows, columns), dtype)
        return key, wire.encode_block(wire.Block(tick, index, rate_hz, tick_rate_hz, values))
    elif kind == 6:
        return key, bytes(payload[: rng.integers(len(payload))])
    elif kind == 7:
        return key, rng.bytes(int(rng.integers(200)))
    elif kind == 8:  # bits of the header, but enough of the time that it is implausible
        for place in rng.integers(4, 44, size=3):
            payload[place] ^= 1 << int(rng.integers(8))
        payload[4 + 3] ^= 0x40
    elif kind == 9:
        name = f"rig/{rng.choice(['sensors', 'truth'])}/x{rng.integers(10**6)}"
        return name, bytes(payload)
    elif kind == 10:
        block = wire.Block(tick, index, rate_hz, tick_rate_hz, np.ones((0, columns), np.int32))
        return key, wire.encode_block(block)
    elif kind == 11:
        rate_hz = float(rng.choice([1.0, 1000.0, 19_999.0, 40_000.0]))
        HEAD.pack_into(payload, 4, tick, index, rate_hz, tick_rate_hz, columns, size)
    elif kind == 12:
        return wire.EVENTS, make_odd_event(rng)
    else:
        document = {name: odd(rng) for name in ("state", "tick", "time_s", "clients", "warnings")}
        if document["state"] == "ended":
            document["state"] = None
        return wire.STATUS, json.dumps(document).encode()
    return key, bytes(payload)


def is_crowded(near: set[int], number: int) -> bool:
    """Return whether a block would continue another forged one, or exceed the limit of forged blocks."""
    if len(near) > 8 or near & {number - 1, number, number + 1}:
        return True
    near.add(number)
    return False


def odd(rng: np.random.Generator) -> Any:
    return ODD_VALUES[rng.integers(len(ODD_VALUES))]


def make_odd_event(rng: np.random.Generator) -> bytes:
    """Return an event with an invalid field; an `end` never has a form that could be the rig's."""
    document: dict[str, Any] = {"event": str(rng.choice(NAMES)), "tick": 5, "time_s": 5e-6}
    for name in rng.choice(FIELDS, size=3):
        document[str(name)] = odd(rng)
    if document["event"] == "end":
        document["reason"] = 7
    if rng.random() < 0.1:
        return b'{"event":' + b"[" * int(rng.integers(2000)) + b"1"
    return json.dumps(document).encode()


def generate_mixed(count: int, seed: int) -> Iterator[tuple[str, bytes, bool]]:
    """Yield `count` forged payloads among valid ones as (key, payload, whether valid), and the valid end."""
    truth, rng = Truth(), np.random.default_rng(seed)
    number, sent = 0, 0
    # The first block of a stream has no predecessor to compare a forged one with.
    while sent < count or number < 5:
        for key in KEYS:
            yield key, truth.payload(key, number), True
        number += 1
        near: dict[str, set[int]] = {key: {number - 1} for key in KEYS}
        for _ in range(int(rng.integers(0, 30)) if sent < count else 0):
            yield *forge_message(rng, truth, number, near), False
            sent += 1
    rows = {key: number * truth.rows[key] for key in KEYS}
    end = {"event": "end", "tick": number * 10_000, "time_s": number * 0.01, "reason": "completed", "rows": rows}
    yield wire.EVENTS, wire.encode_document(end), True


def record_fed(
    session: RecordingSession, client: ScriptedClient, count: int, seed: int
) -> tuple[Summary, dict[str, list[int]]]:
    """Record what is fed from another thread; return the summary, and the row numbers of the valid blocks."""
    true: dict[str, list[int]] = {key: [] for key in KEYS}

    def feed() -> None:
        while wire.STATUS not in client.subscribed:
            time.sleep(0.002)
        for key, payload, is_true in generate_mixed(count, seed):
            while session.waiting > 2000:
                time.sleep(0.001)
            client.publish(key, payload)
            if is_true and key in true:
                true[key].append(struct.unpack_from("<q", payload, 12)[0])

    thread = threading.Thread(target=feed)
    thread.start()
    try:
        return session.run(), true
    finally:
        thread.join()


@pytest.fixture(autouse=True)
def _short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder.session, "QUIET_S", 0.05)


@pytest.mark.parametrize("limits", [DiskLimits(), DiskLimits(rotate_s=1.0)], ids=["one file", "several files"])
def test_a_recording_contains_only_valid_rows(tmp_path: Path, limits: DiskLimits) -> None:
    client = ScriptedClient()
    session = RecordingSession(client, tmp_path / "run.mcap", limits=limits)
    summary, true = record_fed(session, client, input_count(3000), seed=1)
    assert (summary.reason, summary.error, summary.losses) == ("completed", "", ())
    assert summary.refused > input_count(3000) / 3
    recording = join(summary.files)
    assert recording.complete
    for key in KEYS:
        stream = recording.streams[key]
        assert (stream.rows, stream.lost) == (summary.rows[key], 0), key
    for key, indexes in true.items():
        found = [struct.unpack_from("<q", p, 12)[0] for _, p in recording.payloads(key) if is_block(key, p)]
        assert found == indexes, key


def is_block(key: str, payload: bytes) -> bool:
    try:
        wire.decode_block(payload, wire.get_schema(key) or "")
    except ValueError:
        return False
    return True


def test_captures_end_and_contain_only_valid_rows(tmp_path: Path) -> None:
    client = ScriptedClient()
    triggers = tuple(map(Trigger.parse, ("note", "hammer", "P_N>1e9", "speed<-1e9")))
    capture = Capture(triggers, pre_s=0.2, post_s=0.2, longest_s=2.0, again="ignore")
    session = RecordingSession(client, tmp_path / "run.mcap", capture=capture)
    summary, _ = record_fed(session, client, input_count(3000), seed=2)
    assert (summary.reason, summary.error, summary.losses) == (
        "completed" if summary.reason == "completed" else "1000 captures made",
        "",
        (),
    )
    assert summary.files
    for number, file in enumerate(summary.files):
        recording = Recording.open(file)
        assert recording.complete
        for key in KEYS:
            found = [
                wire.decode_block(p, wire.get_schema(key) or "").index
                for _, p in recording.payloads(key)
                if is_block(key, p)
            ]
            # A capture around an earlier event lacks some streams.
            assert found == list(range(found[0], found[-1] + 1, Truth().rows[key])) if found else number == 0, key


def read_available(daq: Daq) -> Samples | None:
    """Return what can be read without waiting."""
    try:
        return daq.read(timeout_s=0.0)
    except (LinkTimeoutError, StreamEndedError):
        return None


def test_a_daq_reads_on_and_gets_the_true_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    count, server = input_count(3000), MemoryServer(cache=10)
    for key, document in make_documents().items():
        server.answer(key, lambda _, document=document: wire.encode_document(document))
    server.announce()
    daq = Daq(RigSource(MemoryClient(server)), channels=["disk_x", "P_N"], buffer_s=1e6)
    block = make_block(PROBES, 0)
    expected = default_table().groups["probes"].engineering(block.values)[:, 0]
    rows = 0
    for key, payload, _ in generate_mixed(count, seed=3):
        server.publish(key, payload)
        while (samples := read_available(daq)) is not None:
            assert (samples.index, samples.gap) == (rows, 0)
            np.testing.assert_array_equal(samples["disk_x"], expected)
            rows += len(samples)
    with pytest.raises(StreamEndedError, match=r"^the rig's run has ended: completed$"):
        daq.read()
    assert (daq.lost, daq.gaps, daq.unmatched) == ({"probes": 0, "forces": 0}, [], 0)
    daq.close()


class CountingPainter:
    """A painter that only counts frames."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.rows = 0
        self.now_s = 0.0

    def add(self, name: str, times_s: np.ndarray, values: np.ndarray) -> None:
        self.rows += len(values)
        assert values.shape[1] == len(default_table().groups[name].channels)

    def add_truth(self, times_s: np.ndarray, values: np.ndarray) -> None:
        assert times_s.shape == values.shape

    def add_event(self, event: dict[str, Any]) -> None:
        live.Painter.add_event(self, event)  # type: ignore[arg-type]

    _windows: list[tuple[float, float]] = []  # noqa: RUF012
    _marks = type("Marks", (), {"take": lambda *_: None})()

    def note(self, time_s: float, text: str, *, level: str = "INFO") -> None:
        assert np.isfinite(time_s)

    def frame(self, name: str) -> None:
        pass


def test_the_live_view_draws_the_true_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    client = ScriptedClient()
    described = live.Described(Catalogue.read(make_documents()[wire.CATALOGUE]), None, ("penetration", "normal_force"))  # type: ignore[arg-type]
    still = CountingPainter()
    with monkeypatch.context() as patch:
        patch.setattr(live, "Painter", lambda *_, **__: still)
        view = live.LiveView(
            client, type("Canvas", (), {"clock": type("Clock", (), {"mark": lambda *_: None})()})(), described
        )
    rows = 0
    for number, (key, payload, is_true) in enumerate(generate_mixed(input_count(3000), seed=4)):
        view.take(key, payload)
        if is_true and key.startswith(wire.SENSORS):
            rows += len(wire.decode_block(payload, wire.SAMPLE_SCHEMA).values)
        if number % 500 == 0:
            view.take_in()
    view.take_in()
    assert (view.received, view.lost, still.rows) == (rows, 0, rows)
    assert view.ended == "completed"
    assert view.malformed > input_count(3000) / 3


def test_a_jump_is_accepted_only_with_a_following_block() -> None:
    truth = Truth()
    for numbers, accepted, refused in (
        ([0, 1, 5, 6], [0, 1, 5, 6], 0),  # a gap
        ([0, 1, 5, 9, 10], [0, 1, 5, 9, 10], 0),  # two gaps in sequence
        ([0, *range(1, 30, 2)], [0, 1, *range(3, 15, 2)], 0),  # every other block; detection takes longer
        ([7, 8, 0, 1, 2], [7, 8, 0, 1, 2], 0),  # restarted
        ([0, 1, 2**40, 2, 3], [0, 1, 2, 3], 1),  # implausible number
        ([0, 1, 900, 2, 3], [0, 1, 2, 3], 1),
        ([5, 6, 5, 7, 8], [5, 6, 7, 8], 1),  # repeated
        ([5, 6, 900, 3, 900, 7, 8], [5, 6, 7, 8], 3),
    ):
        intake = BlockValidator(Catalogue.read(make_documents()[wire.CATALOGUE]))
        found = []
        for number in numbers:
            rows = truth.rows[PROBES]
            found += (
                intake.take(PROBES, truth.payload(PROBES, number))
                if number < 2**39
                else intake.take(
                    PROBES,
                    wire.encode_block(
                        wire.Block(number * 10_000, number * rows, 2e4, 1e6, np.ones((rows, 4), np.int32))
                    ),
                )
            )
        assert [each.block.index // truth.rows[PROBES] for each in found] == accepted, numbers
        assert intake.refused == refused, numbers


@pytest.mark.parametrize(
    "change",
    [{"table": 1}, {"table": {"groups": 3}}, {"tick_rate_hz": 0}, {"tick_rate_hz": "x"}, {"truth": []}, {"table": None},
     {"truth": {"state": {"rate_hz": -1, "columns": []}}}],
)  # fmt: skip
def test_recorder_and_daq_refuse_an_invalid_catalogue_in_one_line(tmp_path: Path, change: dict[str, Any]) -> None:
    client = ScriptedClient()
    client.replies[wire.CATALOGUE] = wire.encode_document({**make_documents()[wire.CATALOGUE], **change})
    with pytest.raises(InputError, match="catalogue"):
        RecordingSession(client, tmp_path / "run.mcap").run()
    with pytest.raises(InputError, match="catalogue"):
        RecordingSession(client, tmp_path / "run.mcap", capture=Capture((Trigger.parse("note"),))).run()
    with pytest.raises(InputError, match="catalogue"):
        Daq(RigSource(client))
    assert list(tmp_path.iterdir()) == []


def test_messages_of_another_session_are_skipped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    import zenoh

    # With access control, the default, the block is refused and none has to be skipped.
    monkeypatch.setattr("rig.serve.transport.zenoh.rules", lambda _: {"enabled": False, "default_permission": "allow"})
    endpoint, truth = free_endpoint(), Truth()
    with ZenohServer(endpoint) as server:
        server.publish(PROBES, truth.payload(PROBES, 0))
        with ZenohClient(endpoint) as client:
            got: dict[bool, list[bytes]] = {True: [], False: []}
            events: list[bytes] = []
            for lossless, payloads in got.items():
                client.subscribe(PROBES, lambda _, p, payloads=payloads: payloads.append(p), lossless=lossless)
            client.subscribe(wire.EVENTS, lambda _, p: events.append(p), history=True)
            # Until both subscriptions are active, blocks that the lossy one misses are not recovered.
            number = 0

            def reached() -> bool:
                nonlocal number
                number += 1
                server.publish(PROBES, truth.payload(PROBES, number))
                return all(got.values())

            until(reached, every_s=0.05)
            begun = number + 1
            until(lambda: all(payloads[-1] == truth.payload(PROBES, number) for payloads in got.values()))
            for payloads in got.values():
                payloads.clear()
            config = zenoh.Config()
            for name, value in (
                ("mode", "client"), ("connect/endpoints", [f"tcp/{endpoint}"]), ("scouting/multicast/enabled", False),
            ):  # fmt: skip
                config.insert_json5(name, json.dumps(value))
            with zenoh.open(config) as forger:
                publisher = forger.declare_publisher(PROBES)
                for number in range(begun, begun + 75):
                    server.publish(PROBES, truth.payload(PROBES, number))
                    publisher.put(b"forged")
                    forger.put(PROBES, truth.payload(PROBES, 10**6 + number))
                    forger.put(wire.EVENTS, b'{"event":"end","reason":"forged","rows":{}}')
                    forger.put(f"{PROBES}/@adv/pub/{forger.zid()}/1/_", b"\x07\x00\x00\x00")
                    time.sleep(0.002)
                sent = [truth.payload(PROBES, number) for number in range(begun, begun + 75)]
                until(lambda: all(len(payloads) >= 75 for payloads in got.values()) and client.foreign >= 4 * 75)
            assert got == {True: sent, False: sent}
            assert events == []
            assert client.foreign >= 4 * 75
            assert client.rig is not None
