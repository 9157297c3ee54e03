"""Problem that our engines and other authors' solvers receive, and the distance of two solutions of it.

It contains the kernels' own numbers (`Constants`, `Inputs`), so that all methods share one model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rig.physics.kernels.constants import Constants, Inputs
from rig.physics.kernels.laws.contact import EXACT
from rig.physics.kernels.signals import STATE_SCALE

ERROR_COLUMNS = (0, 1, 3, 4, 7, 8, 9)
"""States in the error: both tilts, the inner housing, the rates of the tilts and the spin."""
ERROR_SCALE = STATE_SCALE[list(ERROR_COLUMNS)]
"""Their scales [rad, rad, m, m, rad/s, rad/s, rad/s]."""


@dataclass(frozen=True)
class Problem:
    """Window of a scene from its start.

    Attributes:
        name: Name of the scene.
        constants: Model; `levels.friction` is the friction law, and a `contact.damping_factor` of 0 excludes the
            memory.
        inputs: Hammer, drive and magnets, constant over the window.
        y0: State at the start, shape (14,).
        phase: Contact phase at the start (`rig.physics.kernels.laws.contact`).
        onset_speed: v0 of a contact at the start [m/s].
        times: Instants of the required states [s], ascending from 0, shape (n,); the last is the window's end.
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
        """Whether the friction law is Coulomb's set-valued law; otherwise the state determines the friction."""
        return self.constants.levels.friction == EXACT

    @property
    def pulse(self) -> tuple[float, float] | None:
        """Start and end of the hammer pulse [s], if it overlaps the window."""
        inputs = self.inputs
        begin, end = inputs.hammer_start * inputs.tick_s, inputs.hammer_end * inputs.tick_s
        if inputs.hammer_force == 0.0 or end <= max(begin, 0.0) or begin >= self.duration_s:
            return None
        return begin, end

    @property
    def corners(self) -> tuple[float, ...]:
        """Instants inside the window at which the hammer force has a corner [s]."""
        return tuple(t for t in self.pulse or () if 0.0 < t < self.duration_s)


def scaled_error(states: np.ndarray, reference: np.ndarray) -> float:
    """Return the distance of two runs of a problem: RMS of the scaled states of `ERROR_COLUMNS` over all instants.

    Args:
        states: States, shape (n, 14).
        reference: States, shape (n, 14).
    """
    columns = list(ERROR_COLUMNS)
    distance = (states[:, columns] - reference[:, columns]) / ERROR_SCALE
    return float(np.sqrt(np.mean(distance * distance)))
