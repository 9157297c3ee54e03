"""Channels without noise and their derivatives: the sensors' own chain, keys of every kind, quotients that hold."""

from __future__ import annotations

import numpy as np
import pytest

from replays.experiment import Experiment
from replays.sensitivity import Predictor, derivatives, signals, value_of, with_values
from rig.errors import InputError
from rig.offline import SentCommand, simulate
from rig.scenes import load_scene

CHANNELS = ("disk_x", "ring_y", "P_E", "inner_x", "speed", "hammer")


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return Experiment(scene=load_scene("hammer", {"duration_s": 0.06}))


def test_signals_are_the_recorded_ones_but_for_noise_and_rounding(experiment: Experiment) -> None:
    found = signals(experiment, channels=CHANNELS, start_s=0.01, end_s=0.05)
    run = simulate(experiment.changed({"sensors.noise": False}).scene)
    assert found.contacts > 2
    for column, name in enumerate(CHANNELS):
        rounding = abs(run.table.channels[name].scale)
        recorded = run.samples[name][200:1000]
        assert np.abs(found.values[:, column] - recorded).max() <= 0.51 * rounding
    assert np.array_equal(found.times_s, run.sample_times_s[200:1000])


def test_a_slower_rate_has_every_second_sample(experiment: Experiment) -> None:
    whole = signals(experiment, channels=["ring_x"], end_s=0.03)
    half = signals(experiment, channels=["ring_x"], end_s=0.03, rate_hz=10_000)
    assert np.array_equal(half.values, whole.values[::2])
    with pytest.raises(InputError, match="a divisor of the sensors' 20000 Hz"):
        signals(experiment, channels=["ring_x"], end_s=0.03, rate_hz=3_000)


def test_derivatives_are_secants_of_small_steps(experiment: Experiment) -> None:
    keys = ("magnet.stiffness", "contact.stiffness", "contact.friction", "hammer.1.force_n")
    found = derivatives(experiment, keys, channels=["ring_x", "P_E"], end_s=0.034)
    assert found.good.all()
    for place, (key, part) in enumerate(zip(keys, (1e-5, 1e-3, 1e-5, 1e-5), strict=True)):
        step = part * value_of(experiment, key)
        moved = with_values(experiment, {key: value_of(experiment, key) + step})
        other = signals(moved, channels=["ring_x", "P_E"], end_s=0.034).values
        secant = (other - found.base.values) / step
        scale = np.abs(found.values[place]).max(axis=0)
        assert (np.abs(secant - found.values[place]).max(axis=0) < 0.02 * scale).all()


def test_a_value_that_acts_on_nothing_has_no_derivative(experiment: Experiment) -> None:
    found = derivatives(experiment, ["contact.friction"], channels=CHANNELS, end_s=0.02)  # before the blow
    assert not found.values.any()


def test_rules_give_way_to_numbers(experiment: Experiment) -> None:
    sag_mm = value_of(experiment, "ring.offset_y")
    assert sag_mm == pytest.approx(-1.5606, abs=1e-3)
    moved = with_values(experiment, {"ring.offset_y": sag_mm + 0.01})
    assert moved.scene.load_parameters().rule("ring.offset_y") is None
    shown = signals(moved, channels=["ring_y"], end_s=0.001).values[0, 0]
    assert shown == pytest.approx(-0.01, abs=1e-6)


def test_commands_are_numbered_by_time_wherever_they_are_from() -> None:
    scene = load_scene("hammer", {"duration_s": 0.2})
    sent = SentCommand(100_000, "hammer", {"force_n": 50.0, "duration_ms": 4.0, "direction": "y"})
    both = Experiment(scene=scene, commands=(sent,))
    assert value_of(both, "hammer.1.at_s") == 0.02
    assert value_of(both, "hammer.2.force_n") == 50.0
    assert value_of(both, "hammer.2.direction") == pytest.approx(90.0)
    same = with_values(both, {"hammer.2.force_n": 50.0})
    a, b = (signals(one, channels=["ring_x", "hammer"], end_s=0.12).values for one in (both, same))
    assert np.array_equal(a, b)
    for key in ("hammer.3.force_n", "hammer.1.loudness", "contact.frictionn", "engine.name"):
        with pytest.raises(InputError):
            value_of(both, key)


def test_times_of_blows_are_interpolated_between_rows(experiment: Experiment) -> None:
    predictor = Predictor(experiment, ["hammer.1.duration_ms"], channels=["hammer"], end_s=0.03)
    low, middle, high = (predictor.signals([value]).values for value in (5.0, 5.01, 5.025))
    assert np.allclose(middle, 0.6 * low + 0.4 * high)
    assert not np.allclose(low, high)
