"""The real rig on a CAN bus: python-can alone operates the hammer, and the bus carries the recorded values."""

from __future__ import annotations

import itertools
import re
import threading
from pathlib import Path
from typing import Any

import can  # noqa: TID253 - the subject
import numpy as np
import pytest

from drivers.can import dbc
from drivers.can.gateway import Gateway
from drivers.can.schedule import Schedule
from drivers.can.signals import CommandKind, Result, command_frame, default_messages
from drivers.console import Console
from recorder.reader import Recording
from recorder.session import RecordingSession
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import default_table
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation
from rig.serve.pacing import Lockstep
from rig.serve.service import Service
from rig.serve.transport.fanout import Fanout
from rig.serve.transport.memory import MemoryClient, MemoryServer
from rig.serve.transport.zenoh import ZenohClient
from tests.processes import COMPILE_S, free_endpoint, running_rig, start_rig
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.wallclock
TABLE = default_messages()
_channels = itertools.count()


def check_against_recording(
    frames: dict[int, list[bytes]], path: Path, *, rates: dict[bool, int], from_start: bool = True, whole: bool = True
) -> int:
    """Check that the decoded values of all sample frames equal those of the recording.

    Args:
        frames: Data of the frames by identifier.
        path: The recording.
        rates: Rate of the frames [Hz], by whether they are CAN FD.
        from_start: Whether the frames begin within the first half second of the run.
        whole: Whether every frame from the first one to the end of the run is present.

    Returns:
        Number of values compared.
    """
    recording = Recording.open(path)
    compared = 0
    for message in (*TABLE.fd, *TABLE.classic):
        samples = message.samples
        assert samples is not None
        if message.fd not in rates:
            assert message.identifier not in frames
            continue
        data = np.frombuffer(b"".join(frames[message.identifier]), np.uint8).reshape(-1, message.length)
        numbers, values = samples.unpack(data)
        step, first = 20_000 // rates[message.fd], int(numbers[0])
        each = step if message.fd else 1
        assert first < 10_000 or not from_start
        if whole:
            assert np.array_equal(numbers, first + np.arange(len(data)) * samples.rows * each)
        assert (np.diff(numbers.astype(np.int64)) > 0).all()
        rows = ((numbers.astype(np.int64)[:, None] // each + np.arange(samples.rows)) * step).ravel()
        got = samples.engineering(values)
        for column, channel in enumerate(samples.channels):
            group = default_table().groups[channel.group]
            recorded = np.concatenate([block.values for block in recording.blocks(wire.sensor_key(channel.group))])
            expected = group.engineering(recorded)[rows, group.names.index(channel.name)]
            if whole:
                assert 0 <= len(recorded[int(rows[0]) :: step]) - len(got) < samples.rows
            tolerance = channel.scale * (1e-6 if message.fd else 256)
            assert np.all(np.abs(got[:, column] - expected) <= tolerance)
            compared += len(got)
    return compared


class InProcess:
    """A rig in lockstep on python-can's virtual bus, recorded, with a raw client."""

    def __init__(self, path: Path, schedule: Schedule, scene: str) -> None:
        self.path = path
        channel = f"run-{next(_channels)}"
        self._own = can.Bus(channel, interface="virtual", ignore_config=True)
        self.bus = can.Bus(channel, interface="virtual", ignore_config=True)
        server = MemoryServer()
        simulation = Simulation(load_scene(scene, {"duration_s": "5"}))
        self._service = Service(simulation, Fanout([server]), Lockstep(), block_ticks=10_000)
        self._service.prepare()
        self.gateway = Gateway(MemoryClient(server), self._own, schedule, paced=False)
        session = RecordingSession(MemoryClient(server), path, name="recorder", history=True)
        self.console = Console(MemoryClient(server))
        self.frames: dict[int, list[bytes]] = {}
        self.summary: Any = None
        self._threads = [
            threading.Thread(target=self._service.run),
            threading.Thread(target=lambda: setattr(self, "summary", session.run())),
        ]

    def __enter__(self) -> InProcess:
        self.gateway.start()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._service.stop()
        for thread in self._threads:
            thread.join(timeout=PATIENCE_S)
        self.gateway.close()
        self.read()
        self.bus.shutdown()
        self._own.shutdown()

    def read(self) -> None:
        while (message := self.bus.recv(0.1)) is not None:
            self.frames.setdefault(message.arbitration_id, []).append(bytes(message.data))

    def decoded(self, name: str) -> list[dict[str, int]]:
        message = TABLE.by_name[name]
        return [message.decode(data) for data in self.frames.get(message.identifier, [])]

    def ask(self, identifier: int, data: bytes) -> dict[str, int]:
        self.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        before = len(self.decoded("Acknowledge"))
        until(lambda: self.read() or len(self.decoded("Acknowledge")) > before)
        return self.decoded("Acknowledge")[-1]


def test_a_valid_hammer_frame_causes_whirl_and_invalid_ones_nothing(tmp_path: Path) -> None:
    with InProcess(tmp_path / "run.mcap", Schedule(1000, 10_000), "stable-run") as rig:
        rig.console.step(200_000)
        identifier, good = command_frame(CommandKind.HAMMER, 1, force_n=100.0, duration_ms=5.0)
        bad = good[:7] + bytes([good[7] ^ 0xFF])
        assert rig.ask(identifier, bad)["result"] == Result.BAD_CHECKSUM
        strong = rig.ask(*command_frame(CommandKind.HAMMER, 1, force_n=1500.0, duration_ms=5.0))
        assert (strong["result"], strong["field"], strong["limit"]) == (Result.OUT_OF_RANGE, 1, 10_000)
        assert rig.ask(identifier, good)["result"] == Result.STALE_COUNTER
        rig.console.step(200_000)
        pulse = command_frame(CommandKind.HAMMER, 2, force_n=100.0, duration_ms=5.0)
        reply = rig.ask(*pulse)
        assert (reply["result"], reply["counter"]) == (Result.ACCEPTED, 2)
        assert rig.ask(*pulse)["result"] == Result.STALE_COUNTER
        rig.console.step(1_600_000)
        assert rig.gateway.commands.accepted == 1
        assert dict(rig.gateway.commands.refused) == {"bad_checksum": 1, "out_of_range": 1, "stale_counter": 2}
        rig.read()
    compared = check_against_recording(rig.frames, rig.path, rates={True: 10_000, False: 1000})
    assert compared == 15 * 20_000 + 15 * 2000

    # From the bus alone, by its DBC.
    database = dbc.database()
    times, x, y, force = [], [], [], []
    for data in rig.frames[TABLE.by_name["Probes"].identifier]:
        row = database.decode_message("Probes", data)
        for number in range(5):
            times.append((row["index"] + 2 * number) / 20_000)
            x.append(row[f"ring_x_{number}"])
            y.append(row[f"ring_y_{number}"])
    for data in rig.frames[TABLE.by_name["Hammer"].identifier]:
        row = database.decode_message("Hammer", data)
        force += [(row["index"] / 20_000 + n / 10_000, row[f"hammer_{n}"]) for n in range(20)]
    time_s, orbit = np.array(times), np.array(x) + 1j * np.array(y)
    pulse_s, pulse_n = np.array(force).T
    assert reply["time"] == 400_000
    assert np.abs(pulse_n[pulse_s < 0.4]).max() < 2.0
    assert pulse_n.max() == pytest.approx(100.0, rel=0.05)
    assert pulse_s[pulse_n.argmax()] == pytest.approx(0.4025, abs=0.002)
    before, after = orbit[time_s < 0.4], orbit[time_s > 1.5]
    # Hanging free in the ring, without contact.
    assert np.abs(before - before.mean()).max() < 0.3
    # Full annular backward whirl: round the ring in permanent contact, against the spin, far faster than it.
    radius = np.abs(after - after.mean())
    assert radius.min() > 0.8 * radius.max()
    assert radius.min() > 3.0 * np.abs(before - before.mean()).max()
    turns = np.diff(np.unwrap(np.angle(after - after.mean()))).sum() / (2 * np.pi)
    assert turns / (time_s[-1] - 1.5) < -2 * 6.2


def test_rig_run_on_a_virtual_bus_between_processes(tmp_path: Path) -> None:
    options, rates = ("--can-fd", "--can-classic", "--can-rate", "1000"), {True: 1000, False: 1000}
    medium = free_endpoint()
    frames: dict[int, list[bytes]] = {}
    fd = [message for message in TABLE.fd if message.samples is not None]
    enough = {message.identifier: 2 * rates[True] // message.samples.rows for message in fd}  # two seconds
    can_options = ("--can", f"zenoh:can0?endpoint={medium}", *options)
    with running_rig("stable-run", *can_options, says="rig: CAN zenoh:can0 at 1M/8M") as (child, endpoint):
        with (
            can.Bus("can0", interface="zenoh", ignore_config=True, endpoint=medium, connect_s=PATIENCE_S) as bus,
            ZenohClient(endpoint, wait_s=PATIENCE_S) as client,
        ):
            console = Console(client, timeout_s=PATIENCE_S)
            session = RecordingSession(client, tmp_path / "run.mcap", name="recorder", history=True)
            recorder = threading.Thread(target=session.run)
            recorder.start()
            requested = stopped = False
            links: dict[str, float] = {}
            while True:
                if (message := bus.recv(20.0)) is None:
                    assert stopped, "the bus is silent"
                    break  # the last frame was dropped
                assert not message.is_error_frame
                frames.setdefault(message.arbitration_id, []).append(bytes(message.data))
                if message.arbitration_id == TABLE.by_name["Sync"].identifier and not requested:
                    requested = True
                    identifier, data = command_frame(CommandKind.HAMMER, 1, force_n=100.0, duration_ms=5.0)
                    bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
                if message.arbitration_id == TABLE.by_name["Status"].identifier and requested:
                    links = links or console.status()["congestion"]
                if not stopped and links and all(len(frames.get(each, ())) >= enough[each] for each in enough):
                    stopped = True
                    console.stop()
                if message.arbitration_id == TABLE.by_name["Event"].identifier and message.data[0] == 7:
                    break
            recorder.join(timeout=PATIENCE_S)
        output, errors = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0, errors
    sent = sum(len(rows) for rows in frames.values())
    assert int(output.rpartition("CAN: ")[2].split()[0]) >= sent
    assert output.endswith(" dropped, commands accepted 1, refused 0\n"), output
    found = re.search(r"lateness .* max (\d+\.\d+) .*sent, (\d+) dropped", output, re.DOTALL)
    assert found is not None, output
    # A rig that was delayed for longer sends more frames at once than the bus queues: it drops and counts some.
    late, dropped = float(found[1]) > 100.0, int(found[2])
    assert late or not dropped, output
    (reply,) = [TABLE.by_name["Acknowledge"].decode(data) for data in frames[TABLE.by_name["Acknowledge"].identifier]]
    assert reply["result"] == Result.ACCEPTED
    assert links["can_dropped"] <= dropped
    assert links["can_load"] > 0.2
    assert links["can_load"] < 1.0 or late
    compared = check_against_recording(frames, tmp_path / "run.mcap", rates=rates, from_start=False, whole=not dropped)
    assert compared > 0.9 * 15 * 2 * sum(rates.values())


def test_an_infeasible_schedule_is_refused_before_the_run() -> None:
    from rig.cli.commands.run import run as command
    from rig.cli.groups import expand_groups

    run = expand_groups(command)

    with pytest.raises(InputError, match=r"CAN load must be .*--can-overload.*received 126\.1 % of 1M/5M"):
        run("hammer", can="virtual:x", can_fd=True, can_bitrate="1M/5M")
    with pytest.raises(InputError, match="--can must be given with the other --can options"):
        run("hammer", can_fd=True)
    with pytest.raises(InputError, match="--can must be INTERFACE:CHANNEL"):
        run("hammer", can="can0")
    with pytest.raises(InputError, match="--can must be an interface that has CAN FD"):
        run("hammer", can="slcan:/dev/null", can_fd=True)


def test_an_overloaded_bus_drops_counts_and_does_not_slow_the_rig() -> None:
    with start_rig("run",
        "stable-run", "--duration-s", "2", "--listen", free_endpoint(),
        "--can", f"zenoh:can0?endpoint={free_endpoint()}",
        "--can-fd", "--can-bitrate", "500k/1M", "--can-overload",
    ) as child:  # fmt: skip
        output, errors = child.communicate(timeout=COMPILE_S)
    assert child.returncode == 0, errors
    assert "load at most 557.3 %" in errors
    factor = re.search(r"real-time factor (\d\.\d+)", output)
    assert factor is not None
    assert float(factor[1]) > 0.5, "had it waited for the bus, it were 0.18"
    assert "blocks dropped 0" in output
    line = output.splitlines()[-1]
    sent, dropped = (int(line.split()[place]) for place in (1, 4))
    # 7500 frames per second, 557 % of the bus capacity.
    assert 0.1 < sent / (sent + dropped) < 0.4
