"""Orbits, spectra, contact and curves: the drawn data, without a viewer."""

from __future__ import annotations

import math

import numpy as np
import pytest

from recorder.viewer.clock import WallClock
from recorder.viewer.drawings import orbit, spectrum
from recorder.viewer.drawings.contact import Touch, resolution_mm
from recorder.viewer.drawings.geometry import Geometry
from recorder.viewer.drawings.history import History
from recorder.viewer.drawings.series import Envelope, build_curves, find_reaction, get_paths
from recorder.viewer.drawings.whirl import compute_whirl
from rig.channels.table import default_table

RATE_HZ = 20_000


def whirling(frequency_hz: float, radius_mm: float, *, seconds: float = 0.5) -> np.ndarray:
    return radius_mm * np.exp(2j * math.pi * frequency_hz * np.arange(round(seconds * RATE_HZ)) / RATE_HZ)


@pytest.mark.parametrize(("frequency_hz", "sense"), [(-83.0, "backward"), (83.0, "forward"), (6.2, "forward")])
def test_whirl_has_the_sign_of_its_rotation(frequency_hz: float, sense: str) -> None:
    whirl = compute_whirl(whirling(frequency_hz, 0.926), RATE_HZ)
    assert whirl.sense == sense
    # Half a second is not a multiple of the period at 6.2 Hz: its mean is not exactly its centre.
    assert whirl.frequency_hz == pytest.approx(frequency_hz, rel=5e-2 if abs(frequency_hz) < 10 else 2e-3)


def test_whirl_is_about_its_own_centre_and_noise_does_not_slow_it() -> None:
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((2, RATE_HZ // 2)) * 1.3e-4
    z = 0.4 - 0.3j + whirling(-83.0, 0.01) + noise[0] + 1j * noise[1]
    whirl = compute_whirl(z, RATE_HZ)
    assert whirl.frequency_hz == pytest.approx(-83.0, rel=2e-2)
    assert whirl.radius_mm == pytest.approx(0.01, rel=2e-2)


def test_noise_alone_is_no_whirl() -> None:
    rng = np.random.default_rng(2)
    z = 1e-4 * (rng.standard_normal(RATE_HZ) + 1j * rng.standard_normal(RATE_HZ))
    assert compute_whirl(z, RATE_HZ).sense == "none"
    assert orbit.format_reading(compute_whirl(z, RATE_HZ))[0] == "no whirl"


def test_screen_coordinates_flip_y_and_keep_the_sense() -> None:
    # In a view whose y points down, a visibly clockwise motion has a growing angle.
    up, east = orbit.screen(np.array([1j, 1.0 + 0.0j]))
    assert up[1] < 0.0 < east[0]
    drawn = orbit.screen(whirling(-83.0, 0.926, seconds=0.01))
    angle = np.unwrap(np.arctan2(drawn[:, 1], drawn[:, 0]))
    assert np.all(np.diff(angle) > 0.0)


def test_orbit_shows_a_few_turns_within_a_time_limit() -> None:
    fast, slow = compute_whirl(whirling(-83.0, 0.9), RATE_HZ), compute_whirl(whirling(2.0, 0.9), RATE_HZ)
    assert 2.0 <= orbit.get_display_span_s(fast) * 83.0 <= 6.0
    assert orbit.get_display_span_s(slow) < 0.5


@pytest.mark.parametrize("frequency_hz", [-83.0, 83.0, 6.0])
def test_spectrum_puts_a_whirl_at_its_signed_frequency_with_its_radius(frequency_hz: float) -> None:
    frequencies, amplitude = spectrum.limit_spectrum(0.2 + whirling(frequency_hz, 0.926), RATE_HZ)
    assert frequencies[np.argmax(amplitude)] == frequency_hz
    assert amplitude.max() == pytest.approx(0.926, rel=1e-2)
    # Nothing on the other side, and the offset from the centre is not shown.
    assert amplitude[frequencies == -frequency_hz].item() < 1e-3 * amplitude.max()
    if abs(frequency_hz) > 10:
        assert amplitude[frequencies == 0].item() < 1e-3 * amplitude.max()


def test_a_straight_vibration_is_as_much_forward_as_backward() -> None:
    frequencies, amplitude = spectrum.limit_spectrum(whirling(40.0, 0.5) + whirling(-40.0, 0.5), RATE_HZ)
    assert amplitude[frequencies == 40].item() == pytest.approx(amplitude[frequencies == -40].item(), rel=1e-6)


def test_spectrum_of_a_slow_stream_is_empty_above_its_nyquist_frequency() -> None:
    z = np.exp(-2j * math.pi * 20.0 * np.arange(100) / 200.0)
    frequencies, amplitude = spectrum.limit_spectrum(z, 200)
    assert frequencies[np.argmax(amplitude)] == -20
    assert not amplitude[np.abs(frequencies) >= 100].any()


def test_envelope_keeps_the_extremes_of_each_curve_within_their_bucket() -> None:
    rng = np.random.default_rng(3)
    times = np.arange(1000) / 1000.0
    values = rng.standard_normal((1000, 2))
    envelope = Envelope(bucket=20)
    envelope.add(times, values)
    at, kept = envelope.take(until_s=math.inf, windows=[])
    assert len(at) == 100
    assert np.all(np.diff(at) > 0.0)
    for number in range(50):
        bucket, pair = values[20 * number : 20 * number + 20], kept[2 * number : 2 * number + 2]
        np.testing.assert_array_equal(pair.min(axis=0), bucket.min(axis=0))
        np.testing.assert_array_equal(pair.max(axis=0), bucket.max(axis=0))
        first_is_low = bucket.argmin(axis=0) < bucket.argmax(axis=0)
        np.testing.assert_array_equal(pair[0] == bucket.min(axis=0), first_is_low)


def test_envelope_keeps_every_row_in_a_window() -> None:
    times, values = np.arange(2000) / 2000.0, np.arange(2000.0)[:, None]
    envelope = Envelope(bucket=50)
    envelope.add(times, values)
    at, kept = envelope.take(until_s=math.inf, windows=[(0.45, 0.55)])
    inside = (times >= 0.45) & (times <= 0.55)
    assert set(times[inside]) <= set(at)
    assert len(at) < 2 * inside.sum()
    np.testing.assert_array_equal(kept[np.isin(at, times[inside]), 0], values[inside, 0])


def test_envelope_between_close_windows_is_decimated_if_possible() -> None:
    times, values = np.arange(20_000) / 2000.0, np.arange(20_000.0)[:, None]
    windows = [(0.21 * number - 0.05, 0.21 * number + 0.05) for number in range(48)]
    envelope = Envelope(bucket=8)
    for start in range(0, 20_000, 300):
        envelope.add(times[start : start + 300], values[start : start + 300])
        envelope.fold(until_s=math.inf, windows=windows, most=60)
    at, _ = envelope.take(until_s=math.inf, windows=windows, rest=True)
    inside = np.any([(times >= start) & (times <= end) for start, end in windows], axis=0)
    assert set(times[inside]) <= set(at)
    assert len(at) - inside.sum() < 20 * len(windows)


@pytest.mark.parametrize("chunk", [1, 7, 50, 999])
def test_envelope_does_not_depend_on_the_blocks(chunk: int) -> None:
    times, values = np.arange(1000) / 1000.0, np.sin(np.arange(1000.0))[:, None]
    whole, parts = Envelope(bucket=30), Envelope(bucket=30)
    whole.add(times, values)
    expected = whole.take(until_s=math.inf, windows=[(0.3, 0.4)], rest=True)
    pieces = []
    for start in range(0, 1000, chunk):
        parts.add(times[start : start + chunk], values[start : start + chunk])
        pieces.append(parts.take(until_s=times[min(start + chunk, 1000) - 1] - 0.05, windows=[(0.3, 0.4)]))
    pieces.append(parts.take(until_s=math.inf, windows=[(0.3, 0.4)], rest=True))
    np.testing.assert_array_equal(np.concatenate([at for at, _ in pieces if len(at)]), expected[0])
    np.testing.assert_array_equal(np.concatenate([kept for at, kept in pieces if len(at)]), expected[1])


def test_curves_carry_the_names_and_units_of_the_channel_table() -> None:
    table = default_table()
    labels = [label for group in table.groups.values() for series in build_curves(group) for label in series.labels]
    for channel in table.channels.values():
        assert (f"{channel.name} [{channel.unit}]" in labels) == (channel.name != "keyphasor")
    assert len(set(get_paths(table))) == len(get_paths(table))


def test_reaction_is_the_difference_of_the_opposed_pair() -> None:
    group = default_table().groups["forces"]
    values = np.zeros((1, 4))
    for name, value in {"P_N": 10.0, "P_S": 4.0, "P_E": 1.0, "P_W": 8.0}.items():
        values[0, group.names.index(name)] = value
    np.testing.assert_array_equal(find_reaction(group)(values), [[-7.0, 6.0]])


def test_contact_has_hysteresis_and_continues_across_blocks() -> None:
    radius = np.array([0.0, 0.9, 1.0, 0.99, 1.0, 0.97, 1.0, 0.5])
    times = np.arange(8.0)
    whole = Touch(enter=1.0, leave=0.98).changes(times, radius)
    np.testing.assert_array_equal(whole[0], [0, 2, 5, 6, 7])
    np.testing.assert_array_equal(whole[1], [False, True, False, True, False])
    touch = Touch(enter=1.0, leave=0.98)
    parts = [touch.changes(times[n : n + 1], radius[n : n + 1]) for n in range(8)]
    np.testing.assert_array_equal(np.concatenate([at for at, _ in parts]), whole[0])


def test_probe_resolution_is_far_below_the_clearance() -> None:
    ring = default_table().channels["ring_x"]
    assert 1e-5 < resolution_mm(ring) < 1e-3


def test_wall_clock_follows_marks_and_then_real_time() -> None:
    clock = WallClock()
    assert clock.at(np.array([1.0])) is None
    clock.mark(0.0, 100.0)
    clock.mark(10.0, 105.0)
    clock.mark(5.0, 300.0)  # backwards: ignored
    np.testing.assert_allclose(clock.at(np.array([-1.0, 4.0, 12.0])), [99.0, 102.0, 107.0])
    for n in range(10_000):
        clock.mark(20.0 + n, 200.0 + n)
    np.testing.assert_allclose(clock.at(np.array([9000.0])), [9180.0])
    assert len(clock) < 5000


def test_geometry_converts_lengths_and_names_its_assumptions() -> None:
    document = {
        "values": {"ring.clearance": {"value": 0.5, "unit": "mm"}, "shaft.arm_ring": {"value": "rule", "unit": "m"}}
    }
    geometry = Geometry.from_parameters(document)
    assert geometry.clearance_mm("ring") == pytest.approx(0.5)
    assert geometry.clearance_mm("disk") == pytest.approx(0.5 * 0.314 / 0.197)
    assert "ring.clearance" not in geometry.assumed
    assert "shaft.arm_ring" in geometry.assumed
    assert Geometry.from_parameters(None) == Geometry()


def test_geometry_knows_the_keys_of_the_parameter_sets() -> None:
    from rig.physics.parameters import load_parameters

    assert Geometry.from_parameters(load_parameters("corrected").document()).assumed == ()


def test_history_keeps_the_latest_only() -> None:
    history = History(capacity=5, dtype=complex)
    history.add(np.arange(4.0))
    history.add(np.arange(4.0, 8.0))
    np.testing.assert_array_equal(history.last(3), [5, 6, 7])
    assert len(history) == 5
    history.clear()
    assert len(history.last(3)) == 0
