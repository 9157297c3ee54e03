"""Model constants of the kernels: SI floats in one NamedTuple per body or law, frozen for a run."""

from __future__ import annotations

from typing import NamedTuple


class Shaft(NamedTuple):
    """Rigid shaft on its pivot."""

    mass: float  # [kg]
    transverse_inertia: float  # [kg m^2] about the pivot
    polar_inertia: float  # [kg m^2]
    arm_ring: float  # [m]
    arm_magnet: float  # [m]
    arm_centre: float  # [m]
    arm_disk: float  # [m]
    radius: float  # [m]
    unbalance: float  # mass times eccentricity [kg m]
    unbalance_phase: float  # [rad]
    gravity: float  # [m/s^2]


class Magnet(NamedTuple):
    """Magnet map (`kernels.laws.magnet` has its formula), with viscous damping at the same point."""

    terms: int  # LINEAR, RADIAL or RIPPLED of rig.physics.kernels.laws.magnet
    stiffness: float  # [N/m] at the centre
    a3: float  # [1/m^2]
    a5: float  # [1/m^4]
    a7: float  # [1/m^6]
    ripple: float  # [1/m^(number-2)]
    growth: float  # [1/m^2]
    number: int  # of magnets
    damping_x: float  # [N s/m]
    damping_y: float  # [N s/m]


class Contact(NamedTuple):
    """Normal law and friction between shaft and ring."""

    clearance: float  # [m]
    offset_x: float  # [m]
    offset_y: float  # [m]
    stiffness: float  # [N/m^exponent]
    exponent: float  # [1]
    damping_factor: float  # [1]
    viscous_damping: float  # [N s/m]
    restitution: float  # [1] of the rigid impact law
    friction: float  # [1]
    smoothing_speed: float  # [m/s]
    speed_floor: float  # [m/s]
    gap_counts_outer: float  # 0 or 1


class House(NamedTuple):
    """Inner and outer housing on beams and pre-compressed transducers."""

    inner_mass: float  # [kg]
    outer_mass: float  # [kg]
    inner_beam_stiffness: float  # [N/m]
    inner_beam_damping: float  # [N s/m]
    outer_beam_stiffness: float  # [N/m]
    outer_beam_damping: float  # [N s/m]
    pair_stiffness_vertical: float  # [N/m]
    pair_stiffness_horizontal: float  # [N/m]
    preload: float  # [N]


class Levels(NamedTuple):
    """Selected parts of the model; an excluded part costs a predicted branch."""

    euler: bool  # exact rotations and gyroscopic coupling of large tilts; else small angles
    inner_house: bool  # moves; a fixed one transmits forces
    outer_house: bool  # moves; only with an inner housing that moves
    compliant: bool  # contact force; else a rigid impact law
    friction: int  # NO_FRICTION ... EXACT of rig.physics.kernels.laws.contact


class Constants(NamedTuple):
    """All constants of a model."""

    levels: Levels
    shaft: Shaft
    magnet: Magnet
    contact: Contact
    house: House
    torque_gain: float  # [N m s]


class Inputs(NamedTuple):
    """External inputs of the rig, constant between commands and during one call.

    Ticks are absolute; the speed target is `speed + speed_slope (t - speed_tick)`.
    """

    tick_s: float  # seconds a tick
    hammer_force: float  # [N] peak of the half sine
    hammer_x: float  # direction cosine
    hammer_y: float  # direction cosine
    hammer_start: int  # tick
    hammer_end: int  # tick
    speed: float  # [rad/s]
    speed_slope: float  # [rad/s^2]
    speed_tick: int  # tick
    ideal_drive: bool  # theta' prescribed instead of a torque law
    magnet_engaged: bool
