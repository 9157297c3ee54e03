"""The fit: the window grows as far as the model is linear in what is still unknown, and the values follow."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from replays.recordings.identification.horizon import Horizon, horizon
from replays.recordings.identification.judgement import Judgement, blind_directions, judge, triangle_of
from replays.recordings.identification.request import Question
from replays.recordings.identification.window import Window
from rig.base.errors import InputError

PRECISION = 1e-4
"""Half of a 95 % interval, as a part of a value's scale, that is fine enough to look no further ahead."""
SPREAD = 0.1
"""How far off the start may be, as a part of a value's scale."""
_NARROWER = 0.3
"""By this the spread of a value is made smaller that bends the first window, ..."""
_LEAST_SPREAD = 1e-4
"""... down to here."""
_ENOUGH = 0.01
"""Half of an interval, as a part of the scale, with which samples that the model does not explain can be left out."""
_LOOK_S = 0.05
"""How far ahead is looked at first [s]."""
_LEAST_S = 1e-3
"""The window grows by this at least [s]."""
_MOST_STAGES = 60
_MOST_ASTRAY = 8
"""So often the window grows on although the response bends in it."""
_FARTHEST = 6.0
"""A growth that moves the values by more of their standard deviations has led into another valley."""
_BENDS = "beyond, the response to what is not known yet, above all {}, is no longer linear"
_CHANCE = 4.0
"""Samples that come new are not explained where chi2 is above that before by more of its standard deviations."""
_FAR = 6.0
"""Where single samples are to count less, those off by so many times their noise tell nothing of the model, ..."""
_FEW = 0.01
"""... if they are no more than this part."""
_PASSES = 3
"""So often the slopes are taken anew along the principal directions that they have given."""


@dataclass(frozen=True)
class Stage:
    """One growth of the window.

    Attributes:
        end_s: Its end [s].
        why: Why there.
        values: The values after it, in each unit, shape (unknowns,).
        half_widths: Of their 95 % intervals by the noise and the fit, in each unit, shape (unknowns,).
        chi2: Sum of squares over the noise, a degree of freedom.
        fresh: The same a sample, of the rows that came new.
        explained: Whether these are explained as well as those before them.
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
    """A finished fit.

    Attributes:
        question: What was asked.
        judgement: What came out of it.
        window: The samples that it rests on.
        z: Where it ended.
        stages: How the window grew.
        why: Why the window ends where it does.
        runs: Simulations.
        narrowed: By key, a smaller spread than was asked for, with which the first window was linear.
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
        """Where the fit ended, by key; what of it is a result stands in the judgement."""
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
    """Fit what is asked for.

    Args:
        question: It.
        precision: Half of a 95 % interval, as a part of a value's scale, that is fine enough to look no further ahead.
        spread: How far off the start may be, as a part of a value's scale.
        robust: Let single samples that are far off count less (soft L1 from three times the noise on).
        whole: Use the whole window, even beyond what is fine enough and where the model no longer explains it.
        progress: Told what is being done.

    Raises:
        InputError: The samples begin where the motion can no longer be predicted.
    """
    search = _Search(question, spread=spread)
    first_s = float(question.observation.times_s[0])
    limit_s = float(question.observation.times_s[-1]) + 1e-6
    end_s = first_s  # of the last window that was accepted
    look_s, growth_s = _LOOK_S, math.inf
    seen = search.horizon(min(limit_s, end_s + look_s))
    while not seen.whole and seen.time_s < first_s + _LEAST_S:
        if not search.narrow(seen.by):
            must = "one whose first samples can be predicted (begin it before the first contacts, or start nearer "
            must += f"to the truth): a change of {seen.by} by {_LEAST_SPREAD:g} of its scale already bends them"
            raise InputError("window", must, [first_s, limit_s])
        seen = search.horizon(min(limit_s, end_s + look_s))
    good: _State | None = None
    astray, shortened = 0, False
    for _ in range(_MOST_STAGES):
        # Linear as far as the eye reaches, or up to where it bends; less where that has been too much.
        reached_s = min(limit_s, end_s + growth_s, max(seen.time_s, end_s + _LEAST_S))
        why = "as far as was looked ahead" if seen.whole else _BENDS.format(seen.by)
        if progress is not None:
            progress(f"fitting: window to {reached_s:.2f} s, {search.known_of(precision)} values known")
        before = search.state
        stage = search.extend(reached_s, why)
        look_s = 2.0 * look_s if seen.whole else _LOOK_S
        after = search.horizon(min(limit_s, reached_s + look_s))
        straight = after.whole or after.time_s >= reached_s - 1e-9
        if search.jump > _FARTHEST and before.stages:
            search.state = before
            growth_s = (reached_s - end_s) / 2.0
            if growth_s < _LEAST_S / 2.0:
                why = "beyond, no growth of the window leads on in the same valley"
                break
            continue
        if not straight and before.stages and not shortened and after.time_s > end_s + _LEAST_S:
            search.state = before
            growth_s, shortened = after.time_s - end_s, True  # once, only as far as it stays straight
            continue
        last = before.stages[-1] if before.stages else None
        if not whole and last is not None and not stage.explained and search.known(last, _ENOUGH):
            good = before
            why = "beyond, the model no longer explains the samples within their noise: to "
            why += f"{reached_s:.4f} s, chi2 is {stage.fresh:.3g} a sample"
            break
        end_s, seen, growth_s, shortened = reached_s, after, math.inf, False
        # Where the response bends within the window itself, its intervals say too little; more samples may settle that.
        astray = 0 if straight else astray + 1
        good = search.state if straight else good
        if straight and not whole and search.known(stage, precision):
            why = f"every value is known there within {precision:g} of its scale"
            break
        if end_s >= limit_s:
            why = "the samples end there" if straight else _BENDS.format(after.by)
            break
        if astray > _MOST_ASTRAY:
            why = _BENDS.format(after.by)
            break
    else:
        why = f"no more than {_MOST_STAGES} stages are tried"
    search.state = good or search.state
    if progress is not None:
        progress("fitted; intervals of the values")
    return search.finish(why, robust=robust)


@dataclass(frozen=True)
class _State:
    """What the search knows, to come back to: values and their covariance, the window that it rests on, the stages."""

    z: np.ndarray
    covariance: np.ndarray
    window: Window | None
    stages: tuple[Stage, ...]


class _Search:
    """Values and what is known of them, while the window grows."""

    def __init__(self, question: Question, *, spread: float) -> None:
        self.question = question
        self.scale = np.array([unknown.scale for unknown in question.unknowns])
        # The start is two standard deviations from the truth at most.
        self._loose = np.array([
            min(spread, unknown.reach / unknown.scale) / 2.0 for unknown in question.unknowns
        ])  # fmt: skip
        self.state = _State(np.zeros(len(self.scale)), np.diag(self._loose**2), None, ())
        self.narrowed: dict[str, float] = {}
        self.jump = 0.0
        self.runs = 0

    def horizon(self, end_s: float) -> Horizon:
        """Up to where the response to what is not known is linear, looking ahead to some time."""
        window = Window(self.question, end_s)
        found = horizon(window, self.state.z, self.state.covariance)
        self.runs += window.runs
        return found

    def narrow(self, key: str) -> bool:
        """Begin with a smaller spread of one value; False if that is as small as it gets."""
        place = self.question.keys.index(key)
        if 2.0 * self._loose[place] < _LEAST_SPREAD:
            return False
        self._loose[place] *= _NARROWER
        self.narrowed[key] = 2.0 * self._loose[place]
        self.state = replace(self.state, covariance=np.diag(self._loose**2))
        return True

    def known(self, stage: Stage, part: float) -> bool:
        """Whether all that is asked for was known within a part of its scale after a stage."""
        asked = np.array([not unknown.along for unknown in self.question.unknowns])
        return bool((stage.half_widths < part * self.scale)[asked].all())

    def known_of(self, part: float) -> str:
        """How many of the values asked for are known so far within a part of their scales."""
        asked = np.array([not unknown.along for unknown in self.question.unknowns])
        stages = self.state.stages
        last = stages[-1].half_widths if stages else np.full(len(self.scale), math.inf)
        return f"{int(((last < part * self.scale) & asked).sum())} of {int(asked.sum())}"

    def extend(self, end_s: float, why: str) -> Stage:
        """Fit on a longer window, held loosely to the start."""
        window = Window(self.question, end_s)
        before = self.state
        self._settle(window)
        chi2 = self._settle(window)  # again, by slopes along the directions that the first has given
        squares = window.residuals(self.state.z) ** 2
        rows = before.window.rows if before.window is not None else 0
        count = max(1, int(window.known[rows:].sum()))
        fresh, usual = float(squares[rows:].sum()) / count, before.stages[-1].chi2 if before.stages else 1.0
        explained = fresh < usual * (1.0 + _CHANCE * math.sqrt(2.0 / count))
        deviation = np.sqrt(np.diag(self.state.covariance))
        moved = self.state.z - before.z
        self.jump = math.sqrt(max(0.0, float(moved @ np.linalg.solve(before.covariance, moved))))
        self.runs += window.runs
        stage = Stage(end_s, why, window.values(self.state.z), 1.96 * deviation * self.scale, chi2, fresh, explained)
        self.state = replace(self.state, window=window, stages=(*before.stages, stage))
        return stage

    def _settle(self, window: Window) -> float:
        """Fit on a window, held loosely to the start; what is known then; chi2 a degree of freedom."""
        self._solve(window, np.diag(0.5 / self._loose), np.zeros(len(self.state.z)))
        squares = float((window.residuals(self.state.z) ** 2).sum())
        chi2 = squares / max(1, int(window.known.sum()) - len(self.state.z))
        self._learn(window, chi2)
        return chi2

    def finish(self, why: str, *, robust: bool) -> Identification:
        """The last fit, without hold but where the samples tell nothing; and the judgement."""
        last = self.state.window
        assert last is not None
        reach = np.array([unknown.reach / unknown.scale for unknown in self.question.unknowns])
        window = Window(self.question, last.end_s)
        blind = blind_directions(window.slopes(self.state.z, self.state.covariance), reach)
        # Along what is not seen the values stay where they are.
        self._solve(window, blind.T / reach, self.state.z, robust=robust)
        slopes, residuals = window.slopes(self.state.z, self.state.covariance), window.residuals(self.state.z)
        far = np.abs(residuals) > _FAR
        known = window.known & ~far if robust and far.sum() <= _FEW * window.known.sum() else window.known
        judgement = judge(window, self.state.z, slopes * known[..., None], residuals * known, known)
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
        """The covariance that the samples leave of z, starting from what was known before."""
        for _ in range(_PASSES):
            slopes = window.slopes(self.state.z, self.state.covariance)
            triangle = triangle_of(slopes) / math.sqrt(max(1.0, chi2))
            # By singular values: the information may span ten decades and more.
            _, singular, directions = np.linalg.svd(np.vstack([triangle, np.diag(1.0 / self._loose)]))
            root = directions.T / singular
            self.state = replace(self.state, covariance=root @ root.T)

    def _solve(self, window: Window, hold: np.ndarray, centre: np.ndarray, *, robust: bool = False) -> None:
        """Least squares over a window.

        Args:
            window: The samples.
            hold: Rows that hold z to the centre, each over its standard deviation, shape (rows, unknowns).
            centre: Where to.
            robust: Let single samples that are far off count less.
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
            raise InputError("start", "values that the model takes", window.values(begin).tolist())

        def residuals(z: np.ndarray) -> np.ndarray:
            found = window.residuals_or_none(z)
            # Of values that the model does not take, no number: the search takes a shorter step.
            shown = np.full(window.known.size, np.inf) if found is None else found.ravel()
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
            raise InputError("fit", "of values that the model can run with", solved.x.tolist())
