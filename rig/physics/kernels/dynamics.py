"""The equations of motion of the whole rig at one instant, stage by stage.

`rig.physics.kernels.frames.geometry` has the frames and signs. Shaft: Euler's equations (15) in the frame B2 that
follows the shaft but not its spin. With w = theta' + Gamma' sin b:

    Ixx (Gamma'' cos b - 2 Gamma' beta' sin b) + Izz w beta' = -cos G L_y
    Ixx beta'' + Ixx Gamma'^2 sin b cos b - Izz w Gamma' cos b = cos b L_x + sin b sin G L_y
    Izz w' = T_drive - R_S F_t

where (L_x, L_y) is the sum of arm times lateral force. Both torques act along the shaft, so they do work on w and
have no part in the first equation: this is eq. 17 with its signs, where a Lagrangian form has the torque's share
sin b T in Q_Gamma. For the same reason the surface speed in eq. 39 is R_S w, which differs from R_S theta' by less
than 1e-3 but closes the energy ledger.

This is the one statement of the model. Engines that need more than rates take code that is made of it by running it on
symbols (`rig.physics.engines.taylor`).
"""

from __future__ import annotations

from typing import NamedTuple

from rig.physics.kernels import signals as S
from rig.physics.kernels.forces import disk_forces, drive_torque, magnets_on, passed_on, stator_of, torques
from rig.physics.kernels.frames.geometry import State, eccentricity_of, pose_of
from rig.physics.kernels.laws.contact import ROLLING, SWITCH, TOUCHING, ring_force
from rig.physics.kernels.ledger import powers_of
from rig.physics.kernels.observe import write_observed
from rig.physics.kernels.stage import stage


class Motion(NamedTuple):
    """Accelerations of everything that moves."""

    ddG: float  # Gamma'' [rad/s^2]
    ddb: float  # beta'' [rad/s^2]
    ddth: float  # theta'' [rad/s^2]
    dw: float  # w' [rad/s^2]
    torque: float  # of the drive [N m]
    ax_ih: float  # [m/s^2]
    ay_ih: float
    ax_oh: float
    ay_oh: float


@stage
def spin_of(constants, inputs, share, drive, Ft):
    """Acceleration of the spin [rad/s^2] and torque of the drive [N m]."""
    shaft = constants.shaft
    # Reciprocals of constants leave the loop; divisions would not.
    per_Izz = 1.0 / shaft.polar_inertia
    if inputs.ideal_drive:
        dw = inputs.speed_slope + share
        return dw, shaft.polar_inertia * dw + shaft.radius * Ft
    return (drive - shaft.radius * Ft) * per_Izz, drive


@stage
def inner_house_of(constants, stator, Fx, Fy):
    """Acceleration of the inner house, on which the ring's force acts as well [m/s^2]."""
    if constants.levels.inner_house:
        per_inner = 1.0 / constants.house.inner_mass
        return stator.ax_ih - Fx * per_inner, stator.ay_ih - Fy * per_inner
    return stator.ax_ih, stator.ay_ih


@stage
def accelerations(constants, inputs, state, pose, stator, Lx, Ly, drive, Fx, Fy, Ft):
    """Euler's equations, the spin's and the houses'.

    Args:
        constants: Numbers of the model.
        inputs: Kind and speed of the drive.
        state: The state.
        pose: Of the shaft.
        stator: Of the houses.
        Lx: Arm times lateral force without the ring's, x [N m].
        Ly: The same, y [N m].
        drive: Torque of a drive that is not ideal [N m].
        Fx: Force of the ring on the shaft, x [N].
        Fy: The same, y [N].
        Ft: Friction force [N].
    """
    shaft = constants.shaft
    Izz, per_Ixx = shaft.polar_inertia, 1.0 / shaft.transverse_inertia
    dG, db = state.dG, state.db
    cG, sb, cb, w = pose.cG, pose.sb, pose.cb, pose.w
    Lx += shaft.arm_ring * Fx
    Ly += shaft.arm_ring * Fy
    turning = pose.large * (dG * db)
    ddG = ((-cG * Ly - Izz * w * db) * per_Ixx + 2.0 * turning * sb) / cb
    ddb = (cb * Lx + pose.cross * Ly + Izz * w * dG * cb) * per_Ixx - pose.large * (dG * dG * sb * cb)
    # The share of Gamma' along the shaft, by which the spin exceeds theta': its rate.
    share = pose.large * (ddG * sb) + turning * cb
    dw, torque = spin_of(constants, inputs, share, drive, Ft)
    ax_ih, ay_ih = inner_house_of(constants, stator, Fx, Fy)
    return Motion(ddG, ddb, dw - share, dw, torque, ax_ih, ay_ih, stator.ax_oh, stator.ay_oh)


@stage
def axis_acceleration(state, pose, ddG, ddb):
    """Second derivative of the axis's direction u, x, y and z [1/s^2]."""
    sG, cG, sb, cb, dG, db = pose.sG, pose.cG, pose.sb, pose.cb, state.dG, state.db
    spread, turning = pose.large * (dG * dG + db * db), pose.large * (dG * db)
    return (
        cb * ddb - pose.large * (sb * db * db),
        -cG * cb * ddG + pose.cross * ddb + sG * cb * spread + 2.0 * cG * sb * turning,
        pose.large * (-sG * cb * ddG - cG * sb * ddb - cG * cb * spread + 2.0 * sG * sb * turning),
    )


@stage
def sliding_acceleration(constants, state, pose, e, ring, motion):
    """Rate of the sliding speed [m/s^2]."""
    arm, both = constants.shaft.arm_ring, constants.contact.gap_counts_outer
    ddux, dduy, _ = axis_acceleration(state, pose, motion.ddG, motion.ddb)
    ax = arm * ddux - motion.ax_ih - both * motion.ax_oh
    ay = arm * dduy - motion.ay_ih - both * motion.ay_oh
    along = e.vy * ring.nx - e.vx * ring.ny
    distance = ring.delta + constants.contact.clearance
    return ay * ring.nx - ax * ring.ny - along * ring.rate / distance + constants.shaft.radius * motion.dw


@stage
def unit_response(constants, inputs, pose, nx, ny):
    """Rate of the sliding speed for a friction force of 1 N [m/s^2 per N]: -(inverse mass along the ring), below 0."""
    shaft, sb, cb = constants.shaft, pose.sb, pose.cb
    force_x, force_y = shaft.arm_ring * ny, -shaft.arm_ring * nx
    per_Ixx = 1.0 / shaft.transverse_inertia
    ddG = -pose.cG * force_y * per_Ixx / cb
    ddb = (cb * force_x + pose.cross * force_y) * per_Ixx
    ax = shaft.arm_ring * cb * ddb
    ay = shaft.arm_ring * (-pose.cG * cb * ddG + pose.cross * ddb)
    response = ay * nx - ax * ny
    if constants.levels.inner_house:
        response -= 1.0 / constants.house.inner_mass
    if not inputs.ideal_drive:
        response -= shaft.radius * shaft.radius / shaft.polar_inertia
    elif constants.levels.euler:
        response += shaft.radius * ddG * sb
    return response


@stage
def holding_friction(constants, inputs, phase, state, pose, e, ring, motion):
    """Friction that keeps the sliding speed from changing [N]: its rate is linear in the force.

    Args:
        constants: Numbers of the model.
        inputs: Kind of the drive.
        phase: ROLLING, or TOUCHING for Leine's switch model as a clamped law: it brings v_t to 0 within some v_s /
            (largest friction).
        state: The state.
        pose: Of the shaft.
        e: Eccentricity.
        ring: Force of the ring without friction.
        motion: Accelerations without friction.
    """
    contact = constants.contact
    friction = -sliding_acceleration(constants, state, pose, e, ring, motion) / unit_response(
        constants, inputs, pose, ring.nx, ring.ny
    )
    if phase == ROLLING:
        return friction
    limit = contact.friction * ring.Fn
    return min(max(friction + limit * ring.sliding / contact.smoothing_speed, -limit), limit)


@stage
def evaluate(constants, inputs, tick, fraction, onset_speed, phase, observe, y, dy, out):
    """Rates of the state and of the integrals, and what is observed, at one instant.

    Args:
        constants: Numbers of the model.
        inputs: Hammer, drive, magnets.
        tick: Whole tick of the instant.
        fraction: Ticks beyond it.
        onset_speed: v0 of the running contact [m/s].
        phase: Phase of the contact (`kernels.laws.contact`); FLIGHT leaves its force out, up to a located onset.
        observe: False leaves `out` alone but for the penetration, its rate, the sliding speed and the contact forces.
        y: State and integrals, shape (N_VECTOR,).
        dy: Their rates, out, shape (N_VECTOR,).
        out: Observed quantities, out, shape (N_OBSERVED,).
    """
    # state in:
    levels = constants.levels
    state = State(y[0], y[1], y[2], y[3], y[4], y[5], y[6], y[7], y[8], y[9], y[10], y[11], y[12], y[13])
    # Where everything is, and the forces but friction where that depends on the whole motion.
    pose = pose_of(levels, state)
    e = eccentricity_of(constants, state, pose)
    ring = ring_force(
        e.ex, e.ey, e.vx, e.vy, constants.shaft.radius * pose.w, onset_speed, levels.friction, phase, constants.contact
    )
    magnets = magnets_on(constants, inputs, pose)
    disk = disk_forces(constants, inputs, tick, fraction, state)
    stator = stator_of(constants, state)
    drive = drive_torque(constants, inputs, tick, fraction, state)
    Lx, Ly = torques(constants, magnets, disk)
    Fx, Fy, Ft = ring.Fx, ring.Fy, ring.Ft
    if phase == ROLLING or (levels.friction == SWITCH and phase == TOUCHING and ring.Fn > 0.0):
        free = accelerations(constants, inputs, state, pose, stator, Lx, Ly, drive, Fx, Fy, 0.0)
        Ft = holding_friction(constants, inputs, phase, state, pose, e, ring, free)
        Fx += Ft * ring.ny
        Fy -= Ft * ring.nx
    motion = accelerations(constants, inputs, state, pose, stator, Lx, Ly, drive, Fx, Fy, Ft)
    support = passed_on(constants, stator, Fx, Fy)
    powers = powers_of(constants, state, pose, ring, magnets, disk, stator, support, Lx, Ly, Fx, Fy, Ft, motion.torque)

    # out: rates of the state
    dy[S.GAMMA] = state.dG
    dy[S.BETA] = state.db
    dy[S.THETA] = state.dth
    dy[S.X_IH] = state.vx_ih
    dy[S.Y_IH] = state.vy_ih
    dy[S.X_OH] = state.vx_oh
    dy[S.Y_OH] = state.vy_oh
    dy[S.GAMMA_RATE] = motion.ddG
    dy[S.BETA_RATE] = motion.ddb
    dy[S.THETA_RATE] = motion.ddth
    dy[S.VX_IH] = motion.ax_ih
    dy[S.VY_IH] = motion.ay_ih
    dy[S.VX_OH] = motion.ax_oh
    dy[S.VY_OH] = motion.ay_oh
    # out: rates of the integrals
    dy[S.DRIVE_WORK] = powers.drive_work
    dy[S.HAMMER_WORK] = powers.hammer_work
    dy[S.UNBALANCE_WORK] = powers.unbalance_work
    dy[S.GAP_WORK] = powers.gap_work
    dy[S.RELEASE_WORK] = powers.release_work
    dy[S.BEARING_LOSS] = powers.bearing_loss
    dy[S.HOUSE_LOSS] = powers.house_loss
    dy[S.CONTACT_LOSS] = powers.contact_loss
    dy[S.FRICTION_LOSS] = powers.friction_loss
    dy[S.CONTACT_IMPULSE] = powers.contact_impulse
    dy[S.ANGULAR_IMPULSE_X] = powers.angular_impulse_x
    dy[S.ANGULAR_IMPULSE_Y] = powers.angular_impulse_y
    dy[S.ANGULAR_IMPULSE_Z] = powers.angular_impulse_z
    dy[S.HOUSE_IMPULSE_X] = powers.house_impulse_x
    dy[S.HOUSE_IMPULSE_Y] = powers.house_impulse_y
    # out: what is observed
    out[S.PENETRATION] = ring.delta
    out[S.PENETRATION_RATE] = ring.rate
    out[S.NORMAL_FORCE] = ring.Fn
    out[S.FRICTION_FORCE] = Ft
    out[S.SLIDING_SPEED] = ring.sliding
    if observe:
        out[S.ONSET_SPEED] = onset_speed
        acceleration = axis_acceleration(state, pose, motion.ddG, motion.ddb)
        write_observed(constants, state, pose, ring, magnets, disk, stator, support, motion, acceleration, Fx, Fy, out)
