"""Simulated time over a CAN bus: a client that joins late, and a run whose counters have wrapped."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager

import can  # noqa: TID253 - the subject
import numpy as np
import pytest

from drivers.can.gateway import Gateway
from drivers.can.schedule import Schedule
from drivers.can.signals import RigState, default_messages
from drivers.daq import Daq
from drivers.sources.can import CanSource, full_index
from drivers.sources.can_client import CanClient
from drivers.sources.samples import Samples
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import default_table
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.unit.instruments_fake import FakeRig
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.wallclock
GROUPS = tuple(default_table().groups)
RATE_HZ = default_table().groups["probes"].rate_hz
ROWS = 200
_numbers = itertools.count()

INSTANTS_S = [0.0, 20 * 60, 40 * 60, 80 * 60, 60 * 3600, 300 * 3600]
"""Beyond each wrap: of half of 2^32 us (35.8 min), of 2^32 us (71.6 min), of 2^32 samples (59.7 h at 20 kHz)."""


class LateRig(FakeRig):
    """A rig that starts at a simulated time, and then accepts commands."""

    def __init__(self, server: MemoryServer, time_s: float) -> None:
        super().__init__(server)
        self.index = dict.fromkeys(GROUPS, round(time_s * RATE_HZ))

    def step(self) -> None:
        """Publish a block that ends 10 ms later, in every group."""
        for group, index in self.index.items():
            values = np.zeros((ROWS, len(default_table().groups[group].names)), np.int32)
            block = wire.Block(index * 1_000_000 // RATE_HZ, index, float(RATE_HZ), 1e6, values)
            self.server.publish(wire.sensor_key(group), wire.encode_block(block))
            self.index[group] = index + ROWS

    @property
    def tick(self) -> int:
        return self.index["probes"] * 1_000_000 // RATE_HZ

    def _command(self, name: str, payload: bytes) -> bytes:
        return wire.encode_document({"accepted": True, "id": 1, "tick": self.tick, "time_s": self.tick * 1e-6})


@contextmanager
def late_rig(time_s: float, *, lockstep: bool = False) -> Iterator[tuple[LateRig, str]]:
    channel = f"late{next(_numbers)}"
    with (
        MemoryServer(cache=10) as server,
        MemoryClient(server) as client,
        can.Bus(channel, interface="virtual", ignore_config=True) as bus,
    ):
        rig = LateRig(server, time_s)
        with Gateway(client, bus, Schedule(), paced=False) as gateway:
            if lockstep:
                server.publish(wire.STATUS, wire.encode_document({"pace": "lockstep"}))
            rig.step()
            until(lambda: gateway.outbox.sent > 50)  # the block, not only the status
            if lockstep:
                yield rig, channel
                return
            ends = threading.Event()

            def run() -> None:
                while not ends.wait(0.02):
                    rig.step()

            running = threading.Thread(target=run)
            running.start()
            try:
                yield rig, channel
            finally:
                ends.set()
                running.join()


@pytest.mark.parametrize("time_s", INSTANTS_S)
def test_a_late_client_has_the_time_of_the_rig(time_s: float) -> None:
    with late_rig(time_s) as (rig, channel), CanClient(f"virtual:{channel}", wait_s=PATIENCE_S) as client:
        status = wire.decode_document(client.request(wire.STATUS))
        assert time_s - 0.3 <= status["time_s"] <= rig.tick * 1e-6
        reply = wire.decode_document(client.request(wire.command_key("release"), b"{}"))
        assert reply["accepted"]
        assert status["time_s"] <= reply["time_s"] <= rig.tick * 1e-6


@pytest.mark.parametrize("time_s", [80 * 60, 60 * 3600])
def test_samples_read_late_have_the_time_of_the_rig(time_s: float) -> None:
    with (
        late_rig(time_s) as (rig, channel),
        Daq(CanSource(f"virtual:{channel}", wait_s=PATIENCE_S), channels=["P_E"]) as daq,
    ):
        block = daq.read(10)
        assert time_s <= block.tick * 1e-6 <= rig.tick * 1e-6


@pytest.mark.parametrize("time_s", [40 * 60, 60 * 3600])
def test_a_client_that_joins_between_two_steps_has_the_time_of_the_rig(time_s: float) -> None:
    with (
        late_rig(time_s, lockstep=True) as (rig, channel),
        CanClient(f"virtual:{channel}", wait_s=PATIENCE_S) as client,
    ):
        assert client.source.lockstep
        status = wire.decode_document(client.request(wire.STATUS))
        assert status["time_s"] == pytest.approx(rig.tick * 1e-6)


RATES = {"rate": RATE_HZ, "fd_step": 0, "classic_step": 20, "latency": 0}


@pytest.mark.parametrize(("name", "raw"), [("Clock", {"seconds": 60 * 3600}), ("Rates", RATES)])
def test_a_client_that_joins_after_a_clock_waits_for_the_next(name: str, raw: dict[str, int]) -> None:
    """Rates and Sync alone give the time since the last wrap. A rig of version 0.1 sends no Clock before its Rates."""
    with closing(CanSource("virtual:after-clock", wait_s=0.0)) as source:

        def take(name: str, **raw: int) -> None:
            row = default_messages().by_name[name]
            source.take(row.identifier, row.encode(**raw))

        take("Rates", **RATES)
        take("Sync", index=60 * 3600 * RATE_HZ % (1 << 32), time=0)
        with pytest.raises(InputError, match="no Clock, Rates and Sync"):
            source.wait()
        take(name, **raw)
        source.wait()


def take_first_frames(source: CanSource, *, stated: int) -> None:
    """Pass the frames of a rig up to its first sample message."""
    for name, raw in (("Clock", {"classic_messages": stated}), ("Rates", RATES), ("Sync", {}), ("Samples_1", {})):
        row = default_messages().by_name[name]
        source.take(row.identifier, row.encode(**raw))


def pass_later(source: CanSource, name: str, after_s: float) -> None:
    row = default_messages().by_name[name]
    threading.Timer(after_s, source.take, (row.identifier, row.encode())).start()


def test_a_busy_machine_delays_the_samples_of_a_run_but_hides_none() -> None:
    with closing(CanSource("virtual:busy")) as source:
        take_first_frames(source, stated=2)
        pass_later(source, "Samples_2", 0.5)
        assert list(source.streams()) == ["Samples_1", "Samples_2"]


def test_without_their_number_sample_messages_are_awaited_until_none_is_new() -> None:
    """A rig of an earlier version, or its log, states none."""
    with closing(CanSource("virtual:earlier")) as source:
        take_first_frames(source, stated=0)
        pass_later(source, "Samples_2", 0.02)
        assert list(source.streams()) == ["Samples_1", "Samples_2"]


def test_a_silenced_message_is_not_awaited_for_ever_and_old_frames_are_not_passed_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("drivers.sources.can._FIRST_FRAMES_TIMEOUT_S", 0.3)
    monkeypatch.setattr("drivers.sources.can._LEAD_S", 0.1)
    found: list[Samples] = []
    with closing(CanSource("virtual:silenced", wait_s=PATIENCE_S)) as source:
        take_first_frames(source, stated=2)
        assert list(source.streams()) == ["Samples_1"]
        row = default_messages().by_name["Samples_1"]
        source.take(row.identifier, row.encode(index=7))
        source.start(["Samples_1"], None, lambda _, samples: found.append(samples), lambda *_: None)
        assert [samples.index for samples in found] == [7]


def test_a_run_that_has_ended_before_the_streams_start_ends_them() -> None:
    ends: list[tuple[str, str]] = []
    beat = default_messages().by_name["Heartbeat"]
    with (
        closing(CanSource("virtual:ended")) as source,
        can.Bus("ended", interface="virtual", ignore_config=True) as rig,
    ):
        take_first_frames(source, stated=1)
        source.streams()
        data = beat.encode(state=RigState.ENDED)
        rig.send(can.Message(arbitration_id=beat.identifier, data=data, is_extended_id=False))
        until(lambda: not any(each.name == "can ended reads" for each in threading.enumerate()))
        source.start(["Samples_1"], None, lambda *_: None, lambda *end: ends.append(end))
    assert ends == [("Samples_1", "the rig's run has ended")]


def test_an_index_is_the_nearest_with_its_low_32_bits() -> None:
    wrap = 1 << 32
    for index, near in ((7, 0), (wrap + 5, wrap - 5), (wrap - 5, wrap + 5), (3 * wrap, 3 * wrap + wrap // 4)):
        assert full_index(index % wrap, near) == index
