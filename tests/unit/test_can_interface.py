"""The hub of a virtual CAN bus and python-can's interface to it, over zenoh and within a process."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import random
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import can  # noqa: TID253 - the subject
import numpy as np
import pytest
from can.bus import BusState  # noqa: TID253

from drivers.can.bus import codec, endpoints
from drivers.can.bus import frame as frames
from drivers.can.bus.frame import Frame
from drivers.can.bus.hub import Hub
from drivers.can.bus.model import BusModel
from drivers.can.bus.node import match_filters
from drivers.can.bus.timing import speed
from drivers.can.interface import HubBus, ZenohBus
from rig.base import wire
from rig.base.errors import InputError
from rig.cli.commands import can as can_command
from rig.serve.transport.zenoh import ZenohServer
from tests.hostile import input_count
from tests.processes import free_endpoint
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.wallclock


class Rig:
    """A hub, and buses on it for the tests."""

    def __init__(self, way: str, rate: str, **settings: Any) -> None:
        self.way = way
        self.stack = ExitStack()
        self.model = BusModel(rate)
        self.server: ZenohServer | None = None
        if way == "zenoh":
            self.endpoint = free_endpoint()
            self.server = self.stack.enter_context(ZenohServer(self.endpoint))
        self.hub = self.stack.enter_context(Hub(self.model, "can0", self.server, **settings))

    def bus(self, **settings: Any) -> Any:
        if self.way == "zenoh":
            bus: can.BusABC = can.Bus("can0", interface="zenoh", ignore_config=True, endpoint=self.endpoint, **settings)
        else:
            bus = HubBus(self.hub, **settings)
        return self.stack.enter_context(bus)

    def node(self, bus: Any) -> int:
        """Return the number of its node in the model."""
        return next(row.node for row in self.hub.endpoints if row.name == bus.name)

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        self.stack.close()


@pytest.fixture(params=["zenoh", "process"])
def way(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def rig(way: str) -> Iterator[Rig]:
    with Rig(way, "1M/8M") as rig:
        yield rig


def message(identifier: int = 0x123, data: bytes = b"abc", **settings: Any) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False, check=True, **settings)


KINDS = [
    message(),
    message(0, b""),
    message(0x7FF, bytes(8)),
    can.Message(arbitration_id=0x1FFFFFFF, data=b"\x00\xff", check=True),
    can.Message(arbitration_id=1, data=b"low", check=True),
    can.Message(arbitration_id=0x321, is_extended_id=False, is_remote_frame=True, dlc=5, check=True),
    message(0x10, bytes(range(64)), is_fd=True, bitrate_switch=True),
    message(0x11, bytes(range(12)), is_fd=True, error_state_indicator=True),
    message(0x12, b"", is_fd=True),
]


def same(one: can.Message, other: can.Message) -> bool:
    return one.equals(other, timestamp_delta=None, check_channel=False, check_direction=False)


def read(bus: can.BusABC, count: int, *, timeout_s: float = PATIENCE_S) -> list[can.Message]:
    found = [bus.recv(timeout_s) for _ in range(count)]
    assert None not in found
    return [item for item in found if item is not None]


# The codec.


def test_a_record_has_its_documented_layout() -> None:
    payload = codec.encode(frames.pack_records([codec.Record(7, 0x123 | codec.EXTENDED, 2, 0, 5, b"hi")]))
    assert payload == b"RCB1" + bytes((0, 8, 1, 0)) + struct.pack("<QIBBH", 7, 0x80000123, 2, 0, 5) + b"hi\0\0\0\0\0\0"
    assert (codec.EXTENDED, codec.REMOTE, codec.ERROR) == (
        socket.CAN_EFF_FLAG,
        socket.CAN_RTR_FLAG,
        socket.CAN_ERR_FLAG,
    )
    assert [layout.itemsize for layout in codec.RECORDS.values()] == [24, 80]


@pytest.mark.parametrize("many", [False, True])
def test_messages_survive_the_codec(many: bool) -> None:
    parts = [KINDS] if many else [[kind] for kind in KINDS]
    found = []
    for part in parts:
        records = codec.decode(codec.encode(codec.make_records(part)))
        assert isinstance(records, np.ndarray)
        found += codec.make_messages(records, channel="x")
    assert all(map(same, KINDS, found))
    assert {item.channel for item in found} == {"x"}


def test_narrow_and_wide_records_hold_the_same() -> None:
    narrow = codec.make_records(KINDS[:6])
    assert narrow.dtype["data"].itemsize == 8
    wide = frames.resize_records(narrow)
    assert wide.dtype["data"].itemsize == 64
    assert frames.resize_records(wide, 8).tobytes() == narrow.tobytes()
    assert all(map(same, KINDS, codec.make_messages(wide)))


def test_both_judges_of_frames_agree() -> None:
    rng = np.random.default_rng(4)
    rows = np.zeros(20_000, codec.RECORDS[64])
    rows["identifier"] = rng.choice([0, 5, 0x7FF, 0x800, codec.EXTENDED_MASK], len(rows)) | rng.choice(
        [0, codec.EXTENDED, codec.REMOTE, codec.ERROR, codec.EXTENDED | codec.REMOTE], len(rows)
    )
    rows["length"] = rng.integers(0, 70, len(rows))
    rows["flags"] = rng.integers(0, 9, len(rows))
    for fd, width in itertools.product([False, True], [8, 64]):
        short = rows if width == 64 else frames.resize_records(rows, 8)
        one_by_one = [frames.find_fault(codec.Record(*row), fd=fd) is None for row in short.tolist()]
        assert frames.are_sendable(short, fd=fd).tolist() == one_by_one
        assert 0 < sum(one_by_one) < len(rows)


@pytest.mark.parametrize("identifier", [-1, 1 << 29, 1 << 31])
def test_an_identifier_with_too_many_bits_is_refused(identifier: int) -> None:
    with pytest.raises(codec.CodecError, match="29 bits"):
        codec.make_record(can.Message(arbitration_id=identifier))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda payload: b"",
        lambda payload: payload[:-1],
        lambda payload: payload + b"\0",
        lambda payload: b"X" + payload[1:],
        lambda payload: payload[:4] + b"\x07" + payload[5:],
        lambda payload: payload[:5] + b"\x09" + payload[6:],
        lambda payload: payload[:6] + b"\xff\xff" + payload[8:],
    ],
)
def test_malformed_payloads_are_reported(spoil: Callable[[bytes], bytes]) -> None:
    with pytest.raises(codec.CodecError):
        codec.decode(spoil(codec.encode(codec.make_records(KINDS[:1]))))


def test_filters_match_as_python_can_matches() -> None:
    rng = random.Random(3)
    with (
        can.Bus("filters", interface="virtual", ignore_config=True) as bus,
        can.Bus("filters", interface="virtual", ignore_config=True) as other,
    ):
        for _ in range(50):
            filters: Any = [
                {"can_id": rng.getrandbits(rng.choice([11, 29, 32])), "can_mask": rng.choice([0, 0x7F0, 7, 1 << 31])}
                | rng.choice([{}, {"extended": True}, {"extended": False}])
                for _ in range(rng.randint(1, 3))
            ]
            bus.set_filters(filters)
            messages = [
                can.Message(arbitration_id=rng.getrandbits(11), is_extended_id=rng.random() < 0.5, data=bytes([number]))
                for number in range(50)
            ]
            for item in messages:
                other.send(item)
            # Each call checks one frame.
            passed = [found.data[0] for _ in messages if (found := bus.recv(0)) is not None]
            words = codec.make_records(messages)["identifier"]
            assert np.flatnonzero(match_filters(words, filters)).tolist() == passed


# Sending and receiving.


@pytest.mark.parametrize("kind", KINDS, ids=range(len(KINDS)))
def test_every_kind_of_frame_arrives_as_it_was_sent(kind: can.Message) -> None:
    with Rig("process", "1M/8M") as rig:
        sender, receiver = rig.bus(), rig.bus()
        sender.send(kind)
        (found,) = read(receiver, 1)
        assert same(found, kind)
        assert found.is_rx
        assert sender.recv(0.05) is None


def test_receivers_get_all_frames_in_order_and_senders_theirs_on_request(rig: Rig) -> None:
    sender, own, other = rig.bus(), rig.bus(receive_own_messages=True), rig.bus()
    for number in range(100):
        sender.send(message(0x100, bytes((number,))))
        own.send(message(0x101, bytes((number,))))
    for bus in (own, other):
        found = read(bus, 200)
        for identifier in (0x100, 0x101):
            assert [item.data[0] for item in found if item.arbitration_id == identifier] == list(range(100))
        assert {(item.arbitration_id, item.is_rx) for item in found} == {(0x100, True), (0x101, bus is other)}
    assert [item.data[0] for item in read(sender, 100)] == list(range(100))
    assert sender.recv(0.05) is None


def test_stamps_are_the_ends_of_frames_by_the_wall_clock(rig: Rig) -> None:
    sender, receiver = rig.bus(), rig.bus()
    before = time.time()
    sender.send_records(codec.make_records([message(0x100, bytes(8))] * 100))
    stamps = [item.timestamp for item in read(receiver, 100)]
    assert before < stamps[0]
    assert stamps[-1] < time.time()
    # A classic frame is as long as it is at any data rate; doubles hold today's seconds to a quarter of a microsecond.
    duration = speed("1M").duration(Frame(0x100, bytes(8)))
    assert np.diff(stamps) == pytest.approx(duration, abs=1e-6)


def test_the_lower_identifier_goes_first_unless_a_node_keeps_the_order(rig: Rig) -> None:
    sender, receiver = rig.bus(in_order=False), rig.bus()
    identifiers = list(range(0x7F0, 0x6F0, -1))
    sender.send_records(codec.make_records([message(item) for item in identifiers]))
    assert [item.arbitration_id for item in read(receiver, 256)] == sorted(identifiers)
    rig.bus(in_order=True).send_records(codec.make_records([message(item) for item in identifiers]))
    assert [item.arbitration_id for item in read(receiver, 256)] == identifiers


def test_filters_hold_for_few_and_many_and_change_at_once(rig: Rig) -> None:
    sender = rig.bus(in_order=False)
    receiver = rig.bus(can_filters=[{"can_id": 0x100, "can_mask": 0x7FE, "extended": False}])
    sender.send(message(0x102))
    sender.send(message(0x101))
    sender.send_records(codec.make_records([message(0xF0 + item % 32) for item in range(320)]))
    assert [item.arbitration_id for item in read(receiver, 21)] == [0x101] + [0x100] * 10 + [0x101] * 10
    # The remaining frames have lower priority than the new ones.
    until(lambda: sender.done == sender.offered)
    sender.send(message(0x101))
    sender.send(message(0x100))
    until(lambda: receiver.waiting == 2)
    receiver.set_filters([{"can_id": 0x100, "can_mask": 0x7FF}])
    assert read(receiver, 1)[0].arbitration_id == 0x100
    receiver.set_filters(None)
    sender.send(message(0x55))
    assert read(receiver, 1)[0].arbitration_id == 0x55


def test_a_classic_node_of_an_fd_bus_has_classic_frames_only(rig: Rig) -> None:
    sender, classic = rig.bus(), rig.bus(fd=False)
    assert classic.protocol is can.CanProtocol.CAN_20
    assert sender.protocol is can.CanProtocol.CAN_FD
    fd = message(0x100, bytes(12), is_fd=True)
    sender.send(fd)
    sender.send_records(codec.make_records([fd] * 20))
    sender.send(message(0x200))
    assert read(classic, 1)[0].arbitration_id == 0x200
    with pytest.raises(can.CanOperationError, match="can0 cannot send a CAN FD frame, on a bus for classic CAN"):
        classic.send(fd)


def test_a_bus_of_another_kind_is_refused(way: str) -> None:
    with Rig(way, "500k") as rig:
        with pytest.raises(can.CanInitializationError, match="classic CAN only; fd=True asks for CAN FD"):
            rig.bus(fd=True)
        with pytest.raises(can.CanInitializationError, match=r"bitrate must be that of .* 500000"):
            rig.bus(bitrate=1_000_000)
        timing = can.BitTiming.from_sample_point(f_clock=80_000_000, bitrate=500_000, sample_point=80)
        assert rig.bus(timing=timing, bitrate=None).protocol is can.CanProtocol.CAN_20
        until(lambda: len(rig.hub.status()["nodes"]) == 1)


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (can.Message(arbitration_id=0x800, is_extended_id=False), "more than 11 bits"),
        (can.Message(arbitration_id=-1), "29 bits"),
        (can.Message(data=bytes(9)), "9 bytes in a classic frame"),
        (can.Message(data=bytes(9), is_fd=True), "not a CAN FD length"),
        (can.Message(is_error_frame=True), "error frame"),
        (can.Message(is_fd=True, is_remote_frame=True), "remote frame"),
    ],
)
def test_frames_that_do_not_exist_are_refused(wrong: can.Message, why: str) -> None:
    with Rig("process", "1M/8M") as rig, pytest.raises(can.CanOperationError, match=why):
        rig.bus().send(wrong)


def fill(bus: can.BusABC) -> None:
    # Some are sent meanwhile, more if this process is delayed.
    for _ in range(10 * endpoints.QUEUE_FRAMES):
        bus.send(message(0x100), timeout=0)


def test_a_full_transmit_queue_blocks_or_raises_and_can_be_flushed(way: str) -> None:
    with Rig(way, "10k") as rig:
        sender, receiver = rig.bus(), rig.bus()
        with pytest.raises(can.CanOperationError, match=r"transmit queue of can0 is full: 51[0-2] frames wait"):
            fill(sender)
        # One frame takes 8 ms here.
        sender.send(message(0x100), timeout=PATIENCE_S)
        sender.flush_tx_buffer()
        sender.send(message(0x300), timeout=0.5)
        found = []
        while not found or found[-1].arbitration_id != 0x300:
            found += read(receiver, 1)
        until(lambda: sender.done == sender.offered)
        # The number sent before depends on the delay of this process; but each was sent or dropped.
        offered = sender.offered
        until(lambda: rig.hub.status()["nodes"][0]["done"] == offered)
        dropped = rig.hub.status()["nodes"][0]["dropped"]
        assert dropped > 0
        assert len(found) + dropped == offered


def test_many_flushes_during_one_frame_use_up_no_controllers() -> None:
    with Rig("process", "10k") as rig:
        sender, receiver = rig.bus(), rig.bus()
        for _ in range(1000):
            sender.send(message(0x100), timeout=0)
            sender.flush_tx_buffer()
        with pytest.raises(InputError, match="the number of a node of this bus"):
            rig.model.node(8)
        sender.send(message(0x300), timeout=0)
        found = 0
        while read(receiver, 1)[0].arbitration_id != 0x300:
            found += 1
        until(lambda: rig.hub.status()["nodes"][0]["done"] == 1001)
        assert found + 1 + rig.hub.status()["nodes"][0]["dropped"] == 1001
        assert rig.hub.endpoints.waiting == 0


def test_frames_sent_before_a_shutdown_reach_the_bus(rig: Rig) -> None:
    sender, receiver = rig.bus(), rig.bus()
    for number in range(300):
        sender.send(message(0x100, number.to_bytes(2, "big")))
    sender.shutdown()
    assert [int.from_bytes(item.data, "big") for item in read(receiver, 300)] == list(range(300))


def test_many_small_steps_lose_nothing(rig: Rig) -> None:
    sender, receiver = rig.bus(), rig.bus()
    frames = codec.make_records([message(0x100, number.to_bytes(4, "big")) for number in range(20_000)])
    received: list[can.Message] = []
    for first in range(0, len(frames), 40):
        sender.send_records(frames[first : first + 40])
        while (item := receiver.recv(0)) is not None:
            received.append(item)
    received += read(receiver, len(frames) - len(received))
    assert [int.from_bytes(item.data, "big") for item in received] == list(range(20_000))


def test_a_late_reader_loses_the_oldest_frames_with_a_report(rig: Rig) -> None:
    sender, receiver = rig.bus(), rig.bus(rx_queue_size=100)
    for first in range(0, 400, 40):
        rows = [message(0x100, number.to_bytes(2, "big")) for number in range(first, first + 40)]
        sender.send_records(codec.make_records(rows))
    until(lambda: sender.done == 400 and receiver.waiting + receiver.dropped == 400)
    first, *rest = read(receiver, 1 + receiver.waiting)
    assert first.is_error_frame
    assert first.arbitration_id == codec.CONTROLLER
    assert first.data[1] == codec.RECEIVE_OVERFLOW
    assert [int.from_bytes(item.data, "big") for item in rest] == list(range(400 - len(rest), 400))
    assert 0 < len(rest) <= 100
    assert receiver.dropped == 400 - len(rest)


# Errors and states.


def test_a_corrupt_frame_is_an_error_frame_and_is_repeated(rig: Rig) -> None:
    sender, receiver = rig.bus(), rig.bus()
    rig.model.disturb(rig.node(sender), count=1)
    sender.send(message(0x100))
    error, frame = read(receiver, 2)
    assert error.is_error_frame
    assert error.arbitration_id == codec.PROTOCOL | codec.BUS_ERROR
    assert same(frame, message(0x100))
    assert error.timestamp < frame.timestamp
    assert read(sender, 1)[0].is_error_frame
    # ISO 11898-1: +8 for the error, -1 for the frame sent.
    until(lambda: sender.error_counters == (7, 0))
    assert sender.state is BusState.ACTIVE


def test_a_node_without_acknowledge_becomes_passive_but_not_bus_off(way: str) -> None:
    with Rig(way, "1M", acknowledge=False) as rig:
        sender = rig.bus()
        sender.send(message(0x100))
        until(lambda: sender.state is BusState.PASSIVE)
        kinds = set()
        while codec.CONTROLLER | codec.COUNTERS not in kinds:
            kinds.add(read(sender, 1)[0].arbitration_id)
        assert kinds == {
            codec.PROTOCOL | codec.BUS_ERROR | codec.NO_ACKNOWLEDGE,
            codec.CONTROLLER | codec.COUNTERS,
        }
        listener = rig.bus(listen_only=True)
        time.sleep(0.05)
        assert sender.done == 0
        listener.state = BusState.ACTIVE
        until(lambda: sender.done == 1)


def test_bus_off_is_reported_to_its_node_and_ends(rig: Rig) -> None:
    sender, other = rig.bus(), rig.bus()
    rig.model.disturb(rig.node(sender), count=40)
    sender.send(message(0x100))
    kinds: dict[can.BusABC, set[int]] = {sender: set(), other: set()}
    while codec.BUS_OFF | codec.COUNTERS not in kinds[sender]:
        kinds[sender].add(read(sender, 1)[0].arbitration_id)
    while (item := other.recv(0.1)) is not None:
        kinds[other].add(item.arbitration_id)
    assert kinds[other] == {codec.PROTOCOL | codec.BUS_ERROR}
    # 128 times 11 recessive bits: 1.4 ms.
    until(lambda: sender.state is BusState.ACTIVE)
    rig.model.disturb(rig.node(sender), count=0)
    sender.send(message(0x101))
    assert read(other, 1)[0].arbitration_id == 0x101


def test_a_node_that_is_bus_off_refuses_to_send(rig: Rig) -> None:
    sender: Any = rig.bus()
    sender.receive([codec.NodeReport(sender.node, 2, 0, 0, sender.done, 0)])
    assert sender.state is BusState.ERROR
    with pytest.raises(can.CanOperationError, match="this node of can0 is bus off"):
        sender.send(message())


def test_a_passive_node_only_listens(rig: Rig) -> None:
    sender, listener = rig.bus(), rig.bus()
    listener.state = BusState.PASSIVE
    assert listener.state is BusState.PASSIVE
    with pytest.raises(can.CanOperationError, match="only listens"):
        listener.send(message())
    sender.send(message(0x77))
    assert read(listener, 1)[0].arbitration_id == 0x77
    listener.state = BusState.ACTIVE
    listener.send(message(0x78))
    assert read(sender, 1)[0].arbitration_id == 0x78
    with pytest.raises(can.CanOperationError, match="must be ACTIVE or PASSIVE"):
        listener.state = BusState.ERROR


# Opening, closing, restarting hubs.


def test_opening_without_a_hub_explains_how_to_start_one() -> None:
    endpoint = free_endpoint()
    with pytest.raises(can.CanInitializationError) as caught:
        ZenohBus("can7", endpoint=endpoint, connect_s=0.1)
    for part in ("can7", endpoint, "rig can hub can7", "rig run --can zenoh:can7"):
        assert part in str(caught.value)


def test_opening_an_unknown_channel_names_the_known_ones() -> None:
    with Rig("zenoh", "1M") as rig:
        with pytest.raises(can.CanInitializationError, match=r"channel can1 .*\(channels there: can0\)"):
            ZenohBus("can1", endpoint=rig.endpoint)
        until(lambda: rig.hub.status()["nodes"] == [])


@pytest.mark.parametrize(
    ("endpoint", "why"), [("nowhere", "HOST:PORT"), ("192.0.2.1:7461", "ssh -L 7461:127.0.0.1:7461")]
)
def test_wrong_endpoints_are_refused(endpoint: str, why: str) -> None:
    with pytest.raises(can.CanInitializationError, match=why):
        ZenohBus("can0", endpoint=endpoint)


@pytest.mark.parametrize("channel", ["", "can/0", "*", "**", "a b", "c" * 65])
def test_wrong_channels_are_refused(channel: str) -> None:
    with pytest.raises(can.CanInitializationError, match="channel must be"):
        ZenohBus(channel, endpoint=free_endpoint())
    with pytest.raises(ValueError, match="channel must be"):
        Hub(BusModel("1M"), channel)


def test_a_closed_bus_raises_and_is_removed(rig: Rig) -> None:
    bus = rig.bus()
    until(lambda: len(rig.hub.status()["nodes"]) == 1)
    bus.shutdown()
    bus.shutdown()
    for use in (lambda: bus.send(message()), lambda: bus.recv(0), bus.flush_tx_buffer):
        with pytest.raises(can.CanOperationError, match="has been shut down"):
            use()
    until(lambda: rig.hub.status()["nodes"] == [])


def test_senders_are_informed_when_a_hub_ends(rig: Rig) -> None:
    bus, waiting = rig.bus(), rig.bus()
    rig.hub.close()
    if rig.server is not None:
        rig.server.close()
    until(lambda: bus.state is BusState.ERROR)
    with pytest.raises(can.CanOperationError, match=r"the hub of CAN channel can0 .* is lost: nothing can be sent"):
        bus.send(message())
    assert waiting.recv(0.01) is None


def test_clients_rejoin_a_restarted_hub() -> None:
    endpoint = free_endpoint()
    with ExitStack() as stack:
        with ZenohServer(endpoint) as server, Hub(BusModel("1M"), "can0", server):
            buses = [stack.enter_context(ZenohBus("can0", endpoint=endpoint)) for _ in range(2)]
            buses[0].send(message(1))
            assert read(buses[1], 1)[0].arbitration_id == 1
        until(lambda: all(bus.state is BusState.ERROR for bus in buses))
        with ZenohServer(endpoint) as server, Hub(BusModel("1M"), "can0", server):
            until(lambda: all(bus.state is BusState.ACTIVE for bus in buses))
            buses[1].send(message(2))
            assert read(buses[0], 1)[0].arbitration_id == 2


def test_two_channels_at_one_address_do_not_mix() -> None:
    endpoint = free_endpoint()
    with (
        ZenohServer(endpoint) as server,
        Hub(BusModel("1M"), "can0", server),
        Hub(BusModel("1M"), "can1", server),
        ZenohBus("can0", endpoint=endpoint) as zero,
        ZenohBus("can0", endpoint=endpoint) as sender,
        ZenohBus("can1", endpoint=endpoint) as one,
    ):
        sender.send(message(1))
        assert read(zero, 1)[0].channel == "can0"
        assert one.recv(0.1) is None


def test_the_command_listens_at_the_clients_default_endpoint() -> None:
    assert can_command.LISTEN == codec.DEFAULT_ENDPOINT


def test_channels_are_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codec, "DEFAULT_ENDPOINT", free_endpoint())
    assert can.detect_available_configs(["zenoh"]) == []
    with ZenohServer(codec.DEFAULT_ENDPOINT) as server, Hub(BusModel("1M"), "can5", server):
        assert can.detect_available_configs(["zenoh"]) == [{"interface": "zenoh", "channel": "can5"}]


# Functions that python-can calls on a bus.


def test_notifier_listeners_and_periodic_tasks_work(rig: Rig) -> None:
    sender, receiver = rig.bus(), rig.bus()
    reader = can.BufferedReader()
    with can.Notifier(receiver, [reader], timeout=0.1):
        task = sender.send_periodic(message(0x42), 0.002)
        found = [reader.get_message(2.0) for _ in range(20)]
        task.stop()
    assert {item.arbitration_id for item in found if item is not None} == {0x42}
    assert None not in found


def test_asyncio_readers_work(rig: Rig) -> None:
    sender, receiver = rig.bus(), rig.bus()

    async def run() -> list[int]:
        reader = can.AsyncBufferedReader()
        with can.Notifier(receiver, [reader], timeout=0.1, loop=asyncio.get_running_loop()):
            for number in range(50):
                sender.send(message(0x100, bytes((number,))))
            return [(await asyncio.wait_for(reader.get_message(), 5.0)).data[0] for _ in range(50)]

    assert asyncio.run(run()) == list(range(50))


# The hub as one node of several.


def make_payload(rng: random.Random) -> bytes:
    """Return random bytes, or a message of frames with some of its bytes changed."""
    if rng.random() < 0.3:
        return rng.randbytes(rng.choice([0, 1, 7, 8, 32, 88, 500]))
    payload = bytearray(codec.encode(codec.make_records(rng.choices(KINDS, k=rng.randint(1, 12)))))
    for _ in range(rng.choice([0, 1, 3])):
        payload[rng.randrange(len(payload))] = rng.getrandbits(8)
    return bytes(payload)


def test_random_payloads_do_not_change_the_hub() -> None:
    rng = random.Random(1)
    with Rig("process", "1M/8M") as rig:
        villain, sender, receiver = rig.bus(), rig.bus(), rig.bus()
        secret = bytes.fromhex(villain.secret)
        count = input_count(20_000)
        for number in range(count):
            payload = make_payload(rng)
            rig.hub.offer(villain.name if number % 2 else rng.choice(["", "x"]), secret + payload)
            if number % 50 == 0:
                rig.hub.reply(
                    rng.choice(("join", "set", "flush", "status")),
                    rng.choice([payload, b"[]", b'{"endpoint": 3}', b'{"endpoint": "fuzz"}', b"[" * 4000]),
                )
        counts = rig.hub.status()["counts"]
        assert counts["strange"] == count // 2
        assert min(counts["malformed"], counts["invalid"], counts["frames"]) > count // 1000
        assert any(thread.name == "can hub can0" for thread in threading.enumerate())
        villain.shutdown()
        until(lambda: rig.hub.endpoints.waiting == 0)
        # A frame that differs from all malformed ones.
        sender.send(message(0x7A5, b"unique"))
        while (found := read(receiver, 1)[0]).data != b"unique":
            assert found.is_error_frame or frames.find_fault(codec.make_record(found)) is None
        nodes = {row["name"]: row for row in rig.hub.status()["nodes"]}
        assert nodes[receiver.name]["state"] == 0


def test_random_payloads_over_zenoh_do_not_change_the_hub() -> None:
    rng = random.Random(2)
    with Rig("zenoh", "1M/8M") as rig:
        villain, sender, receiver = rig.bus(), rig.bus(), rig.bus()
        client = villain.client
        for number in range(5000):
            name = villain.name if number % 2 else "stranger"
            client.report(codec.offer_key("can0", name), bytes.fromhex(villain.secret) + make_payload(rng))
            client.report(codec.bus_key("can0"), make_payload(rng))
            client.report(f"rig/can/can0/{rng.choice(['join', 'offer', 'node/x'])}", make_payload(rng))
        until(lambda: rig.hub.status()["counts"]["malformed"] > 100)
        sender.send(message(0x7A5, b"unique"))
        while (found := read(receiver, 1)[0]).data != b"unique":
            assert found.is_error_frame or frames.find_fault(codec.make_record(found)) is None
        nodes = {row["name"]: row for row in rig.hub.status()["nodes"]}
        assert nodes[receiver.name]["state"] == 0


def join_hub(hub: Hub, name: str, *, token: bool = False, **more: Any) -> dict[str, Any]:
    """Return the reply to an endpoint of another process that joins."""
    if token:
        hub.record_token(codec.node_key("can0", name), True)
    return hub.answer("join", {"endpoint": name, **more})


def test_the_number_of_endpoints_is_bounded_and_those_of_this_process_always_get_in() -> None:
    with Rig("process", "1M") as rig:
        first = join_hub(rig.hub, "e0", token=True)
        for number in range(1, endpoints.MAX_ENDPOINTS):
            join_hub(rig.hub, f"e{number}", token=True)
        for token in (False, True):
            with pytest.raises(InputError, match=r"endpoint must be one of at most 64; .*one more than 64"):
                join_hub(rig.hub, "late", token=token)
        sender, receiver = rig.bus(), rig.bus()
        sender.send(message(7))
        assert read(receiver, 1)[0].arbitration_id == 7
        assert "node" in join_hub(rig.hub, "e0", secret=first["secret"])


def test_endpoints_without_a_token_are_replaced_first() -> None:
    with Rig("process", "1M") as rig:
        for number in range(1000):
            join_hub(rig.hub, f"ghost{number}")
        names = [row["name"] for row in rig.hub.status()["nodes"]]
        assert names == [f"ghost{number}" for number in range(1000 - endpoints.MAX_TOKENLESS, 1000)]
        for number in range(endpoints.MAX_ENDPOINTS):
            join_hub(rig.hub, f"e{number}", token=True)
        assert [row["name"] for row in rig.hub.status()["nodes"]] == [f"e{n}" for n in range(endpoints.MAX_ENDPOINTS)]
        # However many tokens a node declares, the newest counts.
        for number in range(5000):
            rig.hub.record_token(codec.node_key("can0", f"t{number}"), True)
        assert rig.hub.endpoints.tokens.keys() >= {"t4999"}
        assert len(rig.hub.endpoints.tokens) <= 16 * endpoints.MAX_ENDPOINTS


# The owner of a name.


def test_requests_under_the_name_of_another_node_are_refused(rig: Rig) -> None:
    sender, receiver = rig.bus(), rig.bus()
    villain = rig.bus()
    before = rig.hub.status()
    for secret in (None, "0" * 32, villain.secret):
        given = {} if secret is None else {"secret": secret}
        for name, more in (("set", {"listen_only": True}), ("flush", {}), ("join", {"listen_only": True})):
            with pytest.raises(InputError, match=r"must be (unused|given)"):
                rig.hub.answer(name, {"endpoint": sender.name, **given, **more})
        forged = codec.encode(codec.make_records([message(0x666)]))
        rig.hub.offer(sender.name, bytes.fromhex(secret or "") + forged)
    if rig.way == "zenoh":
        client = villain.client
        reply = client.request(codec.request_key("can0", "join"), wire.encode_document({"endpoint": sender.name}))
        assert wire.decode_document(reply)["field"] == "endpoint"
        client.announce(codec.node_key("can0", sender.name))
        client.report(codec.offer_key("can0", sender.name), bytes.fromhex(villain.secret) + forged)
        until(lambda: rig.hub.status()["counts"]["forged"] >= 10)
        # A second token of the same name, and its end, change nothing.
        villain.shutdown()
        time.sleep(0.3)
    else:
        # Tokens are for other processes.
        rig.hub.record_token(codec.node_key("can0", sender.name), False)
    for number in range(100):
        sender.send(message(0x100, bytes((number,))))
    assert [(item.arbitration_id, item.data[0]) for item in read(receiver, 100)] == [(0x100, n) for n in range(100)]
    after = rig.hub.status()
    assert after["nodes"][0]["listen_only"] is False
    assert after["counts"]["forged"] - before["counts"]["forged"] >= 8
    assert any("used the name of another endpoint" in text for text in after["warnings"])


def test_an_endpoint_can_rejoin_under_its_name() -> None:
    with Rig("process", "1M") as rig:
        first = join_hub(rig.hub, "mine", token=True)
        with pytest.raises(InputError, match="endpoint must be unused"):
            join_hub(rig.hub, "mine")
        second = join_hub(rig.hub, "mine", secret=first["secret"])
        assert second["secret"] != first["secret"]
        with pytest.raises(InputError, match="endpoint must be unused"):
            rig.hub.answer("flush", {"endpoint": "mine", "secret": first["secret"]})
        rig.hub.record_token(codec.node_key("can0", "mine"), False)
        third = join_hub(rig.hub, "mine")
        assert rig.hub.answer("flush", {"endpoint": "mine", "secret": third["secret"]}) == {}


@pytest.mark.parametrize(
    ("name", "document", "field"),
    [
        ("join", {}, "join.endpoint"),
        ("join", {"endpoint": 3}, "join.endpoint"),
        ("join", {"endpoint": "a/b"}, "join.endpoint"),
        ("join", {"endpoint": "a\n"}, "join.endpoint"),
        ("join", {"endpoint": "a", "listen_only": 1}, "join.listen_only"),
        ("join", {"endpoint": "a", "more": 1}, "join.more"),
        ("set", {"endpoint": "a", "secret": "0" * 32}, "set.listen_only"),
        ("flush", {"endpoint": "a", "secret": "0" * 31}, "flush.secret"),
        ("status", {"all": True}, "status.all"),
        ("flush", {"endpoint": "a", "secret": "0" * 32}, "endpoint"),
    ],
)
def test_requests_are_strict(name: str, document: dict[str, Any], field: str) -> None:
    with Rig("process", "1M") as rig:
        answer = wire.decode_document(rig.hub.reply(name, wire.encode_document(document)))
        assert answer["field"] == field
        assert answer["error"].startswith(f"{field} must be {answer['must']}; received")
        assert rig.hub.status()["counts"]["refused"] == 1


def test_a_hub_continues_after_an_internal_error_and_reports_it(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    sender, receiver = rig.bus(), rig.bus()
    for owner, name in ((rig.model, "next_ns"), (rig.hub.endpoints, "offer")):

        def bad(*arguments: Any, good: Any = getattr(owner, name), calls: Any = itertools.count()) -> Any:  # noqa: B008
            if next(calls) % 3 == 0:
                raise ZeroDivisionError("spoilt \x1b[31m")
            return good(*arguments)

        monkeypatch.setattr(owner, name, bad)
    for _ in range(30):
        with contextlib.suppress(ZeroDivisionError):
            sender.send(message(0x100), timeout=0)
        time.sleep(0.005)
    monkeypatch.undo()
    time.sleep(0.2)
    sender.flush_tx_buffer()
    sender.send(message(0x200))
    while read(receiver, 1)[0].arbitration_id != 0x200:
        pass
    assert any("failed" in text and "\x1b" not in text for text in rig.hub.warnings())


def test_an_endpoint_without_a_token_is_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(endpoints, "_TOKEN_TIMEOUT_S", 0.2)
    with Rig("process", "1M") as rig:
        rig.hub.answer("join", {"endpoint": "ghost"})
        bus: Any = rig.bus()
        until(lambda: [row["name"] for row in rig.hub.status()["nodes"]] == [bus.name])


def test_numbers_of_nodes_are_not_reused_at_once() -> None:
    with Rig("process", "1M") as rig:
        numbers = set()
        for _ in range(10):
            bus: Any = rig.bus()
            numbers.add(bus.node)
            bus.shutdown()
        assert len(numbers) == 10
