"""Defects that a signal shows without a model, anywhere in a log: freeze, clip, noise, pulses and lost samples."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from replays.estimate.runs import true_runs
from replays.recordings.identification.request import measured_noise
from replays.recordings.resimulation.prediction import Measured

_HELD = 8
"""So many equal numbers in a row are none that noise makes ..."""
_RARE = 0.02
"""... where neighbours are equal this seldom elsewhere."""
_RAIL, _AT_RAIL = 2, 4
"""Rows in a row at the largest or smallest number, and in all, that make a rail of it."""
_UNEVEN, _UNEVEN_S = 8.0, 5e-5
"""A turn is off by so many deviations of turns, and by as much [s]."""
_MISSED = 1.6
"""Times as long as both turns beside it, a turn has two pulses' time."""
_ANOTHER = 0.2
"""Part by which pulses are more or fewer than turns."""
_SHARP, _MOSTLY = 10.0, 0.995
"""Times what second differences of a probe are in this part of the rows, which inertia leaves to none."""
_LOUD = 3.0
"""Times the noise of its peers."""


class SignalFault(NamedTuple):
    """One defect of one channel.

    Attributes:
        channel: Name of the channel, or "time" for all channels of a group.
        what: Name in the table of defects, as in `Law`.
        from_s: Begin [s].
        to_s: End [s].
        text: Size, and where it is.
    """

    channel: str
    what: str
    from_s: float
    to_s: float
    text: str

    @property
    def line(self) -> str:
        """In words."""
        return f"{self.channel} {self.what}: {self.text}"


def steady_rows(values: np.ndarray, held: int = _HELD) -> np.ndarray:
    """Rows of stretches of one and the same number, shape (n,)."""
    found = np.zeros(len(values), dtype=bool)
    for begin, end in true_runs(np.concatenate([[False], np.diff(values) == 0.0])):
        if end - begin >= held - 1:
            found[begin - 1 : end] = True
    return found


def signal_faults(parts: dict[str, Measured]) -> list[SignalFault]:
    """What channels show by themselves.

    Args:
        parts: The channels, as long as they are.
    """
    found = []
    for part in parts.values():
        found += _jumps(part)
        noises = [measured_noise(part.values[:, c]) for c in range(len(part.channels))]
        for c, channel in enumerate(part.channels):
            if channel.signal == "keyphasor":
                continue  # a pulse is steady, and has rails
            found += _held(channel.name, channel.unit, part.times_s, part.values[:, c])
            peers = [noises[k] for k, other in enumerate(part.channels) if k != c and other.unit == channel.unit]
            if peers and noises[c] > _LOUD * max(peers):
                times = noises[c] / float(np.median(peers))
                text = f"{times:.2g} times that of its peers"
                found.append(SignalFault(channel.name, "noise", float(part.times_s[0]), float(part.times_s[-1]), text))
    return found


def _jumps(part: Measured) -> list[SignalFault]:
    """Where most of the probes jump at once, and stay there: nothing that has a mass does."""
    probes = part.values[:, [c for c, channel in enumerate(part.channels) if channel.unit == "mm"]]
    if probes.shape[1] < 2 or len(probes) < 2 * _HELD:
        return []
    steps = np.diff(probes, axis=0)
    bends = np.abs(np.diff(steps, axis=0))
    sharp = bends > _SHARP * np.maximum(np.quantile(bends, _MOSTLY, axis=0), 1e-300)
    # A step bends there and back; a spike once more.
    lasts = sharp[1:] & sharp[:-1] & (np.abs(probes[3:] - probes[:-3]) > 0.5 * np.abs(steps[1:-1]))
    rows = np.flatnonzero((4 * lasts.sum(axis=1) >= 3 * probes.shape[1]) & (np.diff(part.index)[1:-1] == 1))
    if not len(rows):
        return []
    begin, end = (float(part.times_s[row + 1]) for row in rows[[0, -1]])
    text = (
        f"probes jump at once in {len(rows)} rows, the first behind {begin:.4f} s: samples are missing there, or double"
    )
    return [SignalFault("time", "lost samples", begin, end, text)]


def edge_faults(edges_s: np.ndarray, until_s: float, speed_hz: float) -> list[SignalFault]:
    """Pulses that are missing or too many while the shaft turns evenly; missing ones behind that, too.

    Args:
        edges_s: Keyphasor edges [s].
        until_s: Up to when it does [s].
        speed_hz: At what speed [Hz].
    """
    steps, found = np.diff(edges_s[edges_s < until_s]), list[SignalFault]()
    even = len(steps) if len(steps) >= 3 else 0
    later = np.diff(edges_s[max(0, even - 1) :])
    beside = np.maximum([*later[1:2], *later[:-1]], [*later[1:], math.inf]) if len(later) > 1 else later
    # No shaft is that much slower for a turn, and fast again.
    for at in np.flatnonzero(later > _MISSED * beside) + max(0, even - 1):
        begin, end = float(edges_s[at]), float(edges_s[at + 1])
        text = f"none between {begin:.3f} and {end:.3f} s"
        found.append(SignalFault("keyphasor", "miss-pulses", begin, end, text))
    if not even:
        return found
    turns = steps / np.median(steps)
    a_turn = 1.0 / (float(np.median(steps)) * speed_hz) if speed_hz > 0.0 else 1.0
    if abs(a_turn - 1.0) > _ANOTHER:
        begin, end = float(edges_s[0]), float(edges_s[len(steps)])
        what = "extra-pulses" if a_turn > 1.0 else "miss-pulses"
        found.append(SignalFault("keyphasor", what, begin, end, f"{a_turn:.3g} pulses a turn"))
    for what, rows in (("miss-pulses", turns > 1.5), ("extra-pulses", turns < 0.7)):
        at = np.flatnonzero(rows)
        if len(at):
            begin, end = float(edges_s[at[0]]), float(edges_s[at[-1] + 1])
            text = f"in {len(at)} of {len(steps)} turns, the first at {begin:.3f} s"
            found.append(SignalFault("keyphasor", what, begin, end, text))
    off_s = np.where(np.abs(turns - 1.0) < 0.3, steps - np.median(steps), 0.0)
    for at in np.flatnonzero(np.abs(off_s) > max(_UNEVEN * 1.5 * float(np.median(np.abs(off_s))), _UNEVEN_S)):
        text = f"the turn that ends at {edges_s[at + 1]:.4f} s is {1e3 * off_s[at]:+.4g} ms long beside the others: "
        text += "samples are missing in it, or double" if off_s[at] < 0.0 else "its time jumps"
        found.append(SignalFault("time", "lost samples", float(edges_s[at]), float(edges_s[at + 1]), text))
    return found


def _held(name: str, unit: str, times_s: np.ndarray, values: np.ndarray) -> list[SignalFault]:
    """Where a channel is stuck, and where it is at a rail."""
    steady = steady_rows(values)
    rest = np.diff(values[~steady]) == 0.0
    if not len(rest) or rest.mean() > _RARE:
        return []  # its numbers are coarse, or it is all of one
    found = []
    rails = np.zeros(len(values), dtype=bool)
    for side, level in (("largest", values.max()), ("smallest", values.min())):
        at = steady_rows(np.where(values == level, level, np.arange(len(values)) + level + 1.0), _RAIL)
        runs = true_runs(at)
        if at.sum() >= _AT_RAIL and (len(runs) > 1 or at.sum() < _HELD):
            rails |= at
            text = f"{at.sum()} rows at its {side}, {level:.6g} {unit}, the first at {times_s[runs[0][0]]:.4f} s"
            found.append(SignalFault(name, "clip", *_span(times_s, runs), text))
    runs = true_runs(steady & ~rails)
    if runs:
        begin, end = _span(times_s, runs)
        text = f"one and the same number in {sum(b - a for a, b in runs)} rows, from {begin:.4f} to {end:.4f} s"
        found.append(SignalFault(name, "freeze", begin, end, text))
    return found


def _span(times_s: np.ndarray, runs: list[tuple[int, int]]) -> tuple[float, float]:
    return float(times_s[runs[0][0]]), float(times_s[runs[-1][1] - 1])
