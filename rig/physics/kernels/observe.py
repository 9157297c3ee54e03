"""Observed quantities at one instant, apart from the contact: readings, reactions, displacements, energies, momenta."""

from __future__ import annotations

import math

from rig.physics.kernels import signals as S
from rig.physics.kernels.stage import stage

KEYPHASOR_WIDTH = math.radians(10.0)
"""Angle of the keyphasor mark [rad]; assumed."""
EDGE_WIDTH = math.radians(1.0)
"""Angle of each of its edges, equal to the width of the probe's tip [rad]; assumed."""


@stage
def write_observed(
    constants, state, pose, ring, magnets, disk, stator, support, motion, acceleration, Fx, Fy, out
):  # fmt: skip
    """Write the observed quantities.

    Args:
        constants: Model constants.
        state: State.
        pose: Pose of the shaft.
        ring: Force of the ring, without friction that depends on the accelerations.
        magnets: Magnet forces.
        disk: Forces at the disk.
        stator: Forces of the housings.
        support: Transducer and outer beam forces (`rig.physics.kernels.forces.support_forces`).
        motion: Accelerations.
        acceleration: Acceleration of the axis's direction, x, y, z [1/s^2].
        Fx: Force of the ring on the shaft, x [N].
        Fy: Force as `Fx`, y [N].
        out: Observed quantities, out, shape (N_OBSERVED,).
    """
    shaft, contact, house = constants.shaft, constants.contact, constants.house
    Ixx, Izz, lA, lI = shaft.transverse_inertia, shaft.polar_inertia, shaft.arm_ring, shaft.arm_disk
    sG, cG, sb, cb = pose.sG, pose.cG, pose.sb, pose.cb
    dG, db, w, ux, uy, uz = state.dG, state.db, pose.w, pose.ux, pose.uy, pose.uz
    vx_ih, vy_ih, vx_oh, vy_oh = state.vx_ih, state.vy_ih, state.vx_oh, state.vy_oh
    out[S.P_N], out[S.P_S], out[S.P_E], out[S.P_W], _ = support
    out[S.INNER_AX] = motion.ax_ih
    out[S.INNER_AY] = motion.ay_ih
    out[S.OUTER_AX] = motion.ax_oh
    out[S.OUTER_AY] = motion.ay_oh
    # Reaction at the pivot, R = M a_C - sum of the applied forces (eqs. 20-21).
    ddux, dduy, dduz = acceleration
    inertia = shaft.mass * shaft.arm_centre
    weight = -shaft.mass * shaft.gravity
    out[S.PIVOT_X] = inertia * ddux - (Fx + magnets.x + magnets.damping_x + disk.unbalance_x + disk.hammer_x)
    out[S.PIVOT_Y] = inertia * dduy - (Fy + magnets.y + magnets.damping_y + disk.unbalance_y + disk.hammer_y + weight)
    out[S.PIVOT_Z] = inertia * dduz
    out[S.HAMMER_FORCE] = disk.hammer
    out[S.DISK_X] = lI * (ux - contact.offset_x / lA)
    out[S.DISK_Y] = lI * (uy - contact.offset_y / lA)
    out[S.RING_X] = lA * ux - state.x_ih - contact.offset_x
    out[S.RING_Y] = lA * uy - state.y_ih - contact.offset_y
    out[S.SPIN_RATE] = state.dth
    ahead = (state.theta + math.pi) % (2.0 * math.pi) - math.pi
    seen = 0.5 + min(ahead, KEYPHASOR_WIDTH - ahead) / EDGE_WIDTH
    out[S.KEYPHASOR] = min(max(seen, 0.0), 1.0)
    out[S.DRIVE_TORQUE] = motion.torque
    out[S.MAGNET_X] = magnets.x
    out[S.MAGNET_Y] = magnets.y
    out[S.KINETIC] = 0.5 * (Ixx * (dG * dG * cb * cb + db * db) + Izz * w * w) + 0.5 * (
        house.inner_mass * (vx_ih * vx_ih + vy_ih * vy_ih) + house.outer_mass * (vx_oh * vx_oh + vy_oh * vy_oh)
    )
    out[S.GRAVITY] = -weight * shaft.arm_centre * uy
    out[S.MAGNETIC] = magnets.energy
    out[S.HOUSE] = (
        0.5 * house.inner_beam_stiffness * stator.stretch * stator.stretch
        + 0.5 * house.outer_beam_stiffness * state.y_oh * state.y_oh
        + stator.stored_vertical
        + stator.stored_horizontal
    )
    out[S.CONTACT] = ring.elastic * ring.delta / (contact.exponent + 1.0) if ring.delta > 0.0 else 0.0
    # Angular momentum about the pivot in the fixed frame: Ixx (G' cos b X + b' Y) + Izz w Z, with B2's axes X, Y, Z.
    out[S.ANGULAR_X] = Ixx * dG * cb * cb + Izz * w * ux
    out[S.ANGULAR_Y] = Ixx * (dG * cb * sG * sb + db * cG) + Izz * w * uy
    out[S.ANGULAR_Z] = Ixx * (-dG * cb * cG * sb + db * sG) + Izz * w * uz
    out[S.HOUSE_X] = house.inner_mass * vx_ih + house.outer_mass * vx_oh
    out[S.HOUSE_Y] = house.inner_mass * vy_ih + house.outer_mass * vy_oh
