"""Contact laws between shaft and ring: normal force with impact memory, and friction against the sliding speed."""

from __future__ import annotations

import math
from typing import NamedTuple

from rig.physics.kernels.stage import stage

NO_FRICTION, SMOOTHED, SWITCH, EXACT = range(4)
"""Friction laws: none; mu F_n tanh(v_t/v_s); clamped linear law with rolling within v_s; Coulomb's set-valued law.

For the set-valued law an engine has to track the phase: sliding forward, sliding backward, rolling.
"""
FLIGHT, TOUCHING, FORWARD, BACKWARD, ROLLING = range(5)
"""Phases: separated; in contact with friction that the state determines; in contact and sliding with v_t > 0; with v_t
< 0; rolling, with the friction force that keeps v_t at 0."""


class RingForce(NamedTuple):
    """Force between shaft and ring, in the ring's plane."""

    Fx: float  # on the shaft [N]
    Fy: float
    Fn: float  # normal [N]
    elastic: float  # its elastic part [N]
    Ft: float  # friction against the sliding speed [N]
    delta: float  # penetration [m]; negative is the gap
    rate: float  # rate of the penetration [m/s]
    sliding: float  # speed of the shaft's surface along the ring [m/s]
    nx: float  # direction from the ring's centre to the shaft's
    ny: float


@stage
def elastic_force(penetration, stiffness, exponent):
    """Return the elastic part of the normal force, K delta^n [N], for a penetration >= 0 [m]."""
    if exponent == 1.5:
        return stiffness * penetration * math.sqrt(penetration)
    if exponent == 1.0:
        return stiffness * penetration
    return stiffness * penetration**exponent


@stage
def floor_onset_speed(speed, contact):
    """Return the impact speed v0 that a contact keeps until it ends, for its approach speed at the onset [m/s]."""
    return max(speed, contact.speed_floor)


@stage
def damping_ratio(rate, onset_speed, contact):
    """Return the force without viscous damping over its elastic part, 1 + c delta'/v0 [1]."""
    return 1.0 + contact.damping_factor * rate / onset_speed


@stage
def penetration_at(distance, contact):
    """Return the penetration of the shaft into the ring [m] at a distance of their centres [m]; negative is the gap."""
    return distance - contact.clearance


@stage
def normal_force(penetration, rate, onset_speed, contact):
    """Return the compliant normal force, eq. 44 and its family.

    F = K delta^n (1 + c delta'/v0) + D delta', clamped at 0: a contact cannot pull.

    Caution: the damping term grows without bound for v0 -> 0 in light impacts; `floor_onset_speed` limits v0.

    Args:
        penetration: delta [m]; no force unless positive.
        rate: delta' [m/s], positive while the bodies approach.
        onset_speed: v0 [m/s], delta' at the onset of this contact, floored.
        contact: Contact constants K, n, c, D.

    Returns:
        Force [N] and its elastic part [N], both >= 0.
    """
    if penetration <= 0.0:
        return 0.0, 0.0
    elastic = elastic_force(penetration, contact.stiffness, contact.exponent)
    force = elastic * damping_ratio(rate, onset_speed, contact) + contact.viscous_damping * rate
    return max(0.0, force), elastic


@stage
def friction_force(law, phase, force, sliding_speed, contact):
    """Return the friction force against the sliding speed of eq. 39 (not sgn(theta') of eq. 12), by state or phase.

    Smoothed: mu F_n tanh(v_t / v_s). Exact, while sliding: mu F_n with the sign of the phase.

    Caution: below about v_s the smoothed law creeps at v_s atanh(required / mu), and an explicit step must be below
    about 2 m_t v_s / (mu F_n).

    Args:
        law: Friction law.
        phase: Contact phase.
        force: F_n [N].
        sliding_speed: v_t [m/s].
        contact: Contact constants mu, v_s.

    Returns:
        Force [N], positive against a positive sliding speed; 0 for the rolling phase and for the switch law, whose
        force depends on the accelerations (`rig.physics.kernels.dynamics`).
    """
    if phase == FORWARD:
        return contact.friction * force
    if phase == BACKWARD:
        return -contact.friction * force
    if law == SMOOTHED and phase == TOUCHING:
        return contact.friction * force * math.tanh(sliding_speed / contact.smoothing_speed)
    return 0.0


@stage
def ring_force(ex, ey, vx, vy, surface_speed, onset_speed, law, phase, contact):
    """Return the force of the ring on the shaft, eqs. 12 and 44 in the plane of the ring.

    Frame: n = e/|e| points from the ring's centre to the shaft's, t = (-n_y, n_x). F = -F_n n - F_t t acts on the
    shaft, the opposite on the inner housing, and -radius F_t on the shaft's spin.

    Args:
        ex: Shaft centre minus ring centre, x [m].
        ey: Shaft centre minus ring centre, y [m].
        vx: Rate of `ex` [m/s].
        vy: Rate of `ey` [m/s].
        surface_speed: Speed of the shaft's surface from spin, R_S w [m/s].
        onset_speed: v0 [m/s].
        law: Friction law.
        phase: Contact phase; no force in flight.
        contact: Contact constants.
    """
    distance = math.sqrt(ex * ex + ey * ey)
    penetration = penetration_at(distance, contact)
    if distance == 0.0:
        return RingForce(0.0, 0.0, 0.0, 0.0, 0.0, penetration, 0.0, 0.0, 1.0, 0.0)
    per_distance = 1.0 / distance
    nx = ex * per_distance
    ny = ey * per_distance
    rate = vx * nx + vy * ny
    sliding = vy * nx - vx * ny + surface_speed
    if phase == FLIGHT:
        return RingForce(0.0, 0.0, 0.0, 0.0, 0.0, penetration, rate, sliding, nx, ny)
    force, elastic = normal_force(penetration, rate, onset_speed, contact)
    tangential = 0.0
    if force > 0.0:
        tangential = friction_force(law, phase, force, sliding, contact)
    return RingForce(
        -force * nx + tangential * ny,
        -force * ny - tangential * nx,
        force,
        elastic,
        tangential,
        penetration,
        rate,
        sliding,
        nx,
        ny,
    )
