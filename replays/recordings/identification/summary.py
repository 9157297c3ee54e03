"""Report of a fit: results, their intervals, and pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from replays.recordings.identification.fit import Identification
from replays.recordings.identification.judgement import MIN_CHI2, Finding
from replays.recordings.identification.request import first_command_s
from replays.report import Mark, Report, Row
from replays.report.canvas import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PINK,
    RED,
    SKY,
    add_legend,
    axis_label,
    house_style,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEADINGS = ("key", "start", "result", "95 % interval", "unit", "status")
_MARKS: dict[str, Mark] = {
    "identified": "good", "not seen": "open", "only together": "open", "at its bound": "bad",
    "not explained": "bad",
}  # fmt: skip
_MIN_LEAD_S = 0.4
"""Time before the hammer pulse that shows the noise of a log [s]."""
_MAX_PANELS = 16
_MAX_LABELLED = 6
"""Number of values up to which the picture shows each correlation as a number."""
_ONSET_FRACTION = 0.02
"""Curvature at the start of an impact, relative to the largest one."""
_MIN_PEAK = 50.0
"""Ratio of the largest curvature to the typical one, below which the record has no impact."""


def cells(finding: Finding) -> tuple[str, ...]:
    """Return one row of the table of values; a number only if it is a result."""
    unknown = finding.unknown
    unit = "" if unknown.unit == "1" else unknown.unit
    start = f"{unknown.start:.6g}" + (f" ({unknown.rule})" if unknown.rule else "")
    if finding.standing != "identified":
        return (unknown.key, start, "-", "-", unit, finding.words)
    digits = max(3, 2 + math.ceil(math.log10(max(abs(finding.value), 1e-30) / finding.half_width)))
    return (
        unknown.key, start, f"{finding.value:.{min(digits, 12)}g}", f"±{finding.half_width:.2g}", unit, finding.words
    )  # fmt: skip


def window_line(result: Identification) -> str:
    """Return which samples were used, and why the window ends."""
    names = result.question.observation.names
    grown = f", grown in {len(result.stages)} stages" if result.stages else ""
    return (
        f"window {result.from_s:.4f} to {result.window.end_s:.4f} s, {result.window.rows} rows of {len(names)} channels"
        f"{_decimation(result)}{grown}; end of the window: {result.why}"
    )


def spread_line(result: Identification) -> str:
    """Return the initial spread of values for which the default was too wide; empty without such values."""
    if not result.narrowed:
        return ""
    text = ", ".join(f"{key} {part:.2g}" for key, part in result.narrowed.items())
    return f"initial spread reduced, as the model is not linear over more (relative to each value's scale): {text}"


def _decimation(result: Identification) -> str:
    every = result.question.observation.every
    return f" (decimated: one sample in {every})" if every > 1 else ""


def fit_line(result: Identification) -> str:
    """Return the goodness of the fit."""
    judgement = result.judgement
    line = f"chi2 {judgement.chi2:.4g} per degree of freedom ({judgement.dof}); {judgement.verdict}"
    lead_s = first_command_s(result.question.experiment) - result.from_s
    if judgement.fits and judgement.chi2 < MIN_CHI2 and 0.0 < lead_s < _MIN_LEAD_S:
        line += f"; only {1e3 * lead_s:.0f} ms before the hammer pulse show the noise: record at least 0.5 s"
    if judgement.fits and judgement.inflation > 1.1:
        line += f"; intervals up to {judgement.inflation:.2g} times as wide as from noise alone"
    if judgement.together > 1.0:
        line += f"; for simultaneous intervals multiply by {judgement.together:.2f}"
    return line


def make_report(result: Identification, *, recording: str, origin: Mapping[str, str] | None = None) -> Report:
    """Return the report of a fit.

    Args:
        result: The fit.
        recording: Name of the recording.
        origin: Software that made the report, by name.
    """
    question, judgement = result.question, result.judgement
    results = "; ".join(
        " ".join((finding.unknown.key, *cells(finding)[2:5])).rstrip()
        if finding.standing == "identified"
        else f"{finding.unknown.key}: {finding.words}"
        for finding in judgement.findings
    )
    good = judgement.fits and all(finding.standing == "identified" for finding in judgement.findings)
    report = Report(
        f"Identification from {recording}",
        f"{results}. {fit_line(result)}.",
        origin=origin,
        mark="good" if good else "open",
    )
    report.picture(growth(result), "95 % intervals over the end of the window, relative to each value's scale; right, "
                   "the correlation of the values.")  # fmt: skip
    report.text(f"W{window_line(result)[1:]}.")
    if result.narrowed:
        report.text(f"The {spread_line(result)}.")
    report.heading("Values")
    rows = [Row(cells(finding), _MARKS[finding.standing]) for finding in judgement.findings]
    report.table(HEADINGS, rows, caption="95 % intervals of single values, from the slopes at the optimum.")
    report.text(
        "The intervals hold for this model and engine "
        f"({question.experiment.scene.engine.name}, {question.experiment.scene.engine.step_us} µs) with all other "
        "parameters as in the set, many of which are assumed, and for sensors as in the channel table. They do not "
        "include errors of those."
    )
    if len(judgement.findings) > 1:
        keys = question.keys
        report.heading("Correlation", level=2)
        texts = [[("" if math.isnan(c) else f"{c:+.4f}") for c in row] for row in judgement.correlation]
        report.table(("", *keys), [(key, *row) for key, row in zip(keys, texts, strict=True)])
        report.text(
            "Singular values of the Jacobian, in units of the noise and of each value's prior interval "
            "(below 2, the direction is not seen): " + ", ".join(f"{s:.3g}" for s in judgement.singular_values)
        )
    report.heading("Fit of the channels")
    report.table(
        ("channel", "residual over noise", "autocorrelation", "noise from", "verdict"),
        [
            Row(
                (
                    channel.name, f"{channel.rms:.3f}", f"{channel.correlation:+.3f}", source,
                    "white" if channel.white else "not white",
                ),
                "good" if channel.white and channel.rms < 1.1 else "bad",
            )
            for channel, source in zip(judgement.channels, question.observation.noise_from, strict=True)
        ],
    )  # fmt: skip
    report.picture(overlay(result), "Recorded samples (dots) and the fitted model (line); right, their difference "
                   "in units of the sensor's noise, from shortly before the first impact.")  # fmt: skip
    report.heading("Growth of the window")
    report.table(
        ("to [s]", "chi2", *question.keys, "reason"),
        [
            (
                f"{stage.end_s:.4f}", f"{stage.chi2:.3g}",
                *(f"{value:.6g} ±{half:.1g}" for value, half in zip(stage.values, stage.half_widths, strict=True)),
                stage.why,
            )
            for stage in result.stages
        ],
        caption="These fits have a weak prior around the start: an interval as wide as the prior has no information.",
    )  # fmt: skip
    return report


@house_style()
def overlay(result: Identification) -> Figure:
    """Draw samples, fit and residuals of the channels."""
    observation, window = result.question.observation, result.window
    predicted = window.predicted(result.z) * observation.noise
    residuals = window.residuals(result.z)
    moved = np.argsort(-np.ptp(predicted / observation.noise, axis=0), kind="stable")[:_MAX_PANELS]
    shown = sorted(int(place) for place in moved)
    figure = new_figure(1.35 * len(shown) + 0.8)
    panels = figure.subplots(len(shown), 2, squeeze=False, sharex=True)
    times_s = observation.times_s[: window.rows]
    panels[0][0].set_xlim(_shown_from_s(times_s, predicted / observation.noise), times_s[-1])
    for (left, right), place in zip(panels, shown, strict=True):
        left.plot(times_s, observation.values[: window.rows, place], "o", color=ORANGE, ms=3.5, label="recorded")
        left.plot(times_s, predicted[:, place], color=BLUE, lw=1.1, label="fitted")
        left.set_ylabel(axis_label(observation.names[place], observation.units[place]).replace(" ", "\n"))
        right.plot(times_s, residuals[:, place], ".", color=RED, ms=3.5, label="residual over noise [1]")
    for axes in panels[-1]:
        axes.set_xlabel("simulated time [s]")
    add_legend(figure, *panels[0])
    return figure


def _shown_from_s(times_s: np.ndarray, predicted: np.ndarray) -> float:
    """Return a time shortly before the first impact of the prediction [s], else that of the first sample."""
    bends = np.nan_to_num(np.abs(np.diff(predicted, 2, axis=0))).max(axis=1)
    if not len(bends) or bends.max() < _MIN_PEAK * max(float(np.median(bends[: len(bends) // 4 + 1])), 1e-12):
        return float(times_s[0])
    first_s = float(times_s[int(np.argmax(bends > _ONSET_FRACTION * bends.max())) + 1])
    return max(float(times_s[0]), first_s - 0.15 * (float(times_s[-1]) - first_s))


@house_style()
def growth(result: Identification) -> Figure:
    """Draw the intervals over the end of the window, and the correlation of the values."""
    keys = result.question.keys
    figure = new_figure(4.6)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    ends = [stage.end_s for stage in result.stages]
    left.set_prop_cycle(color=[BLUE, RED, GREEN, PINK, ORANGE, SKY, BLACK], marker=list("osD^vhP"))
    for place, unknown in enumerate(result.question.unknowns):
        left.semilogy(ends, [stage.half_widths[place] / unknown.scale for stage in result.stages], label=unknown.key)
    left.set(title="Interval widths", xlabel="end of the window [s]", ylabel="half of the 95 % interval / scale [1]")
    image = right.imshow(result.judgement.correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0)
    # Names once, at the side: below the picture long ones would run off it.
    right.set_xticks(range(len(keys)), [str(place + 1) for place in range(len(keys))])
    right.set_yticks(range(len(keys)), [f"{key}  {place + 1}" for place, key in enumerate(keys)])
    right.grid(visible=False)
    right.set_title("Correlation")
    for row, place in np.argwhere(np.isfinite(result.judgement.correlation)) if len(keys) <= _MAX_LABELLED else ():
        value = result.judgement.correlation[row, place]
        right.text(place, row, f"{value:+.2f}", ha="center", va="center", color="white" if abs(value) > 0.6 else BLACK)
    figure.colorbar(image, ax=right, label="correlation [1]", shrink=0.8)
    add_legend(figure, left)
    return figure
