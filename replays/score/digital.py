"""Digital path: the DAQ recorded the rig's counts, so each row must be there once, in order, with all counts correct.

Rows are compared with those sent (`rows`). The scale of each channel is found first, and counts must then be exact.
Time stamps are compared with the times of their rows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain

import numpy as np

from replays.score.alignment.overlap import holds_session_rows
from replays.score.alignment.row_matching import SignalRows
from replays.score.alignment.stamps import Stamps
from replays.score.card.scorecard import Interval, Scorecard
from replays.score.records.live import Arrivals
from replays.score.records.recorded import Recorded, RecordedTable
from replays.score.records.rows import Followed, follow, repeated_part, row_hashes, stretches, take_rows
from replays.score.records.scale import Scale
from replays.score.records.sent import Sent, Session
from replays.score.records.wiring import Wire
from rig.channels.table import Channel

_BACKLOG_S = 1.0
"""Initial time for which no latency is measured, because rows that waited in a pipe arrive then [s]."""
_MAX_RANGES = 5
"""Largest number of row ranges in a note; the JSON document has all."""
_REPEATING_PART = 0.5
"""Fraction of repeated rows above which the loss of whole periods may go unnoticed."""
_EDGE_ROWS = 1 << 17
"""Rows on each side of an end of the session that are compared with all of the session."""


def score_digital(
    card: Scorecard, recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], matches: Mapping[str, SignalRows],
    session: Session, arrivals: Arrivals | None = None,
) -> None:  # fmt: skip
    """Add the rows of the digital path to a scorecard, with the latency if the arrival times of rows are known."""
    for name, each in matches.items():
        _score_scale(card, name, each.scale, session.channels[wires[name].channel])
    coarse = [each.scale for each in matches.values() if each.scale.rounding]
    for bits, rounding in dict.fromkeys((scale.bits, scale.rounding) for scale in coarse):
        card.remarks.append(f"counts of {bits} bits, rounded {rounding}, are compared; the rig's lower bits are not")
    tables: dict[tuple[float, ...], list[str]] = {}
    for name in sorted(matches, key=lambda each: not matches[each].scale.known):
        rate_hz = session.rate_hz(session.channels[wires[name].channel].group)
        table = recorded[name].rows, rate_hz, matches[name].step, matches[name].phase, matches[name].early
        tables.setdefault(table, []).append(name)
    for names in tables.values():
        _score_rows(card, names, wires, recorded, matches, session, arrivals)


def _exact(count: float) -> Interval:
    return float(count), float(count), float(count)


def _score_scale(card: Scorecard, name: str, scale: Scale, channel: Channel) -> None:
    note = f"{scale.what}: {scale.each:.9g} per count, {scale.zero + 0.0:.9g} at zero"
    note += "" if scale.known else ", assumed: the values are not the counts that were sent"
    for quantity, off in (("scale", scale.gain_ppm), ("offset", scale.zero_counts)):
        card.add(quantity, name, _exact(off) if scale.known else None, of=channel, note=note)


def _score_rows(
    card: Scorecard, names: Sequence[str], wires: Mapping[str, Wire], recorded: Mapping[str, Recorded],
    matches: Mapping[str, SignalRows], session: Session, arrivals: Arrivals | None,
) -> None:  # fmt: skip
    """Compare the rows of signals of equal length, and add their events and stamps to a scorecard."""
    groups = list(dict.fromkeys(session.channels[wires[name].channel].group for name in names))
    table = "all groups" if len(groups) == len(session.groups) > 1 else ", ".join(groups)
    by_name, one = {name: matches[name].scale for name in names}, matches[names[0]]
    sound = sum(scale.known for scale in by_name.values())
    if not sound:
        for name in names:
            card.add("altered values", name, None, note="no other signal identifies the rows")
        return
    sent = Sent(session, groups, one.step, one.phase)
    columns = [sent.names.index(wires[name].channel) for name in names]

    tables: dict[RecordedTable, list[str]] = {}
    for name in names:
        tables.setdefault(recorded[name].table, []).append(name)
    beside = recorded[names[0]].table
    stamps, delays, longest_s = Stamps(beside), Stamps(beside, shown=True), -math.inf

    def counts(skip: int) -> Iterator[np.ndarray]:
        all_parts = (each.parts([recorded[name].column for name in inside]) for each, inside in tables.items())
        for parts in zip(*all_parts, strict=True):
            parts, skip = [part[skip:] for part in parts], max(0, skip - len(parts[0]))
            stamps.times_s = parts[0][:, 0]
            columns = zip(chain(*tables.values()), chain(*(part.T[1:] for part in parts)), strict=True)
            counted = {name: by_name[name].counts(values) for name, values in columns}
            yield np.column_stack([counted[name] for name in names])

    def convert(sent: Sent) -> Iterator[np.ndarray]:
        """Yield the counts that a DAQ with these converters records of those sent."""
        for chunk in sent:
            cut = chunk[:, columns] >> bits << bits
            if not repeats:
                repeats.append(repeated_part(cut))
            yield np.column_stack([by_name[name].sent(cut[:, n]) for n, name in enumerate(names)]) if coarse else cut

    bits = np.array([recorded[name].lost_bits for name in names])
    coarse = any(scale.rounding for scale in by_name.values())
    state, trigger, at, repeats = Followed(), None, one.early, list[float]()
    for places, state in follow(convert(sent), counts(one.early), sound, one.start):  # noqa: B007
        placed = np.flatnonzero(places >= 0)
        since_s = sent.since_s(places[placed]) if len(placed) else np.empty(0)
        stamps.add_rows(sent.first_s, since_s, placed, len(places))
        if arrivals is not None and len(placed):
            came_s = arrivals.since_s(at + placed)
            settled = came_s > _BACKLOG_S
            sent_s = session.arrived_s(groups, sent.first_s + since_s[settled]) - arrivals.unix_s[0]
            delays.times_s = came_s[settled]
            delays.add_rows(0.0, sent_s, np.arange(len(sent_s)), len(sent_s))
            longest_s = max(longest_s, float(np.max(delays.times_s - sent_s, initial=-math.inf)))
        if trigger is None and session.trigger_s is not None and len(placed):
            after = np.flatnonzero(sent.first_s + since_s >= session.trigger_s)
            # At row 0 the command may precede the recording: no row is named.
            trigger = at + int(placed[after[0]]) if len(after) and at + placed[after[0]] else None
        at += len(places)

    def add(quantity: str, channel: str, runs: np.ndarray, rows: float | None = None, *, numbered: bool = True) -> None:
        note = ""
        if len(runs):
            ranges = [(a, b) for a, b in (sent.numbers(runs) if numbered else runs).tolist()]
            card.runs[f"{quantity} {channel}"] = ranges
            note = "rows " + ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in ranges[:_MAX_RANGES])
            note += f" and {len(ranges) - _MAX_RANGES} more stretches" if len(ranges) > _MAX_RANGES else ""
        card.add(quantity, channel, _exact(np.sum(runs[:, 1] - runs[:, 0] + 1) if rows is None else rows), note=note)

    if repeats and repeats[0] > _REPEATING_PART:
        card.evidence_gaps.append(f"{table}: the sent rows repeat, so that a loss of whole periods is not visible")
    add("missing rows", table, state.lost)
    for quantity, pairs in (("doubled rows", state.doubled), ("swapped rows", state.swapped)):
        add(quantity, table, stretches(np.unique(pairs[:, 0])), len(pairs))

    def hashes() -> Iterator[np.ndarray]:
        return (
            row_hashes(each[:, :sound]).view(np.int64) for each in convert(Sent(session, groups, one.step, one.phase))
        )

    foreign, early = state.foreign, one.early
    early += int(np.sum(foreign == np.arange(len(foreign)))) if early else 0  # inexact by some rows if rows are lost
    after = foreign[(foreign + state.last - state.last_row >= state.sent) & (foreign > state.last_row)]
    foreign = foreign[early - one.early : len(foreign) - len(after)]
    # Unjudged rows may equal judged ones, for example if the DAQ had recorded the same signal earlier.
    ends = ((early, early, "first", "before"), (len(after), at - len(after), "last", "after"))
    for rows, edge, which, side in (each for each in ends if each[0]):
        card.remarks.append(f"{table}: the {which} {rows} rows are not judged: they are {side} the session's {which}")
        first, judged = max(0, edge - _EDGE_ROWS), range(state.first, state.last + 1) if which == "first" else range(0)
        near = row_hashes(take_rows(counts(first), 0, 2 * _EDGE_ROWS, len(names))[:, :sound]).view(np.int64)
        outside = (np.arange(len(near)) < edge - first) == (which == "first")
        if holds_session_rows(near, outside, judged, hashes):
            card.evidence_gaps.append(f"{table}: unjudged rows {side} the session equal a run of rows in it")
    add("foreign rows", table, stretches(foreign + one.early), numbered=False)
    for name, altered in zip(names, state.altered, strict=True):
        add("altered values", name, altered.pairs(), altered.rows)
    estimates = {
        "row step": _exact(one.step),
        "rows before the first": _exact(max(0, state.first)),
        "rows after the last": _exact(state.sent - 1 - state.last), **stamps.estimate_all(session.wall_s),
        "trigger row": None if trigger is None else _exact(trigger),
    }  # fmt: skip
    notes = {}
    if arrivals is not None:
        estimates["latency"] = delays.estimate_all(0.0, apart_s=math.inf)["latency"]
        notes["latency"] = (
            f"arrival here less that of the rig's block, after {_BACKLOG_S:g} s; at most {longest_s:.2g} s; "
            f"a line through a pipe takes {arrivals.floor_s:.2g} s"
        )
        if (late := estimates["latency"]) is not None:  # as a remark, because a row without a limit is listed late
            card.remarks.append(f"{table}: latency {1e3 * late[0]:.3g} ms, at most {1e3 * longest_s:.2g} ms")
    for quantity, estimate in estimates.items():
        card.add(quantity, table, estimate, note=notes.get(quantity, ""))
    card.pictures[f"stamps {table}"] = stamps.batch_means()
