"""The gateway between a rig in this process and python-can's virtual bus."""

from __future__ import annotations

import itertools
import os
import select
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import can  # noqa: TID253 - the subject
import numpy as np
import pytest

from drivers.can import dbc
from drivers.can.gateway import Gateway
from drivers.can.schedule import Schedule
from drivers.can.signals import (
    ABSENT,
    LIMITS,
    CommandKind,
    Field,
    Result,
    RigState,
    command_frame,
    default_messages,
)
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import default_table
from rig.run.commands.table import HammerCommand, SpeedCommand, check_command
from rig.serve.health import IncreaseWarning
from rig.serve.pacing import FreeRun, RealTime
from rig.serve.service import Service
from rig.serve.transport.fanout import Fanout
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.unit.service_fake import GROUPS, FakeSimulation
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.wallclock
TABLE = default_messages()
BLOCK = 10_000
_channels = itertools.count()


class FakeChannels(FakeSimulation):
    """The simulation that counts, with the rig's channel table or a part of it."""

    groups = tuple(GROUPS)

    def catalogue(self) -> dict[str, Any]:
        return {**super().catalogue(), "table": default_table().select_groups(self.groups).model_dump(mode="json")}

    def advance(self, ticks: int) -> Any:
        frame = super().advance(ticks)
        frame = replace(frame, samples={name: frame.samples[name] for name in self.groups})
        return frame


class Tap:
    """A node that reads everything, on a separate thread."""

    def __init__(self, channel: str) -> None:
        self.bus = can.Bus(channel, interface="virtual", ignore_config=True)
        self.frames: list[can.Message] = []
        self._stop = False
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        while not self._stop:
            if (message := self.bus.recv(0.05)) is not None:
                self.frames.append(message)

    def of(self, name: str) -> list[bytes]:
        return [bytes(row.data) for row in list(self.frames) if row.arbitration_id == TABLE.by_name[name].identifier]

    def decoded(self, name: str) -> list[dict[str, int]]:
        return [TABLE.by_name[name].decode(data) for data in self.of(name)]

    def send(self, identifier: int, data: bytes, **settings: Any) -> None:
        self.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False, **settings))

    def ask(self, identifier: int, data: bytes) -> dict[str, int]:
        """Send a command and wait for the next acknowledge."""
        before = len(self.of("Acknowledge"))
        self.send(identifier, data)
        until(lambda: len(self.of("Acknowledge")) > before)
        return self.decoded("Acknowledge")[before]

    def close(self) -> None:
        self._stop = True
        self._thread.join()
        self.bus.shutdown()


class Setup:
    def __init__(
        self,
        simulation: FakeSimulation,
        clock: Any,
        schedule: Schedule,
        bus: Any,
        tap: Tap,
        *,
        block_ticks: int,
        **options: Any,
    ) -> None:
        self.server = MemoryServer(cache=0)
        self.tap = tap
        everywhere = Fanout(
            [self.server], figures=lambda: self.gateway.figures(), warnings=lambda: self.gateway.warnings()
        )
        self.service = Service(simulation, everywhere, clock, block_ticks=block_ticks)
        self.client = MemoryClient(self.server)
        self.service.prepare()
        self.bus = bus
        self.gateway = Gateway(self.client, bus, schedule, **options)
        self.summary: dict[str, Any] = {}
        self.thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        self.summary = self.service.run()

    def start(self) -> None:
        self.thread.start()

    def join(self) -> None:
        self.thread.join(timeout=PATIENCE_S)
        assert not self.thread.is_alive()


@contextmanager
def rig(
    simulation: FakeSimulation,
    *,
    schedule: Schedule | None = None,
    paced: bool = False,
    bus: Any = None,
    block_ticks: int = BLOCK,
    **options: Any,
) -> Iterator[Setup]:
    channel = f"gateway-{next(_channels)}"
    own = bus or can.Bus(channel, interface="virtual", ignore_config=True)
    tap = Tap(channel)
    try:
        clock = RealTime() if paced else FreeRun()
        settings = {"block_ticks": block_ticks, "paced": paced, **options}
        setup = Setup(simulation, clock, schedule or Schedule(1000, 10_000), own, tap, **settings)
        with setup.gateway:
            try:
                yield setup
            finally:
                setup.service.stop()
                if setup.thread.ident is not None:
                    setup.join()
    finally:
        tap.close()
        own.shutdown()


def samples_of(tap: Tap, name: str) -> tuple[np.ndarray, np.ndarray]:
    samples = TABLE.by_name[name].samples
    assert samples is not None
    return samples.unpack(np.frombuffer(b"".join(tap.of(name)), np.uint8).reshape(-1, TABLE.by_name[name].length))


@pytest.mark.parametrize("paced", [False, True])
def test_every_sample_is_sent_in_both_layouts(paced: bool) -> None:
    with rig(FakeChannels(duration_s=0.4), paced=paced) as setup:
        setup.start()
        setup.join()
        last = {"Probes": 800, "Drive": 400, "Hammer": 200, "Samples_1": 400, "Samples_5": 400}
        until(lambda: all(len(setup.tap.of(name)) == count for name, count in last.items()))
    for message in (*TABLE.fd, *TABLE.classic):
        samples = message.samples
        assert samples is not None
        numbers, values = samples_of(setup.tap, message.name)
        step = 2 if message.fd else 20
        assert np.array_equal(numbers, np.arange(len(numbers)) * samples.rows * (step if message.fd else 1))
        # The fake's counts are the number of the sample.
        expected = np.arange(0, 8000, step)[:, None] >> (0 if message.fd else 8)
        assert np.array_equal(values, np.broadcast_to(expected, values.shape))
    figures = setup.gateway.figures()
    assert figures["can_dropped"] == 0
    assert figures["can_frames"] == len(setup.tap.frames)
    assert [row["index"] for row in setup.tap.decoded("Sync")] == [0, 2000, 4000, 6000]
    assert [row["time"] for row in setup.tap.decoded("Sync")] == [0, 100_000, 200_000, 300_000]
    events = [TABLE.by_name["Event"].signals[0].choices[row["event"]] for row in setup.tap.decoded("Event")]  # type: ignore[index]
    assert events == ["start", "end"]
    until(lambda: setup.tap.decoded("Heartbeat")[-1]["state"] == RigState.ENDED)
    names = [TABLE.by_identifier[row.arbitration_id].name for row in setup.tap.frames]
    last_beat = len(names) - 1 - names[::-1].index("Heartbeat")
    last_sample = max(n for n, name in enumerate(names) if TABLE.by_name[name].samples is not None)
    assert last_sample < last_beat


def test_slow_messages_contain_the_status_and_the_decimation() -> None:
    with rig(FakeChannels(duration_s=None), paced=True) as setup:
        setup.start()
        until(lambda: len(setup.tap.of("Status")) >= 3)
        # A run that is delayed while it begins is preparing for more than one heartbeat.
        before = len(setup.tap.of("Heartbeat"))
        until(lambda: len(setup.tap.of("Heartbeat")) > before + 1)
    database = dbc.database()
    beats = [database.decode_message("Heartbeat", data) for data in setup.tap.of("Heartbeat")]
    assert [int(row["beat"]) for row in beats] == list(range(1, len(beats) + 1))
    assert str(beats[before + 1]["state"]) == "running"
    rates = setup.tap.decoded("Rates")[1]
    assert (rates["rate"], rates["fd_step"], rates["classic_step"]) == (20_000, 2, 20)
    assert rates["latency"] * 10 >= 10_000
    status = database.decode_message("Status", setup.tap.of("Status")[2])
    assert status["spin"] == pytest.approx(6.2)


def test_edges_keep_the_fraction_of_their_microsecond() -> None:
    with rig(FakeChannels(duration_s=None), paced=True) as setup:
        block = wire.Block(1000, 7, 1e6, 1e6, np.array([[12.25], [2_000_000.5]]))
        setup.gateway.unpack(wire.EDGES, wire.encode_block(block))
        setup.gateway.outbox.send_due()
        until(lambda: len(setup.tap.of("Keyphasor")) == 2)
    found = setup.tap.decoded("Keyphasor")
    assert [row["number"] for row in found] == [7, 8]
    assert [row["time"] + row["fraction"] / 65536 for row in found] == [1012.25, 2_001_000.5]


def test_absent_channels_are_marked() -> None:
    class Part(FakeChannels):
        groups = ("forces", "hammer")

    with rig(Part(duration_s=0.05)) as setup:
        setup.start()
        setup.join()
        until(lambda: len(setup.tap.of("Samples_5")) == 50 and len(setup.tap.of("Hammer")) == 25)
    assert not setup.tap.of("Probes")
    assert not setup.tap.of("Samples_1")
    clock, sent = setup.tap.decoded("Clock")[0], {frame.arbitration_id for frame in setup.tap.frames}
    for layout in ("fd", "classic"):
        found = sum(row.identifier in sent for row in getattr(TABLE, layout) if row.samples)
        assert clock[f"{layout}_messages"] == found > 1
    _, values = samples_of(setup.tap, "Samples_2")
    assert set(values[:, 0]) == {ABSENT}
    assert set(values[:, 1]) == {0, 1, 2, 3}


def test_a_gap_of_the_stream_loses_whole_frames_and_is_counted() -> None:
    with rig(FakeChannels(duration_s=None), schedule=Schedule(None, 10_000)) as setup:
        for index in (0, 200, 430):
            values = np.repeat(np.arange(index, index + 200, dtype=np.int32)[:, None], 4, axis=1)
            block = wire.Block(50 * index, index, 20_000.0, 1e6, values)
            setup.gateway.unpack(wire.sensor_key("probes"), wire.encode_block(block))
        setup.gateway.outbox.send_due()
        until(lambda: len(setup.tap.of("Probes")) == 60)
        assert setup.gateway.figures()["can_dropped"] == 3
    numbers, values = samples_of(setup.tap, "Probes")
    assert np.array_equal(numbers, [*range(0, 400, 10), *range(430, 630, 10)])
    assert np.array_equal(values[::5, 0], numbers)


class RefusingBus(can.BusABC):
    """A bus that refuses frames, or is slow."""

    def __init__(self, *, seconds: float = 0.0, refuse: bool = False) -> None:
        self.seconds, self.refuse = seconds, refuse
        self.taken: list[tuple[int, bytes]] = []
        super().__init__("stubborn")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        time.sleep(self.seconds)
        if self.refuse:
            raise can.CanOperationError("transmit buffer full")
        self.taken.append((msg.arbitration_id, bytes(msg.data)))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        time.sleep(min(timeout or 0.05, 0.05))
        return None, False


def test_a_stalled_bus_loses_the_oldest_blocks_and_does_not_slow_the_rig() -> None:
    bus = RefusingBus(seconds=0.05)
    with rig(FakeChannels(duration_s=1.0), paced=True, bus=bus, queue_seconds=0.1) as setup:
        setup.start()
        setup.join()
        assert setup.summary["reason"] == "completed"
        assert setup.summary["queue"]["dropped"] == 0
        # A frame takes this bus 50 ms: 100 blocks that wait for one each would take 5 s in place of 1 s.
        assert setup.summary["real_time_factor"] > 0.4
        assert setup.gateway.blocks_dropped > 50
        bus.seconds = 0.0
        setup.gateway.close()


def test_blocks_that_find_no_room_never_take_the_place_of_an_event(monkeypatch: pytest.MonkeyPatch) -> None:
    documents, probes = [wire.EVENTS, wire.STATUS, wire.FAULTS, wire.BLOCK], wire.sensor_key("probes")
    with rig(FakeChannels(duration_s=None), paced=True, bus=RefusingBus()) as setup:
        unpacked: list[str] = []
        begun, may_go_on = threading.Event(), threading.Event()

        def unpack(key: str, _: bytes) -> None:
            begun.set()
            may_go_on.wait()
            unpacked.append(key)

        monkeypatch.setattr(setup.gateway, "unpack", unpack)
        setup.server.publish(probes, b"")
        begun.wait()
        for key in (*documents, *[probes] * 1000):
            setup.server.publish(key, b"")
        assert setup.gateway.blocks_dropped > 900
        may_go_on.set()
        until(lambda: set(documents) <= set(unpacked))


def test_frames_refused_by_the_bus_are_counted() -> None:
    with rig(FakeChannels(duration_s=0.6), paced=True, bus=RefusingBus(refuse=True)) as setup:
        setup.start()
        setup.join()
    assert setup.gateway.outbox.sent == 0
    # Samples of 0.6 s, sync and events; status and the like.
    assert 12_500 * 0.6 + 6 + 2 <= setup.gateway.dropped <= 12_500 * 0.6 + 30


@pytest.mark.parametrize("refuse", [False, True])
def test_future_frames_do_not_keep_a_closed_gateway_busy(refuse: bool) -> None:
    before = set(threading.enumerate())
    with rig(FakeChannels(duration_s=None), paced=True, bus=RefusingBus(refuse=refuse)) as setup:
        for index in (0, 10**9):
            # The number of its first row says when it is due, in 14 hours.
            block = wire.Block(50 * (index % 1000), index, 20_000.0, 1e6, np.zeros((200, 4), np.int32))
            setup.gateway.unpack(wire.sensor_key("probes"), wire.encode_block(block))
        setup.gateway.close()
        until(lambda: not any(each.name == "can gateway sends" for each in set(threading.enumerate()) - before))
        # At least 20 frames of each block.
        assert setup.gateway.outbox.dropped >= (40 if refuse else 20)


def test_frames_without_room_are_sent_later_in_order() -> None:
    bus = RefusingBus(refuse=True)
    with rig(FakeChannels(duration_s=0.5), paced=True, bus=bus, schedule=Schedule(None, 10_000)) as setup:
        setup.start()
        until(lambda: setup.gateway.outbox.waiting > 1000)
        bus.refuse = False
        setup.join()
    assert setup.gateway.dropped == 0
    probes = TABLE.by_name["Probes"]
    numbers = [probes.decode(data)["index"] for identifier, data in bus.taken if identifier == probes.identifier]
    assert numbers == list(range(0, 10_000, 10))
    # Neither replies nor the status wait for samples.
    assert bus.taken[0][0] >= 0x700


def test_drops_are_a_warning_in_the_status_and_one_event_each_time_while_they_happen() -> None:
    bus = RefusingBus()
    now = 0.0
    with rig(FakeChannels(duration_s=None), paced=True, bus=bus) as setup:
        setup.gateway.dropping = IncreaseWarning("CAN: {} frames were dropped", clock=lambda: now)
        replies = []
        setup.client.subscribe(wire.EVENTS, lambda _, payload: replies.append(wire.decode_document(payload)))
        setup.start()

        def warned() -> list[str]:
            return [text for text in setup.service.status()["warnings"] if "frames were dropped" in text]

        def over() -> bool:
            nonlocal now
            now += 10.0
            return not warned()

        until(lambda: len(bus.taken) > 100)
        for round_ in range(2):
            assert warned() == []
            bus.refuse = True
            until(lambda: bool(warned()))
            before = setup.gateway.dropped
            until(lambda: setup.service.status()["congestion"].get("can_dropped", 0) > before)  # noqa: B023
            bus.refuse = False
            until(lambda: setup.gateway.outbox.waiting == 0)
            warned()
            until(over)
            assert len([row for row in replies if "frames were dropped" in row.get("text", "")]) == round_ + 1


def test_a_run_without_the_clock_waits_for_the_bus() -> None:
    bus = RefusingBus(seconds=2e-5)
    with rig(FakeChannels(duration_s=1.0), bus=bus) as setup:
        setup.start()
        setup.join()
        expected = 7500 + 5000 + 10
        until(lambda: len(bus.taken) >= expected)
        assert setup.gateway.figures()["can_dropped"] == 0
        assert setup.gateway.blocks_dropped == 0


def test_a_hammer_pulse_is_acknowledged_with_its_time() -> None:
    with rig(FakeChannels(duration_s=None), paced=True) as setup:
        setup.start()
        until(lambda: bool(setup.tap.of("Probes")))
        reply = setup.tap.ask(*command_frame(CommandKind.HAMMER, 1, force_n=100.0, duration_ms=5.0))
        assert (reply["counter"], reply["result"]) == (1, Result.ACCEPTED)
        until(lambda: any(row["event"] == 3 for row in setup.tap.decoded("Event")))
        pulse = next(row for row in setup.tap.decoded("Event") if row["event"] == 3)
        # The fake executes it at the start of the next block.
        assert pulse["time"] == reply["time"]
        assert reply["time"] % BLOCK == 0
        until(lambda: any(row["counter"] == 1 for row in setup.tap.decoded("Heartbeat")))


def test_an_acknowledge_does_not_wait_for_the_end_of_a_block() -> None:
    with rig(FakeChannels(duration_s=None), paced=True, block_ticks=500_000) as setup:
        setup.start()
        until(lambda: bool(setup.tap.of("Probes")))
        commands = [command_frame(CommandKind.SPEED, counter, speed_hz=6.2) for counter in range(1, 11)]
        times = [setup.tap.ask(*command)["time"] for command in commands]
    # Otherwise each would wait for a separate block; on a busy machine several blocks pass meanwhile.
    assert len(set(times)) < len(commands)


def test_refusals_name_their_reason_and_are_counted() -> None:
    with rig(FakeChannels(duration_s=None), paced=True) as setup:
        setup.start()
        until(lambda: bool(setup.tap.of("Probes")))
        identifier, good = command_frame(CommandKind.HAMMER, 1, force_n=100.0, duration_ms=5.0)
        assert setup.tap.ask(identifier, good[:7] + b"\0")["result"] == Result.BAD_CHECKSUM
        assert setup.tap.ask(identifier, good[:7])["result"] == Result.BAD_LENGTH
        assert setup.tap.ask(identifier, good)["result"] == Result.ACCEPTED
        assert setup.tap.ask(identifier, good)["result"] == Result.STALE_COUNTER
        reply = setup.tap.ask(*command_frame(CommandKind.HAMMER, 2, force_n=5000.0, duration_ms=5.0))
        assert (reply["result"], reply["field"], reply["limit"]) == (Result.OUT_OF_RANGE, 1, 10_000)
        # The refusal uses up the number.
        assert (
            setup.tap.ask(*command_frame(CommandKind.HAMMER, 2, force_n=50.0, duration_ms=5.0))["result"]
            == Result.STALE_COUNTER
        )
        assert dict(setup.gateway.commands.refused) == {
            "bad_checksum": 1, "bad_length": 1, "stale_counter": 2, "out_of_range": 1,
        }  # fmt: skip
        assert setup.gateway.commands.accepted == 1
        until(lambda: any(row["refused"] == 5 for row in setup.tap.decoded("Status")))


@pytest.mark.parametrize(
    ("kind", "values", "field", "limit"),
    [
        (CommandKind.HAMMER, {"force_n": 0.5, "duration_ms": 5.0}, Field.FORCE, 1.0),
        (CommandKind.HAMMER, {"force_n": 1000.1, "duration_ms": 5.0}, Field.FORCE, 1000.0),
        (CommandKind.HAMMER, {"force_n": 10.0, "duration_ms": 0.25}, Field.DURATION, 0.5),
        (CommandKind.HAMMER, {"force_n": 10.0, "duration_ms": 60.0}, Field.DURATION, 50.0),
        (CommandKind.SPEED, {"speed_hz": 5000.0}, Field.SPEED, 61.5),
    ],
)
def test_a_refusal_names_the_exceeded_limit(kind: CommandKind, values: Any, field: Field, limit: float) -> None:
    class Checked(FakeChannels):
        """Refuses as the rig's own simulation does."""

        def parameters_document(self) -> dict[str, Any]:
            return {"set": "fake", "title": "", "values": {"drive.top_speed": {"value": 61.5, "unit": "Hz"}}}

        def submit(self, name: str, request: Any) -> int:
            command = check_command(name, request)
            if isinstance(command, SpeedCommand) and command.speed_hz > 61.5:
                raise InputError("speed.speed_hz", "at most the top speed", command.speed_hz)
            return super().submit(name, request)

    with rig(Checked(duration_s=None), paced=True) as setup:
        setup.start()
        reply = setup.tap.ask(*command_frame(kind, 1, **values))
        assert (reply["result"], reply["field"], reply["limit"]) == (
            Result.OUT_OF_RANGE,
            field,
            round(10 * limit),
        )


def test_limits_of_commands_are_those_of_the_rig() -> None:
    for name, (low, high) in LIMITS.items():
        bounds = {type(bound).__name__: bound for bound in HammerCommand.model_fields[name].metadata}
        assert (bounds["Ge"].ge, bounds["Le"].le) == (low, high)


def test_other_frames_on_the_identifier_of_commands_are_ignored() -> None:
    with rig(FakeChannels(duration_s=None), paced=True) as setup:
        setup.start()
        identifier, data = command_frame(CommandKind.STOP, 1)
        setup.tap.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=True))
        setup.tap.bus.send(can.Message(arbitration_id=identifier, is_remote_frame=True, dlc=8, is_extended_id=False))
        setup.tap.bus.send(can.Message(arbitration_id=identifier, is_error_frame=True, data=data))
        setup.tap.send(0x011, data)
        assert setup.tap.ask(*command_frame(CommandKind.SPEED, 1, speed_hz=5.0))["result"] == Result.ACCEPTED
        assert setup.gateway.commands.refused.total() == 0


def test_a_stop_ends_the_run() -> None:
    with rig(FakeChannels(duration_s=None), paced=True) as setup:
        setup.start()
        until(lambda: bool(setup.tap.of("Probes")))
        assert setup.tap.ask(*command_frame(CommandKind.STOP, 1))["result"] == Result.ACCEPTED
        setup.join()
        assert setup.summary["reason"] == "stopped"
        until(lambda: setup.gateway.state == RigState.ENDED)


class SilentRig(MemoryClient):
    """A rig that replies to commands only on request."""

    def __init__(self, server: MemoryServer) -> None:
        super().__init__(server)
        self.go = threading.Event()

    def request(self, key: str, payload: bytes = b"", *, timeout_s: float = 2.0) -> bytes:
        if key.startswith(wire.COMMAND):
            self.go.wait(PATIENCE_S)
        return super().request(key, payload, timeout_s=timeout_s)


def test_commands_without_a_reply_time_out_and_too_many_are_refused() -> None:
    channel = f"gateway-{next(_channels)}"
    tap, own = Tap(channel), can.Bus(channel, interface="virtual", ignore_config=True)
    server = MemoryServer(cache=0)
    service = Service(FakeChannels(duration_s=None), server, FreeRun(), block_ticks=BLOCK)
    service.prepare()
    client = SilentRig(server)
    try:
        with Gateway(client, own, Schedule(), command_timeout_s=0.3) as gateway:
            for counter in range(1, 18):
                tap.send(*command_frame(CommandKind.SPEED, counter, speed_hz=5.0))
            until(lambda: len(tap.of("Acknowledge")) == 17)
            results = [(row["counter"], Result(row["result"])) for row in tap.decoded("Acknowledge")]
            assert results[0] == (17, Result.BUSY)
            assert sorted(results[1:]) == [(counter, Result.TIMED_OUT) for counter in range(1, 17)]
            assert gateway.commands.refused == {"busy": 1, "timed_out": 16}
            client.go.set()
    finally:
        tap.close()
        own.shutdown()


def test_gateway_threads_survive_errors_and_send_a_command_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with rig(FakeChannels(duration_s=None), paced=True) as setup:
        setup.start()
        until(lambda: bool(setup.tap.of("Probes")))
        good, requests = setup.client.request, []

        def bad(key: str, payload: bytes = b"", *, timeout_s: float = 2.0) -> bytes:
            requests.append((key, good(key, payload, timeout_s=timeout_s)))
            raise ZeroDivisionError("spoilt")

        monkeypatch.setattr(setup.client, "request", bad)
        assert setup.tap.ask(*command_frame(CommandKind.SPEED, 1, speed_hz=5.0))["result"] == Result.TIMED_OUT
        assert len(requests) == 1
        gateway = setup.gateway
        for owner, name in ((gateway, "unpack"), (gateway.commands, "take_message"), (gateway.outbox, "send_due")):
            monkeypatch.setattr(owner, name, lambda *_: 1 / 0)
        monkeypatch.setattr(setup.bus, "recv", lambda _: {}[1])
        before = setup.gateway.guard.failures
        until(lambda: setup.gateway.guard.failures > before + 10)
        assert any("the CAN gateway failed" in text for text in setup.service.status()["warnings"])
        monkeypatch.undo()
        count = len(setup.tap.of("Probes"))
        until(lambda: len(setup.tap.of("Probes")) > count + 100)
        assert setup.tap.ask(*command_frame(CommandKind.SPEED, 2, speed_hz=5.0))["result"] == Result.ACCEPTED


def test_100_000_random_frames_are_no_command_and_few_are_answered() -> None:
    with rig(FakeChannels(duration_s=None), paced=True) as setup:
        random = np.random.default_rng(1)
        data = random.integers(0, 256, (100_000, 8), dtype=np.uint8).tobytes()
        start = time.monotonic()
        for number in range(100_000):
            setup.gateway.commands.take((0x010, 0x020)[number & 1], data[8 * number : 8 * number + 8])
        assert setup.gateway.commands.accepted == 0
        assert setup.gateway.commands.refused.total() == 100_000
        answered = 20 + 50 * (time.monotonic() - start) + 1
        time.sleep(0.05)
        assert len(setup.tap.of("Acknowledge")) <= answered


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda table: table.select_groups(("probes",), 16_000),
            "--can-rate must be a divisor of the samples' rate, 16000 Hz",
        ),
        (lambda table: _calibrated(table), "channel disk_x must be calibrated as in the channel table"),
        (lambda table: _mixed(table), "sample rates must be the same for all channel groups"),
    ],
)
def test_a_rig_that_does_not_fit_the_messages_is_refused(change: Any, message: str) -> None:
    server = MemoryServer()
    document = {"tick_rate_hz": 1_000_000, "table": change(default_table()).model_dump(mode="json")}
    server.answer(wire.CATALOGUE, lambda _: wire.encode_document(document))
    with pytest.raises(InputError) as caught:
        Gateway(MemoryClient(server), RefusingBus(), Schedule(None, 10_000))
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("payload", "field"),
    [
        (b"", "catalogue"),
        (b"{}", "catalogue.tick_rate_hz"),
        (b'{"tick_rate_hz":0,"table":{}}', "catalogue.tick_rate_hz"),
        (b'{"tick_rate_hz":1000000,"table":{"groups":{"x":1}}}', "catalogue.table.groups.x"),
    ],
)
def test_an_invalid_catalogue_is_refused_in_one_line(payload: bytes, field: str) -> None:
    server = MemoryServer()
    server.answer(wire.CATALOGUE, lambda _: payload)
    with pytest.raises(InputError) as caught:
        Gateway(MemoryClient(server), RefusingBus(), Schedule(None, 10_000))
    assert caught.value.field == field


def _calibrated(table: Any) -> Any:
    group = table.groups["probes"]
    rows = (group.channels[0].model_copy(update={"sensitivity_v": 4.0}), *group.channels[1:])
    return table.model_copy(update={"groups": {"probes": group.model_copy(update={"channels": rows})}})


def _mixed(table: Any) -> Any:
    return table.model_copy(update={"groups": {**table.groups, **table.select_groups(("hammer",), 10_000).groups}})


class Firmware:
    """The other end of a serial line: a converter that speaks the slcan protocol."""

    def __init__(self) -> None:
        self.fd, end = os.openpty()
        tty.setraw(self.fd)
        tty.setraw(end)
        self.path = os.ttyname(end)
        self.frames: list[tuple[int, bytes]] = []
        self._stop = False
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        rest = b""
        while not self._stop:
            if not select.select([self.fd], [], [], 0.05)[0]:
                continue
            *lines, rest = (rest + os.read(self.fd, 65536)).split(b"\r")
            for line in lines:
                if line[:1] == b"t":
                    self.frames.append((int(line[1:4], 16), bytes.fromhex(line[5:].decode())))

    def send(self, identifier: int, data: bytes) -> None:
        os.write(self.fd, b"t%03X%d%s\r" % (identifier, len(data), data.hex().upper().encode()))

    def of(self, name: str) -> list[bytes]:
        return [data for identifier, data in list(self.frames) if identifier == TABLE.by_name[name].identifier]

    def close(self) -> None:
        self._stop = True
        self._thread.join()
        os.close(self.fd)


def test_a_serial_converter_works_as_well() -> None:
    pytest.importorskip("serial", reason="slcan needs python-can's extra serial")
    firmware = Firmware()
    try:
        own = can.Bus(firmware.path, interface="slcan", ignore_config=True, sleep_after_open=0.0)
        with rig(FakeChannels(duration_s=None), schedule=Schedule(), paced=True, bus=own) as setup:
            setup.start()
            until(lambda: len(firmware.of("Samples_5")) >= 100)
            firmware.send(*command_frame(CommandKind.HAMMER, 1, force_n=100.0, duration_ms=5.0))
            until(lambda: bool(firmware.of("Acknowledge")))
        (reply,) = [TABLE.by_name["Acknowledge"].decode(data) for data in firmware.of("Acknowledge")]
        assert (reply["counter"], reply["result"]) == (1, Result.ACCEPTED)
        numbers = [int.from_bytes(data[:2], "little") for data in firmware.of("Samples_5")]
        assert numbers == list(range(len(numbers)))
    finally:
        firmware.close()
