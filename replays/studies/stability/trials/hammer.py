"""Trials of the full rig under a hammer pulse (T3, T7, T9, T11): rolling, friction, boundary of whirl."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from itertools import pairwise

import numpy as np

from replays.studies.common.closed_forms import RUNGE_KUTTA_4_REAL_LIMIT
from replays.studies.common.engines import is_adaptive, supported_friction, traits
from replays.studies.peers.common.problem import scaled_error
from replays.studies.stability.trials.boundary import QUICK_POINTS, whirl_class
from replays.studies.stability.trials.cell import Cell
from replays.studies.stability.trials.motion import MotionResult, hammer_run, move
from rig.physics.engines import ENGINES
from rig.physics.kernels.signals import COLUMN

WINDOW_TICKS = 60_000
"""Length of the first impacts after a pulse at time zero; contacts slide, reverse and roll."""
LEAST_SMOOTHING = 0.9e-6
"""Value of v_s below which error control takes minutes without need [m/s]."""


@cache
def _whirl(engine: str, friction: str) -> MotionResult:
    constants, inputs, y0 = hammer_run(friction)
    return move(engine, constants, inputs, y0, ticks=1_000_000, every=1000)


def _slip(motion: MotionResult) -> float:
    """Return the RMS sliding speed in contact over the last 0.1 s [m/s]; NaN without contact."""
    part = motion.rows[motion.times > motion.times[-1] - 0.1]
    part = part[part[:, COLUMN["penetration"]] > 0.0]
    return float(np.sqrt(np.mean(part[:, COLUMN["sliding_speed"]] ** 2))) if len(part) else math.nan


def rolling_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T3: exact rolling has no slip; a smoothed law creeps."""
    if supported_friction(engine) == "exact":
        yield Cell("exact Coulomb", _slip(_whirl(engine, "exact")), 2e-5, "rolling is a constraint: no slip",
                   unit="m/s")  # fmt: skip
    if "smoothed" in ENGINES[engine].frictions:
        slip = _slip(_whirl(engine, "smoothed"))
        yield Cell("tanh, v_s = 5 mm/s", slip, 2e-5, "a smoothed law creeps by v_s atanh(needed / mu)", False, "m/s")
        # Friction needed for rolling, from an engine that rolls exactly; it determines the creep of the smoothed law.
        exact = _whirl("rk8", "exact")
        part = exact.rows[exact.times > exact.times[-1] - 0.1]
        contact = hammer_run("smoothed")[0].contact
        needed = part[:, COLUMN["friction_force"]] / (contact.friction * part[:, COLUMN["normal_force"]])
        creep = contact.smoothing_speed * float(np.sqrt(np.mean(np.arctanh(needed) ** 2)))
        yield Cell("creep against theory", abs(slip / creep - 1.0), 0.1,
                   f"v_s atanh(needed / mu) = {creep:.2e} m/s")  # fmt: skip


def first_impacts(engine: str, law: str, *, step: int = 0, tolerance: float = 0.0, **contact: float) -> MotionResult:
    """Return the first impacts of the full rig under a friction law; `contact` as in `hammer_run`."""
    constants, inputs, y0 = hammer_run(law, **contact)
    inputs = inputs._replace(hammer_start=0, hammer_end=5000)
    return move(engine, constants, inputs, y0, ticks=WINDOW_TICKS, step=step, every=1000, tolerance=tolerance)


@cache
def sharp_impacts(friction: str) -> MotionResult:
    """Return the first impacts at the highest accuracy; "exact" is Coulomb's set-valued law."""
    return first_impacts("rk8", friction, step=25, tolerance=1e-12)


def smoothing_distance(engine: str, smoothing_speed: float) -> float:
    """Return the distance of the smoothed law from the set-valued limit."""
    motion = first_impacts(engine, "smoothed", smoothing_speed=smoothing_speed)
    return scaled_error(motion.states, sharp_impacts("exact").states)


def least_smoothing_speed(engine: str) -> float:
    """Return v_s below which a step of Runge-Kutta's is too long for mu F_n / (v_s m_t) [m/s]."""
    constants = hammer_run("smoothed")[0]
    s, h = constants.shaft, constants.house
    mobility = s.arm_ring**2 / s.transverse_inertia + 1.0 / h.inner_mass + s.radius**2 / s.polar_inertia
    largest = constants.contact.friction * sharp_impacts("exact").peak_force
    return ENGINES[engine].step_us * 1e-6 * largest * mobility / RUNGE_KUTTA_4_REAL_LIMIT


def smoothing_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T7: the exact law, and smoothed ones that approach it."""
    allowance = traits(engine).allowance
    if supported_friction(engine) == "exact":
        distance = scaled_error(first_impacts(engine, "exact").states, sharp_impacts("exact").states)
        yield Cell("exact law", distance, 5e-4 * allowance, "the set-valued limit itself")
    if "smoothed" not in ENGINES[engine].frictions:
        return
    # Far above the limit of any step, the distance is due to the law and linear in v_s.
    slope = smoothing_distance("rk8", 1e-3) / 1e-3
    least = least_smoothing_speed(engine) if traits(engine).on_real_axis else 0.0
    for v_s in (1e-2, 1e-3, 1e-4, 1e-5) if quick else (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9):
        if is_adaptive(engine) and v_s < LEAST_SMOOTHING:
            continue
        distance = smoothing_distance(engine, v_s)
        expected, because = None, ""
        if v_s >= 1e-3:
            expected, because = True, "the law's own error, linear in v_s"
        elif is_adaptive(engine) and v_s >= 1e-5:
            expected, because = True, "error control shortens the steps"
        elif v_s < 0.3 * least:
            expected, because = False, f"its step is beyond 2.785 on the real axis below v_s = {least:.1e} m/s"
        # Twice the linear law plus the error of the engine itself.
        limit = 2.0 * slope * v_s + 1e-4 * (allowance if v_s >= 1e-3 else 1.0)
        yield Cell(f"v_s = {v_s:.0e} m/s", distance, limit, because, expected)


def boundary_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T9: points on both sides of the boundary of whirl."""
    if supported_friction(engine) != "exact":
        return
    wrong = sum(whirl_class(engine, mu, force) != right for mu, force, right in QUICK_POINTS)
    yield Cell(f"{len(QUICK_POINTS)} points beside the boundary", float(wrong), 0.0,
               "the class that tsit5 finds at a tolerance of 1e-9", unit="wrong")  # fmt: skip


REFERENCE_ERROR = 1e-10
"""Scaled error below which the reference's own error, 7e-11, dominates."""


def ladder(engine: str) -> list[float]:
    """Return the errors of the first impacts at increasingly fine steps or tolerances."""
    friction = supported_friction(engine)
    if is_adaptive(engine):
        tolerances = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
        motions = [first_impacts(engine, friction, tolerance=tolerance) for tolerance in tolerances]
    else:
        motions = [first_impacts(engine, friction, step=step) for step in (100, 50, 25, 10, 5, 2)]
    return [scaled_error(motion.states, sharp_impacts(friction).states) for motion in motions]


def ladder_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T11: a finer setting reduces the error."""
    # A larger error means another motion, for which a finer step need not be better.
    errors = [max(error, REFERENCE_ERROR) for error in ladder(engine) if error < 0.2]
    worst = max(fine / coarse for coarse, fine in pairwise(errors))
    yield Cell("worst rung over the one before", worst, 1.5, "asking for more gives more")
    # An engine whose grid is fine enough by itself cannot improve.
    gain = errors[-1] / max(errors[0], 1e-6)
    yield Cell("last rung over the first", gain, 0.1, "the ladder leads somewhere")
