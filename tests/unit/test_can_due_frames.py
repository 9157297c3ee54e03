"""Frames sent to a bus ahead of time: each begins when it is due, and a hub wakes up only for listeners."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import Any

import can  # noqa: TID253 - the subject
import numpy as np
import pytest

from drivers.can.bus import codec
from drivers.can.bus.frame import FD_WIDTH, join_records, make_record, octets, pack_records
from drivers.can.bus.frame import Frame as Wire
from drivers.can.bus.hub import Hub
from drivers.can.bus.model import BusModel
from drivers.can.gateway.outbox import Outbox
from drivers.can.interface import HubBus
from drivers.can.signals import default_messages
from rig.base import wire
from tests.waiting import until

pytestmark = pytest.mark.wallclock

MS = 1_000_000


class CountingNode(HubBus):
    """A node that counts the messages of its hub that carry frames."""

    heard = 0

    def receive(self, message: codec.HubMessage) -> None:
        self.heard += isinstance(message, np.ndarray)
        super().receive(message)


def make(identifiers: Any) -> np.ndarray:
    return pack_records([make_record(Wire(each, bytes(range(1, 9)))) for each in identifiers], FD_WIDTH)


def identifiers(bus: can.BusABC) -> list[int]:
    found = []
    while (message := bus.recv(0.0)) is not None:
        found.append(message.arbitration_id)
    return found


def test_a_frame_begins_when_due_however_early_it_was_queued() -> None:
    with ExitStack() as stack:
        hub = stack.enter_context(Hub(BusModel("1M"), "can0"))
        sender, listener = (stack.enter_context(HubBus(hub)) for _ in range(2))
        delays = np.array([30, 10, 20, 20]) * MS
        sender.schedule_records(make([1, 2, 4, 3]), time.monotonic_ns() + delays, 1.0)
        messages = [listener.recv(30.0) for _ in delays]
        assert [message and message.arbitration_id for message in messages] == [2, 3, 4, 1]
        times_s = np.array([message.timestamp for message in messages if message])
        # 3 and 4 are due at once, and the priority decides; the clock of the stamps resolves 0.24 us.
        assert np.diff(times_s)[[0, 2]] == pytest.approx([0.01, 0.01], abs=0.2e-3)
        assert 100e-6 < np.diff(times_s)[1] < 150e-6


def test_an_immediate_frame_does_not_wait_for_future_ones() -> None:
    with ExitStack() as stack:
        hub = stack.enter_context(Hub(BusModel("1M"), "can0"))
        sender, listener = (stack.enter_context(HubBus(hub)) for _ in range(2))
        sender.schedule_records(make([1]), np.array([time.monotonic_ns() + 100_000 * MS]), 1.0)
        listener.send(can.Message(arbitration_id=7, is_extended_id=False))
        sender.send(can.Message(arbitration_id=8, is_extended_id=False))
        message = listener.recv(30.0)
        assert message is not None
        assert message.arbitration_id == 8
        # Frames that are not due when their sender leaves are not sent, and do not delay others.
        until(lambda: listener.done == 1)
        sender.flush_tx_buffer()
        assert hub.status()["counts"]["unsent"] == 0
        assert identifiers(listener) == []


def test_a_hub_hands_out_frames_of_a_lone_endpoint_in_few_messages_and_those_with_a_listener_soon() -> None:
    with ExitStack() as stack:
        hub = stack.enter_context(Hub(BusModel("1M"), "can0"))
        sender = stack.enter_context(CountingNode(hub))
        delays = np.arange(300) * MS
        sender.schedule_records(make(range(300)), time.monotonic_ns() + delays, 1.0)
        until(lambda: sender.done == 300)
        # One frame ahead; fewer on a busy machine.
        assert sender.heard <= 45
        # A client that joins meanwhile receives every later frame once.
        sender.schedule_records(make(range(300)), time.monotonic_ns() + delays, 1.0)
        listener = stack.enter_context(HubBus(hub))
        until(lambda: sender.done == 600)
        found: list[int] = []
        until(lambda: found.extend(identifiers(listener)) or 299 in found)
        assert found == list(range(found[0], 300))


@pytest.mark.parametrize("ahead_ms", [50, 0, -50])
def test_frames_of_a_slot_keep_their_order_in_any_portions(ahead_ms: int) -> None:
    with ExitStack() as stack:
        hub = stack.enter_context(Hub(BusModel("1M"), "can0"))
        sender, listener = (stack.enter_context(HubBus(hub)) for _ in range(2))
        records = make([5] * 200)
        octets(records)[:, 0] = range(200)
        due_ns = np.full(200, time.monotonic_ns() + ahead_ms * MS)
        for first in range(0, 200, 10):
            sender.schedule_records(records[first : first + 10], due_ns[first : first + 10], 1.0)
        messages = [listener.recv(30.0) for _ in range(200)]
        assert [message and message.data[0] for message in messages] == list(range(200))


def test_a_window_of_frames_that_are_not_due_is_full() -> None:
    with ExitStack() as stack:
        hub = stack.enter_context(Hub(BusModel("1M"), "can0"))
        sender = stack.enter_context(HubBus(hub))
        sender.schedule_records(make(range(512)), np.full(512, time.monotonic_ns() + 100_000 * MS), 0.0)
        with pytest.raises(can.CanOperationError, match="is full: 512 frames wait"):
            sender.send(can.Message(arbitration_id=1), timeout=0.0)
        sender.flush_tx_buffer()


class HoldingBus(can.BusABC):
    """A bus that holds frames until they are due, and stores them."""

    def __init__(self) -> None:
        self.calls: list[tuple[list[int], list[int]]] = []
        self.full = False
        super().__init__("holding")

    def send_records(self, records: np.ndarray, timeout: float | None = None) -> None:
        self.schedule_records(records, np.zeros(len(records), np.int64), timeout)

    def schedule_records(self, records: np.ndarray, due_ns: np.ndarray, timeout: float | None = None) -> None:
        if self.full:
            raise can.CanOperationError("full")
        self.calls.append((records["identifier"].tolist(), np.rint(due_ns / MS).astype(int).tolist()))

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise AssertionError("one by one")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return None, False


TABLE = default_messages()
SYNC, EVENT = TABLE.by_name["Sync"], TABLE.by_name["Event"]


def make_outbox(bus: can.BusABC, room: int) -> tuple[Outbox, list[float]]:
    """Return an outbox at the arrival of a block of 10 ms that begins at 0, and the list that sets its clock."""
    clock = [5.0001]
    outbox = Outbox(bus, room=room, paced=True, now=lambda: clock[0])
    outbox.follow(wire.Block(0, 0, 20_000.0, 1e6, np.zeros((200, 4), np.int32)))
    return outbox, clock


def test_frames_of_a_block_go_to_the_bus_at_once_in_the_order_of_their_slots() -> None:
    bus = HoldingBus()
    outbox, clock = make_outbox(bus, 1000)
    data = np.zeros((10, SYNC.length), np.uint8)
    outbox.put(SYNC, data, np.arange(1, 11) * 1e-3)
    outbox.put_one(EVENT, 4e-3, event=1)
    outbox.send_due()
    ((sent, due_ms),) = bus.calls
    assert sent == [SYNC.identifier] * 4 + [EVENT.identifier] + [SYNC.identifier] * 6
    assert due_ms == [5003, 5004, 5005, 5006, 5006, 5007, 5008, 5009, 5010, 5011, 5012]
    # A client that receives the end must not expect further samples: they are not due until the bus has sent them.
    assert outbox.undue
    clock[0] = outbox.next_s + 1e-6
    assert clock[0] == pytest.approx(5.012, abs=1e-5)
    assert not outbox.undue
    assert (outbox.sent, outbox.dropped) == (11, 0)


def test_long_blocks_are_sent_in_parts_and_never_late() -> None:
    bus = HoldingBus()
    outbox, clock = make_outbox(bus, 1000)
    outbox.put(SYNC, np.zeros((100, SYNC.length), np.uint8), np.arange(1, 101) * 1e-3)
    steps, late = 0, []
    while outbox.undue:
        before = len(bus.calls)
        outbox.send_due()
        late += [each for _, some in bus.calls[before:] for each in some if each <= 1e3 * clock[0]]
        clock[0] = max(clock[0], outbox.next_s + 1e-6)
        steps += 1
    assert [each for _, some in bus.calls for each in some] == list(range(5003, 5103))
    assert not late
    assert steps <= 12


@pytest.mark.parametrize("many", [20, 60])
def test_a_bus_that_gets_many_frames_a_slot_holds_few_of_them(many: int) -> None:
    bus = HoldingBus()
    outbox, clock = make_outbox(bus, 100_000)
    times_s = np.repeat(np.arange(1, 11) * 1e-3, many)
    outbox.put(SYNC, np.zeros((len(times_s), SYNC.length), np.uint8), times_s)
    outbox.send_due()
    assert outbox.sent <= 128 + 2 * many
    while outbox.undue:
        outbox.send_due()
        clock[0] = max(clock[0], outbox.next_s + 1e-6)
    assert outbox.sent == len(times_s)


def test_a_full_bus_drops_only_the_oldest_frames_in_excess() -> None:
    bus = HoldingBus()
    bus.full = True
    outbox, clock = make_outbox(bus, 4)
    outbox.put(SYNC, np.arange(10, dtype=np.uint8)[:, None].repeat(SYNC.length, 1), np.arange(1, 11) * 1e-3)
    outbox.send_due()
    assert (outbox.waiting, outbox.dropped) == (4, 6)
    bus.full, clock[0] = False, 5.5
    outbox.send_due()
    assert bus.calls == [([SYNC.identifier] * 4, [5009, 5010, 5011, 5012])]


def test_arrays_of_frames_are_joined_in_their_order() -> None:
    parts = [make([1, 2]), make([3, 4, 5])[::2], make([])]
    assert join_records(parts).tolist() == np.concatenate(parts).tolist()
    assert join_records(parts).flags.writeable
