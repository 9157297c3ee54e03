"""A problem that our engines and other people's solvers are both given, and the distance of two solutions of it.

It holds the kernels' own numbers (`Constants`, `Inputs`), so that there is one model and only the method differs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rig.physics.kernels.constants import Constants, Inputs
from rig.physics.kernels.laws.contact import EXACT
from rig.physics.kernels.signals import STATE_SCALE

ERROR_COLUMNS = (0, 1, 3, 4, 7, 8, 9)
"""States that an error is made of: both tilts, the inner house, the rates of the tilts and the spin."""
ERROR_SCALE = STATE_SCALE[list(ERROR_COLUMNS)]
"""Their scales [rad, rad, m, m, rad/s, rad/s, rad/s]."""


@dataclass(frozen=True)
class Problem:
    """One window of a scene, from its start.

    Attributes:
        name: Name of the scene.
        constants: The model; `levels.friction` is the friction law, `contact.damping_factor` 0 leaves the memory out.
        inputs: Hammer, drive and magnets, the same over the whole window.
        y0: State at the start, shape (14,).
        phase: Phase of the contact at the start (`rig.physics.kernels.laws.contact`).
        onset_speed: v0 of a contact that is running at the start [m/s].
        times: Instants at which states are wanted [s], ascending from 0, shape (n,); the last is the window's end.
    """

    name: str
    constants: Constants
    inputs: Inputs
    y0: np.ndarray
    phase: int
    onset_speed: float
    times: np.ndarray

    @property
    def duration_s(self) -> float:
        """Length of the window [s]."""
        return float(self.times[-1])

    @property
    def exact_friction(self) -> bool:
        """Coulomb's set-valued law; else a law that the state alone decides."""
        return self.constants.levels.friction == EXACT

    @property
    def pulse(self) -> tuple[float, float] | None:
        """Start and end of the hammer's pulse [s], where any of it lies inside the window."""
        inputs = self.inputs
        begin, end = inputs.hammer_start * inputs.tick_s, inputs.hammer_end * inputs.tick_s
        if inputs.hammer_force == 0.0 or end <= max(begin, 0.0) or begin >= self.duration_s:
            return None
        return begin, end

    @property
    def corners(self) -> tuple[float, ...]:
        """Instants inside the window where the hammer's force has a corner [s]."""
        return tuple(t for t in self.pulse or () if 0.0 < t < self.duration_s)


def scaled_error(states: np.ndarray, reference: np.ndarray) -> float:
    """Distance of two runs of one problem: RMS over all instants of the scaled states of `ERROR_COLUMNS`.

    Args:
        states: Shape (n, 14).
        reference: Shape (n, 14).
    """
    columns = list(ERROR_COLUMNS)
    distance = (states[:, columns] - reference[:, columns]) / ERROR_SCALE
    return float(np.sqrt(np.mean(distance * distance)))
