"""Identification from a log of another system, with the unknowns of the log itself fitted along.

The search is that of `nuisance.tune`, with the requested keys added, and the result is judged as any fit. In addition
to the noise, the intervals include the last changes of the values as the window grew, and a jackknife (model errors are
not the same everywhere). Equally valid assumptions, as filters with other corners and a friction law that is continuous
at zero speed, are uncertainties that the noise includes: each explains only a residual of its own shape.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from recorder.reader import Recording
from replays.estimate.least_squares import solve_normal
from replays.recordings.identification.agreement import ChannelState, jackknife_half_widths
from replays.recordings.identification.fit import Identification
from replays.recordings.identification.judgement import Judgement, judge, widen_interval
from replays.recordings.identification.nuisance import NUISANCES, find_nuisances, tune, window_start_s
from replays.recordings.identification.request import Question, ask, first_command_s
from replays.recordings.identification.window import Window
from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.sensitivity import ANGLE, PHASE


def identify_log(
    recording: Recording,
    experiment: Experiment,
    keys: Sequence[str],
    *,
    start: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    channels: Sequence[str] | None = None,
    to_s: float | None = None,
    variants: Sequence[dict[str, object]] = (),
    bandwidth: float = 1.0,
    progress: Callable[[str], None] = lambda _text: None,
) -> Identification:
    """Fit the requested values to a log.

    Args:
        recording: The log.
        experiment: Experiment, as far as it is known.
        keys: Requested keys.
        start: Start values by key.
        bounds: Lowest and highest value by key.
        priors: Mean and standard deviation by key.
        channels: Channels to use; None for all.
        to_s: End of the used samples [s].
        variants: Changes that make equally valid models.
        bandwidth: Corner of a real anti-alias filter over the nominal one.
        progress: Callback for the current step.

    Raises:
        InputError: An unknown or doubled key, channel or value, or no samples.
    """
    # Report errors of the request before the long search.
    first = ask(recording, experiment, keys, start=start, bounds=bounds, priors=priors, channels=channels)
    # Samples show the sum of both angles: with a known mark, that of the shaft widens the interval of the other.
    mark = experiment.mark if PHASE in keys and ANGLE not in keys else None
    along = [key for key in NUISANCES if key not in keys and (mark is None or key != ANGLE)]
    tuned = tune(
        recording, first.experiment, (*keys, *along), priors=priors or {},
        channels=channels, to_s=to_s, variants=variants, progress=progress,
    )  # fmt: skip
    nuisances = find_nuisances(tuned.baseline, along)
    all_priors = {key: prior for key, prior in nuisances.items() if prior is not None} | dict(priors or {})
    question = ask(
        recording, tuned.baseline, (*keys, *nuisances), start=tuned.values, bounds=bounds, priors=all_priors,
        nuisances=nuisances, channels=channels, window=(window_start_s(tuned.baseline), tuned.end_s),
    )  # fmt: skip
    parts = {name: part.with_spectra(tuned.spectra) for name, part in question.observation.parts.items()}
    question = replace(question, observation=replace(question.observation, parts=parts))
    progress("effect of filters with other corners, and of equally valid models")
    nominal = _window(question).residuals(z := np.zeros(len(question.keys)))
    other = {name: part.with_corner_factor(bandwidth) for name, part in question.observation.parts.items()}
    observation = replace(question.observation, parts=other)
    apart = nominal - _window(replace(question, observation=observation)).residuals(z)
    unsure = [np.where(np.arange(apart.shape[1]) == c, apart, 0.0) for c in np.flatnonzero(apart.any(axis=0))]
    for changes in variants:
        model = question.experiment.with_changes(dict(changes))
        unsure.append(nominal - _window(replace(question, experiment=model)).residuals(z))
    window = _window(question, unsure)
    progress(f"fitted: {len(question.keys)} values, to {tuned.end_s:.4f} s; their intervals")
    slopes, residuals, valid = window.slopes_by_keys(z), window.residuals(z), window.valid
    square, side = _priors(question)
    flat = slopes.reshape(-1, len(z))
    moved_z = solve_normal(square + flat.T @ flat, side + flat.T @ residuals.ravel())
    moved_residuals = window.residuals_or_none(moved_z)
    if moved_residuals is not None and (moved_residuals**2).sum() < (residuals**2).sum():
        z, residuals = moved_z, moved_residuals
    scale = np.array([unknown.scale for unknown in question.unknowns])
    places = [list(tuned.values).index(key) for key in question.keys]
    moves = 1.96 * np.sqrt(np.mean(tuned.growths[:, places] ** 2, axis=0)) / scale
    here = ChannelState(list(np.nan_to_num(residuals).T), list(np.moveaxis(slopes, 1, 0)))
    times = [window.question.observation.times_s[: len(residuals)]] * len(here.apart)
    first_s = first_command_s(question.experiment)
    jackknife = jackknife_half_widths(here, times, [1.0] * len(times), (square, side), first_s)
    moved = np.hypot(jackknife, moves)
    if mark is not None:
        moved[question.keys.index(PHASE)] += 1.96 * mark[1]
    judgement = judge(window, z, slopes, residuals, valid)
    begun = {one.key: one.start for one in tuned.fitted}
    judgement = replace(judgement, findings=tuple(
        replace(one, unknown=replace(one.unknown, start=begun[one.unknown.key])) for one in judgement.findings
    ))  # fmt: skip
    why = f"the fit uses {1e3 * (tuned.end_s - first_s):.3g} ms from the hammer pulse on"
    if tuned.end_s > tuned.parted_s - 1e-9:
        why += "; from then on, equally valid friction laws differ"
    elif tuned.end_s < tuned.longest_s:
        why = f"no values of these keys explain the samples to {tuned.longest_s:.4f} s: the contact law (exponent, "
        why += "damping, friction law) or a number that is not fitted, such as a house stiffness, differs"
        if any(one.standing == "not seen" for one in judgement.findings[: len(keys)]):
            why += "; later samples may show the missing values: fit these numbers too, or use another --start"
    return Identification(
        question=question, judgement=_widen_intervals(judgement, moved * scale), window=window,
        z=z, stages=(), why=why, runs=window.runs, narrowed={},
    )  # fmt: skip


def _window(question: Question, unsure: Sequence[np.ndarray] = ()) -> Window:
    """Return the window of all samples of a question."""
    return Window(question, float(question.observation.times_s[-1]) + 1e-6, unsure)


def _priors(question: Question) -> tuple[np.ndarray, np.ndarray]:
    """Return the prior terms of the normal equations in scales, shapes (unknowns, unknowns) and (unknowns,)."""
    priors = [(one, *(one.prior or (one.start, one.scale))) for one in question.unknowns]
    square = np.diag([(one.scale / sigma) ** 2 for one, _, sigma in priors])
    return square, np.array([(mean - one.start) * one.scale / sigma**2 for one, mean, sigma in priors])


def _widen_intervals(judgement: Judgement, moved: np.ndarray) -> Judgement:
    """Return the judgement with intervals widened by the given changes."""
    findings = tuple(widen_interval(one, float(by)) for one, by in zip(judgement.findings, moved, strict=True))
    identified = np.array([finding.standing == "identified" for finding in findings])
    correlation = np.where(np.outer(identified, identified), judgement.correlation, np.nan)
    return replace(judgement, findings=findings, correlation=correlation)
