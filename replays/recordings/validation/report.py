"""Report of a validation: tables, and plots of recorded and predicted signals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.recordings.identification.request import fit_unit
from replays.recordings.resimulation.prediction import Measured
from replays.recordings.resimulation.sensitivity import CLOCK
from replays.recordings.validation.criteria import Criteria
from replays.recordings.validation.explanations.budget import COVERAGE
from replays.recordings.validation.outcome import Validation
from replays.recordings.validation.phases import PHASES
from replays.recordings.validation.statistics import NOT_JUDGED
from replays.recordings.validation.trajectory import PULSES_ONLY
from replays.report import OUTCOME_MARKS, Mark, Report, Row
from replays.report.canvas import BLUE, ORANGE, RED, add_legend, axis_label, draw_signals, house_style, new_figure
from rig.channels.orbit import full_spectrum

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STRETCHES = 160
"""Intervals of time in the overview plot of residuals."""
_BEFORE_S, _AFTER_S = 5e-3, 60e-3
"""Time before and after an event in a detail plot."""
_MARKS: dict[bool | None, Mark] = {True: "good", False: "bad", None: "plain"}
_WORDS = {True: "pass", False: "fail", None: "no limit"}


def make_report(validation: Validation, *, origin: Mapping[str, str] | None = None) -> Report:
    """Return a validation as a report.

    Args:
        validation: The validation.
        origin: Facts about the origin of the report, by name.
    """
    report = Report(
        f"Validation of {validation.title}",
        f"{_sentence(validation.verdict_line)}.",
        origin=origin,
        mark=OUTCOME_MARKS[validation.outcome],
    )
    if validation.parts and validation.nominal is not None:
        report.picture(
            _overview(validation),
            "Difference of recorded and predicted signals over the noise of each channel: 1 is noise alone.",
        )
    _conclusion(report, validation)
    _bits(report, validation)
    _trajectory(report, validation)
    _phases(report, validation)
    if validation.calibration:
        report.heading("Calibration")
        report.text("The recording's own calibration is used throughout. Differences from the rig's channel table:")
        report.table(("channel", "differs in"), [tuple(line.partition(": ")[::2]) for line in validation.calibration])
    return report


def make_budget_report(
    validation: Validation, criteria: Criteria, *, origin: Mapping[str, str] | None = None
) -> Report:
    """Return the uncertainty budget of a log's validation as a report.

    Args:
        validation: The validation, with budgets.
        criteria: Criteria, with the assumed uncertainties.
        origin: Facts about the origin of the report, by name.
    """
    report = Report(
        f"Uncertainty budget of {validation.title}",
        f"U is the expanded uncertainty with k = {COVERAGE:g}, about 95 %; other columns are standard uncertainties.",
        origin=origin,
    )
    keys = [one.key for one in validation.fitted]
    for title, budgets in (
        ("Fitted numbers", [one for one in validation.budgets if one.name in keys]),
        ("Judged quantities", [one for one in validation.budgets if one.name not in keys]),
    ):
        if not budgets:
            continue
        report.heading(title)
        report.table(
            ("number", "value", *budgets[0].contributions, "combined", "U"),
            [
                (f"{one.name} [{one.unit or '1'}]", f"{one.value:.6g}",
                 *(f"{u:.2g}" for u in (*one.contributions.values(), one.combined, one.expanded)))
                for one in budgets
            ],
        )  # fmt: skip
    report.heading("Sources")
    report.table(("source", "standard uncertainty", "basis", "degrees of freedom"), _sources(validation, criteria))
    report.text(
        "Contributions are combined as independent ones. After the first impacts the motion is chaotic: its spread is "
        "in `fit`. Clock, pulse and friction are less repeatable than their `noise`; this is in `model`. "
        "Not known, and not included: linearity, temperature, cross-sensitivity and mounting of the sensors; "
        "repeatability of the experiment, as the log is a single run."
    )
    return report


def _sources(validation: Validation, criteria: Criteria) -> list[tuple[str, str, str, str]]:
    """Return the inputs of a budget: source, standard uncertainty, basis, degrees of freedom."""
    rules = criteria.imported
    draws = -(-criteria.ensemble.members // (len(rules.variants) + 1))
    priors = {one.key: f"{one.key} {one.prior[1]:.2g} {fit_unit(one.key)}" for one in validation.fitted if one.prior}
    clock, others = (
        ", ".join(text for key, text in priors.items() if (key in CLOCK) is here) or "none" for here in (True, False)
    )
    variants = ", ".join(f"{key} = {value}" for one in rules.variants for key, value in one.set.items())
    corner = f"; {validation.calibration_line}" if validation.calibration else ""
    fitted, assumed = len(validation.fitted), "assumed: criteria, [imported]"
    return [
        ("noise", "of each channel", "measured in the log, by its spectrum", f"samples - {fitted}"),
        ("calibration", f"{rules.calibration:.2%} of each channel", f"{assumed} calibration", "not known"),
        ("filter", f"{1.0 - rules.bandwidth:.1%} of each corner", f"{assumed} bandwidth{corner}", "not known"),
        ("clock", clock, "assumed: a crystal, a trigger found in filtered samples", "not known"),
        ("inputs", others, "assumed, or read from the log (speed, pulse)", "not known"),
        ("model", variants, f"{assumed} variants", "not known"),
        ("model", "of each number", "changes with the window, and jackknife over channels and blocks of time", "2"),
        ("fit", "of all fitted numbers", "draws from their uncertainty", str(draws)),
    ]


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:]


def _conclusion(report: Report, validation: Validation) -> None:
    """Add the conclusion: first the explanation of the difference, then every criterion that fails."""
    one = validation.explained
    if one is not None:
        report.text(f"The first difference is at {one.from_s:.4f} s. {_sentence(one.conclusion)}.")
    report.text(f"{_sentence(validation.bits_line)}.")
    report.table(("item", "value"), _about(validation))
    if validation.failures and not validation.good:
        report.heading("Failed criteria")
        report.table(
            ("criterion", "recorded", "predicted", "limit", "verdict"),
            [Row((f.criterion, f.recorded, f.foretold, f.limit, "fail"), "bad") for f in validation.failures],
            caption="For a residual, the first measure beyond its limit; ± is the largest difference.",
        )
    if one is None or not one.ranked:
        return
    report.heading("Explanations of the difference")
    report.table(
        ("kind", "candidate", "change", "explained", "residual", "fitted to [s]", "verdict"),
        [
            Row((e.kind, e.name, e.change, e.part, f"{e.left:.3g}", f"{e.to_s:.3f}",
                 "named" if e.name in one.best else ""), "good" if e.name in one.best else "plain")
            for e in one.ranked[:20]
        ],
        caption="Each candidate alone, fitted to the recorded channels over their noise; `explained` is the part of "
        "the residual's sum of squares beyond noise that it removes, `residual` the RMS of the rest "
        "over the noise: 1 is noise alone.",
    )  # fmt: skip


def _bits(report: Report, validation: Validation) -> None:
    if not validation.bits:
        return
    report.heading("Bits")
    report.table(
        ("stream", "columns", "rows", "different payloads", "first difference [s]", "largest", "lost rows",
         "verdict"),
        [
            Row((key, b.picked or "all", str(b.rows), str(b.different),
                 "" if b.first_s is None else f"{b.first_s:.6f}", f"{b.largest:.3g}",
                 str(b.skipped), "equal" if b.equal else "differs"), "good" if b.equal else "open")
            for key, b in validation.bits.items()
        ],
        caption="Largest difference in counts of the converter, or SI for truth.",
    )  # fmt: skip


def _trajectory(report: Report, validation: Validation) -> None:
    report.heading("Trajectory")
    begin, end = validation.window_s
    report.text(f"Compared sample by sample from {begin:.4f} to {end:.4f} s: {validation.window_reason}.")
    report.table(
        ("channel", "noise", "RMS", "limit", "largest", "drift", "reason of the limit", "verdict"),
        [
            Row((r.channel, f"{r.floor:.3g} {r.unit}".rstrip(), f"{r.rms:.3f}",
                 "" if math.isinf(r.limit) else f"{r.limit:.3f}", f"{r.peak:.2f}", f"{r.drift:.2f}", r.reason,
                 _WORDS[r.good] + (PULSES_ONLY if r.pulses else "")), _MARKS[r.good])
            for r in validation.residuals
        ],
        caption="Residual over the noise of the recording's own channel table; drift: largest mean of 128 samples, in "
        "standard errors.",
    )  # fmt: skip
    if validation.truth:
        report.table(
            ("truth", "column with the largest error", "error", "limit", "verdict"),
            [
                Row((t.table, t.column, f"{t.relative:.2e}", f"{t.limit:.2e}", _WORDS[t.good]), _MARKS[t.good])
                for t in validation.truth
            ],
        )
    zooms = _zooms(validation)
    windows = "".join(f" and from {begin:.3f} to {end:.3f} s ({why})" for why, begin, end in zooms)
    for part in validation.parts.values():
        caption = f"{part.group}: recorded and predicted, in whole{windows}, and the residual over its noise."
        caption += " The amplitude of the keyphasor is not compared." * ("keyphasor" in part.names)
        report.picture(_group(validation, part, zooms), caption)


def _phases(report: Report, validation: Validation) -> None:
    report.heading("Phases")
    report.table(
        ("phase", "quantity", "recorded", "predicted", "spread", "limit", "verdict"),
        [
            Row((s.phase, s.title, f"{s.recorded:.6g}", f"{s.foretold:.6g}", f"{s.spread:.2g}",
                 "" if s.limit is None else f"± {s.limit:.2g}", NOT_JUDGED if s.too_wide else _WORDS[s.good]),
                _MARKS[s.good])
            for s in validation.statistics
        ],
        caption="Predicted is the median, spread the standard deviation over perturbed re-simulations with noise; "
        f"phases are read off the recording ({', '.join(PHASES)}). {NOT_JUDGED}: the limit is wider than the value. "
        f"Quantities: {validation.legend()}.",
    )  # fmt: skip
    names = {name for part in validation.parts.values() for name in part.names}
    pairs = [pair for pair in (("ring_x", "ring_y"), ("disk_x", "disk_y")) if names.issuperset(pair)]
    if pairs:
        report.picture(
            _orbits(validation, pairs), "Orbits and full spectra (two-sided, of x + j y), over the whole recording."
        )


def _about(validation: Validation) -> list[Row]:
    rows = [
        Row(("scene", validation.scene)),
        Row(("criteria", validation.criteria)),
        Row(("phases", "; ".join(f"{p.name} {p.from_s:.3f} to {p.to_s:.3f} s" for p in validation.phases))),
        Row(("rows lost", str(validation.skipped))),
    ]
    rows += [Row(("changed", f"{key} = {value}")) for key, value in validation.changes.items()]
    rows += [Row(("fitted first", one.line)) for one in validation.fitted]
    rows += [Row(("tolerated", one.line)) for one in validation.tolerated]
    if validation.calibration:
        rows.append(Row(("calibration", validation.calibration_line.removesuffix("; the report says how"))))
    return rows


def _foretold(validation: Validation, part: Measured) -> np.ndarray:
    assert validation.nominal is not None
    return validation.nominal.values[part.group]


def _zooms(validation: Validation) -> list[tuple[str, float, float]]:
    """Return the windows of detail plots: reason, begin and end [s]; overlapping ones are merged."""
    last_s = max(float(part.times_s[-1]) for part in validation.parts.values())
    starts = []
    if validation.explained is not None:
        starts.append(("the first difference", validation.explained.from_s))
    contacts = [phase.from_s for phase in validation.phases if phase.name not in ("free run", "decay")]
    if contacts:
        starts.append(("the first contact", contacts[0]))
    starts.sort(key=lambda start: start[1])
    zooms: list[tuple[str, float, float]] = []
    for why, start in starts:
        if zooms and start < zooms[-1][2]:
            before, begin, _ = zooms.pop()
            zooms.append((f"{before}, {why}", begin, start + _AFTER_S))
        else:
            zooms.append((why, start - _BEFORE_S, start + _AFTER_S))
    return [(why, begin, min(end, last_s)) for why, begin, end in zooms if begin < last_s]


@house_style()
def _overview(validation: Validation) -> Figure:
    """Draw the residual over noise of every channel over the whole time."""
    from matplotlib.colors import LogNorm

    names = [channel.name for part in validation.parts.values() for channel in part.channels]
    figure = new_figure(0.24 * len(names) + 1.2)
    axes = figure.subplots()
    begin = min(float(part.times_s[0]) for part in validation.parts.values())
    end = max(float(part.times_s[-1]) for part in validation.parts.values())
    edges, row = np.linspace(begin, end, _STRETCHES + 1), 0
    image: Any = None
    for part in validation.parts.values():
        squares = ((part.values - _foretold(validation, part)) / part.floor) ** 2
        place = np.clip(np.digitize(part.times_s, edges) - 1, 0, _STRETCHES - 1)
        rows = np.bincount(place, minlength=_STRETCHES)
        for c in range(len(part.channels)):
            sums = np.bincount(place, np.nan_to_num(squares[:, c]), _STRETCHES)
            rms = np.sqrt(np.divide(sums, rows, out=np.full(_STRETCHES, np.nan), where=rows > 0))
            image = axes.pcolormesh(edges, [row - 0.5, row + 0.5], np.maximum(rms, 0.1)[None], cmap="cividis_r",
                                    norm=LogNorm(1.0, 1e3), rasterized=True)  # fmt: skip
            row += 1
    for window_s in validation.window_s:
        axes.axvline(window_s, color="black", lw=1.2, ls=":")
    axes.set_yticks(range(len(names)), names)
    axes.set(xlabel="time [s]   (dotted: begin and end of the sample by sample comparison)", ylim=(row - 0.5, -0.5))
    figure.colorbar(image, ax=axes, label="RMS of residual over noise [1]", extend="both", pad=0.02)
    return figure


@house_style()
def _group(validation: Validation, part: Measured, zooms: list[tuple[str, float, float]]) -> Figure:
    """Draw recorded and predicted signals of a group in whole, and with residuals in each detail window."""
    whole = ("the whole", float(part.times_s[0]), float(part.times_s[-1]))
    n, looks = len(part.channels), len(zooms or [whole])
    figure = new_figure((1.25 * n + 0.9) * looks + 0.3)
    # Each detail window has its own rows, so that a panel is wide enough to read.
    panels = figure.subplots(n * looks, 3, squeeze=False, sharex=False)
    values = _foretold(validation, part)
    for look, window in enumerate(zooms or [whole]):
        for c, channel in enumerate(part.channels):
            left, middle, right = row = panels[look * n + c]
            _overlay(left, part, values, c, whole)
            _overlay(middle, part, values, c, window)
            _residual(right, part, values, c, window)
            left.set_ylabel(axis_label(channel.name, channel.unit))
            for axes, (why, begin, end) in zip(row, (whole, window, window), strict=True):
                if begin < validation.window_s[1] < end - 1e-6:
                    axes.axvline(
                        validation.window_s[1], color="0.4", lw=1.0, ls=":", label="end of the comparison by sample"
                    )
                if end > begin:
                    axes.set_xlim(begin, end)
                axes.tick_params(labelbottom=c == n - 1)
                if c == 0:
                    axes.set_title("Residual" if axes is right else _sentence(why.partition(",")[0]))
                if c == n - 1:
                    axes.set_xlabel("time [s]")
    add_legend(figure)
    return figure


def _rows(part: Measured, window: tuple[str, float, float]) -> slice:
    _, begin, end = window
    first, last = np.searchsorted(part.times_s, (begin, end + 1e-9))
    return slice(int(first), int(last))


def _overlay(axes: Axes, part: Measured, values: np.ndarray, c: int, window: tuple[str, float, float]) -> None:
    rows = _rows(part, window)
    recorded, predicted = (part.values[rows, c], BLUE, "recorded"), (values[rows, c], ORANGE, "predicted")
    draw_signals(axes, part.times_s[rows], recorded, predicted)


def _residual(axes: Axes, part: Measured, values: np.ndarray, c: int, window: tuple[str, float, float]) -> None:
    rows = _rows(part, window)
    off = (part.values[rows, c] - values[rows, c]) / part.floor[c]
    draw_signals(axes, part.times_s[rows], (off, RED, "residual over noise [1]"))


@house_style()
def _orbits(validation: Validation, pairs: list[tuple[str, str]]) -> Figure:
    figure = new_figure(4.2 * len(pairs) + 0.4)
    panels = figure.subplots(len(pairs), 2, squeeze=False)
    for (left, right), pair in zip(panels, pairs, strict=True):
        part = next(part for part in validation.parts.values() if pair[0] in part.names)
        columns = [part.names.index(name) for name in pair]
        signals = [
            values[:, columns[0]] + 1j * values[:, columns[1]] for values in (part.values, _foretold(validation, part))
        ]
        rate = 1.0 / float(np.median(np.diff(part.times_s)))
        for signal, colour, label, style in zip(
            signals, (BLUE, ORANGE), ("recorded", "predicted"), ("-", "--"), strict=True
        ):
            left.plot(signal.real, signal.imag, style, color=colour, lw=0.8, label=label, rasterized=True)
            frequency, amplitude = full_spectrum(signal.real, signal.imag, rate)
            shown = np.abs(frequency) < 250.0
            right.semilogy(frequency[shown], np.maximum(amplitude[shown], 1e-6), style, color=colour, lw=1.0)
        left.set(title="Orbit", xlabel=f"{pair[0]} [mm]", ylabel=f"{pair[1]} [mm]", aspect="equal")
        right.set(title="Full spectrum", xlabel="frequency [Hz], negative is backward", ylabel="amplitude [mm]")
    add_legend(figure, panels[0][0])
    return figure
