"""Fit in a growing window: it grows as far as the model is linear in the remaining uncertainty."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from replays.recordings.identification.horizon import Horizon, find_horizon
from replays.recordings.identification.judgement import Judgement, blind_directions, judge, triangular_factor
from replays.recordings.identification.request import Question
from replays.recordings.identification.window import Window
from rig.base.errors import InputError

PRECISION = 1e-4
"""Half of a 95 % interval, relative to the scale of a value, at which the search ends."""
SPREAD = 0.1
"""Largest error of the start, relative to the scale of a value."""
_SPREAD_REDUCTION = 0.3
"""Factor by which the spread of a value is reduced if the first window is not linear in it."""
_MIN_SPREAD = 1e-4
"""Smallest spread."""
_SUFFICIENT_PRECISION = 0.01
"""Half of an interval, relative to the scale, from which unexplained later samples may be left out."""
_LOOK_AHEAD_S = 0.05
"""Initial look-ahead [s]."""
_MIN_GROWTH_S = 1e-3
"""Minimum growth of the window [s]."""
_MAX_STAGES = 60
_MAX_NONLINEAR = 8
"""Maximum number of consecutive growths with a nonlinear response."""
_MAX_JUMP = 6.0
"""Change of the values, in standard deviations, from which a growth counts as a jump to another minimum."""
_NONLINEAR = "after that, the response to the remaining uncertainty, mainly of {}, is not linear"
_CHI2_SIGMAS = 4.0
"""New samples are unexplained if their chi2 exceeds the previous one by more standard deviations than this."""
_OUTLIER = 6.0
"""Residual over noise from which single samples are left out of a robust fit."""
_MAX_OUTLIERS = 0.01
"""Largest fraction of samples that may be left out."""
_PASSES = 3
"""Passes over the slopes, each along the principal directions of the previous one."""


@dataclass(frozen=True)
class Stage:
    """One growth of the window.

    Attributes:
        end_s: End of the window [s].
        why: Reason for this end.
        values: Fitted values in their units, shape (unknowns,).
        half_widths: Half of the 95 % intervals from noise and fit, in the units of the values, shape (unknowns,).
        chi2: Sum of squares over the noise, per degree of freedom.
        fresh: Sum of squares over the noise of the new rows, per sample.
        explained: True if the new rows are explained as well as those before.
    """

    end_s: float
    why: str
    values: np.ndarray
    half_widths: np.ndarray
    chi2: float
    fresh: float
    explained: bool


@dataclass(frozen=True)
class Identification:
    """Finished fit.

    Attributes:
        question: The request.
        judgement: Assessment of the fit.
        window: Samples of the fit.
        z: Fitted values, as distances from the start in scales, shape (unknowns,).
        stages: Growth of the window.
        why: Reason for the end of the window.
        runs: Number of simulations.
        narrowed: Reduced spread by key, with which the first window became linear.
    """

    question: Question
    judgement: Judgement
    window: Window
    z: np.ndarray
    stages: tuple[Stage, ...]
    why: str
    runs: int
    narrowed: dict[str, float]

    @property
    def values(self) -> dict[str, float]:
        """Fitted values by key; the judgement says which of them are results."""
        return dict(zip(self.question.keys, self.window.values(self.z).tolist(), strict=True))

    @property
    def from_s(self) -> float:
        """Start of the window [s]."""
        return float(self.question.observation.times_s[0])


def identify(
    question: Question,
    *,
    precision: float = PRECISION,
    spread: float = SPREAD,
    robust: bool = False,
    whole: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Identification:
    """Fit the requested values.

    Args:
        question: The request.
        precision: Half of a 95 % interval, relative to the scale of a value, at which the search ends.
        spread: Largest error of the start, relative to the scale of a value.
        robust: Reduce the weight of outliers (soft L1 from three times the noise).
        whole: Use the whole window, even if the precision is reached or the model no longer explains it.
        progress: Callback for the current step.

    Raises:
        InputError: The motion is not predictable from the first samples on.
    """
    search = _Search(question, spread=spread)
    first_s = float(question.observation.times_s[0])
    limit_s = float(question.observation.times_s[-1]) + 1e-6
    end_s = first_s  # of the last window that was accepted
    look_s, growth_s = _LOOK_AHEAD_S, math.inf
    horizon = search.find_horizon(min(limit_s, end_s + look_s))
    while not horizon.whole and horizon.time_s < first_s + _MIN_GROWTH_S:
        if not search.narrow(horizon.by):
            must = "one whose first samples can be predicted (start it before the first contacts, or use better start "
            must += f"values): the response to a change of {horizon.by} by {_MIN_SPREAD:g} of its scale is not linear"
            raise InputError("window", must, [first_s, limit_s])
        horizon = search.find_horizon(min(limit_s, end_s + look_s))
    good: _State | None = None
    nonlinear_growths, shortened = 0, False
    for _ in range(_MAX_STAGES):
        # Linear as far as the look-ahead, or up to the first nonlinearity; less after a jump.
        reached_s = min(limit_s, end_s + growth_s, max(horizon.time_s, end_s + _MIN_GROWTH_S))
        why = "the look-ahead ends there" if horizon.whole else _NONLINEAR.format(horizon.by)
        if progress is not None:
            progress(f"fitting: window to {reached_s:.2f} s, {search.describe_determined(precision)} values known")
        before = search.state
        stage = search.extend(reached_s, why)
        look_s = 2.0 * look_s if horizon.whole else _LOOK_AHEAD_S
        after = search.find_horizon(min(limit_s, reached_s + look_s))
        straight = after.whole or after.time_s >= reached_s - 1e-9
        if search.jump > _MAX_JUMP and before.stages:
            search.state = before
            growth_s = (reached_s - end_s) / 2.0
            if growth_s < _MIN_GROWTH_S / 2.0:
                why = "after that, every growth leads to another minimum"
                break
            continue
        if not straight and before.stages and not shortened and after.time_s > end_s + _MIN_GROWTH_S:
            search.state = before
            growth_s, shortened = after.time_s - end_s, True  # only once, and only as far as it stays linear
            continue
        last = before.stages[-1] if before.stages else None
        if not whole and last is not None and not stage.explained and search.is_determined(last, _SUFFICIENT_PRECISION):
            good = before
            why = "after that, the model does not explain the samples within their noise: to "
            why += f"{reached_s:.4f} s, chi2 is {stage.fresh:.3g} a sample"
            break
        end_s, horizon, growth_s, shortened = reached_s, after, math.inf, False
        # If the response is nonlinear within the window, the intervals are too narrow; more samples may correct that.
        nonlinear_growths = 0 if straight else nonlinear_growths + 1
        good = search.state if straight else good
        if straight and not whole and search.is_determined(stage, precision):
            why = f"every value is known within {precision:g} of its scale"
            break
        if end_s >= limit_s:
            why = "the samples end there" if straight else _NONLINEAR.format(after.by)
            break
        if nonlinear_growths > _MAX_NONLINEAR:
            why = _NONLINEAR.format(after.by)
            break
    else:
        why = f"the limit of {_MAX_STAGES} stages is reached"
    search.state = good or search.state
    if progress is not None:
        progress("fitted; intervals of the values")
    return search.finish(why, robust=robust)


@dataclass(frozen=True)
class _State:
    """State of the search: values, their covariance, the window and the finished stages."""

    z: np.ndarray
    covariance: np.ndarray
    window: Window | None
    stages: tuple[Stage, ...]


class _Search:
    """Search for the values while the window grows."""

    def __init__(self, question: Question, *, spread: float) -> None:
        self.question = question
        self.scale = np.array([unknown.scale for unknown in question.unknowns])
        # The prior assumes the start within two standard deviations.
        self._loose = np.array([
            min(spread, unknown.reach / unknown.scale) / 2.0 for unknown in question.unknowns
        ])  # fmt: skip
        self.state = _State(np.zeros(len(self.scale)), np.diag(self._loose**2), None, ())
        self.narrowed: dict[str, float] = {}
        self.jump = 0.0
        self.runs = 0

    def find_horizon(self, end_s: float) -> Horizon:
        """Return the time up to which the response to the remaining uncertainty is linear."""
        window = Window(self.question, end_s)
        horizon = find_horizon(window, self.state.z, self.state.covariance)
        self.runs += window.runs
        return horizon

    def narrow(self, key: str) -> bool:
        """Reduce the spread of one value; return False if it is already minimal."""
        place = self.question.keys.index(key)
        if 2.0 * self._loose[place] < _MIN_SPREAD:
            return False
        self._loose[place] *= _SPREAD_REDUCTION
        self.narrowed[key] = 2.0 * self._loose[place]
        self.state = replace(self.state, covariance=np.diag(self._loose**2))
        return True

    def is_determined(self, stage: Stage, part: float) -> bool:
        """Return whether all requested values were known within a fraction of their scales after a stage."""
        requested = np.array([not unknown.nuisance for unknown in self.question.unknowns])
        return bool((stage.half_widths < part * self.scale)[requested].all())

    def describe_determined(self, part: float) -> str:
        """Return how many of the requested values are known within a fraction of their scales, as text."""
        requested = np.array([not unknown.nuisance for unknown in self.question.unknowns])
        stages = self.state.stages
        last = stages[-1].half_widths if stages else np.full(len(self.scale), math.inf)
        return f"{int(((last < part * self.scale) & requested).sum())} of {int(requested.sum())}"

    def extend(self, end_s: float, why: str) -> Stage:
        """Fit on a longer window with a weak prior around the start."""
        window = Window(self.question, end_s)
        before = self.state
        self._fit(window)
        chi2 = self._fit(window)  # again, with slopes along the new principal directions
        squares = window.residuals(self.state.z) ** 2
        rows = before.window.rows if before.window is not None else 0
        count = max(1, int(window.valid[rows:].sum()))
        fresh, usual = float(squares[rows:].sum()) / count, before.stages[-1].chi2 if before.stages else 1.0
        explained = fresh < usual * (1.0 + _CHI2_SIGMAS * math.sqrt(2.0 / count))
        deviation = np.sqrt(np.diag(self.state.covariance))
        moved = self.state.z - before.z
        self.jump = math.sqrt(max(0.0, float(moved @ np.linalg.solve(before.covariance, moved))))
        self.runs += window.runs
        stage = Stage(end_s, why, window.values(self.state.z), 1.96 * deviation * self.scale, chi2, fresh, explained)
        self.state = replace(self.state, window=window, stages=(*before.stages, stage))
        return stage

    def _fit(self, window: Window) -> float:
        """Fit on a window with a weak prior, update the covariance, and return chi2 per degree of freedom."""
        self._solve(window, np.diag(0.5 / self._loose), np.zeros(len(self.state.z)))
        squares = float((window.residuals(self.state.z) ** 2).sum())
        chi2 = squares / max(1, int(window.valid.sum()) - len(self.state.z))
        self._learn(window, chi2)
        return chi2

    def finish(self, why: str, *, robust: bool) -> Identification:
        """Fit without a prior, except along directions that the samples do not show, and judge the result."""
        last = self.state.window
        assert last is not None
        reach = np.array([unknown.reach / unknown.scale for unknown in self.question.unknowns])
        window = Window(self.question, last.end_s)
        blind = blind_directions(window.slopes(self.state.z, self.state.covariance), reach)
        # Values keep their state along directions that the samples do not show.
        self._solve(window, blind.T / reach, self.state.z, robust=robust)
        slopes, residuals = window.slopes(self.state.z, self.state.covariance), window.residuals(self.state.z)
        far = np.abs(residuals) > _OUTLIER
        valid = window.valid & ~far if robust and far.sum() <= _MAX_OUTLIERS * window.valid.sum() else window.valid
        judgement = judge(window, self.state.z, slopes * valid[..., None], residuals * valid, valid)
        return Identification(
            question=self.question,
            judgement=judgement,
            window=window,
            z=self.state.z,
            stages=self.state.stages,
            why=why,
            runs=self.runs + window.runs,
            narrowed=self.narrowed,
        )

    def _learn(self, window: Window, chi2: float) -> None:
        """Update the covariance of z from the samples and the initial prior."""
        for _ in range(_PASSES):
            slopes = window.slopes(self.state.z, self.state.covariance)
            triangle = triangular_factor(slopes) / math.sqrt(max(1.0, chi2))
            # Singular values are used, as the information may span ten decades.
            _, singular, directions = np.linalg.svd(np.vstack([triangle, np.diag(1.0 / self._loose)]))
            root = directions.T / singular
            self.state = replace(self.state, covariance=root @ root.T)

    def _solve(self, window: Window, hold: np.ndarray, centre: np.ndarray, *, robust: bool = False) -> None:
        """Solve the least-squares problem on a window.

        Args:
            window: The samples.
            hold: Prior rows, each over its standard deviation, shape (rows, unknowns).
            centre: Centre of the prior, shape (unknowns,).
            robust: Reduce the weight of outliers.
        """
        from scipy.optimize import least_squares

        unknowns = self.question.unknowns
        start = np.array([unknown.start for unknown in unknowns])
        low, high = (
            (np.array(side) - start) / self.scale for side in zip(*((u.low, u.high) for u in unknowns), strict=True)
        )
        room = np.minimum(1e-9, (high - low) / 4.0)
        begin = np.clip(self.state.z, low + room, high - room)
        priors = [(place, unknown.prior) for place, unknown in enumerate(unknowns) if unknown.prior is not None]
        rows = np.zeros((len(priors), len(unknowns)))
        aims = np.zeros(len(priors))
        for row, (place, (mean, sigma)) in enumerate(priors):
            rows[row, place] = self.scale[place] / sigma
            aims[row] = (mean - start[place]) / sigma
        held = np.vstack([hold, rows])
        aim = np.concatenate([hold @ centre, aims])
        if window.residuals_or_none(begin) is None:
            raise InputError("start", "values that the model accepts", window.values(begin).tolist())

        def residuals(z: np.ndarray) -> np.ndarray:
            table = window.residuals_or_none(z)
            # Values that the model rejects have an infinite cost, so the search shortens its step.
            shown = np.full(window.valid.size, np.inf) if table is None else table.ravel()
            return np.concatenate([shown, held @ z - aim])

        def jacobian(z: np.ndarray) -> np.ndarray:
            return np.vstack([-window.slopes(z, self.state.covariance).reshape(-1, len(z)), held])

        solved = least_squares(
            residuals,
            begin,
            jac=jacobian,
            bounds=(low, high),
            method="trf",
            x_scale="jac",
            loss="soft_l1" if robust else "linear",
            f_scale=3.0 if robust else 1.0,
            xtol=1e-11,
            ftol=1e-9,
            gtol=None,
            max_nfev=25,
        )
        self.state = replace(self.state, z=solved.x)
        if not math.isfinite(solved.cost):
            raise InputError("fit", "of values that the model can simulate", solved.x.tolist())
