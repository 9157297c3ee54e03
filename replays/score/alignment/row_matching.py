"""Place of each signal's rows in the session, and the scale from the rig's counts to its values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from replays.score.alignment.overlap import find_starts
from replays.score.records.recorded import Recorded
from replays.score.records.scale import Scale, find_scale, scales
from replays.score.records.sent import Sent, Session
from replays.score.records.wiring import Wire
from rig.channels.table import Channel

_MAX_SCALE_ROWS = 1 << 16
"""Rows of a recording by which its scale is found."""
_MIN_EQUAL_PART = 0.5
"""Part of the first rows that must be equal for a start found by stamps or correlation."""
_DECIMATION = 64
"""Decimation of the values in which a DAQ's unused bits are searched."""
_MAX_SEARCHES = 3
"""Signals of a table whose place in the session is searched over the whole of both."""
_MIN_MOVING = 64
"""Equal rows that change, from which a start is certain: fewer are equal by chance at an end of the session."""
_MAX_UNEQUAL = 16
"""Unequal values of nearly repeating signals that may be consecutive by chance."""


@dataclass(frozen=True)
class SignalRows:
    """Rows of its channel that a signal has, and their scale.

    Attributes:
        scale: Scale of its counts.
        step, phase: The signal has the rows whose number modulo the step is the phase.
        early: Number of its first rows that precede the session.
        start: Place of the next row, among such rows of the session.
        offset: Place of the very first row, among all available rows of the session; negative before these.
    """

    scale: Scale
    step: int = 1
    phase: int = 0
    early: int = 0
    start: int = 0
    offset: int = 0


class _Search:
    """Search for the rows and the scale of signals.

    Attributes:
        held: Index and counts of the first rows of each group of the session.
        offsets: Place of the first row of each table, if known, by the table's identity.
    """

    def __init__(self, recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], session: Session) -> None:
        self._recorded, self._wires, self._session = recorded, wires, session
        self.held = {group: session.early(group) for group in session.groups}
        self.offsets: dict[int, int] = {}
        self._searched: dict[int, set[str]] = {}

    def select_rows_from(self, name: str, of: str, offset: int) -> tuple[np.ndarray, str, np.ndarray, Channel]:
        """Return values, unit, counts and channel of the same rows: row j of the file is row offset + j step there."""
        channel, signal, step = self._session.channels[of], self._recorded[name], self.find_step(name, of)
        skipped = max(0, -(offset // step))
        place, few = offset + skipped * step, _MAX_SCALE_ROWS
        values, there = signal.early[skipped:], self.held[channel.group][1][place:]
        if skipped and len(values) < min(_MAX_SCALE_ROWS, signal.rows - skipped):
            values = signal.table.stretch(skipped, _MAX_SCALE_ROWS)[:, 1 + signal.column]
        if place and len(there) < _MAX_SCALE_ROWS * step:
            there = self._session.stretch(channel.group, place, _MAX_SCALE_ROWS * step)
        counts = there[::step, self._session.place(of)]
        few = min(len(values), len(counts), _MAX_SCALE_ROWS)
        return values[:few], signal.unit, counts[:few] >> signal.lost_bits << signal.lost_bits, channel

    def find_step(self, name: str, of: str) -> int:
        """Return the rows of the session per row of a signal, by its rate."""
        sent_hz = self._session.rate_hz(self._session.channels[of].group)
        return max(1, round(sent_hz / (self._recorded[name].rate_hz or sent_hz)))

    def make_rows(self, scale: Scale, step: int, offset: int, group: str) -> SignalRows:
        """Return the rows of a signal whose first row is at a place in the session."""
        index, _ = self.held[group]
        phase = (index + offset) % step
        start = max(0, offset - (phase - index) % step) // step
        return SignalRows(scale, step, phase, max(0, -(offset // step)), start, offset)

    def is_better(self, offset: int, other: int, signals: Iterable[tuple[str, str, Scale]], *, shared: bool) -> bool:
        """Return whether all rows in the session are equal from a start, but not from another one.

        For a nearly repeating signal, other starts have more rows in the session, nearly all of which are equal. The
        unequal ones are then distributed; if they are consecutive, these rows are stale instead.

        Args:
            offset: Place of the first row in the session, or negative.
            other: Another such place.
            signals: Signals of one table: name, channel and scale.
            shared: Whether another table of the file has this start. If so, any unequal row from the other one counts;
                if not, only those that are in the session from both.
        """
        moving, unequal, expected = 0, 0, 0.0
        for name, of, scale in signals:
            longest, part, same = self.compare(name, of, offset, scale)
            if part < 1.0:
                return False
            wrong, step = ~self.compare(name, of, other, scale)[2], self.find_step(name, of)
            first = max(0, -(offset // step)) - max(0, -(other // step))
            both = wrong if shared else wrong[max(0, first) : max(0, first + len(same))]
            moving, unequal = moving + longest, unequal + int(both.sum())
            expected += len(both) * float(wrong.mean()) if len(wrong) else 0.0
        return moving >= _MIN_MOVING and 0 < unequal <= _MAX_UNEQUAL + 1.5 * expected

    def compare(self, name: str, of: str, offset: int, scale: Scale) -> tuple[int, float, np.ndarray]:
        """Return the agreement of the counts of the first rows in the session.

        Returns:
            Length of the longest run of equal rows, not counting constant ones; part of the rows that are equal;
            whether each row is equal, shape (n,).
        """
        values, _, there, _ = self.select_rows_from(name, of, offset)
        same = scale.counts(values) == scale.sent(there)
        moving = np.concatenate([[0], np.cumsum(np.append(True, np.diff(there) != 0)[: len(there)])])
        ends = np.concatenate([[-1], np.flatnonzero(~same), [len(same)]])
        longest = int((moving[ends[1:]] - moving[ends[:-1] + 1]).max())
        return longest, float(same.mean()) if len(same) else 0.0, same

    def find_rows(self, name: str, of: str) -> SignalRows | None:
        """Return the rows of a signal, by the start of its table if known, otherwise by its counts; or None."""
        signal, channel, step = self._recorded[name], self._session.channels[of], self.find_step(name, of)
        table = id(signal.table)
        _, counts = self.held[channel.group]
        offsets_s = self._wires[name].offset_s, self._wires[name].own_s
        late = [round(each * self._session.rate_hz(channel.group)) for each in offsets_s]
        candidates, most = list[tuple[bool, int, int, Scale]](), list[bool]()

        def try_offset(offset: int) -> bool:
            values, unit, there, _ = self.select_rows_from(name, of, offset)
            if len(values) > 1 and (scale := find_scale(values, unit, there, channel)) is not None:
                longest, part, _ = self.compare(name, of, offset, scale)
                candidates.append((scale.clean, longest, offset, scale))
                most.append(scale.clean and part > _MIN_EQUAL_PART)
                return scale.clean and part == 1.0
            return False

        likely = dict.fromkeys([self.offsets.get(table, late[0]), *late, *self.offsets.values()])
        if not any(map(try_offset, likely)):
            early, bits = signal.early[:_MAX_SCALE_ROWS], signal.lost_bits
            there = counts[:, self._session.place(of)] >> bits << bits
            likely = self._find_overlaps(name, of, step) if not any(most) else []
            fewest, options = min(len(early), len(there) // step), scales(signal.unit, channel, signal.early, there)
            matches = (find_starts([each.counts(early)], [each.sent(there)], step, fewest) for each in options)
            any(map(try_offset, likely or next((places for places in matches if places), [])))
        if not candidates:
            return None
        *_, offset, scale = max(candidates, key=lambda each: each[:2])
        for _, _, other, its in candidates:
            if its.clean and self.is_better(other, offset, [(name, of, its)], shared=False):
                offset, scale = other, its
        self.offsets.setdefault(table, offset)
        return self.make_rows(scale, step, offset, channel.group)

    def _find_overlaps(self, name: str, of: str, step: int) -> list[int]:
        """Return candidate starts of the table by all rows of both, for a few signals, as each reads both files."""
        signal, channel = self._recorded[name], self._session.channels[of]
        sent, searched = Sent(self._session, [channel.group]), self._searched.setdefault(id(signal.table), set())
        rows = self._session.rows(channel.group)
        beyond = signal.rows > _MAX_SCALE_ROWS or rows > len(self.held[channel.group][1])
        if not beyond or name in searched or len(searched) >= _MAX_SEARCHES:
            return []
        searched.add(name)
        column, fewest = sent.names.index(of), min(signal.rows, rows // step)
        some = [_decimate(part[:, 1]) for part in signal.table.parts([signal.column])]
        bits = signal.lost_bits
        for scale in scales(signal.unit, channel, np.concatenate(some), self.held[channel.group][1][:, column]):
            here = (scale.counts(part[:, 1]) for part in signal.table.parts([signal.column]))
            there = (scale.sent(part[:, column] >> bits << bits) for part in Sent(self._session, [channel.group]))
            if places := find_starts(here, there, step, fewest):
                return places
        return []


def identify_signals(
    recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], session: Session
) -> tuple[dict[str, Wire], dict[str, SignalRows]]:
    """Identify the channel, the scale and the rows of each signal by its counts.

    If most signals show counts, or one has most rows as sent, a signal without a match is searched in all channels. If
    none matches, it is assigned to the channel with its name, or to the only similar one, with the scale of its unit.

    Returns:
        Wires and rows, by the signals' names in the file.
    """
    search, rows, wired = _Search(recorded, wires, session), dict[str, SignalRows](), dict(wires)
    searched = list[str]()

    def identify(name: str, likely: Iterable[str]) -> None:
        # Counts are certain where stamps, by which signals are correlated, are not: those of a rig in lockstep.
        best, wire = -1, wires[name]
        for of in dict.fromkeys(each for each in likely if each in session.channels):
            if (one := search.find_rows(name, of)) is None:
                continue
            longest, part, _ = search.compare(name, of, one.offset, one.scale)
            if longest > best or part == 1.0:
                best, rows[name] = longest, one
                wired[name] = wire if of == wire.channel else replace(wire, channel=of, rivals=())
            if part == 1.0:
                break

    for name, wire in wires.items():
        identify(name, (wire.channel, name, *wire.rivals))
    # In a whirl, a signal correlates equally well with channels that lag its own by a quarter of a turn.
    for name in () if rows else list(wires):
        if rows or len(searched) < _MAX_SEARCHES:
            searched.append(name)
            identify(name, session.channels)
    # Rows of a table start together: where one signal matches from several starts, another one decides.
    for table in {id(recorded[name].table) for name in rows}:
        names = [name for name in rows if id(recorded[name].table) == table]
        choices = list(dict.fromkeys(rows[name].offset for name in names))

        def agreed(offset: int) -> int:
            signals = [(each, wired[each].channel, offset, rows[each].scale) for each in names]  # noqa: B023
            return sum(search.compare(*signal)[0] for signal in signals)

        best = max(choices, key=agreed) if choices[1:] else choices[0]
        signals = [(each, wired[each].channel, rows[each].scale) for each in names]
        for other in dict.fromkeys([*choices, *search.offsets.values()]):
            best = other if search.is_better(other, best, signals, shared=other not in choices) else best
        search.offsets[table] = best
        for name in names:
            one, group = rows[name], session.channels[wired[name].channel].group
            rows[name] = search.make_rows(one.scale, one.step, search.offsets[table], group)

    def is_shown(name: str) -> bool:
        one = rows[name]
        return one.scale.clean and search.compare(name, wired[name].channel, one.offset, one.scale)[1] > _MIN_EQUAL_PART

    # Channels of noise alone correlate with none: their counts are found from the start of another signal.
    if 2 * len(rows) <= len(wires) and not any(map(is_shown, rows)):
        return wired, rows
    for name, wire in wires.items():
        used = {wired[each].channel for each in rows}
        for other in () if name in rows else sorted(session.channels, key=lambda each: (each != name, each in used)):
            if (one := search.find_rows(name, other)) is not None:
                wired[name], rows[name] = replace(wire, channel=other, rivals=()), one
                break
        named = name if name in session.channels else "" if wire.rivals else wire.channel
        if name not in rows and named:
            step = search.find_step(name, named)
            offset = search.offsets.get(id(recorded[name].table), 0)
            values, unit, counts, channel = search.select_rows_from(name, named, offset)

            def deviation(scale: Scale) -> float:
                return float(np.nanmedian(np.abs(scale.each * counts + scale.zero - values)) / scale.each)  # noqa: B023

            wired[name] = replace(wire, channel=named)
            scale = replace(min(scales(unit, channel, values[:0], counts), key=deviation), known=False)
            rows[name] = search.make_rows(scale, step, offset, channel.group)
    exact = {name: each for name, each in rows.items() if each.scale.known}
    # A DAQ's converter leaves out bits of all signals equally; if one signal has fewer bits, they are lost later.
    adc_bits = {name: session.channels[wired[name].channel].adc_bits for name in exact}
    bits = {name: adc_bits[name] - each.scale.lost_bits for name, each in exact.items()}
    for name, each in exact.items():
        if each.scale.lost_bits and bits[name] < max(bits.values()):
            size = 2.0**-each.scale.lost_bits
            scale = Scale(size * each.scale.each, each.scale.zero, each.scale.what, known=False)
            rows[name] = replace(each, scale=scale)
    return wired, rows


def _decimate(values: np.ndarray) -> np.ndarray:
    """Return a sample of the values, with the smallest and the largest, for the search for unused bits."""
    good = values[np.isfinite(values)]
    return np.append(good[::_DECIMATION], [good.min(), good.max()] if len(good) else [])
