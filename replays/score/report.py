"""Report of a scorecard: its rows, and plots of residuals, frequency response and time errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from replays.report import OUTCOME_MARKS, Mark, Report, Row
from replays.report.canvas import BLUE, ORANGE, RED, axis_label, draw_signals, house_style, new_figure
from replays.score.analogue import Fitted
from replays.score.card.scorecard import (
    FAIL,
    INCONCLUSIVE,
    LEGEND,
    MARKS,
    NO_LIMIT,
    PASS,
    Scorecard,
    Verdict,
    make_matrix,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARKS: dict[Verdict, Mark] = {FAIL: "bad", INCONCLUSIVE: "open", PASS: "good", NO_LIMIT: "plain"}
_MATRIX_COLUMNS = 8
"""Largest number of channels side by side in a matrix, for the width of a page."""
_STRETCHES = 100
"""Parts of a record whose time errors are plotted."""


def make_report(card: Scorecard, *, origin: Mapping[str, str] | None = None) -> Report:
    """Return a scorecard as a report.

    Args:
        card: The scorecard.
        origin: Facts about the origin of the report, by name.
    """
    verdict = card.verdict_line
    report = Report(
        f"Scorecard of {card.title}",
        f"{verdict[0].upper()}{verdict[1:]}.",
        origin=origin,
        mark=OUTCOME_MARKS[card.outcome],
    )
    names, lines = make_matrix(card)
    for first in range(0, len(names) if lines else 0, _MATRIX_COLUMNS):
        part = slice(1 + first, 1 + first + _MATRIX_COLUMNS)
        report.table(
            ("quantity", *names[first : first + _MATRIX_COLUMNS], "worst"),
            [_matrix_row(line[0], line[part]) for line in lines if any(line[part])],
            caption=LEGEND,
        )
    for line in (*card.evidence_gaps, *card.findings):
        report.text(line)
    rows = sorted(card.rows, key=lambda row: list(_MARKS).index(row.verdict))
    report.heading("Scorecard")
    report.table(
        ("quantity", "channel", "value", "95 % interval", "unit", "limit", "note", "verdict"),
        [Row((*row.cells()[:-1], row.note, row.verdict), _MARKS[row.verdict]) for row in rows],
        caption="A quantity passes or fails with its whole interval; one that reaches over its limit is inconclusive.",
    )
    unshown = {row.quantity: row.run for row in card.rows if row.verdict == INCONCLUSIVE}
    if unshown:
        report.heading("Inconclusive in this run")
        report.table(("quantity", "what to run"), list(unshown.items()))
    report.heading("Limits and methods")
    methods = {(row.quantity, row.method, row.limit.source if row.limit else "none") for row in card.rows}
    report.table(("quantity", "method of the interval", "source of the limit"), sorted(methods))
    for name, about in card.pictures.items():
        if isinstance(about, Fitted):
            report.heading(about.name)
            report.picture(
                _channel(about),
                "Residual of the record after subtraction of the known signal, over time and by recorded value; time "
                "error of each stretch against the fitted clock; and response relative to that of the lowest "
                "frequencies, where the signal determines it.",
            )
        elif len(about):
            report.heading(name)
            report.picture(_stamps(about), "Time stamps less the times of their rows.")
    return report


def _matrix_row(quantity: str, marks: tuple[str, ...]) -> Row:
    worst: Verdict = next(verdict for verdict in _MARKS if MARKS[verdict] in marks and MARKS[verdict])
    return Row((quantity, *marks, worst), _MARKS[worst])


@house_style()
def _channel(one: Fitted) -> Figure:
    clean, unit = one.clean, one.channel.unit
    figure = new_figure(6.0)
    ((left, values), (time, gain)) = figure.subplots(2, 2)
    draw_signals(left, clean.times_s, (clean.residual, BLUE, "residual"))
    left.set(title="Residual", xlabel="time [s]", ylabel=axis_label("residual", unit))
    good = one.values[np.isfinite(one.values)]
    values.hist(good, bins=256, color=BLUE)
    values.set(title="Recorded values", xlabel=axis_label(one.name, unit), ylabel="samples", yscale="log")
    middle, late_s = lateness(one)
    time.plot(middle, 1e9 * late_s, ".", color=ORANGE, ms=4)
    time.set(title="Time error", xlabel="time [s]", ylabel="late [ns]")
    if one.shown is not None:
        gain.semilogx(one.shown.frequency_hz, 20.0 * np.log10(one.shown.gain), color=BLUE)
        gain.axhline(-3.0103, color=RED, lw=0.8)
    gain.set(title="Response", xlabel="frequency [Hz]", ylabel="gain [dB]")
    return figure


def lateness(one: Fitted) -> tuple[np.ndarray, np.ndarray]:
    """Return the times [s] and time errors [s] of stretches against the fitted clock, each shape (stretches,)."""
    clean = one.clean
    edges = np.linspace(0, len(clean.residual), _STRETCHES + 1).astype(int)[:-1]
    steep = clean.gain * clean.slope
    power = np.add.reduceat(steep**2, edges)
    late_s = np.divide(
        np.add.reduceat(steep * clean.residual, edges), power, out=np.zeros(len(edges)), where=power > 0.0
    )
    return clean.times_s[edges], late_s


@house_style()
def _stamps(means: np.ndarray) -> Figure:
    figure = new_figure(2.6)
    axes = figure.subplots()
    late = means[:, 1] - means[0, 1]
    axes.plot(means[:, 0], 1e6 * late, ".", color=ORANGE, ms=4)
    axes.set(xlabel="time since the first row [s]", ylabel=f"late [µs], from {means[0, 1]:.9g} s on")
    return figure
