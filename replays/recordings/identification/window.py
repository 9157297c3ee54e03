"""Distance of a set of values from the recording over a window, in units of the sensors' noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from replays.recordings.identification.request import Question
from replays.recordings.resimulation.sensitivity import Predictor
from rig.base.errors import InputError, SimulationError

_STEP_SIGMAS = 0.5
_MIN_VARIANCE = 1e-20
"""Variance below which difference quotients would be dominated by rounding."""


class Window:
    """Samples from the start of the question to some time, and their prediction.

    Values are given as `z`: distances from the start of the search in scales, shape (unknowns,). What is uncertain is
    part of the noise: residuals and slopes are whitened with its covariance.

    Attributes:
        question: The request.
        end_s: End of the window, simulated [s].
        rows: Number of rows.
    """

    def __init__(self, question: Question, end_s: float, unsure: Sequence[np.ndarray] = ()) -> None:
        """Predict a window.

        Args:
            question: The request.
            end_s: End of the window [s].
            unsure: Effects of one standard deviation of each uncertainty, over the noise, each shape (rows, channels).
        """
        self.question = question
        self.end_s = end_s
        observation = question.observation
        self.rows = observation.count_rows(end_s)
        self._predictor = Predictor(question.experiment, question.keys, observation.select_parts(self.rows))
        self._start = np.array([unknown.start for unknown in question.unknowns])
        self._scale = np.array([unknown.scale for unknown in question.unknowns])
        parts = self._predictor.parts
        self._measured = observation.values[: self.rows] / observation.noise
        if any(part.spectra for part in parts.values()):
            self._measured = self._over_noise({name: part.values for name, part in parts.items()})
        self.valid = np.isfinite(self._measured)
        effects = np.reshape([np.where(self.valid, one, 0.0) for one in unsure], (len(unsure), self._measured.size))
        self._unsure, sizes, _ = np.linalg.svd(effects.T, full_matrices=False)
        self._shrink = 1.0 - 1.0 / np.hypot(1.0, sizes)

    @property
    def runs(self) -> int:
        """Number of simulations."""
        return self._predictor.runs

    def values(self, z: np.ndarray) -> np.ndarray:
        """Return the values in their units, shape (unknowns,)."""
        return self._start + z * self._scale

    def predicted(self, z: np.ndarray) -> np.ndarray:
        """Return the predicted channels without noise, in units of the noise, shape (rows, channels).

        Raises:
            InputError: The model rejects a value.
            SimulationError: The state became non-finite.
        """
        prediction = self._predictor.predict(self.values(z))
        return self._over_noise(prediction.values)

    def residuals(self, z: np.ndarray) -> np.ndarray:
        """Return measured minus predicted over the noise, 0 for lost samples, shape (rows, channels)."""
        return self._whiten(np.where(self.valid, self._measured - self.predicted(z), 0.0))

    def residuals_or_none(self, z: np.ndarray) -> np.ndarray | None:
        """Return the residuals; None if the model rejects the values."""
        try:
            return self.residuals(z)
        except (InputError, SimulationError):
            return None

    def slopes(self, z: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Return d predicted / d z, shape (rows, channels, unknowns).

        Central differences are taken along the principal directions of the covariance, half a standard deviation to
        each side. If two values have nearly equal effects, differences along them would differ only
        by their errors, which would appear as information.

        Args:
            z: Point of the derivative, shape (unknowns,).
            covariance: Covariance of z, shape (unknowns, unknowns).
        """
        sizes, directions = np.linalg.eigh(covariance)
        whitened = []
        for size, direction in zip(sizes, directions.T, strict=True):
            change = _STEP_SIGMAS * np.sqrt(max(size, _MIN_VARIANCE)) * direction
            (above, up), (below, down) = (self._side(z, sign * change) for sign in (1.0, -1.0))
            width = float((above - below) @ direction)
            if width == 0.0:
                raise InputError("start", "values with room for a change", self.values(z).tolist())
            whitened.append(np.where(self.valid, (up - down) / width, 0.0))
        return np.einsum("nck,pk->ncp", np.stack(whitened, axis=-1), directions)

    def slopes_by_keys(self, z: np.ndarray) -> np.ndarray:
        """Return the slopes by each value alone, in the predictor's own steps, shape (rows, channels, unknowns)."""
        slopes = self._predictor.derivatives(self.values(z)).slopes
        columns = [self._over_noise(one) * scale for one, scale in zip(slopes, self._scale, strict=True)]
        return self._whiten(np.nan_to_num(np.stack(columns, axis=-1)))

    def _whiten(self, values: np.ndarray) -> np.ndarray:
        """Return values over the noise, shape (rows, channels, ...), less what the uncertainties may cause."""
        flat = values.reshape(len(self._unsure), -1)
        return values - (self._unsure @ (self._shrink[:, None] * (self._unsure.T @ flat))).reshape(values.shape)

    def _over_noise(self, values: dict[str, np.ndarray]) -> np.ndarray:
        """Return values by group as one table over the noise, filtered so that it is white, shape (rows, channels)."""
        observation, parts = self.question.observation, self._predictor.parts
        white = {name: parts[name].whiten(one) for name, one in values.items()}
        return observation.tabulate(white, self.rows) / observation.noise

    def _side(self, z: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a point near z and the prediction there; z itself if the model rejects the point."""
        try:
            return z + change, self.predicted(z + change)
        except (InputError, SimulationError):
            return z, self.predicted(z)
