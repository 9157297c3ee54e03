"""The mapping file of `rig import`: which signal becomes which channel, and what is done to it. TOML, checked."""

from __future__ import annotations

import json
import re
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveFloat, field_validator

from rig.base import units
from rig.base.checks import check, read_toml
from rig.base.errors import InputError

_EPOCH = re.compile(r"\b(unix|epoch|posix|since|from|the|1970(-01-01)?|utc)\b", re.IGNORECASE)
"""Words about the zero of a time, which its unit does not depend on."""
_EPOCH_UNITS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""Least numbers that are no seconds since 1970 of this millennium, and what they are: 1e11 s is the year 5138, and
1e11 ms, 1e14 us and 1e17 ns are March 1973."""


_ONLY_TEXT = (
    "delimiter", "decimal", "thousands", "header_line", "units_line", "first_line", "encoding", "time_format",
)  # fmt: skip
"""Options that mean nothing for other files."""


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class FileOptions(_Section):
    """How a file is read, where it does not say so itself."""

    delimiter: str | None = None
    """One character, or tab, comma, semicolon, space."""
    decimal: Literal[".", ","] | None = None
    thousands: Literal[",", ".", " ", "'"] | None = None
    """What stands between groups of three digits."""
    header_line: Annotated[int, Field(ge=0)] | None = None
    """Line of the names, from 1; 0: there is none, and the columns are called "column 1" and so on."""
    units_line: Annotated[int, Field(ge=1)] | None = None
    first_line: Annotated[int, Field(ge=1)] | None = None
    """First line of data, from 1."""
    encoding: str | None = None
    missing: tuple[str, ...] = ()
    """More texts that stand for no value."""
    time_column: str | Annotated[int, Field(ge=1)] | None = None
    """Column of times, by name or number from 1; "none": there is none."""
    time_unit: str | None = None
    """s, ms, us, ns, min, h, d, or datetime."""
    time_format: str | None = None
    """Format of times that are neither numbers, nor ISO 8601, nor h:m:s, as for Python's strptime."""

    @field_validator("delimiter")
    @classmethod
    def _one_character(cls, delimiter: str | None) -> str | None:
        if delimiter is not None and len(delimiter) != 1 and delimiter not in ("tab", "comma", "semicolon", "space"):
            raise ValueError("one character, or tab, comma, semicolon, space")
        return delimiter

    @field_validator("time_unit")
    @classmethod
    def _known_unit(cls, unit: str | None) -> str | None:
        if unit not in (None, "datetime") and units.kind(_EPOCH.sub("", unit)) != "time":
            raise ValueError("s, ms, us, ns, min, h, d or datetime")
        return unit

    def only_for_text(self, path: Path) -> None:
        """Refuse options that mean nothing for a file's format.

        Raises:
            InputError: The first such option.
        """
        for name in _ONLY_TEXT:
            if getattr(self, name) is not None:
                raise InputError(f"file.{name}", f"left out with {path.suffix} files", getattr(self, name))

    def time_in_s(self, name: str, told: str, first: float) -> tuple[str, float]:
        """Return the unit of a column of times that are numbers, and its size [s].

        It is as given here, else as the heading has it ("Time [ms]", "time_ms"), else seconds, but for numbers that
        can only be a time since 1970 in ms, us or ns.

        Args:
            name: Name of the column.
            told: Its unit by the file; empty where it has none.
            first: Its first number.

        Raises:
            InputError: The file's unit is none of a time, or ambiguous.
        """
        words = re.split(r"[ _]+", name.strip())
        named = words[1] if len(words) == 2 and units.kind(words[1]) == "time" else ""
        unit = _EPOCH.sub("", (self.time_unit if self.time_unit != "datetime" else None) or told or named).strip()
        unit = unit or next((each for least, each in _EPOCH_UNITS if least <= first), "s")
        if units.kind(unit) != "time":
            must = "given (s, ms, us, ns, min, h, d), as the unit of the column of times is unknown or ambiguous"
            raise InputError("file.time_unit", must, told)
        return units.canonical(unit), units.size_si(unit)


class TimeOptions(_Section):
    """The time axis of the source."""

    rate_hz: PositiveFloat | None = None
    """Sample rate [Hz], where the file tells none or a rounded one; its time stamps are then not used."""
    stamps: Literal["as-is", "line"] = "as-is"
    """As they stand, or the straight line through them: samples came evenly, and only the stamps jitter."""
    from_s: FiniteFloat | None = None
    """Start of what is imported, in the time of the first file [s]."""
    to_s: FiniteFloat | None = None
    """End of it [s]."""
    start: datetime | None = None
    """When the source's time zero was."""


class Resample(_Section):
    """Another sample rate, or even samples out of uneven ones."""

    method: Literal["none", "polyphase", "linear"] = "none"
    rate_hz: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """Rate of the recording [Hz]; left out: that of the source."""


class SignalName(_Section):
    """A signal of the source."""

    source: str
    """Its name in the file."""
    group: str | None = None
    """The file's group that it stands in, where the name is not enough."""
    file: str | None = None
    """Name of the file, where there are several."""


class ChannelMapping(SignalName):
    """How one signal becomes one channel: value = sign * factor * (source - bias), in the channel's unit."""

    unit: str | None = None
    """Unit of the source; left out: as the file tells. For `rig score` also FS: fractions of the converter's range."""
    bits: Annotated[int, Field(ge=8, le=32)] | None = None
    """Of whole numbers that a converter has, in place of a unit; only for `rig score`."""
    sensitivity: str | None = None
    """For a source in volts, such as "7.87 V/mm" or "200 mV/mil"."""
    sign: Literal[1, -1] = 1
    factor: FiniteFloat = 1.0
    """Anything else to multiply by."""
    bias: FiniteFloat | Literal["mean"] = 0.0
    """Source value at zero, in its unit, or the mean of what is imported."""
    delay_us: FiniteFloat = 0.0
    """How late the source shows what happened [us]: a filter, a multiplexer."""
    bandwidth_hz: PositiveFloat | None = None
    """Corner of the low-pass before the converter [Hz]; left out: half of the rate, as nothing is known of it."""
    highpass_hz: Annotated[FiniteFloat, Field(ge=0.0)] = 0.0
    """Corner of an AC coupling [Hz]; 0: none."""
    full_scale: PositiveFloat | None = None
    """Source value (its amount, in its unit) from which on a sample counts as overrange."""
    missing: Literal["gap", "hold", "refuse"] = "gap"
    """Values that are no numbers: their rows are left out, the last good value stands in, or the import is refused."""
    to: str | None = None
    """Sensor group of a channel that is none of the rig's own, ..."""
    to_unit: str | None = None
    """... and its unit."""
    label: str | None = None

    @field_validator("factor")
    @classmethod
    def _not_zero(cls, factor: float) -> float:
        if factor == 0.0:
            raise ValueError("another number than 0")
        return factor


class Defaults(_Section):
    """What holds for all channels that do not say it themselves."""

    bandwidth_hz: PositiveFloat | None = None
    """Corner of the low-pass before the converter [Hz]."""


class Rotate(_Section):
    """Two probes at any two angles as horizontal and vertical."""

    channels: tuple[str, str]
    """The channels that the two probes are mapped to; they become x and y."""
    angles_deg: tuple[FiniteFloat, FiniteFloat]
    """Where each probe sits: direction of its positive values, from x (EAST) toward y (up) [degrees]."""


class Align(_Section):
    """Brings two clocks together by what both have recorded."""

    reference: SignalName
    moved: SignalName
    """Everything in the file of this signal moves, or everything in its group with scope "group"."""
    scope: Literal["file", "group"] = "file"
    method: Literal["edge", "correlation"] = "edge"
    threshold: FiniteFloat | None = None
    """Level of the edge, in both signals' own unit; left out: half way between the lowest and the highest value."""
    within_s: PositiveFloat = 10.0
    """Largest shift to look for [s]."""


class KeyphasorMapping(SignalName):
    """The pulse train that becomes the exact edges."""

    threshold: FiniteFloat | None = None
    """Level of the edge in the signal's unit; left out: half way between the lowest and the highest value."""
    edge: Literal["rising", "falling"] = "rising"
    hysteresis: Annotated[FiniteFloat, Field(ge=0.0)] | None = None
    """How far the signal must fall back before the next edge counts; left out: a tenth of its extent."""
    pulses_per_turn: Annotated[int, Field(ge=1)] = 1


class HammerMapping(_Section):
    """Pulses of the hammer, found in the channel `hammer`."""

    threshold_n: PositiveFloat = 10.0
    """Force from which on it is a hammer pulse [N]."""
    dead_s: PositiveFloat | None = None
    """Time after a hammer pulse in which no other one counts [s]; left out: 0.1, but for a pulse clearly of its own."""
    pre_s: Annotated[FiniteFloat, Field(ge=0.0)] | None = None
    """The recording begins so long before the first hammer pulse [s]."""
    delay_us: FiniteFloat = 0.0
    """How late the channel shows it [us], as by a filter; only the hammer pulse's time changes, no sample moves."""
    direction: str | float = "x"
    """Where it hits, as in a scene."""


class ExperimentMapping(_Section):
    """What was done, as a scene, so that it can be simulated."""

    scene: str
    """Name of a scene, or the path of a file."""
    set: dict[str, Any] = {}
    """Changes of the scene or its parameters, by dotted key."""
    speed_hz: FiniteFloat | Literal["measured"] | None = None
    """Speed of the drive [Hz]; measured: by the channel `speed`, the edges, or the probes, before the first pulse. Left
    out: the scene's."""
    commands: tuple[dict[str, Any], ...] | Literal["scene", "detected"] = "scene"
    """Commands with at_s in the recording's time; those of the scene; or the hammer pulses that were found."""
    lead_s: Annotated[FiniteFloat, Field(ge=0.0, le=60.0)] | None = None
    """The scene began so long before the first sample [s]. Left out: with the first sample; where commands are not the
    scene's own, the rig was running before, and where its shaft was, the samples tell."""


class Mapping(_Section):
    """A mapping file."""

    file: FileOptions = FileOptions()
    time: TimeOptions = TimeOptions()
    resample: Resample = Resample()
    defaults: Defaults = Defaults()
    channels: dict[str, ChannelMapping] = Field(min_length=1)
    rotate: tuple[Rotate, ...] = ()
    align: tuple[Align, ...] = ()
    keyphasor: KeyphasorMapping | None = None
    hammer: HammerMapping | None = None
    experiment: ExperimentMapping | None = None

    def document(self) -> dict[str, Any]:
        """As JSON, without what is left at its default."""
        return json.loads(self.model_dump_json(exclude_defaults=True))


def load_mapping(path: Path) -> Mapping:
    """Read and check a mapping file.

    Raises:
        InputError: The first thing that is wrong, with file and field.
    """
    return parse_mapping(read_toml(path), name=path.name)


def parse_mapping(data: dict[str, Any], *, name: str) -> Mapping:
    """Check a mapping, and give its channels what holds for all.

    Args:
        data: As it stands in TOML.
        name: What errors call it.

    Raises:
        InputError: The first thing that is wrong, with its field.
    """
    try:
        mapping = check(Mapping, data, field="")
    except InputError as first:
        raise InputError(f"{name}: {first.field}", first.must, first.received) from None
    time = mapping.time
    if time.from_s is not None and time.to_s is not None and time.to_s <= time.from_s:
        raise InputError(f"{name}: time.to_s", f"after time.from_s = {time.from_s:g}", time.to_s)
    for entry in mapping.rotate:
        for channel in entry.channels:
            if channel not in mapping.channels:
                raise InputError(f"{name}: rotate.channels", "mapped under [channels]", channel)
    if mapping.hammer is not None and "hammer" not in mapping.channels:
        raise InputError(f"{name}: hammer", "left out without a channel `hammer` under [channels]", "[hammer]")
    experiment = mapping.experiment
    if experiment is not None and experiment.commands == "detected" and mapping.hammer is None:
        raise InputError(f"{name}: experiment.commands", "used with a table [hammer]", "detected")
    if mapping.defaults.bandwidth_hz is None:
        return mapping
    corner = {"bandwidth_hz": mapping.defaults.bandwidth_hz}
    told = {
        channel: entry if entry.bandwidth_hz is not None else entry.model_copy(update=corner)
        for channel, entry in mapping.channels.items()
    }
    for channel, entry in told.items():
        if mapping.channels[channel].bandwidth_hz is None:
            entry.model_fields_set.discard("bandwidth_hz")  # no word of its own: the import holds it against the rate
    return mapping.model_copy(update={"channels": told})
