"""The report of a validation: tables, and pictures of what was recorded over what was foretold."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from replays.canvas import BLUE, ORANGE, RED, draw_grid, new_figure
from replays.prediction import Measured
from replays.report import Mark, Report, Row
from replays.validation.outcome import Validation
from replays.validation.phases import PHASES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_POINTS = 6000
"""Points of a line; of more, each is the extremes of a few."""
_MARKS: dict[bool | None, Mark] = {True: "good", False: "bad", None: "plain"}
_WORDS = {True: "good", False: "fails", None: "not asked"}


def make_report(found: Validation) -> Report:
    """All of a validation as a report."""
    report = Report(f"Validation of {found.path.name}", f"{found.bits_line}. {found.verdict_line}.")
    report.table(("what", "is"), _about(found))
    if found.explained is not None:
        one = found.explained
        report.heading("What explains the difference")
        report.text(f"The first difference is at {one.from_s:.4f} s. {one.conclusion[0].upper()}{one.conclusion[1:]}.")
        report.table(
            ("kind", "what", "change", "explains", "noise left", "seen to [s]"),
            [
                Row((e.kind, e.name, e.change, f"{e.explained:.2%}", f"{e.left:.3g}", f"{e.to_s:.3f}"),
                    "good" if e.name in one.best else "plain")
                for e in one.ranked[:20]
            ],
            caption="Each candidate alone, fitted to the recorded channels over their noise; `explains` is the part of "
            "the residual's sum of squares beyond noise that it takes away, `noise left` 1 where only noise is left.",
        )  # fmt: skip
    report.heading("Bits")
    report.table(
        ("stream", "rows", "payloads that differ", "first difference [s]", "largest", "lost rows", "verdict"),
        [
            Row((key, str(b.rows), str(b.different),
                 "" if b.first_s is None else f"{b.first_s:.6f}", f"{b.largest:.3g}",
                 str(b.skipped), "equal" if b.equal else "differs"), "good" if b.equal else "open")
            for key, b in found.bits.items()
        ],
        caption="Largest difference in counts of the converter, or SI for truth.",
    )  # fmt: skip
    report.heading("Trajectory")
    begin, end = found.window_s
    report.text(f"Compared sample by sample from {begin:.4f} to {end:.4f} s: {found.window_reason}.")
    report.table(
        ("channel", "noise", "RMS", "limit", "largest", "drift", "reason of the limit", "verdict"),
        [
            Row((r.channel, f"{r.floor:.3g} {r.unit}", f"{r.rms:.3f}", f"{r.limit:.3f}", f"{r.peak:.2f}",
                 f"{r.drift:.2f}", r.reason, _WORDS[r.good]), _MARKS[r.good])
            for r in found.residuals
        ],
        caption="Residual over the noise of the recording's own channel table; drift: largest mean of 128 samples, in "
        "standard errors.",
    )  # fmt: skip
    if found.truth:
        report.table(
            ("truth", "column that is off most", "off by", "limit", "verdict"),
            [
                Row((t.table, t.column, f"{t.relative:.2e}", f"{t.limit:.2e}", _WORDS[t.good]), _MARKS[t.good])
                for t in found.truth
            ],
        )
    for part in found.parts.values():
        report.picture(_group(found, part), f"{part.group}: recorded over foretold, and the residual over its noise.")
    report.heading("Phases")
    report.table(
        ("phase", "quantity", "recorded", "foretold", "spread", "limit", "unit", "verdict"),
        [
            Row((s.phase, s.quantity, f"{s.recorded:.6g}", f"{s.foretold:.6g}", f"{s.spread:.2g}",
                 "" if s.limit is None else f"{s.limit:.2g}", s.unit, _WORDS[s.good]), _MARKS[s.good])
            for s in found.statistics
        ],
        caption="Foretold is the median, spread the standard deviation over perturbed re-simulations with noise; "
        f"phases are read off the recording ({', '.join(PHASES)}).",
    )  # fmt: skip
    names = {name for part in found.parts.values() for name in part.names}
    pairs = [pair for pair in (("ring_x", "ring_y"), ("disk_x", "disk_y")) if names.issuperset(pair)]
    if pairs:
        report.picture(
            _orbits(found, pairs), "Orbits and full spectra (two-sided, of x + j y), over the whole recording."
        )
    return report


def _about(found: Validation) -> list[Row]:
    rows = [
        Row(("recording", str(found.path.name))),
        Row(("scene", found.scene)),
        Row(("criteria", found.criteria)),
        Row(("phases", "; ".join(f"{p.name} {p.from_s:.3f} to {p.to_s:.3f} s" for p in found.phases))),
        Row(("rows lost", str(found.skipped))),
    ]
    rows += [Row(("changed", f"{key} = {value}")) for key, value in found.changes.items()]
    rows += [Row(("fitted first", line)) for line in found.fitted]
    rows += [Row(("calibration", line), "open") for line in found.calibration]
    rows += [Row(("fails", failure), "bad") for failure in found.failures]
    return rows


def _foretold(found: Validation, part: Measured) -> np.ndarray:
    assert found.nominal is not None
    return found.nominal.values[part.group]


def _group(found: Validation, part: Measured) -> Figure:
    """Overlay and residual of every channel of a group."""
    n = len(part.channels)
    figure = new_figure((10.0, 1.9 * n + 0.6), layout="constrained")
    panels = figure.subplots(n, 2, squeeze=False, sharex=True)
    values = _foretold(found, part)
    begin, end = float(part.times_s[0]), float(part.times_s[-1])
    if found.explained is not None:  # what is of interest begins at the first difference
        begin, end = found.explained.from_s - 0.02, found.explained.to_s
    rows = slice(*np.searchsorted(part.times_s, (begin, end)))
    times = part.times_s[rows]
    for c, channel in enumerate(part.channels):
        left, right = panels[c]
        left.plot(*_thin(times, part.values[rows, c]), color=BLUE, lw=1.0, label="recorded")
        left.plot(*_thin(times, values[rows, c]), color=ORANGE, lw=0.8, ls="--", label="foretold")
        right.plot(*_thin(times, (part.values[rows, c] - values[rows, c]) / part.floor[c]), color=RED, lw=0.7)
        left.set_ylabel(f"{channel.name} [{channel.unit}]")
        right.set_ylabel("residual / noise")
        for axes in (left, right):
            axes.axvline(found.window_s[1], color="0.6", lw=0.8, ls=":")
        draw_grid(left, right)
    panels[0][0].legend(loc="upper right", fontsize=8)
    panels[0][1].set_title("dotted: end of the window", fontsize=9)
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")
    return figure


def _thin(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line that looks the same with fewer points: lowest and highest of every few."""
    every = len(times) // (_POINTS // 2)
    if every < 2:
        return times, values
    whole = len(times) // every * every
    folded = values[:whole].reshape(-1, every)
    ends = np.column_stack([folded.min(axis=1), folded.max(axis=1)]).ravel()
    return np.repeat(times[:whole:every], 2), ends


def _orbits(found: Validation, pairs: list[tuple[str, str]]) -> Figure:
    figure = new_figure((10.0, 4.2 * len(pairs)))
    panels = figure.subplots(len(pairs), 2, squeeze=False)
    for (left, right), pair in zip(panels, pairs, strict=True):
        part = next(part for part in found.parts.values() if pair[0] in part.names)
        columns = [part.names.index(name) for name in pair]
        signals = [
            values[:, columns[0]] + 1j * values[:, columns[1]] for values in (part.values, _foretold(found, part))
        ]
        rate = 1.0 / float(np.median(np.diff(part.times_s)))
        for signal, colour, label, style in zip(
            signals, (BLUE, ORANGE), ("recorded", "foretold"), ("-", "--"), strict=True
        ):
            left.plot(signal.real, signal.imag, style, color=colour, lw=0.5, label=label, rasterized=True)
            window = np.hanning(len(signal))
            spectrum = np.abs(np.fft.fft((signal - signal.mean()) * window)) / window.sum()
            frequency = np.fft.fftfreq(len(signal), 1.0 / rate)
            shown = np.fft.fftshift(np.abs(frequency) < 250.0)
            right.semilogy(np.fft.fftshift(frequency)[shown], np.fft.fftshift(spectrum)[shown] + 1e-12, style,
                           color=colour, lw=0.8)  # fmt: skip
        left.set_aspect("equal")
        left.set_xlabel(f"{pair[0]} [mm]")
        left.set_ylabel(f"{pair[1]} [mm]")
        left.legend(loc="upper right", fontsize=8)
        right.set_xlabel("frequency [Hz], negative is backward")
        right.set_ylabel("amplitude [mm]")
        draw_grid(left, right)
    return figure
