"""Expectations of a campaign file about a recording: signals, events, order of events, scorecards."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field

from replays.campaigns.files.case_results import CaseRecording, Expected, Time, Units, convert_unit, parse_limit
from replays.campaigns.files.scored import ExpectScore
from replays.campaigns.measurement import Measurement, Must, quantity
from rig.base.checks import Written
from rig.base.errors import InputError, UnknownNameError, Words
from rig.run.commands.table import EVENT_KINDS
from rig.serve.service import REPLAY_COMMANDS

Take = Literal[
    "peak", "max", "min", "mean", "rms", "std", "peak to peak", "value", "first beyond", "last beyond", "time beyond",
    "whirl frequency",
]  # fmt: skip
_TIMES = ("first beyond", "last beyond", "time beyond")
_NOT_NEGATIVE = ("peak", "rms", "std", "peak to peak", "time beyond")
"""Values that are never negative; nor is the radius of an orbit."""
if TYPE_CHECKING:
    EventName = str
else:
    EventName = Literal[*EVENT_KINDS, *REPLAY_COMMANDS]
    """Events of a rig or a replay."""


def _flatten_tables(where: dict[str, Any]) -> dict[str, Any]:
    """Return a table with dotted names in place of tables in it, as `request.speed_hz = 0.0` is written in TOML."""
    found = {}
    for name, value in where.items():
        inner = _flatten_tables(value) if isinstance(value, dict) else {}
        found |= {f"{name}.{key}": each for key, each in inner.items()} if inner else {name: value}
    return found


Where = Annotated[dict[str, Any], AfterValidator(_flatten_tables)]


class _SignalFields(Written):
    signal: str | list[str] = ""
    truth: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        return (self.signal,) if isinstance(self.signal, str) else tuple(self.signal)

    def unit(self, units: Units, *, where: str) -> str:
        """Return the unit of the signal, or of both signals of an orbit.

        Raises:
            InputError: If the signal is unknown, or the two signals have different units.
        """
        if self.truth and self.truth not in units:
            tables = [name for name in units if name]
            raise UnknownNameError(f"{where}.truth", "one of the tables of the truth", self.truth, tables)
        if len(self.names) not in (1, 2):
            raise InputError(f"{where}.signal", "a name, or the two of an orbit", list(self.names))
        signal_units = units[self.truth]
        for name in self.names:
            if name not in signal_units:
                what = f"a column of {self.truth}" if self.truth else "one of the channels"
                raise UnknownNameError(f"{where}.signal", what, name, signal_units)
        if len({signal_units[name] for name in self.names}) > 1:
            received = Words(" and ".join(f"{name} in {signal_units[name]}" for name in self.names))
            raise InputError(f"{where}.signal", "two of one unit", received)
        return signal_units[self.names[0]]

    def level(self, unit: str, *, where: str = "") -> float:
        """Return the level `beyond` in the unit of the signal.

        Raises:
            InputError: If it is negative, or its unit is missing or wrong.
        """
        beyond: str = getattr(self, "beyond", "")
        level = quantity(beyond, unit, field=f"{where}.beyond", of=_name(self.names))
        if level < 0.0:
            raise InputError(f"{where}.beyond", "at least 0, as an absolute value is compared with it", beyond)
        return level

    def values(self, recording: CaseRecording) -> tuple[np.ndarray, np.ndarray]:
        """Return times from the start of the case [s] and values, for an orbit its radius, each of shape (n,)."""
        rows = recording.rows(self.truth, self.names)
        columns = [rows[name] for name in self.names]
        return rows.times_s - recording.origin_s, columns[0] if len(columns) == 1 else np.hypot(*columns)


class EventOf(Written):
    """An event, selected by its name and its fields: `where` compares fields and searches lists."""

    event: EventName
    where: Where = Field(default={})
    text: str = ""

    def __str__(self) -> str:
        about = [f"{name}={value}" for name, value in self.where.items()] + [self.text]
        return " ".join([self.event, *filter(None, about)])

    def times_s(self, recording: CaseRecording) -> list[float]:
        """Return the times of the event, from the start of the case [s]."""
        return [time_s for time_s, event in recording.events if self.matches(event, recording.device_names)]

    def list_senders(self, recording: CaseRecording) -> str:
        """Return who sent such events, whatever `from` is; empty if there are none, or if `from` is not compared."""
        if "from" not in self.where:
            return ""
        any_sender = {name: value for name, value in self.where.items() if name != "from"}
        of, events = self.model_copy(update={"where": any_sender}), recording.events
        return ", ".join(sorted({str(event["from"]) for _, event in events if of.matches(event, {})}))

    def matches(self, event: Mapping[str, Any], device_names: Mapping[str, str]) -> bool:
        """Return whether an event is selected; `from` compares both names of a device on a CAN bus."""
        if event.get("event") != self.event or self.text not in str(event.get("text", "")):
            return False
        for name, wanted in self.where.items():
            place: Any = event
            for part in name.split("."):
                place = place.get(part) if isinstance(place, Mapping) else None
            sender = device_names.get(str(place)) if name == "from" else place
            if wanted not in (place, sender) and not (isinstance(place, list) and wanted in place):
                return False
        return True


class Since(_SignalFields):
    """Origin of a time: a time of the case, an event, or the first sample beyond a level."""

    at_s: Time | None = None
    event: EventName | Literal[""] = ""
    where: Where = Field(default={})
    text: str = ""
    beyond: str = ""

    def check(self, units: Units, *, where: str) -> None:
        """Check that exactly one origin is given.

        Raises:
            InputError: If it is not, or if the unit of the level is missing or wrong.
        """
        origins = [name for name in ("at_s", "event", "signal") if getattr(self, name) not in (None, "", [])]
        if len(origins) != 1:
            raise InputError(where, "given by one of at_s, event and signal", Words(" and ".join(origins) or "none"))
        owners = {"where": "event", "text": "event", "beyond": "signal", "truth": "signal"}
        for name, owner in owners.items():
            if getattr(self, name) and owner not in origins:
                raise InputError(f"{where}.{name}", f"left out without {owner}", getattr(self, name))
        if self.signal:
            self.level(self.unit(units, where=where), where=where)

    @property
    def of(self) -> EventOf:
        """Selector of the event."""
        return EventOf(event=self.event, where=self.where, text=self.text)

    def time_s(self, recording: CaseRecording, units: Units, *, from_s: float) -> float:
        """Return the time of the origin, from the start of the case [s]; NaN if it does not occur."""
        if self.at_s is not None:
            return self.at_s
        if self.event:
            return next((each for each in self.of.times_s(recording) if each >= from_s), math.nan)
        times_s, values = self.values(recording)
        level = self.level(self.unit(units, where=""))
        rows = np.flatnonzero((np.abs(values) > level) & (times_s >= from_s - 1e-9))
        return float(times_s[rows[0]]) if len(rows) else math.nan


class _Within(Expected):
    from_s: Time = 0.0
    to_s: Time | None = None


class ExpectSignal(_SignalFields, _Within):
    """A value computed from a signal between two times."""

    take: Take = "peak"
    at_s: Time | None = None
    beyond: str = ""
    since: Since | None = None
    must: str

    def check(self, units: Units, *, where: str) -> Must:
        """Return the limit and check that its unit fits the computed value.

        Raises:
            InputError: If the signal, level or limit is invalid.
        """
        unit = self.unit(units, where=where)
        if (self.take in _TIMES) != bool(self.beyond):
            must = "given for" if self.take in _TIMES else "left out, except for the times"
            raise InputError(f"{where}.beyond", f"{must} {', '.join(_TIMES)}", self.beyond or None)
        if self.beyond:
            self.level(unit, where=where)
            unit = "s"
        if (self.take == "value") != (self.at_s is not None):
            must = "given where take is value" if self.at_s is None else "left out, unless take is value"
            raise InputError(f"{where}.at_s", must, self.at_s)
        for name in ("from_s", "to_s") if self.at_s is not None else ():
            if getattr(self, name):
                raise InputError(f"{where}.{name}", "left out with at_s", getattr(self, name))
        if self.take == "whirl frequency":
            if len(self.names) != 2:
                raise InputError(f"{where}.signal", "the two of an orbit for a whirl frequency", list(self.names))
            unit = "Hz"
        if self.since is not None:
            if self.take not in ("first beyond", "last beyond"):
                raise InputError(f"{where}.since", "left out, unless take is first beyond or last beyond", self.take)
            self.since.check(units, where=f"{where}.since")
        must = parse_limit(self.must, unit, where=where, of=self.label)
        if self.take in _NOT_NEGATIVE or (len(self.names) == 2 and self.take in ("max", "min", "mean", "value")):
            must.check_decides(whole=False, field=f"{where}.must", of=self.label)
        return must

    @property
    def label(self) -> str:
        """Name of the measurement."""
        level = f" {self.beyond}" if self.beyond else ""
        at = f" at {self.at_s:g} s" if self.at_s is not None else ""
        return self.name or f"{self.take}{level} of {_name(self.names)}{at}"

    def measure(self, recording: CaseRecording, units: Units) -> Iterator[Measurement]:
        """Yield the measurement from the recording."""
        must = self.check(units, where="expect")
        value, at_s, note = self._value(recording, units)
        row_s = 1.0 / recording.rows(self.truth, self.names).rate_hz
        unit = "s" if self.beyond else "Hz" if self.take == "whirl frequency" else self.unit(units, where="expect")
        exact = f"1 row, {1e6 * row_s:g} us" if self.beyond else ""
        channels = () if self.truth else self.names
        level = self.level(self.unit(units, where="")) if self.beyond else None
        yield Measurement(
            self.label, convert_unit(value, unit, must), must, self.source, exact, note, at_s, channels, level=level
        )

    def _value(self, recording: CaseRecording, units: Units) -> tuple[float, float | None, str]:
        times_s, values = self.values(recording)
        if self.at_s is not None:
            row = int(np.argmin(np.abs(times_s - self.at_s)))
            if abs(times_s[row] - self.at_s) > 1.0 / recording.rows(self.truth, self.names).rate_hz:
                return math.nan, None, "no row at this time"
            return float(values[row]), float(times_s[row]), ""
        kept = (times_s >= self.from_s - 1e-9) & (times_s < (math.inf if self.to_s is None else self.to_s) - 1e-9)
        times_s, part = times_s[kept], values[kept]
        if not len(part):
            return math.nan, None, "no rows between these times"
        if self.take == "whirl frequency":
            from rig.channels.orbit import whirl_frequency

            x, y = (recording.rows(self.truth, self.names)[name][kept] for name in self.names)
            return whirl_frequency(x, y, times_s), float(times_s[0]), ""
        if self.beyond:
            rows = np.flatnonzero(np.abs(part) > self.level(self.unit(units, where="")))
            if self.take == "time beyond":
                rate = recording.rows(self.truth, self.names).rate_hz
                return len(rows) / rate, float(times_s[rows[0]]) if len(rows) else None, ""
            if not len(rows):
                return math.nan, None, f"it never exceeds {self.beyond}"
            at_s = float(times_s[rows[0] if self.take == "first beyond" else rows[-1]])
            if self.since is None:
                return at_s, at_s, ""
            since_s = self.since.time_s(recording, units, from_s=self.from_s)
            note = "" if math.isfinite(since_s) else "the origin of the time never occurred"
            return at_s - since_s, at_s, note
        row = {"max": part.argmax, "min": part.argmin}.get(self.take, np.abs(part).argmax)()
        value = _STATISTICS[self.take](part)
        return float(value), float(times_s[int(row)]), ""


_STATISTICS: dict[str, Callable[[np.ndarray], Any]] = {
    "peak": lambda values: np.abs(values).max(),
    "max": np.max,
    "min": np.min,
    "mean": np.mean,
    "rms": lambda values: math.sqrt(float(np.mean(values**2))),
    "std": np.std,
    "peak to peak": np.ptp,
}


class ExpectEvent(_Within):
    """An event that must occur, must not occur, or must occur at a certain time."""

    event: EventName
    where: Where = Field(default={})
    text: str = ""
    appears: bool = True
    take: Literal["time", "count"] = "time"
    since: Since | None = None
    must: str = ""

    def check(self, units: Units, *, where: str) -> Must:
        """Return the limit of the event's time or of the number of its occurrences.

        Raises:
            InputError: If the limit or the origin of the time is invalid.
        """
        if self.since is not None:
            self.since.check(units, where=f"{where}.since")
            if not self.must or self.take == "count":
                must = "left out without must" if not self.must else "left out where take is count"
                raise InputError(f"{where}.since", must, Words("given"))
        if not self.must:
            return Must("==" if not self.appears else ">=", 0.0 if not self.appears else 1.0, "1")
        if not self.appears:
            raise InputError(f"{where}.appears", "left out with must", False)
        must = parse_limit(self.must, "1" if self.take == "count" else "s", where=where, of=self.label)
        if self.take == "count":
            must.check_decides(whole=True, field=f"{where}.must", of=self.label)
        return must

    @property
    def of(self) -> EventOf:
        """Selector of the event."""
        return EventOf(event=self.event, where=self.where, text=self.text)

    @property
    def label(self) -> str:
        """Name of the measurement."""
        what = "time" if self.must and self.take == "time" else "number"
        return self.name or f"{what} of {self.of}"

    def measure(self, recording: CaseRecording, units: Units) -> Iterator[Measurement]:
        """Yield the measurement from the recording."""
        must = self.check(units, where="expect")
        to_s = math.inf if self.to_s is None else self.to_s
        times_s = [each for each in self.of.times_s(recording) if self.from_s <= each < to_s]
        if not self.must or self.take == "count":
            at_s = times_s[0] if times_s else None
            note = f"at {_list_times(times_s)}" if times_s else ""
            yield Measurement(self.label, float(len(times_s)), must, self.source, note=note, at_s=at_s)
            return
        exact = "1 tick, 1 us"
        since_s = 0.0 if self.since is None else self.since.time_s(recording, units, from_s=self.from_s)
        # The origin causes the event, so an event before the origin is a different one.
        at_s = next((each for each in times_s if not each < since_s), math.nan)
        note = "" if math.isfinite(at_s) else f"no {self.of} occurred"
        if note and not times_s and (senders := self.of.list_senders(recording)):
            note += f", only from {senders}"
        if note and times_s:
            note += f" after {since_s:g} s; {len(times_s)} before, at {_list_times(times_s)}"
        note = "the origin of the time never occurred" if math.isnan(since_s) else note
        value = math.nan
        if math.isfinite(at_s - since_s):
            value = (recording.tick(at_s) - recording.tick(since_s)) / recording.tick_rate_hz
        about = at_s if math.isfinite(at_s) else since_s
        channels = () if self.since is None or self.since.truth or not self.since.signal else self.since.names
        since, level = self.since, None
        if since is not None and channels:
            level = since.level(since.unit(units, where=""))
        yield Measurement(
            self.label, convert_unit(value, "s", must), must, self.source, exact, note,
            about if math.isfinite(about) else None, channels,
            since_s=since_s if since is not None and math.isfinite(since_s) else None, level=level,
        )  # fmt: skip


class ExpectOrder(_Within):
    """Events that must occur in a certain order."""

    order: Annotated[list[EventOf], Field(min_length=2)]

    def check(self, units: Units, *, where: str) -> Must:
        """Return the limit: all events in order."""
        return Must("==", float(len(self.order)), "1")

    @property
    def label(self) -> str:
        """Name of the measurement."""
        return self.name or f"events in order: {', then '.join(map(str, self.order))}"

    def measure(self, recording: CaseRecording, units: Units) -> Iterator[Measurement]:
        """Yield the number of events that occurred in order."""
        at_s, count, note = self.from_s, 0, ""
        to_s = math.inf if self.to_s is None else self.to_s
        for each in self.order:
            later = [time_s for time_s in each.times_s(recording) if at_s <= time_s < to_s]
            if not later:
                note = f"no {each} occurred after {at_s:g} s"
                break
            at_s, count = later[0], count + 1
        yield Measurement(self.label, float(count), self.check(units, where=""), self.source, note=note, at_s=at_s)


Expect = ExpectSignal | ExpectEvent | ExpectOrder | ExpectScore
KINDS: dict[str, type[Expect]] = {
    "signal": ExpectSignal, "event": ExpectEvent, "order": ExpectOrder, "score": ExpectScore,
}  # fmt: skip
"""Expectations by the key that selects them."""


def expected_events(expects: Iterable[Expect]) -> Iterator[EventOf]:
    """Yield the expected events, single or in an order."""
    for expect in expects:
        if isinstance(expect, ExpectOrder):
            yield from expect.order
        elif isinstance(expect, ExpectEvent) and expect.appears:
            yield expect.of


def _list_times(times_s: list[float]) -> str:
    return f"{', '.join(f'{each:g}' for each in times_s[:5])}{', ...' if len(times_s) > 5 else ''} s"


def find_selectors(expect: Expect) -> Iterator[tuple[str, EventOf]]:
    """Yield all events of an expectation, each with its field: expected, not expected, and the origin of a time."""
    if isinstance(expect, ExpectOrder):
        yield from ((f".order.{n}", each) for n, each in enumerate(expect.order))
    if isinstance(expect, ExpectEvent):
        yield "", expect.of
    since = None if isinstance(expect, ExpectOrder | ExpectScore) else expect.since
    if since is not None and since.event:
        yield ".since", since.of


def _name(names: tuple[str, ...]) -> str:
    return names[0] if len(names) == 1 else f"the orbit of {' and '.join(names)}"
