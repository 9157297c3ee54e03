"""Alignment of each table of a record with the session: the start that explains it best, and the track of its rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from replays.score.alignment.candidate_starts import EQUAL_BALANCE_PART, MAX_FOLLOWED, Candidates, trim_quiet_ends
from replays.score.alignment.single_start import MIN_ROWS, Alignment, RowSource, find_busiest, follow

_STRETCHES_S = (0.25, 0.03)
"""Lengths of the first fitted stretch [s]; the second one if clocks differ, or samples are lost, in the first."""
_MAX_SEARCHES = 3
"""Searches for starts of a repeating signal, each by the clock of the previous one."""

_EQUAL_LOG_POWER = math.log(2.0)
"""Largest difference in the logarithm of residual power, summed over signals, at which starts count as equal."""


def align(sources: Sequence[RowSource]) -> Alignment | None:
    """Align the signals of one table with the session; return None if they are not found in it."""
    if not sources or len(sources[0].values) < MIN_ROWS:
        return None
    one = max(sources, key=lambda each: each.wire.likeness)
    rows = len(one.values)
    within_s = one.wire.within_s
    within = [min(rows, max(0, round((each - one.first_s) * one.rate_hz))) for each in within_s]
    if within[1] - within[0] < MIN_ROWS:
        within = [0, rows]
    default = [find_busiest(sources, (within[0], within[1]), round(each * one.rate_hz)) for each in _STRETCHES_S]

    def stretches(shift_s: float) -> list[tuple[int, int]]:
        """Return stretches that are in the session from a start."""
        ends_s = [each - one.offset_s - shift_s - one.first_s for each in one.stimulus.span_s]
        first, last = (min(rows, max(0, round(each * one.rate_hz))) for each in ends_s)
        if last - first < MIN_ROWS or (first <= default[0][0] and default[0][1] <= last):
            return default
        return [find_busiest(sources, (first, last), round(each * one.rate_hz)) for each in _STRETCHES_S]

    if not one.wire.others_s:
        return follow(sources, 0.0, default)
    candidates = Candidates(one, sources, stretches)
    candidates.follow_candidates([0.0, *(each - one.wire.offset_s for each in one.wire.others_s)])
    for _ in range(_MAX_SEARCHES):
        candidates.follow_candidates(candidates.find_shifts())
    alike, alignments = _follow_best(candidates, sources)
    if alignments and all(each.track.steps() for each in alignments):
        candidates.search_more_signals()
        alike, alignments = _follow_best(candidates, sources)
    if not alignments:
        return follow(sources, 0.0, default)
    most = max(each.balance for each in alignments)
    powers = [_log_residual_power(each, sources) if alignments[1:] else 0.0 for each in alignments]

    def rank(n: int) -> tuple[bool, bool, int, bool, int, float]:
        each, alike_in_all = alignments[n], powers[n] <= min(powers) + _EQUAL_LOG_POWER
        contradicted = any(powers[m] < powers[n] and _contradicts(other, each) for m, other in enumerate(alignments))
        balanced = each.balance > EQUAL_BALANCE_PART * most
        return not contradicted, balanced, -candidates.penalty(each), alike_in_all, each.upright, -abs(each.shift_s)

    best = alignments[max(range(len(alignments)), key=rank)]
    steps = len(best.track.steps())
    if best.whole and not best.upright:
        # Half a period later the signal is inverted: more rows in the session do not justify an inverted record.
        upright = [
            n for n, each in enumerate(alignments) if each.upright and each.whole and len(each.track.steps()) == steps
        ]
        best = alignments[max(upright, key=rank)] if upright else best
    doubted = any(each.track.explained > best.track.explained and _contradicts(best, each) for each in alignments)
    return replace(trim_quiet_ends(best, one), ambiguous=len(alike) > 1, steps_doubted=doubted)


def _follow_best(candidates: Candidates, sources: Sequence[RowSource]) -> tuple[list[Alignment], list[Alignment]]:
    """Return the starts that none surpasses by some signals, and the alignments of the first of them by all signals."""
    alike = candidates.find_best()
    shifts_s = [each.shift_s for each in alike[:MAX_FOLLOWED]]
    return alike, [each for s in shifts_s if (each := follow(sources, s, candidates.stretches(s)))]


def _contradicts(other: Alignment, alignment: Alignment) -> bool:
    """Return whether an alignment explains the rows about another one's step without a step.

    A lost sample is a step from every start. Where a signal nearly repeats, an incorrect start may need steps in place
    of the difference, and with these explain rows after the session's end.
    """
    return any(
        run.start <= max(0, first - MIN_ROWS) and min(alignment.rows, last + MIN_ROWS) <= run.end
        for first, last, _ in alignment.track.steps()
        for run in other.track.runs
    )


def _log_residual_power(alignment: Alignment, sources: Sequence[RowSource]) -> float:
    """Return the logarithm of the residual part of each signal's power from a common start, summed over the signals.

    Each signal matches a repeated start at a slightly different time, as a keyphasor does whose pulses occur at another
    angle of the whirl.
    """
    common_s, total = float(np.median(list(alignment.own_s.values()))), 0.0
    for one in sources:
        values, times_s, (late_s, pace, bend) = alignment.even(one)
        since_s = times_s - 0.5 * (times_s[0] + times_s[-1])
        own_s = alignment.own_s.get(one.name, one.offset_s + alignment.shift_s)
        at_s = times_s + late_s - own_s + common_s + since_s * (pace + bend * since_s)
        held = np.isfinite(values) & (at_s >= one.stimulus.span_s[0]) & (at_s <= one.stimulus.span_s[1])
        sent = one.stimulus(at_s[held])[0]
        if np.std(sent) and np.std(values[held]):
            total += math.log(max(1e-12, 1.0 - float(np.corrcoef(sent, values[held])[0, 1]) ** 2))
    return total
