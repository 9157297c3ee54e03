"""Noise by its spectrum: the filter makes it white, from the first sample on, and does not change white noise."""

from __future__ import annotations

import numpy as np
import pytest

from replays.estimate.spectra import NoiseSpectrum, whiten_rows

RATE_HZ, QUIET, ROWS = 20_000.0, 9_800, 40_000


def make_noise(slope: float, level: float, lines: int, seed: int) -> np.ndarray:
    """Return white noise with a part of density (100 Hz / f)^slope, and lines of the mains."""
    rng = np.random.default_rng(seed)
    f = np.fft.rfftfreq(ROWS, 1.0 / RATE_HZ)
    f[0] = f[1]
    shape = (rng.standard_normal(len(f)) + 1j * rng.standard_normal(len(f))) * np.sqrt((100.0 / f) ** slope)
    t = np.arange(ROWS) / RATE_HZ
    hum = sum(0.4 * np.sin(2.0 * np.pi * 50.0 * (2 * k + 1) * t + rng.uniform(0.0, 6.28)) for k in range(lines))
    return rng.standard_normal(ROWS) + level * np.fft.irfft(shape, ROWS) * np.sqrt(ROWS / 2.0) + hum


@pytest.mark.parametrize(("slope", "level", "lines"), [(0.0, 0.0, 0), (1.0, 1.0, 0), (2.0, 0.3, 1), (2.0, 0.9, 3)])
def test_noise_of_any_spectrum_becomes_white(slope: float, level: float, lines: int) -> None:
    """Later samples, which the spectrum was not estimated from, have the RMS and means of white noise."""
    for seed in range(5):
        noise = make_noise(slope, level, lines, seed)
        spectrum = NoiseSpectrum.estimate(noise[:QUIET])
        # Every eighth row at first, then all, and a gap.
        index = np.r_[0:8000:8, 8000:12_000, 12_050:20_000]
        white = whiten_rows(noise[index], spectrum, index)
        means = white[1000:].reshape(-1, 50).mean(axis=1) * np.sqrt(50.0)
        assert np.sqrt(np.mean(white**2)) == pytest.approx(1.0, abs=0.06)
        assert np.abs(white).max() < 6.0
        assert np.abs(means).max() < 5.0
        assert np.abs(white[[0, 1000, 5000]]).max() < 4.5


def test_short_or_white_noise_has_no_spectrum() -> None:
    white = np.random.default_rng(1).standard_normal(QUIET)
    assert NoiseSpectrum.estimate(white[:100]) is None
    rows = np.arange(QUIET)
    assert whiten_rows(white, None, rows) is white


def test_a_difference_does_not_appear_before_its_time() -> None:
    spectrum = NoiseSpectrum.estimate(make_noise(2.0, 0.9, 2, seed=1)[:QUIET])
    step = np.where(np.arange(4000) < 1500, 0.0, 10.0)
    seen = whiten_rows(step, spectrum, np.arange(4000))
    assert np.abs(seen[:1500]).max() < 1e-9
    assert seen[1500] == pytest.approx(10.0, rel=0.1)


def test_drawn_noise_has_the_spectrum_and_a_line_its_size() -> None:
    noise = make_noise(0.0, 0.0, 1, seed=2)
    spectrum = NoiseSpectrum.estimate(noise)
    assert spectrum is not None
    assert spectrum.largest_line == pytest.approx(0.4 / np.sqrt(2.0), rel=0.2)
    drawn = spectrum.colour(np.random.default_rng(3).standard_normal(ROWS))
    assert drawn.std() == pytest.approx(np.hypot(1.0, spectrum.excess), rel=0.03)
    again = NoiseSpectrum.estimate(drawn)
    assert again is not None
    assert again.excess == pytest.approx(spectrum.excess, rel=0.3)
