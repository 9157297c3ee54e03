"""Forces on shaft and housings except the ring's: hammer, drive, unbalance, gravity, magnets, beams, transducers."""

from __future__ import annotations

import math
from typing import NamedTuple

from rig.physics.kernels.laws.house import pair_readings
from rig.physics.kernels.laws.magnet import magnet_force
from rig.physics.kernels.stage import stage


class Magnets(NamedTuple):
    """Force of the magnets on the shaft, and of the damping at the same point."""

    x: float  # [N]
    y: float  # [N]
    energy: float  # stored [J]
    damping_x: float  # [N]
    damping_y: float  # [N]


class Disk(NamedTuple):
    """Forces at the disk [N]."""

    unbalance_x: float
    unbalance_y: float
    hammer: float  # along its own direction
    hammer_x: float
    hammer_y: float


class Stator(NamedTuple):
    """Readings and forces of the housings, and their accelerations without the ring's force."""

    north: float  # [N]
    south: float
    east: float
    west: float
    beam_x: float  # force of the inner beam on the outer housing [N]
    beam_y: float  # force of the outer beam on the ground [N]
    stretch: float  # of the inner beam [m]
    slip: float  # its rate [m/s]
    stored_vertical: float  # in the transducers [J]
    stored_horizontal: float
    ax_ih: float  # [m/s^2]
    ay_ih: float
    ax_oh: float
    ay_oh: float


@stage
def hammer_force(inputs, tick, fraction):
    """Return the half-sine hammer pulse [N] at `tick + fraction`, two numbers that keep the time exact."""
    if tick >= inputs.hammer_end or tick + fraction < inputs.hammer_start or inputs.hammer_end <= inputs.hammer_start:
        return 0.0
    phase = (float(tick - inputs.hammer_start) + fraction) / float(inputs.hammer_end - inputs.hammer_start)
    return inputs.hammer_force * math.sin(math.pi * phase) if phase < 1.0 else 0.0


@stage
def drive_speed(inputs, tick, fraction):
    """Return the speed target of the drive [rad/s]."""
    return inputs.speed + inputs.speed_slope * ((float(tick - inputs.speed_tick) + fraction) * inputs.tick_s)


@stage
def drive_torque(constants, inputs, tick, fraction, state):
    """Return the torque of a non-ideal drive [N m]."""
    return constants.torque_gain * (drive_speed(inputs, tick, fraction) - state.dth)


@stage
def magnet_forces(constants, inputs, pose):
    """Return the force of the magnets and of their damping; 0 when they are released."""
    magnet, arm = constants.magnet, constants.shaft.arm_magnet
    if not inputs.magnet_engaged:
        return Magnets(0.0, 0.0, 0.0, 0.0, 0.0)
    x, y, energy = magnet_force(arm * pose.ux, arm * pose.uy, magnet)
    return Magnets(x, y, energy, -magnet.damping_x * arm * pose.dux, -magnet.damping_y * arm * pose.duy)


@stage
def disk_forces(constants, inputs, tick, fraction, state):
    """Return the forces of the unbalance, which rotates with theta, and of the hammer."""
    shaft = constants.shaft
    unbalance = shaft.unbalance * state.dth * state.dth
    angle = state.theta + shaft.unbalance_phase
    hammer = hammer_force(inputs, tick, fraction)
    return Disk(
        unbalance * math.cos(angle),
        unbalance * math.sin(angle),
        hammer,
        hammer * inputs.hammer_x,
        hammer * inputs.hammer_y,
    )


@stage
def torques(constants, magnets, disk):
    """Return the sum of arm times lateral force about the pivot, x and y [N m], without the ring's."""
    shaft = constants.shaft
    weight = -shaft.mass * shaft.gravity
    lB, lI = shaft.arm_magnet, shaft.arm_disk
    Lx = lB * (magnets.x + magnets.damping_x) + lI * (disk.unbalance_x + disk.hammer_x)
    Ly = lB * (magnets.y + magnets.damping_y) + lI * (disk.unbalance_y + disk.hammer_y) + shaft.arm_centre * weight
    return Lx, Ly


@stage
def inner_house_forces(constants, state):
    """Return forces and accelerations of the inner housing, without the ring's force.

    Returns:
        North and south [N], force of the inner beam [N], its stretch [m] and slip [m/s], energy of the pair [J],
        acceleration x, y [m/s^2].
    """
    house = constants.house
    if not constants.levels.inner_house:
        return house.preload, house.preload, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    north, south, stored = pair_readings(state.y_ih - state.y_oh, house.pair_stiffness_vertical, house.preload)
    stretch = state.x_ih - state.x_oh
    slip = state.vx_ih - state.vx_oh
    beam = house.inner_beam_stiffness * stretch + house.inner_beam_damping * slip
    return north, south, beam, stretch, slip, stored, -beam / house.inner_mass, -(north - south) / house.inner_mass


@stage
def outer_house_forces(constants, state, north, south, beam_x):
    """Return forces and accelerations of the outer housing.

    Returns:
        East and west [N], force of the outer beam [N], energy of the pair [J], acceleration x, y [m/s^2].
    """
    house = constants.house
    if not constants.levels.outer_house:
        return house.preload, house.preload, 0.0, 0.0, 0.0, 0.0
    east, west, stored = pair_readings(state.x_oh, house.pair_stiffness_horizontal, house.preload)
    beam_y = house.outer_beam_stiffness * state.y_oh + house.outer_beam_damping * state.vy_oh
    ax = (beam_x - (east - west)) / house.outer_mass
    return east, west, beam_y, stored, ax, ((north - south) - beam_y) / house.outer_mass


@stage
def stator_forces(constants, state):
    """Return the forces of beams and transducers. A fixed housing transmits its force."""
    north, south, beam_x, stretch, slip, stored_v, ax_ih, ay_ih = inner_house_forces(constants, state)
    east, west, beam_y, stored_h, ax_oh, ay_oh = outer_house_forces(constants, state, north, south, beam_x)
    return Stator(
        north, south, east, west, beam_x, beam_y, stretch, slip, stored_v, stored_h, ax_ih, ay_ih, ax_oh, ay_oh
    )


@stage
def support_forces(constants, stator, Fx, Fy):
    """Return the transducer and outer beam forces, where a fixed housing transmits its load to the support.

    Args:
        constants: Model constants.
        stator: Forces of housings that move.
        Fx: Force of the ring on the shaft, x [N].
        Fy: Force as `Fx`, y [N].

    Returns:
        North, south, east, west and the outer beam's force [N].
    """
    levels, preload = constants.levels, constants.house.preload
    north, south, east, west, beam_y = stator.north, stator.south, stator.east, stator.west, stator.beam_y
    if not levels.outer_house:
        across = stator.beam_x if levels.inner_house else -Fx
        beam_y = north - south if levels.inner_house else -Fy
        east, west = preload + 0.5 * across, preload - 0.5 * across
        if not levels.inner_house:
            north, south = preload + 0.5 * beam_y, preload - 0.5 * beam_y
    return north, south, east, west, beam_y
