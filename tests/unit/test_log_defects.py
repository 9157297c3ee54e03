"""Names of defects in a log's channels, from synthetic signals with a known defect."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from replays.recordings.resimulation.prediction import Measured
from replays.recordings.validation.criteria import load_criteria
from replays.recordings.validation.explanations.attribution import Explained, Rest, conclude, settle_channels
from replays.recordings.validation.explanations.channel_fit import Shown
from replays.recordings.validation.explanations.explanation import Explanation
from replays.recordings.validation.explanations.faults import diagnose
from replays.recordings.validation.explanations.signals import edge_faults, find_copies
from rig.channels.table import default_table

RATE_HZ = 20e3
TIMES_S = 0.7 + np.arange(3000) / RATE_HZ
FORCE = 3000.0 + 60.0 * np.sin(2.0 * math.pi * 6.2 * TIMES_S) + 150.0 * np.sin(2.0 * math.pi * 180.0 * TIMES_S) * (
    TIMES_S > 0.8
)  # fmt: skip
"""A preloaded force: unbalance, then vibrations from a hammer pulse on."""
PROBE = 0.3 * np.cos(2.0 * math.pi * 6.2 * TIMES_S + 0.4) + 0.1 * np.sin(900.0 * (TIMES_S - 0.7) ** 2)


def show(name: str, expected: np.ndarray, values: np.ndarray, noise: float, seed: int = 1, **told: float) -> Shown:
    channel = default_table().channels[name].model_copy(update={"highpass_hz": 0.0, **told})
    values = values + noise * np.random.default_rng(seed).standard_normal(len(values))
    others = {
        default_table().channels[one]: (TIMES_S, signal)
        for one, signal in (("P_N", FORCE), ("disk_y", PROBE)) if one != name
    }  # fmt: skip
    return Shown(
        channel, TIMES_S, values, expected, np.full(len(values), noise), noise, neighbours=lambda: others
    )  # fmt: skip


def name_single(*shown: Shown) -> Explanation:
    (found,) = diagnose(list(shown), float(TIMES_S[-1]))
    return found


def high_pass(signal: np.ndarray, hz: float) -> np.ndarray:
    """Return a signal after a settled first-order high-pass, by the bilinear transform."""
    from scipy.signal import lfilter

    k = math.pi * hz / RATE_HZ
    b, a = np.array([1.0, -1.0]) / (1.0 + k), [1.0, -(1.0 - k) / (1.0 + k)]
    return lfilter(b, a, np.concatenate([np.full(40_000, signal[0]), signal]))[40_000:]


def test_an_ac_coupling_has_its_name_and_corner() -> None:
    found = name_single(show("P_W", FORCE, high_pass(FORCE, 5.0), 1.0))
    assert (found.name, found.unit, found.sure) == ("P_W AC coupling", "Hz", True)
    assert found.value == pytest.approx(5.0, rel=0.01)
    told = high_pass(FORCE, 0.5)
    found = name_single(show("P_W", told, high_pass(FORCE, 2.0), 1.0, highpass_hz=0.5))
    assert found.value == pytest.approx(2.0, rel=0.02)
    assert found.change.endswith("Hz, told 0.5 Hz")


@pytest.mark.parametrize(("size", "name"), [(2e-5, "offset"), (0.01, "offset and hum"), (0.2, "hum and offset")])
def test_a_law_that_needs_a_level_states_it(size: float, name: str) -> None:
    hum = size * np.sin(2.0 * math.pi * 50.0 * TIMES_S)
    found = name_single(show("disk_x", PROBE, PROBE + 0.05 + hum, 5e-4))
    assert found.name == f"disk_x {name}"
    assert "+0.05" in found.change
    assert ("Hz" in found.change) == (name != "offset")


def test_a_level_is_no_crosstalk() -> None:
    found = name_single(show("P_W", FORCE, FORCE - 3000.0 + 4.0 * PROBE, 1.0))
    assert found.name == "P_W offset and crosstalk"
    found = name_single(show("P_W", FORCE, FORCE + 40.0 * PROBE, 1.0))
    assert found.name == "P_W crosstalk"
    other = 30.0 * np.sin(4000.0 * (TIMES_S - 0.7) ** 2)
    found = name_single(show("P_W", FORCE, FORCE - 3000.0 + 30.0 * PROBE + other, 1.0))
    assert found.name == "P_W offset"


def test_a_gain_for_a_part_of_the_time_is_one_with_its_times() -> None:
    for_4_ms = (TIMES_S > 0.81) & (TIMES_S < 0.814)
    found = name_single(show("P_W", FORCE, np.where(for_4_ms, 0.3, 1.0) * FORCE, 1.0))
    assert (found.name, found.sure) == ("P_W gain", True)
    assert found.value == pytest.approx(-0.7, abs=0.01)
    assert found.change.startswith("-70 % from 0.81")


def test_values_that_wrap_around_are_not_clipped_nor_nonlinear() -> None:
    signal = 40.0 * np.sin(2.0 * math.pi * 180.0 * TIMES_S) * (TIMES_S > 0.75)
    whole = show("inner_x", signal, signal, 0.1)
    found = name_single(replace(whole, values=(whole.values + 30.0) % 60.0 - 30.0))
    assert found.name == "inner_x wrap"
    assert found.value == pytest.approx(60.0, rel=1e-3)


def test_a_clipped_channel_is_not_nonlinear() -> None:
    signal = 40.0 * np.sin(2.0 * math.pi * 180.0 * TIMES_S) * (TIMES_S > 0.75)
    clipped = show("inner_x", signal, signal, 0.1)
    found = name_single(replace(clipped, values=np.clip(clipped.values, -30.0, 30.0)))
    assert (found.name, found.change) == ("inner_x clip", "at -30 m/s^2 and 30 m/s^2")


def lose_rows(signal: np.ndarray, at: int, rows: int) -> np.ndarray:
    return np.r_[signal[:at], signal[at + rows :], np.full(rows, signal[-1])]


@pytest.mark.parametrize("rows", [1, 7, -5])
def test_rows_that_channels_lose_or_repeat_are_no_delay(rows: int) -> None:
    at, shown = 2200, []
    for name, signal, noise in (("P_W", FORCE, 1.0), ("disk_x", PROBE, 5e-4)):
        kept = lose_rows(signal, at, rows)[:-8] if rows > 0 else np.r_[signal[:at], signal[at + rows : -8 + rows]]
        one = show(name, signal, signal, noise)
        noisy = kept + noise * np.random.default_rng(2).standard_normal(len(kept))
        rest = {"times_s": TIMES_S[:-8], "expected": signal[:-8], "floor": one.floor[:-8]}
        shown.append(replace(one, values=noisy, around=(TIMES_S, signal), **rest))
    (found,) = diagnose(shown, float(TIMES_S[-1]))
    assert found.name == f"P_W, disk_x {'lost' if rows > 0 else 'doubled'} samples"
    assert found.change.startswith(f"{abs(rows)} rows from 0.8")
    assert found.at_floor


@pytest.mark.parametrize("size", [0.01, -0.1])
def test_a_probe_that_warms_up_drifts(size: float) -> None:
    warm = size * (1.0 - np.exp(-(TIMES_S - 0.7) / 0.06))
    found = name_single(show("disk_x", PROBE, PROBE + warm, 5e-4))
    assert found.name == "disk_x drift"
    assert found.value == pytest.approx(size, rel=0.05)


def measure(values: np.ndarray, noise: float = 1.0) -> Measured:
    channels = tuple(default_table().channels[name] for name in ("P_N", "P_S"))
    floor, random = np.full(2, noise), np.ones(2, dtype=bool)
    times_s = np.arange(len(values)) / RATE_HZ
    return Measured("forces", channels, times_s, np.arange(len(values)), values, floor, random, ideal=False)


def test_rows_that_are_a_copy_have_their_times() -> None:
    values = np.rint(np.random.default_rng(1).normal(0.0, 30.0, (4000, 2)))
    assert not find_copies({"forces": measure(values)})
    values[3000:3400] = values[1000:1400]
    (found,) = find_copies({"forces": measure(values)})
    assert (found.what, found.from_s, found.to_s) == ("doubled samples", 0.15, pytest.approx(0.16995))
    assert "400 rows of forces from 0.1500 to 0.1699 s are equal bit for bit to those from 0.0500 s" in found.line
    wave = np.rint(100.0 * np.sin(2.0 * math.pi * np.arange(4000) / 200.0))
    assert not find_copies({"forces": measure(np.stack([wave, wave], axis=1))})


def test_uneven_extra_pulses_are_not_missing_ones() -> None:
    edges = np.arange(20) / 6.25
    later = edges[8:] + 0.3 / 6.25
    faults = edge_faults(np.sort(np.r_[edges, later]), 0.5, 6.25)
    assert not [one for one in faults if one.what == "miss-pulses"]


@pytest.mark.parametrize("place", [0.3, 0.6])
def test_an_extra_pulse_in_every_turn_is_extra_and_a_missing_one_missing(place: float) -> None:
    edges = np.arange(20) / 6.25
    extra = np.sort(np.r_[edges, edges[:-1] + place / 6.25])
    assert {one.what for one in edge_faults(extra, 9.0, 6.25)} == {"extra-pulses"}
    assert {one.what for one in edge_faults(np.delete(edges, [3, 7, 12]), 9.0, 6.25)} == {"miss-pulses"}
    assert not edge_faults(edges, 9.0, 6.25)


@pytest.mark.parametrize("left", [1.5, 7.7])
def test_a_defect_that_leaves_more_than_noise_is_only_the_closest(left: float) -> None:
    one = Explanation("sensor", "inner_x offset", "+2 m/s^2", 2.0, "m/s^2", 0.97, left, 1e4 * left**2, 10_000, 0.3)
    conclusion, names = conclude([one], [one], load_criteria().attribution, end_s=0.3)
    assert ("closest is sensor: inner_x offset" in conclusion) == (left > 2.0)
    assert names == (("inner_x offset",) if left < 2.0 else ())


RUNOUT = {1: (4e-3, 0.3), 2: (3e-3, 1.9), 3: (1.5e-3, 4.0), 5: (1e-3, 2.2)}
"""Amplitudes and phases of a run-out by order [mm, rad]."""


def turn_shaft(hz: float) -> np.ndarray:
    """Return the angle of a shaft that a rub slows down from 0.8 s on [revolutions]."""
    return hz * (TIMES_S - 0.4 * np.maximum(TIMES_S - 0.8, 0.0) ** 2 / 0.1)


@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
def test_a_run_out_is_periodic_in_the_angle_and_no_hum(size: float) -> None:
    turns = turn_shaft(20.0)
    waves = (a * np.cos(2.0 * math.pi * k * turns + phase) for k, (a, phase) in RUNOUT.items())
    found = name_single(replace(show("disk_x", PROBE, PROBE + size * sum(waves), 4e-4), turns=turns))
    assert (found.name, found.unit, found.sure) == ("disk_x run-out", "mm", True)
    assert found.value == pytest.approx(0.0145 * size, rel=0.2)
    assert "1X 0.0" in found.change


@pytest.mark.parametrize("hz", [50.0, 100.0, 20.0 / 3.0])
def test_a_fixed_frequency_is_hum_also_at_a_multiple_of_the_speed(hz: float) -> None:
    steady, slowed = 25.0 * TIMES_S, turn_shaft(25.0)
    hum = show("disk_x", PROBE, PROBE + 0.005 * np.sin(2.0 * math.pi * hz * TIMES_S), 4e-4)
    for turns in (slowed, *((steady,) if hz > 99.0 else ())):
        assert name_single(replace(hum, turns=turns)).name == "disk_x hum"


def test_a_gain_of_a_probe_is_no_run_out_although_unbalance_is_periodic() -> None:
    signal = 0.3 * np.cos(2.0 * math.pi * 20.0 * TIMES_S)
    probe = replace(show("disk_x", signal, 1.03 * signal, 4e-4), turns=20.0 * TIMES_S)
    assert name_single(probe).name == "disk_x gain"


SECOND_PROBE = 0.3 * np.sin(2.0 * math.pi * 6.2 * TIMES_S + 0.4) + 0.05 * np.sin(1300.0 * (TIMES_S - 0.7) ** 2)


@pytest.mark.parametrize(("degrees", "words"), [(10.0, "toward"), (-4.0, "away from")])
def test_a_single_probe_at_another_angle_is_no_crosstalk(degrees: float, words: str) -> None:
    angle = math.radians(degrees)
    turned = math.cos(angle) * SECOND_PROBE + math.sin(angle) * PROBE
    found = name_single(show("disk_x", SECOND_PROBE, turned, 4e-4))
    assert (found.name, found.unit, found.sure) == ("disk_x angle", "rad", True)
    assert found.change == f"{abs(degrees):g} degrees {words} disk_y"
    found = name_single(show("disk_x", SECOND_PROBE, SECOND_PROBE + math.sin(angle) * PROBE, 4e-4))
    assert found.name == "disk_x crosstalk"


def settle(*faults: Explanation, failed: str = "", passed: str = "", is_evidence: bool = True) -> Explained:
    """Return the settled explanation of a log with a gain of P_S, an unsettled inner_x, and a failing outer_y."""
    gain = name_single(show("P_S", FORCE, 0.99 * FORCE, 1.0))
    explained = Explained(0.0, 1.0, (gain,), "sensor: P_S gain -1 %", (gain.name,), ("inner_x",))
    channels = ["disk_x", "P_S", "inner_x", "outer_y"]

    def compare(used: list[str]) -> Rest:
        assert used == ["disk_x", "inner_x", "outer_y"]
        return Rest([*faults], failed.split(), is_evidence)

    return settle_channels(explained, {name: name in passed for name in ("P_S", "outer_y")}, channels, compare)


def test_differences_beside_a_fault_are_settled_by_a_fit_without_the_faulty_channel() -> None:
    offset = name_single(show("inner_x", PROBE, PROBE - 0.1, 0.1))
    none = settle(passed="outer_y")
    assert none.conclusion.endswith("; inner_x differs only through the fit: a fit without P_S shows no difference")
    assert (none.settled, none.best) == ({"inner_x": "effect"}, ("P_S gain",))
    small = settle(offset, failed="outer_y")
    assert "; another fault, also in a fit without P_S, closest is inner_x offset -0." in small.conclusion
    assert small.conclusion.endswith("; outer_y fails, also in a fit without P_S, without a known cause")
    assert (small.settled, small.best) == ({"inner_x": "fault", "outer_y": "fault"}, ("P_S gain",))
    failed = settle(offset, failed="inner_x")
    assert (failed.settled["outer_y"], failed.best) == ("effect", ("P_S gain", "inner_x offset"))
    unknown = settle(is_evidence=False)
    assert unknown.conclusion.endswith("; inner_x in addition: an effect, or another fault")
    assert (unknown.settled, unknown.best) == ({}, ("P_S gain",))


@pytest.mark.parametrize(("gain", "names"), [(1.05, ["P_N, P_S gain"]), (-1.0, ["P_N polarity", "P_S polarity"])])
def test_equal_gains_of_opposite_forces_are_no_swap(gain: float, names: list[str]) -> None:
    opposite = 6000.0 - FORCE
    pair = [show("P_N", FORCE, gain * FORCE, 1.0), show("P_S", opposite, gain * opposite, 1.0, seed=2)]
    assert sorted(one.name for one in diagnose(pair, float(TIMES_S[-1]))) == names
    swapped = [show("P_N", FORCE, opposite, 1.0), show("P_S", opposite, FORCE, 1.0, seed=2)]
    (found,) = diagnose(swapped, float(TIMES_S[-1]))
    assert found.name == "P_N and P_S"


@pytest.mark.parametrize(("times", "named"), [(1.08, False), (1.15, True)])
def test_a_tenth_more_noise_in_a_log_is_no_fault(times: float, named: bool) -> None:
    loud = show("outer_x", FORCE, FORCE, times)
    shown = replace(loud, floor=np.ones(len(TIMES_S)), noise=1.0)
    found = [one.name for one in diagnose([shown], float(TIMES_S[-1]))]
    assert found == (["outer_x noise"] if named else [])
