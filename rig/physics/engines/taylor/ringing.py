"""Housings in free flight: they ring by themselves, as sums of their modes, and ask for no steps.

Nothing acts on them there but their own beams and transducers, which are linear up to the loss of a preload. A series
in flight may then be of the shaft alone: as long as a hundred that follow the ringing. It is, while the shaft is
farther from the ring than the ringing can move that. Off unless an engine calls `set_modes`.
"""

from __future__ import annotations

import math

import numpy as np

from rig.physics.engines.taylor.place import RINGING
from rig.physics.kernels import signals as S
from rig.physics.kernels.constants import House
from rig.physics.kernels.stage import kernel

_WORST_CONDITION = 1e6
"""Condition of the matrix of modes above which it says too little: two modes are nearly the same."""
_LEAST_M = 1e-16
"""Amplitude of the inner house below which it does not ring."""
_LEAST_ANGLE = 3.0
"""Angle that the fastest mode turns by until the shaft may touch, below which a series follows the ringing."""

RINGS, _FASTEST, _AMPLITUDE, _ENERGY = (RINGING + 1 + k for k in range(4))
"""A mark that the modes are known; rate of the fastest [rad/s]; largest shift of the ring [m]; energy at the start
[J]."""
_MOMENTUM, _BODIES, _COUNT, _MODES = RINGING + 5, RINGING + 7, RINGING + 15, RINGING + 17
"""By direction, x and y: momentum at the start [N s]; masses [kg] and stiffnesses [N/m], inner and outer; number of
modes; their numbers."""
_DECAY, _TURN, _STATE, _SHARE, _NOW, _SIZE = 0, 4, 8, 40, 72, 104
"""Of up to four modes: real and imaginary parts of the rates [1/s]; state by mode, mode by state and state at the start
by mode, complex numbers as pairs. The state: displacements [m] and speeds [m/s], inner and outer."""


def set_modes(house: House, matrices: np.ndarray, memory: np.ndarray) -> None:
    """Enter the modes of the housings.

    Args:
        house: Its numbers.
        matrices: Rates of displacements and speeds, inner and outer, by these, of x and y, shape (2, 4, 4).
        memory: Of the engine.
    """
    stiffness = (
        (house.inner_beam_stiffness, house.pair_stiffness_horizontal),
        (house.pair_stiffness_vertical, house.outer_beam_stiffness),
    )
    for direction, moving in enumerate(matrices):
        matrix = moving.copy()
        for body in range(2):
            if not moving[2 + body].any():
                # It does not move: a state of 0 stays so by any decay, and a double mode at 0 has no basis.
                matrix[body, 2 + body], matrix[body, body], matrix[2 + body, 2 + body] = 0.0, -1.0, -2.0
        rates, modes = (each.astype(complex) for each in np.linalg.eig(matrix))
        if not np.linalg.cond(modes) < _WORST_CONDITION:
            return
        kept = rates.imag >= 0.0
        # One of two conjugate modes counts twice: the state is the real part.
        states, shares = modes[:, kept] * np.where(rates[kept].imag > 0.0, 2.0, 1.0), np.linalg.inv(modes)[kept]
        first, count = _MODES + direction * _SIZE, int(kept.sum())
        memory[first + _DECAY : first + _DECAY + count] = np.minimum(rates[kept].real, 0.0)
        memory[first + _TURN : first + _TURN + count] = rates[kept].imag
        memory[first + _STATE : first + _STATE + 8 * count] = np.ascontiguousarray(states.T).view(float).ravel()
        memory[first + _SHARE : first + _SHARE + 8 * count] = np.ascontiguousarray(shares).view(float).ravel()
        memory[_COUNT + direction] = count
        memory[_FASTEST] = max(memory[_FASTEST], abs(rates).max())
        masses = (house.inner_mass, house.outer_mass)
        memory[_BODIES + 4 * direction : _BODIES + 4 * direction + 4] = masses + stiffness[direction]
    memory[RINGS] = 1.0


@kernel
def _rows_of(direction):
    """Positions of a direction's displacements and speeds in the state."""
    return (S.X_IH, S.X_OH, S.VX_IH, S.VX_OH) if direction == 0 else (S.Y_IH, S.Y_OH, S.VY_IH, S.VY_OH)


@kernel
def _energy_and_momentum(memory, direction, x):
    """Energy [J] and momentum [N s] of the housings in a direction."""
    qi, qo, vi, vo = _rows_of(direction)
    body = _BODIES + 4 * direction
    mi, mo, ki, ko = memory[body], memory[body + 1], memory[body + 2], memory[body + 3]
    stretch = x[qi] - x[qo]
    energy = 0.5 * (mi * x[vi] * x[vi] + mo * x[vo] * x[vo] + ki * stretch * stretch + ko * x[qo] * x[qo])
    return energy, mi * x[vi] + mo * x[vo]


@kernel
def _bounds(memory, direction):
    """Return bounds on the ringing: displacements of the inner and outer house, and their difference [m]."""
    first = _MODES + direction * _SIZE
    inner = outer = apart = 0.0
    for k in range(int(memory[_COUNT + direction])):
        at = first + _NOW + 8 * k
        inner += math.hypot(memory[at], memory[at + 1])
        outer += math.hypot(memory[at + 2], memory[at + 3])
        apart += math.hypot(memory[at] - memory[at + 2], memory[at + 1] - memory[at + 3])
    return inner, outer, apart


@kernel
def _take_modes(memory, direction, x):
    """The modes' parts of a state."""
    first, rows = _MODES + direction * _SIZE, _rows_of(direction)
    for k in range(int(memory[_COUNT + direction])):
        real = imaginary = 0.0
        for c in range(4):
            share = first + _SHARE + 8 * k + 2 * c
            real += memory[share] * x[rows[c]]
            imaginary += memory[share + 1] * x[rows[c]]
        for c in range(4):
            state, now = first + _STATE + 8 * k + 2 * c, first + _NOW + 8 * k + 2 * c
            memory[now] = real * memory[state] - imaginary * memory[state + 1]
            memory[now + 1] = real * memory[state + 1] + imaginary * memory[state]


@kernel
def let_ring(constants, memory, x, depth, rate):
    """Take the housings out of a state in flight, if they ring and neither contact nor a lost preload is near.

    Args:
        constants: Numbers of the model.
        memory: Of the engine.
        x: State, in and out.
        depth: Penetration with housings at rest [m].
        rate: Its rate [m/s].

    Returns:
        True where they ring from now on by their modes.
    """
    house, both = constants.house, constants.contact.gap_counts_outer
    shift, limit = 0.0, 2.0 * house.preload
    for direction in range(2):
        _take_modes(memory, direction, x)
        inner, outer, apart = _bounds(memory, direction)
        shift = math.hypot(shift, inner + both * outer)
        unloads = house.pair_stiffness_vertical * apart if direction else house.pair_stiffness_horizontal * outer
        if not unloads < limit:
            return False
    clear = -depth - shift
    if shift < _LEAST_M or not clear * memory[_FASTEST] > _LEAST_ANGLE * max(rate, 0.0) or not clear > 0.0:
        return False
    memory[_AMPLITUDE], memory[_ENERGY] = shift, 0.0
    for direction in range(2):
        energy, memory[_MOMENTUM + direction] = _energy_and_momentum(memory, direction, x)
        memory[_ENERGY] += energy
        for row in _rows_of(direction):
            x[row] = 0.0
    memory[RINGING] = 1.0
    return True


@kernel
def keep_clear(constants, memory, Y, column):
    """Make what falls through 0 at the ring do so where the ringing may move that."""
    shift = memory[_AMPLITUDE]
    Y[0, column] -= shift * (2.0 * constants.contact.clearance - shift)


@kernel
def add_ringing(memory, time, x):
    """Add the housings at a time [s] after the start to the shaft's state, and their loss and impulse."""
    loss = memory[_ENERGY]
    for direction in range(2):
        first, rows = _MODES + direction * _SIZE, _rows_of(direction)
        for k in range(int(memory[_COUNT + direction])):
            size, angle = math.exp(memory[first + _DECAY + k] * time), memory[first + _TURN + k] * time
            real, imaginary = size * math.cos(angle), size * math.sin(angle)
            for c in range(4):
                now = first + _NOW + 8 * k + 2 * c
                x[rows[c]] += real * memory[now] - imaginary * memory[now + 1]
        energy, momentum = _energy_and_momentum(memory, direction, x)
        loss -= energy
        x[S.HOUSE_IMPULSE_X if direction == 0 else S.HOUSE_IMPULSE_Y] += momentum - memory[_MOMENTUM + direction]
    x[S.HOUSE_LOSS] += loss
