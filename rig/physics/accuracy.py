"""Error estimate of a run by its distance from a companion run, for each quantity in its own unit.

Both runs are compared at the same instants, in windows of samples. A whirl that leads or lags in angle has different
instantaneous values although the motion is the same. A difference therefore counts only as far as it remains when both
runs are compared at the same whirl angle.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rig.physics.engines import ENGINES
from rig.physics.kernels import signals as S
from rig.physics.kernels.signals import COLUMN

COMPANION_REFINEMENT = 1.0 / 16.0
"""Companion's tolerance over engine.tolerance: their difference is then the run's own error within about 6 %."""
QUANTITIES = {
    "radius": ("whirl radius", "um", 1e6),
    "force": ("contact force", "N", 1.0),
    "frequency": ("whirl frequency", "Hz", 1.0),
    "state": ("state", "(scaled)", 1.0),
    "angle": ("whirl angle", "deg", math.degrees(1.0)),
    "spin_angle": ("spin angle", "deg", math.degrees(1.0)),
}
"""Label, unit and units per SI unit of each quantity. The two angles have no tolerance unless a limit is set."""
STATE_FACTOR = 10.0
"""Tolerance of the scaled state over engine.tolerance: the warning level of version 0.1."""
FORCE_FLOOR_N = 100.0
"""Smallest force scale [N], the default hammer's peak: a light rub must not warn of millinewtons."""
FREQUENCY_SCALE_HZ = 100.0
"""Whirl frequency scale [Hz]: the rig whirls at 40 to 130 Hz."""
_WINDOW_ROWS, _WINDOW_S = 64, 0.064
"""Minimum number and duration [s] of a window's samples; 64 ms are three turns of the slowest rolling whirl."""
_HARMONICS = np.arange(1, 5)
"""Harmonics of the whirl angle in the fit; weight and stiffness excite the first two."""
_MIN_FIT_ROWS = 30
"""Minimum number of samples for a meaningful residual of the fit's twelve coefficients."""
_MIN_WHIRL_RADIUS = 0.5
"""Minimum orbit radius that has a whirl angle, as a share of the clearance."""
_COLUMNS = [*range(S.N_STATE), COLUMN["ring_x"], COLUMN["ring_y"], COLUMN["normal_force"]]
_SCALED_STATE_COLUMNS = [2 + k for k in range(S.N_STATE) if k != S.THETA]
"""Columns of a window's differences that hold states, without the spin angle; radius and force come first."""
_MIN_GROWTH_DISTANCE, _MAX_GROWTH_DISTANCE = 1e-9, 0.1
"""Range of distances in which growth is measured: above rounding, and below where two runs are unrelated."""


def choose_companion(engine: str, tolerance: float, friction: str) -> tuple[str, float]:
    """Return engine and tolerance of the companion.

    A tolerance per step has no effect if the grid limits the step, as with `tsit5` at 1e-3: a companion of the same
    method then has the same error. Other engines are compared with the default engine, or with `rk8` where the default
    engine does not support the friction law.

    Args:
        engine: Name of the run's engine.
        tolerance: engine.tolerance of the run.
        friction: Friction law of the model.
    """
    default = next(iter(ENGINES))
    name = default if friction in ENGINES[default].frictions else "rk8"
    return name, COMPANION_REFINEMENT * (tolerance if name == engine else min(tolerance, ENGINES[name].tolerance))


@dataclass
class Accuracy:
    """Error estimate of a run.

    Attributes:
        tolerance: engine.tolerance [1].
        clearance: Radial clearance of the ring [m].
        block_s: Time between compared samples [s].
        limits: Limits that replace tolerances, by quantity, each in the quantity's unit.
        estimate: Largest distance of all states at the same instant, RMS of the scaled states (`STATE_SCALE`) [1].
        grown_per_s: Mean growth rate of a small distance [1/s].
        errors: Largest error of each of `QUANTITIES` [SI], shape (6,).
        largest_s: Start of the window of each of those errors [s], shape (6,).
        since_s: Start of the window in which a quantity exceeded its tolerance [s].
        peak_force: Largest contact force of the compared samples [N].
    """

    tolerance: float
    clearance: float
    block_s: float
    limits: dict[str, float] = field(default_factory=dict)
    estimate: float = 0.0
    grown_per_s: float = 0.0
    errors: np.ndarray = field(default_factory=lambda: np.zeros(len(QUANTITIES)))
    largest_s: np.ndarray = field(default_factory=lambda: np.zeros(len(QUANTITIES)))
    since_s: dict[str, float] = field(default_factory=dict)
    peak_force: float = 0.0
    _first: tuple[float, float] | None = None
    _window: np.ndarray = field(default_factory=lambda: np.empty((0, 1 + 2 * len(_COLUMNS))))
    _waiting: list[np.ndarray] = field(default_factory=lambda: [])

    def compare(self, rows: np.ndarray, companion: np.ndarray, times_s: np.ndarray) -> list[tuple[float, str]]:
        """Add samples of both runs.

        Args:
            rows: Observed rows, shape (n, N_ROW).
            companion: The companion's rows at the same instants, shape (n, N_ROW).
            times_s: Instants [s], shape (n,).

        Returns:
            Time [s] and text of a warning for each window in which a further quantity exceeded its tolerance.
        """
        self._waiting.append(np.concatenate([times_s[:, None], rows[:, _COLUMNS], companion[:, _COLUMNS]], axis=1))
        size, warnings = max(_WINDOW_ROWS, math.ceil(_WINDOW_S / self.block_s)), []
        if sum(map(len, self._waiting)) < size:
            return warnings
        waiting = np.concatenate(self._waiting)
        while len(waiting) >= size:
            self._window, waiting = waiting[:size], waiting[size:]
            if self._add_window(self._window):
                warnings.append((float(self._window[-1, 0]), self.warning()))
        self._waiting = [waiting]
        return warnings

    def copy_completed(self) -> Accuracy:
        """Return a copy that includes the samples of the last, incomplete window."""
        done = copy.deepcopy(self)
        done.complete()
        return done

    def complete(self) -> None:
        """Add the samples of the last, incomplete window, filled up with earlier samples."""
        if count := sum(map(len, self._waiting)):
            self._add_window(np.concatenate([self._window, *self._waiting])[-max(len(self._window), count) :])

    def document(self) -> dict[str, Any]:
        """Return the estimate as JSON: largest error, tolerance and time of excess of each quantity, in its unit."""
        tolerances = self._tolerances()
        return {
            "estimate": self.estimate,
            "growth_per_s": self.grown_per_s,
            "doubted_s": min(self.since_s.values(), default=None),
            "quantities": {
                name: {
                    "label": label,
                    "unit": unit,
                    "error": error * per_si,
                    "tolerance": self.limits.get(name, tolerances[name] * per_si if name in tolerances else None),
                    "exceeded_s": self.since_s.get(name),
                }
                for (name, (label, unit, per_si)), error in zip(QUANTITIES.items(), self.errors.tolist(), strict=True)
            },
        }

    def warning(self) -> str:
        """Return a sentence that lists the quantities above their tolerance; empty if there is none."""
        parts = [
            f"{one['label']} off by {one['error']:.2g} {one['unit']} "
            f"({'limit' if name in self.limits else 'tolerance'} {one['tolerance']:.2g}) "
            f"since {one['exceeded_s']:.3f} s, largest at {largest_s:.3f} s"
            for (name, one), largest_s in zip(self.document()["quantities"].items(), self.largest_s, strict=True)
            if one["exceeded_s"] is not None
        ]
        finer = f"engine.tolerance is now {self.tolerance:.2g}, try {self.tolerance / 10.0:.2g}"
        advice = f"differences grow by {self.grown_per_s:.3g} 1/s: {finer}, or use statistics only"
        return f"accuracy: {'; '.join(parts)}; {advice}" if parts else ""

    def _tolerances(self) -> dict[str, float]:
        """Return the tolerance of each quantity that has one [SI]."""
        scales = self.clearance, max(self.peak_force, FORCE_FLOOR_N), FREQUENCY_SCALE_HZ, STATE_FACTOR
        scaled_limits = {name: limit / QUANTITIES[name][2] for name, limit in self.limits.items()}
        return {name: self.tolerance * scale for name, scale in zip(QUANTITIES, scales, strict=False)} | scaled_limits

    def _add_window(self, window: np.ndarray) -> bool:
        """Update all estimates by one window; return whether a further quantity exceeds its tolerance."""
        # The memory order, which depends on how the run was cut, would change the last bit of sums along rows.
        window = np.ascontiguousarray(window)
        times_s, both = window[:, 0], window[:, 1:].reshape(len(window), 2, len(_COLUMNS))
        orbit, force = both[..., -3] + 1j * both[..., -2], both[..., -1:]
        radius = np.abs(orbit)
        values = np.concatenate([radius[..., None], force, both[..., : S.N_STATE] / S.STATE_SCALE], axis=-1)
        apart = np.abs(values[:, 0] - values[:, 1])
        apart[np.isnan(apart)] = math.inf
        self._note_growth(times_s, np.sqrt(np.mean(apart[:, 2:] ** 2, axis=1)))
        self.peak_force = max(self.peak_force, float(force[:, 0].max()))
        between = np.angle(orbit[:, 0] * np.conj(orbit[:, 1]))
        whirls = radius.min(axis=1) > _MIN_WHIRL_RADIUS * self.clearance
        errors = self._largest_errors(apart)
        if len(window) >= _MIN_FIT_ROWS and np.isfinite(apart).all() and (errors > self.errors[[0, 1, 3]]).any():
            phases = np.stack([np.angle(orbit), both[..., S.THETA]], axis=-1)
            (own, other), (phase, phase_other) = values.swapaxes(0, 1), phases.swapaxes(0, 1)
            same_angle = _distance_at_same_angle(own, other, phase, phase_other, times_s)
            errors = self._largest_errors(np.minimum(apart, same_angle))
        span_s = times_s[-1] - times_s[0]
        frequency = 0.0
        if whirls.all() and span_s >= 0.5 * _WINDOW_S:
            turned = np.unwrap(between)
            frequency = abs(turned[-1] - turned[0]) / (2.0 * math.pi * span_s)
        angle = np.abs(between[whirls]).max(initial=0.0)
        window_errors = np.array([errors[0], errors[1], frequency, errors[2], angle, apart[:, 2 + S.THETA].max()])
        self.largest_s = np.where(window_errors > self.errors, times_s[0], self.largest_s)
        self.errors = np.maximum(self.errors, window_errors)
        errors_by_name, tolerances = dict(zip(QUANTITIES, self.errors, strict=True)), self._tolerances()
        exceeded = [
            name
            for name, tolerance in tolerances.items()
            if errors_by_name[name] > tolerance and name not in self.since_s
        ]
        self.since_s |= dict.fromkeys(exceeded, float(times_s[0]))
        return bool(exceeded)

    def _note_growth(self, times_s: np.ndarray, distances: np.ndarray) -> None:
        """Update the largest distance of all states and its growth rate.

        Args:
            times_s: Instants [s], shape (n,).
            distances: RMS of the scaled states' differences, shape (n,).
        """
        self.estimate, begin = max(self.estimate, float(distances.max())), 0
        if self._first is None and (above := distances > _MIN_GROWTH_DISTANCE).any():
            begin = int(np.argmax(above)) + 1
            self._first = float(times_s[begin - 1]), float(distances[begin - 1])
        if self._first is not None:
            grown = np.flatnonzero((distances[begin:] > self._first[1]) & (distances[begin:] < _MAX_GROWTH_DISTANCE))
            if len(grown):
                last = begin + int(grown[-1])
                self.grown_per_s = math.log(distances[last] / self._first[1]) / float(times_s[last] - self._first[0])

    @staticmethod
    def _largest_errors(apart: np.ndarray) -> np.ndarray:
        """Return the largest error of radius [m], force [N] and scaled state without the spin angle, shape (3,)."""
        rms = np.sqrt(np.sum(apart[:, _SCALED_STATE_COLUMNS] ** 2, axis=1) / S.N_STATE)
        return np.array([apart[:, 0].max(), apart[:, 1].max(), rms.max()])


def _distance_at_same_angle(
    own: np.ndarray, other: np.ndarray, phase: np.ndarray, phase_other: np.ndarray, times_s: np.ndarray
) -> np.ndarray:
    """Return the distance of another run from this one at the same whirl angle.

    This run's values are fitted as a function of its whirl angle, of that angle relative to the rotating unbalance, and
    of time. The fit's residual is added: an angle error must not explain motion such as impacts, which is no function
    of the angle.

    Args:
        own: Values of this run, shape (n, k).
        other: Values of the other run, shape (n, k).
        phase: Whirl angle and spin angle of this run [rad], shape (n, 2).
        phase_other: Those of the other run [rad], shape (n, 2).
        times_s: Instants [s], shape (n,).

    Returns:
        Distances in the units of the values, shape (n, k).
    """
    elapsed = (times_s - times_s.mean()) / max(np.ptp(times_s), 1e-9)

    def basis(at: np.ndarray) -> np.ndarray:
        turns = np.column_stack([np.outer(at[:, 0], _HARMONICS), at[:, 0] - at[:, 1]])
        return np.column_stack([np.ones_like(elapsed), elapsed, np.cos(turns), np.sin(turns)])

    terms = basis(phase)
    coefficients, *_ = np.linalg.lstsq(terms, own)
    residual = np.abs(own - terms @ coefficients).max(axis=0)
    return np.abs(other - basis(phase_other) @ coefficients) + residual
