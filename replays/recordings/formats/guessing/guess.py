"""Which signal of a log is which channel of the rig: by name, unit, level and how signals go together.

A guess says why, and how sure it is: `sure` where name and unit agree, `likely` where one thing speaks for it, `ask`
where something of it cannot be known from the log. What is none of the rig's stays a channel of its own.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import median

from replays.recordings.formats.guessing.features import Look, look, relation
from replays.recordings.formats.guessing.naming import Named, read_name, words_of
from replays.recordings.formats.source import Entry, Source
from rig.base import units
from rig.channels.table import default_table

SURE, LIKELY, ASK = "sure", "likely", "ask"
_KIND_OF_UNIT = {
    "length": "length", "force": "force", "acceleration": "acceleration", "speed of rotation": "speed",
}  # fmt: skip
_PROBE_V = (-20.0, -1.0)
"""Mean voltages of eddy-current probes: they are fed with -24 V, and half way is about -10 V."""
_PAIRS = {"length": ("disk", "ring"), "acceleration": ("inner", "outer")}
_RATIO = 1.15
"""By so much the disk moves more than the shaft in the ring, at least: it is farther from the lower bearing."""
_OPPOSED = -0.5
"""Correlation of two transducers of which one is relieved as the other is loaded."""
_SENSITIVITY = re.compile(r"(\d+(?:[.,]\d+)?)\s*(m?V)\s*(?:/|per|pro)\s*(mm|mil|um|µm|μm|N|lbf|g|m/s\^?2|m/s²)(?!\w)")
_BIAS = re.compile(r"(?:bias|offset|ruhespannung)\w*\s*[:=]?\s*(-?\d+(?:[.,]\d+)?)\s*(m?V)", re.IGNORECASE)
_TURN_UNITS = (("Hz", 1.0), ("rpm", 60.0), ("rad/s", 6.283185307179586))
_NAME = "name: "
_WHOLE = 0.02
"""So near a whole number pulses a turn must be."""


@dataclass
class Guess:
    """What one signal is taken for.

    Attributes:
        source: Its file.
        entry: The signal.
        look: Its numbers.
        named: What its name says.
        kind: What it measures, as in `Named`; empty if nobody knows.
        channel: Channel of the rig; empty: none.
        sure: `sure`, `likely` or `ask`; empty without a channel.
        reasons: Why.
        unit: Unit that the file does not tell, or tells otherwise; None: as the file has it.
        sensitivity: Volts per unit, as a mapping has it; None: there are none.
        bias: Source value at zero, or "mean"; None: zero.
        sign: -1 where it falls as what it measures rises.
        asks: What cannot be known, by field of the mapping.
        pulses_per_turn: Of a keyphasor.
    """

    source: Source
    entry: Entry
    look: Look
    named: Named
    kind: str = ""
    channel: str = ""
    sure: str = ""
    reasons: list[str] = field(default_factory=list)
    unit: str | None = None
    sensitivity: str | None = None
    bias: float | str | None = None
    sign: int = 1
    asks: dict[str, str] = field(default_factory=dict)
    pulses_per_turn: int = 1

    @property
    def volts(self) -> bool:
        """Whether it stands in the file as a voltage."""
        return units.kind(self.entry.unit) == "voltage"

    @property
    def zero(self) -> float:
        """Source value at zero."""
        return self.look.mean if self.bias == "mean" else float(self.bias or 0.0)

    @property
    def gain(self) -> float:
        """Channel unit per unit of the file, as far as it is guessed; 0 where it is not."""
        if not self.channel:
            return 0.0
        unit = default_table().channels[self.channel].unit
        if self.sensitivity is not None:
            return (
                self.sign
                * units.size_si(self.entry.unit)
                / units.sensitivity_v(self.sensitivity, unit, field="sensitivity")
            )
        told = self.unit or self.entry.unit
        return self.sign * units.size_si(told) / units.size_si(unit) if units.kind(told) == units.kind(unit) else 0.0

    def take(self, channel: str, sure: str, *reasons: str, ask: str = "") -> None:
        """Take it for a channel, at most as surely as was said before; `ask` is what cannot be known of its name."""
        order = ("", SURE, LIKELY, ASK)
        self.channel, self.sure = channel, max(self.sure, sure, key=order.index)
        self.reasons += reasons
        if ask:
            self.asks["name"] = ask

    @property
    def why(self) -> str:
        """The reasons in a line, what the name says together."""
        names = [reason.removeprefix(_NAME) for reason in self.reasons if reason.startswith(_NAME)]
        others = [reason for reason in self.reasons if reason and not reason.startswith(_NAME)]
        return "; ".join([*([f"name: {', '.join(names)}"] if names else []), *others])


def guess(
    sources: Sequence[Source], *, told: Callable[[Source, Entry], bool] = lambda source, entry: False
) -> list[Guess]:
    """Guess what the signals of files are.

    Args:
        sources: The files.
        told: Of which signals the rig's own documents tell: their names are right.

    Raises:
        InputError: A signal cannot be read.
    """
    guesses = [
        Guess(source, entry, look(source.read(entry)), read_name(entry.name))
        for source in sources
        for entry in source.entries
    ]
    rig, seen = default_table().channels, set[str]()
    for each in guesses:
        name = each.entry.name
        if name in rig and name not in seen and (told(each.source, each.entry) or _fits(each, rig[name].unit)):
            each.kind = _of_channel(name)
            each.take(name, SURE, "the rig's own name")
            seen.add(name)
        else:
            each.kind = _kind(each)
    free = [each for each in guesses if not each.channel]
    for kind in _PAIRS:
        _place_pairs(kind, [each for each in free if each.kind == kind], seen)
    _place_forces([each for each in free if each.kind == "force"], guesses, seen)
    for kind, channel in (("hammer", "hammer"), ("keyphasor", "keyphasor"), ("speed", "speed")):
        _place_only(channel, [each for each in free if each.kind == kind], seen)
    _turns(guesses)
    for each in guesses:
        if each.channel:
            _scale(each, rig[each.channel].unit, rig[each.channel].sensitivity_v)
    return guesses


def _fits(each: Guess, unit: str) -> bool:
    kind = units.kind(each.entry.unit)
    return kind in ("", "voltage", "number") or kind == units.kind(unit)


def _of_channel(name: str) -> str:
    if name in ("speed", "keyphasor", "hammer"):
        return name
    return units.kind(default_table().channels[name].unit)


def _kind(each: Guess) -> str:
    """What a signal measures: its unit says, else its name, else its numbers; `reasons` grows."""
    by_unit, named, view = _KIND_OF_UNIT.get(units.kind(each.entry.unit), ""), each.named, each.look
    word = f"name: {named.kind_word}" if named.kind_word else ""
    if by_unit == "force" and (named.kind == "hammer" or (view.blows and not named.side)):
        each.reasons += [word] if named.kind == "hammer" else ["rests but for single pulses"]
        each.sure = SURE if named.kind == "hammer" else LIKELY
        return "hammer"
    if by_unit:
        agree = named.kind == by_unit
        each.reasons += [*([word] if agree else []), f"unit {each.entry.unit}"]
        each.sure = SURE if agree or named.place or named.side else LIKELY
        return by_unit
    if units.kind(each.entry.unit) not in ("", "voltage", "number"):
        return ""
    kind = named.kind if len(named.kind_word) > 1 else ""
    # Few pulses tell nothing of what they are; a signal that turns by its name and has two levels is no speed.
    pulses = view.edges if not kind else view.pulses if len(view.pulses) > 1 or kind == "keyphasor" else ()
    if len(pulses) and kind in ("", "speed", "keyphasor"):
        each.reasons += [word, f"{len(pulses)} {'even ' * bool(len(view.edges))}pulses"]
        each.sure = SURE if kind else LIKELY
        return "keyphasor"
    if kind == "keyphasor":
        return ""  # no pulses
    if kind == "force" and view.blows and not named.side:
        kind = "hammer"
    if not kind and each.volts and named.place in _PAIRS["length"] and named.axis:
        each.sure = SURE
        return "length"
    if not kind and each.volts and _PROBE_V[0] < view.mean < _PROBE_V[1] and view.spread < 0.3 * abs(view.mean):
        each.reasons.append(f"rests at {view.mean:.3g} V, as a probe does")
        each.sure = LIKELY
        return "length"
    if kind:
        each.reasons.append(word)
        each.sure = SURE if each.volts else LIKELY
    return kind


def _place_only(channel: str, found: list[Guess], seen: set[str]) -> None:
    """The one channel of its kind: that whose name says so, else the first."""
    if not found or channel in seen:
        return
    best = next((each for each in found if each.named.kind == channel), found[0])
    best.take(channel, LIKELY if len(found) > 1 and best.named.kind != channel else "")
    seen.add(channel)


def _stem(each: Guess) -> tuple[str, ...]:
    """A name without its axis."""
    return tuple(word for word in words_of(each.entry.name) if not read_name(word).axis)


def _place_pairs(kind: str, found: list[Guess], seen: set[str]) -> None:
    """Probes or accelerometers: place and axis by name, pairs by quadrature, disk and ring by how far they move."""
    for each in found:
        name = f"{each.named.place}_{each.named.axis}"
        if each.named.place in _PAIRS[kind] and each.named.axis and name not in seen:
            each.take(name, "", f"name: {each.named.place}, {each.named.axis}")
            seen.add(name)
    pairs = _pairs(kind, [each for each in found if not each.channel])
    open_places = [place for place in _PAIRS[kind] if not {f"{place}_x", f"{place}_y"} & seen]
    if len(pairs) > len(open_places):
        return  # nobody can tell which
    named: dict[int, str] = {}
    for number, pair in enumerate(pairs):
        if pair[0].named.place in set(open_places) - set(named.values()):
            named[number] = pair[0].named.place
    places, why, sure = _places(kind, pairs, named, open_places)
    for number, pair in enumerate(pairs):
        place = places[number]
        ask = [f"{' or '.join(_PAIRS[kind])}"] if number not in named and sure == ASK else []
        own_axes = {each.named.axis for each in pair} in ({"x", "y"}, {"x"}, {"y"}) and len(pair) == len(
            {each.named.axis for each in pair}
        )
        ask += [] if own_axes else [f"is it x, and {pair[1].entry.name} y" if len(pair) > 1 else "x or y"]
        for axis, each in zip("xy", pair, strict=False):
            own = each.named.axis if own_axes else ""
            reasons = [why] if number not in named else [f"name: {place}"]
            turned = relation(pair[0].look, pair[1].look) if len(pair) == 2 else None
            if turned is not None and turned.quadrature and kind == "length":
                other = pair[1 - pair.index(each)].entry.name
                reasons.append(f"90° from {other} at {turned.hz:.3g} Hz")
            reasons += [f"name: {own}"] * bool(own)
            level = ASK if not own else sure if number not in named else ""
            each.take(f"{place}_{own or axis}", level, *reasons, ask="; ".join(ask) if each is pair[0] else "")
            seen.add(each.channel)


def _pairs(kind: str, found: list[Guess]) -> list[list[Guess]]:
    """Signals at right angles, x first: of one name but for the axis, or in quadrature, or in their order.

    Without: what another signal is already, by the same name; and lengths for which nothing speaks but their unit.
    """
    found = [each for each in found if not (each.named.place in _PAIRS[kind] and each.named.axis)]
    stems: dict[tuple[str, ...], list[Guess]] = {}
    for each in found:
        if each.named.axis:
            stems.setdefault(_stem(each), []).append(each)
    pairs = [sorted(pair, key=lambda each: each.named.axis) for pair in stems.values() if
             {each.named.axis for each in pair} == {"x", "y"} and len(pair) == 2]  # fmt: skip
    rest = [each for each in found if all(each is not one for pair in pairs for one in pair)]
    while len(rest) > 1:
        a = rest.pop(0)
        turned = [b for b in rest if (found_one := relation(a.look, b.look)) is not None and found_one.quadrature]
        if not turned and not _speaks(kind, a):
            continue
        b = (turned or rest)[0]
        rest = [each for each in rest if each is not b]
        pairs.append([a, b])
    return [*pairs, *([each] for each in rest if _speaks(kind, each))]


def _speaks(kind: str, each: Guess) -> bool:
    """Whether the name says what it measures, or its numbers look like a probe; of accelerations the unit is enough."""
    return kind == "acceleration" or each.named.kind == kind or each.named.place in _PAIRS[kind] or each.volts


def _places(
    kind: str, pairs: list[list[Guess]], named: dict[int, str], free: list[str]
) -> tuple[dict[int, str], str, str]:
    """Place of each pair by its number, why, and how sure."""
    left = [place for place in free if place not in named.values()]
    rest = [number for number in range(len(pairs)) if number not in named]
    if len(rest) == 1 and len(left) == 1:
        return {**named, rest[0]: left[0]}, f"the pair that is left: {left[0]}", LIKELY
    if kind == "length" and len(rest) == 2 and all(len(pairs[number]) == 2 for number in rest):
        reach = {number: sum(_moves_mm(each) for each in pairs[number]) for number in rest}
        far, near = sorted(rest, key=lambda number: -reach[number])
        if reach[near] and reach[far] > _RATIO * reach[near]:
            why = f"pairs move {reach[far] / reach[near]:.2g}:1, the disk more"
            return {**named, far: "disk", near: "ring"}, why, LIKELY
    asked = f"{' or '.join(left)}: in their order"
    return {**named, **dict(zip(rest, left, strict=False))}, asked, ASK


def _moves_mm(each: Guess) -> float:
    """How far a probe moves [mm], by its own scale or an assumed one."""
    size = units.size_si(each.entry.unit) if units.kind(each.entry.unit) == "length" else 1e-3
    return each.look.spread * size * 1e3


def _place_forces(found: list[Guess], guesses: Sequence[Guess], seen: set[str]) -> None:
    """Force transducers: sides by name, else pairs of which one is relieved as the other is loaded."""
    others = {each.named.side for each in found}
    for each in found:
        name = f"P_{each.named.side_among(others)}"
        if each.named.side and name not in seen:
            alone = len(others - {""}) == 1 and each.named.side_letter
            each.take(name, LIKELY if alone else "", f"name: {name[-1]}", *_opposite(each, found))
            seen.add(name)
    rest = [each for each in found if not each.channel]
    free = [name for name in ("P_N", "P_S", "P_E", "P_W") if name not in seen]
    if not rest or len(rest) != len(free):
        return
    if len(rest) != 4:
        for each, name in zip(rest, free, strict=True):
            each.take(name, LIKELY, f"the one that is left: {name[-1]}")
            seen.add(name)
        return
    pairs = _opposed_pairs(rest)
    if not all(each.named.kind == "force" or _opposite(each, pair) for pair in pairs for each in pair):
        return
    axes = {each.channel[-1]: each for each in guesses if each.channel in ("disk_x", "disk_y")}
    if len(axes) == 2:
        along = [max(axes, key=lambda axis, pair=pair: abs(_follows(pair, axes[axis]))) for pair in pairs]
        if set(along) == {"x", "y"}:
            for pair, axis in zip(pairs, along, strict=True):
                order = pair if _follows(pair, axes[axis]) > 0.0 else pair[::-1]
                probe = axes[axis].entry.name
                _take_sides(order, "EW" if axis == "x" else "NS", f"loaded as {probe} rises", seen)
            return
    for pair, letters in zip(pairs, ("NS", "EW"), strict=True):
        _take_sides(pair, letters, "in their order", seen)


def _take_sides(pair: Sequence[Guess], letters: str, why: str, seen: set[str]) -> None:
    """Two transducers across each other, of which nobody tells the sides."""
    across = [_opposite(each, pair) for each in pair]
    for each, letter, against in zip(pair, letters, across, strict=True):
        reason = why.replace("loaded", "loaded" if each is pair[0] else "relieved")
        ask = f"is it {letters[0]}, and {pair[1].entry.name} {letters[1]}" if each is pair[0] else ""
        each.take(f"P_{letter}", ASK, *against, reason, ask=ask)
        seen.add(each.channel)


def _follows(pair: Sequence[Guess], probe: Guess) -> float:
    """By how much the difference of two forces goes with a probe: the difference of their correlations."""
    found = [relation(each.look, probe.look) for each in pair]
    return sum(sign * each.likeness for sign, each in zip((1.0, -1.0), found, strict=True) if each is not None)


def _opposed_pairs(four: list[Guess]) -> list[list[Guess]]:
    """The two pairs of four forces whose members are most opposed."""
    first, *others = four

    def opposed(one: Guess) -> float:
        rest = [each for each in others if each is not one]
        found = [relation(first.look, one.look), relation(rest[0].look, rest[1].look)]
        return round(sum(each.likeness for each in found if each is not None), 2)

    across = min(others, key=opposed)
    return [[first, across], [each for each in others if each is not across]]


def _opposite(each: Guess, found: Sequence[Guess]) -> list[str]:
    """The transducer across, in words, if there is one."""
    alike = {one.entry.name: relation(each.look, one.look) for one in found if one is not each}
    against = {name: one.likeness for name, one in alike.items() if one is not None and one.likeness < _OPPOSED}
    return [f"against {min(against, key=lambda name: against[name])}"] if against else []


def _turns(guesses: Sequence[Guess]) -> None:
    """Pulses and speed check each other: pulses a turn, and the speed's unit where nobody tells it."""
    pulse = next((each for each in guesses if each.channel == "keyphasor"), None)
    if pulse is None or len(pulse.look.pulses) < 2:
        return
    rate_hz = 1.0 / median((pulse.look.pulses[1:] - pulse.look.pulses[:-1]).tolist())
    speed = next((each for each in guesses if each.channel == "speed"), None) or _speed_of(guesses, rate_hz)
    if speed is None or not speed.look.mean:
        pulse.reasons.append(f"{rate_hz:.4g} pulses a second")
        pulse.asks["pulses_per_turn"] = "no speed to check it by"
        return
    if speed.volts:
        pulse.asks["pulses_per_turn"] = "the speed is told in volts"
        return
    told = speed.entry.unit if units.kind(speed.entry.unit) == "speed of rotation" else None
    pairs = [(unit, size) for unit, size in _TURN_UNITS if told is None or units.canonical(told) == unit]
    pairs = pairs or [(told or "", 6.283185307179586 / units.size_si(told or ""))]
    for unit, size in pairs:
        ratio = rate_hz / (speed.look.mean / size)
        whole = round(ratio)
        if whole >= 1 and abs(ratio / whole - 1.0) < _WHOLE and (told is not None or whole == 1):
            pulse.pulses_per_turn = whole
            pulse.reasons.append(f"{ratio:.4g} a turn of {speed.entry.name}")
            if told is None:
                speed.unit = unit
                speed.reasons.append(f"{unit}: as the pulses turn")
            return
    pulse.asks["pulses_per_turn"] = f"{rate_hz:.4g} pulses a second do not fit the speed"


def _speed_of(guesses: Sequence[Guess], rate_hz: float) -> Guess | None:
    """A signal without a unit that is as steady and as large as the pulses turn."""
    for each in guesses:
        steady = not (each.channel or each.kind or each.volts) and each.look.spread < 0.1 * abs(each.look.mean)
        if steady and any(abs(each.look.mean / size / rate_hz - 1.0) < _WHOLE for _, size in _TURN_UNITS):
            each.take("speed", LIKELY, "steady, and as the pulses turn")
            return each
    return None


def _scale(each: Guess, unit: str, usual_v: float) -> None:
    """Unit, sensitivity and zero of a signal that is taken for a channel."""
    told, view = units.kind(each.entry.unit), each.look
    low, high = view.extent
    if each.channel == "hammer" and view.blows and view.mean - low > high - view.mean:
        each.sign = -1
        each.reasons.append("polarity: its pulses point down")
    if each.channel.startswith("P_") and not each.volts and view.mean < -3.0 * view.spread:
        each.sign = -1
        each.reasons.append("polarity: its preload is negative")
    text = f"{each.entry.name} {each.entry.label}"
    if unit == "1":
        return
    if each.volts:
        found = _SENSITIVITY.search(text)
        if found is not None and units.kind(found[3]) == units.kind(unit):
            each.sensitivity = f"{float(found[1].replace(',', '.')):g} {found[2]}/{found[3]}"
            each.reasons.append(f"told: {each.sensitivity}")
        else:
            each.sensitivity = f"{usual_v:g} V/{unit}"
            each.asks["sensitivity"] = "assumed, and that its volts rise toward +: the file tells none"
        bias = _BIAS.search(text)
        if bias is not None:
            scale = units.size_si(bias[2]) / units.size_si(each.entry.unit)
            each.bias = round(float(bias[1].replace(",", ".")) * scale, 9)
            each.reasons.append(f"told: bias {each.bias:g} {each.entry.unit}")
        elif units.kind(unit) == "length":
            each.bias = "mean"
            each.reasons.append("zero: its mean")
    elif told in ("", "number") and each.unit is None:
        each.unit = unit
        each.asks["unit"] = f"the file says {each.entry.unit!r}" if each.entry.unit else "the file tells none"
    elif units.kind(unit) == "length" and abs(each.look.mean) > 5.0 * each.look.spread:
        each.bias = "mean"
        each.reasons.append("zero: its mean")
