"""Faults of channels alone: each on artificial signals, with its name and size."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from replays.recordings.resimulation.prediction import Measured, Prediction
from replays.recordings.validation.explanations.faults import sensor_faults
from replays.recordings.validation.explanations.signals import edge_faults, is_quiet, signal_faults, steady_rows
from rig.channels.table import default_table

RATE_HZ, ROWS = 20_000, 6000
TIMES = np.arange(ROWS) / RATE_HZ


def make_signals(group: str, seed: int = 3) -> tuple[Measured, np.ndarray]:
    """Return a group with independent smooth signals in each channel, and the expected signals."""
    channels, rng = default_table().groups[group].channels, np.random.default_rng(seed)
    floor = np.array([channel.noise_v / channel.sensitivity_v for channel in channels])
    # A steady rotation, and decaying impacts.
    clean = np.stack([
        floor[c] * (900.0 * np.sin(2.0 * math.pi * (7.0 * TIMES + rng.random()))
                    + 300.0 * np.exp(-40.0 * np.maximum(TIMES - 0.15, 0.0)) * (TIMES > 0.15)
                    * np.sin(2.0 * math.pi * (170.0 + 30.0 * c) * (TIMES - 0.15)))
        + 3000.0 * (group == "forces") for c in range(len(channels))
    ], axis=1)  # fmt: skip
    values = clean + floor * rng.standard_normal(clean.shape)
    part = Measured(
        group, channels, TIMES, np.arange(ROWS), values, floor, np.ones(len(channels), dtype=bool), ideal=False
    )
    return part, clean


def find_faults(change: Callable[[np.ndarray, np.ndarray], None], group: str = "probes") -> list[tuple[str, float]]:
    """Return names and sizes of the faults found after a change of columns; `change` receives values and
    expectation.
    """
    part, clean = make_signals(group)
    values = part.values.copy()
    change(values, clean)
    found = sensor_faults({group: replace(part, values=values)}, Prediction({group: clean}, {}, 1000), 1.0)
    return [(one.name, one.value) for one in found]


def test_signals_without_a_fault_have_no_finding() -> None:
    assert find_faults(lambda values, clean: None) == []


@pytest.mark.parametrize("factor", [0.97, 1.02, 25.4, 1e-3, 2e-4])
def test_gain(factor: float) -> None:
    def change(values: np.ndarray, clean: np.ndarray) -> None:
        values[:, 2] += (factor - 1.0) * clean[:, 2]

    ((name, value),) = find_faults(change)
    assert name == ("ring_x signal" if factor < 1e-3 else "ring_x gain")
    assert value == pytest.approx(factor - 1.0, abs=1e-3)


def test_polarity_and_offset_of_a_preloaded_transducer() -> None:
    def change(values: np.ndarray, clean: np.ndarray) -> None:
        values[:, 0] = 6000.0 - values[:, 0]
        values[:, 2] += 4.0

    assert [name for name, _ in find_faults(change, "forces")] == ["P_N polarity", "P_E offset"]


@pytest.mark.parametrize("rows", [1, 7, 30])
def test_equal_delays_are_reported_together(rows: int) -> None:
    def change(values: np.ndarray, clean: np.ndarray) -> None:
        values[rows:, :2] += clean[:-rows, :2] - clean[rows:, :2]

    ((name, value),) = find_faults(change)
    assert name == "disk_x, disk_y delay"
    assert value == pytest.approx(rows / RATE_HZ, rel=0.01)


def test_a_channel_with_an_equal_delay_and_small_residues_is_grouped() -> None:
    """A ten-thousandth of gain and a small offset are residues of a fit, and no faults next to a delay."""

    def change(values: np.ndarray, clean: np.ndarray) -> None:
        values[8:, :2] += clean[:-8, :2] - clean[8:, :2]
        values[:, 1] += 2e-4 * clean[:, 1] + 2e-4 * values[:, 1].std()

    ((name, _),) = find_faults(change)
    assert name == "disk_x, disk_y delay"


@pytest.mark.parametrize("rms_s", [70e-6, 150e-6])
def test_samples_at_uneven_times_are_jitter(rms_s: float) -> None:
    def change(values: np.ndarray, clean: np.ndarray) -> None:
        taken_s = TIMES - rms_s * np.random.default_rng(5).standard_normal(ROWS)
        values[:, 2] += np.interp(taken_s, TIMES, clean[:, 2]) - clean[:, 2]

    ((name, value),) = find_faults(change)
    assert name == "ring_x jitter"
    assert value == pytest.approx(rms_s, rel=0.08)


@pytest.mark.parametrize("factor", [5.0, 20.0])
def test_white_noise_is_noise_and_no_jitter(factor: float) -> None:
    def change(values: np.ndarray, clean: np.ndarray) -> None:
        floor = make_signals("probes")[0].floor[2]
        values[:, 2] += factor * floor * np.random.default_rng(5).standard_normal(ROWS)

    ((name, value),) = find_faults(change)
    assert name == "ring_x noise"
    assert value == pytest.approx(math.hypot(1.0, factor), rel=0.02)


def test_swapped_and_turned() -> None:
    def swap(values: np.ndarray, clean: np.ndarray) -> None:
        values[:, [0, 1]] = values[:, [1, 0]]

    def turn(values: np.ndarray, clean: np.ndarray) -> None:
        c, s = math.cos(0.2), math.sin(0.2)
        values[:, 2:] += clean[:, 2:] @ np.array([[c - 1.0, s], [-s, c - 1.0]])

    assert [name for name, _ in find_faults(swap)] == ["disk_x and disk_y"]
    ((name, value),) = find_faults(turn)
    assert (name, value) == ("ring_x and ring_y angle", pytest.approx(-0.2, abs=1e-3))


def test_faults_visible_without_a_prediction() -> None:
    part, _ = make_signals("forces")
    assert signal_faults({"forces": part}) == []
    values = part.values.copy()
    values[2000:2300, 0] = values[2000, 0]
    values[:, 1] = np.minimum(values[:, 1], 3300.0)
    values[4000:4005, 3] = values[:, 3].max() + 1.0  # one short peak
    values[:, 2] += 8.0 * part.floor[2] * np.random.default_rng(0).standard_normal(ROWS)
    found = {(one.channel, one.what): one for one in signal_faults({"forces": replace(part, values=values)})}
    assert set(found) == {("P_N", "freeze"), ("P_S", "clip"), ("P_E", "noise"), ("P_W", "clip")}
    frozen = found["P_N", "freeze"]
    assert (frozen.from_s, frozen.to_s) == (pytest.approx(0.1), pytest.approx(0.11495))


def test_noise_is_judged_before_the_first_contact_only() -> None:
    """A rub looks like noise of an accelerometer; few rows before it show no noise at all."""
    part, _ = make_signals("forces")
    values = part.values.copy()
    values[200:, 2] += 8.0 * part.floor[2] * np.random.default_rng(0).standard_normal(ROWS - 200)
    rubbed = {"forces": replace(part, values=values)}
    assert [one.what for one in signal_faults(rubbed)] == ["noise"]
    assert signal_faults(rubbed, 200 / RATE_HZ) == []
    assert not is_quiet(rubbed["forces"], 50 / RATE_HZ)
    values[:, 2] = 1e3 * values[:, 2]
    assert signal_faults(rubbed, 50 / RATE_HZ) == []
    assert [one.to_s for one in signal_faults(rubbed, 200 / RATE_HZ)] == [pytest.approx(199 / RATE_HZ)]


def test_coarse_numbers_are_not_stuck() -> None:
    part, _ = make_signals("drive")
    values = np.round(part.values, 1)
    assert steady_rows(values[:, 0]).any()
    assert signal_faults({"drive": replace(part, values=values)}) == []


def test_pulses() -> None:
    edges_s = np.arange(40) / 6.2
    assert edge_faults(edges_s, 6.0, 6.2) == []
    assert "miss-pulses: in 1 of" in edge_faults(np.delete(edges_s, 7), 6.0, 6.2)[0].line
    assert "extra-pulses: 2 pulses per turn" in edge_faults(np.arange(40) / 12.4, 6.0, 6.2)[0].line
    sampled_s = np.ceil(5000.0 * edges_s) / 5000.0  # without a filter, an edge is up to a sample late
    assert edge_faults(sampled_s, 6.0, 6.2, period_s=1.0 / 5000.0) == []
    assert "missing or doubled" in edge_faults(sampled_s - 0.001 * (edges_s > 3.0), 6.0, 6.2, period_s=2e-4)[0].line
    assert "none in 3.1 turns" in edge_faults(edges_s[:0], 0.5, 6.2, from_s=0.0)[0].line
    assert edge_faults(edges_s[:0], 0.2, 6.2, from_s=0.0) == edge_faults(edges_s[:0], 0.5, 6.2) == []


@pytest.mark.parametrize(("change_s", "line"), [
    (0.5, "extra-pulses: in 2 of"), (0.05, "longer than the others by -8.065 ms: samples are missing or doubled in it"),
    (-0.05, "longer than the others by +8.065 ms: its time jumps"),
])  # fmt: skip
def test_a_pulse_at_the_wrong_time_has_one_name(change_s: float, line: str) -> None:
    """A pulse half a turn after another, and all pulses from the 20th on a fraction of a turn too early."""
    edges_s = np.arange(40) / 6.2
    if change_s == 0.5:
        edges_s = np.insert(edges_s, 20, edges_s[19] + 0.5 / 6.2)
    else:
        edges_s[20:] -= change_s / 6.2
    (fault,) = edge_faults(edges_s, 7.0, 6.2)
    assert line in fault.line
    assert fault.from_s == pytest.approx(edges_s[19])
