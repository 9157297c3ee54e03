"""The verdict on a hammer recording: measured from its samples, against the law, the paper, and what a stream must keep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recorder.reader import Recording
from replays.whirl import parameter_si, whirl_figures
from rig.errors import InputError

PAPER_WHIRL_HZ = 83.7
"""The paper's Fig. 14, at 6.2 Hz."""
PAPER_SPIN_HZ = 6.2
PAPER_REACTION_N = (0.0, 900.0)
"""Axis of the paper's Fig. 16, simulated, at 6.2 Hz."""


@dataclass(frozen=True)
class Row:
    """One line of the verdict; `good` is None where nothing is asked for."""

    quantity: str
    measured: str
    expected: str
    good: bool | None


@dataclass(frozen=True)
class Verdict:
    """All lines, and whether all that were asked for are good."""

    rows: tuple[Row, ...]

    @property
    def good(self) -> bool:
        """No line failed."""
        return all(row.good is not False for row in self.rows)


def hammer_time_s(recording: Recording) -> float:
    """Simulated time of the first blow [s].

    Raises:
        InputError: There is none in the recording.
    """
    for event in recording.events:
        if event.get("event") == "hammer":
            return float(event["time_s"])
    raise InputError("recording", "one with a hammer blow in it", str(recording.path))


def judge(recording: Recording) -> Verdict:
    """Judge a recording of a hammer blow that leads to whirl; the last two seconds are taken as settled.

    Raises:
        InputError: There is no blow in the recording, or it is too short after it.
    """
    blow_s = hammer_time_s(recording)
    probes, drive, forces = recording.samples("probes"), recording.samples("drive"), recording.samples("forces")
    end_s = float(probes.times_s[-1])
    figures = whirl_figures(recording, max(blow_s + 0.5, end_s - 2.0), end_s)
    clearance = parameter_si(recording, "ring.clearance")
    off_law = figures.frequency_hz / figures.law_hz - 1.0
    rows = [
        Row("whirl frequency, ring probes", f"{figures.frequency_hz:.3f} Hz", f"{figures.law_hz:.3f} Hz = -spin R_S/(r0+delta), within 0.2 %", abs(off_law) < 2e-3),
        Row("whirl frequency, disk probes", f"{figures.disk_frequency_hz:.3f} Hz", f"{figures.law_hz:.3f} Hz, within 0.2 %", abs(figures.disk_frequency_hz / figures.law_hz - 1) < 2e-3),
        Row("sense of rotation", "backward" if figures.frequency_hz < 0 else "forward", "backward", figures.frequency_hz < 0),
        Row("rolling: slip", f"{figures.slip:+.3%}", "below 0.2 %", abs(figures.slip) < 2e-3),
        Row("orbit in the ring", f"{figures.radius_m * 1e3:.4f} mm", f"r0 = {clearance * 1e3:.3f} mm + delta", figures.radius_m > clearance * 0.99),
    ]  # fmt: skip
    spun = drive.column("speed")
    before = float(np.mean(spun[drive.times_s < blow_s])) if (drive.times_s < blow_s).any() else float("nan")
    if abs(before - PAPER_SPIN_HZ) < 0.05:
        scaled = figures.frequency_hz / figures.spin_hz * PAPER_SPIN_HZ
        rows += [
            Row("against the paper's Fig. 14", f"{figures.frequency_hz:.2f} Hz at {figures.spin_hz:.3f} Hz spin", f"-{PAPER_WHIRL_HZ} Hz, within 3 % (our drive gives way: torque law assumed)", abs(figures.frequency_hz / -PAPER_WHIRL_HZ - 1) < 0.03),
            Row("  the same at 6.2 Hz spin", f"{scaled:.2f} Hz", f"-{PAPER_WHIRL_HZ} Hz, within 1.5 % (delta lowers ours)", abs(scaled / -PAPER_WHIRL_HZ - 1) < 0.015),
            Row("reaction E/W, whirl", f"{figures.reaction_x_n:.0f} N", "0-900 N simulated (Fig. 16 axis); +-500 N measured", PAPER_REACTION_N[0] < figures.reaction_x_n < PAPER_REACTION_N[1]),
        ]  # fmt: skip
    else:
        rows.append(Row("reaction E/W, whirl", f"{figures.reaction_x_n:.0f} N", "", None))
    rows.append(Row("reaction N/S, whirl", f"{figures.reaction_y_n:.0f} N", "", None))
    pair = forces.column("P_E") - forces.column("P_W")
    rows.append(Row("largest reaction E/W, impacts", f"{np.abs(pair[forces.times_s >= blow_s]).max():.0f} N", "below 5000 N (Fig. 15 axis)", bool(np.abs(pair).max() < 5000.0)))  # fmt: skip
    after = spun[drive.times_s >= blow_s]
    rows.append(Row("spin: before, lowest, settled", f"{before:.3f} / {after.min():.3f} / {figures.spin_hz:.3f} Hz", "dips, and recovers in part", bool(after.min() < before - 0.05)))  # fmt: skip
    rows += stream_rows(recording)
    return Verdict(tuple(rows))


def stream_rows(recording: Recording) -> list[Row]:
    """What a recording says about its own stream: losses and pace."""
    streams = recording.streams
    lost = sum(stream.lost for stream in streams.values())
    count = sum(stream.rows for key, stream in streams.items() if "/sensors/" in key)
    rows = [
        Row("samples lost", f"{lost} of {count} rows", "0", lost == 0 and not recording.gaps),
        Row("recording", recording.end_reason, "complete", recording.complete),
    ]
    if recording.statuses:
        status = recording.statuses[-1]
        late = status["lateness_ms"]
        block = status["block_ms"]
        rows += [
            Row("lateness p50 / p99 / max", f"{late['p50']:.3f} / {late['p99']:.3f} / {late['max']:.3f} ms", f"p99 below a block of {block:g} ms", late["p99"] < block),
            Row("real-time factor", f"{status['real_time_factor']:.4f}", "1.000", abs(status["real_time_factor"] - 1.0) < 2e-3),
            Row("energy residual", f"{status['energy']['residual_j']:.1e} J of {status['energy']['dissipated_j']:.2f} J", "below 1e-6 of what was dissipated", abs(status["energy"]["residual_j"]) < 1e-6 * max(status["energy"]["dissipated_j"], 1e-6)),
        ]  # fmt: skip
    return rows
