"""Hammer pulses in a force."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.estimate.runs import true_runs

if TYPE_CHECKING:
    from replays.recordings.formats.clock import Axis
    from replays.recordings.formats.mapping import HammerMapping

_FOOT = 0.05
"""A pulse is summed out to this part of its peak on either side."""
_DEAD_S = 0.1
"""So soon behind a pulse one counts only [s] ..."""
_RESTED, _LARGE = 2.0, 0.2
"""... if the hammer has been below the threshold for so many times as long as the one before, and it is this part of
that in force: ringing does not rest, and rebounds are small."""


@dataclass(frozen=True)
class HammerPulse:
    """A hammer pulse as the half sine of the same peak and impulse, centred where it is: how a scene tells it.

    Attributes:
        at_s: Start [s].
        force_n: Peak [N].
        duration_ms: Length, pi/2 times impulse over peak [ms].
        direction: As in a scene.
    """

    at_s: float
    force_n: float
    duration_ms: float
    direction: str | float

    def command(self) -> dict[str, Any]:
        """As a scene's command."""
        return {
            "at_s": self.at_s, "command": "hammer", "force_n": self.force_n, "duration_ms": self.duration_ms,
            "direction": self.direction,
        }  # fmt: skip


def find_pulses(force_n: np.ndarray, axis: Axis, wanted: HammerMapping) -> tuple[list[HammerPulse], list[HammerPulse]]:
    """Hammer pulses in a force: those that count, and those that are of their own but come too soon behind another.

    A pulse is a stretch above the threshold. Behind one the dead time has to pass, if it is given; else a pulse counts
    at once that is clearly one of its own.

    Args:
        force_n: Force of the hammer [N], shape (n,).
        axis: Its time axis.
        wanted: Threshold, dead time, direction.
    """
    times_s = axis.instants()
    force = np.nan_to_num(force_n)
    loud_s = times_s[np.abs(force) >= wanted.threshold_n]  # ringing goes to both sides
    found: list[HammerPulse] = []
    passed_over: list[HammerPulse] = []
    free_s = -math.inf
    for start, end in true_runs(force >= wanted.threshold_n):
        at_s = float(times_s[start])
        last = found[-1] if found else None
        soon = last is not None and at_s < free_s
        if last is not None and soon:
            before = int(np.searchsorted(loud_s, at_s))
            if at_s - loud_s[before - 1] < _RESTED * 1e-3 * last.duration_ms:
                continue
        pulse = _pulse(force, times_s, (start, end), axis.rate_hz, wanted)
        if last is not None and soon and (wanted.dead_s is not None or pulse.force_n < _LARGE * last.force_n):
            passed_over.append(pulse)
            continue
        free_s = at_s + (_DEAD_S if wanted.dead_s is None else wanted.dead_s)
        found.append(pulse)
    return found, passed_over


def _pulse(
    force: np.ndarray, times_s: np.ndarray, above: tuple[int, int], rate_hz: float, wanted: HammerMapping
) -> HammerPulse:
    """Return the pulse that is above the threshold in a run of rows."""
    low, high = above
    foot = _FOOT * float(force[low:high].max())
    while low > 0 and force[low - 1] > foot:
        low -= 1
    while high < len(force) and force[high] > foot:
        high += 1
    pulse, when = force[low:high], times_s[low:high]
    peak, impulse = float(pulse.max()), float(pulse.sum()) / rate_hz
    duration = 0.5 * math.pi * impulse / peak
    centre = float(pulse @ when) / float(pulse.sum())
    return HammerPulse(centre - 0.5 * duration - wanted.delay_us * 1e-6, peak, duration * 1e3, wanted.direction)
