"""heyoka's Taylor series on the rig's equations, written down anew: a peer, and half of the charts' reference.

Nothing of `rig.kernels` is used but the numbers. The shaft is the direction `u` of its axis (a unit vector) instead of
two angles: with S = sum of arm times lateral force, w the spin about the axis and L = Ixx u x u' + Izz w u,

    Ixx u'' = S - u (u . S) + Izz w (u x u') - Ixx |u'|^2 u
    Izz w'  = T_drive - R_S F_t

(the component of dL/dt across the axis, turned by u x; u' . u = 0). u_z and u_z' follow from |u| = 1. States are
divided by `STATE_SCALE`, because heyoka's tolerance is relative to the largest of them.

Phases. Each is a smooth system of its own with terminal events, so that the series never meets a corner: flight;
contact with smoothed friction or none, sliding forward, sliding backward, rolling; contact whose normal law asks for
tension (no force). Rolling is Filippov's: the friction force is what keeps v_t at 0, linear in the accelerations, and
ends where it reaches mu F_n.

The root at the rim. delta^1.5 has a branch point at delta = 0, so a contact starts a hair inside: the flight's own
series is carried on past the onset to a depth h, and a contact ends at that depth too. What is left out is the impulse
K h^2.5 / (2.5 rate) twice a contact; h is chosen for it to change a speed by `_HAIR` times the tolerance, in m/s. From
there the steps grow with the distance from the branch point, about 13 % a step. (Between h for 1 and for 1e-6 times
the tolerance, the first 0.1 s of the hammer scene move by 1.4e-11 scaled at tolerance 1e-15: the noise of rounding.)

Left out: a transducer that loses its preload. Samples that show it make the run a failure.
"""

from __future__ import annotations

import functools
import math
import time
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from replays.studies.peers.problem import Problem
from replays.studies.peers.solution import Journal, Setting, Solution
from rig.kernels.contact import BACKWARD, FLIGHT, FORWARD, NO_FRICTION, ROLLING, SMOOTHED, SWITCH, TOUCHING
from rig.kernels.magnet import LINEAR, RIPPLED
from rig.kernels.signals import STATE_SCALE

SLACK = 5
"""A phase more than the kernels count: touching, while the normal law would have to pull and the force is held at 0."""
_HAIR = 1e-2
_LEAST_HAIR = 1e-14
"""[m], well above the rounding of the gap."""
_SCALE = np.where(np.arange(14) == 2, 40.0, STATE_SCALE)
"""As `STATE_SCALE`, but for the spin angle, which grows to tens of radians and would be the largest state."""
_CHUNK = 500
"""Samples between two looks at the clock."""
_STEPS = 200_000
"""Steps between two of them."""

PARAMETERS = (
    "Ixx", "Izz", "lA", "lB", "lI", "R", "unbalance", "phi", "moment",
    "K_m", "a3", "a5", "a7", "ripple", "growth", "D_x", "D_y",
    "r0", "x0", "y0", "K", "c", "D", "mu", "v_s", "both", "v0", "hair",
    "M_ih", "M_oh", "K_bv", "D_bv", "K_bh", "D_bh", "k_ns", "k_ew",
    "gain", "speed", "slope", "H_x", "H_y", "t_hit", "T_hit",
)  # fmt: skip
"""Numbers that a compiled system is given, so that it serves every problem of its kind."""


class _Kind(NamedTuple):
    """What decides a system's form; each form is compiled once a process and tolerance."""

    phase: int
    hit: bool
    ideal_drive: bool
    smoothed: bool
    exact: bool  # friction
    exponent: float
    damped: bool
    viscous: bool
    terms: int  # of the magnet map, as the kernels name them; -1 without magnets
    number: int  # of magnets, where the map has ripples
    both: bool  # the gap counts the outer house


class _System(NamedTuple):
    """A compiled system and what its events lead to. The integrator is used again by every solve."""

    integrator: Any
    following: tuple[int, ...]


_REST = -1
"""What follows where sliding stops: rolling, or sliding on, as the friction needed there says."""


def solve(problem: Problem, *, setting: Setting, budget_s: float) -> Solution:
    """Solve a problem by Taylor series.

    Args:
        problem: The problem.
        setting: Tolerance; an absolute one has no meaning here.
        budget_s: Wall time allowed [s].
    """
    _check(problem)
    # Whatever this problem may meet is compiled before the clock starts.
    begin = time.perf_counter()
    touching = (FORWARD, BACKWARD, ROLLING) if problem.exact_friction else (TOUCHING,)
    first = _kind(problem, FLIGHT, hit=False)
    for phase in (FLIGHT, *touching, *((SLACK,) if first.damped or first.viscous else ())):
        for hit in {False, problem.pulse is not None}:
            _system(_kind(problem, phase, hit=hit), setting.tolerance)
            _contact_function(_kind(problem, ROLLING, hit=hit))
    journal = Journal(problem.times, budget_s, time.perf_counter() - begin)
    _run(problem, setting.tolerance, journal)
    house = problem.constants.house
    for stretch, stiffness in (
        (journal.states[:, 4] - journal.states[:, 6], house.pair_stiffness_vertical),
        (journal.states[:, 5], house.pair_stiffness_horizontal),
    ):
        if journal.failure is None and np.max(np.abs(stretch)) * 0.5 * stiffness > house.preload:
            journal.failure = "a transducer loses its preload, which the series leaves out"
    return journal.close()


def _check(problem: Problem) -> None:
    levels = problem.constants.levels
    if not (levels.euler and levels.inner_house and levels.outer_house and levels.compliant):
        raise NotImplementedError("the series has the full model only, with a compliant contact")
    if levels.friction == SWITCH:
        raise NotImplementedError("the series has no switch friction")


def _run(problem: Problem, tolerance: float, journal: Journal) -> None:
    """Go from phase to phase until the end, into the journal."""
    numbers = _numbers(problem)
    values = np.array([numbers[name] for name in PARAMETERS])
    hair_at, speed_at = PARAMETERS.index("hair"), PARAMETERS.index("v0")

    def look(time_s: float, state: np.ndarray) -> tuple[float, ...]:
        contact_at = _contact_function(_kind(problem, ROLLING, hit=hit))
        return tuple(float(value) for value in contact_at(state, pars=values[: contact_at.nparams], time=time_s))

    times, pulse = problem.times, problem.pulse
    corners = [*problem.corners, problem.duration_s]
    phase, t = problem.phase, 0.0
    state = _to_series(problem.y0, ideal_drive=problem.inputs.ideal_drive)
    samples = np.full((len(times), 14), np.nan)
    samples[0] = state
    hit = False
    values[speed_at] = problem.onset_speed
    values[hair_at] = _hair(problem, problem.onset_speed, tolerance)
    while corners and not journal.overrun():
        hit = pulse is not None and pulse[0] <= t < pulse[1]
        system = _system(_kind(problem, phase, hit=hit), tolerance)
        series = system.integrator
        series.time = t
        series.state[:] = state
        # heyoka makes room up to the last parameter that this system has.
        series.pars[:] = values[: len(series.pars)]
        series.reset_cooldowns()
        first = int(np.searchsorted(times, t, side="right"))
        wanted = times[first : first + _CHUNK]
        wanted = wanted[wanted < corners[0]]
        goal = corners[0] if len(wanted) < _CHUNK else float(wanted[-1])
        grid = np.concatenate(([t], wanted[wanted < goal], [goal]))
        outcome, _, _, steps, _, reached = series.propagate_grid(grid, max_steps=_STEPS)
        journal.steps += int(steps)
        journal.evaluations += int(steps) * series.order
        # The goal itself is a sample only where it is wanted.
        kept = reached[1:][: len(times) - first]
        kept = kept[: int(np.searchsorted(times[first:], grid[len(reached) - 1], side="right"))]
        samples[first : first + len(kept)] = kept
        t, state = float(series.time), series.state.copy()
        number = -int(outcome) - 1
        if not np.isfinite(state).all():
            journal.failure = f"the series broke down at {t:.9g} s"
        elif 0 <= number < len(system.following):
            journal.switches += 1
            following = system.following[number]
            depth, rate, sliding, _, _ = look(t, state)
            if phase == FLIGHT:
                speed = max(rate, problem.constants.contact.speed_floor)
                journal.onsets.append((t, speed))
                values[speed_at] = speed
                values[hair_at] = hair = _hair(problem, max(rate, 1e-9), tolerance)
                beyond = t + hair / max(rate, 1e-9)
                for i in range(*np.searchsorted(times, (t, beyond), side="right")):
                    samples[i] = series.update_d_output(times[i])
                t = beyond
                state = series.update_d_output(t).copy()
                depth, _, sliding, _, _ = look(t, state)
                following = FLIGHT if depth <= 0.0 else following
            if following == FORWARD and phase in (FLIGHT, SLACK):
                following = _REST if sliding == 0.0 else FORWARD if sliding > 0.0 else BACKWARD
            if following == _REST:
                _, _, _, normal, needed = look(t, state)
                following = FORWARD if needed > 0.0 else BACKWARD
                if abs(needed) <= numbers["mu"] * normal:
                    following = ROLLING
            phase = following
        if t >= corners[0]:
            corners.pop(0)
    journal.states = _from_series(samples, ideal_drive=problem.inputs.ideal_drive)
    if phase == SLACK:
        phase = TOUCHING
        if problem.exact_friction:
            phase = FORWARD if look(t, state)[2] > 0.0 else BACKWARD
    journal.phase, journal.onset_speed = phase, float(values[speed_at])


def _hair(problem: Problem, rate: float, tolerance: float) -> float:
    """Depth [m] up to which a contact's force is left out."""
    shaft, contact = problem.constants.shaft, problem.constants.contact
    mass = 1.0 / (shaft.arm_ring**2 / shaft.transverse_inertia + 1.0 / problem.constants.house.inner_mass)
    change = _HAIR * tolerance
    n = contact.exponent + 1.0
    depth = (n * mass * rate * change / contact.stiffness) ** (1.0 / n)
    if contact.viscous_damping > 0.0:
        # A force that is there at once leaves out the impulse D h as well.
        depth = min(depth, mass * change / contact.viscous_damping)
    return max(depth, _LEAST_HAIR)


def _kind(problem: Problem, phase: int, *, hit: bool) -> _Kind:
    constants, inputs = problem.constants, problem.inputs
    contact, magnet = constants.contact, constants.magnet
    terms = magnet.terms if inputs.magnet_engaged else -1
    return _Kind(
        phase=phase,
        hit=hit,
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


def _numbers(problem: Problem) -> dict[str, float]:
    """The numbers of a problem by the paper's symbols."""
    _, shaft, magnet, contact, house, gain = problem.constants
    inputs = problem.inputs
    begin, end = problem.pulse or (0.0, 1.0)
    return {
        "Ixx": shaft.transverse_inertia,
        "Izz": shaft.polar_inertia,
        "lA": shaft.arm_ring,
        "lB": shaft.arm_magnet,
        "lI": shaft.arm_disk,
        "R": shaft.radius,
        "unbalance": shaft.unbalance,
        "phi": shaft.unbalance_phase,
        "moment": shaft.arm_centre * shaft.mass * shaft.gravity,
        "K_m": magnet.stiffness,
        "a3": magnet.a3,
        "a5": magnet.a5,
        "a7": magnet.a7,
        "ripple": magnet.ripple,
        "growth": magnet.growth,
        "D_x": magnet.damping_x,
        "D_y": magnet.damping_y,
        "r0": contact.clearance,
        "x0": contact.offset_x,
        "y0": contact.offset_y,
        "K": contact.stiffness,
        "c": contact.damping_factor,
        "D": contact.viscous_damping,
        "mu": 0.0 if problem.constants.levels.friction == NO_FRICTION else contact.friction,
        "v_s": contact.smoothing_speed,
        "both": contact.gap_counts_outer,
        "v0": problem.onset_speed,
        "hair": 0.0,
        "M_ih": house.inner_mass,
        "M_oh": house.outer_mass,
        "K_bv": house.inner_beam_stiffness,
        "D_bv": house.inner_beam_damping,
        "K_bh": house.outer_beam_stiffness,
        "D_bh": house.outer_beam_damping,
        "k_ns": house.pair_stiffness_vertical,
        "k_ew": house.pair_stiffness_horizontal,
        "gain": gain,
        "speed": inputs.speed + inputs.speed_slope * (problem.start_tick - inputs.speed_tick) * inputs.tick_s,
        "slope": inputs.speed_slope,
        "H_x": inputs.hammer_force * inputs.hammer_x,
        "H_y": inputs.hammer_force * inputs.hammer_y,
        "t_hit": begin,
        "T_hit": end - begin,
    }


def _to_series(y: np.ndarray, *, ideal_drive: bool) -> np.ndarray:
    """The 14 states as the series has them: direction of the axis for its angles, spin about it for theta'."""
    G, b, dG, db = y[0], y[1], y[7], y[8]
    sG, cG, sb, cb = math.sin(G), math.cos(G), math.sin(b), math.cos(b)
    x = y.copy()
    x[0], x[1] = sb, -sG * cb
    x[7], x[8] = cb * db, sG * sb * db - cG * cb * dG
    if not ideal_drive:
        x[9] = y[9] + dG * sb
    return x / _SCALE


def _from_series(scaled: np.ndarray, *, ideal_drive: bool) -> np.ndarray:
    """Back again, shape (n, 14)."""
    x = scaled * _SCALE
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


def _heyoka() -> Any:
    return import_module("heyoka")


@functools.cache
def _system(kind: _Kind, tolerance: float) -> _System:
    """Compile one phase."""
    hy = _heyoka()

    variables, rates, seen = _equations(kind)
    down, up = hy.event_direction.negative, hy.event_direction.positive
    sliding = FORWARD if kind.exact else TOUCHING
    watched: list[tuple[Any, Any, int]] = []
    # The gap by its square where it is no part of the motion: heyoka's step suits the motion's series, not that of an
    # event, and the root has branch points where the shaft passes the ring's middle.
    inside = seen["square"] - (_parameter("r0") + (_parameter("hair") if kind.phase != FLIGHT else 0.0)) ** 2.0
    if kind.phase == FLIGHT:
        watched.append((inside, up, sliding))
    else:
        watched.append((inside if kind.phase == SLACK else seen["depth"] - _parameter("hair"), down, FLIGHT))
        if kind.damped or kind.viscous:
            watched.append((seen["pull"], up, sliding) if kind.phase == SLACK else (seen["pull"], down, SLACK))
    if kind.phase == FORWARD:
        watched.append((seen["sliding"], down, _REST))
    elif kind.phase == BACKWARD:
        watched.append((seen["sliding"], up, _REST))
    elif kind.phase == ROLLING:
        watched.append((_parameter("mu") * seen["normal"] - seen["friction"], down, FORWARD))
        watched.append((_parameter("mu") * seen["normal"] + seen["friction"], down, BACKWARD))
    integrator = hy.taylor_adaptive(
        sys=list(zip(variables, rates, strict=True)),
        state=np.zeros(14),
        tol=tolerance,
        t_events=[hy.t_event(function, direction=way) for function, way, _ in watched],
    )
    return _System(integrator, tuple(following for _, _, following in watched))


@functools.cache
def _contact_function(kind: _Kind) -> Any:
    """Penetration, its rate, sliding speed, normal force, and the friction that rolling needs, of a scaled state."""
    hy = _heyoka()

    variables, _, seen = _equations(kind)
    return hy.cfunc([seen[name] for name in ("depth", "rate", "sliding", "normal", "friction")], vars=list(variables))


def _parameter(name: str) -> Any:
    hy = _heyoka()

    return hy.par[PARAMETERS.index(name)]


def _equations(kind: _Kind) -> tuple[list[Any], list[Any], dict[str, Any]]:
    """Scaled states, their rates, and what the events look at, as heyoka's expressions."""
    hy = _heyoka()

    scaled = hy.make_vars(*[f"q{i}" for i in range(14)])
    ux, uy, theta, xi, yi, xo, yo, vx, vy, spin, vxi, vyi, vxo, vyo = (
        q * float(scale) for q, scale in zip(scaled, _SCALE, strict=True)
    )
    p = {name: _parameter(name) for name in PARAMETERS}
    Ixx, Izz, lA, lB, lI, R = (p[name] for name in ("Ixx", "Izz", "lA", "lB", "lI", "R"))

    # The axis, and theta' from the spin about it: w = theta' + u_x G', tan G = -u_y/u_z.
    across = 1.0 - ux * ux
    uz = hy.sqrt(across - uy * uy)
    vz = -(ux * vx + uy * vy) / uz
    turn = (uy * vz - uz * vy) / across
    w = spin + ux * turn if kind.ideal_drive else spin
    theta_rate = spin if kind.ideal_drive else spin - ux * turn

    # Sum of arm times lateral force, without the contact's.
    angle = theta + p["phi"]
    unbalance = p["unbalance"] * theta_rate * theta_rate
    Sx = lI * unbalance * hy.cos(angle)
    Sy = lI * unbalance * hy.sin(angle) - p["moment"]
    if kind.hit:
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

    # Forces on the houses, without the contact's.
    beam = p["K_bv"] * (xi - xo) + p["D_bv"] * (vxi - vxo)
    ns = p["k_ns"] * (yi - yo)
    axo = (beam - p["k_ew"] * xo) / p["M_oh"]
    ayo = (ns - p["K_bh"] * yo - p["D_bh"] * vyo) / p["M_oh"]
    torque = p["gain"] * (p["speed"] + p["slope"] * hy.time - theta_rate)

    def accelerations(Fx: Any, Fy: Any, Ft: Any) -> tuple[Any, ...]:
        """u'', w' and the inner house's accelerations under a force of the ring on the shaft."""
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
    seen = {
        "square": square,
        "depth": depth,
        "rate": rate,
        "sliding": sliding,
        "normal": normal,
        "pull": pull,
        "friction": friction,
    }
    return list(scaled), [value / float(scale) for value, scale in zip(rates, _SCALE, strict=True)], seen


def _magnet(kind: _Kind, p: dict[str, Any], x: Any, y: Any) -> tuple[Any, Any]:
    """Force of the magnets; with ripples as the gradient of the map's potential, which heyoka differentiates."""
    hy = _heyoka()

    if kind.terms == LINEAR:
        return -p["K_m"] * x, -p["K_m"] * y
    s = x * x + y * y
    stiffness = p["K_m"] * (1.0 + s * (p["a3"] + s * (p["a5"] + s * p["a7"])))
    if kind.terms != RIPPLED:
        return -stiffness * x, -stiffness * y
    # Re (-Y + i X)^N, the magnets' pattern, from straight below.
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
