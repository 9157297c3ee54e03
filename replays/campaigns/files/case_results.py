"""What a case has left, and what all expectations share: names, sources, limits with units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, FiniteFloat

from replays.campaigns.measurement import Must
from rig.base import units as units_of
from rig.base.checks import Written

if TYPE_CHECKING:
    from recorder.reader import Recording
    from replays.score.card.scorecard import Scorecard
    from rig.base.samples import Samples

Time = Annotated[FiniteFloat, Field(ge=0.0, le=86_400.0)]
Units = Mapping[str, Mapping[str, str]]
"""Units of columns by table: "" for the channels, else a table of the truth."""


class Expected(Written):
    """What every expectation may say."""

    name: str = ""
    source: str = ""
    when: dict[str, Any] = Field(default={})
    """Only in the cases that have these values, or one of several, on the matrix's axes."""


@dataclass
class Seen:
    """What a case has left: its recording, in time of the case.

    Attributes:
        recording: All that the rig sent.
        folder: Where the device under test has put its files.
        origin_s: Simulated time at which the case began [s].
    """

    recording: Recording
    folder: Path
    origin_s: float = 0.0
    _cards: dict[tuple[Any, ...], Scorecard] = field(default_factory=dict)
    _rows: dict[tuple[str, tuple[str, ...]], Samples] = field(default_factory=dict)

    @property
    def tick_rate_hz(self) -> float:
        """Ticks a simulated second [Hz]."""
        return float(self.recording.catalogue["tick_rate_hz"])

    def tick(self, time_s: float) -> int:
        """A time of the case to the nearest tick of the case."""
        return round(time_s * self.tick_rate_hz)

    @cached_property
    def units(self) -> Units:
        """Units of the channels, and of the tables of the truth, that were recorded."""
        tables = self.recording.catalogue.get("truth", {})
        channels = {name: channel.unit for name, channel in self.recording.table.channels.items()}
        truth = {name: {one["name"]: one["unit"] for one in table["columns"]} for name, table in tables.items()}
        return {"": channels, **truth}

    @cached_property
    def events(self) -> list[tuple[float, dict[str, Any]]]:
        """Events with their times, in order of these [s of the case]."""
        rate, origin = self.tick_rate_hz, round(self.origin_s * self.tick_rate_hz)
        timed = [(event["tick"] - origin, event) for event in self.recording.events if event.get("tick") is not None]
        return [(tick / rate, event) for tick, event in sorted(timed, key=lambda each: each[0])]

    def rows(self, truth: str, names: tuple[str, ...]) -> Samples:
        """Rows of channels, or of a table of the truth."""
        key = truth, names
        if key not in self._rows:
            found = self.recording.truth(truth) if truth else self.recording.samples(*names)
            self._rows[key] = found.only(*names)
        return self._rows[key]

    def card(
        self, file: str, limits: str | None, path: Literal["digital", "analogue"] | None,
        channels: tuple[str, ...] | None = None,
    ) -> Scorecard:  # fmt: skip
        """The scorecard of a file in the folder."""
        from replays.score.card.limits import load_limits
        from replays.score.judgement import judge

        key = file, limits, path, channels
        if key not in self._cards:
            sent = [part.path for part in self.recording.parts]
            asked = load_limits(limits)
            self._cards[key] = judge(self.folder / file, sent, limits=asked, path=path, channels=channels)
        return self._cards[key]


def asked(text: str, unit: str, *, where: str, of: str) -> Must:
    """What is asked, kept in the unit that it is asked in where that says more, such as ms of a time."""
    field = f"{where}.must"
    asked = Must.parse(text, field=field)
    asked.within(unit, field=field, of=of)
    return asked


def in_unit(value: float, unit: str, must: Must) -> float:
    """A value in the unit that it is asked in; without the last digits, which conversions and times leave."""
    same = units_of.canonical(unit) == units_of.canonical(must.unit)
    scale = 1.0 if same else units_of.size_si(unit) / units_of.size_si(must.unit)
    return float(f"{value * scale:.12g}")
