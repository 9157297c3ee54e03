"""Impacts and speed derived from the motion in a log: time and strength of an impact, and the speed of rotation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from replays.estimate.runs import block_means
from replays.recordings.formats.clock import TimeAxis
from replays.recordings.formats.events.pulses import find_pulses
from rig.channels.orbit import full_spectrum
from rig.channels.table import default_table

_BLOCK_S, _MIN_RATE_HZ = 1e-3, 200.0
"""Length of the block means on which motion is evaluated [s], and the lowest rate of such signals [Hz]."""
_MIN_LEAD_S, _MAX_RISE_S = 0.1, 5e-3
"""Length of record needed before a sudden motion [s], and its longest rise [s]."""
_MIN_JUMP, _MIN_PART = 8.0, 0.01
"""A motion is sudden if its curvature is this many times the previous maximum, and this fraction of the overall one."""
_PERSISTENCE_S, _MIN_PERSISTENCE = (0.02, 0.08), 1.5
"""Interval after a sudden motion [s] in which the curvature must stay above this multiple: a spike does not."""
_COINCIDENCE_S, _MIN_CHANNELS = 0.05, 2
"""Interval within which channels must show a sudden motion [s], and their minimum number."""
_PARABOLA_S = 2e-3
"""Length of the parabola fitted for the acceleration [s]."""
_PULSE_SEARCH_S = (0.03, 0.06)
"""Interval evaluated before and after the start of an impact [s]."""
_PADDING, _MIN_LINE_RATIO = 16, 30.0
"""Zero padding of the spectrum, and the minimum ratio of a line of rotation to the median power."""
_MAX_LENGTH_S = 20.0
_FREQUENCY_DEVIATION = 0.1
"""Standard deviation of a line's frequency, as a fraction of the frequency resolution."""


class ChannelMotion(NamedTuple):
    """Motion of one channel in its unit, shape (n,); nan for missing samples."""

    name: str
    values: np.ndarray
    axis: TimeAxis

    @property
    def kind(self) -> str:
        """Unit of the channel: mm, N or m/s^2; empty for other channels."""
        channel = default_table().channels.get(self.name)
        return "" if channel is None or channel.name == "hammer" else channel.unit

    def average_blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times [s] and block means of the motion, each shape (m,)."""
        missing = ~np.isfinite(self.values)
        values, rows = self.values, np.arange(len(self.values))
        if missing.any():  # a channel without finite values does not move
            values = np.zeros(len(rows)) if missing.all() else np.interp(rows, rows[~missing], values[~missing])
        several = max(1, round(_BLOCK_S * self.axis.rate_hz))
        return block_means(self.axis.instants()[: len(values)], several), block_means(values, several)


class Impact(NamedTuple):
    """Impact on the shaft: time [s], channels that show it, and the pulse derived from the probes."""

    at_s: float
    names: tuple[str, ...]
    pulse: tuple[float, float, float, float] | None
    """Start [s], force [N], length [ms] and direction [degrees]; None without a pair of probes."""


def detect_impact(motions: Sequence[ChannelMotion]) -> Impact | None:
    """Return the first sudden motion that several channels show, or None."""
    onsets = sorted(
        (at_s, one.name)
        for one in motions
        if one.kind in ("mm", "N", "m/s^2") and one.axis.rate_hz >= _MIN_RATE_HZ and (at_s := _onset_s(one)) is not None
    )
    for at_s, _ in onsets:
        names = tuple(name for s, name in onsets if 0.0 <= s - at_s <= _COINCIDENCE_S)
        if len(names) >= _MIN_CHANNELS:
            return Impact(at_s, names, _pulse({one.name: one for one in motions}, at_s))
    return None


def _onset_s(motion: ChannelMotion) -> float | None:
    """Return the time of a channel's first sudden and lasting change of curvature [s]."""
    times, values = motion.average_blocks()
    if len(times) < 3:
        return None
    step_s = float(times[-1] - times[0]) / (len(times) - 1)
    bent = np.abs(np.diff(values, 2))
    rise, lead = math.ceil(_MAX_RISE_S / step_s), math.ceil(_MIN_LEAD_S / step_s)
    before = np.maximum.accumulate(bent)[:-rise]
    now = bent[rise:]
    for n in np.flatnonzero((now > _MIN_JUMP * before) & (now > _MIN_PART * bent.max(initial=0.0))).tolist():
        later = now[n + math.ceil(_PERSISTENCE_S[0] / step_s) : n + math.ceil(_PERSISTENCE_S[1] / step_s)]
        persists = len(later) == 0 or later.max() > _MIN_PERSISTENCE * before[n]
        if persists and lead <= n < len(now) - rise:
            return float(times[1 + rise + n])
    return None


def _pulse(motions: Mapping[str, ChannelMotion], at_s: float) -> tuple[float, float, float, float] | None:
    """Return the half sine that explains the acceleration of a pair of probes, as found by `pulses.find_pulses`."""
    from scipy.signal import savgol_filter

    from replays.recordings.formats.mapping import HammerMapping
    from rig.physics.parameters import load_parameters

    place = next((one for one in ("disk", "ring") if f"{one}_x" in motions and f"{one}_y" in motions), None)
    if place is None or motions[f"{place}_x"].axis.rate_hz != motions[f"{place}_y"].axis.rate_hz:
        return None
    x, y = motions[f"{place}_x"], motions[f"{place}_y"]
    times, rate_hz = x.axis.instants(), x.axis.rate_hz
    part = (times > at_s - _PULSE_SEARCH_S[0]) & (times < at_s + _PULSE_SEARCH_S[1])
    length = 2 * round(_PARABOLA_S * rate_hz / 2.0) + 1
    if length < 5 or part.sum() < 2 * length or len(y.values) != len(x.values) or x.axis.times_s is not None:
        return None
    entries = load_parameters().entries
    inertia, arm, own = (
        float(entries[f"shaft.{name}"].value) for name in ("transverse_inertia", "arm_disk", f"arm_{place}")
    )
    weight_kg = inertia / (arm * own)  # as if only the hammer accelerated the shaft
    path_m = 1e-3 * np.nan_to_num(np.stack([x.values[part], y.values[part]]))
    force = weight_kg * np.asarray(savgol_filter(path_m, length, 2, deriv=2, delta=1.0 / rate_hz))  # shape (2, n)
    times = times[part]
    quiet = times < at_s - _PARABOLA_S - _MAX_RISE_S
    force -= force[:, quiet].mean(axis=1, keepdims=True)
    first = force[:, (times >= at_s) & (times < at_s + _PARABOLA_S)].sum(axis=1)
    along = first / max(float(np.hypot(*first)), 1e-30) @ force
    least = max(_MIN_JUMP * float(along[quiet].std()), 1e-3)
    pulses, _ = find_pulses(along, TimeAxis(float(times[0]), rate_hz, len(along)), HammerMapping(threshold_n=least))
    if not pulses:
        return None
    return pulses[0].at_s, pulses[0].force_n, pulses[0].duration_ms, math.degrees(math.atan2(first[1], first[0]))


def estimate_speed(motions: Sequence[ChannelMotion], *, until_s: float = math.inf) -> tuple[float, float] | None:
    """Return the speed of rotation from the probes and its standard deviation [Hz]; None if no line is distinct.

    It is the strongest line of the spectrum, which is that of the unbalance unless the shaft is hit. The deviation is a
    fraction of the frequency resolution, as free motion may be close to it.

    Args:
        motions: Channels.
        until_s: End of the evaluated interval [s].
    """
    named = {one.name: one for one in motions if one.kind == "mm" and one.axis.rate_hz >= _MIN_RATE_HZ}
    best: tuple[float, float, float] | None = None
    for place in ("disk", "ring"):
        parts = [named[name].average_blocks() for name in (f"{place}_x", f"{place}_y") if name in named]
        if not parts or not len(parts[0][0]) or len({len(times) for times, _ in parts}) > 1:
            continue
        times = parts[0][0]
        rows = (times < until_s) & (times > min(until_s, float(times[-1])) - _MAX_LENGTH_S)
        n = int(rows.sum())
        if n < _PADDING:
            continue
        x, y = parts[0][1][rows], parts[1][1][rows] if len(parts) > 1 else np.zeros(n)
        size = _PADDING << (n - 1).bit_length()
        step_s = float(times[rows][-1] - times[rows][0]) / (n - 1)
        both = full_spectrum(x, y, 1.0 / step_s, lines=size)[1] ** 2  # from minus half of the rate
        hz, apart_hz = np.arange(size // 2) / (size * step_s), 1.0 / (n * step_s)
        moves = hz >= 2.0 * apart_hz
        power, behind = moves * both[size // 2 :], moves * both[size // 2 : 0 : -1]
        peak = int(np.argmax(power))
        if behind.max() > 2.0 * power[peak]:
            continue  # backward whirl
        stands = float(power[peak]) / max(float(np.median(both)), 1e-300)
        if stands > _MIN_LINE_RATIO and (best is None or stands > best[2]):
            best = float(hz[peak]), _FREQUENCY_DEVIATION * apart_hz, stands
    return None if best is None else best[:2]
