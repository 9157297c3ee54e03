"""What is uncertain in a log, as signals: the part of a residual that it explains is tolerated, and stated.

A filter's corner, a calibration factor or a friction law that no log shows is one number for the whole log. It is
fitted with its prior, so that it explains only a residual of its own shape: a contact that begins late, or another
contact law, has another one. A floor as wide as the largest effect of each would hide both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from replays.recordings.resimulation.prediction import Measured, Prediction
from replays.recordings.validation.trajectory import floors

_MAX_DEVIATION = 3.0
"""Largest value of an uncertain number, in standard deviations."""
_LEAST_SHOWN = 0.5
"""Least value of an uncertain number that is stated, in standard deviations."""


@dataclass(frozen=True)
class Uncertainty:
    """Something that is known up to a standard deviation.

    Attributes:
        name: What it is, with its standard deviation.
        prediction: Prediction with one standard deviation more of it.
        each: Whether it is another number for each channel.
    """

    name: str
    prediction: Prediction
    each: bool = False


@dataclass(frozen=True)
class Tolerated:
    """Part of a residual that an uncertainty explains.

    Attributes:
        name: What is uncertain, with its standard deviation.
        channel: Channel; "" for all.
        deviations: Its fitted value, in standard deviations.
        largest: Largest effect on a sample, over the noise.
    """

    name: str
    channel: str
    deviations: float
    largest: float

    @property
    def line(self) -> str:
        """The result in words."""
        where = f"{self.channel} " if self.channel else ""
        return f"{where}{self.name}: {self.deviations:+.2g} of it, up to {self.largest:.2g} times the noise"


def tolerate(
    parts: dict[str, Measured], nominal: Prediction, uncertainties: Sequence[Uncertainty], *, end_s: float
) -> tuple[dict[str, np.ndarray], list[Tolerated]]:
    """Return residuals over the noise without what is uncertain, whitened, and what was tolerated.

    Args:
        parts: Recorded channels.
        nominal: Prediction.
        uncertainties: What is uncertain.
        end_s: End of the samples [s].

    Returns:
        Residuals by group, each shape (n, channels), and what explains a part of them.
    """
    from scipy.optimize import lsq_linear

    places = [(name, c) for name, part in parts.items() for c in range(len(part.channels))]
    residuals, effects = {}, [dict[tuple[str, int], np.ndarray]() for _ in uncertainties]
    for name, part in parts.items():
        model = nominal.values[name][: part.count_rows(end_s)]
        residuals[name] = part.whiten(part.values[: len(model)] - model) / part.floor
        for effect, one in zip(effects, uncertainties, strict=True):
            moved = np.nan_to_num(part.whiten(one.prediction.values[name][: len(model)] - model) / part.floor)
            effect |= {(name, c): moved[:, c] for c, channel in enumerate(part.channels) if channel.name != "keyphasor"}
    numbers = [
        (one.name, own)
        for one, effect in zip(uncertainties, effects, strict=True)
        for own in ([{place: effect[place]} for place in effect] if one.each else [effect])
        if any(signal.any() for signal in own.values())
    ]
    square, side = np.eye(len(numbers)), np.zeros(len(numbers))
    for i, (_, own) in enumerate(numbers):
        side[i] = sum(float(signal @ np.nan_to_num(residuals[name][:, c])) for (name, c), signal in own.items())
        for k, (_, other) in enumerate(numbers[: i + 1]):
            square[i, k] += sum(float(signal @ other[place]) for place, signal in own.items() if place in other)
            square[k, i] = square[i, k]
    upper = np.linalg.cholesky(square).T
    goal = np.linalg.solve(upper.T, side)
    fitted = lsq_linear(upper, goal, bounds=(-_MAX_DEVIATION, _MAX_DEVIATION)).x if numbers else goal
    tolerated = []
    for (text, own), value in zip(numbers, fitted.tolist(), strict=True):
        for (name, c), signal in own.items():
            residuals[name][:, c] -= value * signal
        channel = parts[next(iter(own))[0]].names[next(iter(own))[1]] if len(own) < len(places) - 1 else ""
        largest = abs(value) * max(float(np.abs(signal).max()) for signal in own.values())
        if abs(value) > _LEAST_SHOWN and largest > 1.0:
            tolerated.append(Tolerated(text, channel, value, largest))
    for name, part in parts.items():
        if "keyphasor" in part.names:  # a pulse may shift by a row
            c, rows = part.names.index("keyphasor"), len(residuals[name])
            model = nominal.values[name][:rows]
            floor = floors(part, model, [one.prediction.values[name][:rows] for one in uncertainties])
            residuals[name][:, c] = (part.values[:rows, c] - model[:, c]) / floor[:, c]
    return residuals, sorted(tolerated, key=lambda one: -one.largest)
