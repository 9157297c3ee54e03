"""Defects of single channels in a recording of this rig, whose counts differ while the motion is equal to the bit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from replays.recordings.resimulation.prediction import Measured, Prediction
from replays.recordings.validation.explanations.channel_fit import MIN_ROWS, Shown
from replays.recordings.validation.explanations.explanation import Explanation
from replays.recordings.validation.explanations.faults import PAIR_ROWS, diagnose, extend, find_others, select_channels
from replays.recordings.validation.explanations.laws import law_of
from replays.recordings.validation.explanations.signals import SignalFault
from rig.channels.faults.defects import alternatives, size_text, unit_of
from rig.channels.table import Channel

_MAX_DELAY_S = 0.011
"""Time for which a delayed channel holds its first value."""
_SETTLING_PERIODS = 6.0
"""Time in which a filter settles, in periods of its corner."""
_MAX_ROWS = 20_000
"""Largest number of rows of a channel that are fitted."""
_END_PART, _MIN_OTHER_PART = 1e-3, 0.2
"""Distance from an end of the conditioner's range within which rows are excluded, and the part of other rows needed."""
_NO_FILTER = 1e4
"""Factor on a corner that removes the filter."""
_MAX_EDGE_SHIFT = 0.1
"""Largest shift of an edge, in turns."""
_MIN_FOREIGN_PART, _MIN_FOREIGN_CHANNELS, _MIN_FOREIGN_NOISE = 0.9, 0.75, 0.7
"""Smallest parts of rows and of channels that differ in rows of another run, and smallest noise of the difference, by
its second differences, over the noise; for independent noise it is 1.4."""
_MIN_JUMP = 5.0
"""Smallest jump at the first row of another run with the same noise, over the noise."""
_EVEN_S = 1e-5
"""Standard deviation of shifts of edges that count as equal."""


def own_faults(
    parts: dict[str, Measured], nominal: Prediction, apart: Callable[[str], tuple[np.ndarray, dict[str, np.ndarray]]],
    recorded_s: np.ndarray, made_s: np.ndarray, again: Callable[[dict[str, Measured]], Prediction],
    step: Callable[[str], None] = lambda _text: None,
) -> list[Explanation]:  # fmt: skip
    """Return the defects of channels whose counts differ from those of the same motion resimulated to the bit.

    The noise is equal in both, and is subtracted from the recorded signals.

    Args:
        parts: Recorded channels.
        nominal: Prediction.
        apart: Function that returns, for a group, the differing rows and by channel their counts, shape (n,).
        recorded_s: Recorded edges of the keyphasor [s].
        made_s: Simulated edges [s].
        again: Function that predicts other channels of the same motion.
        step: Function that is called with the current step.
    """
    shown, ends = [], dict[str, Callable[[], Shown]]()
    for name, part in parts.items():
        index, counts = apart(name)
        at = np.searchsorted(part.index, index)
        there = at < len(part.index)
        there[there] = part.index[at[there]] == index[there]
        for c, channel in enumerate(part.channels):
            off = np.zeros(len(part.index))
            if channel.name in counts:
                off[at[there]] = counts[channel.name][there]
            rows = np.flatnonzero(off)
            if not len(rows):
                continue
            lasted_s = float(part.times_s[rows[0]]), float(part.times_s[rows[-1]])
            fine = round(_SETTLING_PERIODS / channel.bandwidth_hz * channel.rate_hz)
            skips = (max(fine, round(_MAX_DELAY_S * channel.rate_hz)), fine, 0)
            first = next(int(rows[0]) + skip for skip in skips if rows[-1] - rows[0] >= 3 * skip)
            # Rows after its end belong to the filter.
            last = int(rows[-1]) + 1 - (fine if rows[-1] - first > 3 * fine else 0)
            expected, dense = nominal.values[name][:, c], 5 * np.count_nonzero(off[first:last]) > last - first
            show_rows = partial(_shown, part, channel, expected, off, lasted_s)
            few = partial(_bare, part, channel, again), partial(find_others, parts, nominal, channel)
            rows = np.arange(first, min(last, first + _MAX_ROWS))
            if len(rows) < (MIN_ROWS if dense else PAIR_ROWS):
                rows = np.arange(max(0, first - PAIR_ROWS), min(first + PAIR_ROWS, len(off)))
            shown.append(show_rows(rows, *few))
            if last - first > 2 * _MAX_ROWS:
                ends[channel.name] = partial(show_rows, np.arange(last - _MAX_ROWS, last), *few)
    about = {one.name: one for one in shown}
    faults = []
    for one in diagnose(shown, max((float(one.times_s[-1]) for one in shown), default=0.0), step):
        its = [about[name] for name in select_channels([one], about)]
        # Relative to the noise, not to the steps of the converter.
        steps = max(each.noise / float(each.floor[0]) for each in its)
        begin, end = min(each.lasted_s[0] for each in its), max(each.lasted_s[1] for each in its)
        if one.sure and len(its) == 1 and its[0].name in ends:
            step(f"{its[0].name} at its end")
            later = law_of(ends[its[0].name]())
            common = [name for name in alternatives(one.channels_and_defect[1]) if name in alternatives(later.name)]
            if common:
                one = replace(one, name=f"{its[0].name} {' or '.join(common)}")
            elif one.name != f"{its[0].name} {later.name}":
                one = replace(one, sure=False, change=f"{one.change}, and at its end {later.name} {later.change}")
        # In so short a time, a held value matches almost any law, except for one that matches each count.
        one = replace(one, sure=one.sure and (end - begin > _MAX_DELAY_S or one.squares == 0.0))
        faults.append(replace(one, left=one.left / max(1.0, steps), from_s=begin, to_s=end))
    # A recording may begin and end within a run.
    begin_s = min(float(part.times_s[0]) for part in parts.values())
    end_s = max(float(part.times_s[-1]) for part in parts.values())
    others = [one for one in faults if not one.name.startswith("keyphasor")]
    late = any("delay" in one.name for one in faults if one not in others)
    edges = _own_edges(*(each[(each > begin_s) & (each < end_s)] for each in (recorded_s, made_s)), late=late)
    return faults if edges is None else [*others, edges]


def _shown(
    part: Measured, channel: Channel, expected: np.ndarray, off: np.ndarray, lasted_s: tuple[float, float],
    rows: np.ndarray, bare: Callable[[np.ndarray], np.ndarray], others: Callable[[], Mapping[Channel, Any]],
) -> Shown:  # fmt: skip
    """Return a channel in some rows, with known differences in counts `off`, shape (all rows,)."""
    volts = channel.bias_v + channel.sensitivity_v * (expected + channel.scale * off)
    limits = np.array([*channel.range_v, -channel.adc_v, channel.adc_v])
    at_end = np.abs(volts[:, None] - limits).min(axis=1) < _END_PART * np.ptp(channel.range_v)
    within = ~np.convolve(at_end, np.ones(2 * MIN_ROWS + 1), "same").astype(bool)
    if within[rows].mean() > _MIN_OTHER_PART:
        rows = rows[within[rows]]
    recorded = np.rint((part.values[rows, part.names.index(channel.name)] - channel.offset) / channel.scale)
    return Shown(
        channel, part.times_s[rows], (expected + channel.scale * off)[rows], expected[rows],
        np.full(len(rows), 0.5 * abs(channel.scale)), channel.noise_v / abs(channel.sensitivity_v),
        partial(bare, rows), others, np.column_stack([recorded, recorded - off[rows]]).astype(np.int64), lasted_s,
        extend(part, expected, rows[0], rows[-1] + 1),
    )  # fmt: skip


def _bare(
    part: Measured, channel: Channel, again: Callable[[dict[str, Measured]], Prediction], rows: np.ndarray
) -> np.ndarray:
    """Return the expected signal of a channel in some rows without its low-pass [its unit]."""
    alone = part.select_first(int(rows[-1]) + 1).select_channels([channel.name]).with_corner_factor(_NO_FILTER)
    return again({part.group: alone}).values[part.group][rows, 0]


def _own_edges(recorded_s: np.ndarray, made_s: np.ndarray, *, late: bool) -> Explanation | None:
    """Return missing or extra keyphasor edges, or their shifts; None if the signal, late or not, shows more."""
    lacking, more = np.setdiff1d(made_s, recorded_s), np.setdiff1d(recorded_s, made_s)
    if 1 <= min(len(lacking), len(more)) == max(len(lacking), len(more)) - 1:  # one may have moved over an end
        most = _MAX_EDGE_SHIFT * float(np.diff(made_s).min(initial=math.inf))
        for part in (slice(1, None), slice(None, -1)):
            fewer = (lacking[part], more) if len(lacking) > len(more) else (lacking, more[part])
            if np.abs(fewer[1] - fewer[0]).max() < most:
                lacking, more = fewer
                break
    off = np.sort(np.concatenate([lacking, more]))
    moved_s = more - lacking if len(more) == len(lacking) else np.empty(0)
    turns = np.count_nonzero((made_s >= off[0]) & (made_s <= off[-1])) if len(off) else 0
    if len(moved_s) == 1 and late:  # a single edge leaves both open
        what, value = "delay or edge-jitter", float(moved_s[0])
        change = f"{size_text('delay', value)}, one edge"
    elif len(moved_s) > 1 and moved_s.std() > _EVEN_S:
        what, value = "edge-jitter", float(moved_s.std())
        change = f"{1e6 * value:.4g} µs about {1e6 * moved_s.mean():.4g} µs"
    elif len(moved_s) or not len(off):
        return None
    elif len(lacking) < turns and not len(more):
        what, value, change = "miss-pulses", len(lacking) / turns, f"{len(lacking)} of {turns}"
    elif len(more) > len(lacking):
        what, value, change = "extra-pulses", len(more) / max(1, turns), f"{len(more)} in addition to {turns}"
    else:
        what, value, change = "open, short or miss-pulses", 1.0, f"{len(lacking)} of {turns}"
    unit = unit_of(alternatives(what)[-1], "")
    explanation = Explanation.of(
        np.empty(0), kind="sensor", name=f"keyphasor {what}", change=change, value=value, unit=unit,
        explained=0.0, to_s=float(off[-1]),
    )  # fmt: skip
    return replace(explanation, from_s=float(off[0]))


def find_other_runs(
    parts: Mapping[str, Measured], apart: Callable[[str], tuple[np.ndarray, dict[str, np.ndarray]]]
) -> list[SignalFault]:
    """Return the rows that are of another run, as the probes and most other channels differ at once beyond their noise.

    Motion that differs for another reason has equal noise, and inertia lets the probes differ gradually.

    Args:
        parts: Recorded channels.
        apart: Function that returns, for a group, the differing rows and by channel their counts, shape (n,).
    """
    spans, differ = list[tuple[float, float]](), list[bool]()
    for name, part in parts.items():
        index, counts = apart(name)
        rows = np.flatnonzero(np.isin(part.index, index))
        at_once = len(rows) >= MIN_ROWS and len(rows) > _MIN_FOREIGN_PART * (rows[-1] - rows[0] + 1)
        for one, random in zip(part.channels, part.random, strict=True):
            if random and one.signal != "keyphasor":
                off_v = one.scale * one.sensitivity_v * counts.get(one.name, np.zeros(3))[:MIN_ROWS]
                noise = float(np.diff(off_v, 2).std()) / math.sqrt(6.0) if at_once and len(off_v) > 2 else 0.0
                jumps = at_once and abs(off_v[0]) > _MIN_JUMP * one.noise_v
                differ.append(bool(jumps or noise > _MIN_FOREIGN_NOISE * one.noise_v))
                if one.unit == "mm" and not differ[-1]:
                    return []
                if one.unit == "mm":
                    spans.append((float(part.times_s[rows[0]]), float(part.times_s[rows[-1]])))
    starts_s, ends_s = zip(*((part.times_s[0], part.times_s[-1]) for part in parts.values()), strict=True)
    begins, ends = np.array(spans).reshape(-1, 2).T
    if not spans or np.mean(differ) < _MIN_FOREIGN_CHANNELS:
        return []
    begin, end = float(begins.min()), float(ends.max())
    if begin <= max(starts_s):
        return []
    until = f"to {end:.4f} s" if end < max(ends_s) - _MAX_DELAY_S else "on"
    text = f"all probes differ at once from {begin:.4f} s {until}, by other noise or a jump: "
    return [SignalFault("time", "other run", begin, end, f"{text}these rows are of another run or time")]


def make_signal_faults(own: Sequence[Explanation]) -> tuple[SignalFault, ...]:
    """Return the defects of channels as faults of signals."""
    faults = []
    for one in own:
        names, what = one.channels_and_defect
        rest = f"({one.left:.2g} times the noise is left)"
        text = one.change if one.sure else f"by no known law; closest is {what} {one.change} {rest}"
        what, text = (what if one.sure else "differs", f"{text}, ") if what else (one.change, "")
        text += f"from {one.from_s:.4f} to {one.to_s:.4f} s"
        faults.append(SignalFault(names, what, one.from_s, one.to_s, text))
    return tuple(faults)
