"""Independent formulation of the rig's equations for heyoka's Taylor series: phases, numbers, states and rates.

Of `rig.physics.kernels` only the numbers are used. The shaft is the direction `u` of its axis (a unit vector) instead
of two angles. With S = sum of arm times lateral force, w the spin about the axis and L = Ixx u x u' + Izz w u,

    Ixx u'' = S - u (u . S) + Izz w (u x u') - Ixx |u'|^2 u
    Izz w'  = T_drive - R_S F_t

(the component of dL/dt across the axis, rotated by u x; u' . u = 0). u_z and u_z' follow from |u| = 1. States are
divided by `STATE_SCALE`, because heyoka's tolerance is relative to the largest of them.
"""

from __future__ import annotations

import math
from importlib import import_module
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from replays.studies.peers.common.problem import Problem
from rig.physics.kernels.laws.contact import BACKWARD, FLIGHT, FORWARD, NO_FRICTION, ROLLING, SMOOTHED, TOUCHING
from rig.physics.kernels.laws.magnet import LINEAR, RIPPLED
from rig.physics.kernels.signals import STATE_SCALE

SLACK = 5
"""Phase in addition to those of the kernels: in contact, while the normal law would pull and the force is held at 0."""
SERIES_SCALE = np.where(np.arange(14) == 2, 40.0, STATE_SCALE)
"""`STATE_SCALE` except for the spin angle, which grows to tens of radians and would be the largest state."""

_PLACES = {
    "Ixx": "shaft.transverse_inertia", "Izz": "shaft.polar_inertia", "lA": "shaft.arm_ring", "lB": "shaft.arm_magnet",
    "lI": "shaft.arm_disk", "R": "shaft.radius", "unbalance": "shaft.unbalance", "phi": "shaft.unbalance_phase",
    "moment": "", "K_m": "magnet.stiffness", "a3": "magnet.a3", "a5": "magnet.a5", "a7": "magnet.a7",
    "ripple": "magnet.ripple", "growth": "magnet.growth", "D_x": "magnet.damping_x", "D_y": "magnet.damping_y",
    "r0": "contact.clearance", "x0": "contact.offset_x", "y0": "contact.offset_y", "K": "contact.stiffness",
    "c": "contact.damping_factor", "D": "contact.viscous_damping", "mu": "", "v_s": "contact.smoothing_speed",
    "both": "contact.gap_counts_outer", "v0": "", "margin": "", "M_ih": "house.inner_mass", "M_oh": "house.outer_mass",
    "K_bv": "house.inner_beam_stiffness", "D_bv": "house.inner_beam_damping", "K_bh": "house.outer_beam_stiffness",
    "D_bh": "house.outer_beam_damping", "k_ns": "house.pair_stiffness_vertical",
    "k_ew": "house.pair_stiffness_horizontal", "gain": "torque_gain",
    "speed": "", "slope": "", "H_x": "", "H_y": "", "t_hit": "", "T_hit": "",
}  # fmt: skip
"""Attribute of the model by the paper's symbol; empty for numbers that `parameter_values` computes."""
PARAMETERS = tuple(_PLACES)
"""Parameters of a compiled system, which thus serves every problem of its kind."""


class Kind(NamedTuple):
    """Form of a system; each form is compiled once per process and tolerance."""

    phase: int
    pulse_on: bool
    ideal_drive: bool
    smoothed: bool
    exact: bool  # friction
    exponent: float
    damped: bool
    viscous: bool
    terms: int  # terms of the magnet map, as in the kernels; -1 without magnets
    number: int  # number of magnets, if the map has ripples
    both: bool  # the gap includes the outer housing


def system_kind(problem: Problem, phase: int, *, pulse_on: bool) -> Kind:
    """Return the form of a problem's system in one phase, with or without the hammer force."""
    constants, inputs = problem.constants, problem.inputs
    contact, magnet = constants.contact, constants.magnet
    terms = magnet.terms if inputs.magnet_engaged else -1
    return Kind(
        phase=phase,
        pulse_on=pulse_on,
        ideal_drive=inputs.ideal_drive,
        smoothed=constants.levels.friction == SMOOTHED,
        exact=problem.exact_friction,
        exponent=contact.exponent,
        damped=contact.damping_factor != 0.0,
        viscous=contact.viscous_damping != 0.0,
        terms=terms,
        number=magnet.number if terms == RIPPLED else 0,
        both=contact.gap_counts_outer != 0.0,
    )


def parameter_values(problem: Problem) -> dict[str, float]:
    """Return the parameters of a problem by the paper's symbols."""
    constants, inputs = problem.constants, problem.inputs
    shaft = constants.shaft
    begin, end = problem.pulse or (0.0, 1.0)
    worked_out = {
        "moment": shaft.arm_centre * shaft.mass * shaft.gravity,
        "mu": 0.0 if constants.levels.friction == NO_FRICTION else constants.contact.friction,
        "v0": problem.onset_speed,
        "margin": 0.0,
        "speed": inputs.speed,
        "slope": inputs.speed_slope,
        "H_x": inputs.hammer_force * inputs.hammer_x,
        "H_y": inputs.hammer_force * inputs.hammer_y,
        "t_hit": begin,
        "T_hit": end - begin,
    }
    return {name: attrgetter(place)(constants) if place else worked_out[name] for name, place in _PLACES.items()}


def to_series(y: np.ndarray, *, ideal_drive: bool) -> np.ndarray:
    """Return the 14 states of the series: direction of the axis for its angles, spin about it for theta'."""
    G, b, dG, db = y[0], y[1], y[7], y[8]
    sG, cG, sb, cb = math.sin(G), math.cos(G), math.sin(b), math.cos(b)
    x = y.copy()
    x[0], x[1] = sb, -sG * cb
    x[7], x[8] = cb * db, sG * sb * db - cG * cb * dG
    if not ideal_drive:
        x[9] = y[9] + dG * sb
    return x / SERIES_SCALE


def from_series(scaled: np.ndarray, *, ideal_drive: bool) -> np.ndarray:
    """Return the rig's states for those of the series, shape (n, 14)."""
    x = scaled * SERIES_SCALE
    ux, uy, vx, vy = x[:, 0], x[:, 1], x[:, 7], x[:, 8]
    uz = np.sqrt(1.0 - ux * ux - uy * uy)
    vz = -(ux * vx + uy * vy) / uz
    across = uy * uy + uz * uz
    y = x.copy()
    y[:, 0], y[:, 1] = np.arctan2(-uy, uz), np.arcsin(ux)
    y[:, 7] = (uy * vz - uz * vy) / across
    y[:, 8] = vx / np.sqrt(across)
    if not ideal_drive:
        y[:, 9] = x[:, 9] - y[:, 7] * ux
    return y


def heyoka() -> Any:
    """Import heyoka, which may not be installed."""
    return import_module("heyoka")


def parameter(name: str) -> Any:
    """Return a parameter of the problem as heyoka's expression."""
    return heyoka().par[PARAMETERS.index(name)]


def equations(kind: Kind) -> tuple[list[Any], list[Any], dict[str, Any]]:
    """Return scaled states, their rates, and the quantities for the events, as heyoka's expressions."""
    hy = heyoka()
    scaled = hy.make_vars(*[f"q{i}" for i in range(14)])
    rates, looked_at = system_rates(kind, scaled, {name: parameter(name) for name in PARAMETERS}, hy)
    return list(scaled), rates, looked_at


def system_rates(kind: Kind, scaled: Any, p: dict[str, Any], hy: Any) -> tuple[list[Any], dict[str, Any]]:
    """Return the rates of the scaled states, and the quantities for the events.

    Args:
        kind: Form of the system.
        scaled: The 14 scaled states.
        p: Parameters of the problem, by name.
        hy: Library of functions and time: heyoka, or another with the same names.
    """
    ux, uy, theta, xi, yi, xo, yo, vx, vy, spin, vxi, vyi, vxo, vyo = (
        q * float(scale) for q, scale in zip(scaled, SERIES_SCALE, strict=True)
    )
    Ixx, Izz, lA, lB, lI, R = (p[name] for name in ("Ixx", "Izz", "lA", "lB", "lI", "R"))

    # The axis, and theta' from the spin about it: w = theta' + u_x G', tan G = -u_y/u_z.
    across = 1.0 - ux * ux
    uz = hy.sqrt(across - uy * uy)
    vz = -(ux * vx + uy * vy) / uz
    turn = (uy * vz - uz * vy) / across
    w = spin + ux * turn if kind.ideal_drive else spin
    theta_rate = spin if kind.ideal_drive else spin - ux * turn

    # Sum of arm times lateral force, without the contact force.
    angle = theta + p["phi"]
    unbalance = p["unbalance"] * theta_rate * theta_rate
    Sx = lI * unbalance * hy.cos(angle)
    Sy = lI * unbalance * hy.sin(angle) - p["moment"]
    if kind.pulse_on:
        pulse = lI * hy.sin(math.pi * (hy.time - p["t_hit"]) / p["T_hit"])
        Sx, Sy = Sx + p["H_x"] * pulse, Sy + p["H_y"] * pulse
    if kind.terms >= LINEAR:
        Fx, Fy = _magnet(kind, p, lB * ux, lB * uy)
        Sx, Sy = Sx + lB * (Fx - p["D_x"] * lB * vx), Sy + lB * (Fy - p["D_y"] * lB * vy)

    # The ring.
    ex, ey = lA * ux - xi - p["x0"], lA * uy - yi - p["y0"]
    gx, gy = lA * vx - vxi, lA * vy - vyi
    if kind.both:
        ex, ey, gx, gy = ex - p["both"] * xo, ey - p["both"] * yo, gx - p["both"] * vxo, gy - p["both"] * vyo
    square = ex * ex + ey * ey
    r = hy.sqrt(square)
    nx, ny = ex / r, ey / r
    depth = r - p["r0"]
    rate = gx * nx + gy * ny
    along = gy * nx - gx * ny
    sliding = along + R * w
    elastic = p["K"] * (depth * hy.sqrt(depth) if kind.exponent == 1.5 else depth**kind.exponent)
    pull = 1.0 + p["c"] * rate / p["v0"] if kind.damped else hy.expression(1.0)
    normal = elastic * pull if kind.damped else elastic
    if kind.viscous:
        normal = pull = normal + p["D"] * rate

    # Forces on the housings, without the contact force.
    beam = p["K_bv"] * (xi - xo) + p["D_bv"] * (vxi - vxo)
    ns = p["k_ns"] * (yi - yo)
    axo = (beam - p["k_ew"] * xo) / p["M_oh"]
    ayo = (ns - p["K_bh"] * yo - p["D_bh"] * vyo) / p["M_oh"]
    torque = p["gain"] * (p["speed"] + p["slope"] * hy.time - theta_rate)

    def accelerations(Fx: Any, Fy: Any, Ft: Any) -> tuple[Any, ...]:
        """Return u'', w' and the inner housing's accelerations for a force of the ring on the shaft."""
        sx, sy = Sx + lA * Fx, Sy + lA * Fy
        inward = (ux * sx + uy * sy) / Ixx + vx * vx + vy * vy + vz * vz
        gyro = Izz * w / Ixx
        ax = sx / Ixx - ux * inward + gyro * (uy * vz - uz * vy)
        ay = sy / Ixx - uy * inward + gyro * (uz * vx - ux * vz)
        az = -uz * inward + gyro * (ux * vy - uy * vx)
        if kind.ideal_drive:
            turning = (uy * az - uz * ay) / across + 2.0 * turn * ux * vx / across
            dw = p["slope"] + vx * turn + ux * turning
        else:
            dw = (torque - R * Ft) / Izz
        return ax, ay, dw, (-Fx - beam) / p["M_ih"], (-Fy - ns) / p["M_ih"]

    nothing = hy.expression(0.0)
    friction = nothing
    if kind.phase == TOUCHING:
        friction = p["mu"] * normal * hy.tanh(sliding / p["v_s"]) if kind.smoothed else nothing
    elif kind.phase == FORWARD:
        friction = p["mu"] * normal
    elif kind.phase == BACKWARD:
        friction = -p["mu"] * normal
    elif kind.phase == ROLLING:
        # The sliding speed's rate with the normal force alone, and per newton of friction.
        ax, ay, dw, axi, ayi = accelerations(-normal * nx, -normal * ny, nothing)
        bx, by = lA * ax - axi, lA * ay - ayi
        if kind.both:
            bx, by = bx - p["both"] * axo, by - p["both"] * ayo
        drift = by * nx - bx * ny - along * rate / r + R * dw
        share = uy * nx - ux * ny
        response = -lA * lA / Ixx * (1.0 - share * share) - 1.0 / p["M_ih"]
        if kind.ideal_drive:
            # u'' per newton is lA/Ixx (f - u (u . f)) with f = (n_y, -n_x, 0), and u . f = -share.
            per_y, per_z = lA / Ixx * (uy * share - nx), lA / Ixx * uz * share
            response = response + R * ux * (uy * per_z - uz * per_y) / across
        else:
            response = response - R * R / Izz
        friction = -drift / response
    bears = kind.phase not in (FLIGHT, SLACK)
    Fx = -normal * nx + friction * ny if bears else nothing
    Fy = -normal * ny - friction * nx if bears else nothing
    ax, ay, dw, axi, ayi = accelerations(Fx, Fy, friction if bears else nothing)
    rates = [vx, vy, theta_rate, vxi, vyi, vxo, vyo, ax, ay, dw, axi, ayi, axo, ayo]
    if kind.ideal_drive:
        rates[9] = p["slope"] + nothing
    looked_at = {
        "square": square,
        "depth": depth,
        "rate": rate,
        "sliding": sliding,
        "normal": normal,
        "pull": pull,
        "friction": friction,
    }
    return [value / float(scale) for value, scale in zip(rates, SERIES_SCALE, strict=True)], looked_at


def _magnet(kind: Kind, p: dict[str, Any], x: Any, y: Any) -> tuple[Any, Any]:
    """Return the force of the magnets; with ripples it is the gradient of the map's potential, by heyoka."""
    hy = heyoka()
    if kind.terms == LINEAR:
        return -p["K_m"] * x, -p["K_m"] * y
    s = x * x + y * y
    stiffness = p["K_m"] * (1.0 + s * (p["a3"] + s * (p["a5"] + s * p["a7"])))
    if kind.terms != RIPPLED:
        return -stiffness * x, -stiffness * y
    # Re (-Y + i X)^N, the ripple of the magnets, from straight below.
    X, Y = hy.make_vars("X", "Y")
    re, im = hy.expression(1.0), hy.expression(0.0)
    for _ in range(kind.number):
        re, im = -re * Y - im * X, re * X - im * Y
    extra = p["K_m"] * p["ripple"] * (1.0 + p["growth"] * (X * X + Y * Y)) * re
    place = {"X": x, "Y": y}
    return (
        -stiffness * x - hy.subs(hy.diff(extra, X), place),
        -stiffness * y - hy.subs(hy.diff(extra, Y), place),
    )
