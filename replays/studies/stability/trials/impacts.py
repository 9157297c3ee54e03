"""Trials of impacts on the ring (T2, T4, T8, T10, T14), mostly with the shaft as a mass on one line."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from replays.studies.common.closed_forms import RUNGE_KUTTA_4_REAL_LIMIT, impact, pushed_contact
from replays.studies.common.engines import is_adaptive, supported_friction, traits
from replays.studies.stability.trials.cell import Cell
from replays.studies.stability.trials.motion import (
    MotionResult,
    bare_shaft,
    base_model,
    move,
    pivoted_mass,
    quiet_inputs,
    state,
)
from rig.physics.engines import ENGINES
from rig.physics.engines.common.memory import CEILING, FLOORED
from rig.physics.levels import ModelLevels

ONSET_SPEEDS = (1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0)
"""Approach speeds [m/s]."""
PUSH_N = 1000.0
"""Peak force at the disk in `push_error` [N]."""


def bounce(engine: str, step: int = 0) -> tuple[float, MotionResult]:
    """Return the largest energy drift in flight over 25 elastic, frictionless impacts, and the motion."""
    constants = bare_shaft(damping_factor=0.0)
    shaft, magnet = constants.shaft, constants.magnet
    y0 = state(beta_rate=0.5 / shaft.arm_ring)
    with np.errstate(all="ignore"):
        motion = move(engine, constants, quiet_inputs(magnets=True), y0, ticks=100_000, step=step, every=200)
        stiffness = magnet.stiffness * shaft.arm_magnet**2
        energy = 0.5 * (
            shaft.transverse_inertia * motion.column("beta_rate") ** 2 + stiffness * motion.column("beta") ** 2
        )
        free = motion.column("penetration") < 0.0
        return float(np.max(np.abs(energy[free] / energy[0] - 1.0))), motion


def bounce_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T2: elastic, frictionless impacts."""
    drift, motion = bounce(engine)
    yield Cell("own step", drift, 1e-4 * traits(engine).allowance, "nothing takes energy out")
    missing = float(max(0, 24 - motion.contacts))
    yield Cell("own step: impacts missing", missing, 0.0, "the shaft cannot leave the ring")
    expected, because = traits(engine).coarse_bounce
    yield Cell("step of 200 us", bounce(engine, 200)[0], 1e-3, because, expected)


def first_impact(engine: str, speed: float, *, tolerance: float = 0.0) -> dict[str, float]:
    """Return relative errors of one impact on the rigid ring against quadrature."""
    constants = bare_shaft()
    shaft, contact = constants.shaft, constants.contact
    right = impact(
        mass=pivoted_mass(constants), speed=speed, stiffness=contact.stiffness, exponent=contact.exponent,
        factor=contact.damping_factor, speed_floor=contact.speed_floor,
    )  # fmt: skip
    # The contact begins off every engine's grid.
    onset = 1.01371e-3
    y0 = state(beta=(contact.clearance - speed * onset) / shaft.arm_ring, beta_rate=speed / shaft.arm_ring)
    ticks = 1000 * math.ceil(2.0 + 2e3 * right.duration)
    motion = move(engine, constants, quiet_inputs(), y0, ticks=ticks, tolerance=tolerance)
    back = -motion.final_value("beta_rate") * shaft.arm_ring
    place = motion.final_value("beta") * shaft.arm_ring
    lift_off = ticks * 1e-6 - (contact.clearance - place) / back
    return {
        "restitution": abs(back / speed / right.restitution - 1.0),
        "impulse": abs(motion.final_value("contact_impulse") / right.impulse - 1.0),
        "peak": abs(motion.peak_force / right.peak - 1.0),
        "duration": abs((lift_off - onset) / right.duration - 1.0),
        "floored": float(motion.memory[FLOORED]),
    }


def first_impact_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T4: one impact at 0.3 m/s."""
    errors = first_impact(engine, 0.3)
    limit = 1e-3 * traits(engine).allowance
    for name in ("impulse", "peak", "duration"):
        yield Cell(name, errors[name], limit, "a quadrature in one dimension knows it")


def grazing_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T8: impacts from grazing to hard."""
    errors = [first_impact(engine, speed) for speed in ONSET_SPEEDS]
    worst = max(error["restitution"] for error in errors)
    yield Cell("restitution, 1e-5 to 1 m/s", worst, 2e-3 * traits(engine).allowance,
               "the law with v0 at its lower limit is a law like any other")  # fmt: skip
    limit = bare_shaft().contact.speed_floor
    wrong = sum(
        (speed < 0.999 * limit) != bool(error["floored"])
        for speed, error in zip(ONSET_SPEEDS, errors, strict=True)
        if abs(speed / limit - 1.0) > 1e-3
    )
    yield Cell("floor not reported", float(wrong), 0.0, "a floored v0 is counted, no other")


def drop_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T10: a drop of the full rig from the top of the ring."""
    model = base_model(ModelLevels.model_validate({"friction": supported_friction(engine)}))
    constants = model.constants
    constants = constants._replace(contact=constants.contact._replace(damping_factor=1.4328))  # e = 0.5
    y0 = model.state(ring_x=0.0, ring_y=constants.contact.clearance * (1.0 - 1e-12))
    motion = move(engine, constants, quiet_inputs(), y0, ticks=500_000, every=1000)
    energy = float(motion.column("kinetic_energy")[-1]) if np.isfinite(motion.end).all() else math.nan
    fallen = 0.5 * constants.shaft.mass * constants.shaft.gravity * constants.contact.clearance
    yield Cell("energy left", energy / fallen, 1e-6, "it comes to rest (e = 0.5)")
    yield Cell("contacts", float(motion.contacts), 40.0,
               "a compliant law with a lower limit of v0 ends in lasting contact: no Zeno")  # fmt: skip
    yield Cell("steps given up", float(motion.memory[CEILING]), 0.0, "no stall")


def push_error(engine: str, *, speed_floor: float) -> float:
    """Return the relative error of the depth of a shaft that is pushed from rest into the ring for 20 ms.

    v0 is latched at its lower limit, when nothing moves, and stays constant while the force grows to about 1.6 kN, so
    it is outdated to the greatest extent.
    """
    constants = bare_shaft(speed_floor=speed_floor)
    shaft, contact = constants.shaft, constants.contact
    length = 20_000
    y0 = state(beta=contact.clearance / shaft.arm_ring)
    ticks = round(0.9 * length)  # until the end of the push
    inputs = quiet_inputs(pulse=(PUSH_N, 0, length))
    with np.errstate(all="ignore"):
        motion = move(engine, constants, inputs, y0, ticks=ticks, every=1000)
    load = PUSH_N * shaft.arm_disk / shaft.arm_ring

    def pulse(t: float) -> float:
        return load * math.sin(math.pi * t / (length * 1e-6))

    right = pushed_contact(
        mass=pivoted_mass(constants), load=pulse, stiffness=contact.stiffness, exponent=contact.exponent,
        factor=contact.damping_factor, onset_speed=speed_floor, times=motion.times,
    )[:, 0]  # fmt: skip
    return float(np.max(np.abs(motion.column("penetration") - right)) / np.max(right))


def stale_stiffness(engine: str, speed_floor: float) -> float:
    """Return h lambda of the damping with outdated v0 at an engine's own step: c F/(v0 m) h at peak force."""
    constants = bare_shaft(speed_floor=speed_floor)
    load = PUSH_N * constants.shaft.arm_disk / constants.shaft.arm_ring
    rate = constants.contact.damping_factor * load / speed_floor / pivoted_mass(constants)
    return ENGINES[engine].step_us * 1e-6 * rate


def stale_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T14: lasting contact with an outdated v0."""
    own = traits(engine)
    yield Cell("v0 = 1e-2 m/s", push_error(engine, speed_floor=1e-2), 2e-2,
               f"h lambda = {stale_stiffness(engine, 1e-2):.2g} and less: not stiff")  # fmt: skip
    for limit in (1e-3, 1e-4, 1e-5):
        z = stale_stiffness(engine, limit)
        expected, because = None, ""
        if is_adaptive(engine):
            expected, because = True, "error control shortens the steps"
        elif own.damping_limit is not None:
            expected = z < own.damping_limit
            because = f"measured, h lambda = {z:.2g}: {own.damping_because}"
            if own.on_real_axis:
                because = f"h lambda = {z:.2g} against {RUNGE_KUTTA_4_REAL_LIMIT:.4g}"
        yield Cell(f"v0 = {limit:.0e} m/s", push_error(engine, speed_floor=limit), 2e-2, because, expected)
