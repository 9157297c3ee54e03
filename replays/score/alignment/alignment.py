"""Alignment of each table of a record with the session: the begin that explains it, and the track of its rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from replays.score.alignment.begins import FOLLOWED, SAME_BALANCE, Begins, trimmed
from replays.score.alignment.one_begin import FEWEST, Alignment, Source, busiest, follow

_STRETCHES_S = (0.25, 0.03)
"""Lengths of the stretch that is fitted first; the second where clocks are apart, or samples lost, in the first [s]."""
_ROUNDS = 3
"""Searches for begins where the signal repeats, each by the clock that the last one found."""

_MAX_LOG_APART = math.log(2.0)
"""Logarithms of residual power, summed over signals, within which begins explain all signals alike."""


def align(sources: Sequence[Source]) -> Alignment | None:
    """Align the signals of one table with the session; None where none of them is found in it."""
    if not sources or len(sources[0].values) < FEWEST:
        return None
    one = max(sources, key=lambda each: each.wire.likeness)
    rows = len(one.values)
    within_s = one.wire.within_s
    within = [min(rows, max(0, round((each - one.first_s) * one.rate_hz))) for each in within_s]
    if within[1] - within[0] < FEWEST:
        within = [0, rows]
    default = [busiest(sources, (within[0], within[1]), round(each * one.rate_hz)) for each in _STRETCHES_S]

    def stretches(shift_s: float) -> list[tuple[int, int]]:
        """Stretches that lie in the session from a begin."""
        ends_s = [each - one.late_s - shift_s - one.first_s for each in one.stimulus.span_s]
        first, last = (min(rows, max(0, round(each * one.rate_hz))) for each in ends_s)
        if last - first < FEWEST or (first <= default[0][0] and default[0][1] <= last):
            return default
        return [busiest(sources, (first, last), round(each * one.rate_hz)) for each in _STRETCHES_S]

    if not one.wire.others_s:
        return follow(sources, 0.0, default)
    begins = Begins(one, sources, stretches)
    begins.try_all([0.0, *(each - one.wire.late_s for each in one.wire.others_s)])
    for _ in range(_ROUNDS):
        begins.try_all(begins.repeats())
    alike, found = _follow_alike(begins, sources)
    if found and all(each.track.steps() for each in found):
        begins.search_all()
        alike, found = _follow_alike(begins, sources)
    if not found:
        return follow(sources, 0.0, default)
    most = max(each.balance for each in found)
    left = [_log_residual_power(each, sources) if found[1:] else 0.0 for each in found]

    def rank(n: int) -> tuple[bool, bool, int, bool, int, float]:
        each, alike_in_all = found[n], left[n] <= min(left) + _MAX_LOG_APART
        contradicted = any(left[m] < left[n] and _contradicts(other, each) for m, other in enumerate(found))
        balanced = each.balance > SAME_BALANCE * most
        return not contradicted, balanced, -begins.unaccounted(each), alike_in_all, each.upright, -abs(each.begin_s)

    best = found[max(range(len(found)), key=rank)]
    steps = len(best.track.steps())
    if best.whole and not best.upright:
        # Half a period later the signal is inverted: more rows in the session are no reason for an inverted record.
        upright = [
            n for n, each in enumerate(found) if each.upright and each.whole and len(each.track.steps()) == steps
        ]
        best = found[max(upright, key=rank)] if upright else best
    doubted = any(each.track.explained > best.track.explained and _contradicts(best, each) for each in found)
    return replace(trimmed(best, one), ambiguous=len(alike) > 1, steps_doubted=doubted)


def _follow_alike(begins: Begins, sources: Sequence[Source]) -> tuple[list[Alignment], list[Alignment]]:
    """Return the begins that none surpasses, by some signals, and the first of them followed by all signals."""
    alike = begins.alike()
    shifts_s = [each.begin_s for each in alike[:FOLLOWED]]
    return alike, [each for s in shifts_s if (each := follow(sources, s, begins.stretches(s)))]


def _contradicts(other: Alignment, found: Alignment) -> bool:
    """Return whether an alignment explains the rows about a step of another one without a step.

    A lost sample is lost from whichever begin. Where a signal nearly repeats, a wrong begin may need steps in place of
    the difference, and explain rows after the session's end for these.
    """
    return any(
        run.begin <= max(0, first - FEWEST) and min(found.rows, last + FEWEST) <= run.end
        for first, last, _ in found.track.steps()
        for run in other.track.runs
    )


def _log_residual_power(found: Alignment, sources: Sequence[Source]) -> float:
    """Return the logarithm of the part of each signal's power that one common begin leaves, summed over the signals.

    Each signal fits a repeated begin at a time of its own, as a keyphasor whose pulses come at another part of a whirl.
    """
    common_s, total = float(np.median(list(found.own_s.values()))), 0.0
    for one in sources:
        values, times_s, (late_s, pace, bend) = found.even(one)
        since_s = times_s - 0.5 * (times_s[0] + times_s[-1])
        own_s = found.own_s.get(one.name, one.late_s + found.begin_s)
        at_s = times_s + late_s - own_s + common_s + since_s * (pace + bend * since_s)
        held = np.isfinite(values) & (at_s >= one.stimulus.span_s[0]) & (at_s <= one.stimulus.span_s[1])
        known = one.stimulus(at_s[held])[0]
        if np.std(known) and np.std(values[held]):
            total += math.log(max(1e-12, 1.0 - float(np.corrcoef(known, values[held])[0, 1]) ** 2))
    return total
