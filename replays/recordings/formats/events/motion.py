"""What the motion in a log tells that no channel does: when the shaft was hit, how hard, and how fast it turns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from replays.estimate.runs import block_means
from replays.recordings.formats.clock import Axis
from replays.recordings.formats.events.pulses import find_pulses
from rig.channels.orbit import full_spectrum
from rig.channels.table import default_table

_STEP_S, _SLOWEST_HZ = 1e-3, 200.0
"""Motion is looked at in means so long [s], of signals that are at least so fast [Hz]."""
_LEAD_S, _RISE_S = 0.1, 5e-3
"""So much has to be seen before something sudden, and so long it may take to rise [s]."""
_SUDDEN, _SEEN = 8.0, 0.01
"""So many times as curved as ever before, and as this part of what is most so, is sudden, ..."""
_AFTER_S, _GOES_ON = (0.02, 0.08), 1.5
"""... where so long behind it [s] motion is still so many times what it was: a spike leaves none."""
_TOGETHER_S, _WITNESSES = 0.05, 2
"""So many channels must show it, within such a time of each other [s]."""
_CURVE_S = 2e-3
"""Stretch over which a parabola tells the acceleration [s]."""
_AROUND_S = (0.03, 0.06)
"""What is looked at before and behind the begin of an impact [s]."""
_PADDED, _OVER_MIDDLE = 16, 30.0
"""Lines of the spectrum between two that differ, and how far in power one turning stands out of it."""
_LONGEST_S = 20.0
_RESOLVED = 0.1
"""Part of the distance of two lines that can be told apart, to which the middle of one is known: a deviation."""


class Motion(NamedTuple):
    """One channel as it moves, in its unit, shape (n,); nan where it is missing."""

    name: str
    values: np.ndarray
    axis: Axis

    @property
    def kind(self) -> str:
        """Unit of the channel: lengths in mm, forces in N, accelerations in m/s^2."""
        channel = default_table().channels.get(self.name)
        return "" if channel is None or channel.name == "hammer" else channel.unit

    def slow(self) -> tuple[np.ndarray, np.ndarray]:
        """Times [s] and means of as many samples as a step takes, each shape (m,)."""
        gone = ~np.isfinite(self.values)
        values, rows = self.values, np.arange(len(self.values))
        if gone.any():  # a channel without a number does not move
            values = np.zeros(len(rows)) if gone.all() else np.interp(rows, rows[~gone], values[~gone])
        several = max(1, round(_STEP_S * self.axis.rate_hz))
        return block_means(self.axis.instants()[: len(values)], several), block_means(values, several)


class Impact(NamedTuple):
    """Something that hit the shaft: when [s], which channels show it, and the pulse that it was as the probes tell."""

    at_s: float
    names: tuple[str, ...]
    pulse: tuple[float, float, float, float] | None
    """Start [s], force [N], length [ms], direction [degrees]; of one that no pair of probes shows, None."""


def impact(motions: Sequence[Motion]) -> Impact | None:
    """The first moment from which on several channels move as never before; None where there is none."""
    found = sorted(
        (at_s, one.name)
        for one in motions
        if one.kind in ("mm", "N", "m/s^2") and one.axis.rate_hz >= _SLOWEST_HZ and (at_s := _sudden_s(one)) is not None
    )
    for at_s, _ in found:
        names = tuple(name for s, name in found if 0.0 <= s - at_s <= _TOGETHER_S)
        if len(names) >= _WITNESSES:
            return Impact(at_s, names, _pulse({one.name: one for one in motions}, at_s))
    return None


def _sudden_s(motion: Motion) -> float | None:
    """From when on a channel is suddenly more curved than ever before [s], and keeps moving."""
    times, values = motion.slow()
    if len(times) < 3:
        return None
    step_s = float(times[-1] - times[0]) / (len(times) - 1)
    bent = np.abs(np.diff(values, 2))
    rise, lead = math.ceil(_RISE_S / step_s), math.ceil(_LEAD_S / step_s)
    before = np.maximum.accumulate(bent)[:-rise]
    now = bent[rise:]
    for n in np.flatnonzero((now > _SUDDEN * before) & (now > _SEEN * bent.max(initial=0.0))).tolist():
        later = now[n + math.ceil(_AFTER_S[0] / step_s) : n + math.ceil(_AFTER_S[1] / step_s)]
        seen = len(later) == 0 or later.max() > _GOES_ON * before[n]
        if seen and lead <= n < len(now) - rise:
            return float(times[1 + rise + n])
    return None


def _pulse(motions: Mapping[str, Motion], at_s: float) -> tuple[float, float, float, float] | None:
    """The half sine that gives the shaft the acceleration which a pair of probes shows: as `pulses.find_pulses`."""
    from scipy.signal import savgol_filter

    from replays.recordings.formats.mapping import HammerMapping
    from rig.physics.parameters import load_parameters

    place = next((one for one in ("disk", "ring") if f"{one}_x" in motions and f"{one}_y" in motions), None)
    if place is None or motions[f"{place}_x"].axis.rate_hz != motions[f"{place}_y"].axis.rate_hz:
        return None
    x, y = motions[f"{place}_x"], motions[f"{place}_y"]
    times, rate_hz = x.axis.instants(), x.axis.rate_hz
    part = (times > at_s - _AROUND_S[0]) & (times < at_s + _AROUND_S[1])
    length = 2 * round(_CURVE_S * rate_hz / 2.0) + 1
    if length < 5 or part.sum() < 2 * length or len(y.values) != len(x.values) or x.axis.times_s is not None:
        return None
    entries = load_parameters().entries
    inertia, arm, own = (
        float(entries[f"shaft.{name}"].value) for name in ("transverse_inertia", "arm_disk", f"arm_{place}")
    )
    weight_kg = inertia / (arm * own)  # as if the hammer alone accelerated the shaft
    path_m = 1e-3 * np.nan_to_num(np.stack([x.values[part], y.values[part]]))
    force = weight_kg * np.asarray(savgol_filter(path_m, length, 2, deriv=2, delta=1.0 / rate_hz))  # shape (2, n)
    times = times[part]
    quiet = times < at_s - _CURVE_S - _RISE_S
    force -= force[:, quiet].mean(axis=1, keepdims=True)
    first = force[:, (times >= at_s) & (times < at_s + _CURVE_S)].sum(axis=1)
    along = first / max(float(np.hypot(*first)), 1e-30) @ force
    least = max(_SUDDEN * float(along[quiet].std()), 1e-3)
    found, _ = find_pulses(along, Axis(float(times[0]), rate_hz, len(along)), HammerMapping(threshold_n=least))
    if not found:
        return None
    return found[0].at_s, found[0].force_n, found[0].duration_ms, math.degrees(math.atan2(first[1], first[0]))


def turning(motions: Sequence[Motion], *, until_s: float = math.inf) -> tuple[float, float] | None:
    """Speed at which the probes turn forward, and its standard deviation [Hz]; None where none stands out.

    It is the strongest line of the spectrum, which of a shaft that is not hit is that of its unbalance. Its deviation
    is a part of what can be told apart in such a time, as free motion may lie beside it.

    Args:
        motions: Channels.
        until_s: What comes later is not looked at [s].
    """
    named = {one.name: one for one in motions if one.kind == "mm" and one.axis.rate_hz >= _SLOWEST_HZ}
    best: tuple[float, float, float] | None = None
    for place in ("disk", "ring"):
        parts = [named[name].slow() for name in (f"{place}_x", f"{place}_y") if name in named]
        if not parts or not len(parts[0][0]) or len({len(times) for times, _ in parts}) > 1:
            continue
        times = parts[0][0]
        rows = (times < until_s) & (times > min(until_s, float(times[-1])) - _LONGEST_S)
        n = int(rows.sum())
        if n < _PADDED:
            continue
        x, y = parts[0][1][rows], parts[1][1][rows] if len(parts) > 1 else np.zeros(n)
        size = _PADDED << (n - 1).bit_length()
        step_s = float(times[rows][-1] - times[rows][0]) / (n - 1)
        both = full_spectrum(x, y, 1.0 / step_s, lines=size)[1] ** 2  # from -half of the rate
        hz, apart_hz = np.arange(size // 2) / (size * step_s), 1.0 / (n * step_s)
        moves = hz >= 2.0 * apart_hz
        power, behind = moves * both[size // 2 :], moves * both[size // 2 : 0 : -1]
        peak = int(np.argmax(power))
        if behind.max() > 2.0 * power[peak]:
            continue  # it whirls backward
        stands = float(power[peak]) / max(float(np.median(both)), 1e-300)
        if stands > _OVER_MIDDLE and (best is None or stands > best[2]):
            best = float(hz[peak]), _RESOLVED * apart_hz, stands
    return None if best is None else best[:2]
