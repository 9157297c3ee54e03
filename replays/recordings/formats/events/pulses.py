"""Detection of hammer pulses in a force signal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.estimate.runs import split_at_breaks
from replays.estimate.spool import blocks

if TYPE_CHECKING:
    from replays.recordings.formats.clock import TimeAxis
    from replays.recordings.formats.mapping import HammerMapping

_FOOT_FRACTION = 0.05
"""Fraction of its peak down to which a pulse is integrated on both sides."""
_DEFAULT_DEAD_S = 0.1
"""Dead time after a pulse unless the mapping sets one [s]; within it a pulse counts only if it is clearly separate."""
_MIN_PAUSE_LENGTHS, _MIN_PEAK_RATIO = 2.0, 0.2
"""A pulse is separate if the force was below the threshold for this many lengths of the previous pulse, and its peak is
at least this fraction of the previous one. Ringing has no pause, and rebounds are small."""


@dataclass(frozen=True)
class HammerPulse:
    """Hammer pulse as the half sine of equal peak, impulse and centre, as in a scene.

    Attributes:
        at_s: Start [s].
        force_n: Peak [N].
        duration_ms: Length, pi/2 times impulse over peak [ms].
        direction: Direction as in a scene.
        is_cut: Whether the log begins or ends, or samples are missing, within it.
    """

    at_s: float
    force_n: float
    duration_ms: float
    direction: str | float
    is_cut: bool = False

    def command(self) -> dict[str, Any]:
        """Return the pulse as a command of a scene."""
        return {
            "at_s": self.at_s, "command": "hammer", "force_n": self.force_n, "duration_ms": self.duration_ms,
            "direction": self.direction,
        }  # fmt: skip


def find_pulses(
    force: np.ndarray, axis: TimeAxis, wanted: HammerMapping
) -> tuple[list[HammerPulse], list[HammerPulse]]:
    """Return the hammer pulses in a force that count, and separate ones that follow another too soon.

    A pulse is an interval above the threshold. After a pulse, others are ignored for the dead time; without a given
    dead time, clearly separate pulses count.

    Args:
        force: Force of the hammer [N], shape (n,); nan if missing.
        axis: Its time axis.
        wanted: Threshold, dead time and direction.
    """
    above_s, above = list[np.ndarray](), list[np.ndarray]()
    for part in blocks(len(force), force):
        above_s.append(axis.instants(part)[np.abs(force[part]) >= wanted.threshold_n])  # both signs: the hammer rings
        above.append(part.start + np.flatnonzero(force[part] >= wanted.threshold_n))
    pulses: list[HammerPulse] = []
    ignored: list[HammerPulse] = []
    next_allowed_s = -math.inf
    loud_s, loud = np.concatenate(above_s), np.concatenate(above)
    for start, end in split_at_breaks(np.diff(loud) > 1) if len(loud) else []:
        run = int(loud[start]), int(loud[end - 1]) + 1
        at_s = float(axis.instants(slice(*run))[0])
        last = pulses[-1] if pulses else None
        soon = last is not None and at_s < next_allowed_s
        if last is not None and soon:
            before = int(np.searchsorted(loud_s, at_s))
            if at_s - loud_s[before - 1] < _MIN_PAUSE_LENGTHS * 1e-3 * last.duration_ms:
                continue
        pulse = _pulse(force, axis, run, wanted)
        if last is not None and soon and (wanted.dead_s is not None or pulse.force_n < _MIN_PEAK_RATIO * last.force_n):
            ignored.append(pulse)
            continue
        next_allowed_s = at_s + (_DEFAULT_DEAD_S if wanted.dead_s is None else wanted.dead_s)
        pulses.append(pulse)
    return pulses, ignored


def _pulse(force: np.ndarray, axis: TimeAxis, above: tuple[int, int], wanted: HammerMapping) -> HammerPulse:
    """Return the pulse that exceeds the threshold in a range of rows."""
    low, high = above
    foot = _FOOT_FRACTION * float(force[low:high].max())
    while low > 0 and force[low - 1] > foot:
        low -= 1
    while high < len(force) and force[high] > foot:
        high += 1
    pulse, when = force[low:high], axis.instants(slice(low, high))
    peak, impulse = float(pulse.max()), float(pulse.sum()) / axis.rate_hz
    duration = 0.5 * math.pi * impulse / peak
    centre = float(pulse @ when) / float(pulse.sum())
    is_cut = low == 0 or high == len(force) or bool(np.isnan(force[[low - 1, high]]).any())
    at_s = centre - 0.5 * duration - wanted.delay_us * 1e-6
    return HammerPulse(at_s, peak, duration * 1e3, wanted.direction, is_cut)
