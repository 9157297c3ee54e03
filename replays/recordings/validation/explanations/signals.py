"""Defects that a log's signals show without a model: freeze, clip, noise, pulses and lost samples."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from replays.estimate.runs import find_true_runs
from replays.recordings.identification.request import measure_noise
from replays.recordings.resimulation.prediction import Measured

_MIN_FROZEN_ROWS = 8
"""Fewest consecutive equal numbers that noise does not cause."""
_MAX_EQUAL_PART = 0.02
"""Largest part of equal neighbours elsewhere, for a stretch to be frozen."""
_RAIL_RUN, RAIL_ROWS = 2, 4
"""Fewest rows at the largest or smallest number for a rail: consecutive, and in all."""
_UNEVENNESS, _UNEVENNESS_S = 8.0, 5e-5
"""Deviation of an uneven turn: in standard deviations of turns, and absolute."""
_EDGE_SAMPLES = 1.05
"""Deviation of a turn between edges that are sampled without a filter [samples]: one, and rounding."""
_SILENT_TURNS = 2.0
"""Turns without any pulse at which pulses are missing."""
_MISSED_TURN = 1.6
"""Length of a turn relative to both neighbours above which a pulse is missing."""
_PULSE_TOLERANCE = 0.2
"""Relative difference of the numbers of pulses and turns."""
_JUMP_FACTOR, _JUMP_QUANTILE = 10.0, 0.995
"""Second difference of a probe in a jump, relative to this quantile of all; inertia prevents it in a motion."""
_NOISE_FACTOR = 3.0
"""Noise of a faulty channel relative to that of similar ones."""
_MIN_COPIED_ROWS, _MAX_COPIED_PART, _MAX_COPIES = 16, 0.5, 8
"""Fewest consecutive rows that are a copy, as noise does not repeat that often; largest part of rows that are copies,
and largest number of distances from the original."""
_MIN_QUIET_ROWS = 64
"""Fewest rows that show a noise to a tenth, far below the factor above."""


class SignalFault(NamedTuple):
    """A defect of a channel.

    Attributes:
        channel: Name of the channel, or "time" for all channels of a group.
        what: Name in the table of defects, as in `Law`.
        from_s: Start [s].
        to_s: End [s].
        text: Size and place.
    """

    channel: str
    what: str
    from_s: float
    to_s: float
    text: str

    @property
    def line(self) -> str:
        """Defect in one line."""
        return f"{self.channel} {self.what}: {self.text}"


def steady_rows(values: np.ndarray, held: int = _MIN_FROZEN_ROWS) -> np.ndarray:
    """Return whether each row is in a stretch of equal numbers, shape (n,)."""
    steady = np.zeros(len(values), dtype=bool)
    for begin, end in find_true_runs(np.concatenate([[False], np.diff(values) == 0.0])):
        if end - begin >= held - 1:
            steady[begin - 1 : end] = True
    return steady


def signal_faults(parts: dict[str, Measured], quiet_s: float = math.inf) -> list[SignalFault]:
    """Return the defects that channels show without a model.

    Args:
        parts: Recorded channels, in their whole length.
        quiet_s: Time up to which the shaft touches nothing [s]; a rub looks like noise of an accelerometer.
    """
    faults = find_copies(parts)
    for part in parts.values():
        faults += _find_jumps(part)
        quiet = part.values[: part.count_rows(quiet_s)]
        noises = [measure_noise(quiet[:, c]) for c in range(len(part.channels))] if is_quiet(part, quiet_s) else []
        for c, channel in enumerate(part.channels):
            if channel.signal == "keyphasor":
                continue  # a pulse is steady, and has rails
            faults += _find_held_values(channel.name, channel.unit, part.times_s, part.values[:, c])
            peers = [one for k, one in enumerate(noises) if k != c and part.channels[k].unit == channel.unit]
            if peers and noises[c] > _NOISE_FACTOR * max(peers):
                times = noises[c] / float(np.median(peers))
                text = f"{times:.2g} times that of similar channels"
                end_s = float(part.times_s[len(quiet) - 1])
                faults.append(SignalFault(channel.name, "noise", float(part.times_s[0]), end_s, text))
    return faults


def is_quiet(part: Measured, quiet_s: float) -> bool:
    """Return whether a part of a recording before a time is long enough to show the noise."""
    return part.count_rows(quiet_s) >= _MIN_QUIET_ROWS


def _find_jumps(part: Measured) -> list[SignalFault]:
    """Return jumps of most probes at the same time to another value, which inertia prevents in a motion."""
    probes = part.values[:, [c for c, channel in enumerate(part.channels) if channel.unit == "mm"]]
    if probes.shape[1] < 2 or len(probes) < 2 * _MIN_FROZEN_ROWS:
        return []
    steps = np.diff(probes, axis=0)
    bends = np.abs(np.diff(steps, axis=0))
    sharp = bends > _JUMP_FACTOR * np.maximum(np.quantile(bends, _JUMP_QUANTILE, axis=0), 1e-300)
    # A step has two opposite second differences, a spike three.
    lasts = sharp[1:] & sharp[:-1] & (np.abs(probes[3:] - probes[:-3]) > 0.5 * np.abs(steps[1:-1]))
    rows = np.flatnonzero((4 * lasts.sum(axis=1) >= 3 * probes.shape[1]) & (np.diff(part.index)[1:-1] == 1))
    if not len(rows):
        return []
    begin, end = (float(part.times_s[row + 1]) for row in rows[[0, -1]])
    text = (
        f"probes jump together in {len(rows)} rows, the first after {begin:.4f} s: samples are missing or doubled there"
    )
    return [SignalFault("time", "lost samples", begin, end, text)]


def find_copies(parts: Mapping[str, Measured]) -> list[SignalFault]:
    """Return stretches of rows that are equal to others bit for bit, which noise prevents."""
    faults = []
    for name, part in parts.items():
        noisy = [c for c, channel in enumerate(part.channels) if part.random[c] and channel.signal != "keyphasor"]
        values = np.ascontiguousarray(part.values[:, noisy])
        if not noisy or not len(values):
            continue
        _, rows = np.unique(values.view([("", values.dtype)] * len(noisy))[:, 0], return_inverse=True)
        order = np.argsort(rows, kind="stable")
        back = np.zeros(len(values), dtype=np.int64)  # distance to the same row before, or 0
        back[order[1:]] = np.where(np.diff(rows[order]) == 0, np.diff(order), 0)
        lags, counts = np.unique(back[back > _MIN_COPIED_ROWS], return_counts=True)
        often = lags[np.argsort(-counts)][:_MAX_COPIES]
        runs = [
            (begin + lag, end - 1 + lag, lag)
            for lag in often.tolist()
            for begin, end in find_true_runs(rows[lag:] == rows[:-lag])
            if end - begin >= _MIN_COPIED_ROWS
        ]
        if sum(last - first for first, last, _ in runs) > _MAX_COPIED_PART * len(values):
            continue  # periodic motion without noise
        for first, last, lag in runs:
            from_s, to_s, other_s = (float(part.times_s[row]) for row in (first, last, first - lag))
            text = f"{last - first + 1} rows of {name} from {from_s:.4f} to {to_s:.4f} s are equal bit for bit "
            text += f"to those from {other_s:.4f} s on, in spite of noise: one is a copy"
            faults.append(SignalFault("time", "doubled samples", from_s, to_s, text))
    return faults


def edge_faults(
    edges_s: np.ndarray, until_s: float, speed_hz: float, *, from_s: float = math.inf, period_s: float = 0.0
) -> list[SignalFault]:
    """Return missing or extra pulses at constant speed, and missing ones after that.

    Args:
        edges_s: Keyphasor edges [s].
        until_s: End of the constant speed [s].
        speed_hz: Speed [Hz].
        from_s: Start of a keyphasor's record [s].
        period_s: Sampling period of the keyphasor, whose edges may be up to a sample off [s].
    """
    if not len(edges_s) and (until_s - from_s) * speed_hz > _SILENT_TURNS:
        text = f"none in {(until_s - from_s) * speed_hz:.1f} turns"
        return [SignalFault("keyphasor", "miss-pulses", from_s, until_s, text)]
    steps, faults = np.diff(edges_s[edges_s < until_s]), list[SignalFault]()
    even = len(steps) if len(steps) >= 3 else 0
    later = np.diff(edges_s[max(0, even - 1) :])
    neighbours = np.maximum([*later[1:2], *later[:-1]], [*later[1:], math.inf]) if len(later) > 1 else later
    # A shaft cannot be that much slower for a single turn, and a missing pulse leaves more than a turn at its speed.
    missing = (later > _MISSED_TURN * neighbours) & ((later * speed_hz > _MISSED_TURN) | (speed_hz <= 0.0))
    for at in np.flatnonzero(missing) + max(0, even - 1):
        begin, end = float(edges_s[at]), float(edges_s[at + 1])
        text = f"none between {begin:.3f} and {end:.3f} s"
        faults.append(SignalFault("keyphasor", "miss-pulses", begin, end, text))
    if not even:
        return faults
    turns = steps / np.median(steps)
    a_turn = 1.0 / (float(np.median(steps)) * speed_hz) if speed_hz > 0.0 else 1.0
    uneven = speed_hz > 0.0 and np.abs(turns - 1.0).max() > _PULSE_TOLERANCE < abs(speed_hz * steps.mean() - 1.0)
    if uneven:  # the median of many uneven turns is no turn
        turns, a_turn = steps * speed_hz, 1.0
    if abs(a_turn - 1.0) > _PULSE_TOLERANCE:
        begin, end = float(edges_s[0]), float(edges_s[len(steps)])
        what = "extra-pulses" if a_turn > 1.0 else "miss-pulses"
        faults.append(SignalFault("keyphasor", what, begin, end, f"{a_turn:.3g} pulses per turn"))
    for what, rows in (("miss-pulses", turns > 1.5), ("extra-pulses", turns < 0.7)):
        at = np.flatnonzero(rows)
        if len(at):
            begin, end = float(edges_s[at[0]]), float(edges_s[at[-1] + 1])
            text = f"in {len(at)} of {len(steps)} turns, the first at {begin:.3f} s"
            faults.append(SignalFault("keyphasor", what, begin, end, text))
    if uneven:
        return faults
    off_s = np.where(np.abs(turns - 1.0) < 0.3, steps - np.median(steps), 0.0)
    least_s = max(_UNEVENNESS * 1.5 * float(np.median(np.abs(off_s))), _UNEVENNESS_S, _EDGE_SAMPLES * period_s)
    for at in np.flatnonzero(np.abs(off_s) > least_s):
        text = f"the turn that ends at {edges_s[at + 1]:.4f} s is longer than the others by {1e3 * off_s[at]:+.4g} ms: "
        text += "samples are missing or doubled in it" if off_s[at] < 0.0 else "its time jumps"
        faults.append(SignalFault("time", "lost samples", float(edges_s[at]), float(edges_s[at + 1]), text))
    return faults


def _find_held_values(name: str, unit: str, times_s: np.ndarray, values: np.ndarray) -> list[SignalFault]:
    """Return the stretches in which a channel is frozen or at a rail."""
    steady = steady_rows(values)
    rest = np.diff(values[~steady]) == 0.0
    if not len(rest) or rest.mean() > _MAX_EQUAL_PART:
        return []  # its numbers are coarse, or all are equal
    faults = []
    rails = np.zeros(len(values), dtype=bool)
    for side, level in (("largest", values.max()), ("smallest", values.min())):
        at = steady_rows(np.where(values == level, level, np.arange(len(values)) + level + 1.0), _RAIL_RUN)
        runs = find_true_runs(at)
        if at.sum() >= RAIL_ROWS and (len(runs) > 1 or at.sum() < _MIN_FROZEN_ROWS):
            rails |= at
            text = f"{at.sum()} rows at its {side}, {level:.6g} {unit}, the first at {times_s[runs[0][0]]:.4f} s"
            faults.append(SignalFault(name, "clip", *_find_span(times_s, runs), text))
    runs = find_true_runs(steady & ~rails)
    if runs:
        begin, end = _find_span(times_s, runs)
        text = f"the same number in {sum(b - a for a, b in runs)} rows, from {begin:.4f} to {end:.4f} s"
        faults.append(SignalFault(name, "freeze", begin, end, text))
    return faults


def _find_span(times_s: np.ndarray, runs: list[tuple[int, int]]) -> tuple[float, float]:
    return float(times_s[runs[0][0]]), float(times_s[runs[-1][1] - 1])
