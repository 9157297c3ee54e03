"""Filters of a channel in continuous time, as steps from row to row with samples at any position in between.

The filters are solved exactly, by partial fractions of their transfer function. Every pole p has a state w,

    w' = p w + r u(t),    output voltage = direct u(t) + sum of Re w,

with u the cubic through the last four rows. A sample may therefore lie between rows, at any rate, and the result does
not depend on the engine's step or on the division of a run into calls. For a sine of frequency f and a row interval T
the error of the cubic is at most (2 pi f T)^4 / 24: 3e-5 at 1 kHz and 25 us.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from rig.channels.table import LINEAR_PHASE, Channel

_NODES = (1.0, 0.0, -1.0, -2.0)
"""Positions of the four rows of a cubic, in rows from the start of its interval."""
_MIN_CORNER_GAP = 1e-3
"""Smallest relative distance of the two filter corners, as partial fractions need distinct poles."""
POLE = 10
"""Numbers per pole: the state's factor and the weights of the four rows, each with real and imaginary part."""


def channel_poles(channel: Channel, row_rate_hz: float = math.inf) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the poles of a channel's filters [rad/s], one of each pair, their residues, and the direct gain.

    The filters are the channel's low-pass, omitted if it is above what rows represent or not of this kind (see
    `linear_phase_taps`), and a first-order high-pass for an AC-coupled channel.
    """
    by_poles = channel.filter not in (*LINEAR_PHASE, "none") and channel.bandwidth_hz < 0.45 * row_rate_hz
    order = channel.filter_order if by_poles else 0
    corner, highpass = 2.0 * math.pi * channel.bandwidth_hz, 2.0 * math.pi * channel.highpass_hz
    if order and abs(highpass - corner) < _MIN_CORNER_GAP * corner:
        highpass = (1.0 - _MIN_CORNER_GAP) * corner
    angles = [math.pi * (2 * n + order + 1) / (2 * order) for n in range(order)]
    low = [corner * complex(math.cos(angle), math.sin(angle)) for angle in angles]
    factors: list[complex] = [complex(corner)] * order
    if order and channel.filter != "butterworth":
        low = _poles_of(channel.filter, order, channel.ripple_db, corner)
        factors = [-pole for pole in low]  # so that the gain at 0 Hz is 1
        if any(abs(highpass + pole) < _MIN_CORNER_GAP * abs(pole) for pole in low):
            highpass *= 1.0 - 2.0 * _MIN_CORNER_GAP
    poles, residues = [], []
    for n, pole in enumerate([*low, complex(-highpass)] if highpass else low):
        if pole.imag < -1e-9 * abs(pole):
            continue  # complex conjugate
        residue = complex(pole) if highpass else complex(1.0)
        for m, other in enumerate(low):
            residue *= factors[m] / (pole - other) if m != n else factors[m]
        if n < order and highpass:
            residue /= pole + highpass
        poles.append(pole)
        residues.append(residue * (2.0 if pole.imag > 1e-9 * abs(pole) else 1.0))
    return np.array(poles, complex), np.array(residues, complex), 0.0 if low else 1.0


def _poles_of(kind: str, order: int, ripple_db: float, corner: float) -> list[complex]:
    """Return the poles of a Bessel (-3 dB at its corner) or Chebyshev low-pass [rad/s]."""
    from scipy.signal import bessel, cheby1

    shape: dict[str, Any] = {"analog": True, "output": "zpk"}
    made = bessel(order, corner, norm="mag", **shape) if kind == "bessel" else cheby1(order, ripple_db, corner, **shape)
    return [complex(pole) for pole in made[1]]


def delay_s(channel: Channel) -> float:
    """Return the delay of a linear-phase filter [s]."""
    return channel.half_length_s if channel.group_delay_us is None else 1e-6 * channel.group_delay_us


def linear_phase_taps(channel: Channel, row_rate_hz: float) -> np.ndarray:
    """Return the weights of the rows before and at an output row, the oldest first, shape (n,); (0,) for other filters.

    A fir is a sinc function in a Hamming window, a sinc filter is a B-spline. The delay may be any fraction of a row.
    """
    half_s, rows = channel.half_length_s * row_rate_hz, delay_s(channel) * row_rate_hz
    if not half_s or channel.bandwidth_hz >= 0.45 * row_rate_hz:
        return np.empty(0)
    at = np.arange(math.ceil(rows + half_s), -1.0, -1.0) - rows
    inside = np.abs(at) <= half_s
    if channel.filter == "sinc":
        from scipy.interpolate import BSpline

        knots = np.linspace(-half_s, half_s, channel.filter_order + 1)
        taps = np.nan_to_num(BSpline.basis_element(knots, extrapolate=False)(at))
    else:
        window = 0.54 + 0.46 * np.cos(math.pi * at / half_s)
        taps = np.where(inside, np.sinc(2.0 * channel.bandwidth_hz / row_rate_hz * at) * window, 0.0)
    return taps / taps.sum()


def low_pass_response(channel: Channel, turn: np.ndarray) -> np.ndarray:
    """Return the response of a channel's low-pass, without AC coupling.

    Args:
        channel: The channel.
        turn: Frequencies times 2 pi i [rad/s], shape (n,).
    """
    hz = turn.imag / (2.0 * math.pi)
    if channel.filter == "sinc":
        return np.sinc(hz * channel.average_s) ** channel.filter_order * np.exp(-turn * delay_s(channel))
    if channel.filter == "fir":
        from scipy.special import sici

        half_s = channel.half_length_s

        def passed(hz: np.ndarray) -> np.ndarray:
            edges = (2.0 * math.pi * half_s * (hz + sign * channel.bandwidth_hz) for sign in (1.0, -1.0))
            above, below = (sici(edge)[0] for edge in edges)
            return above - below

        def windowed(hz: np.ndarray) -> np.ndarray:
            return 0.54 * passed(hz) + 0.23 * sum(passed(hz + 0.5 * sign / half_s) for sign in (1.0, -1.0))

        return windowed(hz) / windowed(np.zeros(1)) * np.exp(-turn * delay_s(channel))
    poles, residues, direct = channel_poles(channel.model_copy(update={"highpass_hz": 0.0}))
    shown = np.full(len(turn), complex(direct))
    for pole, residue in zip(poles.tolist(), residues.tolist(), strict=True):
        shown += residue / (turn - pole)
        if pole.imag:  # one of a pair: its residue is doubled
            shown += 0.5 * (residue.conjugate() / (turn - pole.conjugate()) - residue / (turn - pole))
    return shown


def _integrals(poles: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the integrals of exp(p (length - t)) times the weights of the four rows, from 0 to the length.

    Args:
        poles: Poles [1/row], shape (p,).
        lengths: Lengths [rows], shape (n,).

    Returns:
        Integrals, shape (p, n, 4).
    """
    places, weights = np.polynomial.legendre.leggauss(24)
    t = 0.5 * lengths[:, None] * (places + 1.0)
    falling = np.exp(poles[:, None, None] * (lengths[:, None] - t)) * (0.5 * lengths[:, None] * weights)
    return np.einsum("pnt,ntr->pnr", falling, _cubics(t))


def _cubics(t: np.ndarray) -> np.ndarray:
    """Return the weights of the four rows at positions in the interval, shape (..., 4)."""
    return np.stack([math.prod((t - b) / (a - b) for b in _NODES if b != a) for a in _NODES], axis=-1)


@lru_cache(maxsize=256)
def coefficients(
    poles: tuple[complex, ...], residues: tuple[complex, ...], direct: float, parts: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the coefficients of one filter: pole steps, steady states for 1 V, and sample weights by position.

    Args:
        poles: Poles [1/row].
        residues: Residues [1/row].
        direct: Direct gain.
        parts: Sample positions per row interval.

    Returns:
        Arrays of shapes (p, POLE), (p, 2), (parts, 4 + 2 p); cached, so do not modify them.
    """
    p, r = np.array(poles, complex), np.array(residues, complex)
    factor, settled = np.exp(p), -r / p
    highpass = r[:, None] * _integrals(p, np.ones(1))[:, 0]
    step = np.hstack([np.real(factor)[:, None], np.imag(factor)[:, None], np.real(highpass), np.imag(highpass)])
    places = np.arange(parts) / parts
    turned = np.exp(p * places[:, None])
    rows = direct * _cubics(places) + np.real(r[:, None, None] * _integrals(p, places)).sum(axis=0)
    waves = np.stack([np.real(turned), np.imag(turned)], axis=2).reshape(parts, -1)
    return step, np.stack([np.real(settled), np.imag(settled)], axis=1), np.hstack([rows, waves])


def digital_coefficients(channel: Channel, row_rate_hz: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `coefficients` for samples on rows, of filters by the bilinear transform with prewarped corners."""

    def warped(hz: float) -> float:
        return row_rate_hz / math.pi * math.tan(math.pi * hz / row_rate_hz)

    bent = {"bandwidth_hz": min(channel.bandwidth_hz, 0.49 * row_rate_hz), "highpass_hz": channel.highpass_hz}
    bent = {name: warped(hz) for name, hz in bent.items()}
    known_hz = math.inf if channel.bandwidth_hz < 0.45 * row_rate_hz else row_rate_hz
    poles, residues, direct = channel_poles(channel.model_copy(update=bent), known_hz)
    p, r = poles / row_rate_hz, residues / row_rate_hz
    # r / (s - p) with s = 2 (z - 1) / (z + 1) is k + q / (z - f).
    f = (2.0 + p) / (2.0 - p)
    k, q = r / (2.0 - p), 4.0 * r / (2.0 - p) ** 2
    step = np.zeros((len(p), POLE))
    step[:, 0], step[:, 1], step[:, 3], step[:, 7] = np.real(f), np.imag(f), np.real(q), np.imag(q)
    settled = q / (1.0 - f)
    phase = np.zeros((1, 4 + 2 * len(p)))
    phase[0, 1], phase[0, 4::2] = direct + np.real(k).sum(), 1.0
    return step, np.stack([np.real(settled), np.imag(settled)], axis=1), phase
