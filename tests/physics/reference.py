"""An independent reference of the rig's model: plain numpy, scipy's DOP853, nothing shared with the product.

It exists so that agreement with the product's kernels means something. Nothing here is imported from `rig`, and the
shaft is written differently: Lagrange's equations with the mass matrix and its Christoffel terms, generalised forces
from the Jacobian of the axis, instead of Euler's equations in the turning frame.

Shaft. The axis points along `a = (sin b, -sin G cos b, cos G cos b)`; its kinetic energy about the pivot is
`T = 1/2 [Ixx (G'^2 cos^2 b + b'^2) + Izz w^2]`, `w = theta' + G' sin b`. Only `b` enters the mass matrix, so

    M(b) q'' + b' M_b q' - 1/2 (q' . M_b q') (0, 1, 0) = Q,    M_b = dM/db

A lateral force F at arm l does the virtual work `F . l J dq`, with J the Jacobian of `(sin b, -sin G cos b)`: all
lateral forces enter through the one vector `sum l_i F_i`. A couple T about the axis does `T (dtheta + sin b dG)`.

Contact. `e = p(l0A) - p_ih - (x0, y0)`, `n = e/|e|`, `t = (-n_y, n_x)`, `d = |e| - r0`,
`v_t = (v(l0A) - v_ih) . t + R_S w`; `F_n = max(0, K d^1.5 (1 + c d'/v0))`, friction `mu F_n tanh(v_t/v_s)`. `v0` is d'
where the running contact began, at least `v_floor`.

House. Absolute coordinates; each opposed transducer pair reads `P0 +- k/2 u`, each at least 0, and pushes with the
difference. Weights of the houses are balanced by their static deflection and left out.

Every discontinuity of the right-hand side or of its slope is a point where the integration stops and restarts: onset,
lift-off, the tension clamp, a lost preload, the hammer's two corners. States there and at the asked times are
reached by integration steps that end exactly there, never by interpolation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Lateral position [m] and velocity [m/s] of a point: (x, y, x', y').
Planar = tuple[float, float, float, float]

#: The 14 states, in order: angles [rad], house displacements [m], then their rates.
STATES = ("G", "b", "th", "x_ih", "y_ih", "x_oh", "y_oh")
#: The integrals of power [J] that `solve` carries along; each is the work done *on* the stored energy.
WORKS = ("drive", "hammer", "unbalance", "shaft_damping", "house_damping", "contact_damping", "friction")

_ATOL_STATES = np.array([1e-14, 1e-14, 1e-12, 1e-17, 1e-17, 1e-17, 1e-17, 1e-12, 1e-12, 1e-11, *[1e-13] * 4])
_ATOL_WORKS = np.full(len(WORKS), 1e-13)


@dataclass(frozen=True)
class Rig:
    """The rig's numbers by the paper's symbols, SI units; the defaults are the corrected set."""

    # shaft
    M: float = 1.28
    Ixx: float = 0.0771
    Izz: float = 7.78e-4
    l0A: float = 0.197
    l0B: float = 0.391
    l0C: float = 0.176
    l0I: float = 0.314
    eps: float = 1e-4
    phi: float = 0.21
    g: float = 9.81
    # magnets: F(r) = -K_mag (r + a3 r^3 + a5 r^5 + a7 r^7); viscous damping at the same point
    K_mag: float = 1.7e3
    a3: float = 1.3e4
    a5: float = 0.0
    a7: float = 0.0
    D_x: float = 2 * 0.016 * math.sqrt(1.7e3 * 1.28)
    D_y: float = 2 * 0.035 * math.sqrt(1.7e3 * 1.28)
    # drive: torque c_d (omega0 - theta'), or theta'' = 0
    c_d: float = 0.1
    ideal_drive: bool = False
    # contact
    R_S: float = 12.5e-3
    r0: float = 12.5e-3 / 13.5
    x0: float = 0.0
    y0: float = 0.0
    K: float = 2.86e10
    c: float = 0.1665
    mu: float = 0.25
    v_s: float = 1e-3
    v_floor: float = 1e-3
    # house
    M_ih: float = 1.70
    M_oh: float = 7.18
    K_bv: float = 1.23e7
    K_bh: float = 2.4e7
    D_bv: float = 238.0
    D_bh: float = 1576.0
    k_ns: float = 2 * 8.88e7
    k_ew: float = 2 * 8.88e7
    P0: float = 5e3

    @property
    def conservative(self) -> Rig:
        """The same rig without any dissipation or supply of energy."""
        return replace(self, D_x=0.0, D_y=0.0, D_bv=0.0, D_bh=0.0, c=0.0, mu=0.0, c_d=0.0, eps=0.0)


class Contact(NamedTuple):
    """One evaluation of the contact law."""

    d: float
    d_rate: float
    v_t: float
    F_n: float
    F_t: float
    #: Force on the shaft at l0A [N]; the inner house gets the opposite.
    Fx: float
    Fy: float
    #: Couple on the shaft about its own axis [N m].
    couple: float


@dataclass
class Solution:
    """What `solve` returns; n is the number of asked times."""

    #: Asked times [s], shape (n,).
    t: Array
    #: States at these times, shape (n, 14).
    states: Array
    #: v0 of the contact running at these times [m/s], nan in free flight, shape (n,).
    v0: Array
    #: Works since t[0] [J], columns WORKS, shape (n, 7).
    works: Array
    #: (time [s], v0 [m/s]) of each onset.
    onsets: list[tuple[float, float]] = field(default_factory=list)
    #: (time [s], separation speed -d' [m/s]) of each lift-off.
    liftoffs: list[tuple[float, float]] = field(default_factory=list)
    #: Peak of F_n over the accepted steps' inner points [N], one per onset.
    peaks: list[float] = field(default_factory=list)
    #: Calls of the right-hand side.
    evaluations: int = 0


# ---- kinematics -----------------------------------------------------------------------------------------------------


def axis_point(arm: float, y: Array) -> tuple[Array, Array, Array, Array]:
    """Lateral position [m] and velocity [m/s] of the axis at an arm [m]: x, y, x', y'; y of shape (14+, ...)."""
    sG, cG, sb, cb = np.sin(y[0]), np.cos(y[0]), np.sin(y[1]), np.cos(y[1])
    return arm * sb, -arm * sG * cb, arm * cb * y[8], arm * (sG * sb * y[8] - cG * cb * y[7])


def gap(rig: Rig, y: Array) -> tuple[Array, Array]:
    """Penetration d [m] and its rate [m/s]; negative in free flight; y of shape (14+, ...)."""
    x, yy, vx, vy = axis_point(rig.l0A, y)
    ex, ey = x - y[3] - rig.x0, yy - y[4] - rig.y0
    r = np.hypot(ex, ey)
    rate = (ex * (vx - y[10]) + ey * (vy - y[11])) / np.maximum(r, 1e-300)
    return r - rig.r0, rate


def contact(rig: Rig, shaft: Planar, house: Planar, w: float, v0: float) -> Contact:
    """The contact law in the plane, from the motion of the shaft at l0A and of the inner house."""
    ex, ey = shaft[0] - house[0] - rig.x0, shaft[1] - house[1] - rig.y0
    ux, uy = shaft[2] - house[2], shaft[3] - house[3]
    r = math.hypot(ex, ey)
    nx, ny = ex / r, ey / r
    d = r - rig.r0
    d_rate = ux * nx + uy * ny
    v_t = uy * nx - ux * ny + rig.R_S * w
    F_n = max(0.0, rig.K * max(d, 0.0) ** 1.5 * (1.0 + rig.c * d_rate / v0))
    F_t = rig.mu * F_n * math.tanh(v_t / rig.v_s)
    return Contact(d, d_rate, v_t, F_n, F_t, -F_n * nx + F_t * ny, -F_n * ny - F_t * nx, -rig.R_S * F_t)


def contact_at(rig: Rig, y: Array, v0: float) -> Contact:
    """The contact law at a full state of shape (14,)."""
    x, yy, vx, vy = (float(v) for v in axis_point(rig.l0A, y))
    house = (float(y[3]), float(y[4]), float(y[10]), float(y[11]))
    return contact(rig, (x, yy, vx, vy), house, float(y[9] + y[7] * math.sin(y[1])), v0)


def transducers(rig: Rig, y: Array) -> tuple[Array, Array, Array, Array]:
    """Readings P_N, P_S, P_E, P_W [N], at least 0."""
    u, w = 0.5 * rig.k_ns * (y[4] - y[6]), 0.5 * rig.k_ew * y[5]
    return (
        np.maximum(rig.P0 + u, 0.0),
        np.maximum(rig.P0 - u, 0.0),
        np.maximum(rig.P0 + w, 0.0),
        np.maximum(rig.P0 - w, 0.0),
    )


def pair_force(u: float, k: float, P0: float) -> float:
    """Restoring force [N] of an opposed pair of stiffness k at the displacement u: difference of the two readings."""
    return max(P0 + 0.5 * k * u, 0.0) - max(P0 - 0.5 * k * u, 0.0)


# ---- energies -------------------------------------------------------------------------------------------------------


def _pair_energy(u: float, k: float, P0: float) -> float:
    """Potential of an opposed pair: stiffness k until one side is unloaded at |u| = 2 P0/k, then k/2."""
    u, u0 = abs(u), 2 * P0 / k if k > 0 else math.inf
    if u <= u0:
        return 0.5 * k * u * u
    return 0.5 * k * u0 * u0 + P0 * (u - u0) + 0.25 * k * (u * u - u0 * u0)


def energies(rig: Rig, y: Array, *, magnet: bool = True) -> dict[str, float]:
    """Stored energies [J] at a state of shape (14,); "total" is their sum."""
    G, b = y[0], y[1]
    Gd, bd, thd = y[7], y[8], y[9]
    xB, yB, _, _ = axis_point(rig.l0B, y)
    r2 = float(xB * xB + yB * yB)
    d = max(float(gap(rig, y)[0]), 0.0)
    out = {
        "shaft": 0.5 * rig.Ixx * ((Gd * math.cos(b)) ** 2 + bd**2) + 0.5 * rig.Izz * (thd + Gd * math.sin(b)) ** 2,
        "gravity": -rig.M * rig.g * rig.l0C * math.sin(G) * math.cos(b),
        "magnet": rig.K_mag * r2 * (1 / 2 + r2 * (rig.a3 / 4 + r2 * (rig.a5 / 6 + r2 * rig.a7 / 8))) if magnet else 0.0,
        "house_motion": 0.5 * rig.M_ih * (y[10] ** 2 + y[11] ** 2) + 0.5 * rig.M_oh * (y[12] ** 2 + y[13] ** 2),
        "beams": 0.5 * rig.K_bv * (y[3] - y[5]) ** 2 + 0.5 * rig.K_bh * y[6] ** 2,
        "transducers": _pair_energy(y[4] - y[6], rig.k_ns, rig.P0) + _pair_energy(y[5], rig.k_ew, rig.P0),
        "contact": rig.K * d**2.5 / 2.5,
    }
    out = {name: float(value) for name, value in out.items()}
    out["total"] = sum(out.values())
    return out


# ---- equations of motion --------------------------------------------------------------------------------------------


def lateral_forces(
    rig: Rig,
    t: float,
    unit: Planar,
    spin: tuple[float, float],
    *,
    hammer: tuple[float, float, float, float] | None,
    magnet: bool,
) -> list[tuple[str, float, float, float]]:
    """The applied lateral forces but the contact, as (name, arm [m], Fx [N], Fy [N]).

    `unit` is the lateral position and velocity of the axis at unit arm: any other point of it is arm times that.
    `spin` is (theta, theta').
    """
    xB, yB, vxB, vyB = (rig.l0B * v for v in unit)
    u = rig.M * rig.eps * spin[1] * spin[1]
    forces = [
        ("shaft_damping", rig.l0B, -rig.D_x * vxB, -rig.D_y * vyB),
        ("gravity", rig.l0C, 0.0, -rig.M * rig.g),
        ("unbalance", rig.l0I, u * math.cos(spin[0] + rig.phi), u * math.sin(spin[0] + rig.phi)),
    ]
    if magnet:
        r2 = xB * xB + yB * yB
        k = rig.K_mag * (1 + r2 * (rig.a3 + r2 * (rig.a5 + r2 * rig.a7)))
        forces.append(("magnet", rig.l0B, -k * xB, -k * yB))
    if hammer is not None and 0.0 <= t - hammer[0] <= hammer[1]:
        h = hammer[2] * math.sin(math.pi * (t - hammer[0]) / hammer[1])
        forces.append(("hammer", rig.l0I, h * math.cos(hammer[3]), h * math.sin(hammer[3])))
    return forces


def rhs(
    rig: Rig,
    t: float,
    y: Array,
    *,
    omega0: float,
    v0: float | None = None,
    hammer: tuple[float, float, float, float] | None = None,
    magnet: bool = True,
) -> Array:
    """Time derivative of the 14 states followed by the 7 powers of WORKS, shape (21,).

    Args:
        rig: The rig's numbers.
        t: Time [s]; only the hammer reads it.
        y: State, shape (14,) or longer (what follows is ignored).
        omega0: The drive's set speed [rad/s].
        v0: Impact speed of the running contact [m/s]; None without contact.
        hammer: (start [s], duration [s], amplitude [N], direction from +x [rad]).
        magnet: Whether the magnets act; the viscous damping stays either way.
    """
    G, b, th, x_ih, y_ih, x_oh, y_oh, Gd, bd, thd, vx_ih, vy_ih, vx_oh, vy_oh = y[:14].tolist()
    sb, cb, sG, cG = math.sin(b), math.cos(b), math.sin(G), math.cos(G)
    w = thd + Gd * sb
    unit = (sb, -sG * cb, cb * bd, sG * sb * bd - cG * cb * Gd)
    power = dict.fromkeys(WORKS, 0.0)

    mx = my = 0.0  # sum of arm x force
    for name, arm, Fx, Fy in lateral_forces(rig, t, unit, (th, thd), hammer=hammer, magnet=magnet):
        mx += arm * Fx
        my += arm * Fy
        if name in power:
            power[name] = arm * (Fx * unit[2] + Fy * unit[3])

    Fx_c = Fy_c = couple = 0.0
    if v0 is not None:
        lA = rig.l0A
        ring = contact(rig, (lA * unit[0], lA * unit[1], lA * unit[2], lA * unit[3]), (x_ih, y_ih, vx_ih, vy_ih), w, v0)
        Fx_c, Fy_c, couple = ring.Fx, ring.Fy, ring.couple
        mx += lA * Fx_c
        my += lA * Fy_c
        power["friction"] = -ring.F_t * ring.v_t
        power["contact_damping"] = -(ring.F_n - rig.K * max(ring.d, 0.0) ** 1.5) * ring.d_rate

    # Lagrange. Mass matrix [[m_GG, 0, m_Gt], [0, Ixx, 0], [m_Gt, 0, Izz]] and its slope in b, the only coordinate in it
    m_GG, m_Gt, m_tt = rig.Ixx * cb * cb + rig.Izz * sb * sb, rig.Izz * sb, rig.Izz
    s_GG, s_Gt = 2 * (rig.Izz - rig.Ixx) * sb * cb, rig.Izz * cb
    Q_G = -cG * cb * my + sb * couple - bd * (s_GG * Gd + s_Gt * thd)
    Q_b = cb * mx + sG * sb * my + 0.5 * (s_GG * Gd * Gd + 2 * s_Gt * Gd * thd)
    Q_t = couple - bd * s_Gt * Gd
    # a torque T about the axis does the work T (dtheta + sin b dG)
    if rig.ideal_drive:  # T is whatever holds theta'' = 0
        Gdd, thdd = (Q_G - sb * Q_t) / (m_GG - sb * m_Gt), 0.0
        torque = m_Gt * Gdd - Q_t
    else:
        torque = rig.c_d * (omega0 - thd)
        Q_G, Q_t = Q_G + sb * torque, Q_t + torque
        det = m_GG * m_tt - m_Gt * m_Gt
        Gdd, thdd = (m_tt * Q_G - m_Gt * Q_t) / det, (m_GG * Q_t - m_Gt * Q_G) / det
    power["drive"] = torque * w

    # houses: inner hangs on the vertical beams in x and the N/S pair in y, outer on the E/W pair in x and beams in y
    pair_ns = pair_force(y_ih - y_oh, rig.k_ns, rig.P0)
    pair_ew = pair_force(x_oh, rig.k_ew, rig.P0)
    beam = rig.D_bv * (vx_ih - vx_oh) + rig.K_bv * (x_ih - x_oh)
    power["house_damping"] = -rig.D_bv * (vx_ih - vx_oh) ** 2 - rig.D_bh * vy_oh**2

    out = np.empty(14 + len(WORKS))
    out[:7] = y[7:14]
    out[7:14] = (
        Gdd,
        Q_b / rig.Ixx,
        thdd,
        (-Fx_c - beam) / rig.M_ih,
        (-Fy_c - pair_ns) / rig.M_ih,
        (beam - pair_ew) / rig.M_oh,
        (pair_ns - rig.D_bh * vy_oh - rig.K_bh * y_oh) / rig.M_oh,
    )
    out[14:] = list(power.values())
    return out


def hanging(rig: Rig, *, spin: float) -> tuple[Rig, Array]:
    """The rig with its ring centred on the sagged shaft, and the state at rest there with the given spin [rad/s]."""
    import scipy.optimize

    brentq: Any = scipy.optimize.brentq

    def moment(G: float) -> float:
        forces = lateral_forces(rig, 0.0, (0.0, -math.sin(G), 0.0, 0.0), (0.0, 0.0), hammer=None, magnet=True)
        return sum(arm * Fy for _, arm, _, Fy in forces)

    y = np.zeros(14)
    y[0] = brentq(moment, 0.0, 0.1, xtol=1e-16)
    y[9] = spin
    return replace(rig, x0=0.0, y0=float(axis_point(rig.l0A, y)[1])), y


def on_ring(rig: Rig, *, angle: float, radius: float | None = None, spin: float = 0.0) -> Array:
    """State at rest, the shaft's centre at an angle [rad] and a distance (default r0) from the ring's centre."""
    r = rig.r0 if radius is None else radius
    y = np.zeros(14)
    y[1] = math.asin((rig.x0 + r * math.cos(angle)) / rig.l0A)
    y[0] = -math.asin((rig.y0 + r * math.sin(angle)) / (rig.l0A * math.cos(y[1])))
    y[9] = spin
    return y


# ---- integration ----------------------------------------------------------------------------------------------------


@dataclass
class _Mode:
    """Where the integration stands between two switches."""

    #: Impact speed of the running contact [m/s]; None is free flight.
    v0: float | None
    #: Whether the gap is zero at the start of the mode, to rounding.
    at_gap: bool
    #: Number of the kink that is zero at the start of the mode, or -1.
    at_kink: int

    @property
    def sign(self) -> float:
        """Sign of the penetration inside the mode."""
        return -1.0 if self.v0 is None else 1.0


class _Event(NamedTuple):
    time: float
    #: -1: the gap's zero; else the kink's number.
    kink: int


def _kinks(rig: Rig, mode: _Mode, z: Array) -> list[Array]:
    """Functions whose zero is a corner of the right-hand side within a mode; z of shape (14+, ...)."""
    u, w = 0.5 * rig.k_ns * (z[4] - z[6]), 0.5 * rig.k_ew * z[5]
    found = [rig.P0 + u, rig.P0 - u, rig.P0 + w, rig.P0 - w]
    return found if mode.v0 is None else [*found, 1.0 + rig.c * gap(rig, z)[1] / mode.v0]


def _first_event(rig: Rig, mode: _Mode, dense: Callable[..., Array], times: Array) -> _Event | None:
    """The first zero of a switching function in a step, by its interpolant looked at in some times.

    The gap is also looked for between these times, wherever its rate turns. `mode.at_gap` and `mode.at_kink` say what
    is zero at times[0] because it was met there; it is not met again.
    """
    import scipy.optimize

    brentq: Any = scipy.optimize.brentq

    def root(f: Callable[[float], float], left: float, right: float) -> float:
        return float(brentq(f, left, right, xtol=1e-17, rtol=1e-15))

    def inside(time: float) -> float:
        return mode.sign * float(gap(rig, dense(time))[0])

    def inside_rate(time: float) -> float:
        return mode.sign * float(gap(rig, dense(time))[1])

    def kink(time: float, number: int) -> float:
        return float(_kinks(rig, mode, dense(time))[number])

    points = dense(times)
    d, rate = (mode.sign * v for v in gap(rig, points))
    kinks = _kinks(rig, mode, points)
    for k in range(len(times) - 1):
        left, right = float(times[k]), float(times[k + 1])
        found: list[_Event] = []
        outside = None
        if d[k + 1] <= 0.0:
            outside = right
        elif rate[k] < 0.0 < rate[k + 1]:
            dip = root(inside_rate, left, right)
            outside = dip if inside(dip) < 0.0 else None
        if outside is not None:
            start: float | None = left
            if k == 0 and mode.at_gap:
                # zero to rounding, of either sign: look for a time that is inside the mode at all
                trials = (left + (outside - left) * 0.5**j for j in range(1, 40))
                start = next((time for time in trials if inside(time) > 0.0), None)
            found.append(_Event(left if start is None else root(inside, start, outside), -1))
        for i, g in enumerate(kinks):
            if g[k] * g[k + 1] < 0.0 and not (k == 0 and i == mode.at_kink):
                found.append(_Event(root(lambda time, i=i: kink(time, i), left, right), i))
        if found:
            return min(found)
    return None


def solve(
    rig: Rig,
    y0: Array,
    t_out: Array,
    *,
    omega0: float,
    hammer: tuple[float, float, float, float] | None = None,
    magnet: bool = True,
    rtol: float = 1e-11,
    atol: Array | None = None,
    max_step: float = 5e-5,
    v0: float | None = None,
    method: str = "DOP853",
) -> Solution:
    """Integrates from y0 at t_out[0] and returns the states at t_out.

    Args:
        rig: The rig's numbers.
        y0: State at t_out[0], shape (14,).
        t_out: Increasing times [s], shape (n,).
        omega0: The drive's set speed [rad/s].
        hammer: (start [s], duration [s], amplitude [N], direction from +x [rad]), or None.
        magnet: Whether the magnets act; the viscous damping of the shaft stays either way.
        rtol: Relative tolerance of each step.
        atol: Absolute tolerance per state, shape (14,).
        max_step: Longest step [s]; the gap is looked at in five points of each.
        v0: Impact speed of a contact that is already running at t_out[0]; by default d' there.
        method: Name of a solver class of scipy.integrate.

    Returns:
        States, works, onsets and lift-offs.

    Raises:
        RuntimeError: The solver gave up, or the contact switches without end.
    """
    import scipy.integrate

    solver_class = getattr(scipy.integrate, method)
    tolerances = np.concatenate([_ATOL_STATES if atol is None else np.asarray(atol, float), _ATOL_WORKS])
    t_out = np.asarray(t_out, dtype=float)
    n = len(t_out)
    result = Solution(t_out, np.full((n, 14), np.nan), np.full(n, np.nan), np.full((n, len(WORKS)), np.nan))
    corners = [] if hammer is None else [hammer[0], hammer[0] + hammer[1]]
    stops = sorted({float(s) for s in corners if t_out[0] < s < t_out[-1]} | {float(t_out[-1])})
    mode = _Mode(None, False, -1)
    written = 0

    def derivative(t: float, z: Array) -> Array:
        result.evaluations += 1
        return rhs(rig, t, z, omega0=omega0, v0=mode.v0, hammer=hammer, magnet=magnet)

    def stepper(t: float, z: Array, bound: float, first_step: float | None = None) -> Any:
        return solver_class(
            derivative, t, z, bound, rtol=rtol, atol=tolerances, max_step=max_step, first_step=first_step
        )

    def landed(t: float, z: Array, bound: float) -> Array:
        """The state at bound, by a step from (t, z) that ends there."""
        if bound <= t:
            return z
        solver = stepper(t, z, bound, bound - t)
        while solver.status == "running":
            _step(solver)
        return solver.y

    def write(before: float, t: float, z: Array) -> None:
        """Fills in the asked times below `before`, from the state z at t."""
        nonlocal written
        while written < n and t_out[written] < before:
            at = landed(t, z, float(t_out[written]))
            result.states[written], result.works[written] = at[:14], at[14:]
            result.v0[written] = np.nan if mode.v0 is None else mode.v0
            written += 1

    def enter_contact(t: float, v0: float) -> None:
        mode.v0 = v0
        result.onsets.append((t, v0))
        result.peaks.append(0.0)

    def until_event(t: float, z: Array, stop: float) -> tuple[float, Array, _Event | None]:
        """Steps from (t, z) to the first event or to the stop."""
        solver = stepper(t, z, stop)
        while solver.status == "running":
            t_old, z_old = solver.t, solver.y.copy()
            _step(solver)
            times = np.linspace(t_old, solver.t, 5)
            dense = solver.dense_output()
            if mode.v0 is not None:
                d, d_rate = gap(rig, dense(times[1:]))
                F_n = rig.K * np.maximum(d, 0.0) ** 1.5 * (1.0 + rig.c * d_rate / mode.v0)
                result.peaks[-1] = max(result.peaks[-1], float(F_n.max()))
            event = _first_event(rig, mode, dense, times)
            if event is not None:
                root = event.time
                z_root = landed(t_old, z_old, root)
                # To the root of the integrated state, not the interpolant's.
                for _ in range(3 if event.kink < 0 else 0):
                    d, d_rate = (float(v) for v in gap(rig, z_root))
                    move = -d / d_rate if d_rate else 0.0
                    if abs(move) <= 2 * math.ulp(root) or not t_old < root + move <= solver.t:
                        break
                    root += move
                    z_root = landed(t_old, z_old, root)
                write(root, t_old, z_old)
                return root, z_root, event
            mode.at_gap, mode.at_kink = False, -1
            write(solver.t, t_old, z_old)
        return float(solver.t), solver.y, None

    t, z = float(t_out[0]), np.concatenate([np.asarray(y0, dtype=float), np.zeros(len(WORKS))])
    d, d_rate = (float(v) for v in gap(rig, z))
    mode.at_gap = abs(d) <= 1e-15  # on the boundary the direction of motion decides
    if d > 1e-15 or (mode.at_gap and d_rate > 0.0):
        enter_contact(t, max(d_rate, rig.v_floor) if v0 is None else v0)
    stalled = 0
    for stop in stops:
        while t < stop:
            t_old = t
            t, z, event = until_event(t, z, stop)
            if event is None:
                continue
            mode.at_gap, mode.at_kink = event.kink < 0, event.kink
            if mode.at_gap:
                d_rate = float(gap(rig, z)[1])
                if mode.v0 is None:
                    enter_contact(t, max(d_rate, rig.v_floor))
                else:
                    mode.v0 = None
                    result.liftoffs.append((t, -d_rate))
            stalled = stalled + 1 if t - t_old <= 1e-15 else 0
            if stalled > 4:
                raise RuntimeError(f"the contact switches without end at t = {t} s")
    write(math.inf, t, z)
    return result


def _step(solver: Any) -> None:
    message = solver.step()
    if message:
        raise RuntimeError(f"the reference integrator failed: {message}")
