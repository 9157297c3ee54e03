"""The equations of motion of the whole rig, and everything that is read off them at one instant.

Frames and signs: x horizontal (EAST +), y up, z along the shaft toward its free end; Gamma turns about x, beta about
the turned y, theta is the spin. A point of the axis at arm l is at l u with u = (sin b, -sin G cos b, cos G cos b).

Shaft: Euler's equations (15) in the frame B2 that follows the shaft but not its spin. With w = theta' + Gamma' sin b:

    Ixx (Gamma'' cos b - 2 Gamma' beta' sin b) + Izz w beta' = -cos G L_y
    Ixx beta'' + Ixx Gamma'^2 sin b cos b - Izz w Gamma' cos b = cos b L_x + sin b sin G L_y
    Izz w' = T_drive - R_S F_t

where (L_x, L_y) is the sum of arm times lateral force. Both torques act along the shaft, so they do work on w and
have no part in the first equation: this is eq. 17 with its signs, where a Lagrangian form has the torque's share
sin b T in Q_Gamma. For the same reason the surface speed in eq. 39 is R_S w, which differs from R_S theta' by less
than 1e-3 but closes the energy ledger.
"""

from __future__ import annotations

import math

from numba import njit

from rig.kernels import signals as S
from rig.kernels.angles import sin_cos
from rig.kernels.contact import ROLLING, SWITCH, TOUCHING, ring_force
from rig.kernels.house import pair_readings
from rig.kernels.magnet import magnet_force

KEYPHASOR_WIDTH = math.radians(10.0)
"""Angle over which the mark is seen [rad]."""


@njit(cache=True, error_model="numpy", fastmath=False)
def hammer_force(inputs, tick, fraction):
    """Half-sine pulse of the hammer [N] at `tick + fraction`: a whole tick and the part beyond, apart to stay exact."""
    if tick >= inputs.hammer_end or tick + fraction < inputs.hammer_start or inputs.hammer_end <= inputs.hammer_start:
        return 0.0
    phase = (float(tick - inputs.hammer_start) + fraction) / float(inputs.hammer_end - inputs.hammer_start)
    return inputs.hammer_force * math.sin(math.pi * phase) if phase < 1.0 else 0.0


@njit(cache=True, error_model="numpy", fastmath=False)
def drive_speed(inputs, tick, fraction):
    """Speed that the drive aims at [rad/s]."""
    return inputs.speed + inputs.speed_slope * ((float(tick - inputs.speed_tick) + fraction) * inputs.tick_s)


@njit(cache=True, error_model="numpy", fastmath=False)
def gap(constants, y):
    """Penetration of the shaft into the ring [m] (negative: gap) and its rate [m/s]."""
    contact = constants.contact
    arm = constants.shaft.arm_ring
    if constants.levels.euler:
        sin_g, cos_g = sin_cos(y[0])
        sin_b, cos_b = sin_cos(y[1])
        turned = sin_g * sin_b * y[8]
    else:
        sin_g, cos_g, sin_b, cos_b, turned = y[0], 1.0, y[1], 1.0, 0.0
    ex = arm * sin_b - y[3] - contact.gap_counts_outer * y[5] - contact.offset_x
    ey = -arm * sin_g * cos_b - y[4] - contact.gap_counts_outer * y[6] - contact.offset_y
    vx = arm * cos_b * y[8] - y[10] - contact.gap_counts_outer * y[12]
    vy = -arm * (cos_g * cos_b * y[7] - turned) - y[11] - contact.gap_counts_outer * y[13]
    distance = math.sqrt(ex * ex + ey * ey)
    if distance == 0.0:
        return -contact.clearance, 0.0
    return distance - contact.clearance, (ex * vx + ey * vy) / distance


@njit(cache=True, error_model="numpy", fastmath=False)
def unit_response(constants, inputs, sin_g, cos_g, sin_b, cos_b, nx, ny):
    """Rate of the sliding speed for a friction force of 1 N [m/s^2 per N]: -(inverse mass along the ring), below 0."""
    shaft = constants.shaft
    force_x, force_y = shaft.arm_ring * ny, -shaft.arm_ring * nx
    per_Ixx = 1.0 / shaft.transverse_inertia
    ddG = -cos_g * force_y * per_Ixx / cos_b
    cross = sin_b * sin_g if constants.levels.euler else 0.0
    ddb = (cos_b * force_x + cross * force_y) * per_Ixx
    ax = shaft.arm_ring * cos_b * ddb
    ay = shaft.arm_ring * (-cos_g * cos_b * ddG + cross * ddb)
    response = ay * nx - ax * ny
    if constants.levels.inner_house:
        response -= 1.0 / constants.house.inner_mass
    if not inputs.ideal_drive:
        response -= shaft.radius * shaft.radius / shaft.polar_inertia
    elif constants.levels.euler:
        response += shaft.radius * ddG * sin_b
    return response


@njit(cache=True, error_model="numpy", fastmath=False, forceinline=True)
def evaluate(constants, inputs, tick, fraction, onset_speed, phase, observe, y, dy, out):
    """Rates of the state and of the integrals, and what is observed, at one instant.

    Args:
        constants: Numbers of the model.
        inputs: Hammer, drive, magnets.
        tick: Whole tick of the instant.
        fraction: Ticks beyond it.
        onset_speed: v0 of the running contact [m/s].
        phase: Phase of the contact (`rig.kernels.contact`); FLIGHT leaves its force out, up to a located onset.
        observe: False leaves `out` alone but for the penetration, its rate, the sliding speed and the contact forces.
        y: State and integrals, shape (N_VECTOR,).
        dy: Their rates, out, shape (N_VECTOR,).
        out: Observed quantities, out, shape (N_OBSERVED,).
    """
    # params:
    levels = constants.levels
    shaft, magnet, contact, house = constants.shaft, constants.magnet, constants.contact, constants.house
    Ixx, Izz = shaft.transverse_inertia, shaft.polar_inertia
    lA, lB, lI = shaft.arm_ring, shaft.arm_magnet, shaft.arm_disk
    # state in:
    dG, db, dth = y[7], y[8], y[9]
    x_ih, y_ih, x_oh, y_oh = y[3], y[4], y[5], y[6]
    vx_ih, vy_ih, vx_oh, vy_oh = y[10], y[11], y[12], y[13]
    if levels.euler:
        sG, cG = sin_cos(y[0])
        sb, cb = sin_cos(y[1])
        w = dth + dG * sb
        spread = dG * dG + db * db
        turning = dG * db
        drag = dG * dG * sb * cb
        cross = sb * sG
    else:
        sG, cG, sb, cb = y[0], 1.0, y[1], 1.0
        w = dth
        spread = turning = drag = cross = 0.0
    # Direction of the axis and its rate.
    ux, uy, uz = sb, -sG * cb, cG * cb
    dux, duy = cb * db, -cG * cb * dG
    if levels.euler:
        duy += sG * sb * db

    # Contact at the ring.
    both = contact.gap_counts_outer
    ex = lA * ux - x_ih - both * x_oh - contact.offset_x
    ey = lA * uy - y_ih - both * y_oh - contact.offset_y
    vx = lA * dux - vx_ih - both * vx_oh
    vy = lA * duy - vy_ih - both * vy_oh
    Fx, Fy, Fn, elastic, Ft, delta, rate, sliding, nx, ny = ring_force(
        ex, ey, vx, vy, shaft.radius * w, onset_speed, levels.friction, phase, contact
    )

    # Magnets and their damping.
    magnet_x = magnet_y = magnet_energy = damping_x = damping_y = 0.0
    if inputs.magnet_engaged:
        magnet_x, magnet_y, magnet_energy = magnet_force(lB * ux, lB * uy, magnet)
        damping_x = -magnet.damping_x * lB * dux
        damping_y = -magnet.damping_y * lB * duy

    # Unbalance and hammer at the disk, gravity at the centre of mass.
    unbalance = shaft.unbalance * dth * dth
    angle = y[2] + shaft.unbalance_phase
    unbalance_x = unbalance * math.cos(angle)
    unbalance_y = unbalance * math.sin(angle)
    hammer = hammer_force(inputs, tick, fraction)
    hammer_x = hammer * inputs.hammer_x
    hammer_y = hammer * inputs.hammer_y
    weight = -shaft.mass * shaft.gravity

    # Torques about the pivot by lateral forces, without the contact's.
    Lx = lB * (magnet_x + damping_x) + lI * (unbalance_x + hammer_x)
    Ly = lB * (magnet_y + damping_y) + lI * (unbalance_y + hammer_y) + shaft.arm_centre * weight

    # Houses. What does not move passes its force on.
    beam_x = beam_y = stored_v = stored_h = stretch = slip = 0.0
    ax_ih = ay_ih = ax_oh = ay_oh = 0.0
    north = south = east = west = house.preload
    if levels.inner_house:
        north, south, stored_v = pair_readings(y_ih - y_oh, house.pair_stiffness_vertical, house.preload)
        stretch = x_ih - x_oh
        slip = vx_ih - vx_oh
        beam_x = house.inner_beam_stiffness * stretch + house.inner_beam_damping * slip
        ax_ih = -beam_x / house.inner_mass
        ay_ih = -(north - south) / house.inner_mass
    if levels.outer_house:
        east, west, stored_h = pair_readings(x_oh, house.pair_stiffness_horizontal, house.preload)
        beam_y = house.outer_beam_stiffness * y_oh + house.outer_beam_damping * vy_oh
        ax_oh = (beam_x - (east - west)) / house.outer_mass
        ay_oh = ((north - south) - beam_y) / house.outer_mass

    # Euler's equations.
    # Reciprocals of constants leave the loop; divisions would not.
    per_Ixx, per_Izz, per_inner = 1.0 / Ixx, 1.0 / Izz, 1.0 / house.inner_mass
    drive = constants.torque_gain * (drive_speed(inputs, tick, fraction) - dth)
    if phase == ROLLING or (phase == TOUCHING and levels.friction == SWITCH and Fn > 0.0):
        # The friction that keeps the sliding speed from changing: its rate is linear in the force.
        torque_x, torque_y = Lx + lA * Fx, Ly + lA * Fy
        ddG = ((-cG * torque_y - Izz * w * db) * per_Ixx + 2.0 * turning * sb) / cb
        ddb = (cb * torque_x + cross * torque_y + Izz * w * dG * cb) * per_Ixx - drag
        dw = drive * per_Izz
        if inputs.ideal_drive:
            dw = inputs.speed_slope
            if levels.euler:
                dw += ddG * sb + turning * cb
        ax = lA * (cb * ddb - sb * db * db) if levels.euler else lA * ddb
        ay = -lA * ddG
        if levels.euler:
            ay = lA * (-cG * cb * ddG + sG * sb * ddb + sG * cb * spread + 2.0 * cG * sb * turning)
        if levels.inner_house:
            ax -= ax_ih - Fx * per_inner
            ay -= ay_ih - Fy * per_inner
        ax -= both * ax_oh
        ay -= both * ay_oh
        along = vy * nx - vx * ny
        change = ay * nx - ax * ny - along * rate / (delta + contact.clearance) + shaft.radius * dw
        response = unit_response(constants, inputs, sG, cG, sb, cb, nx, ny)
        if phase == ROLLING:
            Ft = -change / response
        else:
            # Leine's switch model as a clamped law: it brings v_t to 0 within some v_s / (largest friction).
            limit = contact.friction * Fn
            Ft = -change / response + limit * sliding / contact.smoothing_speed
            Ft = min(max(Ft, -limit), limit)
        Fx += Ft * ny
        Fy -= Ft * nx
    Lx += lA * Fx
    Ly += lA * Fy
    ddG = ((-cG * Ly - Izz * w * db) * per_Ixx + 2.0 * turning * sb) / cb
    ddb = (cb * Lx + cross * Ly + Izz * w * dG * cb) * per_Ixx - drag
    # theta' differs from the spin by the share of Gamma' along the shaft.
    share = ddG * sb + turning * cb if levels.euler else 0.0
    if inputs.ideal_drive:
        dw = inputs.speed_slope + share
        torque = Izz * dw + shaft.radius * Ft
    else:
        torque = drive
        dw = (torque - shaft.radius * Ft) * per_Izz
    ddth = dw - share
    if levels.inner_house:
        ax_ih -= Fx * per_inner
        ay_ih -= Fy * per_inner
    if not levels.outer_house:
        # The support carries what the inner house, or the ring itself, passes on.
        across = beam_x if levels.inner_house else -Fx
        beam_y = north - south if levels.inner_house else -Fy
        east, west = house.preload + 0.5 * across, house.preload - 0.5 * across
        if not levels.inner_house:
            north, south = house.preload + 0.5 * beam_y, house.preload - 0.5 * beam_y

    # out: rates of the state
    dy[0] = dG
    dy[1] = db
    dy[2] = dth
    dy[3] = vx_ih
    dy[4] = vy_ih
    dy[5] = vx_oh
    dy[6] = vy_oh
    dy[7] = ddG
    dy[8] = ddb
    dy[9] = ddth
    dy[10] = ax_ih
    dy[11] = ay_ih
    dy[12] = ax_oh
    dy[13] = ay_oh

    # out: powers and forces behind the integrals
    net = torque - shaft.radius * Ft
    dy[S.DRIVE_WORK] = torque * w
    dy[S.HAMMER_WORK] = lI * (hammer_x * dux + hammer_y * duy)
    dy[S.UNBALANCE_WORK] = lI * (unbalance_x * dux + unbalance_y * duy)
    dy[S.GAP_WORK] = both * (Fx * vx_oh + Fy * vy_oh)
    dy[S.RELEASE_WORK] = 0.0
    dy[S.BEARING_LOSS] = -lB * (damping_x * dux + damping_y * duy)
    dy[S.HOUSE_LOSS] = house.inner_beam_damping * slip * slip + house.outer_beam_damping * vy_oh * vy_oh
    dy[S.CONTACT_LOSS] = (Fn - elastic) * rate
    dy[S.FRICTION_LOSS] = Ft * sliding
    dy[S.CONTACT_IMPULSE] = Fn
    dy[S.ANGULAR_IMPULSE_X] = -uz * Ly + net * ux
    dy[S.ANGULAR_IMPULSE_Y] = uz * Lx + net * uy
    dy[S.ANGULAR_IMPULSE_Z] = ux * Ly - uy * Lx + net * uz
    dy[S.HOUSE_IMPULSE_X] = -Fx - (east - west)
    dy[S.HOUSE_IMPULSE_Y] = -Fy - beam_y

    # out: what is observed
    out[S.PENETRATION] = delta
    out[S.PENETRATION_RATE] = rate
    out[S.NORMAL_FORCE] = Fn
    out[S.FRICTION_FORCE] = Ft
    out[S.SLIDING_SPEED] = sliding
    if not observe:
        return
    out[S.ONSET_SPEED] = onset_speed
    out[S.P_N] = north
    out[S.P_S] = south
    out[S.P_E] = east
    out[S.P_W] = west
    out[S.INNER_AX] = ax_ih
    out[S.INNER_AY] = ay_ih
    out[S.OUTER_AX] = ax_oh
    out[S.OUTER_AY] = ay_oh
    # Reaction at the pivot, R = M a_C - sum of the applied forces (eqs. 20-21), from the axis's acceleration.
    ddux, dduy, dduz = ddb, -ddG, 0.0
    if levels.euler:
        ddux = cb * ddb - sb * db * db
        dduy = -cG * cb * ddG + sG * sb * ddb + sG * cb * spread + 2.0 * cG * sb * turning
        dduz = -sG * cb * ddG - cG * sb * ddb - cG * cb * spread + 2.0 * sG * sb * turning
    inertia = shaft.mass * shaft.arm_centre
    out[S.PIVOT_X] = inertia * ddux - (Fx + magnet_x + damping_x + unbalance_x + hammer_x)
    out[S.PIVOT_Y] = inertia * dduy - (Fy + magnet_y + damping_y + unbalance_y + hammer_y + weight)
    out[S.PIVOT_Z] = inertia * dduz
    out[S.HAMMER_FORCE] = hammer
    out[S.DISK_X] = lI * (ux - contact.offset_x / lA)
    out[S.DISK_Y] = lI * (uy - contact.offset_y / lA)
    out[S.RING_X] = lA * ux - x_ih - contact.offset_x
    out[S.RING_Y] = lA * uy - y_ih - contact.offset_y
    out[S.SPIN_RATE] = dth
    out[S.KEYPHASOR] = 1.0 if y[2] % (2.0 * math.pi) < KEYPHASOR_WIDTH else 0.0
    out[S.DRIVE_TORQUE] = torque
    out[S.MAGNET_X] = magnet_x
    out[S.MAGNET_Y] = magnet_y
    out[S.KINETIC] = 0.5 * (Ixx * (dG * dG * cb * cb + db * db) + Izz * w * w) + 0.5 * (
        house.inner_mass * (vx_ih * vx_ih + vy_ih * vy_ih) + house.outer_mass * (vx_oh * vx_oh + vy_oh * vy_oh)
    )
    out[S.GRAVITY] = -weight * shaft.arm_centre * uy
    out[S.MAGNETIC] = magnet_energy
    out[S.HOUSE] = (
        0.5 * house.inner_beam_stiffness * stretch * stretch
        + 0.5 * house.outer_beam_stiffness * y_oh * y_oh
        + stored_v
        + stored_h
    )
    out[S.CONTACT] = elastic * delta / (contact.exponent + 1.0) if delta > 0.0 else 0.0
    # Angular momentum about the pivot in the fixed frame: Ixx (G' cos b X + b' Y) + Izz w Z, with B2's axes X, Y, Z.
    out[S.ANGULAR_X] = Ixx * dG * cb * cb + Izz * w * ux
    out[S.ANGULAR_Y] = Ixx * (dG * cb * sG * sb + db * cG) + Izz * w * uy
    out[S.ANGULAR_Z] = Ixx * (-dG * cb * cG * sb + db * sG) + Izz * w * uz
    out[S.HOUSE_X] = house.inner_mass * vx_ih + house.outer_mass * vx_oh
    out[S.HOUSE_Y] = house.inner_mass * vy_ih + house.outer_mass * vy_oh
