"""The verdict on a hammer recording, from its samples: against the law, the paper, and what a stream must keep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from recorder.reader import Recording
from replays.recordings.whirl import WhirlFigures, parameter_si, reactions, whirl_figures
from rig.base.errors import InputError

PAPER_WHIRL_HZ = 83.7
"""The paper's Fig. 14, at 6.2 Hz."""
PAPER_SPIN_HZ = 6.2


_BUSY = (
    "The samples came late: the machine was busy, or is too slow for real time. That says nothing of the rig: its "
    "time is counted in steps, not read off a clock, so what was recorded is the same, only later."
)


@dataclass(frozen=True)
class VerdictRow:
    """One line of the verdict; `good` is None where nothing is asked for."""

    quantity: str
    measured: str
    expected: str
    good: bool | None


@dataclass(frozen=True)
class Verdict:
    """All lines, what is to be said of them, and whether all that were asked for are good."""

    rows: tuple[VerdictRow, ...]
    remark: str = ""

    @property
    def good(self) -> bool:
        """No line failed."""
        return all(row.good is not False for row in self.rows)


def hammer_time_s(recording: Recording) -> float:
    """Simulated time of the first hammer pulse [s].

    Raises:
        InputError: There is none in the recording.
    """
    for event in recording.events:
        if event.get("event") == "hammer":
            return float(event["time_s"])
    raise InputError("recording", "one with a hammer pulse in it", str(recording.path))


def judge(recording: Recording) -> Verdict:
    """Judge a recording of a hammer pulse that leads to whirl; the last two seconds are taken as settled.

    Raises:
        InputError: There is no hammer pulse in the recording, or it is too short after it.
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
        _stated("reaction N/S, whirl", f"{figures.reaction_y_n:.0f} N"),
        _impact_row(recording, hammer_s),
        _spin_row(figures, before_hz=before_hz, lowest_hz=float(after.min())),
        *stream_rows(recording),
    ]
    status = recording.last_status
    return Verdict(tuple(rows), "" if status is None or not _is_late(status) else _BUSY)


def stream_rows(recording: Recording) -> list[VerdictRow]:
    """What a recording says about its own stream: losses and pace."""
    streams = recording.streams
    lost = sum(stream.lost for stream in streams.values())
    count = sum(stream.rows for key, stream in streams.items() if "/sensors/" in key)
    rows = [
        _judged("samples lost", f"{lost} of {count} rows", "0", lost == 0 and not recording.gaps),
        _judged("recording", recording.end_reason, "complete", recording.complete),
    ]
    if recording.last_status is not None:
        rows += _status_rows(recording.last_status)
    return rows


def _judged(quantity: str, measured: str, expected: str, good: bool) -> VerdictRow:
    # Comparisons of numpy numbers give numpy's own truth, of which none `is False`.
    return VerdictRow(quantity, measured, expected, bool(good))


def _stated(quantity: str, measured: str, beside: str = "") -> VerdictRow:
    """A figure that is not judged, beside something to compare it with."""
    return VerdictRow(quantity, measured, beside, None)


def _near(value: float, expected: float, *, within: float) -> bool:
    return abs(value / expected - 1.0) < within


def _law_rows(figures: WhirlFigures) -> list[VerdictRow]:
    """The whirl against the law of rolling."""
    whirl_hz, disk_hz, law_hz = figures.frequency_hz, figures.disk_frequency_hz, figures.law_hz
    ring_hz = f"{whirl_hz:.3f} Hz, slip {figures.slip:.3%}"
    law = f"{law_hz:.3f} Hz = -spin R_S/(r0+delta), within 0.2 %"
    disk_law = f"{law_hz:.3f} Hz, within 0.2 %"
    sense = "backward" if whirl_hz < 0 else "forward"
    return [
        _judged("whirl frequency, ring probes", ring_hz, law, _near(whirl_hz, law_hz, within=2e-3)),
        _judged("whirl frequency, disk probes", f"{disk_hz:.3f} Hz", disk_law, _near(disk_hz, law_hz, within=2e-3)),
        _judged("sense of rotation", sense, "backward", whirl_hz < 0),
    ]


def _orbit_row(recording: Recording, figures: WhirlFigures) -> VerdictRow:
    """How far the shaft presses into the ring, against Hertz at the force that the transducers show."""
    delta_m = figures.radius_m - parameter_si(recording, "ring.clearance")
    force_n = (figures.reaction_x_n + figures.reaction_y_n) / 2
    hertz_m = (force_n / parameter_si(recording, "contact.stiffness")) ** (2 / 3)
    orbit = f"{figures.radius_m * 1e3:.4f} mm = r0 {delta_m * 1e6:+.1f} µm"
    hertz = f"r0 {hertz_m * 1e6:+.1f} µm, Hertz at {force_n:.0f} N, within 15 %"
    return _judged("orbit in the ring", orbit, hertz, _near(delta_m, hertz_m, within=0.15))


def _paper_rows(figures: WhirlFigures, *, before_hz: float) -> list[VerdictRow]:
    """The whirl against the paper's figures, which hold for its speed alone."""
    reaction = f"{figures.reaction_x_n:.0f} N"
    if not abs(before_hz - PAPER_SPIN_HZ) < 0.05:
        return [_stated("reaction E/W, whirl", reaction)]
    whirl_hz, spin_hz = figures.frequency_hz, figures.spin_hz
    scaled_hz = whirl_hz / spin_hz * PAPER_SPIN_HZ
    paper_hz = -PAPER_WHIRL_HZ
    whirl = f"{whirl_hz:.2f} Hz at {spin_hz:.3f} Hz spin"
    as_is = f"{paper_hz} Hz, within 3 % (our drive gives way: torque law assumed)"
    scaled = f"{scaled_hz:.2f} Hz"
    at_its_spin = f"{paper_hz} Hz, within 1.5 % (delta lowers ours)"
    beside = "the paper: +-500 N measured, 0-900 N the axis of its simulation (Figs. 15, 16)"
    return [
        _judged("against the paper's Fig. 14", whirl, as_is, _near(whirl_hz, paper_hz, within=0.03)),
        _judged("  the same at 6.2 Hz spin", scaled, at_its_spin, _near(scaled_hz, paper_hz, within=0.015)),
        _stated("reaction E/W, whirl", reaction, beside),
    ]


def _impact_row(recording: Recording, hammer_s: float) -> VerdictRow:
    """The hardest impacts, in each direction."""
    forces = recording.samples("forces")
    after = forces.times_s >= hammer_s
    largest = " / ".join(f"{np.abs(pair[after]).max():.0f} N" for pair in reactions(forces))
    return _stated("largest reactions E/W / N/S", largest, "the paper: +-5000 N, the axes of its simulation (Fig. 15)")


def _spin_row(figures: WhirlFigures, *, before_hz: float, lowest_hz: float) -> VerdictRow:
    """The drive gives way to the impacts: the spin dips."""
    spin = f"{before_hz:.3f} / {lowest_hz:.3f} / {figures.spin_hz:.3f} Hz"
    return _judged("spin: before, lowest, settled", spin, "dips, and recovers in part", lowest_hz < before_hz - 0.05)


def _status_rows(status: dict[str, Any]) -> list[VerdictRow]:
    """What the rig said of itself, in its last status of the recording; of a run without a clock only its energy."""
    if not status.get("energy"):
        return []  # signals of a generator have none
    residual_j, dissipated_j = status["energy"]["residual_j"], status["energy"]["dissipated_j"]
    ledger = f"{residual_j:.1e} J of {dissipated_j:.2f} J"
    alarm = status["energy"].get("alarm_share", 1e-3)  # as older recordings have it
    closed = abs(residual_j) < alarm * max(dissipated_j, 1e-6)
    rows = [_judged("energy residual", ledger, f"below {alarm:g} of what was dissipated", closed)]
    if "lateness_ms" not in status:
        return rows
    late, block_ms, factor = status["lateness_ms"], status["block_ms"], status["real_time_factor"]
    lateness = f"{late['p50']:.3f} / {late['p99']:.3f} / {late['max']:.3f} ms"
    paced = _judged("real-time factor", f"{factor:.4f}", "1.000", abs(factor - 1.0) < 2e-3)
    if _is_late(status) and factor < 1.0:  # it could not keep up
        paced = _stated(paced.quantity, paced.measured, paced.expected)
    expected = f"p99 below a block of {block_ms:g} ms, if the machine is free"
    return [_stated("lateness p50 / p99 / max", lateness, expected), paced, *rows]


def _is_late(status: dict[str, Any]) -> bool:
    return "lateness_ms" in status and status["lateness_ms"]["p99"] >= status["block_ms"]
