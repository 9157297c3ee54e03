"""One contract for all instruments on all links: the user of a driver need not know the link."""

from __future__ import annotations

import asyncio
import itertools
import os
import random
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from drivers.can.bus.hub import Hub
from drivers.can.bus.model import BusModel
from drivers.daq import Daq
from drivers.instruments.accelerometer.driver import Accelerometer, AsyncAccelerometer
from drivers.instruments.common import protocol
from drivers.instruments.common.aio import AsyncInstrument, AsyncSampler
from drivers.instruments.common.driver import Instrument, Sampler
from drivers.instruments.common.protocol import ProtocolError
from drivers.instruments.common.twin import Twin
from drivers.instruments.drive.driver import AsyncDrive, Drive
from drivers.instruments.force.driver import AsyncForce, Force
from drivers.instruments.hammer.driver import AsyncHammer, Hammer
from drivers.instruments.magnet.driver import AsyncMagnet, Magnet
from drivers.instruments.proximity.driver import AsyncProximity, Proximity
from drivers.instruments.twins import TWINS, Twins
from drivers.link import Address, Link, LinkClosedError, LinkError, LinkTimeoutError, frames, open_link
from drivers.link.port import MessagePort
from drivers.link.serial import open_pty, open_serial
from drivers.sources.rig import RigSource
from drivers.sources.samples import Samples, StreamEndedError
from rig.base.errors import InputError, RefusedError
from rig.channels.table import default_table
from rig.serve.transport import RigLostError
from rig.serve.transport.memory import MemoryClient, MemoryServer
from rig.serve.transport.zenoh import ZenohClient, ZenohServer
from tests.processes import free_endpoint
from tests.unit import link_memory as memory
from tests.unit.instruments_fake import BLOCK, FakeRig, expected_values
from tests.waiting import PATIENCE_S, time_limit, until

pytestmark = pytest.mark.wallclock

LINKS = ("memory", "pty", "zenoh", "can", "can-zenoh")
"""`can` is classic CAN of python-can's own virtual bus, one bus per instrument; `can-zenoh` is CAN FD on a hub."""
KINDS = {twin.CODEC.address.name: twin for twin in TWINS}
DRIVERS: dict[str, tuple[type[Instrument], type[AsyncInstrument[Any]]]] = {
    "proximity": (Proximity, AsyncProximity),
    "force": (Force, AsyncForce),
    "accelerometer": (Accelerometer, AsyncAccelerometer),
    "hammer": (Hammer, AsyncHammer),
    "drive": (Drive, AsyncDrive),
    "magnet": (Magnet, AsyncMagnet),
}
SAMPLERS = ("proximity", "force", "accelerometer", "hammer", "drive")
ACTS: dict[str, tuple[Callable[[Any], Any], tuple[str, dict[str, Any]]]] = {
    "hammer": (
        lambda hammer: hammer.trigger(force_n=250.0, duration_ms=4.0, direction=-30.5),
        ("hammer", {"force_n": 250.0, "duration_ms": 4.0, "direction": -30.5}),
    ),
    "drive": (lambda drive: drive.set_speed(5.25), ("speed", {"speed_hz": 5.25})),
    "magnet": (lambda magnet: magnet.release(), ("release", {})),
}
_channels = itertools.count()


@dataclass
class Bench:
    """A fake rig, and the means to open its instruments on one kind of link."""

    link: str
    server: MemoryServer
    rig: FakeRig
    twins: Twins
    closing: ExitStack
    buses: ExitStack
    """Closed last."""
    url: str = ""

    def open_link(self, name: str) -> Link:
        """Open the host's end of a link to an instrument, which is started on it."""
        kind = KINDS[name]
        if self.link == "memory":
            near, far = memory.make_pair()
            self.twins.serve(kind, MessagePort(near, "memory:"))
            return far
        if self.link == "pty":
            line, path = open_pty()
            self.twins.serve(kind, MessagePort(line, f"pty:{path}"))
            return open_link(f"pty:{path}", kind.CODEC.address)
        if self.link == "can":
            spec = f"virtual:bench{next(_channels)}"
            self.twins.serve_can(spec, kinds=(kind,))
            return open_link(f"can:{spec}", kind.CODEC.address)
        if not self.url:
            endpoint = free_endpoint()
            if self.link == "zenoh":
                self.twins.serve_zenoh(endpoint)
                self.url = f"zenoh:{endpoint}"
            else:
                server = self.buses.enter_context(ZenohServer(endpoint))
                self.buses.enter_context(Hub(BusModel("1M/8M"), "can0", server))
                self.twins.serve_can(f"zenoh:can0?endpoint={endpoint}")
                self.url = f"can:zenoh:can0?endpoint={endpoint}"
        return open_link(self.url, kind.CODEC.address)

    def open(self, name: str, *, timeout_s: float = 5.0) -> Any:
        """Open the driver of an instrument."""
        driver = DRIVERS[name][0](self.open_link(name), timeout_s=timeout_s)
        self.closing.callback(driver.close)
        return driver

    def twin(self, name: str) -> Twin:
        return next(twin for twin in self.twins.twins if twin.CODEC.address.name == name)


@pytest.fixture(params=LINKS)
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    yield from _bench(request.param)


@pytest.fixture
def memory_bench() -> Iterator[Bench]:
    yield from _bench("memory")


def _bench(link: str) -> Iterator[Bench]:
    with ExitStack() as buses, ExitStack() as closing:
        server = closing.enter_context(MemoryServer(cache=10))
        client = closing.enter_context(MemoryClient(server))
        twins = closing.enter_context(Twins(client))
        yield Bench(link, server, FakeRig(server), twins, closing, buses)


def drain(driver: Sampler) -> tuple[int, int]:
    """Read until the stream is silent; return the numbers of received rows and of missing rows between them."""
    rows = missing = 0
    while True:
        try:
            samples = driver.read(timeout_s=0.3)
        except LinkTimeoutError:
            return rows, missing
        rows += len(samples)
        missing += samples.gap


def group_of(name: str) -> str:
    group = KINDS[name].GROUP
    assert group is not None
    return group


def test_every_instrument_reports_identity_and_calibration(bench: Bench) -> None:
    for name in DRIVERS:
        sheet = bench.open(name).identify()
        assert sheet.virtual
        assert sheet.serial.startswith("VIRTUAL-")
        assert sheet.model == f"{name} (virtual)"
        group = KINDS[name].GROUP
        assert sheet.channels == (() if group is None else default_table().groups[group].channels)
        assert all(channel.kind == "assumed" for channel in sheet.channels)
        assert sheet.acts == {"hammer": ("Hit",), "drive": ("SetSpeed",), "magnet": ("Release",)}.get(name, ())


def test_the_same_engineering_values_come_over_every_link(bench: Bench) -> None:
    for name in SAMPLERS:
        group = group_of(name)
        with bench.open(name) as driver:
            configuration = driver.configure()
            driver.start()
            bench.rig.publish(group, blocks=2)
            samples = driver.read(2 * BLOCK)
            table = default_table().groups[group]
            assert samples.names == configuration.channels == table.names
            assert samples.units == tuple(channel.unit for channel in table.channels)
            assert (samples.index, samples.tick, samples.gap, samples.rate_hz) == (0, 0, 0, 20_000.0)
            np.testing.assert_allclose(samples.values, expected_values(group, 0, 2 * BLOCK), rtol=0, atol=1e-9)
            np.testing.assert_allclose(samples.times_s, np.arange(2 * BLOCK) / 20_000.0, atol=1e-12)


def test_channels_and_a_slower_rate_can_be_chosen(bench: Bench) -> None:
    group = group_of("force")
    driver = bench.open("force")
    configuration = driver.configure(channels=["P_W", "P_S"], rate_hz=20_000 / 7)
    assert configuration.channels == ("P_S", "P_W")
    driver.start()
    bench.rig.publish(group, blocks=5)
    rows = -(-5 * BLOCK // 7)
    samples = driver.read(rows)
    assert len(samples) == rows
    np.testing.assert_allclose(samples.values, expected_values(group, 0, 5 * BLOCK, 7)[:, [1, 3]], rtol=0, atol=1e-9)
    np.testing.assert_allclose(samples.times_s, np.arange(rows) * 7 / 20_000.0, atol=1e-12)


def test_an_invalid_configuration_is_refused(bench: Bench) -> None:
    driver = bench.open("force")
    with pytest.raises(RefusedError, match="rate_hz must be 20000 divided by a whole number; received 3000"):
        driver.configure(rate_hz=3000.0)
    with pytest.raises(RefusedError, match="finite"):
        driver.configure(rate_hz=float("nan"))
    with pytest.raises(RefusedError, match="rate_hz"):
        driver.configure(rate_hz=-1.0)
    with pytest.raises(InputError, match="channel must be one of P_N, P_S, P_E, P_W; received 'disk_x'"):
        driver.configure(channels=["disk_x"])
    with pytest.raises(InputError, match="rows must be at least 1"):
        driver.read(0)
    with pytest.raises(InputError, match="after start"):
        driver.read(1)


def test_a_gap_is_reported_with_its_size(bench: Bench) -> None:
    group = group_of("proximity")
    driver = bench.open("proximity")
    driver.start()
    bench.rig.publish(group)
    bench.rig.publish(group, blocks=2, skip=3)
    before, after = driver.read(3 * BLOCK), driver.read(2 * BLOCK)
    assert (before.index, len(before), before.gap) == (0, BLOCK, 0)
    assert (after.index, len(after), after.gap) == (4 * BLOCK, 2 * BLOCK, 3 * BLOCK)
    np.testing.assert_allclose(after.values, expected_values(group, 4 * BLOCK, 2 * BLOCK), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ACTS)
def test_commands_are_acknowledged_with_their_time_or_refused_with_the_rigs_text(bench: Bench, name: str) -> None:
    act, request = ACTS[name]
    driver = bench.open(name)
    done = act(driver)
    assert (done.id, done.tick, done.time_s) == (1, 1000, 1e-3)
    assert bench.rig.commands == [request]
    bench.rig.refusal = "force_n must be from 1 to 1000; received 5000"
    with pytest.raises(RefusedError) as caught:
        act(driver)
    assert str(caught.value) == bench.rig.refusal
    assert len(bench.rig.commands) == 2


def test_invalid_numbers_never_reach_the_rig(bench: Bench) -> None:
    with pytest.raises(RefusedError, match="finite"):
        bench.open("hammer").trigger(force_n=float("nan"))
    with pytest.raises(RefusedError, match="finite"):
        bench.open("drive").set_speed(float("inf"))
    assert bench.rig.commands == []


def test_a_command_is_executed_while_data_stream(bench: Bench) -> None:
    hammer = bench.open("hammer")
    hammer.start()
    bench.rig.publish("hammer", blocks=5)
    assert hammer.trigger().id == 1
    bench.rig.publish("hammer", blocks=5)
    np.testing.assert_allclose(
        hammer.read(10 * BLOCK).values, expected_values("hammer", 0, 10 * BLOCK), rtol=0, atol=1e-9
    )


def test_twins_and_daq_read_only_sensors_and_events(monkeypatch: pytest.MonkeyPatch) -> None:
    read, good = set(), MemoryClient.subscribe

    def subscribe(client: MemoryClient, key: str, *arguments: Any, **settings: Any) -> None:
        read.add(key)
        good(client, key, *arguments, **settings)

    monkeypatch.setattr(MemoryClient, "subscribe", subscribe)
    for bench in _bench("memory"):
        for name in SAMPLERS:
            bench.open(name).start()
        with Daq(RigSource(MemoryClient(bench.server))):
            pass
    assert read == {f"rig/sensors/{group_of(name)}" for name in SAMPLERS} | {"rig/events"}


def test_instruments_reconnect_to_a_restarted_rig() -> None:
    endpoint = free_endpoint()
    with ExitStack() as closing:
        first = ZenohServer(endpoint)
        closing.callback(first.close)
        rig = FakeRig(first)
        twins = closing.enter_context(Twins(closing.enter_context(ZenohClient(endpoint))))
        near, far = memory.make_pair()
        twins.serve(KINDS["force"], MessagePort(near, "memory:"))
        force = closing.enter_context(Force(far, timeout_s=PATIENCE_S))
        force.start()
        with publishing(rig):
            assert len(force.read(3 * BLOCK, timeout_s=PATIENCE_S)) == 3 * BLOCK
        first.close()
        with pytest.raises(RigLostError, match="the link to the rig is lost"):
            read_on(force)
        rig = FakeRig(closing.enter_context(ZenohServer(endpoint)))
        until(lambda: answers(force))
        force.start()
        with publishing(rig):
            samples = force.read(3 * BLOCK, timeout_s=PATIENCE_S)
        np.testing.assert_allclose(samples.values, expected_values("forces", samples.index, len(samples)), atol=1e-9)


def read_on(force: Force) -> None:
    while True:
        force.read(1)


@contextmanager
def publishing(rig: FakeRig) -> Iterator[None]:
    """Publish blocks repeatedly: a subscription may take some time to arrive."""
    done = threading.Event()

    def work() -> None:
        while not done.wait(0.02):
            rig.publish("forces")

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def answers(driver: Instrument) -> bool:
    try:
        return driver.identify().virtual
    except LinkError:
        return False


def test_the_magnet_measures_nothing(bench: Bench) -> None:
    magnet = bench.open("magnet")
    with pytest.raises(RefusedError, match="measurements"):
        magnet.ask(protocol.Start(), protocol.Started)


def test_timeouts_raise_and_lose_nothing(bench: Bench) -> None:
    driver = bench.open("force")
    driver.start()
    with pytest.raises(LinkTimeoutError, match=r"force: 0 of 10 rows came in 0\.05 s"):
        driver.read(10, timeout_s=0.05)
    bench.rig.publish("forces")
    with pytest.raises(LinkTimeoutError, match=f"force: {BLOCK} of {2 * BLOCK} rows came"):
        driver.read(2 * BLOCK, timeout_s=0.4)
    bench.rig.publish("forces")
    assert len(driver.read(2 * BLOCK)) == 2 * BLOCK


def test_a_stream_ends_when_it_is_stopped_and_when_the_run_ends(bench: Bench) -> None:
    driver = bench.open("drive")
    driver.start()
    bench.rig.publish("drive")
    driver.stop()
    bench.rig.publish("drive")
    assert len(driver.read(5 * BLOCK)) == BLOCK
    with pytest.raises(StreamEndedError, match="stopped"):
        driver.read(1)
    driver.start()
    bench.rig.publish("drive")
    bench.rig.end()
    assert [len(samples) for samples in driver.blocks(150)] == [150, 50]
    with pytest.raises(StreamEndedError, match="the rig's run has ended: completed"):
        driver.read(1)


def test_an_instrument_can_be_closed_twice_and_then_refuses_requests(bench: Bench) -> None:
    for name in DRIVERS:
        driver = bench.open(name)
        driver.identify()
        driver.close()
        driver.close()
        with pytest.raises(LinkClosedError, match="closed"):
            driver.identify()
    bench.twins.close()
    bench.twins.close()


def test_an_instrument_can_be_opened_again(bench: Bench) -> None:
    if bench.link == "memory":
        pytest.skip("a pair has two ends and no address")
    bench.open_link("hammer").close()
    url = bench.twin("hammer").url
    for number in (1, 2, 3):
        with Hammer.open(url) as hammer:
            hammer.start()
            bench.rig.publish("hammer")
            assert hammer.read(BLOCK).index == (number - 1) * BLOCK
            if number == 2:
                # Equivalent to a killed process.
                hammer.link.close()


def test_closing_a_driver_stops_its_stream_and_no_other(memory_bench: Bench) -> None:
    driver = memory_bench.open("force")
    twin = memory_bench.twin("force")
    driver.start()
    driver.close()
    assert not twin.running
    for stream, runs in ((7, True), (2, False)):
        twin.answer(twin.CODEC.encode(protocol.Start(), 1)) if stream == 7 else None
        twin.answer(twin.CODEC.encode(protocol.Stop(stream, 0), 1))
        assert twin.running is runs


def test_another_kind_of_instrument_is_refused(memory_bench: Bench) -> None:
    driver = Hammer(memory_bench.open_link("force"), timeout_s=0.2)
    # Its reply has the instrument's own number, which a hammer does not send.
    with pytest.raises(LinkTimeoutError, match="did not reply to Identify"):
        driver.identify()
    assert driver.malformed == 1
    assert memory_bench.twin("force").refused == 1


def test_a_link_without_an_instrument_raises() -> None:
    line, path = open_pty()
    with pytest.raises(LinkTimeoutError, match=r"force did not reply to Identify in 0\.1 s"):
        Force.open(f"pty:{path}", timeout_s=0.1)
    line.close()
    with pytest.raises(LinkClosedError, match=r"no instruments reply at .*rig twins"):
        Force.open(f"zenoh:{free_endpoint()}")
    with pytest.raises(LinkError, match="force"):
        Force.open("can:virtual:nobody", timeout_s=0.2)


def test_a_missing_rig_is_reported(bench: Bench) -> None:
    driver = bench.open("proximity")
    driver.start()
    bench.rig.server.close()
    with pytest.raises(RigLostError, match="the link to the rig is lost"):
        driver.read(1)
    with pytest.raises(LinkError, match="no rig answers"):
        driver.identify()


def test_a_stopped_instrument_is_reported(bench: Bench) -> None:
    driver = bench.open("proximity")
    driver.start()
    bench.rig.publish("probes")
    bench.twins.close()
    if bench.link in ("memory", "pty"):
        # The other end has closed, which may be detected before its last message.
        with pytest.raises((StreamEndedError, LinkClosedError)):
            drain(driver)
    else:
        assert len(driver.read(BLOCK)) == BLOCK
        with pytest.raises(StreamEndedError, match="switched off"):
            driver.read(1)


@pytest.mark.parametrize("name", DRIVERS)
def test_the_asyncio_drivers_agree(memory_bench: Bench, name: str) -> None:
    async def use() -> None:
        kind: Any = DRIVERS[name][1]
        async with kind.from_link(memory_bench.open_link(name)) as instrument:
            assert (await instrument.identify()).virtual
            if isinstance(instrument, AsyncSampler):
                group = group_of(name)
                await instrument.start()
                reading = asyncio.create_task(instrument.read(BLOCK))
                memory_bench.rig.publish(group, blocks=3)
                np.testing.assert_allclose((await reading).values, expected_values(group, 0, BLOCK), atol=1e-9)
                memory_bench.rig.end()
                assert [len(samples) async for samples in instrument.blocks(150)] == [150, 150, 100]
            for method in {"hammer": ["trigger"], "drive": ["set_speed"], "magnet": ["release"]}.get(name, []):
                arguments = (5.0,) if method == "set_speed" else ()
                assert (await getattr(instrument, method)(*arguments)).id == 1
            await instrument.close()

    asyncio.run(use())


def test_random_bytes_crash_nothing(bench: Bench) -> None:
    noise = random.Random(11)
    link = bench.open_link("hammer")
    bench.closing.callback(link.close)
    driver = Hammer(link, timeout_s=PATIENCE_S)
    for _ in range(30):
        message = noise.randbytes(noise.randint(0, 60))
        if bench.link.startswith("can") and not message:
            continue
        link.send(message, timeout_s=2.0)
        # Every request gets a reply, even an invalid one.
        assert link.receive(timeout_s=2.0) is not None
    assert bench.twin("hammer").refused == 30 or bench.link.startswith("can")
    assert driver.identify().virtual
    assert bench.rig.commands == []


@pytest.mark.parametrize("name", DRIVERS)
def test_no_bytes_are_more_than_a_protocol_error_to_a_codec(memory_bench: Bench, name: str) -> None:
    codec, noise = KINDS[name].CODEC, random.Random(5)
    rows = protocol.Rows(1, 2, 3, 20_000.0, 1e6, 2, np.arange(6, dtype=np.int32).reshape(3, 2))
    whole = [
        codec.encode(message, 7)
        for message in (
            protocol.Identify(), protocol.Configure(1000.0, 3), protocol.Start(), protocol.Stop(0, 0),
            protocol.Identity("{}"), protocol.Configured(1.0, 1), protocol.Started(1), protocol.Stopped(1, 2, 3),
            protocol.Done(1, 2, 3.0), protocol.Refused(6, "no"), rows, protocol.Ended(1, "done"),
        )
    ]  # fmt: skip
    for data in whole:
        sequence, message = codec.decode(data)
        assert (sequence, codec.encode(message, 7)) == (7, data)
    memory_bench.open_link(name)
    twin = memory_bench.twin(name)
    understood = 0
    for _ in range(5000):
        data = bytearray(noise.choice(whole))
        for _ in range(noise.randint(0, 3)):
            data[noise.randrange(len(data))] = noise.randrange(256)
        data = bytes(data[: noise.randint(0, len(data))]) + noise.randbytes(noise.choice((0, 0, 3)))
        try:
            codec.decode(data)
            understood += 1
        except ProtocolError as error:
            assert len(str(error)) > 10  # noqa: PT017 - any other error fails the test
        reply = codec.decode(twin.answer(data))[1]
        assert isinstance(
            reply, protocol.Refused | protocol.Identity | protocol.Configured | protocol.Started | protocol.Stopped
        )
    assert 200 < understood < 4800


def test_a_wrong_version_and_a_wrong_length_are_named() -> None:
    codec = KINDS["drive"].CODEC
    good = codec.encode(protocol.Start(), 9)
    with pytest.raises(ProtocolError, match="version must be 1; received 2") as caught:
        codec.decode(b"\x02" + good[1:])
    assert (caught.value.reason, caught.value.sequence) == (protocol.Reason.VERSION, 9)
    with pytest.raises(ProtocolError, match="Start must be 7 bytes long; received 8"):
        codec.decode(good + b"\0")
    with pytest.raises(ProtocolError, match="at least 7 bytes"):
        codec.decode(good[:6])


def test_a_host_that_does_not_read_loses_a_reported_number_of_rows(memory_bench: Bench) -> None:
    near, far = memory.make_pair(room=5)
    twin = memory_bench.twins.serve(KINDS["force"], MessagePort(near, "memory:", room=16_000))
    driver = Force(far)
    driver.start()
    with time_limit(PATIENCE_S):
        memory_bench.rig.publish("forces", blocks=400)
    rows, missing = drain(driver)
    memory_bench.rig.publish("forces")
    last = driver.read()
    missing += last.gap
    assert missing > 50 * BLOCK
    assert rows + missing == 400 * BLOCK
    reply = twin.CODEC.decode(twin.answer(twin.CODEC.encode(protocol.Stop(0, 0), 1)))[1]
    assert isinstance(reply, protocol.Stopped)
    assert (reply.rows, reply.dropped) == (rows + BLOCK, missing)


def test_a_second_host_ends_the_stream_of_the_first() -> None:
    for bench in _bench("zenoh"):
        first, second = bench.open("force"), bench.open("force")
        first.start()
        second.start()
        bench.rig.publish("forces")
        assert len(second.read(BLOCK)) == BLOCK
        with pytest.raises(StreamEndedError, match="configured again"):
            first.read(1)


@pytest.mark.parametrize(
    "url",
    [
        "", "zenoh", "zenoh:", "zenoh:7462", "zenoh:127.0.0.1:x", "pty:", "pty:/dev/null/x", "pty:/etc/passwd",
        "pty:/dev/null", "serial:/dev/null@115200", "serial:/dev/null@12", "can:", "can:zenoh", "can:virtual:",
        "can:nothing:can0", "can:virtual:x?fd", "usb:3", "http://127.0.0.1",
    ],
)  # fmt: skip
def test_invalid_input_is_refused_in_one_line(url: str) -> None:
    with pytest.raises(InputError, match=r"must be .*; received") as caught:
        open_link(url, Address("hammer", 4))
    assert "\n" not in str(caught.value)


# The serial line's frames.


@pytest.mark.parametrize(
    ("data", "stuffed"),
    [
        # Computed by hand from the paper's rules.
        ("", "01"),
        ("00", "0101"),
        ("0000", "010101"),
        ("11220033", "0311220233"),
        ("11000000", "0211010101"),
        (bytes(range(1, 255)).hex(), "ff" + bytes(range(1, 255)).hex()),
        ("00" + bytes(range(1, 255)).hex(), "01ff" + bytes(range(1, 255)).hex()),
        (bytes(range(1, 256)).hex(), "ff" + bytes(range(1, 255)).hex() + "02ff"),
        (bytes(range(2, 256)).hex() + "00", "ff" + bytes(range(2, 256)).hex() + "0101"),
    ],
)
def test_stuffing(data: str, stuffed: str) -> None:
    assert frames.stuff(bytes.fromhex(data)).hex() == stuffed
    assert frames.unstuff(bytes.fromhex(stuffed)).hex() == data


def test_stuffing_is_reversible_for_any_bytes() -> None:
    noise = random.Random(3)
    for length in [*range(600), 5000]:
        for zeros in (0.0, 0.01, 0.5):
            data = bytes(0 if noise.random() < zeros else noise.randrange(1, 256) for _ in range(length))
            stuffed = frames.stuff(data)
            assert 0 not in stuffed
            assert len(stuffed) <= length + length // 254 + 1
            assert frames.unstuff(stuffed) == data


def test_the_checksum_agrees_with_the_catalogue() -> None:
    # CRC-16/XMODEM of "123456789" is 0x31C3.
    assert frames.encode_frame(b"123456789") == b"\x00\x0c123456789\x31\xc3\x00"


def test_frames_are_found_in_portions_of_any_size_and_between_rubbish() -> None:
    noise = random.Random(8)
    sent = [noise.randbytes(noise.randint(1, 700)) for _ in range(60)]
    stream = b"rubbish" + b"".join(frames.encode_frame(message) for message in sent) + b"\x00cut"
    for size in (1, 2, 7, 255, 4096, len(stream)):
        deframer = frames.Deframer(1000)
        found = [
            message for start in range(0, len(stream), size) for message in deframer.feed(stream[start : start + size])
        ]
        assert found == sent
        assert deframer.spoilt == 1
    # One bit anywhere corrupts one frame, or, if it adds or removes a zero, its neighbour as well.
    for _ in range(200):
        spoilt = bytearray(stream)
        spoilt[noise.randrange(8, len(stream) - 4)] ^= 1 << noise.randrange(8)
        found = frames.Deframer(1000).feed(bytes(spoilt))
        assert len(found) >= len(sent) - 2
        assert all(message in sent for message in found)


def test_a_frame_without_an_end_takes_no_memory() -> None:
    deframer = frames.Deframer(100)
    for _ in range(1000):
        assert deframer.feed(b"x" * 1000) == []
    assert len(deframer) < 200
    assert deframer.feed(frames.encode_frame(b"after"))[-1:] == [b"after"]
    assert deframer.spoilt == 1


def test_a_spoilt_line_is_counted_and_used_again(memory_bench: Bench) -> None:
    line, path = open_pty()
    memory_bench.twins.serve(KINDS["force"], MessagePort(line, f"pty:{path}"))
    noise = random.Random(2)
    with Force.open(f"pty:{path}") as force:
        other = os.open(path, os.O_RDWR | os.O_NOCTTY)
        for _ in range(20):
            os.write(other, noise.randbytes(200))
            assert force.identify().virtual
        os.close(other)
    assert line.lost > 0


def test_an_unread_line_does_not_block_the_writer() -> None:
    line, path = open_pty()
    host = open_serial(path)
    with time_limit(PATIENCE_S), pytest.raises(LinkTimeoutError, match="accepted no data"):
        line.send(b"x" * 60_000, timeout_s=0.2)
    # A new reader is synchronised after the truncated frame.
    reader = threading.Thread(target=lambda: line.send(b"last", timeout_s=PATIENCE_S))
    reader.start()
    found = []
    while not found or found[-1] != b"last":
        message = host.receive(timeout_s=2.0)
        assert message is not None
        found.append(message)
    reader.join()
    host.close()
    line.close()
    with pytest.raises(LinkClosedError):
        line.receive(timeout_s=0.1)


# Specific to each instrument.


def samples(driver: Sampler, values: np.ndarray) -> Samples:
    group = driver.datasheet.group()
    return Samples(0, 0, 1000.0, 1e6, group.names, tuple(row.unit for row in group.channels), values)


def test_probes_show_their_gap_voltage_and_whether_they_are_in_range(memory_bench: Bench) -> None:
    probes = memory_bench.open("proximity")
    at_rest = samples(probes, np.zeros((10, 4)))
    assert probes.gap_volts(at_rest) == dict.fromkeys(("disk_x", "disk_y", "ring_x", "ring_y"), -10.0)
    # 7.87 V/mm from -10 V: the limit of -2 V is at 1.0165 mm.
    near = samples(probes, np.full((10, 4), 1.017))
    assert probes.in_range(at_rest) == dict.fromkeys(at_rest.names, True)
    assert probes.in_range(near) == {"disk_x": True, "disk_y": True, "ring_x": False, "ring_y": False}


def test_peaks_and_effective_values(memory_bench: Bench) -> None:
    force, acceleration = memory_bench.open("force"), memory_bench.open("accelerometer")
    values = np.zeros((10, 4))
    values[3, 1] = 200.0
    assert force.peaks(samples(force, values))["P_S"] == (200.0, 0.003)
    wave = np.outer(np.sin(2 * np.pi * np.arange(100) / 100), [1.0, 2.0, 3.0, 4.0])
    found = acceleration.rms(samples(acceleration, wave))
    np.testing.assert_allclose(list(found.values()), np.array([1.0, 2.0, 3.0, 4.0]) / np.sqrt(2.0))
