"""Verdict on a hammer recording from its samples: rolling law, the paper, and integrity of the stream."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from recorder.reader import Recording
from replays.recordings.whirl import WhirlFigures, parameter_si, reactions, whirl_figures
from rig.base.errors import InputError
from rig.base.text import build_html_table

PAPER_WHIRL_HZ = 83.7
"""Whirl frequency in the paper's Fig. 14, at 6.2 Hz spin."""
PAPER_SPIN_HZ = 6.2


_LATE_REMARK = (
    "The samples came late: the machine was busy, or is too slow for real time. The recording is not affected, as "
    "simulated time is counted in steps and not read from a clock."
)


@dataclass(frozen=True)
class VerdictRow:
    """Line of the verdict; `good` is None if nothing is required."""

    quantity: str
    measured: str
    expected: str
    good: bool | None


@dataclass(frozen=True)
class Verdict:
    """Lines of the verdict, and a remark."""

    rows: tuple[VerdictRow, ...]
    remark: str = ""

    @property
    def good(self) -> bool:
        """True if no line failed."""
        return all(row.good is not False for row in self.rows)

    def _repr_html_(self) -> str:
        words = {None: "", True: "pass", False: "fail"}
        rows = [(row.quantity, row.measured, row.expected, words[row.good]) for row in self.rows]
        return build_html_table(self.remark or "Verdict", ("quantity", "measured", "expected", "verdict"), rows)


def hammer_time_s(recording: Recording) -> float:
    """Return the simulated time of the first hammer pulse [s].

    Raises:
        InputError: The recording has no hammer pulse.
    """
    for event in recording.events:
        if event.get("event") == "hammer":
            return float(event["time_s"])
    raise InputError("recording", "one with a hammer pulse", str(recording.path))


def judge(recording: Recording) -> Verdict:
    """Judge a recording of a hammer pulse that leads to whirl; the last two seconds count as settled.

    Raises:
        InputError: The recording has no hammer pulse, or is too short after it.
    """
    hammer_s = hammer_time_s(recording)
    end_s = float(recording.samples("probes").times_s[-1])
    figures = whirl_figures(recording, max(hammer_s + 0.5, end_s - 2.0), end_s)
    drive = recording.samples("drive")
    spin = drive["speed"]
    before, after = spin[drive.times_s < hammer_s], spin[drive.times_s >= hammer_s]
    before_hz = float(np.mean(before)) if len(before) else float("nan")
    rows = [
        *_law_rows(figures),
        _orbit_row(recording, figures),
        *_paper_rows(figures, before_hz=before_hz),
        _fact("reaction N/S, whirl", f"{figures.reaction_y_n:.0f} N"),
        _impact_row(recording, hammer_s),
        _spin_row(figures, before_hz=before_hz, lowest_hz=float(after.min())),
        *stream_rows(recording),
    ]
    status = recording.last_status
    return Verdict(tuple(rows), "" if status is None or not _is_late(status) else _LATE_REMARK)


def stream_rows(recording: Recording) -> list[VerdictRow]:
    """Return the lines on losses and pace of the stream."""
    streams = recording.streams
    lost = sum(stream.lost for stream in streams.values())
    count = sum(stream.rows for key, stream in streams.items() if "/sensors/" in key)
    rows = [
        _judge("samples lost", f"{lost} of {count} rows", "0", lost == 0 and not recording.gaps),
        _judge("recording", recording.end_reason, "complete", recording.complete),
    ]
    if recording.last_status is not None:
        rows += _status_rows(recording.last_status)
    return rows


def _judge(quantity: str, measured: str, expected: str, good: bool) -> VerdictRow:
    # `is False` fails for numpy booleans.
    return VerdictRow(quantity, measured, expected, bool(good))


def _fact(quantity: str, measured: str, comparison: str = "") -> VerdictRow:
    """Return a line without a verdict, with a value for comparison."""
    return VerdictRow(quantity, measured, comparison, None)


def _is_close(value: float, expected: float, *, within: float) -> bool:
    return abs(value / expected - 1.0) < within


def _law_rows(figures: WhirlFigures) -> list[VerdictRow]:
    """Return the lines that compare the whirl with the law of rolling."""
    whirl_hz, disk_hz, law_hz = figures.frequency_hz, figures.disk_frequency_hz, figures.law_hz
    ring_hz = f"{whirl_hz:.3f} Hz, slip {figures.slip:.3%}"
    law = f"{law_hz:.3f} Hz = -spin R_S/(r0+delta), within 0.2 %"
    disk_law = f"{law_hz:.3f} Hz, within 0.2 %"
    sense = "backward" if whirl_hz < 0 else "forward"
    return [
        _judge("whirl frequency, ring probes", ring_hz, law, _is_close(whirl_hz, law_hz, within=2e-3)),
        _judge("whirl frequency, disk probes", f"{disk_hz:.3f} Hz", disk_law, _is_close(disk_hz, law_hz, within=2e-3)),
        _judge("sense of rotation", sense, "backward", whirl_hz < 0),
    ]


def _orbit_row(recording: Recording, figures: WhirlFigures) -> VerdictRow:
    """Return the line that compares the indentation in the ring with Hertz's at the measured force."""
    delta_m = figures.radius_m - parameter_si(recording, "ring.clearance")
    force_n = (figures.reaction_x_n + figures.reaction_y_n) / 2
    hertz_m = (force_n / parameter_si(recording, "contact.stiffness")) ** (2 / 3)
    orbit = f"{figures.radius_m * 1e3:.4f} mm = r0 {delta_m * 1e6:+.1f} µm"
    hertz = f"r0 {hertz_m * 1e6:+.1f} µm, Hertz at {force_n:.0f} N, within 15 %"
    return _judge("orbit in the ring", orbit, hertz, _is_close(delta_m, hertz_m, within=0.15))


def _paper_rows(figures: WhirlFigures, *, before_hz: float) -> list[VerdictRow]:
    """Return the lines that compare the whirl with the paper's figures, which hold only at its speed."""
    reaction = f"{figures.reaction_x_n:.0f} N"
    if not abs(before_hz - PAPER_SPIN_HZ) < 0.05:
        return [_fact("reaction E/W, whirl", reaction)]
    whirl_hz, spin_hz = figures.frequency_hz, figures.spin_hz
    scaled_hz = whirl_hz / spin_hz * PAPER_SPIN_HZ
    paper_hz = -PAPER_WHIRL_HZ
    whirl = f"{whirl_hz:.2f} Hz at {spin_hz:.3f} Hz spin"
    as_is = f"{paper_hz} Hz, within 3 % (the drive slows down: assumed torque law)"
    scaled = f"{scaled_hz:.2f} Hz"
    at_its_spin = f"{paper_hz} Hz, within 1.5 % (reduced here by delta)"
    comparison = "the paper: +-500 N measured, 0-900 N axis of its simulation (Figs. 15, 16)"
    return [
        _judge("against the paper's Fig. 14", whirl, as_is, _is_close(whirl_hz, paper_hz, within=0.03)),
        _judge("  the same at 6.2 Hz spin", scaled, at_its_spin, _is_close(scaled_hz, paper_hz, within=0.015)),
        _fact("reaction E/W, whirl", reaction, comparison),
    ]


def _impact_row(recording: Recording, hammer_s: float) -> VerdictRow:
    """Return the line with the largest impacts in each direction."""
    forces = recording.samples("forces")
    after = forces.times_s >= hammer_s
    largest = " / ".join(f"{np.abs(pair[after]).max():.0f} N" for pair in reactions(forces))
    return _fact("largest reactions E/W / N/S", largest, "the paper: +-5000 N, axes of its simulation (Fig. 15)")


def _spin_row(figures: WhirlFigures, *, before_hz: float, lowest_hz: float) -> VerdictRow:
    """Return the line on the spin, which dips at the impacts."""
    spin = f"{before_hz:.3f} / {lowest_hz:.3f} / {figures.spin_hz:.3f} Hz"
    return _judge("spin: before, lowest, settled", spin, "dips, and recovers in part", lowest_hz < before_hz - 0.05)


def _status_rows(status: dict[str, Any]) -> list[VerdictRow]:
    """Return the lines from the rig's last status in the recording; of a run without a clock only its energy."""
    if not status.get("energy"):
        return []  # test signals have no energy
    residual_j, dissipated_j = status["energy"]["residual_j"], status["energy"]["dissipated_j"]
    ledger = f"{residual_j:.1e} J of {dissipated_j:.2f} J"
    alarm = status["energy"].get("alarm_share", 1e-3)  # default of older recordings
    closed = abs(residual_j) < alarm * max(dissipated_j, 1e-6)
    rows = [_judge("energy residual", ledger, f"below {alarm:g} of the dissipated energy", closed)]
    if "lateness_ms" not in status:
        return rows
    late, block_ms, factor = status["lateness_ms"], status["block_ms"], status["real_time_factor"]
    lateness = f"{late['p50']:.3f} / {late['p99']:.3f} / {late['max']:.3f} ms"
    paced = _judge("real-time factor", f"{factor:.4f}", "1.000", abs(factor - 1.0) < 2e-3)
    if _is_late(status) and factor < 1.0:  # real time was not possible
        paced = _fact(paced.quantity, paced.measured, paced.expected)
    expected = f"p99 below a block of {block_ms:g} ms, if the machine is idle"
    return [_fact("lateness p50 / p99 / max", lateness, expected), paced, *rows]


def _is_late(status: dict[str, Any]) -> bool:
    return "lateness_ms" in status and status["lateness_ms"]["p99"] >= status["block_ms"]
