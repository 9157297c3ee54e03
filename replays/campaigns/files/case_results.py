"""Recording of a case, and what all expectations share: names, sources, limits with units."""

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
from rig.base.errors import InputError

if TYPE_CHECKING:
    from recorder.reader import Recording
    from replays.score.card.scorecard import Scorecard
    from rig.base.samples import Samples

Time = Annotated[FiniteFloat, Field(ge=0.0, le=86_400.0)]
Units = Mapping[str, Mapping[str, str]]
"""Units of columns by table: "" for the channels, otherwise the name of a truth table."""


class Expected(Written):
    """Fields that every expectation has."""

    name: str = ""
    source: str = ""
    when: dict[str, Any] = Field(default={})
    """Restricts the expectation to cases with these values on the axes of the matrix: one value or a list per axis."""


@dataclass
class CaseRecording:
    """The recording of a case, and the files of the device under test.

    Attributes:
        recording: All that the rig sent.
        folder: Folder with the files of the device under test.
        origin_s: Simulated time at which the case began [s].
        device_names: Names of the devices in the campaign, by those on a CAN bus, such as "CAN 7".
    """

    recording: Recording
    folder: Path
    origin_s: float = 0.0
    device_names: Mapping[str, str] = field(default_factory=dict)
    _cards: dict[tuple[Any, ...], Scorecard] = field(default_factory=dict)
    _rows: dict[tuple[str, tuple[str, ...]], Samples] = field(default_factory=dict)

    @property
    def tick_rate_hz(self) -> float:
        """Ticks per simulated second [Hz]."""
        return float(self.recording.catalogue["tick_rate_hz"])

    def tick(self, time_s: float) -> int:
        """Return the tick nearest to a time, both counted from the start of the case."""
        return round(time_s * self.tick_rate_hz)

    @cached_property
    def units(self) -> Units:
        """Units of the recorded channels and truth tables."""
        tables = self.recording.catalogue.get("truth", {})
        channels = {name: channel.unit for name, channel in self.recording.table.channels.items()}
        truth = {name: {one["name"]: one["unit"] for one in table["columns"]} for name, table in tables.items()}
        return {"": channels, **truth}

    @cached_property
    def events(self) -> list[tuple[float, dict[str, Any]]]:
        """Events with their times from the start of the case [s], in order of time."""
        rate, origin = self.tick_rate_hz, round(self.origin_s * self.tick_rate_hz)
        timed = [(event["tick"] - origin, event) for event in self.recording.events if event.get("tick") is not None]
        return [(tick / rate, event) for tick, event in sorted(timed, key=lambda each: each[0])]

    def rows(self, truth: str, names: tuple[str, ...]) -> Samples:
        """Return samples of channels, or of a truth table."""
        key = truth, names
        if key not in self._rows:
            samples = self.recording.truth(truth) if truth else self.recording.samples(*names)
            self._rows[key] = samples.select(*names)
        return self._rows[key]

    def card(
        self, file: str, limits: str | None, path: Literal["digital", "analogue"] | None,
        channels: tuple[str, ...] | None = None,
    ) -> Scorecard:  # fmt: skip
        """Return the scorecard of a file in the folder."""
        from replays.score.card.limits import load_limits
        from replays.score.judgement import judge

        key = file, limits, path, channels
        if key not in self._cards:
            _check_no_symlinks(self.folder, file)
            sent = [part.path for part in self.recording.parts]
            loaded = load_limits(limits)
            self._cards[key] = judge(self.folder / file, sent, limits=loaded, path=path, channels=channels)
        return self._cards[key]


def _check_no_symlinks(folder: Path, file: str) -> None:
    """Refuse a device's file outside its folder, or behind a symbolic link, which could lead to any file.

    Raises:
        InputError: If the path leaves the folder or contains a symbolic link.
    """
    path = folder / file
    inside = [each for each in (path, *path.parents) if folder in each.parents]
    if not inside or ".." in Path(file).parts or any(each.is_symlink() for each in inside):
        raise InputError("file", "a file in {folder}, without symbolic links", file)


def parse_limit(text: str, unit: str, *, where: str, of: str) -> Must:
    """Parse a limit and check its unit; the limit keeps the unit of the text."""
    field = f"{where}.must"
    limit = Must.parse(text, field=field)
    limit.convert_to(unit, field=field, of=of)
    return limit


def convert_unit(value: float, unit: str, must: Must) -> float:
    """Convert a value to the unit of its limit, and remove the conversion's rounding errors."""
    same = units_of.canonical(unit) == units_of.canonical(must.unit)
    scale = 1.0 if same else units_of.size_si(unit) / units_of.size_si(must.unit)
    return float(f"{value * scale:.12g}")
