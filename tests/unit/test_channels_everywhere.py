"""One channel table for everything: streams, the bus, recordings, exports and validation follow a user's own."""

from __future__ import annotations

import itertools
import re
import threading
from pathlib import Path

import numpy as np
import pytest

import rig
from drivers.can.gateway import Gateway
from drivers.can.schedule import Schedule
from drivers.can.signals import messages_for
from drivers.daq import Daq
from drivers.sources.can import CanSource
from drivers.sources.rig import RigSource
from recorder.reader import Recording
from replays.recordings.validation import validate
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import default_table
from rig.physics.engines import ENGINES
from rig.run.scenes import Scene, load_scene
from rig.run.simulation import Simulation
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.commands import run_for_output
from tests.unit.test_validation import record_scene

ROOT = Path(__file__).parents[2]
TABLE = ROOT / "docs/daq24.toml"
ADDED = re.findall(r"{ name = \"(\w+)\"", TABLE.read_text())
GROUPS = re.findall(r"^\[groups\.(\w+)\]", TABLE.read_text(), re.MULTILINE)
_names = itertools.count()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("channels") / "daq24.mcap"
    return record_scene(path, channels=str(TABLE), sensors__rate_hz=0)


def test_a_recording_contains_the_table_and_is_reproduced_bit_for_bit(recording: Recording) -> None:
    assert set(recording.table.channels) == {*default_table().channels, *ADDED}
    assert {recording.table.groups[name].rate_hz for name in GROUPS} == {51_200}
    again = validate(recording)
    assert again.bit_exact
    samples = recording.samples("pivot")
    # Rows are on whole numbers over the rate, though no tick is.
    np.testing.assert_array_equal(samples.times_s, np.arange(len(samples)) / 51_200)
    run = rig.simulate(Scene.model_validate(recording.scene["scene"]), {"sensors.groups": ["pivot"]})
    np.testing.assert_array_equal(samples["pivot_v"], run.samples["pivot_v"])


def test_an_export_has_the_channels_and_their_instants(recording: Recording, capsys, tmp_path: Path) -> None:
    run_for_output(
        capsys, "export", str(recording.path), "-o", str(tmp_path / "x.csv"), "--channels", "end_u,inner_beam"
    )
    table = np.loadtxt(tmp_path / "x.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table[:, 0], np.arange(len(table)) / 51_200, rtol=0, atol=1e-12)
    np.testing.assert_allclose(table[:, 1], recording.samples("probes")["end_u"], rtol=1e-6)


class PublishingRig:
    """A rig in this process, whose blocks are published as they are produced."""

    def __init__(self, server: MemoryServer) -> None:
        self.simulation = Simulation(load_scene("hammer", {"channels": str(TABLE), "sensors.noise": False}))
        self.server = server
        server.answer(wire.CATALOGUE, lambda _: wire.encode_document(self.simulation.catalogue()))
        self.values: dict[str, list[np.ndarray]] = {}

    def publish(self, blocks: int) -> None:
        for _ in range(blocks):
            frame = self.simulation.advance(10_000)
            for name, block in frame.samples.items():
                self.values.setdefault(name, []).append(self.simulation.table.groups[name].engineering(block.values))
            for key, block in frame.blocks():
                self.server.publish(key, wire.encode_block(block))

    def shown(self, name: str) -> np.ndarray:
        channel = self.simulation.table.channels[name]
        column = self.simulation.table.groups[channel.group].names.index(name)
        return np.concatenate(self.values[channel.group])[:, column]


def test_a_daq_reads_every_channel_of_the_table() -> None:
    with MemoryServer(cache=10) as server, MemoryClient(server) as client:
        played = PublishingRig(server)
        with Daq(RigSource(client), channels=["end_v", "P_N", "pivot_h"]) as daq:
            played.publish(10)
            got = daq.read(4_000)
    assert daq.rate_hz == 51_200
    for name in got.names:
        np.testing.assert_array_equal(got[name], played.shown(name)[:4_000])
    np.testing.assert_array_equal(got.times_s, np.arange(4_000) / 51_200)


def test_a_bus_carries_the_table_and_a_client_with_another_is_refused() -> None:
    import can

    channel = f"channels{next(_names)}"
    with MemoryServer(cache=10) as server, MemoryClient(server) as client:
        played = PublishingRig(server)
        schedule = Schedule(classic_hz=None, fd_hz=6_400, table=messages_for(played.simulation.table))
        bus = can.Bus(channel, "virtual", protocol=can.CanProtocol.CAN_FD)
        gateway = Gateway(client, bus, schedule, paced=False)
        gateway.start()
        source, other = (
            CanSource(f"virtual:{channel}?fd=true&channels={TABLE}"),
            CanSource(f"virtual:{channel}?fd=true"),
        )
        publishing = threading.Timer(0.05, played.publish, (20,))
        publishing.start()
        try:
            with Daq(source, channels=["end_v", "P_N", "pivot_h"]) as daq:
                publishing.join()
                got = daq.read(800)
            with pytest.raises(InputError, match=r"can must be a rig with the sample messages \d+ \(\?channels="):
                Daq(other)
        finally:
            publishing.join()
            for each in (source, other, gateway):
                each.close()
            bus.shutdown()
    assert daq.rate_hz == 6_400
    for name in got.names:
        np.testing.assert_allclose(got[name], played.shown(name)[got.index * 8 :: 8][:800], rtol=0, atol=1e-9)


def test_a_recording_of_an_earlier_version_passes() -> None:
    recording = Recording.open(ROOT / "tests/recordings/hammer-table-1.mcap")
    assert (recording.table.version, recording.samples("probes").rate_hz) == (1, 20_000)
    judged = validate(recording)
    assert judged.good, judged
    for residual in judged.residuals:
        # With today's filters, which are 4 us later, the force transducers would be off by 100 times their noise.
        if residual.channel not in ("keyphasor", "hammer"):  # one had steps instead of edges
            assert residual.rms < 1.15, residual


SIMILAR_RUNS = {
    "taylor": {"engine.tolerance": 1e-9},
    "split": {"engine.tolerance": 1e-6},
    "split in other steps": {"engine.tolerance": 1e-6, "engine.step_us": 100},
    "split in odd steps": {"engine.tolerance": 1e-6, "engine.step_us": 7},
    "tsit5": {"engine.tolerance": 1e-12},
    "rk8": {"engine.tolerance": 1e-10, "engine.step_us": 10},
}


@pytest.mark.parametrize("how", SIMILAR_RUNS)
@pytest.mark.parametrize("rate_hz", [20_000, 51_200])
def test_sensor_signals_do_not_depend_on_engine_and_step(how: str, rate_hz: int) -> None:
    def volts(changes: dict[str, object]) -> tuple[np.ndarray, np.ndarray]:
        common = {"sensors.noise": False, "sensors.rate_hz": rate_hz, "engine.companion": False}
        run = rig.simulate("hammer", {**changes, **common}, duration_s=0.06)
        channels = run.table.channels.values()
        scale = np.array([channel.sensitivity_v / channel.noise_v for channel in channels])
        return run.samples.values * scale, run.counts.values

    name = how.split()[0]
    assert name in ENGINES
    fine, _ = volts({"engine.name": "taylor", "engine.tolerance": 1e-12})
    shown_, _ = volts({"engine.name": name, **SIMILAR_RUNS[how]})
    assert np.abs(shown_ - fine).max() < 0.1, "a tenth of the noise, in every channel"
