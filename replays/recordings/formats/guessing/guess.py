"""Guesses of the rig's channels for the signals of a log, from name, unit, level and relations between signals.

A guess has reasons and a confidence: `sure` if the name determines channel and side and values and unit are plausible,
`likely` if the signals of the log determine it, `open` if that is undetermined. Other signals become separate channels.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from replays.recordings.formats.guessing.assignment import (
    CHANNELS,
    FAMILIES,
    Choice,
    Relations,
    assign_channels,
    family_of,
    find_pairs,
)  # fmt: skip
from replays.recordings.formats.guessing.features import SignalFeatures, compute_features
from replays.recordings.formats.guessing.naming import ParsedName, read_name, split_unit
from replays.recordings.formats.source import Entry, Source
from rig.base import units
from rig.channels.table import default_table

SURE, LIKELY, ASK = "sure", "likely", "open"
_ORDER = ("", SURE, LIKELY, ASK)
_SURE, _LIKELY = 2.0, 0.5
"""Least loss of score of every other assignment, for both levels of confidence."""
_OWN_NAME, _EXCLUDED, _FILE_ORDER = 40.0, -20.0, 1e-6
"""Scores of the rig's own name, of a unit of another quantity, and of equal signals by their number in the file."""
_KIND_OF_UNIT = {
    "length": "length", "force": "force", "acceleration": "acceleration", "speed of rotation": "speed",
}  # fmt: skip
_PROBE_V = (-20.0, -1.0)
"""Mean voltages of eddy-current probes: supplied with -24 V, mid-range is about -10 V."""
_PAIRS = {"length": ("disk", "ring"), "acceleration": ("inner", "outer")}
_AXIS_OF_SIDE = {"N": "y", "S": "y", "E": "x", "W": "x"}
_MAX_SPEED_VARIATION = 0.1
"""Largest standard deviation of a speed, relative to its mean."""
_PLAUSIBLE = {
    "disk": ("mm", 5e-3, 3.0), "ring": ("mm", 5e-3, 1.5), "P": ("N", 100.0, 50_000.0), "hammer": ("N", 1.0, 20_000.0),
    "speed": ("Hz", 0.1, 1000.0), "inner": ("m/s^2", 0.5, 50_000.0), "outer": ("m/s^2", 0.5, 50_000.0),
}  # fmt: skip
"""Range of half the extent of probes and accelerometers and of the mean or peak of others: a clearance of 0.93 mm."""
_UNIT_CHOICES = {
    "mm": ("mm", "um", "mil"), "N": ("N", "daN", "lbf", "kN"), "Hz": ("Hz", "rpm", "rad/s"), "m/s^2": ("m/s^2", "g"),
}  # fmt: skip
_MAX_LIKENESS = -0.985
"""Correlation of two opposite transducers, one of which is unloaded as the other is loaded."""
_SENSITIVITY = re.compile(r"(\d+(?:[.,]\d+)?)\s*(m?V)\s*(?:/|per|pro)\s*(mm|mil|um|µm|μm|N|lbf|g|m/s\^?2|m/s²)(?!\w)")
_BIAS = re.compile(r"(?:bias|offset|ruhespannung)\w*\s*[:=]?\s*(-?\d+(?:[.,]\d+)?)\s*(m?V)", re.IGNORECASE)
_TURN_UNITS = (("Hz", 1.0), ("rpm", 60.0), ("rad/s", 6.283185307179586))
_NAME = "name: "
_MIN_REASON = 0.25
"""Measure of a relation of two signals from which it is given as a reason."""
_IMPACT_S = 0.03
"""Longest time from a hammer pulse to the motion that it causes."""
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
        wave_reasons: Reasons from the values, by kind of quantity.
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
    wave_reasons: dict[str, str] = field(default_factory=dict)
    unit: str | None = None
    sensitivity: str | None = None
    bias: float | str | None = None
    sign: int = 1
    asks: dict[str, str] = field(default_factory=dict)
    pulses_per_turn: int = 1

    @property
    def volts(self) -> bool:
        """True if the signal's unit is a voltage."""
        return units.get_quantity(self.own_unit) == "voltage"

    @property
    def own_unit(self) -> str:
        """Unit of the signal, from the mapping, its name or the file; empty or unknown if none of them has it."""
        return self.unit or self.entry.unit

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
                * units.size_si(self.own_unit)
                / units.sensitivity_v(self.sensitivity, unit, field="sensitivity")
            )
        same = units.get_quantity(self.own_unit) == units.get_quantity(unit)
        return self.sign * units.size_si(self.own_unit) / units.size_si(unit) if same else 0.0

    def assign(self, channel: str, confidence: str, *reasons: str, ask: str = "") -> None:
        """Assign a channel with a confidence no higher than before; `ask` is the question about its name."""
        self.channel, self.confidence = channel, max(self.confidence, confidence, key=_ORDER.index)
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
        Guess(source, entry, compute_features(source.read(entry)), read_name(split_unit(entry.name)[0]))
        for source in sources
        for entry in source.entries
    ]
    own = {
        number
        for number, each in enumerate(guesses)
        if (channel := default_table().channels.get(each.entry.name)) is not None
        and (exported(each.source, each.entry) or _fits(each, channel.unit))
    }
    for each in guesses:
        name_unit = split_unit(each.entry.name)[1]
        if not each.entry.unit or units.get_quantity(each.entry.unit) == "number":
            each.unit = units.canonical(name_unit) if units.is_known(name_unit) else None
        elif units.get_quantity(plain := units.split_detector(each.entry.unit)[0]):
            each.unit = units.canonical(plain) if plain != each.entry.unit else None
        if detector := units.split_detector(name_unit or each.entry.unit)[1]:
            each.unit = units.canonical(units.split_detector(name_unit or each.entry.unit)[0])
            each.asks["unit"] = f"{detector} is the reading of a detector; samples may need a factor"
    known = [each.own_unit if units.get_quantity(each.own_unit) not in ("", "number") else "" for each in guesses]
    relations = Relations(
        [each.features for each in guesses], [units.canonical(unit) if unit else "" for unit in known]
    )
    scores = _score(guesses, relations, own)
    choices = assign_channels(scores, relations)
    for number, (each, choice) in enumerate(zip(guesses, choices, strict=True)):
        each.channel = choice.channel
        if number in own and choice.channel == each.entry.name:
            each.assign(choice.channel, SURE, "the rig's own name")
        elif choice.channel:
            _explain(each, choice)
    _explain_pairs(guesses, relations, own)
    _check_turns(guesses)
    _choose_zeros(guesses)
    for each in guesses:
        if each.channel:
            channel = default_table().channels[each.channel]
            _scale(each, channel.unit, channel.sensitivity_v)
    return guesses


def _fits(each: Guess, unit: str) -> bool:
    kind = units.get_quantity(each.entry.unit)
    return kind in ("", "voltage", "number") or kind == units.get_quantity(unit)


def _score(guesses: Sequence[Guess], relations: Relations, own: set[int]) -> np.ndarray:
    """Return the score of each signal for each channel from its name, unit and values, shape (signals, channels)."""
    named_sides = {each.name_parts.side for each in guesses}
    scores = np.zeros((len(guesses), len(CHANNELS)))
    pulse_rates = [_pulse_rate_hz(each) for each in guesses]
    waves = [_score_waves(number, guesses, relations, pulse_rates) for number in range(len(guesses))]
    for number, each in enumerate(guesses):
        named, wave = each.name_parts, waves[number]
        side = named.resolve_side(named_sides)
        axis = named.axis or _AXIS_OF_SIDE.get(side if not named.side_letter else "", "")
        for column, channel in enumerate(CHANNELS):
            kind = _channel_kind(channel)
            place, _, end = channel.rpartition("_")
            score = _score_kind(each, kind) + wave.get(kind, 0.0)
            if kind in _PAIRS:
                score += _compare(named.place if named.place in _PAIRS[kind] else "", place, 3.0, 9.0)
                score += _compare(axis, end, 3.0, 9.0)
            elif kind == "force":
                score += _compare(side, end, 4.0, 9.0)
                score += _compare("" if side else named.axis, _AXIS_OF_SIDE[end], 1.5, 3.0)
            exact = number in own and each.entry.name == channel
            scores[number, column] = score + (_OWN_NAME if exact else 0.0) - _FILE_ORDER * number
    return scores


def _compare(found: str, wanted: str, equal: float, other: float) -> float:
    return 0.0 if not found else equal if found == wanted else -other


def _score_kind(each: Guess, kind: str) -> float:
    """Return the score of a signal for a kind of quantity by unit and name."""
    named, quantity = each.name_parts, units.get_quantity(each.own_unit)
    score = 0.0
    if quantity not in ("", "voltage", "number"):
        if _KIND_OF_UNIT.get(quantity) != ("force" if kind == "hammer" else kind):
            return _EXCLUDED
        score += 4.0 if kind in ("acceleration", "speed") else 2.5
    if named.kind == kind:
        score += 5.0 if len(named.kind_word) > 1 or kind == "speed" else 1.0
    elif named.kind == "tach":
        score += {"speed": 5.0, "keyphasor": 2.0}.get(kind, -4.0)
    elif len(named.kind_word) > 1 and not (kind == "hammer" and named.kind == "force" and not named.side):
        score -= 1.0 if (named.kind, kind) == ("speed", "keyphasor") else 4.0
    for other, places in _PAIRS.items():
        if named.place in places:
            score += (5.0 if named.axis else 3.0) if kind == other else -3.0
    return score + (1.5 if kind == "force" and named.side and not named.side_letter else 0.0)


def _score_waves(
    number: int, guesses: Sequence[Guess], relations: Relations, pulse_rates: Sequence[float]
) -> dict[str, float]:
    """Return the score of a signal by kind of quantity from its values and its relations to other signals."""
    each = guesses[number]
    view, every = each.features, range(len(guesses))
    if len(view.pulses) and view.spread > 0.05 * abs(view.mean):
        regular = len(view.edges) > 0
        if regular:
            each.wave_reasons["keyphasor"] = f"{len(view.edges)} even pulses"
        elif len(view.pulses) > 1:
            each.wave_reasons["keyphasor"] = f"{len(view.pulses)} pulses"
        wave = {"keyphasor": 4.0 if regular else 2.0, "speed": -2.0} if len(view.pulses) > 1 else {}
        if regular:
            wave["keyphasor"] += 2.0 if _turns_with(number, guesses, relations) else 0.0
            return wave | {"speed": -4.0, "hammer": -4.0, "length": -4.0, "force": -4.0, "acceleration": -4.0}
    else:
        wave = {"keyphasor": -4.0}
    if view.is_hammer:
        each.wave_reasons["hammer"] = "rests except for single pulses"
        moves = 0.0 <= relations.onset_s - view.pulse_start_s < _IMPACT_S
        if moves:
            each.wave_reasons["hammer"] = "a single pulse, after which others move"
        return wave | {
            "hammer": 6.0 if moves else 4.0,
            "force": -4.0,
            "length": -4.0,
            "acceleration": -4.0,
            "speed": -1.0,
        }
    wave["hammer"] = -1.0
    steady = view.spread < _MAX_SPEED_VARIATION * abs(view.mean)
    opposed = min((relations.opposed(number, other) for other in every if other != number), default=0.0)
    turning = [
        other
        for other in every
        if other != number
        and not len(guesses[other].features.pulses)
        and relations.quadrature(number, other) is not None
    ]
    if turning and opposed > _MAX_LIKENESS:
        wave["length"] = 4.0
    elif each.volts and _PROBE_V[0] < view.mean < _PROBE_V[1] and view.spread < 0.3 * abs(view.mean):
        each.wave_reasons["length"] = f"rests at {view.mean:.3g} V, as a probe does"
        wave["length"] = 3.5
    if view.moves_in_bursts and opposed > _MAX_LIKENESS:
        each.wave_reasons["acceleration"] = "vibrates in bursts"
        wave |= {"acceleration": 4.0, "length": wave.get("length", 0.0) - 3.0}
    elif opposed < _MAX_LIKENESS:
        wave["force"] = 4.0
    if steady and opposed > _MAX_LIKENESS:
        wave["speed"] = 2.0 if each.name_parts.bare else 0.0
        rates = [rate_hz for rate_hz in pulse_rates if rate_hz]
        ratios = [view.mean / size / rate_hz for rate_hz in rates for _, size in _TURN_UNITS]
        if not each.volts and any(abs(ratio - 1.0) < _RATIO_TOLERANCE for ratio in ratios):
            each.wave_reasons["speed"] = "steady, and fits the pulse rate"
            wave["speed"] += 4.0
        elif each.name_parts.bare:
            each.wave_reasons["speed"] = "steady"
            wave["speed"] += 1.0
    return wave


def _turns_with(number: int, guesses: Sequence[Guess], relations: Relations) -> bool:
    """Return whether two other signals in quadrature turn at the rate of these pulses."""
    rate_hz, others = _pulse_rate_hz(guesses[number]), [each for each in range(len(guesses)) if each != number]
    found = (relations.quadrature(i, j) for i in others for j in others if i < j)
    line_hz = 1.0 / max(guesses[number].features.axis.last_s - guesses[number].features.axis.first_s, 1e-9)
    return any(each is not None and abs(each.hz - rate_hz) < 2.0 * line_hz for each in found)


def _pulse_rate_hz(each: Guess) -> float:
    """Return the rate of a regular pulse train [Hz]; 0 for other signals."""
    edges = each.features.edges
    return 1.0 / median(np.diff(edges).tolist()) if len(edges) else 0.0


def _channel_kind(channel: str) -> str:
    return next(kind for kind, family in FAMILIES.items() if channel in family)


def _explain(each: Guess, choice: Choice) -> None:
    """Set confidence, reasons and questions of a chosen channel."""
    kind, named = _channel_kind(choice.channel), each.name_parts
    each.kind = kind
    place, _, end = choice.channel.rpartition("_")
    words = [named.kind_word] * (named.kind in (kind, "tach")) + [place] * (named.place == place != "")
    words += [end] * (end in (named.axis, named.side) or (end in "EW" and named.side == "O"))
    reasons = [f"{_NAME}{word}" for word in words]
    reasons += [f"unit {each.own_unit}"] if units.get_quantity(each.own_unit) in _KIND_OF_UNIT else []
    single = len(family_of(choice.channel)) == 1
    if choice.kind_margin >= _SURE and (single or (choice.named >= _SURE and choice.margin >= _SURE)):
        confidence = SURE
    elif choice.kind_margin >= _LIKELY and (single or choice.margin >= _LIKELY):
        confidence = LIKELY
    else:
        confidence = ASK
    wave = each.wave_reasons.get(kind, "")
    ask = ""
    if choice.other and choice.named < _SURE and confidence != SURE:
        ask = f"or {choice.other}; the name has no {'side' if kind == 'force' else 'axis'}"
    each.assign(choice.channel, confidence, *reasons, wave, ask=ask)


def _explain_pairs(guesses: Sequence[Guess], relations: Relations, own: set[int]) -> None:
    """Add the relations to other signals as reasons."""
    chosen = {number: each.channel for number, each in enumerate(guesses) if each.channel}
    for rule, _, i, j in find_pairs(chosen):
        value = relations.measure(rule, i, j)
        if value < _MIN_REASON:
            continue
        for number, other in ((i, j), (j, i)):
            each, name = guesses[number], guesses[other].entry.name
            first = number == i
            text = {
                "against": f"against {name}" if each.kind == "force" else "",
                "loaded": f"loaded as {name} rises" if first else "",
                "relieved": f"relieved as {name} rises" if first else "", "leads": f"90° from {name}",
            }.get(rule, "")  # fmt: skip
            if rule == "leads" and (found := relations.first(i, j)) is not None:
                text += f" at {found.hz:.3g} Hz"
            if rule in ("farther", "stronger") and not each.name_parts.place:
                ratio = found.size if (found := relations.whole(i, j)) is not None else 1.0
                text = f"pairs move {ratio:.2g}:1, the {'disk' if rule == 'farther' else 'inner one'} more"
            kinds = [one for one in each.reasons if one.startswith(text.split(" ")[0])] if text else []
            if text and number not in own and not kinds:
                each.reasons.append(text)


def _choose_zeros(guesses: Sequence[Guess]) -> None:
    """Set the mean as zero of both probes of a pair, or of neither."""
    for place in _PAIRS["length"]:
        pair = [each for each in guesses if each.channel in (f"{place}_x", f"{place}_y") and not each.volts]
        if any(abs(each.features.mean) > 5.0 * each.features.spread for each in pair):
            for each in pair:
                each.bias = "mean"
                each.asks["bias"] = f"the zero of the {place}'s probes is not known; assumed: their means"
                each.confidence = max(each.confidence, LIKELY, key=_ORDER.index)
                each.reasons.append("zero: its mean")


def _check_turns(guesses: Sequence[Guess]) -> None:
    """Check keyphasor and speed against each other: pulses per turn, and the unit of the speed if the file has none."""
    pulse = next((each for each in guesses if each.channel == "keyphasor"), None)
    if pulse is None or len(pulse.features.pulses) < 2:
        return
    rate_hz = 1.0 / median((pulse.features.pulses[1:] - pulse.features.pulses[:-1]).tolist())
    speed = next((each for each in guesses if each.channel == "speed"), None)
    if speed is None or not speed.features.mean:
        pulse.reasons.append(f"{rate_hz:.4g} pulses a second")
        pulse.asks["pulses_per_turn"] = "no speed for a check"
        return
    if speed.volts:
        pulse.asks["pulses_per_turn"] = "the speed is in volts"
        return
    speed_unit = speed.own_unit if units.get_quantity(speed.own_unit) == "speed of rotation" else None
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


def _scale(each: Guess, unit: str, usual_v: float) -> None:
    """Determine unit, sensitivity and zero of a signal with a channel."""
    view = each.features
    low, high = view.extent
    if each.channel == "hammer" and view.is_hammer and view.mean - low > high - view.mean:
        each.sign = -1
        each.reasons.append("polarity: its pulses point down")
    if each.channel.startswith("P_") and not each.volts and view.mean < -3.0 * view.spread:
        each.sign = -1
        each.reasons.append("polarity: its preload is negative")
    text = f"{each.entry.name} {each.entry.label}"
    if unit == "1":
        if not each.volts and units.get_quantity(each.own_unit) != "number":
            each.unit = "1"
            each.reasons.append(f"only the pulses are used, and not the unit {each.entry.unit!r}")
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
            scale = units.size_si(bias[2]) / units.size_si(each.own_unit)
            each.bias = round(float(bias[1].replace(",", ".")) * scale, 9)
            each.reasons.append(f"in the file: bias {each.bias:g} {each.own_unit}")
        elif units.get_quantity(unit) == "length":
            each.bias = "mean"
            each.reasons.append("zero: its mean")
    else:
        _check_unit(each, unit)


def _check_unit(each: Guess, unit: str) -> None:
    """Choose a unit for a signal without a known one, by its size; ask if the size is implausible."""
    wanted, low, high = _PLAUSIBLE[each.channel.partition("_")[0]]
    extent = each.features.extent
    peak = max(abs(value - each.features.median) for value in extent)
    size = peak if wanted in ("mm", "m/s^2") or each.channel == "hammer" else abs(each.features.mean)
    quantity = units.get_quantity(unit)

    def misfit(name: str) -> float:
        value = size * units.size_si(name) / units.size_si(wanted)
        return max(low / max(value, 1e-300), value / high, 1.0)

    if units.get_quantity(each.own_unit) != quantity:
        choices = (unit, *_UNIT_CHOICES[wanted])
        each.unit = min(choices, key=misfit)
        each.asks["unit"] = f"the file says {each.entry.unit!r}" if each.entry.unit else "the file has none"
        each.confidence = max(each.confidence, LIKELY, key=_ORDER.index)
    if misfit(each.own_unit) > 1.0:
        value = size * units.size_si(each.own_unit) / units.size_si(wanted)
        each.asks["unit"] = f"{value:.3g} {wanted} is not plausible"
        each.asks["unit"] += ": the ring's clearance is 0.93 mm" if wanted == "mm" else ""
        each.confidence = max(each.confidence, LIKELY, key=_ORDER.index)
    if "unit" in each.asks:
        each.confidence = max(each.confidence, LIKELY, key=_ORDER.index)
