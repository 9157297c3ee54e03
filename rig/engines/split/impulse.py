"""The contact's impulse over a kick of `rig.engines.split`: normal law and friction.

Impulses are along the normal n (from the ring's centre to the shaft's) and across it; jn > 0 pushes the shaft back,
jt > 0 is what slows a positive sliding speed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rig.engines.split.inner_motion import inlined
from rig.kernels.contact import elastic_force


class Law(NamedTuple):
    """The contact's compliant law at one depth."""

    elastic: float  # force [N]
    slope: float  # of it [N/m]
    relative: float  # its slope over it [1/m]
    damping: float  # force per speed of the gap [N s/m]


class Mobility(NamedTuple):
    """Speed of the shaft against the ring, per impulse [1/kg]."""

    nn: float  # normal, by a normal one
    tt: float  # across, by one across
    nt: float  # the one by the other
    per_tt: float  # 1 / tt [kg]


class Push(NamedTuple):
    """Normal impulse of a compliant contact and what belongs to it."""

    jn: float  # [N s]
    held: float  # of it, what a spring gives back [N s]
    shift: float  # change of the relative position, as an impulse times a time [kg m]
    back: float  # part of the normal speed's change by friction that comes off jn, per speed [kg]
    taken: float  # part of the gap's speed that damping takes in a step [1]


class Impulse(NamedTuple):
    """What a contact does in a kick."""

    jx: float  # impulse on the shaft [N s]
    jy: float
    jt: float  # friction's part [N s]
    shift_x: float  # impulse times a time that changes positions, against the shaft [kg m]
    shift_y: float
    cx: float  # force of this kick [N]
    cy: float
    dcx: float  # its rate [N/s]
    dcy: float


@inlined
def law_at(contact, depth, factor_per_speed):
    """The compliant law at a depth [m]; the damping factor comes over the onset speed [s/m]."""
    per_depth = 1.0 / depth
    if contact.exponent == 1.5:
        root = math.sqrt(depth)
        elastic = contact.stiffness * depth * root
        slope = 1.5 * contact.stiffness * root
    else:
        elastic = elastic_force(depth, contact.stiffness, contact.exponent)
        slope = contact.exponent * elastic * per_depth
    return Law(elastic, slope, contact.exponent * per_depth, elastic * factor_per_speed + contact.viscous_damping)


@inlined
def mobility_of(plant, euler, axis, nx, ny):
    """Speed of the shaft against the ring per impulse: less where the axis tilts that way."""
    un = ut = 0.0
    if euler:
        un, ut = axis.ux * nx + axis.uy * ny, axis.uy * nx - axis.ux * ny
    nn = plant.mobility * (1.0 - un * un) + plant.per_inner
    tt = plant.mobility * (1.0 - ut * ut) + plant.per_inner + plant.spin_mobility
    q = plant.mobility * ut * ut * plant.per_w
    return Mobility(nn, tt, -plant.mobility * un * ut, plant.per_w * (1.0 + q * (1.0 + q * (1.0 + q * (1.0 + q)))))


@inlined
def flow_acceleration(constants, plant, axis, houses, motion):
    """What the flow alone would add to the rate of the gap [m/s^2]."""
    house = constants.house
    nx, ny = motion.nx, motion.ny
    flow_rate = motion.lateral * motion.lateral * motion.per_distance - plant.arm * (
        plant.spring_x * axis.ux * nx + plant.spring_y * (axis.uy - plant.rest) * ny
    )
    if constants.levels.inner_house:
        beam = house.inner_beam_stiffness * (houses.x0 - houses.x2) + house.inner_beam_damping * (houses.x1 - houses.x3)
        pair = house.pair_stiffness_vertical * (houses.y0 - houses.y2)
        flow_rate += plant.per_inner * (beam * nx + pair * ny)
    return flow_rate


@inlined
def compliant_push(law, w, rate, flow_rate, h):
    """Normal impulse of a compliant contact over a step: damping in closed form, commutator and all.

    Args:
        law: At this depth.
        w: Mobility.
        rate: Of the depth, before the impulse [m/s].
        flow_rate: What the flow alone adds to it [m/s^2].
        h: Step [s].
    """
    damping = h * law.damping
    z = damping * w.nn
    share = 1.0 / (1.0 + z * (0.5 + z * (1.0 / 12.0)))
    jn = (h * law.elastic + damping * rate) * share
    bend = jn * law.relative * h * w.nn * (1.0 / 12.0)
    held = h * law.elastic - jn * bend * (1.0 + 0.25 * z - (7.0 / 6.0) * bend)
    held += damping * damping * w.nn * h * flow_rate * (1.0 / 24.0)
    jn = (held + damping * rate) * share
    shift = h * jn * damping * w.nn * (1.0 / 24.0)
    return Push(max(0.0, jn), held, shift, 0.5 * damping * w.nt * share, z)


@inlined
def friction_impulse(w, jn, limit, sliding, slid):
    """Friction's impulse across the normal, and what it would have to be [N s].

    Args:
        w: Mobility.
        jn: Normal impulse [N s].
        limit: Largest one that friction can give [N s].
        sliding: Sliding speed before it [m/s].
        slid: Sliding speed after the last kick [m/s]; nan: there was none, in a contact that rolls so far.
    """
    target = -0.5 * (sliding - slid) if slid == slid else -sliding
    wanted = (sliding - target - w.nt * jn) * w.per_tt
    return min(max(wanted, -limit), limit), wanted
