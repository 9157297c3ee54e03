"""Contact laws between shaft and ring: normal force with impact memory, and friction against the sliding speed."""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True)
def normal_force(penetration, rate, onset_speed, stiffness, damping_factor):
    """Compliant normal force with hysteresis damping, eq. 44.

    F = K delta^1.5 (1 + c delta'/v0), clamped at 0: a contact cannot pull.

    Trap: v0 -> 0 at grazing onsets blows the damping term up; the caller floors v0.

    Args:
        penetration: delta [m]; no force unless positive.
        rate: delta' [m/s], positive while the bodies approach.
        onset_speed: v0 [m/s], delta' at the onset of this contact, floored.
        stiffness: K [N/m^1.5].
        damping_factor: c [1].

    Returns:
        Force [N] and its elastic part [N], both >= 0.
    """
    if penetration <= 0.0:
        return 0.0, 0.0
    elastic = stiffness * penetration * math.sqrt(penetration)
    return max(0.0, elastic * (1.0 + damping_factor * rate / onset_speed)), elastic


@njit(cache=True)
def friction_force(force, sliding_speed, friction, smoothing_speed):
    """Coulomb friction, regularised: mu F_n tanh(v_t / v_s).

    It acts against the sliding speed of eq. 39 (not sgn(theta') of eq. 12).

    Trap: below sliding at about v_s the contact creeps by v_s atanh(needed / mu), and an explicit step must stay below
    about 2 m_t v_s / (mu F_n).

    Args:
        force: F_n [N].
        sliding_speed: v_t [m/s].
        friction: mu [1].
        smoothing_speed: v_s [m/s].

    Returns:
        Force [N], positive against a positive sliding speed.
    """
    return friction * force * math.tanh(sliding_speed / smoothing_speed)


@njit(cache=True)
def ring_force(
    ex, ey, vx, vy, surface_speed, clearance, onset_speed, stiffness, damping_factor, friction, smoothing_speed
):
    """Force of the ring on the shaft, eqs. 12 and 44 in the plane of the ring.

    Frame: n = e/|e| points from the ring's centre to the shaft's, t = (-n_y, n_x). F = -F_n n - F_t t acts on the
    shaft, the opposite on the inner house; the shaft's spin feels -radius F_t.

    Args:
        ex: Shaft centre minus ring centre, x [m].
        ey: The same, y [m].
        vx: Its rate, x [m/s].
        vy: Its rate, y [m/s].
        surface_speed: Speed of the shaft's surface from spin, R_S w [m/s].
        clearance: r0 [m].
        onset_speed: v0 [m/s].
        stiffness: K [N/m^1.5].
        damping_factor: c [1].
        friction: mu [1].
        smoothing_speed: v_s [m/s].

    Returns:
        Force on the shaft x, y [N]; normal force, its elastic part, friction force [N]; penetration [m]; its rate,
        sliding speed [m/s].
    """
    distance = math.sqrt(ex * ex + ey * ey)
    penetration = distance - clearance
    if distance == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, penetration, 0.0, 0.0
    per_distance = 1.0 / distance
    nx = ex * per_distance
    ny = ey * per_distance
    rate = vx * nx + vy * ny
    sliding = vy * nx - vx * ny + surface_speed
    force, elastic = normal_force(penetration, rate, onset_speed, stiffness, damping_factor)
    tangential = 0.0
    if force > 0.0:
        tangential = friction_force(force, sliding, friction, smoothing_speed)
    return (
        -force * nx + tangential * ny,
        -force * ny - tangential * nx,
        force,
        elastic,
        tangential,
        penetration,
        rate,
        sliding,
    )
