"""How far a set of values is from the recording, over a stretch of it, in units of the sensors' noise."""

from __future__ import annotations

import numpy as np

from replays.recordings.identification.request import Question
from replays.recordings.resimulation.sensitivity import Predictor
from rig.base.errors import InputError, SimulationError

_STEP_SIGMAS = 0.5
_LEAST_VARIANCE = 1e-20
"""Finer steps than the root of this would show rounding."""


class Window:
    """The samples from the start of the question to some time, and what the model makes of them.

    Values are given as `z`: distances from where the search began, in scales, shape (unknowns,).

    Attributes:
        question: What is asked.
        end_s: End of the window, simulated [s].
        rows: Rows in it.
    """

    def __init__(self, question: Question, end_s: float) -> None:
        self.question = question
        self.end_s = end_s
        observation = question.observation
        self.rows = observation.until(end_s)
        self._predictor = Predictor(question.experiment, question.keys, observation.parts_until(self.rows))
        self._start = np.array([unknown.start for unknown in question.unknowns])
        self._scale = np.array([unknown.scale for unknown in question.unknowns])
        self._measured = observation.values[: self.rows] / observation.noise
        self.known = np.isfinite(self._measured)

    @property
    def runs(self) -> int:
        """Simulations so far."""
        return self._predictor.runs

    def values(self, z: np.ndarray) -> np.ndarray:
        """The values themselves, each in its unit."""
        return self._start + z * self._scale

    def predicted(self, z: np.ndarray) -> np.ndarray:
        """What the channels show without noise, in units of it, shape (rows, channels).

        Raises:
            InputError: A value that the model does not take.
            SimulationError: The state became non-finite.
        """
        observation = self.question.observation
        found = self._predictor.predict(self.values(z))
        return observation.placed(found.values, self.rows) / observation.noise

    def residuals(self, z: np.ndarray) -> np.ndarray:
        """Measured less predicted, in units of the noise, 0 where a sample was lost, shape (rows, channels)."""
        return np.where(self.known, self._measured - self.predicted(z), 0.0)

    def residuals_or_none(self, z: np.ndarray) -> np.ndarray | None:
        """The same; None where the model does not take the values."""
        try:
            return self.residuals(z)
        except (InputError, SimulationError):
            return None

    def slopes(self, z: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """D predicted / d z, shape (rows, channels, unknowns).

        By central differences along the principal directions of what is known, each over half a standard deviation to
        either side. Where values act almost alike, quotients along the values themselves would be the same but for
        their errors, and these would pass for information.

        Args:
            z: Where.
            covariance: Of z, shape (unknowns, unknowns).
        """
        sizes, directions = np.linalg.eigh(covariance)
        whitened = []
        for size, direction in zip(sizes, directions.T, strict=True):
            change = _STEP_SIGMAS * np.sqrt(max(size, _LEAST_VARIANCE)) * direction
            (above, up), (below, down) = (self._side(z, sign * change) for sign in (1.0, -1.0))
            width = float((above - below) @ direction)
            if width == 0.0:
                raise InputError("start", "values with room for a change", self.values(z).tolist())
            whitened.append(np.where(self.known, (up - down) / width, 0.0))
        return np.einsum("nck,pk->ncp", np.stack(whitened, axis=-1), directions)

    def slopes_by_keys(self, z: np.ndarray) -> np.ndarray:
        """The same by each value alone, in the predictor's own steps, shape (rows, channels, unknowns)."""
        observation = self.question.observation
        found = self._predictor.derivatives(self.values(z)).slopes
        columns = [observation.placed(one, self.rows) * s for one, s in zip(found, self._scale, strict=True)]
        return np.nan_to_num(np.stack(columns, axis=-1) / observation.noise[:, None])

    def _side(self, z: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A point beside z and what is predicted there; z itself where the model does not take it."""
        try:
            return z + change, self.predicted(z + change)
        except (InputError, SimulationError):
            return z, self.predicted(z)
