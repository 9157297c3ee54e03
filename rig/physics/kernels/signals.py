"""Columns of the row that an engine writes at every observed instant: order, units and meaning.

The first columns are the state, then the observed quantities of that instant and the ledger: stored momenta and
energies, and the running integral of every torque, force and power. Each line below adds a column and names its
position for the kernels: `dy[GAMMA_RATE]` in the integrated vector, `out[P_N]` in the observed part.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Signal(NamedTuple):
    """Column of the row."""

    name: str
    unit: str
    label: str
    scale: float = 0.0
    """Unit of the scaled error of a state, in its SI unit."""


class _Table:
    """Ordered columns; a call adds one and returns its position."""

    def __init__(self, first: int = 0) -> None:
        self.signals: list[Signal] = []
        self._first = first

    def __call__(self, name: str, unit: str, label: str, scale: float = 0.0) -> int:
        self.signals.append(Signal(name, unit, label, scale))
        return self._first + len(self.signals) - 1


_state = _Table()
GAMMA = _state("Gamma", "rad", "Shaft rotation about x", scale=5e-3)
BETA = _state("beta", "rad", "Shaft rotation about the turned y axis", scale=5e-3)
THETA = _state("theta", "rad", "Spin angle", scale=1.0)
X_IH = _state("x_ih", "m", "Inner house, horizontal (EAST +)", scale=2e-5)
Y_IH = _state("y_ih", "m", "Inner house, vertical (up +)", scale=2e-5)
X_OH = _state("x_oh", "m", "Outer house, horizontal (EAST +)", scale=2e-5)
Y_OH = _state("y_oh", "m", "Outer house, vertical (up +)", scale=2e-5)
GAMMA_RATE = _state("Gamma_rate", "rad/s", "Rate of Gamma", scale=1.0)
BETA_RATE = _state("beta_rate", "rad/s", "Rate of beta", scale=1.0)
THETA_RATE = _state("theta_rate", "rad/s", "Rate of theta", scale=40.0)
VX_IH = _state("vx_ih", "m/s", "Inner house velocity, horizontal", scale=0.1)
VY_IH = _state("vy_ih", "m/s", "Inner house velocity, vertical", scale=0.1)
VX_OH = _state("vx_oh", "m/s", "Outer house velocity, horizontal", scale=0.1)
VY_OH = _state("vy_oh", "m/s", "Outer house velocity, vertical", scale=0.1)

STATE = tuple(_state.signals)
"""Generalised coordinates and their rates, in the order of the state vector."""
N_STATE = len(STATE)
STATE_SCALE = np.array([signal.scale for signal in STATE])
"""Unit of each state's scaled error, in its SI unit, shape (N_STATE,)."""

_integral = _Table(N_STATE)
DRIVE_WORK = _integral("drive_work", "J", "Work done by the drive torque")
HAMMER_WORK = _integral("hammer_work", "J", "Work done by the hammer")
UNBALANCE_WORK = _integral("unbalance_work", "J", "Work done by the unbalance force")
GAP_WORK = _integral("gap_work", "J", "Energy made by a gap that counts the outer house (as printed); else 0")
RELEASE_WORK = _integral("release_work", "J", "Energy taken out by switching the magnets")
BEARING_LOSS = _integral("bearing_loss", "J", "Dissipated by the damping at the magnets")
HOUSE_LOSS = _integral("house_loss", "J", "Dissipated by the beams of the houses")
CONTACT_LOSS = _integral("contact_loss", "J", "Dissipated by the normal contact law")
FRICTION_LOSS = _integral("friction_loss", "J", "Dissipated by friction")
CONTACT_IMPULSE = _integral("contact_impulse", "N s", "Integral of the normal force")
ANGULAR_IMPULSE_X = _integral("angular_impulse_x", "N m s", "Integral of all torques about the pivot, x")
ANGULAR_IMPULSE_Y = _integral("angular_impulse_y", "N m s", "Integral of all torques about the pivot, y")
ANGULAR_IMPULSE_Z = _integral("angular_impulse_z", "N m s", "Integral of all torques about the pivot, z")
HOUSE_IMPULSE_X = _integral("house_impulse_x", "N s", "Integral of the forces on both houses, x")
HOUSE_IMPULSE_Y = _integral("house_impulse_y", "N s", "Integral of the forces on both houses, y")

INTEGRALS = tuple(_integral.signals)
"""Running integrals, which the engine appends to the state and integrates by its own quadrature."""
N_VECTOR = N_STATE + len(INTEGRALS)
"""Length of the integrated vector: the state, then the integrals."""

_observed = _Table()
PENETRATION = _observed("penetration", "m", "Shaft into ring; negative is the gap")
PENETRATION_RATE = _observed("penetration_rate", "m/s", "Rate of the penetration")
NORMAL_FORCE = _observed("normal_force", "N", "Contact normal force")
FRICTION_FORCE = _observed("friction_force", "N", "Contact friction force against the sliding speed")
SLIDING_SPEED = _observed("sliding_speed", "m/s", "Speed of the shaft's surface along the ring")
ONSET_SPEED = _observed("onset_speed", "m/s", "Impact speed held by the running contact (after its floor)")
P_N = _observed("P_N", "N", "NORTH transducer, compression")
P_S = _observed("P_S", "N", "SOUTH transducer, compression")
P_E = _observed("P_E", "N", "EAST transducer, compression")
P_W = _observed("P_W", "N", "WEST transducer, compression")
INNER_AX = _observed("inner_ax", "m/s^2", "Inner house acceleration, horizontal")
INNER_AY = _observed("inner_ay", "m/s^2", "Inner house acceleration, vertical")
OUTER_AX = _observed("outer_ax", "m/s^2", "Outer house acceleration, horizontal")
OUTER_AY = _observed("outer_ay", "m/s^2", "Outer house acceleration, vertical")
PIVOT_X = _observed("pivot_x", "N", "Reaction of the pivot on the shaft, x (eqs. 20-21)")
PIVOT_Y = _observed("pivot_y", "N", "Reaction of the pivot on the shaft, y (eqs. 20-21)")
PIVOT_Z = _observed("pivot_z", "N", "Reaction of the pivot on the shaft, z (eqs. 20-21)")
HAMMER_FORCE = _observed("hammer_force", "N", "Hammer force along its direction")
DISK_X = _observed("disk_x", "m", "Disk, horizontal, from the line through pivot and ring centre")
DISK_Y = _observed("disk_y", "m", "Disk, vertical, from the line through pivot and ring centre")
RING_X = _observed("ring_x", "m", "Shaft in the ring, horizontal, relative to the inner house")
RING_Y = _observed("ring_y", "m", "Shaft in the ring, vertical, relative to the inner house")
SPIN_RATE = _observed("spin_rate", "rad/s", "Spin speed")
KEYPHASOR = _observed("keyphasor", "1", "1 while the mark passes the keyphasor, 0.5 on its edges")
DRIVE_TORQUE = _observed("drive_torque", "N m", "Torque of the drive")
MAGNET_X = _observed("magnet_x", "N", "Magnet force, x")
MAGNET_Y = _observed("magnet_y", "N", "Magnet force, y")
KINETIC = _observed("kinetic_energy", "J", "Shaft and houses")
GRAVITY = _observed("gravity_energy", "J", "Shaft, from the level of the pivot")
MAGNETIC = _observed("magnet_energy", "J", "Stored in the magnets, from the centre")
HOUSE = _observed("house_energy", "J", "Stored in beams and transducers, from the preloaded rest")
CONTACT = _observed("contact_energy", "J", "Stored in the contact, K delta^(n+1)/(n+1)")
ANGULAR_X = _observed("angular_momentum_x", "N m s", "Shaft about the pivot, x")
ANGULAR_Y = _observed("angular_momentum_y", "N m s", "Shaft about the pivot, y")
ANGULAR_Z = _observed("angular_momentum_z", "N m s", "Shaft about the pivot, z")
HOUSE_X = _observed("house_momentum_x", "N s", "Both houses, x")
HOUSE_Y = _observed("house_momentum_y", "N s", "Both houses, y")

OBSERVED = tuple(_observed.signals)
"""Quantities computed from the state at one instant."""
N_OBSERVED = len(OBSERVED)

ROW = STATE + INTEGRALS + OBSERVED
N_ROW = len(ROW)
COLUMN = {signal.name: column for column, signal in enumerate(ROW)}

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
"""Columns of each truth table that is published with the sensors."""
