"""Health of the channels in a recording, compared with signals of known faults."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.health import ChannelHealth, Health, examine, pace_of
from recorder.reader import Recording
from recorder.writer import RecordingWriter
from rig.base.wire import CATALOGUE, EVENTS, PARAMETERS, SCENE, STATUS, Block, encode_block, encode_document, sensor_key
from rig.channels.table import Channel, default_table

from .recorder_stream import TICK_RATE_HZ, make_documents

ROWS, RATE_HZ = 100_000, 20_000
TIME_S = np.arange(ROWS) / RATE_HZ
GROUPS = ("probes", "accelerations")


def _channel(name: str) -> Channel:
    return default_table().channels[name]


def make_volts(name: str) -> np.ndarray:
    """Return a normal channel: its noise on a whirl of 84 Hz with a few impacts [V]."""
    channel = _channel(name)
    rng = np.random.default_rng(len(name) + ord(name[-1]))
    signal = 0.1 * np.sin(2 * np.pi * 84.3 * TIME_S)
    for impact_s in rng.uniform(0.0, 5.0, 12):
        since_s = np.maximum(TIME_S - impact_s, 0.0)
        signal += (impact_s <= TIME_S) * 0.3 * np.exp(-since_s / 1e-3)
    signal -= signal.mean()
    return channel.bias_v + signal + channel.noise_v * rng.normal(size=ROWS)


def record(path: Path, changed: dict[str, np.ndarray] | None = None, **options: Any) -> Health:
    """Write the channels, some of them changed, and examine the recording."""
    about = make_documents()
    scene = {**about[SCENE], "scene": {"sensors": options.get("sensors", {})}, **dict(options.get("about", {}))}
    with RecordingWriter(
        path, catalogue=about[CATALOGUE], parameters=about[PARAMETERS], scene=scene, view_rate_hz=0.0
    ) as file:
        ppm, late = float(str(options.get("ppm", 0.0))), options.get("late")
        for name in GROUPS:
            group = default_table().groups[name]
            volts = [(changed or {}).get(channel.name, make_volts(channel.name)) for channel in group.channels]
            scales = np.array([channel.lsb_v for channel in group.channels])
            counts = np.rint(np.stack(volts, axis=1) / scales).astype(np.int32)
            for start in range(0, ROWS, 200):
                shift = 3 if start == late else 0
                block = Block(start * 50 + shift, start, float(RATE_HZ), TICK_RATE_HZ, counts[start : start + 200])
                wall_ns = 10**18 + round(start * 50_000 * (1.0 + ppm * 1e-6))
                if name == "probes" or start != late:
                    file.write(sensor_key(name), encode_block(block), wall_ns)
        file.write(EVENTS, encode_document({"event": "warning", "tick": 5, "text": "the shaft has gone"}), 0)
        if "event" in options:
            file.write(EVENTS, encode_document({"tick": 0, **dict(options["event"])}), 0)
        status = {"tick": 5, "lateness_ms": {"max": 3.0}, "warnings": ["doubtful"], "queue": {"dropped": 2}}
        file.write(STATUS, encode_document(status), 0)
        file.finish("completed")
    return examine(Recording.open(path))


def channel(health: Health, name: str) -> ChannelHealth:
    return next(each for each in health.channels if each.name == name)


def test_a_normal_recording_has_no_doubt_and_the_true_noise(tmp_path):
    health = record(tmp_path / "a.mcap")
    assert [each.findings for each in health.channels] == [[]] * 8
    for each in health.channels:
        put_in = _channel(each.name).noise_v / abs(_channel(each.name).sensitivity_v)
        assert each.noise == pytest.approx(put_in, rel=0.12), each.name
        assert each.noise_calibrated == pytest.approx(put_in, rel=0.01)
        assert each.rows == ROWS
        assert each.limited_rows == 0
    assert health.misplaced == {}


def test_figures_are_those_of_the_samples(tmp_path):
    health = record(tmp_path / "a.mcap")
    samples = Recording.open(tmp_path / "a.mcap").samples("probes")["ring_y"]
    ring = channel(health, "ring_y")
    assert (ring.mean, ring.low, ring.high) == pytest.approx((samples.mean(), samples.min(), samples.max()))


FAULTS = {
    "noisy": ("disk_x", lambda v: v + 5e-3 * np.random.default_rng(1).normal(size=ROWS), r"noise (4\.9|5|5\.\d) times"),
    "quiet": ("disk_x", lambda v: -10.0 + 0.1 * np.sin(60.0 * TIME_S), r"noise 0\.0\d* times"),
    "stuck": ("disk_y", lambda v: np.where(TIME_S > 3.0, v[60_000], v), r"stuck for 2 s"),
    "clipped": ("ring_x", lambda v: np.where(TIME_S > 4.99, -2.0, v), r"at its limit for 0\.00995 s \(199 rows\)"),
    "off": ("ring_y", lambda v: 0.0 * v, r"at its limit for 5 s"),
    "bias": ("inner_x", lambda v: v + 0.5, r"a mean of 0\.5 V though it is AC-coupled"),
    "hum": ("outer_x", lambda v: v + 0.02 * np.sin(2 * np.pi * 50.0 * TIME_S), r"at 50 Hz: mains hum"),
    "hum60": ("outer_y", lambda v: v + 0.02 * np.sin(2 * np.pi * 60.0 * TIME_S), r"at 60 Hz: mains hum"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_found_on_its_channel_alone(tmp_path, fault):
    name, spoil, finding = FAULTS[fault]
    health = record(tmp_path / "a.mcap", {name: spoil(make_volts(name))})
    for each in health.channels:
        if each.name == name:
            assert any(re.search(finding, found) for found in each.findings), each.findings
        else:
            assert each.findings == []


def test_the_amplitude_of_the_hum_is_reported(tmp_path):
    hum = 0.02 / abs(_channel("outer_x").sensitivity_v)
    health = record(tmp_path / "a.mcap", {"outer_x": make_volts("outer_x") + 0.02 * np.sin(100.0 * np.pi * TIME_S)})
    (finding,) = channel(health, "outer_x").findings
    assert float(finding.split()[3]) == pytest.approx(hum, rel=0.05)


def test_sensors_without_noise_are_not_called_stuck(tmp_path):
    still = {name: np.full(ROWS, _channel(name).bias_v) for name in default_table().groups["probes"].names}
    quiet = record(tmp_path / "a.mcap", still, sensors={"chain": "ideal"})
    assert [each.findings for each in quiet.channels[:4]] == [[]] * 4
    noisy = record(tmp_path / "b.mcap", still)
    assert all(channel(noisy, name).findings for name in still)


@pytest.mark.parametrize("ppm", [-80.0, 0.0, 250.0])
def test_the_clock_is_measured(tmp_path, ppm):
    health = record(tmp_path / "a.mcap", ppm=ppm)
    # The wall clock runs ahead by ppm, so the simulation lags by it.
    assert health.pace_ppm == pytest.approx(-ppm, abs=2.0)
    assert health.jitter_max_ms < 0.1


def test_fetched_history_does_not_affect_the_clock_estimate():
    wall_s = np.arange(20) * 0.5
    simulated_s = np.where(wall_s < 2.0, wall_s * 10.0, 16.5 + wall_s * (1.0 + 50e-6))
    slope, jitter_ms, _, strays = pace_of(np.column_stack((simulated_s, wall_s)))
    assert slope == pytest.approx(1.0 + 50e-6, abs=1e-6)
    assert jitter_ms < 0.1
    assert strays == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("event", [{"event": "start", "pace": "none"}, {"event": "import", "files": "a.csv"}])
def test_artificial_wall_times_give_no_clock_estimate(tmp_path, event):
    assert math.isnan(record(tmp_path / "a.mcap", event=event).pace)


def test_an_import_without_calibration_is_not_judged_by_one(tmp_path):
    still = {name: np.full(ROWS, _channel(name).bias_v) for name in default_table().groups["probes"].names}
    health = record(tmp_path / "a.mcap", still, about={"import": {}})
    assert all(math.isnan(each.noise_calibrated) for each in health.channels)
    assert not any(channel(health, name).findings for name in still)


def test_blocks_with_wrong_times_and_warnings_of_the_rig_are_reported(tmp_path):
    health = record(tmp_path / "a.mcap", late=2000)
    assert health.misplaced == {sensor_key("probes"): 1}
    assert health.warnings == ["the shaft has gone", "doubtful"]
    assert health.status["lateness_ms"] == {"max": 3.0}
    assert any("dropped 2 blocks" in finding for finding in health.findings)
