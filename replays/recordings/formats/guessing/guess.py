"""Guesses of the rig's channels for the signals of a log, from name, unit, level and relations between signals.

A guess has reasons and a confidence: `sure` if name and unit agree, `likely` if there is one indication, `ask` if
something cannot be determined from the log. Other signals become separate channels.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import median

from replays.recordings.formats.guessing.features import SignalFeatures, compute_features, compute_relation
from replays.recordings.formats.guessing.naming import ParsedName, read_name, split_words
from replays.recordings.formats.source import Entry, Source
from rig.base import units
from rig.channels.table import default_table

SURE, LIKELY, ASK = "sure", "likely", "ask"
_KIND_OF_UNIT = {
    "length": "length", "force": "force", "acceleration": "acceleration", "speed of rotation": "speed",
}  # fmt: skip
_PROBE_V = (-20.0, -1.0)
"""Mean voltages of eddy-current probes: supplied with -24 V, mid-range is about -10 V."""
_PAIRS = {"length": ("disk", "ring"), "acceleration": ("inner", "outer")}
_MIN_DISK_RATIO = 1.15
"""Minimum ratio of the motion at the disk to that in the ring, which is nearer to the lower bearing."""
_MAX_LIKENESS = -0.5
"""Correlation of two opposite transducers, one of which is unloaded as the other is loaded."""
_SENSITIVITY = re.compile(r"(\d+(?:[.,]\d+)?)\s*(m?V)\s*(?:/|per|pro)\s*(mm|mil|um|µm|μm|N|lbf|g|m/s\^?2|m/s²)(?!\w)")
_BIAS = re.compile(r"(?:bias|offset|ruhespannung)\w*\s*[:=]?\s*(-?\d+(?:[.,]\d+)?)\s*(m?V)", re.IGNORECASE)
_TURN_UNITS = (("Hz", 1.0), ("rpm", 60.0), ("rad/s", 6.283185307179586))
_NAME = "name: "
_RATIO_TOLERANCE = 0.02
"""Relative tolerance for a whole number of pulses per turn."""


@dataclass
class Guess:
    """Guess for one signal.

    Attributes:
        source: File of the signal.
        entry: The signal.
        features: Features of its values.
        name_parts: Content of its name.
        kind: Quantity, as in `ParsedName`; empty if unknown.
        channel: Channel of the rig; empty: none.
        confidence: `sure`, `likely` or `ask`; empty without a channel.
        reasons: Reasons of the guess.
        unit: Unit that the file lacks or has wrong; None: as in the file.
        sensitivity: Volts per unit, in the notation of a mapping; None for signals in units.
        bias: Source value at zero, or "mean"; None: zero.
        sign: -1 if the signal falls as the quantity rises.
        asks: Undetermined properties, by field of the mapping.
        pulses_per_turn: Pulses per turn of a keyphasor.
    """

    source: Source
    entry: Entry
    features: SignalFeatures
    name_parts: ParsedName
    kind: str = ""
    channel: str = ""
    confidence: str = ""
    reasons: list[str] = field(default_factory=list)
    unit: str | None = None
    sensitivity: str | None = None
    bias: float | str | None = None
    sign: int = 1
    asks: dict[str, str] = field(default_factory=dict)
    pulses_per_turn: int = 1

    @property
    def volts(self) -> bool:
        """True if the file's unit is a voltage."""
        return units.get_quantity(self.entry.unit) == "voltage"

    @property
    def zero(self) -> float:
        """Source value at zero."""
        return self.features.mean if self.bias == "mean" else float(self.bias or 0.0)

    @property
    def gain(self) -> float:
        """Channel unit per unit of the file; 0 if unknown."""
        if not self.channel:
            return 0.0
        unit = default_table().channels[self.channel].unit
        if self.sensitivity is not None:
            return (
                self.sign
                * units.size_si(self.entry.unit)
                / units.sensitivity_v(self.sensitivity, unit, field="sensitivity")
            )
        own = self.unit or self.entry.unit
        return (
            self.sign * units.size_si(own) / units.size_si(unit)
            if units.get_quantity(own) == units.get_quantity(unit)
            else 0.0
        )

    def assign(self, channel: str, confidence: str, *reasons: str, ask: str = "") -> None:
        """Assign a channel with a confidence no higher than before; `ask` is the question about its name."""
        order = ("", SURE, LIKELY, ASK)
        self.channel, self.confidence = channel, max(self.confidence, confidence, key=order.index)
        self.reasons += reasons
        if ask:
            self.asks["name"] = ask

    @property
    def why(self) -> str:
        """Reasons in one line, with those from the name combined."""
        names = [reason.removeprefix(_NAME) for reason in self.reasons if reason.startswith(_NAME)]
        others = [reason for reason in self.reasons if reason and not reason.startswith(_NAME)]
        return "; ".join([*([f"name: {', '.join(names)}"] if names else []), *others])


def guess_channels(
    sources: Sequence[Source], *, exported: Callable[[Source, Entry], bool] = lambda source, entry: False
) -> list[Guess]:
    """Guess the channels of the signals in files.

    Args:
        sources: The files.
        exported: Predicate of signals that the rig itself exported, whose names are reliable.

    Raises:
        InputError: A signal cannot be read.
    """
    guesses = [
        Guess(source, entry, compute_features(source.read(entry)), read_name(entry.name))
        for source in sources
        for entry in source.entries
    ]
    rig, assigned = default_table().channels, set[str]()
    for each in guesses:
        name = each.entry.name
        if name in rig and name not in assigned and (exported(each.source, each.entry) or _fits(each, rig[name].unit)):
            each.kind = _channel_kind(name)
            each.assign(name, SURE, "the rig's own name")
            assigned.add(name)
        else:
            each.kind = _kind(each)
    free = [each for each in guesses if not each.channel]
    for kind in _PAIRS:
        _assign_pairs(kind, [each for each in free if each.kind == kind], assigned)
    _assign_forces([each for each in free if each.kind == "force"], guesses, assigned)
    for kind, channel in (("hammer", "hammer"), ("keyphasor", "keyphasor"), ("speed", "speed")):
        _assign_single(channel, [each for each in free if each.kind == kind], assigned)
    _check_turns(guesses)
    for each in guesses:
        if each.channel:
            _scale(each, rig[each.channel].unit, rig[each.channel].sensitivity_v)
    return guesses


def _fits(each: Guess, unit: str) -> bool:
    kind = units.get_quantity(each.entry.unit)
    return kind in ("", "voltage", "number") or kind == units.get_quantity(unit)


def _channel_kind(name: str) -> str:
    if name in ("speed", "keyphasor", "hammer"):
        return name
    return units.get_quantity(default_table().channels[name].unit)


def _kind(each: Guess) -> str:
    """Return the quantity of a signal from its unit, else its name, else its values; extend its `reasons`."""
    by_unit, named, view = _KIND_OF_UNIT.get(units.get_quantity(each.entry.unit), ""), each.name_parts, each.features
    word = f"name: {named.kind_word}" if named.kind_word else ""
    if by_unit == "force" and (named.kind == "hammer" or (view.is_hammer and not named.side)):
        each.reasons += [word] if named.kind == "hammer" else ["rests except for single pulses"]
        each.confidence = SURE if named.kind == "hammer" else LIKELY
        return "hammer"
    if by_unit:
        agree = named.kind == by_unit
        each.reasons += [*([word] if agree else []), f"unit {each.entry.unit}"]
        each.confidence = SURE if agree or named.place or named.side else LIKELY
        return by_unit
    if units.get_quantity(each.entry.unit) not in ("", "voltage", "number"):
        return ""
    kind = named.kind if len(named.kind_word) > 1 else ""
    # A few pulses alone are not enough; a signal named like a speed that has two levels is a keyphasor.
    pulses = view.edges if not kind else view.pulses if len(view.pulses) > 1 or kind == "keyphasor" else ()
    if len(pulses) and kind in ("", "speed", "keyphasor"):
        each.reasons += [word, f"{len(pulses)} {'even ' * bool(len(view.edges))}pulses"]
        each.confidence = SURE if kind else LIKELY
        return "keyphasor"
    if kind == "keyphasor":
        return ""  # no pulses
    if kind == "force" and view.is_hammer and not named.side:
        kind = "hammer"
    if not kind and each.volts and named.place in _PAIRS["length"] and named.axis:
        each.confidence = SURE
        return "length"
    if not kind and each.volts and _PROBE_V[0] < view.mean < _PROBE_V[1] and view.spread < 0.3 * abs(view.mean):
        each.reasons.append(f"rests at {view.mean:.3g} V, as a probe does")
        each.confidence = LIKELY
        return "length"
    if kind:
        each.reasons.append(word)
        each.confidence = SURE if each.volts else LIKELY
    return kind


def _assign_single(channel: str, guesses: list[Guess], assigned: set[str]) -> None:
    """Assign the only channel of its kind: to a signal whose name fits, else to the first."""
    if not guesses or channel in assigned:
        return
    best = next((each for each in guesses if each.name_parts.kind == channel), guesses[0])
    best.assign(channel, LIKELY if len(guesses) > 1 and best.name_parts.kind != channel else "")
    assigned.add(channel)


def _stem(each: Guess) -> tuple[str, ...]:
    """Return a name without its axis."""
    return tuple(word for word in split_words(each.entry.name) if not read_name(word).axis)


def _assign_pairs(kind: str, guesses: list[Guess], assigned: set[str]) -> None:
    """Assign probes or accelerometers: place and axis by name, pairs by quadrature, disk and ring by amplitude."""
    for each in guesses:
        name = f"{each.name_parts.place}_{each.name_parts.axis}"
        if each.name_parts.place in _PAIRS[kind] and each.name_parts.axis and name not in assigned:
            each.assign(name, "", f"name: {each.name_parts.place}, {each.name_parts.axis}")
            assigned.add(name)
    pairs = _pairs(kind, [each for each in guesses if not each.channel])
    open_places = [place for place in _PAIRS[kind] if not {f"{place}_x", f"{place}_y"} & assigned]
    if len(pairs) > len(open_places):
        return  # ambiguous
    named: dict[int, str] = {}
    for number, pair in enumerate(pairs):
        if pair[0].name_parts.place in set(open_places) - set(named.values()):
            named[number] = pair[0].name_parts.place
    places, why, confidence = _places(kind, pairs, named, open_places)
    for number, pair in enumerate(pairs):
        place = places[number]
        ask = [f"{' or '.join(_PAIRS[kind])}"] if number not in named and confidence == ASK else []
        own_axes = {each.name_parts.axis for each in pair} in ({"x", "y"}, {"x"}, {"y"}) and len(pair) == len(
            {each.name_parts.axis for each in pair}
        )
        ask += [] if own_axes else [f"is it x, and {pair[1].entry.name} y" if len(pair) > 1 else "x or y"]
        for axis, each in zip("xy", pair, strict=False):
            own = each.name_parts.axis if own_axes else ""
            reasons = [why] if number not in named else [f"name: {place}"]
            relation = compute_relation(pair[0].features, pair[1].features) if len(pair) == 2 else None
            if relation is not None and relation.quadrature and kind == "length":
                other = pair[1 - pair.index(each)].entry.name
                reasons.append(f"90° from {other} at {relation.hz:.3g} Hz")
            reasons += [f"name: {own}"] * bool(own)
            level = ASK if not own else confidence if number not in named else ""
            each.assign(f"{place}_{own or axis}", level, *reasons, ask="; ".join(ask) if each is pair[0] else "")
            assigned.add(each.channel)


def _pairs(kind: str, guesses: list[Guess]) -> list[list[Guess]]:
    """Return pairs of signals at right angles, x first: equal names except for the axis, or quadrature, or file order.

    Signals whose named place is already assigned, and lengths without other evidence than their unit, are excluded.
    """
    guesses = [each for each in guesses if not (each.name_parts.place in _PAIRS[kind] and each.name_parts.axis)]
    stems: dict[tuple[str, ...], list[Guess]] = {}
    for each in guesses:
        if each.name_parts.axis:
            stems.setdefault(_stem(each), []).append(each)
    pairs = [sorted(pair, key=lambda each: each.name_parts.axis) for pair in stems.values() if
             {each.name_parts.axis for each in pair} == {"x", "y"} and len(pair) == 2]  # fmt: skip
    rest = [each for each in guesses if all(each is not one for pair in pairs for one in pair)]
    while len(rest) > 1:
        a = rest.pop(0)
        normal = [b for b in rest if (rel := compute_relation(a.features, b.features)) is not None and rel.quadrature]
        if not normal and not _is_confirmed(kind, a):
            continue
        b = (normal or rest)[0]
        rest = [each for each in rest if each is not b]
        pairs.append([a, b])
    return [*pairs, *([each] for each in rest if _is_confirmed(kind, each))]


def _is_confirmed(kind: str, each: Guess) -> bool:
    """Return whether name or level of a signal confirm its quantity; for accelerations the unit suffices."""
    return kind == "acceleration" or each.name_parts.kind == kind or each.name_parts.place in _PAIRS[kind] or each.volts


def _places(
    kind: str, pairs: list[list[Guess]], named: dict[int, str], free: list[str]
) -> tuple[dict[int, str], str, str]:
    """Return the place of each pair by its number, the reason, and the confidence."""
    unused = [place for place in free if place not in named.values()]
    rest = [number for number in range(len(pairs)) if number not in named]
    if len(rest) == 1 and len(unused) == 1:
        return {**named, rest[0]: unused[0]}, f"the remaining pair: {unused[0]}", LIKELY
    if kind == "length" and len(rest) == 2 and all(len(pairs[number]) == 2 for number in rest):
        reach = {number: sum(_moves_mm(each) for each in pairs[number]) for number in rest}
        far, near = sorted(rest, key=lambda number: -reach[number])
        if reach[near] and reach[far] > _MIN_DISK_RATIO * reach[near]:
            why = f"pairs move {reach[far] / reach[near]:.2g}:1, the disk more"
            return {**named, far: "disk", near: "ring"}, why, LIKELY
    return {**named, **dict(zip(rest, unused, strict=False))}, f"{' or '.join(unused)}: in file order", ASK


def _moves_mm(each: Guess) -> float:
    """Return the amplitude of a probe [mm], by its own scale or an assumed one."""
    size = units.size_si(each.entry.unit) if units.get_quantity(each.entry.unit) == "length" else 1e-3
    return each.features.spread * size * 1e3


def _assign_forces(forces: list[Guess], guesses: Sequence[Guess], assigned: set[str]) -> None:
    """Assign force transducers: sides by name, else opposite pairs by their correlation."""
    others = {each.name_parts.side for each in forces}
    for each in forces:
        name = f"P_{each.name_parts.resolve_side(others)}"
        if each.name_parts.side and name not in assigned:
            alone = len(others - {""}) == 1 and each.name_parts.side_letter
            each.assign(name, LIKELY if alone else "", f"name: {name[-1]}", *_opposite(each, forces))
            assigned.add(name)
    rest = [each for each in forces if not each.channel]
    free = [name for name in ("P_N", "P_S", "P_E", "P_W") if name not in assigned]
    if not rest or len(rest) != len(free):
        return
    if len(rest) != 4:
        for each, name in zip(rest, free, strict=True):
            each.assign(name, LIKELY, f"the remaining one: {name[-1]}")
            assigned.add(name)
        return
    pairs = _opposed_pairs(rest)
    if not all(each.name_parts.kind == "force" or _opposite(each, pair) for pair in pairs for each in pair):
        return
    axes = {each.channel[-1]: each for each in guesses if each.channel in ("disk_x", "disk_y")}
    if len(axes) == 2:
        along = [max(axes, key=lambda axis, pair=pair: abs(_correlation(pair, axes[axis]))) for pair in pairs]
        if set(along) == {"x", "y"}:
            for pair, axis in zip(pairs, along, strict=True):
                order = pair if _correlation(pair, axes[axis]) > 0.0 else pair[::-1]
                probe = axes[axis].entry.name
                _assign_sides(order, "EW" if axis == "x" else "NS", f"loaded as {probe} rises", assigned)
            return
    for pair, letters in zip(pairs, ("NS", "EW"), strict=True):
        _assign_sides(pair, letters, "in file order", assigned)


def _assign_sides(pair: Sequence[Guess], letters: str, why: str, assigned: set[str]) -> None:
    """Assign two opposite transducers whose sides are not named."""
    across = [_opposite(each, pair) for each in pair]
    for each, letter, against in zip(pair, letters, across, strict=True):
        reason = why.replace("loaded", "loaded" if each is pair[0] else "relieved")
        ask = f"is it {letters[0]}, and {pair[1].entry.name} {letters[1]}" if each is pair[0] else ""
        each.assign(f"P_{letter}", ASK, *against, reason, ask=ask)
        assigned.add(each.channel)


def _correlation(pair: Sequence[Guess], probe: Guess) -> float:
    """Return the correlation of the difference of two forces with a probe, as the difference of their correlations."""
    relations = [compute_relation(each.features, probe.features) for each in pair]
    return sum(sign * each.likeness for sign, each in zip((1.0, -1.0), relations, strict=True) if each is not None)


def _opposed_pairs(four: list[Guess]) -> list[list[Guess]]:
    """Return the two pairs of four forces with the most negative correlations."""
    first, *others = four

    def opposed(one: Guess) -> float:
        rest = [each for each in others if each is not one]
        pairs = [compute_relation(first.features, one.features), compute_relation(rest[0].features, rest[1].features)]
        return round(sum(each.likeness for each in pairs if each is not None), 2)

    across = min(others, key=opposed)
    return [[first, across], [each for each in others if each is not across]]


def _opposite(each: Guess, forces: Sequence[Guess]) -> list[str]:
    """Return the opposite transducer as a reason, if there is one."""
    alike = {one.entry.name: compute_relation(each.features, one.features) for one in forces if one is not each}
    against = {name: one.likeness for name, one in alike.items() if one is not None and one.likeness < _MAX_LIKENESS}
    return [f"against {min(against, key=lambda name: against[name])}"] if against else []


def _check_turns(guesses: Sequence[Guess]) -> None:
    """Check keyphasor and speed against each other: pulses per turn, and the unit of the speed if the file has none."""
    pulse = next((each for each in guesses if each.channel == "keyphasor"), None)
    if pulse is None or len(pulse.features.pulses) < 2:
        return
    rate_hz = 1.0 / median((pulse.features.pulses[1:] - pulse.features.pulses[:-1]).tolist())
    speed = next((each for each in guesses if each.channel == "speed"), None) or _find_speed(guesses, rate_hz)
    if speed is None or not speed.features.mean:
        pulse.reasons.append(f"{rate_hz:.4g} pulses a second")
        pulse.asks["pulses_per_turn"] = "no speed for a check"
        return
    if speed.volts:
        pulse.asks["pulses_per_turn"] = "the speed is in volts"
        return
    speed_unit = speed.entry.unit if units.get_quantity(speed.entry.unit) == "speed of rotation" else None
    pairs = [(unit, size) for unit, size in _TURN_UNITS if speed_unit is None or units.canonical(speed_unit) == unit]
    pairs = pairs or [(speed_unit or "", 6.283185307179586 / units.size_si(speed_unit or ""))]
    for unit, size in pairs:
        ratio = rate_hz / (speed.features.mean / size)
        whole = round(ratio)
        if whole >= 1 and abs(ratio / whole - 1.0) < _RATIO_TOLERANCE and (speed_unit is not None or whole == 1):
            pulse.pulses_per_turn = whole
            pulse.reasons.append(f"{ratio:.4g} a turn of {speed.entry.name}")
            if speed_unit is None:
                speed.unit = unit
                speed.reasons.append(f"{unit}: fits the pulse rate")
            return
    pulse.asks["pulses_per_turn"] = f"{rate_hz:.4g} pulses a second do not fit the speed"


def _find_speed(guesses: Sequence[Guess], rate_hz: float) -> Guess | None:
    """Return a steady signal without a unit whose value fits the pulse rate, if there is one."""
    for each in guesses:
        steady = not (each.channel or each.kind or each.volts) and each.features.spread < 0.1 * abs(each.features.mean)
        if steady and any(abs(each.features.mean / size / rate_hz - 1.0) < _RATIO_TOLERANCE for _, size in _TURN_UNITS):
            each.assign("speed", LIKELY, "steady, and fits the pulse rate")
            return each
    return None


def _scale(each: Guess, unit: str, usual_v: float) -> None:
    """Determine unit, sensitivity and zero of a signal with a channel."""
    file_kind, view = units.get_quantity(each.entry.unit), each.features
    low, high = view.extent
    if each.channel == "hammer" and view.is_hammer and view.mean - low > high - view.mean:
        each.sign = -1
        each.reasons.append("polarity: its pulses point down")
    if each.channel.startswith("P_") and not each.volts and view.mean < -3.0 * view.spread:
        each.sign = -1
        each.reasons.append("polarity: its preload is negative")
    text = f"{each.entry.name} {each.entry.label}"
    if unit == "1":
        return
    if each.volts:
        match = _SENSITIVITY.search(text)
        if match is not None and units.get_quantity(match[3]) == units.get_quantity(unit):
            each.sensitivity = f"{float(match[1].replace(',', '.')):g} {match[2]}/{match[3]}"
            each.reasons.append(f"in the file: {each.sensitivity}")
        else:
            each.sensitivity = f"{usual_v:g} V/{unit}"
            each.asks["sensitivity"] = "assumed, with volts rising toward +, as the file has none"
        bias = _BIAS.search(text)
        if bias is not None:
            scale = units.size_si(bias[2]) / units.size_si(each.entry.unit)
            each.bias = round(float(bias[1].replace(",", ".")) * scale, 9)
            each.reasons.append(f"in the file: bias {each.bias:g} {each.entry.unit}")
        elif units.get_quantity(unit) == "length":
            each.bias = "mean"
            each.reasons.append("zero: its mean")
    elif file_kind in ("", "number") and each.unit is None:
        each.unit = unit
        each.asks["unit"] = f"the file says {each.entry.unit!r}" if each.entry.unit else "the file has none"
    elif units.get_quantity(unit) == "length" and abs(each.features.mean) > 5.0 * each.features.spread:
        each.bias = "mean"
        each.reasons.append("zero: its mean")
