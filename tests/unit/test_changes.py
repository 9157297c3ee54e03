"""Comparison of two recordings without a model: false alarms, and changes in the right phase and channel."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recorder.reader import Recording, join
from recorder.rewrite import cut
from recorder.writer import RecordingWriter
from replays.recordings.changes import Change, compare
from replays.recordings.changes.estimates import Estimate, decay_rate, rotation, steady
from rig.base.errors import InputError
from rig.base.outcome import Outcome
from rig.base.wire import EDGES, EVENTS, encode_block, encode_document, sensor_key
from rig.run.offline import frames
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation
from tests.commands import run_captured
from tests.unit.test_validation import record_scene

Counts = Callable[[np.ndarray], np.ndarray]


def record(
    path: Path, scene: str, seed: int, channel: str = "", change: Counts = lambda counts: counts, **changes: object
) -> Recording:
    """Record a scene, with the counts of one channel changed."""
    values = {"seed": seed, **{key.replace("__", "."): value for key, value in changes.items()}}
    simulation = Simulation(load_scene(scene, values))
    with RecordingWriter(
        path, catalogue=simulation.catalogue(), parameters=simulation.parameters_document(),
        scene=simulation.scene_document(), view_rate_hz=0.0, force=True,
    ) as writer:  # fmt: skip
        for frame in frames(simulation, chunk_s=0.1):
            for event in frame.events:
                writer.write(EVENTS, encode_document(event), 0)
            blocks = {sensor_key(name): block for name, block in frame.samples.items()}
            for name, group in simulation.table.groups.items():
                if channel in group.names:
                    counts = blocks[sensor_key(name)].values.copy()
                    column = group.names.index(channel)
                    counts[:, column] = np.rint(change(counts[:, column]))
                    blocks[sensor_key(name)] = replace(blocks[sensor_key(name)], values=counts)
            if frame.edges is not None:
                blocks[EDGES] = frame.edges
            for key, block in blocks.items():
                writer.write(key, encode_block(block), frame.tick * 1000)
        writer.finish("closed")
    return Recording.open(path)


RUN = {"sensors__rate_hz": 2000, "duration_s": 2.0}
IMPACT = {"sensors__rate_hz": 5000, "duration_s": 0.25}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record(tmp_path_factory.mktemp("changes") / "run.mcap", "stable-run", 1, **RUN)


@pytest.fixture(scope="module")
def impact(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record(tmp_path_factory.mktemp("changes") / "impact.mcap", "hammer", 1, **IMPACT)


def test_no_row_changes_with_the_noise_alone(run: Recording, impact: Recording, tmp_path: Path) -> None:
    alarms = [
        (scene, one.phase, one.channel, one.quantity)
        for scene, first, settings in (("stable-run", run, RUN), ("hammer", impact, IMPACT))
        for seed in (2, 3)
        for one in compare(first, record(tmp_path / "b.mcap", scene, seed, **settings)).changed
    ]
    assert not alarms


def test_false_alarms_keep_their_rate_in_coloured_noise() -> None:
    from scipy.signal import lfilter

    generator, turns, alarms, pairs = np.random.default_rng(7), np.arange(8000) * 0.005, 0, 40
    for _ in range(pairs):
        white = generator.standard_normal((2, 10_000))
        signals = lfilter([1.0], [1.0, -0.95], white)[:, 2000:] + 4.0 * np.sin(2.0 * np.pi * turns)
        a, b = (steady(signal, turns, 1000.0, "mm") for signal in signals)
        rows = [Change("free run", "x", *key, one, b[key], tests=len(a)) for key, one in a.items() if key in b]
        assert len(rows) == 9
        alarms += any(row.changed for row in rows)
    assert alarms <= 6, "6 of 40 are exceeded with a probability of 0.3 % at a rate of 5 %"


def test_gain_is_found_in_its_channel(run: Recording, tmp_path: Path) -> None:
    other = record(tmp_path / "b.mcap", "stable-run", 2, "disk_x", lambda counts: 1.01 * counts, **RUN)
    result = compare(run, other)
    assert {one.channel for one in result.changed} == {"disk_x"}
    gains = {one.quantity: one.b.value / one.a.value for one in result.changed}
    assert gains["1X"] == pytest.approx(1.01, abs=1e-3)
    assert result.outcome is Outcome.FAIL


def test_offset_changes_the_mean_only(run: Recording, tmp_path: Path) -> None:
    other = record(tmp_path / "b.mcap", "stable-run", 2, "P_N", lambda counts: counts + 100.0, **RUN)
    assert [(one.phase, one.channel, one.quantity) for one in compare(run, other).changed] == [
        ("free run", "P_N", "mean")
    ]


def test_noise_is_found(run: Recording, tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    louder = record(
        tmp_path / "b.mcap", "stable-run", 2, "inner_x",
        lambda counts: counts + 100.0 * generator.standard_normal(len(counts)), **RUN,
    )  # fmt: skip
    changed = compare(run, louder).changed
    assert {one.channel for one in changed} == {"inner_x"}
    assert {"noise", "RMS"} <= {one.quantity for one in changed}


def test_unbalance_changes_amplitude_and_phase_of_1x(run: Recording, tmp_path: Path) -> None:
    settings = {"shaft__unbalance_eccentricity": 0.22, "shaft__unbalance_phase": 0.3}
    changed = compare(run, record(tmp_path / "b.mcap", "stable-run", 2, **RUN, **settings)).changed
    found = {(one.channel, one.quantity) for one in changed}
    assert {("disk_x", "1X"), ("disk_y", "1X"), ("disk_x", "1X phase"), ("disk_y", "1X phase")} <= found
    assert not {channel for channel, _ in found} & {"speed", "hammer", "keyphasor"}


def test_friction_is_found_in_the_contact(impact: Recording, tmp_path: Path) -> None:
    result = compare(impact, record(tmp_path / "b.mcap", "hammer", 2, contact__friction=0.19, **IMPACT))
    phases = {one.phase for one in result.changed}
    assert "impacts" in phases
    assert "free run" not in phases
    assert {"P_N", "speed"} <= {one.channel for one in result.changed}


def test_missing_phase_is_inconclusive(impact: Recording, run: Recording, tmp_path: Path) -> None:
    cut(join([impact.path]), tmp_path / "before.mcap", to_s=0.018)
    result = compare(impact, Recording.open(tmp_path / "before.mcap"))
    assert result.outcome is Outcome.INCONCLUSIVE
    assert any(line.startswith("only in A: phase impacts") for line in result.missing)
    assert compare(run, run).outcome is Outcome.PASS


def test_phases_are_found_by_channels_that_both_recordings_have(impact: Recording, tmp_path: Path) -> None:
    """A recording without probes of the ring and without transducers shows no contact."""
    cut(join([impact.path]), tmp_path / "part.mcap", channels=("disk_x", "speed", "keyphasor"))
    part = Recording.open(tmp_path / "part.mcap")
    for pair in ((impact, part), (part, impact)):
        result = compare(*pair)
        assert result.outcome is Outcome.INCONCLUSIVE
        assert {one.channel for one in result.changes} == {"disk_x", "speed"}


def test_gaps_are_reported(impact: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gaps = record_scene(tmp_path / "gaps.mcap", duration_s=0.06, leave_out=(1, 3))
    code, out, _ = run_captured(capsys, "compare", str(gaps.path), str(impact.path))
    assert (code, "A has gaps: only the longest stretch without one is compared" in out) == (3, True)
    assert "Changes, largest first" not in out


def test_phase_that_is_too_short_is_reported(impact: Recording) -> None:
    result = compare(impact, impact)
    assert result.missing == ("not compared, as it is too short: phase free run",)
    assert result.outcome is Outcome.INCONCLUSIVE


@pytest.mark.parametrize(("from_s", "to_s"), [(0.03, 0.3), (0.4, 1.2), (0.75, 1.5)])
def test_another_stretch_of_the_same_signals_is_no_change(
    run: Recording, tmp_path: Path, from_s: float, to_s: float
) -> None:
    """Unbalance and a free vibration of almost its frequency beat: the RMS differs between stretches."""
    cut(join([run.path]), tmp_path / "part.mcap", from_s=from_s, to_s=to_s)
    assert not compare(run, Recording.open(tmp_path / "part.mcap")).changed


def test_rotation_and_decay_are_measured() -> None:
    times = np.arange(20_000) / 10_000.0
    noise = 1e-3 * np.random.default_rng(0).standard_normal(len(times))
    found = rotation(2.0 * np.pi * -81.7 * times + noise, 10_000.0)
    assert abs(found.value + 81.7) < 2.0 * found.half < 1e-4
    decay = decay_rate(np.exp(-3.0 * times) * np.sin(300.0 * times) + noise, 1e-3, 10_000.0)
    assert decay is not None
    assert abs(decay.value + -3.0) < 2.0 * decay.half < 0.3
    assert decay_rate(noise, 1e-3, 10_000.0) is None


def test_phases_differ_within_half_a_revolution() -> None:
    a, b = Estimate(179.0, 1.0, 60.0), Estimate(-179.0, 1.0, 60.0)
    assert Change("free run", "disk_x", "1X phase", "°", a, b, tests=1).difference == pytest.approx(2.0)


def test_command_reports_rows_and_status(
    run: Recording, impact: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "changes.html"
    code, out, _ = run_captured(capsys, "compare", str(run.path), str(run.path), "--report", str(page), "--wide")
    assert code == 0
    assert " of " in out.splitlines()[1]
    assert "noise [mm/√Hz]" in out
    assert "rows changed" in page.read_text(encoding="utf-8")
    code, out, _ = run_captured(capsys, "compare", str(run.path), str(impact.path))
    assert code == 3
    assert "only in B: phase impacts" in out
    louder = record(tmp_path / "b.mcap", "stable-run", 2, "P_N", lambda counts: counts + 100.0, **RUN)
    code, out, _ = run_captured(capsys, "compare", str(run.path), str(louder.path), "--json")
    document = json.loads(out)
    assert code == 1
    assert document["outcome"] == "fail"
    assert document["changed"] == sum(row["changed"] for row in document["rows"])
    sizes = [abs(row["difference"]) / row["half"] for row in document["rows"] if row["half"]]
    assert sizes == sorted(sizes, reverse=True)
    code, _, error = run_captured(capsys, "compare", str(run.path), str(tmp_path / "none.mcap"))
    assert (code, error.count("\n")) == (2, 1)


def test_recordings_without_a_common_channel_are_refused(run: Recording, tmp_path: Path) -> None:
    for name in ("disk_x", "P_N"):
        cut(join([run.path]), tmp_path / f"{name}.mcap", channels=(name,))
    parts = [Recording.open(tmp_path / f"{name}.mcap") for name in ("disk_x", "P_N")]
    with pytest.raises(InputError, match="channel of the same name and unit"):
        compare(*parts)
    result = compare(run, parts[0])
    assert result.outcome is Outcome.INCONCLUSIVE
    assert "P_N [N]" in result.missing[0]
