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
from replays.recordings.identification.agreement import stretches, without_each
from replays.recordings.identification.fit import Identification
from replays.recordings.identification.judgement import Judgement, judge, widened
from replays.recordings.identification.nuisance import NUISANCES, looks_from, nuisances_of, tune
from replays.recordings.identification.question import Question, ask, first_command_s
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
    moved = np.hypot(_jackknife(question, slopes, residuals), moves)
    shown = [residuals - apart / louder]
    for changes in variants:
        shown.append(_of(replace(question, experiment=question.experiment.changed(dict(changes)))).residuals(z))
    here = _step(question, slopes, residuals)
    for one in shown:
        moved = np.hypot(moved, np.abs(_step(question, slopes, one) - here))
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


def _jackknife(question: Question, slopes: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Half of 95 % intervals by what values do without single channels, and stretches of time, in scales."""
    times_s = question.observation.times_s[: len(residuals)]
    number = stretches(times_s, first_command_s(question.experiment))
    return np.max([
        without_each(np.array([_step(question, slopes, residuals, groups != one) for one in np.unique(groups)]))
        for groups in (np.broadcast_to(np.arange(residuals.shape[1]), residuals.shape),
                       np.broadcast_to(number[:, None], residuals.shape))
    ], axis=0)  # fmt: skip


def _of(question: Question, parts: dict[str, Measured] | None = None) -> Window:
    """All samples of a question; where other parts are given, behind their filters."""
    if parts is not None:
        question = replace(question, observation=replace(question.observation, parts=parts))
    return Window(question, float(question.observation.times_s[-1]) + 1e-6)


def _step(question: Question, slopes: np.ndarray, residuals: np.ndarray, kept: np.ndarray | None = None) -> np.ndarray:
    """How far values go by least squares, with what is known of them before, in scales, shape (unknowns,)."""
    n = slopes.shape[-1]
    weights = 1.0 if kept is None else kept.ravel()
    flat = slopes.reshape(-1, n)
    square, side = (flat.T * weights) @ flat, flat.T @ (np.nan_to_num(residuals).ravel() * weights)
    for place, unknown in enumerate(question.unknowns):
        mean, sigma = unknown.prior or (unknown.start, unknown.scale)
        square[place, place] += (unknown.scale / sigma) ** 2
        side[place] += (mean - unknown.start) * unknown.scale / sigma**2
    size = 1.0 / np.sqrt(np.diag(square))
    return size * np.linalg.lstsq(square * np.outer(size, size), side * size, rcond=1e-14)[0]


def _wider(judgement: Judgement, moved: np.ndarray) -> Judgement:
    """With intervals that hold what the values move by as well."""
    findings = tuple(widened(finding, float(far)) for finding, far in zip(judgement.findings, moved, strict=True))
    told = np.array([finding.standing == "identified" for finding in findings])
    correlation = np.where(np.outer(told, told), judgement.correlation, np.nan)
    return replace(judgement, findings=findings, correlation=correlation)
