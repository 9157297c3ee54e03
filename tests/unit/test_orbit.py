"""Figures of an orbit from samples: whirl frequency and sense, full spectrum, waterfall."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.base.errors import InputError
from rig.channels.orbit import (
    SPECTRUM_HZ,
    full_spectrum,
    mean_rotation,
    phase,
    rms_radius,
    synchronous,
    waterfall,
    whirl_frequency,
)


def orbit(
    hz: float, *, n: int = 4_000, rate: float = 4_000.0, noise: float = 0.0, centre: complex = 0.0
) -> tuple[np.ndarray, ...]:
    times = np.arange(n) / rate
    rng = np.random.default_rng(1)
    z = centre + np.exp(2j * math.pi * (hz * times + 0.1)) + noise * (rng.normal(size=n) + 1j * rng.normal(size=n))
    return times, z.real, z.imag


@given(
    hz=st.floats(3.0, 500.0),
    forward=st.booleans(),
    x=st.floats(-3.0, 3.0),
    y=st.floats(-3.0, 3.0),
    start_s=st.floats(0.0, 1e5),
)
def test_whirl_frequency_has_a_sense_and_needs_no_centre(
    hz: float, forward: bool, x: float, y: float, start_s: float
) -> None:
    sign = 1.0 if forward else -1.0
    times, ox, oy = orbit(sign * hz, centre=complex(x, y))
    found = whirl_frequency(ox, oy, times + start_s)
    # A fraction of a turn at the end moves the mean, and with it the centre, by up to 1 part in 2 pi turns.
    assert found == pytest.approx(sign * hz, abs=0.2 / hz + 1e-6)
    assert whirl_frequency(ox, -oy, times + start_s) == pytest.approx(-found, rel=1e-9)
    assert whirl_frequency(oy, ox, times + start_s) == pytest.approx(-found, rel=1e-6)


@pytest.mark.parametrize("hz", [-83.7, -20.0, 6.2])
def test_whirl_frequency_reads_through_noise(hz: float) -> None:
    times, x, y = orbit(hz, noise=0.1)
    # Phase noise of 0.1 rad over 4000 samples of 1 s: sqrt(12 / 4000) x 0.1 / (2 pi) = 0.9 mHz.
    assert whirl_frequency(x, y, times) == pytest.approx(hz, abs=5e-3 + 0.2 / abs(hz) ** 2)


def test_whirl_frequency_is_not_bound_to_the_bins_of_a_spectrum() -> None:
    for hz in (-83.70, -83.75, -83.80):
        times, x, y = orbit(hz)
        assert whirl_frequency(x, y, times) == pytest.approx(hz, abs=0.005)


@pytest.mark.parametrize("hz", [-80.0, 6.0])
def test_full_spectrum_shows_sense_and_amplitude(hz: float) -> None:
    _, x, y = orbit(hz, centre=3 + 2j)
    frequency, amplitude = full_spectrum(0.7 * x, 0.7 * y, 4_000.0)
    top = int(np.argmax(amplitude))
    assert frequency[top] == pytest.approx(hz)
    assert amplitude[top] == pytest.approx(0.7, rel=1e-3)
    assert amplitude[np.argmin(np.abs(frequency + hz))] < 1e-5, "nothing on the other side"


@pytest.mark.parametrize("hz", [-80.0, 6.0])
def test_a_padded_spectrum_has_closer_lines_and_none_at_zero(hz: float) -> None:
    times, x, y = orbit(hz, n=2_000, centre=3 + 2j)
    frequency, amplitude = full_spectrum(x, y, 4_000.0, lines=4_000)
    assert len(times) == 2_000
    assert np.allclose(np.diff(frequency), 1.0)
    assert frequency[np.argmax(amplitude)] == hz
    assert amplitude.max() == pytest.approx(1.0, rel=1e-2)
    assert amplitude[frequency == 0.0].item() < 1e-9


@pytest.mark.parametrize("hz", [-83.0, 40.5])
def test_mean_rotation_is_not_pulled_to_zero_by_noise(hz: float) -> None:
    _, x, y = orbit(hz, noise=0.5)
    assert mean_rotation(x, y, 4_000.0) == pytest.approx(hz, rel=0.02)
    assert mean_rotation(x[:5], y[:5], 4_000.0) == 0.0


def test_radius_is_about_the_orbits_centre() -> None:
    _, x, y = orbit(10.0, centre=5 - 1j)
    assert rms_radius(0.3 * x, 0.3 * y) == pytest.approx(0.3)


def test_a_small_orbit_next_to_the_centre_is_not_taken_as_one_around_it() -> None:
    times, x, y = orbit(10.0, centre=5 + 0j)
    assert abs(phase(x, y)[-1] - phase(x, y)[0]) < 1.0, "it never goes round the origin"
    assert whirl_frequency(x, y, times, about=0.0) == pytest.approx(0.0, abs=0.1)
    assert whirl_frequency(x, y, times) == pytest.approx(10.0, abs=0.02)


def test_the_last_window_of_a_waterfall_ends_with_the_samples() -> None:
    times, x, y = orbit(-80.0, n=4_000)
    assert waterfall(x, y, 4_000.0, times, window_s=0.5, hop_s=0.5)[0] == pytest.approx([0.25, 0.75])
    assert len(waterfall(x, y, 4_000.0, times, window_s=0.5, hop_s=1e-9)[0]) == 2001


def test_waterfall_shows_when_the_whirl_turns_over() -> None:
    times, x, y = orbit(-80.0, n=8_000)
    y = np.where(times < 1.0, y, -y)
    centres, frequency, amplitude = waterfall(x, y, 4_000.0, times)
    assert amplitude.shape == (len(centres), len(frequency))
    assert np.abs(frequency).max() == SPECTRUM_HZ
    assert np.allclose(np.diff(centres), 0.1)
    assert (frequency[np.argmax(amplitude[centres < 0.7], axis=1)] == -80.0).all()
    assert (frequency[np.argmax(amplitude[centres > 1.3], axis=1)] == 80.0).all()


@pytest.mark.parametrize("hz", [8.0, 153.0, 230.0])
def test_a_fractional_turn_on_a_large_mean_gives_the_closed_form(hz: float) -> None:
    times = np.arange(2_000) / 2_000.0
    edges = np.arange(0.0123, 0.99, 1.0 / hz)
    speed, vector = synchronous(50.0 + 0.3 * np.cos(2.0 * math.pi * hz * (times - edges[0]) - 0.5), times, edges)
    assert len(speed) == len(edges) - 1
    assert speed == pytest.approx(hz)
    assert vector == pytest.approx(0.3 * np.exp(-0.5j), rel=1e-9)


def test_a_turn_with_a_missing_quarter_is_omitted() -> None:
    times, x, _ = orbit(10.0)
    held = (times < 0.31) | (times > 0.34)
    assert len(synchronous(x, times, np.arange(0.0, 1.0, 0.1))[0]) == 9
    assert len(synchronous(x[held], times[held], np.arange(0.0, 1.0, 0.1))[0]) == 8


T, X, Y = (part.tolist() for part in orbit(200.0, n=40))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: full_spectrum(X, Y[1:], 4e3), "y must be as long as x, 40; received 39"),
        (
            lambda: full_spectrum([X, X], Y, 4e3),
            "x must be one row of numbers; received float64 of shape (2, 40)",
        ),
        (lambda: full_spectrum([[1.0], [2.0, 3.0]], Y, 4e3), "x must be one row of numbers; received rows of"),
        (lambda: full_spectrum("x", Y, 4e3), "x must be one row of numbers"),
        (lambda: full_spectrum([], [], 4e3), "x must be a row of at least 1; received 0"),
        (
            lambda: full_spectrum(X, [*Y[1:], math.nan], 4e3),
            "y must be finite numbers; received 1 that are not",
        ),
        (lambda: full_spectrum(X, Y, 0), "rate_hz must be a number greater than 0; received 0"),
        (lambda: full_spectrum(X, Y, T), "rate_hz must be a number greater than 0"),
        (lambda: full_spectrum(X, Y, 4e3, lines=8), "lines must be a whole number of at least the 40 samples"),
        (lambda: waterfall(X, Y, 4e3, T[1:]), "times_s must be as long as x, 40; received 39"),
        (lambda: waterfall(X, Y, 4e3, T, hop_s=-1.0), "hop_s must be a number greater than 0; received -1.0"),
        (lambda: whirl_frequency([1.0], [1.0], [0.0]), "x must be a row of at least 2; received 1"),
        (lambda: whirl_frequency(T, X, Y), "times_s must be ascending"),
        (lambda: synchronous(X, T, [0.2, 0.1]), "edges_s must be ascending"),
    ],
)
def test_invalid_orbits_are_refused_in_one_line(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(InputError) as error:
        call()
    assert str(error.value).startswith(message)


def test_lists_are_accepted_like_arrays() -> None:
    times, x, y = (np.array(part) for part in (T, X, Y))
    assert whirl_frequency(X, Y, T) == whirl_frequency(x, y, times)
    assert np.array_equal(waterfall(X, Y, 4000, T)[2], waterfall(x, y, 4e3, times)[2])
    assert [len(part) for part in synchronous(X, T, [])] == [0, 0]
