"""Numbers of a rig from a log of another system: with all that the log does not tell, and as right models leave them.

The search is that of `nuisance.tune`, with what is asked among its numbers. What it comes to is judged as any fit is.
Beside the noise, intervals hold what the values moved by as the last samples came, what they do where some are left
out (a jackknife: what the model lacks is not the same everywhere), and where something is as right as what was assumed:
a friction that goes through zero, filters with other corners.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from recorder.reader import Recording
from replays.estimate.least_squares import solve_normal
from replays.recordings.identification.agreement import Here, half_without_parts
from replays.recordings.identification.fit import Identification
from replays.recordings.identification.judgement import Judgement, judge, widened
from replays.recordings.identification.nuisance import NUISANCES, looks_from, nuisances_of, tune
from replays.recordings.identification.request import Question, ask, first_command_s
from replays.recordings.identification.window import Window
from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.resimulation.prediction import Measured


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
    """Fit what is asked of a log.

    Args:
        recording: The log.
        experiment: What was done, as far as it is known.
        keys: What is asked.
        start: Where the search begins, by key.
        bounds: Least and largest value by key.
        priors: Mean and standard deviation by key.
        channels: By which channels; None for all.
        to_s: Samples are used up to here [s].
        variants: Changes that make models as right as ours.
        bandwidth: Corner of a real anti-alias filter over the one that is told.
        progress: Told what is being done.

    Raises:
        InputError: An unknown or doubled key, channel or value, or no samples.
    """
    # What is wrong with the question is said at once.
    first = ask(recording, experiment, keys, start=start, bounds=bounds, priors=priors, channels=channels)
    tuned = tune(
        recording, first.experiment, (*keys, *(key for key in NUISANCES if key not in keys)), known=priors or {},
        channels=channels, to_s=to_s, progress=progress,
    )  # fmt: skip
    along = nuisances_of(tuned.begun, NUISANCES, besides=keys)
    held = {key: known for key, known in along.items() if known is not None} | dict(priors or {})
    question = ask(
        recording, tuned.begun, (*keys, *along), start=tuned.values, bounds=bounds, priors=held, along=along,
        channels=channels, window=(looks_from(tuned.begun), tuned.end_s),
    )  # fmt: skip
    progress("what filters with other corners would show")
    other = {name: part.filtered(bandwidth) for name, part in question.observation.parts.items()}
    apart = _of(question, other).predicted(z := np.zeros(len(question.keys))) - _of(question).predicted(z)
    louder = np.hypot(1.0, np.sqrt(np.nanmean(apart**2, axis=0)))
    observation = question.observation
    question = replace(question, observation=replace(observation, noise=observation.noise * louder))
    window = _of(question)
    progress(f"fitted: {len(question.keys)} values, to {tuned.end_s:.4f} s; their intervals")
    slopes, residuals, known = window.slopes_by_keys(z), window.residuals(z), window.known
    scale = np.array([unknown.scale for unknown in question.unknowns])
    places = [list(tuned.values).index(key) for key in question.keys]
    moves = 1.96 * np.sqrt(np.mean(tuned.moves[:, places] ** 2, axis=0)) / scale
    square, side = _priors(question)
    here = Here(list(np.nan_to_num(residuals).T), list(np.moveaxis(slopes, 1, 0)))
    times = [observation.times_s[: len(residuals)]] * len(here.apart)
    lacking = half_without_parts(here, times, [1.0] * len(times), (square, side), first_command_s(question.experiment))
    moved = np.hypot(lacking, moves)
    shown = [residuals - apart / louder]
    for changes in variants:
        shown.append(_of(replace(question, experiment=question.experiment.changed(dict(changes)))).residuals(z))
    flat = slopes.reshape(-1, len(scale))
    for one in shown:
        change = solve_normal(square + flat.T @ flat, flat.T @ np.nan_to_num(one - residuals).ravel())
        moved = np.hypot(moved, np.abs(change))
    judgement, why = (
        judge(window, z, slopes, residuals, known),
        "the model, or a search that follows it, goes no further",
    )
    if tuned.end_s < tuned.longest_s and any(one.standing == "not seen" for one in judgement.findings[: len(keys)]):
        why += "; what comes next may show what is not seen: with another --start, or another law of the contact"
    return Identification(
        question=question, judgement=_wider(judgement, moved * scale), window=window,
        z=z, stages=(), why=why, runs=window.runs, narrowed={},
    )  # fmt: skip


def _of(question: Question, parts: dict[str, Measured] | None = None) -> Window:
    """All samples of a question; where other parts are given, behind their filters."""
    if parts is not None:
        question = replace(question, observation=replace(question.observation, parts=parts))
    return Window(question, float(question.observation.times_s[-1]) + 1e-6)


def _priors(question: Question) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal equations of what is known before, in scales, shapes (unknowns, unknowns) and (unknowns,)."""
    known = [(one, *(one.prior or (one.start, one.scale))) for one in question.unknowns]
    square = np.diag([(one.scale / sigma) ** 2 for one, _, sigma in known])
    return square, np.array([(mean - one.start) * one.scale / sigma**2 for one, mean, sigma in known])


def _wider(judgement: Judgement, moved: np.ndarray) -> Judgement:
    """With intervals that hold what the values move by as well."""
    findings = tuple(widened(finding, float(far)) for finding, far in zip(judgement.findings, moved, strict=True))
    told = np.array([finding.standing == "identified" for finding in findings])
    correlation = np.where(np.outer(told, told), judgement.correlation, np.nan)
    return replace(judgement, findings=findings, correlation=correlation)
