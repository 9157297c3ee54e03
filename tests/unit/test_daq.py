"""The DAQ client: merged streams, reported gaps, bounded memory, over the rig's keys and over CAN."""

from __future__ import annotations

import asyncio
import importlib
import inspect
import itertools
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import can  # noqa: TID253 - the subject
import numpy as np
import pytest

import drivers.examples
from drivers.can.gateway import Gateway
from drivers.can.schedule import Schedule
from drivers.can.signals import RigState, default_messages
from drivers.console import Console
from drivers.daq import Aligner, Daq
from drivers.instruments.force.driver import AsyncForce
from drivers.instruments.twins import Twins
from drivers.link import LinkTimeoutError
from drivers.sources import stream
from drivers.sources.can import CanSource, SampleDecoder
from drivers.sources.rig import RigSource
from drivers.sources.samples import RowBuffer, Samples, StreamEndedError, follow
from rig.base import wire
from rig.base.errors import InputError
from rig.base.wire import Continuity
from rig.channels.table import default_table
from rig.serve.transport import RigLostError
from rig.serve.transport.memory import MemoryClient, MemoryServer
from rig.serve.transport.zenoh import ZenohClient, ZenohServer
from tests.processes import free_endpoint, start_python
from tests.unit.instruments_fake import BLOCK, FakeRig, expected_values, make_counts
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.wallclock
_numbers = itertools.count()


def make_rows(index: int, rows: int, *, name: str = "a", columns: int = 1, rate_hz: float = 1000.0) -> Samples:
    """Return rows whose values encode their number."""
    values = np.arange(index, index + rows, dtype=float)[:, None] + np.arange(columns) * 1e6
    names = tuple(f"{name}{n}" for n in range(columns))
    return Samples(index, round(index * 1e6 / rate_hz), rate_hz, 1e6, names, ("V",) * columns, values)


# Rows and their numbers.


def test_rows_that_are_missing_late_or_twice_are_counted() -> None:
    rows = Continuity()
    kept = [follow(rows, make_rows(*each)) for each in [(100, 10), (110, 10), (115, 10), (105, 5), (135, 5), (125, 10)]]
    assert [(new.index, len(new), new.gap) if new else None for new in kept] == [
        (100, 10, 0), (110, 10, 0), (120, 5, 0), None, (135, 5, 10), None,
    ]  # fmt: skip
    assert (rows.lost, rows.stale, rows.runs) == ({"": 10}, 5 + 5 + 10, {"": 0})
    again = follow(rows, make_rows(0, 10))
    assert again is not None
    assert (again.gap, rows.runs) == (0, {"": 1})


def test_a_buffer_returns_the_requested_rows_and_never_across_a_gap() -> None:
    pile = RowBuffer()
    for samples in (make_rows(0, 10), make_rows(10, 10)):
        pile.add(samples)
    assert pile.take(25, ended=False) is None
    first = pile.take(15, ended=False)
    assert first is not None
    np.testing.assert_array_equal(first["a0"], np.arange(15))
    assert pile.rows == 5
    pile.add(Samples(40, 40_000, 1000.0, 1e6, ("a0",), ("V",), np.zeros((5, 1)), gap=20))
    rest = pile.take(25, ended=False)
    assert rest is not None
    assert (rest.index, len(rest), rest.tick) == (15, 5, 15_000)
    assert pile.take(25, ended=False) is None
    last = pile.take(25, ended=True)
    assert last is not None
    assert (last.gap, len(last), pile.rows) == (20, 5, 0)


def test_an_unread_buffer_stays_small_and_reports_lost_rows() -> None:
    pile = RowBuffer(50)
    for n in range(100):
        pile.add(make_rows(10 * n, 10))
    assert (pile.rows, pile.dropped) == (50, 950)
    lowest = pile.take(None, ended=False)
    assert lowest is not None
    assert (lowest.index, lowest.gap) == (950, 950)


# Alignment, without I/O.


def aligner(room: int = 1000) -> Aligner:
    return Aligner({"a": [0, 1], "b": [1]}, [2, 0, 1], room)


def test_rows_are_merged_by_number_with_columns_in_the_requested_order() -> None:
    merged = aligner()
    assert merged.feed("a", make_rows(0, 10, columns=2)) == []
    (first,) = merged.feed("b", make_rows(4, 4, name="b", columns=2))
    assert first.names == ("a1", "b1", "a0")
    assert (first.index, first.tick) == (4, 4000)
    np.testing.assert_array_equal(first.values[:, 2], np.arange(4, 8))
    np.testing.assert_array_equal(first.values[:, 0], first.values[:, 1])
    (second,) = merged.feed("b", make_rows(8, 10, name="b", columns=2))
    assert (second.index, len(second), second.gap) == (8, 2, 0)


def test_a_gap_in_one_stream_is_a_gap_in_all_with_its_name() -> None:
    merged = aligner()
    out = merged.feed("a", make_rows(0, 30, columns=2)) + merged.feed("b", make_rows(0, 10, name="b", columns=2))
    out += merged.feed("b", make_rows(17, 13, name="b", columns=2))
    assert [(each.index, len(each), each.gap) for each in out] == [(0, 10, 0), (17, 13, 7)]
    assert [(gap.key, gap.index, gap.size) for gap in merged.gaps] == [("b", 10, 7)]
    assert merged.lost == {"a": 0, "b": 7}


def test_portions_of_any_size_in_any_order_give_the_same_rows() -> None:
    random = np.random.default_rng(4)
    merged, out, position = aligner(10_000), [], {"a": 0, "b": 0}
    while min(position.values()) < 500:
        name = str(random.choice(["a", "b"]))
        rows = int(random.integers(1, 40))
        out += merged.feed(name, make_rows(position[name], rows, name=name, columns=2))
        position[name] += rows
    joined = np.concatenate([each.values for each in out])
    assert len(joined) == min(position.values())
    np.testing.assert_array_equal(joined[:, 2], np.arange(len(joined)))
    assert all(each.gap == 0 for each in out)


def test_a_stream_without_its_partner_is_bounded() -> None:
    merged = aligner(room=100)
    for n in range(100):
        assert merged.feed("a", make_rows(10 * n, 10, columns=2)) == []
    assert merged.unmatched == 900
    (out,) = merged.feed("b", make_rows(995, 5, name="b", columns=2))
    assert (out.index, len(out)) == (995, 5)


def test_rows_of_different_runs_are_never_joined() -> None:
    merged = aligner()
    assert merged.feed("a", make_rows(1000, 50, columns=2)) == []
    assert len(merged.feed("b", make_rows(1000, 20, name="b", columns=2))) == 1
    # The rig was restarted; `a` is the first to notice.
    assert merged.feed("a", make_rows(0, 10, columns=2)) == []
    assert merged.feed("b", make_rows(1020, 20, name="b", columns=2)) == []
    (out,) = merged.feed("b", make_rows(0, 10, name="b", columns=2))
    assert (out.index, len(out), out.gap) == (0, 10, 0)


# The client on the rig's keys.


@contextmanager
def on_memory(**options: Any) -> Iterator[tuple[FakeRig, Daq]]:
    with MemoryServer(cache=10) as server, MemoryClient(server) as client:
        rig = FakeRig(server)
        with Daq(RigSource(client), **options) as daq:
            yield rig, daq


CHANNELS = ["P_W", "disk_x", "hammer"]
GROUPS = ("probes", "forces", "hammer")


def expected(index: int, rows: int, step: int = 1) -> np.ndarray:
    columns = {"P_W": ("forces", 3), "disk_x": ("probes", 0), "hammer": ("hammer", 0)}
    return np.stack([expected_values(columns[c][0], index, rows, step)[:, columns[c][1]] for c in CHANNELS], axis=1)


def test_chosen_channels_come_aligned_in_engineering_units() -> None:
    with on_memory(channels=CHANNELS) as (rig, daq):
        rig.publish(*GROUPS, "drive", blocks=3)
        samples = daq.read(3 * BLOCK)
        assert (samples.names, samples.units) == (("P_W", "disk_x", "hammer"), ("N", "mm", "N"))
        assert (samples.index, samples.gap, samples.rate_hz, daq.rate_hz) == (0, 0, 20_000.0, 20_000.0)
        np.testing.assert_allclose(samples.values, expected(0, 3 * BLOCK), rtol=0, atol=1e-9)
        np.testing.assert_array_equal(samples["disk_x"], samples.values[:, 1])
        si = samples.to_si()
        np.testing.assert_allclose(si["disk_x"], samples["disk_x"] * 1e-3, rtol=1e-15)
        assert (samples.unit("disk_x"), si.unit("disk_x"), si.unit("P_W"), len(si)) == ("mm", "m", "N", 3 * BLOCK)
        with pytest.raises(KeyError, match=r"name must be one of the existing names, such as disk_x"):
            samples["disk_z"]
        shown = f"Samples(P_W [N], disk_x [mm], hammer [N]; {len(samples)} rows at 20000 Hz, 0 to"
        assert repr(samples).startswith(shown)
        assert repr(replace(samples, gap=7)).endswith(" s; 7 missing before)")
        # None of these rows was lost or invented in transit.
        assert (daq.lost, daq.dropped, daq.unmatched) == (dict.fromkeys(GROUPS, 0), 0, 0)


def test_a_slower_rate_takes_every_nth_row_of_the_rig() -> None:
    with on_memory(channels=CHANNELS, rate_hz=20_000 / 3) as (rig, daq):
        rig.publish(*GROUPS, blocks=4)
        samples = daq.read(4 * BLOCK // 3)
        np.testing.assert_allclose(samples.values, expected(0, 4 * BLOCK, 3)[: len(samples)], rtol=0, atol=1e-9)
        np.testing.assert_allclose(samples.times_s, 3 * np.arange(len(samples)) / 20_000.0, atol=1e-9)


def test_gaps_are_reported_with_their_size() -> None:
    with on_memory(channels=CHANNELS) as (rig, daq):
        rig.publish(*GROUPS)
        rig.publish("forces", skip=2, blocks=2)
        rig.publish("probes", "hammer", blocks=4)
        blocks = [daq.read(10 * BLOCK, timeout_s=0.2) if n == 0 else daq.read(BLOCK) for n in range(2)]
        assert [(block.index, len(block), block.gap) for block in blocks] == [
            (0, BLOCK, 0),
            (3 * BLOCK, BLOCK, 2 * BLOCK),
        ]
        assert [(gap.key, gap.index, gap.size) for gap in daq.gaps] == [("forces", BLOCK, 2 * BLOCK)]


def test_the_iterator_ends_with_the_run() -> None:
    with on_memory(channels=CHANNELS) as (rig, daq):
        rig.publish(*GROUPS, blocks=2)
        rig.end()
        assert [len(samples) for samples in daq.blocks(150)] == [150, 150, 100]
        with pytest.raises(StreamEndedError, match="the rig's run has ended: completed"):
            daq.read()


def test_an_end_that_overtakes_blocks_waits_for_them() -> None:
    with on_memory(channels=["P_N"]) as (rig, daq):
        rig.publish("forces")
        rig.index["forces"] = 3 * BLOCK
        rig.end()
        rig.index["forces"] = BLOCK
        rig.publish("forces", blocks=2)
        assert sum(map(len, daq)) == 3 * BLOCK


def test_an_end_does_not_overtake_rows_being_delivered() -> None:
    """Blocks and events arrive on separate threads: the end, while the last block is still being delivered."""
    received, held, on_the_way = [], threading.Event(), threading.Event()

    class Threads(MemoryClient):
        def subscribe(self, key: str, callback: Any, **_: Any) -> None:
            takes[key] = callback

    def hold(_: wire.Block) -> None:
        on_the_way.set()
        held.wait(PATIENCE_S)

    takes: dict[str, Any] = {}
    with MemoryServer(cache=10) as server, Threads(server) as client, MemoryClient(server) as keeper:
        rig, sent = FakeRig(server), {}
        for key in (wire.sensor_key("forces"), wire.EVENTS):
            keeper.subscribe(key, sent.__setitem__)
        rows = stream.RigStream(client)
        rows.listen(wire.sensor_key("forces"), hold, lambda _: None)
        rows.listen(wire.sensor_key("forces"), lambda block: received.append(len(block.values)), received.append)
        rig.publish("forces")
        rig.end()
        threads = [threading.Thread(target=takes[key], args=each) for each in sent.items() for key in each[:1]]
        threads[0].start()
        assert on_the_way.wait(PATIENCE_S)
        threads[1].start()
        threads[1].join(0.2)
        held.set()
        for thread in threads:
            thread.join(PATIENCE_S)
    assert received == [BLOCK, "the rig's run has ended: completed"]


def test_an_end_without_row_numbers_allows_time_for_the_last_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "GRACE_S", 0.2)
    with on_memory(channels=["P_N"]) as (rig, daq):
        rig.publish("forces")
        rig.server.publish(wire.EVENTS, b'{"event": "end", "reason": "completed"}')
        rig.publish("forces", blocks=2)
        assert [len(samples) for samples in daq.blocks(2 * BLOCK)] == [2 * BLOCK, BLOCK]
        with pytest.raises(StreamEndedError, match="the rig's run has ended: completed"):
            daq.read()


@pytest.mark.wallclock
def test_an_end_without_row_numbers_waits_for_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a delayed machine the last blocks come later than the grace after the end, but close together."""
    monkeypatch.setattr(stream, "GRACE_S", 1.0)
    with on_memory(channels=["P_N"]) as (rig, daq):
        rig.server.publish(wire.EVENTS, b'{"event": "end", "reason": "completed"}')
        for _ in range(2):
            time.sleep(0.6)
            rig.publish("forces")
        assert sum(map(len, daq)) == 2 * BLOCK


def test_a_rig_that_is_killed_raises_after_its_last_rows() -> None:
    with on_memory(channels=["P_N"]) as (rig, daq):
        rig.publish("forces")
        rig.server.close()
        rows: list[int] = []
        with pytest.raises(RigLostError, match="the link to the rig is lost"):
            rows.extend(map(len, daq))
        assert sum(rows) == BLOCK
        with pytest.raises(RigLostError):
            daq.read()
        with pytest.raises(RigLostError):
            asyncio.run(daq.aread())


def test_a_rig_that_is_killed_raises_in_the_program_that_waits_for_its_function() -> None:
    taken: list[Samples] = []
    with on_memory(channels=["P_N"]) as (rig, daq):
        daq.call(taken.append)
        rig.publish("forces")
        rig.server.close()
        with pytest.raises(RigLostError, match="the link to the rig is lost"):
            daq.wait(timeout_s=PATIENCE_S)
    assert sum(map(len, taken)) == BLOCK


def test_a_function_is_called_with_each_block() -> None:
    blocks: list[Samples] = []
    with on_memory(channels=CHANNELS) as (rig, daq):
        daq.call(blocks.append, rows=BLOCK)
        rig.publish(*GROUPS, blocks=5)
        rig.end()
        assert daq.wait(timeout_s=PATIENCE_S)
    np.testing.assert_allclose(np.concatenate([each.values for each in blocks]), expected(0, 5 * BLOCK), atol=1e-9)


def test_an_exception_of_the_function_is_raised_again() -> None:
    with on_memory(channels=CHANNELS) as (rig, daq):
        daq.call(lambda samples: 1 / 0)
        rig.publish(*GROUPS)
        with pytest.raises(ZeroDivisionError):
            daq.wait(timeout_s=PATIENCE_S)


def test_asyncio_waits_without_holding_the_loop() -> None:
    async def use(rig: FakeRig, daq: Daq) -> None:
        reading = asyncio.create_task(daq.aread(2 * BLOCK))
        await asyncio.sleep(0.05)
        assert not reading.done()
        publishing = threading.Thread(target=lambda: rig.publish(*GROUPS, blocks=3))
        publishing.start()
        np.testing.assert_allclose((await reading).values, expected(0, 2 * BLOCK), rtol=0, atol=1e-9)
        publishing.join()
        with pytest.raises(LinkTimeoutError, match=f"{BLOCK} of 1000 rows"):
            await daq.aread(1000, timeout_s=0.05)
        rig.end()
        assert [len(samples) async for samples in daq] == [BLOCK]

    with on_memory(channels=CHANNELS) as (rig, daq):
        asyncio.run(use(rig, daq))


def test_a_slow_reader_loses_counted_rows_with_constant_memory() -> None:
    with on_memory(channels=["P_N"], buffer_s=0.1) as (rig, daq):
        rig.publish("forces", blocks=100)
        assert daq.dropped == 90 * BLOCK
        samples = daq.read(BLOCK)
        assert (samples.gap, samples.index) == (90 * BLOCK, 90 * BLOCK)
        assert daq.lost == {"forces": 0}


def test_malformed_arguments_are_refused_in_one_line() -> None:
    for options, message in [
        (
            {"channels": ["P_N", "disk_z"]},
            "channel must be one of the source's, such as disk_y, .*'disk_z'",
        ),
        ({"channels": []}, "channels must be at least one, each once"),
        ({"channels": ["P_N", "P_N"]}, "channels must be at least one, each once"),
        ({"channels": ["P_N"], "rate_hz": 3000.0}, "rate_hz must be 20000 divided by a whole number"),
    ]:
        with pytest.raises(InputError, match=message), on_memory(**options):
            pass
    for url in ("", "zenoh", "zenoh:nowhere", "pty:/dev/pts/0", "can:virtual", "can:virtual:x?layout=odd"):
        with pytest.raises(InputError, match=r"must be .*; received"):
            Daq.open(url)


def test_reading_after_closing_and_closing_twice() -> None:
    with on_memory(channels=["P_N"]) as (_, daq):
        daq.close()
        daq.close()
        with pytest.raises(StreamEndedError, match="the client was closed"):
            daq.read()


# The client on CAN.


@pytest.mark.parametrize(("layout", "step"), [("fd", 2), ("classic", 20)])
def test_frames_reproduce_the_counts_of_the_recording(layout: str, step: int) -> None:
    table = default_messages()
    # The running number wraps in the classic layout: 65,536 instants of 20 samples.
    start = 2 * step * 32_760
    for message in table.fd if layout == "fd" else table.classic:
        form = message.samples
        assert form is not None
        instants, scale = 40, 1 if layout == "fd" else step
        index = start // (step * form.rows) * step * form.rows
        rows = instants * form.rows
        counts = np.stack(
            [
                make_counts(channel.group, index, rows * step)[
                    ::step, default_table().groups[channel.group].names.index(channel.name)
                ]
                for channel in form.channels
            ],
            axis=1,
        )
        numbers = (index + step * form.rows * np.arange(instants)) // scale
        frames = [bytes(data) for data in form.pack(numbers, counts, message.length)]
        lost, short = 7, 3
        sent = [data if n != short else data[:-1] for n, data in enumerate(frames) if n != lost]
        decoder = SampleDecoder({message.name: message})
        found = decoder.decode(message.name, sent[:20], 20_000, step, index + 3000)
        found += decoder.decode(message.name, sent[20:], 20_000, step, index + 3000)
        rows = Continuity()
        followed = [each for each in (follow(rows, one) for one in found) if each is not None]
        assert rows.lost == {"": 2 * form.rows}
        assert decoder.malformed == 1
        for samples in followed:
            first = samples.index - index // step
            units = np.array([[channel.scale, channel.offset] for channel in form.channels])
            wanted = counts[first : first + len(samples)] * units[:, 0] + units[:, 1]
            # Within one step of the 16 bits, or exact.
            step_value = np.abs(units[:, 0]) * (256.0 if layout == "classic" else 1e-6)
            assert np.all(np.abs(samples.values - wanted) <= step_value + 1e-9)
            assert samples.tick == (index + first * step) * 50


@contextmanager
def on_can(layout: Schedule, *, channel: str = "", **options: Any) -> Iterator[tuple[FakeRig, Daq, Gateway]]:
    channel = channel or f"daq{next(_numbers)}"
    with MemoryServer(cache=10) as server, MemoryClient(server) as client:
        rig = FakeRig(server)
        bus = can.Bus(channel, "virtual", protocol=can.CanProtocol.CAN_FD)
        gateway = Gateway(client, bus, layout, paced=False)
        gateway.start()
        source = CanSource(f"virtual:{channel}?fd=true")
        publishing = threading.Timer(0.05, lambda: rig.publish(*default_table().groups, blocks=20))
        publishing.start()
        try:
            with Daq(source, **options) as daq:
                publishing.join()
                yield rig, daq, gateway
        finally:
            publishing.join()
            source.close()
            gateway.close()
            bus.shutdown()


@pytest.mark.parametrize(
    ("layout", "step", "steps"),
    [(Schedule(classic_hz=None, fd_hz=10_000), 2, 1e-9), (Schedule(classic_hz=1000), 20, 256.0)],
)
def test_the_same_channels_come_over_can(layout: Schedule, step: int, steps: float) -> None:
    with on_can(layout, channels=CHANNELS) as (_, daq, _):
        assert daq.rate_hz == 20_000 / step
        got = daq.read(10 * BLOCK // step)
        assert got.index == 0
        table = default_table().channels
        tolerance = np.array([abs(table[name].scale) * steps for name in CHANNELS])
        wanted = expected(got.index * step, len(got) * step, step)
        assert np.all(np.abs(got.values - wanted) <= tolerance + 1e-9)


def test_a_bus_without_a_rig_is_reported_in_one_line() -> None:
    with pytest.raises(InputError, match="can must be a bus with a rig on it"):
        Daq.open("can:virtual:empty", wait_s=0.1)


def test_a_bus_that_falls_silent_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    with on_can(Schedule(classic_hz=1000), channels=["P_N"]) as (_, daq, gateway):
        monkeypatch.setattr("drivers.sources.can._SILENCE_TIMEOUT_S", 0.3)
        gateway.close()
        rows: list[int] = []
        with pytest.raises(RigLostError, match="the link to the rig is lost"):
            rows.extend(map(len, daq.blocks(timeout_s=PATIENCE_S)))
        assert sum(rows) == 200


@pytest.mark.parametrize("state", [RigState.PREPARING, RigState.RUNNING])
def test_a_restarted_rig_on_a_bus_is_another_rig(state: RigState) -> None:
    """Its first heartbeat comes before its first samples: the state starts again, or the time steps back."""
    heartbeat = default_messages().by_name["Heartbeat"]
    sent = heartbeat.encode(state=state, beat=1, counter=0, time=0, layout=default_messages().layout)
    with (
        can.Bus(channel := f"daq{next(_numbers)}", "virtual", protocol=can.CanProtocol.CAN_FD) as bus,
        closing(CanSource(f"virtual:{channel}?fd=true")) as source,
        on_can(Schedule(classic_hz=1000), channel=channel, channels=["P_N"]),
        Daq(source, channels=["P_N"]) as daq,
    ):
        beats = (heartbeat.decode(each.data) for each in bus if each.arbitration_id == heartbeat.identifier)
        next(beat for beat in beats if beat["time"] and beat["state"] == RigState.RUNNING)
        source.send(0x20, bytes(8))
        bus.send(can.Message(arbitration_id=heartbeat.identifier, data=sent, is_extended_id=False))
        with pytest.raises(RigLostError, match="the link to the rig is lost"):
            list(daq.blocks(timeout_s=PATIENCE_S))
        with pytest.raises(RigLostError):
            source.send(0x20, bytes(8))


def test_the_end_of_a_run_is_sent_on_the_bus() -> None:
    with on_can(Schedule(classic_hz=1000), channels=["P_N"]) as (rig, daq, gateway):
        rig.end()
        assert sum(map(len, daq.blocks(timeout_s=PATIENCE_S))) == 200
        with pytest.raises(StreamEndedError, match="the rig's run has ended"):
            daq.read()
        gateway.close()


# The examples, on a rig with known counts.


@pytest.fixture
def live() -> Iterator[tuple[str, str]]:
    """A rig and its instruments over zenoh, five times slower than real time: two consecutive requests receive the same
    rows even if the machine is delayed between them.
    """
    rig_at, instruments_at = free_endpoint(), free_endpoint()
    done = threading.Event()
    with ZenohServer(rig_at) as server:
        rig = FakeRig(server)

        def publish() -> None:
            start, number = time.monotonic(), 0
            while not done.wait(max(0.0, start + 0.05 * number - time.monotonic())):
                rig.publish(*default_table().groups)
                number += 1

        thread = threading.Thread(target=publish)
        with ZenohClient(rig_at) as client, Twins(client) as twins:
            twins.serve_zenoh(instruments_at)
            thread.start()
            try:
                yield f"zenoh:{rig_at}", f"zenoh:{instruments_at}"
            finally:
                done.set()
                thread.join()


def test_the_examples_are_short_and_all_run_here() -> None:
    folder = Path(drivers.examples.__file__).parent
    names = sorted(path.stem for path in folder.glob("*.py") if path.stem != "__init__")
    assert names == ["asynchronous", "callback", "force_peak", "hammer_and_capture", "iterate"]
    for name in names:
        main = importlib.import_module(f"drivers.examples.{name}").main
        lines = inspect.getsource(main).splitlines()[2:]
        assert len(lines) <= 12, name


@pytest.mark.wallclock
def test_an_example_without_a_rig_prints_one_line() -> None:
    file = Path(drivers.examples.__file__).with_name("callback.py")
    with start_python(str(file), f"zenoh:{free_endpoint()}") as child:
        output, complaints = child.communicate(timeout=PATIENCE_S)
    assert (child.returncode, output, complaints.count("\n")) == (2, "", 1)
    assert complaints.startswith("no rig answers at 127.0.0.1:")
    assert "start one with: rig run" in complaints


def test_example_iterate(live: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    from drivers.examples.iterate import main

    main(live[0], blocks=3)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert all(line.endswith("missing before: 0") for line in lines)


def test_example_callback(live: tuple[str, str]) -> None:
    from drivers.examples.callback import main

    assert main(live[0], seconds=2.0) > 100


@pytest.mark.parametrize(("late", "name"), [(None, ""), (AsyncForce, "read"), (Daq, "aread")])
def test_example_asynchronous(live: tuple[str, str], late: Any, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """However much later one of the two begins: the first read skips rows."""
    from drivers.examples.asynchronous import main

    async def held_up(reader: Any, rows: int) -> Samples:
        monkeypatch.undo()
        await getattr(reader, name)(3000)
        return await getattr(reader, name)(rows)

    if late:
        monkeypatch.setattr(late, name, held_up)
    assert asyncio.run(main(*live)) == 0.0


def test_example_hammer_and_capture(live: tuple[str, str]) -> None:
    from drivers.examples.hammer_and_capture import main

    captured = main(*live)
    assert all(samples.gap == 0 for samples in captured)
    assert captured[-1].times_s[-1] >= 0.201


def test_example_force_peak(live: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    from drivers.examples.force_peak import main

    peaks = main(live[1], seconds=0.3)
    assert set(peaks) == {"P_N", "P_S", "P_E", "P_W"}
    assert "P_N: " in capsys.readouterr().out


@pytest.mark.wallclock
def test_a_console_opens_at_a_url_as_a_daq_does() -> None:
    endpoint = free_endpoint()
    with ZenohServer(endpoint) as server:
        server.answer(wire.STATUS, lambda _: wire.encode_document({"state": "running"}))
        server.announce()
        with Console.open(f"zenoh:{endpoint}", name="a test") as console:
            assert console.status() == {"state": "running"}
    for url in ("", "zenoh", "can:zenoh:can0", "zenoh:nowhere"):
        with pytest.raises(InputError, match=r"must be .*; received"):
            Console.open(url)
