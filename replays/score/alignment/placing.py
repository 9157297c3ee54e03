"""Where each signal's rows stand in the session, and how its values come from the rig's counts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from replays.score.alignment.overlap import find_begins
from replays.score.records.recorded import Recorded
from replays.score.records.scale import Scale, find_scale, scales
from replays.score.records.sent import Sent, Session
from replays.score.records.wiring import Wire
from rig.channels.table import Channel

_LOOKED = 1 << 16
"""Rows of a recording by which its scale is found."""
_MOST_ROWS = 0.5
"""Part of the first rows that must be equal for a begin that stamps or correlation tell."""
_SAMPLED = 64
"""Of so many values one is looked at for the bits that a DAQ leaves out."""
_SEARCHED = 3
"""Signals of a table by which its place in the session is searched over the whole of both."""
_MIN_MOVING = 64
"""Equal rows that move, from which a begin is shown: fewer are equal by chance at an end of the session."""
_MAX_UNEQUAL = 16
"""Unequal values of nearly repeating signals that may stand together by chance."""


@dataclass(frozen=True)
class Taken:
    """What a signal has taken of its channel.

    Attributes:
        scale: Of its counts.
        step, phase: Those rows whose number is the phase, modulo the step.
        early: Number of its first rows that stand before the session.
        start: Place among those rows of the session at which the first of the others is due.
        begin: Place of the first row of all, among all rows of the session that are held; below 0 before these.
    """

    scale: Scale
    step: int = 1
    phase: int = 0
    early: int = 0
    start: int = 0
    begin: int = 0


class _Search:
    """The search for the rows and the scale of signals.

    Attributes:
        held: Index and counts of the first rows of each group of the session.
        begins: Place of the first row of each table that is known, by its identity.
    """

    def __init__(self, recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], session: Session) -> None:
        self._recorded, self._wires, self._session = recorded, wires, session
        self.held = {group: session.early(group) for group in session.groups}
        self.begins: dict[int, int] = {}
        self._searched: dict[int, set[str]] = {}

    def tried(self, name: str, of: str, begin: int) -> tuple[np.ndarray, str, np.ndarray, Channel]:
        """Values and counts of the same rows: row j of the file was sent `begin` and j steps behind the first one."""
        channel, signal, step = self._session.channels[of], self._recorded[name], self.step_of(name, of)
        skipped = max(0, -(begin // step))
        place, few = begin + skipped * step, _LOOKED
        values, there = signal.early[skipped:], self.held[channel.group][1][place:]
        if skipped and len(values) < min(_LOOKED, signal.rows - skipped):
            values = signal.table.stretch(skipped, _LOOKED)[:, 1 + signal.column]
        if place and len(there) < _LOOKED * step:
            there = self._session.stretch(channel.group, place, _LOOKED * step)
        counts = there[::step, self._session.place(of)]
        few = min(len(values), len(counts), _LOOKED)
        return values[:few], signal.unit, counts[:few] >> signal.lost_bits << signal.lost_bits, channel

    def step_of(self, name: str, of: str) -> int:
        """Rows of the session from one row of a signal to the next, by its rate."""
        sent_hz = self._session.rate_hz(self._session.channels[of].group)
        return max(1, round(sent_hz / (self._recorded[name].rate_hz or sent_hz)))

    def taken(self, scale: Scale, step: int, begin: int, group: str) -> Taken:
        """What a signal has taken whose first row stands at a place of the session."""
        index, _ = self.held[group]
        phase = (index + begin) % step
        start = max(0, begin - (phase - index) % step) // step
        return Taken(scale, step, phase, max(0, -(begin // step)), start, begin)

    def is_better(self, begin: int, other: int, signals: Iterable[tuple[str, str, Scale]], *, known: bool) -> bool:
        """Return whether all rows in the session are equal from a begin, and some of these are not from another one.

        Where a signal nearly repeats, other begins have more rows in the session, of which nearly all are equal. Those
        that are not stand everywhere; where they stand together, these rows are stale ones.

        Args:
            begin: Place of the first row in the session, or below 0.
            other: Another such place.
            signals: Signals of one table: name, channel and scale.
            known: Whether another table of the file has this begin. Any unequal row from the other one counts then;
                otherwise only those that stand in the session from both.
        """
        moving, unequal, expected = 0, 0, 0.0
        for name, of, scale in signals:
            longest, part, same = self.agreement(name, of, begin, scale)
            if part < 1.0:
                return False
            wrong, step = ~self.agreement(name, of, other, scale)[2], self.step_of(name, of)
            first = max(0, -(begin // step)) - max(0, -(other // step))
            both = wrong if known else wrong[max(0, first) : max(0, first + len(same))]
            moving, unequal = moving + longest, unequal + int(both.sum())
            expected += len(both) * float(wrong.mean()) if len(wrong) else 0.0
        return moving >= _MIN_MOVING and 0 < unequal <= _MAX_UNEQUAL + 1.5 * expected

    def agreement(self, name: str, of: str, begin: int, scale: Scale) -> tuple[int, float, np.ndarray]:
        """Return how the counts of the first rows in the session agree.

        Returns:
            Length of the longest run of equal rows, without those that stand still; part of the rows that are equal;
            whether each is, shape (n,).
        """
        values, _, there, _ = self.tried(name, of, begin)
        same = scale.counts(values) == scale.sent(there)
        moving = np.concatenate([[0], np.cumsum(np.append(True, np.diff(there) != 0)[: len(there)])])
        ends = np.concatenate([[-1], np.flatnonzero(~same), [len(same)]])
        longest = int((moving[ends[1:]] - moving[ends[:-1] + 1]).max())
        return longest, float(same.mean()) if len(same) else 0.0, same

    def taken_of(self, name: str, of: str) -> Taken | None:
        """By where its table begins, as far as that is known; else by where its counts are."""
        signal, channel, step = self._recorded[name], self._session.channels[of], self.step_of(name, of)
        table = id(signal.table)
        _, counts = self.held[channel.group]
        late_s = self._wires[name].late_s, self._wires[name].own_s
        late = [round(each * self._session.rate_hz(channel.group)) for each in late_s]
        placed, most = list[tuple[bool, int, int, Scale]](), list[bool]()

        def try_begin(begin: int) -> bool:
            values, unit, there, _ = self.tried(name, of, begin)
            if len(values) > 1 and (scale := find_scale(values, unit, there, channel)) is not None:
                longest, part, _ = self.agreement(name, of, begin, scale)
                placed.append((scale.clean, longest, begin, scale))
                most.append(scale.clean and part > _MOST_ROWS)
                return scale.clean and part == 1.0
            return False

        likely = dict.fromkeys([self.begins.get(table, late[0]), *late, *self.begins.values()])
        if not any(map(try_begin, likely)):
            early, bits = signal.early[:_LOOKED], signal.lost_bits
            there = counts[:, self._session.place(of)] >> bits << bits
            likely = self._overlapping(name, of, step) if not any(most) else []
            fewest, known = min(len(early), len(there) // step), scales(signal.unit, channel, signal.early, there)
            found = (find_begins([each.counts(early)], [each.sent(there)], step, fewest) for each in known)
            any(map(try_begin, likely or next((places for places in found if places), [])))
        if not placed:
            return None
        *_, begin, scale = max(placed, key=lambda each: each[:2])
        for _, _, other, its in placed:
            if its.clean and self.is_better(other, begin, [(name, of, its)], known=False):
                begin, scale = other, its
        self.begins.setdefault(table, begin)
        return self.taken(scale, step, begin, channel.group)

    def _overlapping(self, name: str, of: str, step: int) -> list[int]:
        """Where the table may begin, by all rows of both; a few of its signals are asked, as each reads both sides."""
        signal, channel = self._recorded[name], self._session.channels[of]
        sent, asked = Sent(self._session, [channel.group]), self._searched.setdefault(id(signal.table), set())
        rows = self._session.rows(channel.group)
        beyond = signal.rows > _LOOKED or rows > len(self.held[channel.group][1])
        if not beyond or name in asked or len(asked) >= _SEARCHED:
            return []
        asked.add(name)
        column, fewest = sent.names.index(of), min(signal.rows, rows // step)
        some = [_sample(part[:, 1]) for part in signal.table.parts([signal.column])]
        bits = signal.lost_bits
        for scale in scales(signal.unit, channel, np.concatenate(some), self.held[channel.group][1][:, column]):
            here = (scale.counts(part[:, 1]) for part in signal.table.parts([signal.column]))
            there = (scale.sent(part[:, column] >> bits << bits) for part in Sent(self._session, [channel.group]))
            if places := find_begins(here, there, step, fewest):
                return places
        return []


def settle(
    recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], session: Session
) -> tuple[dict[str, Wire], dict[str, Taken]]:
    """Which channel each signal has the counts of, how scaled and of which rows, by its name in the file.

    Where most signals show counts, or one has most rows as they were sent, a signal that shows none is looked for in
    all channels; if it is in none, it is the channel that it is named by, or alone is like, with what its unit says of
    its scale.
    """
    search, settled, found = _Search(recorded, wires, session), dict[str, Taken](), dict(wires)
    asked = list[str]()

    def look(name: str, likely: Iterable[str]) -> None:
        # Counts are sure where stamps, by which signals are likened, are not: those of a rig that waits for steps.
        best, wire = -1, wires[name]
        for of in dict.fromkeys(each for each in likely if each in session.channels):
            if (one := search.taken_of(name, of)) is None:
                continue
            longest, part, _ = search.agreement(name, of, one.begin, one.scale)
            if longest > best or part == 1.0:
                best, settled[name] = longest, one
                found[name] = wire if of == wire.channel else replace(wire, channel=of, rivals=())
            if part == 1.0:
                break

    for name, wire in wires.items():
        look(name, (wire.channel, name, *wire.rivals))
    # In a whirl, signals correlate as well with the channels that are a quarter of a turn behind their own.
    for name in () if settled else list(wires):
        if settled or len(asked) < _SEARCHED:
            asked.append(name)
            look(name, session.channels)
    # Rows of a table begin together: where one signal is alike from several begins, another one decides.
    for table in {id(recorded[name].table) for name in settled}:
        names = [name for name in settled if id(recorded[name].table) == table]
        choices = list(dict.fromkeys(settled[name].begin for name in names))

        def agreed(begin: int) -> int:
            signals = [(each, found[each].channel, begin, settled[each].scale) for each in names]  # noqa: B023
            return sum(search.agreement(*signal)[0] for signal in signals)

        best = max(choices, key=agreed) if choices[1:] else choices[0]
        signals = [(each, found[each].channel, settled[each].scale) for each in names]
        for other in dict.fromkeys([*choices, *search.begins.values()]):
            best = other if search.is_better(other, best, signals, known=other not in choices) else best
        search.begins[table] = best
        for name in names:
            one, group = settled[name], session.channels[found[name].channel].group
            settled[name] = search.taken(one.scale, one.step, search.begins[table], group)

    def is_shown(name: str) -> bool:
        one = settled[name]
        return one.scale.clean and search.agreement(name, found[name].channel, one.begin, one.scale)[1] > _MOST_ROWS

    # Channels of noise alone correlate with none: their counts are found from the begin that another signal shows.
    if 2 * len(settled) <= len(wires) and not any(map(is_shown, settled)):
        return found, settled
    for name, wire in wires.items():
        used = {found[each].channel for each in settled}
        for other in () if name in settled else sorted(session.channels, key=lambda each: (each != name, each in used)):
            if (one := search.taken_of(name, other)) is not None:
                found[name], settled[name] = replace(wire, channel=other, rivals=()), one
                break
        named = name if name in session.channels else "" if wire.rivals else wire.channel
        if name not in settled and named:
            step = search.step_of(name, named)
            begin = search.begins.get(id(recorded[name].table), 0)
            values, unit, counts, channel = search.tried(name, named, begin)

            def apart(scale: Scale) -> float:
                return float(np.nanmedian(np.abs(scale.each * counts + scale.zero - values)) / scale.each)  # noqa: B023

            found[name] = replace(wire, channel=named)
            scale = replace(min(scales(unit, channel, values[:0], counts), key=apart), known=False)
            settled[name] = search.taken(scale, step, begin, channel.group)
    known = {name: each for name, each in settled.items() if each.scale.known}
    # Bits are left out by the DAQ's converter, so that no signal has more of them; else they are lost on the way.
    adc_bits = {name: session.channels[found[name].channel].adc_bits for name in known}
    bits = {name: adc_bits[name] - each.scale.lost_bits for name, each in known.items()}
    for name, each in known.items():
        if each.scale.lost_bits and bits[name] < max(bits.values()):
            size = 2.0**-each.scale.lost_bits
            scale = Scale(size * each.scale.each, each.scale.zero, each.scale.what, known=False)
            settled[name] = replace(each, scale=scale)
    return found, settled


def _sample(values: np.ndarray) -> np.ndarray:
    """Return some values, and the least and the largest, of which the bits of a DAQ are found."""
    good = values[np.isfinite(values)]
    return np.append(good[::_SAMPLED], [good.min(), good.max()] if len(good) else [])
