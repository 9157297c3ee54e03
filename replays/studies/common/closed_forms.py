"""Reference solutions for the trials, independent of the rig: closed forms, quadratures and small linear problems."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np


class Impact(NamedTuple):
    """A central impact on a fixed wall."""

    restitution: float
    impulse: float  # [N s]
    peak: float  # [N]
    duration: float  # [s]
    depth: float  # [m]


def impact(
    *, mass: float, speed: float, stiffness: float, exponent: float, factor: float, speed_floor: float
) -> Impact:
    """Return the impact of a mass without other forces on F = K d^n (1 + c d'/v0), v0 = max(speed, speed_floor).

    m v dv = -K d^n (1 + g v) dd with g = c/v0 separates: K d^(n+1)/(n+1) = m G(v) with the elementary
    G(v) = int_v^speed u/(1 + g u) du. The impact ends at the other zero of G; its duration is int m dv/F.

    Args:
        mass: m [kg].
        speed: Approach speed [m/s].
        stiffness: K [N/m^n].
        exponent: n.
        factor: c [1].
        speed_floor: Lower limit of v0 [m/s].
    """
    from scipy.integrate import quad
    from scipy.optimize import brentq, minimize_scalar

    g = factor / max(speed, speed_floor)

    def work(v: float) -> float:
        a = g * (speed - v) / (1.0 + g * v)
        if abs(g * speed) < 1e-9:
            return 0.5 * (speed * speed - v * v)
        # a - log(1 + a), without cancellation for small a.
        rest = a * a * (0.5 - a * (1.0 / 3.0 - a * (0.25 - 0.2 * a))) if abs(a) < 1e-4 else a - math.log1p(a)
        return (a * g * v + rest) / (g * g)

    def depth(v: float) -> float:
        return ((exponent + 1.0) * mass * max(0.0, work(v)) / stiffness) ** (1.0 / (exponent + 1.0))

    def force(v: float) -> float:
        return stiffness * depth(v) ** exponent * (1.0 + g * v)

    low = -speed if g * speed < 1.0 else -1.0 / g * (1.0 - 1e-12)
    root: Any = -speed
    if factor:
        root = brentq(work, low, -1e-12 * speed, xtol=1e-18, rtol=np.float64(1e-14))
    rebound = -float(root)
    peak: Any = minimize_scalar(
        lambda v: -force(v), bounds=(-rebound, speed), method="bounded", options={"xatol": 1e-12}
    )
    # At both ends F is proportional to s^(n/(n+1)), with s the speed from the end; s = u^(n+1) removes the singularity.
    power = exponent + 1.0
    middle = 0.5 * (speed - rebound)

    def before(u: float) -> float:
        return mass * power * u**exponent / force(speed - u**power) if u > 0.0 else 0.0

    def after(u: float) -> float:
        return mass * power * u**exponent / force(u**power - rebound) if u > 0.0 else 0.0

    duration = 0.0
    for part, end in ((before, speed - middle), (after, middle + rebound)):
        # F and u both vanish at u = 0, so the first thousandth is added as a rectangle.
        value: Any = quad(part, 1e-3 * end ** (1.0 / power), end ** (1.0 / power), epsabs=0.0, epsrel=1e-10)
        first: Any = part(1e-3 * end ** (1.0 / power)) * 1e-3 * end ** (1.0 / power)
        duration += float(value[0]) + float(first)
    return Impact(
        restitution=rebound / speed,
        impulse=mass * (speed + rebound),
        peak=-float(peak.fun),
        duration=duration,
        depth=depth(0.0),
    )


def pushed_contact(
    *, mass: float, load: Any, stiffness: float, exponent: float, factor: float, onset_speed: float, times: np.ndarray
) -> np.ndarray:
    """Return depth and its rate of a mass pushed by a load into F = K d^n max(0, 1 + c d'/v0), from rest at d = 0.

    Uses Radau, an implicit method, at a tolerance of 1e-10, because a small v0 kept from the onset makes the law stiff.

    Args:
        mass: m [kg].
        load: Force over time [N], a function of seconds.
        stiffness: K [N/m^n].
        exponent: n.
        factor: c [1].
        onset_speed: v0 [m/s], constant.
        times: Output times [s], shape (n,).

    Returns:
        Depth and rate, shape (n, 2) [m, m/s].
    """
    from scipy.integrate import solve_ivp

    def rates(t: float, z: np.ndarray) -> list[float]:
        depth = max(0.0, float(z[0]))
        force = stiffness * depth**exponent * max(0.0, 1.0 + factor * float(z[1]) / onset_speed)
        return [float(z[1]), (load(t) - force) / mass]

    run = solve_ivp(
        rates, (0.0, float(times[-1])), [0.0, 0.0], method="Radau", t_eval=times, rtol=1e-10, atol=[1e-15, 1e-12]
    )
    return run.y.T


class Mode(NamedTuple):
    """An undamped mode of the housings."""

    frequency_hz: float
    inner: float  # displacement of the inner housing; the larger of the two is 1
    outer: float


def stiffest_mode(*, inner: float, outer: float, link: float, support: float) -> Mode:
    """Return the faster mode of two masses on a line: inner - link - outer - support - ground [kg, kg, N/m, N/m]."""
    stiffness = np.array([[link, -link], [-link, link + support]])
    mass = np.array([inner, outer])
    values, vectors = np.linalg.eigh(stiffness / np.sqrt(mass[:, None] * mass[None, :]))
    shape = vectors[:, -1] / np.sqrt(mass)
    shape = shape / shape[np.argmax(np.abs(shape))]
    return Mode(math.sqrt(values[-1]) / (2.0 * math.pi), float(shape[0]), float(shape[1]))


RUNGE_KUTTA_4_LIMIT = 2.0 * math.sqrt(2.0)
"""Stability limit of h w, where |R(i h w)| = 1: |R|^2 = 1 - z^6/72 + z^8/576, so z^2 = 8 (on the real axis 2.785)."""
RUNGE_KUTTA_4_REAL_LIMIT = 2.7852935634
"""Limit of h lambda for damping (real axis), where R(-h lambda) = 1 - z + z^2/2 - z^3/6 + z^4/24 reaches 1."""
VERLET_LIMIT = 2.0


def linear_motion(rates: np.ndarray, constant: np.ndarray, z0: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the solution of z' = A z + b by the exponential of the bordered matrix, shape (n, len(z0))."""
    from scipy.linalg import expm

    size = len(z0)
    bordered = np.zeros((size + 1, size + 1))
    bordered[:size, :size] = rates
    bordered[:size, size] = constant
    first = np.append(z0, 1.0)
    return np.array([(expm(bordered * t) @ first)[:size] for t in times])
