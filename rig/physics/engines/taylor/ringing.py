"""Ringing of the housings in free flight as a sum of their modes, without steps.

In flight only their own beams and transducers act on the housings, and these are linear up to the loss of a preload. A
series may then be of the shaft alone, and as long as a hundred series that follow the ringing, while the shaft's
distance from the ring exceeds the ring's motion. Disabled unless an engine calls `set_modes`.
"""

from __future__ import annotations

import math

import numpy as np

from rig.physics.engines.taylor.memory import RINGING
from rig.physics.kernels import signals as S
from rig.physics.kernels.constants import House
from rig.physics.kernels.stage import kernel

_MAX_MODE_CONDITION = 1e6
"""Largest condition number of the mode matrix: above it, two modes are nearly equal and the rest is inaccurate."""
_MIN_SHIFT_M = 1e-16
"""Minimum amplitude of the inner housing for ringing [m]."""
_MIN_ANGLE = 3.0
"""Minimum angle of the fastest mode until a possible contact [rad]; below it a series follows the ringing."""

RINGS, _MAX_RATE, _AMPLITUDE, _ENERGY = (RINGING + 1 + k for k in range(4))
"""Flag of known modes; rate of the fastest [rad/s]; largest displacement of the ring [m]; energy at the start [J]."""
_MOMENTUM, _BODIES, _COUNT, _MODES = RINGING + 5, RINGING + 7, RINGING + 15, RINGING + 17
"""By direction, x and y: momentum at the start [N s]; masses [kg] and stiffnesses [N/m], inner and outer; number of
modes; their numbers."""
_DECAY, _FREQUENCY, _STATE, _SHARE, _MODE_PARTS, _MODE_SIZE = 0, 4, 8, 40, 72, 104
"""Offsets, of up to four modes: real and imaginary parts of the rates [1/s]; state by mode, mode by state and state at
the start by mode, as pairs of real and imaginary part; size. The state: displacements [m] and speeds [m/s], inner and
outer."""


def set_modes(house: House, matrices: np.ndarray, memory: np.ndarray) -> None:
    """Store the modes of the housings.

    Args:
        house: Housing constants.
        matrices: State matrices of the housings in x and y, shape (2, 4, 4): displacements and speeds, inner and outer.
        memory: Memory of the engine.
    """
    stiffness = (
        (house.inner_beam_stiffness, house.pair_stiffness_horizontal),
        (house.pair_stiffness_vertical, house.outer_beam_stiffness),
    )
    for direction, moving in enumerate(matrices):
        matrix = moving.copy()
        for body in range(2):
            if not moving[2 + body].any():
                # A fixed housing stays at 0 with any decay; a double mode at 0 would have no basis.
                matrix[body, 2 + body], matrix[body, body], matrix[2 + body, 2 + body] = 0.0, -1.0, -2.0
        rates, modes = (each.astype(complex) for each in np.linalg.eig(matrix))
        if not np.linalg.cond(modes) < _MAX_MODE_CONDITION:
            return
        kept = rates.imag >= 0.0
        # The state is the real part: one of two conjugate modes counts twice.
        states, shares = modes[:, kept] * np.where(rates[kept].imag > 0.0, 2.0, 1.0), np.linalg.inv(modes)[kept]
        first, count = _MODES + direction * _MODE_SIZE, int(kept.sum())
        memory[first + _DECAY : first + _DECAY + count] = np.minimum(rates[kept].real, 0.0)
        memory[first + _FREQUENCY : first + _FREQUENCY + count] = rates[kept].imag
        memory[first + _STATE : first + _STATE + 8 * count] = np.ascontiguousarray(states.T).view(float).ravel()
        memory[first + _SHARE : first + _SHARE + 8 * count] = np.ascontiguousarray(shares).view(float).ravel()
        memory[_COUNT + direction] = count
        memory[_MAX_RATE] = max(memory[_MAX_RATE], abs(rates).max())
        masses = (house.inner_mass, house.outer_mass)
        memory[_BODIES + 4 * direction : _BODIES + 4 * direction + 4] = masses + stiffness[direction]
    memory[RINGS] = 1.0


@kernel
def _state_rows(direction):
    """Return the positions of a direction's displacements and speeds in the state."""
    return (S.X_IH, S.X_OH, S.VX_IH, S.VX_OH) if direction == 0 else (S.Y_IH, S.Y_OH, S.VY_IH, S.VY_OH)


@kernel
def _compute_energy_and_momentum(memory, direction, x):
    """Return energy [J] and momentum [N s] of the housings in a direction."""
    qi, qo, vi, vo = _state_rows(direction)
    body = _BODIES + 4 * direction
    mi, mo, ki, ko = memory[body], memory[body + 1], memory[body + 2], memory[body + 3]
    stretch = x[qi] - x[qo]
    energy = 0.5 * (mi * x[vi] * x[vi] + mo * x[vo] * x[vo] + ki * stretch * stretch + ko * x[qo] * x[qo])
    return energy, mi * x[vi] + mo * x[vo]


@kernel
def _bound_ringing(memory, direction):
    """Return bounds of the ringing: displacements of the inner and outer housing, and their difference [m]."""
    first = _MODES + direction * _MODE_SIZE
    inner = outer = apart = 0.0
    for k in range(int(memory[_COUNT + direction])):
        at = first + _MODE_PARTS + 8 * k
        inner += math.hypot(memory[at], memory[at + 1])
        outer += math.hypot(memory[at + 2], memory[at + 3])
        apart += math.hypot(memory[at] - memory[at + 2], memory[at + 1] - memory[at + 3])
    return inner, outer, apart


@kernel
def _split_into_modes(memory, direction, x):
    """Compute the modes' parts of a state."""
    first, rows = _MODES + direction * _MODE_SIZE, _state_rows(direction)
    for k in range(int(memory[_COUNT + direction])):
        real = imaginary = 0.0
        for c in range(4):
            share = first + _SHARE + 8 * k + 2 * c
            real += memory[share] * x[rows[c]]
            imaginary += memory[share + 1] * x[rows[c]]
        for c in range(4):
            state, now = first + _STATE + 8 * k + 2 * c, first + _MODE_PARTS + 8 * k + 2 * c
            memory[now] = real * memory[state] - imaginary * memory[state + 1]
            memory[now + 1] = real * memory[state + 1] + imaginary * memory[state]


@kernel
def start_ringing(constants, memory, x, depth, rate):
    """Remove the ringing of the housings from a state in flight, unless contact or a lost preload is near.

    Args:
        constants: Model constants.
        memory: Memory of the engine.
        x: State, in and out.
        depth: Penetration with housings at rest [m].
        rate: Its rate [m/s].

    Returns:
        True if the housings ring by their modes from now on.
    """
    house, both = constants.house, constants.contact.gap_counts_outer
    shift, limit = 0.0, 2.0 * house.preload
    for direction in range(2):
        _split_into_modes(memory, direction, x)
        inner, outer, apart = _bound_ringing(memory, direction)
        shift = math.hypot(shift, inner + both * outer)
        unloads = house.pair_stiffness_vertical * apart if direction else house.pair_stiffness_horizontal * outer
        if not unloads < limit:
            return False
    clear = -depth - shift
    if shift < _MIN_SHIFT_M or not clear * memory[_MAX_RATE] > _MIN_ANGLE * max(rate, 0.0) or not clear > 0.0:
        return False
    memory[_AMPLITUDE], memory[_ENERGY] = shift, 0.0
    for direction in range(2):
        energy, memory[_MOMENTUM + direction] = _compute_energy_and_momentum(memory, direction, x)
        memory[_ENERGY] += energy
        for row in _state_rows(direction):
            x[row] = 0.0
    memory[RINGING] = 1.0
    return True


@kernel
def add_clearance_margin(constants, memory, Y, column):
    """Shift the contact's event function by the largest displacement of the ring."""
    shift = memory[_AMPLITUDE]
    Y[0, column] -= shift * (2.0 * constants.contact.clearance - shift)


@kernel
def add_ringing(memory, time, x):
    """Add the housings' motion, loss and impulse at a time [s] after the start to the shaft's state."""
    loss = memory[_ENERGY]
    for direction in range(2):
        first, rows = _MODES + direction * _MODE_SIZE, _state_rows(direction)
        for k in range(int(memory[_COUNT + direction])):
            size, angle = math.exp(memory[first + _DECAY + k] * time), memory[first + _FREQUENCY + k] * time
            real, imaginary = size * math.cos(angle), size * math.sin(angle)
            for c in range(4):
                now = first + _MODE_PARTS + 8 * k + 2 * c
                x[rows[c]] += real * memory[now] - imaginary * memory[now + 1]
        energy, momentum = _compute_energy_and_momentum(memory, direction, x)
        loss -= energy
        x[S.HOUSE_IMPULSE_X if direction == 0 else S.HOUSE_IMPULSE_Y] += momentum - memory[_MOMENTUM + direction]
    x[S.HOUSE_LOSS] += loss
