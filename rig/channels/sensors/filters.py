"""Filters of a channel in continuous time, as steps from row to row and samples anywhere between.

Filters are solved exactly, by partial fractions of their transfer function: every pole p has a state w of its own,

    w' = p w + r u(t),    volts behind the filters = direct u(t) + sum of Re w,

with u the cubic through the last four rows. So a sample may fall between rows, at any rate, and neither the engine's
step nor the way a run is cut into calls has a part in what the chain does. A cubic errs by (2 pi f T)^4 / 24 of a sine
of frequency f at most, rows T apart: 3e-5 at 1 kHz and 25 us.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from rig.channels.table import Channel

_NODES = (1.0, 0.0, -1.0, -2.0)
"""Where the four rows stand that a cubic goes through, in rows from the start of the interval it is for."""
_NEAR = 1e-3
"""How near a high-pass may come to the low-pass, as a part: of poles that are one, fractions have no parts."""
POLE = 10
"""Numbers of a pole's step: the state's factor, and what the four rows add to it; real and imaginary parts."""


def channel_poles(channel: Channel, row_rate_hz: float = math.inf) -> tuple[np.ndarray, np.ndarray, float]:
    """Poles of a channel's filters [rad/s], one of each pair, their residues, and what goes straight through.

    A Butterworth low-pass at the channel's bandwidth (none where rows cannot show what it takes away), and a
    first-order high-pass where the channel is AC-coupled.
    """
    order = channel.filter_order if channel.bandwidth_hz < 0.45 * row_rate_hz else 0
    corner, held = 2.0 * math.pi * channel.bandwidth_hz, 2.0 * math.pi * channel.highpass_hz
    if order and abs(held - corner) < _NEAR * corner:
        held = (1.0 - _NEAR) * corner
    angles = [math.pi * (2 * n + order + 1) / (2 * order) for n in range(order)]
    low = [corner * complex(math.cos(angle), math.sin(angle)) for angle in angles]
    found, residues = [], []
    for n, pole in enumerate([*low, complex(-held)] if held else low):
        if pole.imag < -1e-9 * abs(pole):
            continue  # the other of a pair
        residue = complex(pole) if held else complex(1.0)
        for m, other in enumerate(low):
            residue *= corner / (pole - other) if m != n else corner
        if n < order and held:
            residue /= pole + held
        found.append(pole)
        residues.append(residue * (2.0 if pole.imag > 1e-9 * abs(pole) else 1.0))
    return np.array(found, complex), np.array(residues, complex), 0.0 if low else 1.0


def _held(poles: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Integrals of exp(p (length - t)) times the four rows' weights, from 0 to the length.

    Args:
        poles: Per row, shape (p,).
        lengths: In rows, shape (n,).

    Returns:
        Shape (p, n, 4).
    """
    places, weights = np.polynomial.legendre.leggauss(24)
    t = 0.5 * lengths[:, None] * (places + 1.0)
    falling = np.exp(poles[:, None, None] * (lengths[:, None] - t)) * (0.5 * lengths[:, None] * weights)
    return np.einsum("pnt,ntr->pnr", falling, _cubics(t))


def _cubics(t: np.ndarray) -> np.ndarray:
    """Weights of the four rows at places in the interval, shape (..., 4)."""
    return np.stack([math.prod((t - b) / (a - b) for b in _NODES if b != a) for a in _NODES], axis=-1)


@lru_cache(maxsize=256)
def coefficients(
    poles: tuple[complex, ...], residues: tuple[complex, ...], direct: float, parts: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of one filter: the steps of its poles, their state in the steady state of 1 V, and samples by their place.

    Args:
        poles: Per row.
        residues: Per row.
        direct: What goes straight through.
        parts: Places of samples in a row.

    Returns:
        Shapes (p, POLE), (p, 2), (parts, 4 + 2 p); not to be written to.
    """
    p, r = np.array(poles, complex), np.array(residues, complex)
    factor, settled = np.exp(p), -r / p
    held = r[:, None] * _held(p, np.ones(1))[:, 0]
    step = np.hstack([np.real(factor)[:, None], np.imag(factor)[:, None], np.real(held), np.imag(held)])
    places = np.arange(parts) / parts
    turned = np.exp(p * places[:, None])
    rows = direct * _cubics(places) + np.real(r[:, None, None] * _held(p, places)).sum(axis=0)
    waves = np.stack([np.real(turned), np.imag(turned)], axis=2).reshape(parts, -1)
    return step, np.stack([np.real(settled), np.imag(settled)], axis=1), np.hstack([rows, waves])


def digital_coefficients(channel: Channel, row_rate_hz: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `coefficients`, for samples on rows, of filters by the bilinear transform with their corners in place."""

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
