"""Noise-free channels and their derivatives: a recording's own channels, keys of every kind, accurate quotients."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.prediction import LeadIns, Measured, interpolate_rows, predict, simplify
from replays.recordings.resimulation.sensitivity import Predictor, get_value, with_values
from rig.base.errors import InputError
from rig.channels.table import Channel, default_table
from rig.run.motion import MotionStart
from rig.run.offline import SentCommand, simulate
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

CHANNELS = ("disk_x", "ring_y", "P_E", "inner_x", "speed", "hammer")


def make_rows(names: tuple[str, ...], times_s: np.ndarray, **own: Any) -> dict[str, Measured]:
    """Return rows of some channels, each a group; `own` changes their calibration."""
    found = {}
    for name in names:
        channel = Channel.model_validate(default_table().channels[name].model_dump() | own)
        one = np.ones(1)
        empty = np.zeros((len(times_s), 1))
        found[name] = Measured(name, (channel,), times_s, np.arange(len(times_s)), empty, one, one > 0.0, ideal=False)
    return found


def shown(experiment: Experiment, *names: str, start_s: float = 0.0, end_s: float = 0.03, **own: Any) -> np.ndarray:
    times_s = np.arange(round(start_s * 20_000), round(end_s * 20_000)) / 20_000
    found = Predictor(experiment, (), make_rows(names, times_s, **own)).predict(())
    return np.concatenate([found.values[name] for name in names], axis=1)


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return Experiment(scene=load_scene("hammer", {"duration_s": 0.06}))


def test_channels_equal_the_recorded_ones_except_noise_and_rounding(experiment: Experiment) -> None:
    found = shown(experiment, *CHANNELS, start_s=0.01, end_s=0.05)
    run = simulate(experiment.with_changes({"sensors.noise": False}).scene)
    for column, name in enumerate(CHANNELS):
        rounding = abs(run.table.channels[name].scale)
        assert np.abs(found[:, column] - run.samples[name][200:1000]).max() <= 0.51 * rounding


def test_a_recordings_own_calibration_is_used(experiment: Experiment) -> None:
    """Volts clip where its conditioner does, and its low-pass delays by tau = 2.613 / (2 pi f), Butterworth's."""
    usual = shown(experiment, "P_E")
    assert usual.max() > 3000.0
    clipped = shown(experiment, "P_E", bandwidth_hz=18_500.0, range_v=(-3.0, 3.0))
    assert clipped.max() == pytest.approx(3000.0, rel=1e-6)
    slow = shown(experiment, "hammer", end_s=0.06, bandwidth_hz=200.0)[:, 0]
    quick = shown(experiment, "hammer", end_s=0.06, bandwidth_hz=18_500.0)[:, 0]  # no delay: half of the rows' rate
    times_s = np.arange(len(slow)) / 20_000
    delay_s = slow @ times_s / slow.sum() - quick @ times_s / quick.sum()
    assert delay_s == pytest.approx(2.6131 / (2.0 * np.pi * 200.0), rel=0.03)


def test_a_compensated_filter_shows_in_its_last_rows_what_comes_after_them(experiment: Experiment) -> None:
    linear = {"filter": "fir", "filter_order": 64, "group_delay_us": 0.0}
    in_pulse, whole = (shown(experiment, "hammer", "P_E", end_s=end_s, **linear) for end_s in (0.022, 0.04))
    assert np.abs(whole[: len(in_pulse)] - in_pulse).max() < 1e-3


@pytest.mark.parametrize("sent", [(), (SentCommand(30_500, "speed", {"speed_hz": 5.0}),)])
def test_a_late_start_is_the_same_as_from_the_start(sent: tuple[SentCommand, ...]) -> None:
    """Far from the start the channels are computed from shortly before the requested rows."""
    experiment = Experiment(scene=load_scene("hammer", {"duration_s": 4.0}), commands=sent)
    whole, late = (shown(experiment, "ring_x", "inner_x", start_s=start, end_s=3.6)[-100:] for start in (0.0, 3.5))
    assert np.abs(whole[:, 0] - late[:, 0]).max() < 1e-8
    assert np.abs(whole[:, 1] - late[:, 1]).max() < 1e-3 * np.abs(whole[:, 1]).max()


def running(**changes: Any) -> Experiment:
    """Return the experiment of a log of a running rig, with a hammer pulse at 0.85 s."""
    pulse = {"at_s": 0.85, "command": "hammer", "force_n": 90.0, "duration_ms": 5.0, "direction": "x"}
    scene = load_scene("hammer", {"duration_s": 1.0, "commands": [pulse], **changes})
    return Experiment(scene=scene, begin=MotionStart(300_000, 1e-5, -2e-5, 1e-3, 2e-3, angle=1.0), imported=True)


@pytest.mark.parametrize("rate_hz", [2048, 3001, 16_384])
def test_samples_do_not_depend_on_whether_one_falls_on_the_start(rate_hz: int) -> None:
    """At these rates none falls on 0.3 s; at times that no row shows, channels are interpolated."""
    index = np.arange(round(0.33 * rate_hz), round(0.5 * rate_hz))
    rows = make_rows(("disk_x",), index / rate_hz, rate_hz=rate_hz, bandwidth_hz=300.0)
    between = make_rows(("disk_x",), (index + 2e-6) / rate_hz, rate_hz=rate_hz, bandwidth_hz=300.0)
    exact, near = (predict(simplify(running()), one).values["disk_x"] for one in (rows, between))
    assert np.abs(exact - near).max() < 1e-5 * np.ptp(exact)


@pytest.mark.parametrize(
    ("own", "divided"),
    [
        ({}, True),
        ({"filter": "fir", "filter_order": 64}, True),
        ({"filter": "sinc", "filter_order": 3}, True),
        ({"filter": "chebyshev", "bandwidth_hz": 8500.0}, True),
        ({"bandwidth_hz": 30_000.0}, False),
        ({"highpass_hz": 0.3}, False),  # settles for seconds
    ],
)
def test_a_quiet_stretch_is_predicted_apart_where_it_can_be(own: dict[str, Any], divided: bool) -> None:
    own = {"bandwidth_hz": 5000.0, "highpass_hz": 0.0} | own
    rows = make_rows(("disk_x", "P_E", "inner_x", "hammer"), np.arange(6200, 17_400) / 20_000, **own)
    keys = ("shaft.unbalance_phase", "state.vx", "clock.offset_s", "contact.friction", "hammer.1.force_n")
    single, apart = (Predictor(running(), keys, rows, quiet_until_s=until_s) for until_s in (-np.inf, 0.82))
    values = np.add(single.start, [0.01, 0.2, 3e-6, 0.01, 1.0])
    for part in (0.0, 1e-3, 1e-2):  # the keys of contact and hammer do not change the quiet stretch
        z = np.add(values, [0.0, 0.0, 0.0, part, 10.0 * part])
        one, other = single.predict(z), apart.predict(z)
        assert one.contacts == other.contacts > 2
        assert (len(other.truth["state"]) < len(one.truth["state"])) is divided
        for name, value in one.values.items():
            assert np.abs(value - other.values[name]).max() < 1e-5 * np.ptp(value)


SPEED = {"at_s": 0.6, "command": "speed", "speed_hz": 4.5}


@pytest.mark.parametrize(
    ("changes", "until_s", "version"),
    [({}, 0.9, 2), ({}, 1.2, 2), ({}, 0.82, 1), ({"commands": [SPEED]}, 0.82, 2)],
    ids=["after the pulse", "after all rows", "version 1", "after a command"],
)
def test_no_quiet_stretch_is_predicted_apart_where_it_cannot_be(
    changes: dict[str, Any], until_s: float, version: int
) -> None:
    rows = make_rows(("disk_x",), np.arange(6200, 19_000) / 20_000, bandwidth_hz=5000.0, highpass_hz=0.0)
    rows = {name: replace(part, version=version) for name, part in rows.items()}
    single, late = (Predictor(running(**changes), (), rows, quiet_until_s=one) for one in (-np.inf, until_s))
    assert single.predict(()).values["disk_x"].tobytes() == late.predict(()).values["disk_x"].tobytes()


@pytest.mark.parametrize("truth_rate_hz", [50, 250, 1250, 2000])
def test_a_quiet_stretch_may_end_in_a_gap_and_needs_no_rate_of_the_truth(truth_rate_hz: int) -> None:
    index = np.concatenate([np.arange(6200, 15_000), np.arange(16_500, 17_400)])
    rows = make_rows(("disk_x", "inner_x"), index / 20_000, bandwidth_hz=5000.0, highpass_hz=0.0)
    running_rig = running(**{"sensors.truth_rate_hz": truth_rate_hz})
    single, apart = (Predictor(running_rig, (), rows, quiet_until_s=one).predict(()) for one in (-np.inf, 0.82))
    assert len(apart.truth["state"]) < len(single.truth["state"])
    for name, value in single.values.items():
        assert np.abs(value - apart.values[name]).max() < 1e-5 * np.ptp(value)


def test_the_prediction_of_a_log_is_accurate_after_many_impacts() -> None:
    """With the engine's default tolerance the error after ten impacts is a hundred times as large."""
    rows = make_rows(("inner_x",), np.arange(16_000, 17_600) / 20_000)
    finest = simplify(running()).with_changes({"engine.tolerance": 1e-7})
    usual, fine = (predict(one, rows) for one in (simplify(running()), finest))
    assert usual.contacts == fine.contacts > 8
    assert np.abs(usual.values["inner_x"] - fine.values["inner_x"]).max() < 1e-4 * np.abs(fine.values["inner_x"]).max()


def test_experiments_share_the_run_before_their_first_difference() -> None:
    pulse = {"at_s": 0.46, "command": "hammer", "force_n": 60.0, "duration_ms": 5.0, "direction": "x"}
    experiment = simplify(Experiment(scene=load_scene("hammer", {"duration_s": 0.5, "commands": [pulse]})))
    parts = make_rows(("ring_x", "hammer"), np.arange(9000, 10_000) / 20_000)
    lead_ins = LeadIns()
    for values in ({}, {"hammer.1.force_n": 90.0}, {"hammer.1.at_s": 0.2}, {"shaft.unbalance_phase": 0.1}):
        changed = with_values(experiment, values)
        alone, shared = predict(changed, parts), predict(changed, parts, lead_ins=lead_ins)
        assert alone.contacts == shared.contacts
        for one, other in ((alone.values, shared.values), (alone.truth, shared.truth)):
            assert {name: each.tobytes() for name, each in one.items()} == {
                name: each.tobytes() for name, each in other.items()
            }


def test_a_snapshot_without_commands_is_not_used_after_the_first_command() -> None:
    scene = load_scene("hammer", {"commands": []})
    lead = Simulation(scene)
    lead.advance(200_000)
    pulse = {"command": "hammer", "force_n": 60.0, "duration_ms": 5.0, "direction": "x"}
    for at_s, changes in ((0.1, {}), (0.3, {"seed": 7})):
        other = Simulation(load_scene("hammer", {"commands": [{"at_s": at_s, **pulse}], **changes}))
        with pytest.raises(InputError, match="snapshot must be one of this scene"):
            other.restore(lead.snapshot())


def test_values_between_samples_are_those_of_the_polynomial() -> None:
    times = np.arange(40.0)
    quintic = np.column_stack([(times / 20.0 - 1.0) ** 5, np.sin(2.0 * np.pi * times / 8.0)])
    places = np.linspace(3.3, 35.9, 57)
    found = interpolate_rows(quintic, places)
    assert found[:, 0] == pytest.approx((places / 20.0 - 1.0) ** 5, abs=1e-12)
    assert np.abs(found[:, 1] - np.sin(2.0 * np.pi * places / 8.0)).max() < 2e-3
    assert np.array_equal(interpolate_rows(quintic, np.array([0.0, 7.0, 39.0])), quintic[[0, 7, 39]])


def test_a_late_fast_clock_shows_earlier_values(experiment: Experiment) -> None:
    from scipy.interpolate import CubicSpline

    times_s = np.arange(200, 600) / 20_000
    predictor = Predictor(experiment, ("clock.offset_s", "clock.rate_ppm"), make_rows(("ring_x",), times_s))
    found = predictor.predict((1e-4, 2000.0)).values["ring_x"][:, 0]
    model = shown(experiment, "ring_x", end_s=0.04)[:, 0]
    there_s = times_s - 1e-4 - 2e-3 * (times_s - times_s[0])
    assert found == pytest.approx(CubicSpline(np.arange(len(model)) / 20_000, model)(there_s), abs=1e-4)
    assert np.abs(found - model[200:600]).max() > 1e-2


def test_a_scanner_samples_one_channel_after_another(experiment: Experiment) -> None:
    names, times_s = ("ring_x", "P_E", "ring_y"), np.arange(200, 600) / 20_000
    mapped = replace(experiment, mapped=names)
    found = Predictor(mapped, ("clock.scan_us",), make_rows(names, times_s)).predict((50.0,)).values
    model = shown(experiment, *names, end_s=0.04)
    for late, (name, values) in enumerate(zip(names, model.T, strict=True)):
        size = 0.02 * float(np.ptp(values)) + 1e-6
        assert found[name][:-2, 0] == pytest.approx(values[200 + late : 598 + late], abs=size)


def test_derivatives_are_secants_of_small_steps(experiment: Experiment) -> None:
    keys = ("magnet.stiffness", "contact.stiffness", "contact.friction", "hammer.1.force_n")
    parts = make_rows(("ring_x", "P_E"), np.arange(680) / 20_000)
    predictor = Predictor(experiment, keys, parts)
    found = predictor.derivatives(predictor.start)
    assert found.smooth.all()
    for place, part in enumerate((1e-5, 1e-3, 1e-5, 1e-5)):
        moved = predictor.start.copy()
        step = part * moved[place]
        moved[place] += step
        for name, values in predictor.predict(moved).values.items():
            secant = (values - found.base.values[name]) / step
            slope = found.slopes[place][name]
            assert np.abs(secant - slope).max() < 0.02 * np.abs(slope).max()


def test_the_length_of_a_pulse_acts_through_impacts_by_its_impulse_above_all(experiment: Experiment) -> None:
    """Apart from the force's slope, its slope is a secant at constant impulse: ticks of length bend the rest."""
    parts = make_rows(("ring_x", "P_E"), np.arange(1200) / 20_000)
    predictor = Predictor(experiment, ("hammer.1.duration_ms", "hammer.1.force_n"), parts)
    length_ms, force_n = predictor.start
    by_length, by_force = predictor.derivatives(predictor.start).slopes
    longer, shorter = (
        predictor.predict((length_ms + step, force_n * length_ms / (length_ms + step))).values
        for step in (0.001, -0.001)
    )
    for name in parts:
        shape = by_length[name] - force_n / length_ms * by_force[name]
        assert np.abs(shape - (longer[name] - shorter[name]) / 0.002).max() < 0.05 * np.abs(shape).max()
        assert np.abs(shape).max() < 0.1 * np.abs(by_length[name]).max()


def test_a_value_without_effect_has_no_derivative(experiment: Experiment) -> None:
    predictor = Predictor(
        experiment, ["contact.friction"], make_rows(CHANNELS, np.arange(400) / 20_000)
    )  # before the impact
    assert not any(slope.any() for slope in predictor.derivatives(predictor.start).slopes[0].values())


def test_numbers_override_rules(experiment: Experiment) -> None:
    sag_mm = get_value(experiment, "ring.offset_y")
    assert sag_mm == pytest.approx(-1.5606, abs=1e-3)
    moved = with_values(experiment, {"ring.offset_y": sag_mm + 0.01})
    assert moved.scene.load_parameters().rule("ring.offset_y") is None
    assert shown(moved, "ring_y", end_s=0.001)[0, 0] == pytest.approx(-0.01, abs=1e-6)


def test_commands_of_all_sources_are_numbered_by_time() -> None:
    scene = load_scene("hammer", {"duration_s": 0.2})
    sent = SentCommand(100_000, "hammer", {"force_n": 50.0, "duration_ms": 4.0, "direction": "y"})
    both = Experiment(scene=scene, commands=(sent,))
    assert get_value(both, "hammer.1.at_s") == 0.02
    assert get_value(both, "hammer.2.force_n") == 50.0
    assert get_value(both, "hammer.2.direction") == pytest.approx(90.0)
    same = with_values(both, {"hammer.2.force_n": 50.0})
    a, b = (shown(one, "ring_x", "hammer", end_s=0.12) for one in (both, same))
    assert np.array_equal(a, b)
    for key in ("hammer.3.force_n", "hammer.1.loudness", "contact.frictionn", "engine.name"):
        with pytest.raises(InputError):
            get_value(both, key)


def test_times_of_impacts_are_interpolated_between_rows(experiment: Experiment) -> None:
    """A half sine that begins between two rows: its impulse about any time is that of the formula."""
    parts = make_rows(("hammer",), np.arange(600) / 20_000)
    parts = {"hammer": replace(parts["hammer"], ideal=True)}
    predictor = Predictor(experiment, ["hammer.1.duration_ms"], parts)
    low, middle, high = (predictor.predict([value]).values["hammer"].sum() for value in (5.0, 5.01, 5.025))
    assert middle == pytest.approx(0.6 * low + 0.4 * high, rel=1e-4)
    assert not np.allclose(low, high)


def test_an_impact_after_the_window_is_not_simulated(experiment: Experiment) -> None:
    predictor = Predictor(experiment, ["hammer.1.duration_ms"], make_rows(("ring_x",), np.arange(200) / 20_000))
    predictor.predict([5.01])
    assert predictor.runs == 1
