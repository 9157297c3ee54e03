"""Best assignment of signals to channels, by a score of each pair of a signal and a channel and of pairs of signals.

Names and units give the score of a signal alone. Pairs of signals are related by the physics of the rig: opposite
transducers, probes in quadrature, the shaft bounded in its ring. What only a convention decides (mirrored axes, which
of two ends) has small weights, so that it remains open.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import cache
from statistics import median
from typing import NamedTuple

import numpy as np

from replays.recordings.formats.guessing.features import Relation, SignalFeatures, compute_relation

FAMILIES = {
    "length": ("disk_x", "disk_y", "ring_x", "ring_y"), "force": ("P_N", "P_S", "P_E", "P_W"),
    "acceleration": ("inner_x", "inner_y", "outer_x", "outer_y"), "speed": ("speed",), "keyphasor": ("keyphasor",),
    "hammer": ("hammer",),
}  # fmt: skip
"""Channels by kind of quantity."""
CHANNELS = [channel for family in FAMILIES.values() for channel in family]
_NO_CHANNEL = 2.9
"""Score from which a signal gets a channel: more than a unit of length or force alone."""
_AMBIGUITY = 0.25
"""Loss of score below which signals without a telling name are equal candidates for too few channels."""
_DISK_RATIO = 1.15
"""Minimum ratio of the motion at the disk to that in the ring, which is nearer to the lower bearing."""
_MIN_LIKENESS = 0.5
_MIRROR = str.maketrans("xyNSEW", "yxEWNS")
_PER_AXIS = {"x": ("P_E", "P_W"), "y": ("P_N", "P_S")}
_Rule = tuple[str, float, list[tuple[str, str]]]
_RULES: tuple[_Rule, ...] = (
    ("alike", 2.0, [(f"disk_{axis}", f"ring_{axis}") for axis in "xy"]),
    ("against", 2.0, list(_PER_AXIS.values())),
    ("leads", 0.8, [("disk_x", "disk_y"), ("ring_x", "ring_y")]),
    ("farther", 1.5, [(f"disk_{axis}", f"ring_{axis}") for axis in "xy"]),
    ("loaded", 1.0, [(each[0], f"{at}_{axis}") for axis, each in _PER_AXIS.items() for at in ("disk", "ring")]),
    ("relieved", 1.0, [(each[1], f"{at}_{axis}") for axis, each in _PER_AXIS.items() for at in ("disk", "ring")]),
    ("coupled", 1.5, [(f"{at}_{axis}", force) for axis, pair in _PER_AXIS.items() for at in ("inner", "outer")
                      for force in pair]),
    ("stronger", 1.5, [(f"inner_{axis}", f"outer_{axis}") for axis in "xy"]),
    ("sharper", 1.2, [(f"inner_{axis}", f"outer_{axis}") for axis in "xy"]),
    ("alike", 0.7, [("outer_y", "P_N"), ("outer_x", "P_W"), ("inner_y", "P_S"), ("inner_x", "P_W")]),
    ("against", 0.7, [("outer_y", "P_S"), ("outer_x", "P_E"), ("inner_y", "P_N"), ("inner_x", "P_E")]),
)  # fmt: skip
"""Relations of two channels with their weights; `Relations.measure` gives -1 to 1."""


class Relations:
    """Relations of the signals of a log, computed when needed."""

    def __init__(self, signals: Sequence[SignalFeatures], units: Sequence[str]) -> None:
        self.signals, self.units = signals, units
        onsets = [each.onset_s for each in signals if math.isfinite(each.onset_s)]
        self.onset_s = median(onsets) if onsets else math.inf
        self._first = [each.before(self.onset_s) for each in signals]
        self.whole = cache(lambda i, j: compute_relation(signals[i], signals[j]))
        self.first = cache(lambda i, j: compute_relation(self._first[i], self._first[j]) or self.whole(i, j))
        self.measure = cache(self._measure)

    def likeness(self, i: int, j: int) -> float:
        """Return the correlation coefficient of two signals; 0 if they were not sampled together."""
        found: Relation | None = self.whole(min(i, j), max(i, j)) if i != j else None
        return found.likeness if found is not None else 0.0

    def quadrature(self, i: int, j: int) -> Relation | None:
        """Return the relation of two signals of similar size in quadrature before the impact, if they are."""
        found: Relation | None = self.first(i, j)
        apart = found is not None and found.quadrature and found.coherence > 0.95
        return found if apart and self.units[i] == self.units[j] else None

    def opposed(self, i: int, j: int) -> float:
        """Return the correlation of two signals of similar size and equal unit; else 0."""
        found: Relation | None = self.whole(min(i, j), max(i, j))
        alike = found is not None and 0.5 < found.size < 2.0 and self.units[i] == self.units[j]
        return found.likeness if found is not None and alike else 0.0

    def _measure(self, kind: str, i: int, j: int) -> float:
        if kind == "leads":
            found: Relation | None = self.first(i, j)
            if found is None or found.coherence < 0.8:
                return 0.0
            return -1.0 if not found.quadrature else 1.0 if found.phase_deg > 0.0 else -1.0
        if kind in ("farther", "stronger"):
            return self._size(kind, i, j)
        if kind == "sharper":
            return max(-1.0, min(1.0, math.log(self.signals[i].kurtosis / self.signals[j].kurtosis)))
        value = self.likeness(i, j)
        return -value if kind in ("against", "relieved") else abs(value) if kind == "coupled" else value

    def _size(self, kind: str, i: int, j: int) -> float:
        """Return whether one signal is larger; for probes, also whether the housing moves the other one."""
        if (found := self.whole(i, j)) is None or self.units[i] != self.units[j]:
            return 0.0
        ratio = math.log(found.size) / math.log(_DISK_RATIO)
        sized = max(-1.0, min(1.0, ratio))
        scaled = self.units[i] not in ("", "V", "mV")
        if kind == "stronger":
            return sized if self.units[i] else 0.0
        # The ring's probes move with the housing, which the contact forces displace: what a probe has in common with
        # them apart from the other probe is positive for the disk.
        partial = 0.0
        for k in range(len(self.signals)):
            with_i, with_j, both = self.likeness(i, k), self.likeness(j, k), found.likeness
            if k not in (i, j) and _MIN_LIKENESS < abs(with_j) < 0.98 and both > 0.9:
                norm = math.sqrt(max((1.0 - both**2) * (1.0 - with_j**2), 1e-12))
                partial += math.copysign((with_i - both * with_j) / norm, with_j * (with_i - both * with_j))
        return max(-1.0, min(1.0, (sized if scaled else 0.3 * sized) + 1.5 * max(-1.0, min(1.0, partial))))


class Choice(NamedTuple):
    """Channel of a signal.

    Attributes:
        channel: The channel; empty: none.
        kind_margin: Loss of score without this kind.
        margin: Loss of score of the best assignment in which the signal has another channel of this kind.
        other: Channel of the signal in that assignment.
        named: Advantage of this channel by the name alone over those of other axes or sides.
    """

    channel: str = ""
    kind_margin: float = 0.0
    margin: float = math.inf
    other: str = ""
    named: float = math.inf


def assign_channels(scores: np.ndarray, relations: Relations) -> list[Choice]:
    """Return the best assignment.

    Args:
        scores: Score of each signal for each of `CHANNELS`, shape (signals, channels).
        relations: Relations of the signals.
    """
    chosen = _solve(scores)
    best = _total(scores, chosen)
    kind_margins = {}
    for signal, channel in list(chosen.items()):
        without = scores.copy()
        without[signal, [CHANNELS.index(each) for each in family_of(channel)]] = -math.inf
        kind_margins[signal] = best - _total(without, _solve(without))
        own = scores[signal, [CHANNELS.index(each) for each in family_of(channel)]]
        if kind_margins[signal] < _AMBIGUITY and len(own) > 1 and np.ptp(own) == 0.0:
            del chosen[signal]
    settled = {signal: channel for signal, channel in chosen.items() if len(family_of(channel)) == 1}
    ranked: dict[str, list[tuple[float, dict[int, str]]]] = {}
    for _ in range(3):
        for kind in ("length", "force", "acceleration"):
            members = [signal for signal, channel in chosen.items() if channel in FAMILIES[kind]]
            rest = {signal: channel for signal, channel in settled.items() if signal not in members}
            options = (
                rest | dict(zip(members, each, strict=True))
                for each in itertools.permutations(FAMILIES[kind], len(members))
            )
            ranked[kind] = sorted(
                ((_total(scores, each) + _related(each, relations), each) for each in options), key=lambda one: -one[0]
            )
            settled = ranked[kind][0][1]
    whole = _total(scores, settled) + _related(settled, relations)
    mirrored = {
        signal: channel[:-1] + channel[-1].translate(_MIRROR) if len(family_of(channel)) > 1 else channel
        for signal, channel in settled.items()
    }
    mirror = (_total(scores, mirrored) + _related(mirrored, relations), mirrored)
    found = [Choice()] * len(scores)
    for signal, channel in settled.items():
        family = family_of(channel)
        if len(family) == 1:
            found[signal] = Choice(channel, kind_margins[signal])
            continue
        kind = next(kind for kind, each in FAMILIES.items() if channel in each)
        others = [one for one in (*ranked[kind], mirror) if one[1][signal] != channel]
        total, other = max(others, key=lambda one: one[0])
        own = {each: scores[signal, CHANNELS.index(each)] for each in family}
        named = own[channel] - max(score for each, score in own.items() if each[-1] != channel[-1])
        found[signal] = Choice(channel, kind_margins[signal], whole - total, other[signal], named)
    return found


def family_of(channel: str) -> tuple[str, ...]:
    """Return the channels of the same kind."""
    return next(family for family in FAMILIES.values() if channel in family)


def _solve(scores: np.ndarray) -> dict[int, str]:
    """Return the channels of the signals with the largest sum of scores, without pairs."""
    from scipy.optimize import linear_sum_assignment

    rows = len(scores)
    padded = np.hstack([np.maximum(scores, -1e3), np.full((rows, rows), _NO_CHANNEL)])
    signals, columns = linear_sum_assignment(padded, maximize=True)
    return {int(i): CHANNELS[j] for i, j in zip(signals, columns, strict=True) if j < len(CHANNELS)}


def _total(scores: np.ndarray, chosen: Mapping[int, str]) -> float:
    assigned = sum(float(scores[signal, CHANNELS.index(channel)]) for signal, channel in chosen.items())
    return assigned + _NO_CHANNEL * (len(scores) - len(chosen))


def _related(chosen: Mapping[int, str], relations: Relations) -> float:
    """Return the score of the pairs of signals."""
    return sum(weight * relations.measure(kind, i, j) for kind, weight, i, j in find_pairs(chosen))


def find_pairs(chosen: Mapping[int, str]) -> list[tuple[str, float, int, int]]:
    """Return kind, weight and signals of each rule that applies."""
    at = {channel: signal for signal, channel in chosen.items()}
    return [(kind, weight, at[a], at[b]) for kind, weight, pairs in _RULES for a, b in pairs if a in at and b in at]
