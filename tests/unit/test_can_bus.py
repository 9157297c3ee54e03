"""The bus model against hand-computed times, the standard's rules, and a slow model written differently."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.can.bus import frame as frames
from drivers.can.bus import kernels
from drivers.can.bus.frame import Frame, records
from drivers.can.bus.model import OUTCOMES, BusModel, Delivery, warm_up
from drivers.can.bus.timing import encode, frame_bits
from rig.base.errors import InputError

US = 1_000
MS = 1_000_000
HORIZON = 10_000 * MS
EMPTY = Frame(0x555)
"""47 bits and no stuff bit before the CRC: 0 10101010101 000 0000 has one after the fifth dominant bit."""


def duration_us(frame: Frame) -> int:
    """Return the bits of a classic frame with its intermission: microseconds at 1 Mbit/s."""
    return sum(frame_bits(frame))


def pair(rate: str = "1M", **options: object) -> tuple[BusModel, int, int]:
    bus = BusModel(rate, **options)
    return bus, bus.attach("a"), bus.attach("b")


def sent(deliveries: list[Delivery]) -> list[Delivery]:
    return [delivery for delivery in deliveries if not delivery.error]


def test_times_are_the_frames_bits():
    bus, a, _ = pair("500k")
    frame = Frame(0x14, b"\x01")  # 58 bits with the intermission, see test_can_frame.
    bus.offer(a, frame, 7 * US)
    bus.offer(a, frame, 8 * US)
    one, two = bus.advance(MS)
    assert (one.start_ns, one.end_ns) == (7 * US, (7 + 55 * 2) * US)
    assert (two.start_ns, two.end_ns) == ((7 + 58 * 2) * US, (7 + 113 * 2) * US)
    assert (one.frame, one.node, one.attempt, one.final, one.error) == (frame, a, 1, True, "")
    assert two.offered_ns == 8 * US
    state = bus.state()
    assert state.frames == 2
    assert state.load == pytest.approx(116 * 2e-6 / 1e-3)


def test_fd_frames_have_a_fast_phase():
    bus, a, _ = pair("500k/2M")
    frame = Frame(0x123, bytes(range(32)), fd=True, brs=True)
    nominal, fast = frame_bits(frame)
    bus.offer(a, frame, 0)
    (one,) = bus.advance(MS)
    assert one.end_ns == (nominal - 3) * 2000 + fast * 500


def test_arbitration_follows_the_bits_on_the_wire():
    """Dominant wins: identifier; data before remote; base before extended with the same first 11 bits."""
    order = [
        Frame(0x0FF, b"1"),
        Frame(0x0FF, b"\0", remote=True),
        Frame(0x0FF << 18, b"1", extended=True),
        Frame(0x0FF << 18, b"\0", extended=True, remote=True),
        Frame(0x0FF << 18 | 1, b"1", extended=True),
        Frame(0x100, b"1"),
        Frame(0x7FF, b"1"),
    ]
    # Compare bit by bit without stuffing: the first difference decides.
    words = []
    for frame in order:
        encoded = encode(frame)
        words.append("".join(map(str, encoded.bits[~encoded.stuff]))[:33])
    assert words == sorted(words)
    bus = BusModel("1M")
    for frame in reversed(order):
        bus.offer(bus.attach(), frame, 0)
    assert [delivery.frame for delivery in bus.advance(10 * MS)] == order


def test_a_frame_on_the_wire_is_not_interrupted():
    bus, a, b = pair()
    slow = Frame(0x700, bytes(8))
    bus.offer(a, slow, 0)
    bus.offer(b, Frame(0x001), 1)
    one, two = bus.advance(MS)
    assert one.frame == slow
    assert two.start_ns == duration_us(slow) * US


def test_equal_identifiers_of_one_node_keep_their_order():
    bus, a, _ = pair()
    for k in range(20):
        bus.offer(a, Frame(0x100, bytes([k])), 0)
    assert [delivery.frame.data[0] for delivery in bus.advance(10 * MS)] == list(range(20))


def test_a_node_that_keeps_the_order_takes_part_in_arbitration_with_its_oldest_frame():
    bus = BusModel("1M")
    a, b = bus.attach(in_order=True), bus.attach()
    for identifier in (0x023, 0x300, 0x020):
        bus.offer(a, Frame(identifier), 0)
    bus.offer(b, Frame(0x100), 0)
    assert [row.frame.identifier for row in bus.advance(10 * MS)] == [0x023, 0x100, 0x300, 0x020]


def test_full_queue_drops_the_newest_and_counts():
    bus = BusModel("1M")
    a, _ = bus.attach(queue=3), bus.attach()
    for k in range(5):
        bus.offer(a, Frame(0x100 + k), 0)
    done = bus.advance(10 * MS)
    assert [(row.frame.identifier, row.error) for row in done[:2]] == [(0x103, "queue full"), (0x104, "queue full")]
    assert [row.frame.identifier for row in sent(done)] == [0x100, 0x101, 0x102]
    assert (bus.node(a).dropped, bus.node(a).queued) == (2, 0)
    # The frame on the wire holds its place until it ends, and no longer.
    first = Frame(0x200)
    end = 20 * MS + (duration_us(first) - 3) * US
    for late, drops in ((-1, 2), (0, 1), (1, 1)):
        bus = BusModel("1M")
        a, _ = bus.attach(queue=3), bus.attach()
        bus.offer(a, first, 20 * MS)
        for k in range(3):
            bus.offer(a, Frame(0x201 + k), 20 * MS + 10 * US)
        bus.offer(a, Frame(0x210), end + late)
        errors = [row.error for row in bus.advance(30 * MS)]
        assert errors.count("queue full") == drops
        assert errors.count("") == 5 - drops


class Slow:
    """The error-free bus in another form: a list of all frames, searched for each transmission."""

    def __init__(self, offers: list[tuple[int, int, Frame]], capacity: int) -> None:
        self.waiting = sorted(enumerate(offers), key=lambda item: (item[1][0], item[0]))
        self.capacity = capacity

    @staticmethod
    def rank(frame: Frame) -> str:
        encoded = encode(frame)
        return "".join(map(str, encoded.bits[~encoded.stuff]))[: 33 if frame.extended else 14]

    def run(self) -> tuple[list[tuple[int, int, Frame]], int]:
        queues: dict[int, list[tuple[str, int, int, Frame]]] = {}
        done: list[tuple[int, int, Frame]] = []
        dropped = 0
        free = number = 0
        on_wire: tuple[int, int, tuple[str, int, int, Frame]] | None = None
        while self.waiting or on_wire or any(queues.values()):
            arrival = self.waiting[0][1][0] if self.waiting else HORIZON
            if on_wire and on_wire[0] <= arrival:
                queues[on_wire[1]].remove(on_wire[2])
                on_wire = None
                continue
            start = free if any(queues.values()) else HORIZON
            if on_wire or arrival <= max(start, free):
                _, (at, node, frame) = self.waiting.pop(0)
                number += 1
                queue = queues.setdefault(node, [])
                if len(queue) >= self.capacity:
                    dropped += 1
                else:
                    queue.append((self.rank(frame), number, at, frame))
                    if not on_wire:
                        free = max(free, at)
                continue
            node, entry = min(
                ((node, min(queue)) for node, queue in queues.items() if queue), key=lambda item: item[1][:2]
            )
            length = duration_us(entry[3]) * US
            done.append((start, start + length - 3 * US, entry[3]))
            on_wire = (start + length - 3 * US, node, entry)
            free = start + length
        return done, dropped


offer_lists = st.lists(
    st.tuples(
        st.integers(0, 2000).map(lambda value: value * US),
        st.integers(0, 3),
        st.integers(0, 63),
        st.booleans(),
        st.binary(max_size=8),
    ),
    max_size=40,
)


@settings(deadline=None, max_examples=150)
@given(offer_lists, st.integers(1, 6))
def test_schedule_agrees_with_a_slow_model(offers: list[tuple[int, int, int, bool, bytes]], capacity: int):
    """Order, times and drops; the nodes' identifiers differ, so no two send the same."""
    rows = [(at, node, Frame(number << 2 | node, data, extended)) for at, node, number, extended, data in offers]
    bus = BusModel("1M")
    for _ in range(4):
        bus.attach(queue=capacity)
    for at, node, frame in rows:
        bus.offer(node, frame, at)
    got = sent(bus.advance(HORIZON))
    expected, dropped = Slow(rows, capacity).run()
    assert [(row.start_ns, row.end_ns, row.frame) for row in got] == expected
    assert sum(bus.node(node).dropped for node in range(4)) == dropped


@settings(deadline=None, max_examples=60)
@given(offer_lists, st.lists(st.integers(0, 40_000), max_size=30), st.integers(0, 1000))
def test_steps_of_any_length_give_the_same(offers: list[tuple[int, int, int, bool, bytes]], cuts: list[int], seed: int):
    def run(times: list[int]) -> tuple[list[Delivery], list[object]]:
        bus = BusModel("1M", error_rate=3e-3, seed=seed)
        for _ in range(4):
            bus.attach(queue=5)
        bus.disturb(1, count=33)
        waiting = sorted(offers, key=lambda row: row[0])
        done: list[Delivery] = []
        for time in times:
            while waiting and waiting[0][0] <= time:
                at, node, number, extended, data = waiting.pop(0)
                bus.offer(node, Frame(number, data, extended), at)
            done += bus.advance(time)
        return done, [bus.state(), *(bus.node(node) for node in range(4))]

    end = 60 * MS
    every = {row[0] for row in offers}
    assert run([*sorted({*every, *(cut * US for cut in cuts)}), end]) == run([2 * MS, end])


def test_a_lone_node_gets_no_acknowledge():
    """The lone node turns passive after 16 attempts and stays: ISO 11898-1:2015, 12.1.4.2, exception 1 of rule c."""
    bus = BusModel("1M")
    a = bus.attach()
    bus.offer(a, EMPTY, 0)
    done = bus.advance(100 * MS)
    assert {row.error for row in done} == {"no acknowledge"}
    assert not any(row.final for row in done)
    assert [row.attempt for row in done] == list(range(1, len(done) + 1))
    # Up to the acknowledge slot, then flag 6 and delimiter 8; intermission 3; passive, 8 more before the next.
    length = duration_us(EMPTY) - 3 - 7 - 1 + 6 + 8
    assert {row.end_ns - row.start_ns for row in done} == {length * US}
    gaps = [(two.start_ns - one.end_ns) // US for one, two in pairwise(done)]
    assert gaps == [3] * 15 + [11] * (len(gaps) - 15)
    assert (bus.node(a).state, bus.node(a).tec, bus.node(a).errors) == ("error passive", 128, len(done))
    # The first other node acknowledges it.
    bus.attach()
    assert bus.advance(101 * MS)[-1].error == ""
    assert (bus.node(a).tec, bus.node(a).state) == (127, "error active")


def test_a_listener_does_not_acknowledge_nor_send():
    bus = BusModel("1M")
    a, b = bus.attach(), bus.attach(listen_only=True)
    bus.offer(a, EMPTY, 0)
    assert bus.advance(MS)[0].error == "no acknowledge"
    with pytest.raises(InputError):
        bus.offer(b, EMPTY)


def test_error_frame_has_the_length_of_the_superposed_flags():
    """Identifier 0x555: 0 1 0 1 0 1 ...; the bad bit is inverted, then the sender's flag begins.

    Receivers respond after six equal bits, which include those before the flag.
    """
    cases = {
        1: 12 - 2,  # 0 [1 turned 0]: two dominant before the flag
        2: 12,  # 0 1 [0 turned 1]: recessive before the flag
        3: 12 - 2,
        5: 12 - 2,
        13: 12,  # RTR: the first of five dominant bits turned recessive
        17: 6,  # the stuff bit after them turned dominant: six equal bits, detected by all at once
    }
    for bit, flag in cases.items():
        bus, a, _ = pair()
        bus.disturb(a, bit=bit)
        bus.offer(a, EMPTY, 0)
        one, two = bus.advance(MS)
        assert one.error == "bit error"
        assert (one.end_ns - one.start_ns) // US == bit + 1 + flag + 8, bit
        assert (two.start_ns - one.end_ns, two.error, two.attempt) == (3 * US, "", 2)


def test_all_nodes_detect_an_error_in_the_end_of_frame_at_once():
    length = duration_us(EMPTY) - 3
    for bit, flag in ((length - 1, 6), (length - 9, 7), (10_000, 6)):
        bus, a, _ = pair()
        bus.disturb(a, bit=bit)
        bus.offer(a, EMPTY, 0)
        one = bus.advance(MS)[0]
        assert (one.end_ns - one.start_ns) // US == min(bit, length - 1) + 1 + flag + 8


def test_error_in_the_fast_phase_ends_it():
    bus, a, _ = pair("500k/2M")
    frame = Frame(0x555, b"\x55" * 16, fd=True, brs=True)
    encoded = encode(frame)
    bit = 40
    assert encoded.fast[bit]
    bus.disturb(a, bit=bit)
    bus.offer(a, frame, 0)
    one = bus.advance(MS)[0]
    fast = int(encoded.fast[: bit + 1].sum())
    flags = (one.end_ns - (bit + 1 - fast) * 2000 - fast * 500) // 2000 - 8
    level = 1 - encoded.bits[bit]
    run = 1
    while encoded.bits[bit - run] == level:
        run += 1
    assert flags == (12 - run if level == 0 else 12)


def test_counters_states_and_bus_off():
    bus, a, b = pair()
    bus.disturb(a, count=32)
    bus.offer(a, EMPTY, 0)
    bus.offer(a, Frame(0x600), 0)
    states = []
    for step in range(1, 4000):
        bus.advance(step * 5 * US)
        state = bus.node(a)
        if not states or states[-1] != (state.state, state.tec):
            states.append((state.state, state.tec))
    expected = [(("error active", "error passive", "bus-off")[(8 * k > 127) + (8 * k > 255)], 8 * k) for k in range(33)]
    assert states == [*expected, ("error active", 0)]
    assert (bus.node(a).bus_offs, bus.node(a).errors, bus.node(a).refused, bus.node(a).queued) == (1, 32, 1, 0)
    assert (bus.node(b).rec, bus.node(b).state) == (32, "error active")


def test_receivers_count_errors_and_good_frames():
    bus, a, b = pair()
    bus.disturb(a, count=5)
    bus.offer(a, EMPTY, 0)
    bus.advance(MS)
    assert (bus.node(a).tec, bus.node(b).rec) == (5 * 8 - 1, 5 - 1)
    for _ in range(50):
        bus.offer(a, EMPTY)
    bus.advance(10 * MS)
    assert (bus.node(a).tec, bus.node(b).rec) == (0, 0)


def test_recovery_takes_128_times_11_recessive_bits_of_an_idle_bus():
    bus, a, _ = pair()
    bus.disturb(a, count=32)
    bus.offer(a, EMPTY, 0)
    last = bus.advance(5 * MS)[-1]
    assert (last.error, last.final) == ("bit error", True)
    back = last.end_ns + (3 + 128 * 11) * US
    bus, a, _ = pair()
    bus.disturb(a, count=32)
    bus.offer(a, EMPTY, 0)
    bus.advance(back - 1)
    assert bus.node(a).state == "bus-off"
    bus.offer(a, EMPTY)
    assert bus.advance(back)[0].error == "bus-off"
    bus.offer(a, EMPTY)
    assert bus.advance(back + MS)[0].error == ""


def test_recovery_counts_one_for_each_frame_of_a_busy_bus():
    bus, a, b = pair()
    bus.attach()
    bus.disturb(a, count=32)
    bus.offer(a, EMPTY, 0)
    start = 2_500 * US
    last = bus.advance(start)[-1]
    idle = (start - last.end_ns - 3 * US) // (11 * US)
    assert 0 < idle < 128
    for k in range(200):
        bus.offer(b, Frame(0x100), start + k * 100 * US)
    # Between frames: the remainder of 100 us after the frame, in runs of 11.
    rest = (100 - duration_us(Frame(0x100))) // 11
    frames_needed = -(-(128 - idle) // (1 + rest))
    bus.advance(start + (frames_needed - 1) * 100 * US)
    assert bus.node(a).state == "bus-off"
    bus.advance(start + frames_needed * 100 * US)
    assert bus.node(a).state == "error active"


def test_error_passive_node_suspends_and_lets_others_go_first():
    bus, a, b = pair()
    bus.disturb(a, count=16)
    bus.offer(a, Frame(0x100, b"1"), 0)
    for k in range(17):
        bus.advance((k + 1) * MS // 17)
    assert bus.node(a).state == "error active"  # 16 errors, then one sent: 127
    bus.disturb(a, count=1)
    bus.offer(a, Frame(0x100, b"2"), 2 * MS)
    bus.offer(a, Frame(0x101, b"3"), 2 * MS)
    bus.offer(b, Frame(0x700), 2 * MS)
    order = bus.advance(3 * MS)
    # Passive with 135: waits eight bits after its error, in which b starts.
    assert [row.frame.identifier for row in order] == [0x100, 0x700, 0x100, 0x101]
    assert order[1].start_ns == order[0].end_ns + 3 * US
    assert order[2].start_ns == order[1].end_ns + 3 * US
    # It sent once, 134, is still passive, and so suspended before its own next frame.
    assert order[3].start_ns == order[2].end_ns + 11 * US


def test_two_nodes_with_one_identifier_collide_unless_the_frames_are_the_same():
    bus, a, b = pair()
    receiver = bus.attach()
    bus.offer(a, Frame(0x100, b"\x00"), 0)
    bus.offer(b, Frame(0x100, b"\x00"), 0)
    one, two = bus.advance(MS)
    assert (one.error, two.error, one.start_ns, one.end_ns) == ("", "", two.start_ns, two.end_ns)
    assert bus.state().frames == 1
    bus.offer(a, Frame(0x100, b"\x00"), 2 * MS)
    bus.offer(b, Frame(0x100, b"\x01"), 2 * MS)
    done = bus.advance(100 * MS)
    assert done[0].error == done[1].error == "collision of equal identifiers"
    assert not sent(done)
    # Both retransmit, so both go bus-off: a visible fault of the configuration.
    assert bus.node(a).bus_offs == bus.node(b).bus_offs == 1
    assert bus.node(receiver).rec == 32


def test_random_errors_come_at_their_rate_and_by_the_seed():
    def run(seed: int) -> tuple[int, int, list[int]]:
        bus, a, _ = pair(error_rate=1e-4, seed=seed)
        array = np.repeat(records([Frame(0x123, bytes(range(8)))]), 20_000)
        array["node"] = a
        array["time_ns"] = np.arange(20_000) * 400 * US
        bus.take(array)
        rows = bus.advance_records(HORIZON)
        faults = rows["outcome"] == OUTCOMES.index("bit error")
        assert bus.node(a).sent == 20_000
        return int(faults.sum()), len(rows), rows["start_ns"][faults].tolist()

    faults, attempts, times = run(1)
    assert run(1)[2] == times
    assert run(2)[2] != times
    chance = 1.0 - (1.0 - 1e-4) ** (duration_us(Frame(0x123, bytes(range(8)))) - 3)
    deviation = np.sqrt(attempts * chance * (1.0 - chance))
    assert abs(faults - attempts * chance) < 4.0 * deviation


def test_load_is_the_time_taken_by_windows():
    bus, a, _ = pair()
    frame = Frame(0x123, bytes(8))
    busy_us = duration_us(frame)
    for k in range(100):
        bus.offer(a, frame, k * 2 * MS)
    bus.advance(150 * MS)
    assert bus.state().window_load == pytest.approx(50 * busy_us / 100_000)
    bus.advance(200 * MS)
    assert bus.state().load == pytest.approx(busy_us / 2000)
    bus.advance(400 * MS)
    state = bus.state()
    assert (state.load, state.window_load) == (pytest.approx(busy_us / 4000), 0.0)
    # An overloaded bus has a load of one, and no idle window.
    array = np.repeat(records([frame]), 6000)
    array["node"] = a
    array["time_ns"] = 400 * MS + np.arange(6000) * 50 * US
    bus.take(array)
    bus.advance(550 * MS)
    assert bus.state().window_load == 1.0
    assert bus.node(a).dropped > 0


def test_numbers_of_detached_nodes_are_reused():
    bus, a, b = pair()
    for k in range(3):
        bus.offer(b, Frame(0x100 + k, bytes(8)), 0)
    bus.advance(50 * US)  # The first is on the wire.
    bus.detach(b)
    assert [row.frame.identifier for row in bus.advance(MS)] == [0x100]
    with pytest.raises(InputError):
        bus.offer(b, EMPTY)
    bus.offer(a, EMPTY)
    assert bus.advance(2 * MS)[0].error == "no acknowledge"
    assert bus.attach() == b
    assert bus.node(b).sent == 0
    assert not bus.advance(3 * MS)[-1].error
    other = bus.attach(queue=200)
    bus.offer(other, EMPTY, 5 * MS)
    bus.detach(other)
    assert [row.error for row in bus.advance(6 * MS)] == ["detached"]


def test_records_and_single_frames_give_the_same():
    rng = np.random.default_rng(4)
    some = [Frame(int(rng.integers(0x100, 0x400)), rng.bytes(8), fd=k % 2 == 0, brs=k % 4 == 0) for k in range(3000)]
    times = np.sort(rng.integers(0, 100, 3000)) * MS
    array = records(some)
    array["time_ns"] = times
    array["node"] = np.arange(3000) % 3
    one, two = BusModel("1M/4M"), BusModel("1M/4M")
    for bus in (one, two):
        for _ in range(3):
            bus.attach(queue=30)
    one.take(array)
    for k, frame in enumerate(some):
        two.offer(k % 3, frame, int(times[k]))
    rows = one.advance_records(HORIZON)
    assert len(rows) > 3000 // 2
    assert [
        (row["start_ns"], row["end_ns"], OUTCOMES[row["outcome"]], row["node"], frame)
        for row, frame in zip(rows, frames.frames(rows["frame"]), strict=True)
    ] == [(row.start_ns, row.end_ns, row.error, row.node, row.frame) for row in two.advance(HORIZON)]
    assert one.next_ns() is None
    assert (rows["frame"]["time_ns"] == rows["end_ns"]).all()


def test_next_time():
    bus, a, _ = pair()
    assert bus.next_ns() is None
    bus.offer(a, EMPTY, 5 * MS)
    bus.advance(MS)
    assert bus.next_ns() == 5 * MS
    bus.advance(5 * MS + 1)
    assert bus.next_ns() == 5 * MS + (duration_us(EMPTY) - 3) * US


def test_offers_of_the_past_are_offers_of_now():
    bus, a, _ = pair()
    bus.advance(5 * MS)
    bus.offer(a, EMPTY, 0)
    bus.offer(a, EMPTY)
    one, two = bus.advance(6 * MS)
    assert one.start_ns == one.offered_ns == two.offered_ns == 5 * MS


def test_warm_up_compiles_all_that_a_bus_runs():
    warm_up()
    before = [len(function.signatures) for function in (kernels.advance, kernels.enlist, kernels.draw_gap)]
    bus, a, b = pair("500k/2M", error_rate=1e-3)
    array = records([Frame(0x100, bytes(8)), Frame(0x200, bytes(64), fd=True, brs=True)])
    array["node"] = (a, b)
    bus.take(array)
    bus.offer(a, EMPTY)
    bus.advance(10 * MS)
    assert [len(function.signatures) for function in (kernels.advance, kernels.enlist, kernels.draw_gap)] == before


def test_refusals():
    bus, a, _ = pair()
    with pytest.raises(InputError, match="bus of 1M"):
        bus.offer(a, Frame(0x100, fd=True))
    with pytest.raises(InputError):
        bus.offer(7, EMPTY)
    with pytest.raises(InputError):
        bus.offer(a, Frame(0x800))
    bus.advance(MS)
    with pytest.raises(InputError):
        bus.advance(MS - 1)
    with pytest.raises(InputError):
        BusModel("1M", error_rate=1.5)
    with pytest.raises(InputError):
        bus.attach(queue=0)


def test_bus_without_nodes_lets_time_pass() -> None:
    bus = BusModel("1M")
    assert bus.advance(1_000_000) == []
    assert bus.now_ns == 1_000_000
