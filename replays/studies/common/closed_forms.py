"""What the trials are held against: closed forms, quadratures and small linear problems, none of it the rig's code."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np


class Impact(NamedTuple):
    """One central impact on a fixed wall."""

    restitution: float
    impulse: float  # [N s]
    peak: float  # [N]
    duration: float  # [s]
    depth: float  # [m]


def impact(
    *, mass: float, speed: float, stiffness: float, exponent: float, factor: float, speed_floor: float
) -> Impact:
    """A mass hits F = K d^n (1 + c d'/v0), v0 = max(speed, speed_floor), and nothing else acts on it.

    m v dv = -K d^n (1 + g v) dd with g = c/v0 separates: K d^(n+1)/(n+1) = m G(v) with
    G(v) = int_v^speed u/(1 + g u) du, elementary. The end is the other zero of G; the time is int m dv/F.

    Args:
        mass: m [kg].
        speed: Approach [m/s].
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
        # a - log(1 + a), without cancellation where it is small.
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
    # F goes as s^(n/(n+1)) at both ends, with s the distance in speed from there: s = u^(n+1) takes that out.
    power = exponent + 1.0
    middle = 0.5 * (speed - rebound)

    def before(u: float) -> float:
        return mass * power * u**exponent / force(speed - u**power) if u > 0.0 else 0.0

    def after(u: float) -> float:
        return mass * power * u**exponent / force(u**power - rebound) if u > 0.0 else 0.0

    duration = 0.0
    for part, end in ((before, speed - middle), (after, middle + rebound)):
        # The ends themselves, where force and u both vanish, are left to the quadrature's open rule.
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
    """Depth and its rate of a mass that a load pushes into F = K d^n max(0, 1 + c d'/v0), from rest at d = 0.

    Radau at a tolerance of 1e-10: implicit, so that a stale, small v0 may make the law as stiff as it likes.

    Args:
        mass: m [kg].
        load: Force over time [N], a function of seconds.
        stiffness: K [N/m^n].
        exponent: n.
        factor: c [1].
        onset_speed: v0 [m/s], held.
        times: Instants wanted [s], shape (n,).

    Returns:
        Shape (n, 2) [m, m/s].
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
    """One undamped mode of the houses."""

    frequency_hz: float
    inner: float  # displacement of the inner house, largest of both 1
    outer: float


def stiffest_mode(*, inner: float, outer: float, link: float, support: float) -> Mode:
    """The faster mode of two masses on a line: inner - link - outer - support - ground [kg, kg, N/m, N/m]."""
    stiffness = np.array([[link, -link], [-link, link + support]])
    mass = np.array([inner, outer])
    values, vectors = np.linalg.eigh(stiffness / np.sqrt(mass[:, None] * mass[None, :]))
    shape = vectors[:, -1] / np.sqrt(mass)
    shape = shape / shape[np.argmax(np.abs(shape))]
    return Mode(math.sqrt(values[-1]) / (2.0 * math.pi), float(shape[0]), float(shape[1]))


RUNGE_KUTTA_4_LIMIT = 2.0 * math.sqrt(2.0)
"""h w up to which |R(i h w)| <= 1: |R|^2 = 1 - z^6/72 + z^8/576, so z^2 = 8. (2.785 is the limit on the real axis.)"""
RUNGE_KUTTA_4_REAL_LIMIT = 2.7852935634
"""h lambda up to which R(-h lambda) = 1 - z + z^2/2 - z^3/6 + z^4/24 stays below 1: what damping must keep."""
VERLET_LIMIT = 2.0


def linear_motion(rates: np.ndarray, constant: np.ndarray, z0: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Z' = A z + b by the exponential of the bordered matrix, shape (n, len(z0))."""
    from scipy.linalg import expm

    size = len(z0)
    bordered = np.zeros((size + 1, size + 1))
    bordered[:size, :size] = rates
    bordered[:size, size] = constant
    first = np.append(z0, 1.0)
    return np.array([(expm(bordered * t) @ first)[:size] for t in times])
