"""What every door of a rig must do, as its users start it: zenoh, CAN, NI-DAQmx, Foxglove and Modbus.

| test | what must hold |
|---|---|
| rows | equal to those of the recording, with the rig's channels and with own channels at several rates |
| fault | injected through the rig, visible through the door |
| malformed | refused; the rig does not change, and the next client is served |
| commands | refused without `--allow-commands`, where the door has that rule |
| stalled | a reader that stalls learns of its loss; the rig and other readers continue |
| killed | a client that began before the rig is served, and learns that the rig was killed; its successor is served |
"""

from __future__ import annotations

import random
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from drivers.console import Console
from recorder.session import RecordingSession
from rig.channels.channel_file import read_channels
from rig.channels.table import ChannelTable, default_table
from rig.serve.transport.zenoh import ZenohClient
from tests import processes
from tests.doors import DOORS, Door, Recorded
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.wallclock
SCENE = ("run", "hammer", "--set", "commands=[]", "--set", "drive.speed_hz=12", "--duration-s", "86400")
SEVERAL_RATES = """
drop = ["outer_x"]
[groups.forces]
rate_hz = 10000
[groups.accelerations]
rate_hz = 5000
"""
# CAN refuses several rates by name, because its frames have one Sync for all channels; see test_can_run.py.
RATES = [(name, several) for name in DOORS for several in (False, True) if (name, several) != ("CAN", True)]
# zenoh and CAN have no such rule: who may command is decided by the keys of an exposed rig (test_access.py) or the bus.
ALLOWED = [name for name, door in DOORS.items() if door.has_server]


@dataclass
class Bench:
    """A rig in lockstep with a door."""

    door: Door
    table: ChannelTable
    process: subprocess.Popen[str]
    console: Console
    address: Any
    read_only: Any
    now_s: float = 0.0

    def step(self, duration_s: float) -> float:
        """Step the rig and return its time [s]."""
        self.console.step(round(1e6 * duration_s))
        self.now_s = round(self.now_s + duration_s, 9)
        return self.now_s

    def open(self, address: Any = None) -> Any:
        """Return a new client, whose first rows are the next ones."""
        client = self.door.open(self.table, address or self.address)
        client.time_s = self.now_s
        return client

    def stop(self) -> None:
        """Stop the rig, which must end without an error."""
        self.console.stop()
        output = self.process.communicate(timeout=PATIENCE_S)
        assert self.process.returncode == 0, output


@contextmanager
def start_rig(door: Door, *options: str, channels: Path | None = None) -> Iterator[Any]:
    with processes.start_rig(*SCENE, *door.rig_options(channels), *options) as child:
        processes.read_line(child, "listening on")
        yield child


@contextmanager
def make_bench(name: str, folder: Path, *, several: bool = False) -> Iterator[Bench]:
    door, channels = DOORS[name](), None
    if several:
        channels = folder / "several.toml"
        channels.write_text(SEVERAL_RATES)
    table = default_table() if channels is None else read_channels(channels)
    with (
        start_rig(door, "--pace", "lockstep", channels=channels) as child,
        Console.open(f"zenoh:{door.endpoint}", wait_s=PATIENCE_S) as console,
        door.serve(*door.access) as (_, address),
        door.serve() as (_, read_only),
    ):
        yield Bench(door, table, child, console, address, read_only)


@pytest.mark.parametrize(("name", "several"), RATES)
def test_rows_are_those_of_the_recording(name: str, several: bool, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with ExitStack() as stack:
        bench = stack.enter_context(make_bench(name, tmp_path, several=several))
        link = stack.enter_context(ZenohClient(bench.door.endpoint, wait_s=PATIENCE_S))
        session = RecordingSession(link, path, name="recorder", history=True)
        recorder = threading.Thread(target=session.run)
        recorder.start()
        until(lambda: any(each.startswith("recorder") for each in bench.console.status()["clients"]))
        client = stack.enter_context(bench.open())
        client.read(bench.step(0.5))
        bench.console.fault("disk_y", "gain", factor=1.5)
        client.act()
        client.read(bench.step(0.3))
        client.read(bench.step(0.2))
        bench.stop()
        recorder.join(PATIENCE_S)
        client.compare(recorded := Recorded.read(path))
    assert len(recorded.counts) == 14 if several else 15


@pytest.mark.parametrize("name", DOORS)
def test_a_stalled_reader_learns_of_its_loss_and_delays_nobody(name: str) -> None:
    door, table = DOORS[name](), default_table()
    with (
        start_rig(door) as child,
        Console.open(f"zenoh:{door.endpoint}", wait_s=PATIENCE_S) as console,
        door.serve(*door.stall_options) as (_, address),
        door.open(table, address) as steady,
        door.open(table, address, **door.stall_settings) as stalled,
    ):
        stalled.receive()
        begin_s = console.status()["time_s"]
        while console.status()["time_s"] < begin_s + door.stall_s:
            steady.receive()
        assert stalled.loss()
        steady.receive()
        assert child.poll() is None


@pytest.mark.parametrize("name", DOORS)
def test_a_client_before_the_rig_is_served_and_learns_of_its_end(name: str) -> None:
    door, table = DOORS[name](), default_table()
    caught: list[Any] = []
    with door.serve(*door.access) as (_, address):
        early = threading.Thread(target=lambda: caught.append(door.open(table, address)))
        early.start()
        with start_rig(door) as first:
            early.join(PATIENCE_S)
            with caught.pop() as client:
                client.receive()
                first.kill()
                end = client.end()
                assert end
                assert "Traceback" not in end
                with start_rig(door) as second, door.open(table, address) as other:
                    other.receive()
                    if door.continues:
                        client.resume()
                    assert second.poll() is None


# A rig in lockstep ends if it is not stepped for five minutes, so its tests come last, one after another.
@pytest.fixture(scope="module")
def bench(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with make_bench(request.param, tmp_path_factory.mktemp("bench")) as bench:
        yield bench
        bench.stop()


every_door = pytest.mark.parametrize("bench", list(DOORS), indirect=True)


@every_door
def test_a_fault_is_seen(bench: Bench) -> None:
    with bench.open() as client:
        fault = bench.console.fault("disk_x", "open", level_v=-3.0)
        client.read(bench.step(0.5))
        assert client.volts("disk_x") == pytest.approx(-3.0, abs=0.01)
        assert client.volts("disk_y") != pytest.approx(-3.0, abs=0.5)
        bench.console.clear(fault.fault)


@every_door
def test_malformed_messages_change_nothing(bench: Bench) -> None:
    before = bench.console.status()
    bench.door.attack(bench.address, random.Random(5), 300)
    after = bench.console.status()
    assert [after[key] for key in ("tick", "commands", "state", "warnings")] == [
        before[key] for key in ("tick", "commands", "state", "warnings")
    ]
    with bench.open() as client:
        client.read(bench.step(0.5))
        client.act()


@pytest.mark.parametrize("bench", ALLOWED, indirect=True)
def test_commands_are_refused_unless_allowed(bench: Bench) -> None:
    before = bench.console.status()["commands"]
    error, words = bench.door.refusal
    with bench.open(bench.read_only) as client:
        with pytest.raises(error, match=words):
            client.act()
        assert bench.console.status()["commands"] == before
        client.read(bench.step(0.5))
