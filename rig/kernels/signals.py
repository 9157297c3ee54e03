"""The row that an engine writes at every observed instant: its columns, their order, units and meaning.

The first columns are the state; then what the laws make of it at that instant; then the ledger: the momenta and
energies that are stored, and the running integral of every torque, force and power. Kernels address columns by the
constants below.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Signal(NamedTuple):
    """One column."""

    name: str
    unit: str
    label: str


STATE = (
    Signal("Gamma", "rad", "Shaft rotation about x"),
    Signal("beta", "rad", "Shaft rotation about the turned y axis"),
    Signal("theta", "rad", "Spin angle"),
    Signal("x_ih", "m", "Inner house, horizontal (EAST +)"),
    Signal("y_ih", "m", "Inner house, vertical (up +)"),
    Signal("x_oh", "m", "Outer house, horizontal (EAST +)"),
    Signal("y_oh", "m", "Outer house, vertical (up +)"),
    Signal("Gamma_rate", "rad/s", "Rate of Gamma"),
    Signal("beta_rate", "rad/s", "Rate of beta"),
    Signal("theta_rate", "rad/s", "Rate of theta"),
    Signal("vx_ih", "m/s", "Inner house velocity, horizontal"),
    Signal("vy_ih", "m/s", "Inner house velocity, vertical"),
    Signal("vx_oh", "m/s", "Outer house velocity, horizontal"),
    Signal("vy_oh", "m/s", "Outer house velocity, vertical"),
)
"""Generalised coordinates and their rates, in the order of the state vector."""
STATE_SCALE = np.array([5e-3, 5e-3, 1.0, 2e-5, 2e-5, 2e-5, 2e-5, 1.0, 1.0, 40.0, 0.1, 0.1, 0.1, 0.1])
"""What counts as 1 in each state where errors are added up, in its SI unit: shape (N_STATE,)."""

INTEGRALS = (
    Signal("drive_work", "J", "Work done by the drive torque"),
    Signal("hammer_work", "J", "Work done by the hammer"),
    Signal("unbalance_work", "J", "Work done by the unbalance force"),
    Signal("gap_work", "J", "Energy made by a gap that counts the outer house (as printed); else 0"),
    Signal("release_work", "J", "Energy taken out by switching the magnets"),
    Signal("bearing_loss", "J", "Dissipated by the damping at the magnets"),
    Signal("house_loss", "J", "Dissipated by the beams of the houses"),
    Signal("contact_loss", "J", "Dissipated by the normal contact law"),
    Signal("friction_loss", "J", "Dissipated by friction"),
    Signal("contact_impulse", "N s", "Integral of the normal force"),
    Signal("angular_impulse_x", "N m s", "Integral of all torques about the pivot, x"),
    Signal("angular_impulse_y", "N m s", "Integral of all torques about the pivot, y"),
    Signal("angular_impulse_z", "N m s", "Integral of all torques about the pivot, z"),
    Signal("house_impulse_x", "N s", "Integral of the forces on both houses, x"),
    Signal("house_impulse_y", "N s", "Integral of the forces on both houses, y"),
)
"""Running integrals, carried by the engine behind the state with the engine's own quadrature."""

OBSERVED = (
    Signal("penetration", "m", "Shaft into ring; negative is the gap"),
    Signal("penetration_rate", "m/s", "Rate of the penetration"),
    Signal("normal_force", "N", "Contact normal force"),
    Signal("friction_force", "N", "Contact friction force against the sliding speed"),
    Signal("sliding_speed", "m/s", "Speed of the shaft's surface along the ring"),
    Signal("onset_speed", "m/s", "Impact speed held by the running contact (after its floor)"),
    Signal("P_N", "N", "NORTH transducer, compression"),
    Signal("P_S", "N", "SOUTH transducer, compression"),
    Signal("P_E", "N", "EAST transducer, compression"),
    Signal("P_W", "N", "WEST transducer, compression"),
    Signal("inner_ax", "m/s^2", "Inner house acceleration, horizontal"),
    Signal("inner_ay", "m/s^2", "Inner house acceleration, vertical"),
    Signal("outer_ax", "m/s^2", "Outer house acceleration, horizontal"),
    Signal("outer_ay", "m/s^2", "Outer house acceleration, vertical"),
    Signal("pivot_x", "N", "Reaction of the pivot on the shaft, x (eqs. 20-21)"),
    Signal("pivot_y", "N", "Reaction of the pivot on the shaft, y (eqs. 20-21)"),
    Signal("pivot_z", "N", "Reaction of the pivot on the shaft, z (eqs. 20-21)"),
    Signal("hammer_force", "N", "Hammer force along its direction"),
    Signal("disk_x", "m", "Disk, horizontal, from the line through pivot and ring centre"),
    Signal("disk_y", "m", "Disk, vertical, from the line through pivot and ring centre"),
    Signal("ring_x", "m", "Shaft in the ring, horizontal, relative to the inner house"),
    Signal("ring_y", "m", "Shaft in the ring, vertical, relative to the inner house"),
    Signal("spin_rate", "rad/s", "Spin speed"),
    Signal("keyphasor", "1", "1 while the mark passes the keyphasor"),
    Signal("drive_torque", "N m", "Torque of the drive"),
    Signal("magnet_x", "N", "Magnet force, x"),
    Signal("magnet_y", "N", "Magnet force, y"),
    Signal("kinetic_energy", "J", "Shaft and houses"),
    Signal("gravity_energy", "J", "Shaft, from the level of the pivot"),
    Signal("magnet_energy", "J", "Stored in the magnets, from the centre"),
    Signal("house_energy", "J", "Stored in beams and transducers, from the preloaded rest"),
    Signal("contact_energy", "J", "Stored in the contact, K delta^(n+1)/(n+1)"),
    Signal("angular_momentum_x", "N m s", "Shaft about the pivot, x"),
    Signal("angular_momentum_y", "N m s", "Shaft about the pivot, y"),
    Signal("angular_momentum_z", "N m s", "Shaft about the pivot, z"),
    Signal("house_momentum_x", "N s", "Both houses, x"),
    Signal("house_momentum_y", "N s", "Both houses, y"),
)
"""What the laws make of the state at one instant."""

ROW = STATE + INTEGRALS + OBSERVED
COLUMN = {signal.name: column for column, signal in enumerate(ROW)}

N_STATE = len(STATE)
N_VECTOR = N_STATE + len(INTEGRALS)
"""Length of the vector that an engine integrates: the state, then the integrals."""
N_OBSERVED = len(OBSERVED)
N_ROW = len(ROW)

# Positions in the vector and in the observed part, for the kernels.
(
    DRIVE_WORK, HAMMER_WORK, UNBALANCE_WORK, GAP_WORK, RELEASE_WORK,
    BEARING_LOSS, HOUSE_LOSS, CONTACT_LOSS, FRICTION_LOSS,
    CONTACT_IMPULSE, ANGULAR_IMPULSE_X, ANGULAR_IMPULSE_Y, ANGULAR_IMPULSE_Z, HOUSE_IMPULSE_X, HOUSE_IMPULSE_Y,
) = range(N_STATE, N_VECTOR)  # fmt: skip
(
    PENETRATION, PENETRATION_RATE, NORMAL_FORCE, FRICTION_FORCE, SLIDING_SPEED, ONSET_SPEED,
    P_N, P_S, P_E, P_W, INNER_AX, INNER_AY, OUTER_AX, OUTER_AY, PIVOT_X, PIVOT_Y, PIVOT_Z, HAMMER_FORCE,
    DISK_X, DISK_Y, RING_X, RING_Y, SPIN_RATE, KEYPHASOR, DRIVE_TORQUE, MAGNET_X, MAGNET_Y,
    KINETIC, GRAVITY, MAGNETIC, HOUSE, CONTACT, ANGULAR_X, ANGULAR_Y, ANGULAR_Z, HOUSE_X, HOUSE_Y,
) = range(N_OBSERVED)  # fmt: skip

TRUTH = {
    "state": tuple(signal.name for signal in STATE),
    "contact": ("penetration", "penetration_rate", "normal_force", "friction_force", "sliding_speed", "onset_speed"),
    "forces": (
        "P_N", "P_S", "P_E", "P_W", "pivot_x", "pivot_y", "pivot_z",
        "magnet_x", "magnet_y", "hammer_force", "drive_torque",
    ),
    "energy": (
        "kinetic_energy", "gravity_energy", "magnet_energy", "house_energy", "contact_energy",
        "drive_work", "hammer_work", "unbalance_work", "gap_work", "release_work",
        "bearing_loss", "house_loss", "contact_loss", "friction_loss",
    ),
}  # fmt: skip
"""Columns of each truth table that is published beside the sensors."""
