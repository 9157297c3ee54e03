"""Mapping file of `rig import` (TOML): assignment of signals to channels, and their processing."""

from __future__ import annotations

import json
import re
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveFloat, field_validator

from rig.base import units
from rig.base.checks import check, read_toml
from rig.base.errors import InputError, Words
from rig.channels.table import LINEAR_PHASE, ORDERS, FilterKind

_EPOCH = re.compile(r"\b(unix|epoch|posix|since|from|the|1970(-01-01)?|utc)\b", re.IGNORECASE)
"""Words for the origin of a time scale, which do not affect its unit."""
_EPOCH_UNITS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""Unit of epoch times by their least value. As seconds since 1970, 1e11 is the year 5138; 1e11 ms, 1e14 us and 1e17 ns
are March 1973."""


_TEXT_OPTIONS = (
    "delimiter", "decimal", "thousands", "header_line", "units_line", "first_line", "encoding", "time_format",
)  # fmt: skip
"""Options that apply to text files only."""


Degrees = Annotated[FiniteFloat, Field(ge=-360.0, le=360.0)]
"""Angle [degrees]; beyond a turn it is a typing error."""


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class FileOptions(_Section):
    """Options for reading a file that does not define them itself."""

    delimiter: str | None = None
    """Delimiter: one character, or tab, comma, semicolon, space."""
    decimal: Literal[".", ","] | None = None
    thousands: Literal[",", ".", " ", "'"] | None = None
    """Separator between groups of three digits."""
    header_line: Annotated[int, Field(ge=0)] | None = None
    """Line of the names, from 1; 0: no names, and columns are named "column 1" and so on."""
    units_line: Annotated[int, Field(ge=1)] | None = None
    first_line: Annotated[int, Field(ge=1)] | None = None
    """First line of data, from 1."""
    encoding: str | None = None
    missing: tuple[str, ...] = ()
    """Additional texts for a missing value."""
    time_column: str | Annotated[int, Field(ge=1)] | None = None
    """Time column, by name or number from 1; "none": no time column."""
    time_unit: str | None = None
    """Unit of the time column: s, ms, us, ns, min, h, d, excel d (serial days from 1900), or datetime."""
    time_format: str | None = None
    """Format for Python's strptime of times that are not numbers, ISO 8601 or h:m:s."""

    @field_validator("delimiter")
    @classmethod
    def _one_character(cls, delimiter: str | None) -> str | None:
        if delimiter is not None and len(delimiter) != 1 and delimiter not in ("tab", "comma", "semicolon", "space"):
            raise ValueError("one character, or tab, comma, semicolon, space")
        return delimiter

    @field_validator("time_unit")
    @classmethod
    def _known_unit(cls, unit: str | None) -> str | None:
        if unit not in (None, "datetime") and units.get_quantity(_EPOCH.sub("", unit)) != "time":
            raise ValueError("s, ms, us, ns, min, h, d, excel d or datetime")
        return unit

    def reject_text_options(self, path: Path) -> None:
        """Reject text-file options for a file of another format.

        Raises:
            InputError: The first such option.
        """
        for name in _TEXT_OPTIONS:
            if getattr(self, name) is not None:
                raise InputError(f"file.{name}", f"left out with {path.suffix} files", getattr(self, name))

    def time_in_s(self, name: str, file_unit: str, first: float) -> tuple[str, float, float]:
        """Return the unit of a numeric time column, its size [s] and the number at time zero.

        The unit is `time_unit`, or that of the file, or that of the heading ("Time [ms]", "time_ms"), or s. Numbers
        that can only be times since 1970 in ms, us or ns are recognised.

        Args:
            name: Name of the column.
            file_unit: Unit in the file; empty if it has none.
            first: First number in the column.

        Raises:
            InputError: The unit is not a unit of time, or is ambiguous.
        """
        words = re.split(r"[ _]+", name.strip())
        named = words[1] if len(words) == 2 and units.get_quantity(words[1]) == "time" else ""
        unit = _EPOCH.sub("", (self.time_unit if self.time_unit != "datetime" else None) or file_unit or named).strip()
        unit = unit or next((each for least, each in _EPOCH_UNITS if least <= first), "s")
        if units.get_quantity(unit) != "time":
            must = "set to s, ms, us, ns, min, h, d or excel d, as the unit of the time column is unknown or ambiguous"
            raise InputError("file.time_unit", must, file_unit)
        if self.time_unit is None and units.canonical(unit) == "d" and first >= units.zero_of("excel d"):
            must = 'set to "excel d" (serial days of a spreadsheet, from 1900) or "d", as it is ambiguous'
            raise InputError("file.time_unit", must, Words(f"{unit}, {first:.9g}"))
        return units.canonical(unit), units.size_si(unit), units.zero_of(unit)


class TimeOptions(_Section):
    """Time axis of the source."""

    rate_hz: PositiveFloat | None = None
    """Sample rate [Hz], if the file has none or a rounded one; its time stamps are then ignored."""
    stamps: Literal["as-is", "line"] = "as-is"
    """as-is: use the time stamps; line: use their fitted line, for even sampling with jittering stamps."""
    from_s: FiniteFloat | None = None
    """Start of the imported range, on the clock of the first file [s]."""
    to_s: FiniteFloat | None = None
    """End of the imported range [s]."""
    start: datetime | None = None
    """Wall time of the source's time zero."""


class Resample(_Section):
    """Resampling to another rate, or of uneven samples to even ones."""

    method: Literal["none", "polyphase", "linear"] = "none"
    rate_hz: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """Rate of the recording [Hz]; omitted: that of the source."""


class SignalName(_Section):
    """Signal of the source."""

    source: str
    """Name in the file."""
    group: str | None = None
    """Group in the file, if the name is ambiguous."""
    file: str | None = None
    """File name, if there are several files."""


USED_BY = {
    "filter_order": [kind for kind in ORDERS if kind != "none"], "ripple_db": ["chebyshev"],
    "group_delay_us": LINEAR_PHASE,
}  # fmt: skip
"""Kinds of filter that have a field of `LowPass`."""


class LowPass(_Section):
    """Anti-aliasing low-pass; the values are those of a channel table."""

    bandwidth_hz: PositiveFloat | None = None
    """Its corner [Hz]; omitted: half of the rate is assumed."""
    filter: FilterKind | None = None
    """Its kind; omitted: butterworth."""
    filter_order: int | None = None
    ripple_db: FiniteFloat | None = None
    group_delay_us: FiniteFloat | None = None

    @property
    def shape(self) -> dict[str, Any]:
        """Kind, order, ripple and delay, as far as given."""
        return self.model_dump(include={*LowPass.model_fields} - {"bandwidth_hz"}, exclude_none=True)


class ChannelMapping(SignalName, LowPass):
    """Conversion of one signal to one channel: value = sign * factor * (source - bias), in the channel's unit."""

    unit: str | None = None
    """Unit of the source; omitted: as in the file. `rig score` also accepts FS, fractions of the converter's range."""
    bits: Annotated[int, Field(ge=8, le=32)] | None = None
    """Word length of a converter's integers, used instead of a unit; only for `rig score`."""
    sensitivity: str | None = None
    """Sensitivity of a source in volts, such as "7.87 V/mm" or "200 mV/mil"."""
    sign: Literal[1, -1] = 1
    factor: FiniteFloat = 1.0
    """Additional factor."""
    bias: FiniteFloat | Literal["mean"] = 0.0
    """Source value at zero, in its unit, or the mean of the imported range."""
    delay_us: FiniteFloat = 0.0
    """Delay of the source [us], for example of a filter or a multiplexer."""
    highpass_hz: Annotated[FiniteFloat, Field(ge=0.0)] = 0.0
    """Corner of an AC coupling [Hz]; 0: none."""
    full_scale: PositiveFloat | None = None
    """Source value (absolute, in its unit) from which a sample counts as overrange."""
    missing: Literal["gap", "hold", "refuse"] = "gap"
    """Missing values: gap omits their rows, hold repeats the last valid value, refuse stops the import."""
    to: str | None = None
    """Sensor group of a channel that the rig does not have."""
    to_unit: str | None = None
    """Unit of a channel that the rig does not have."""
    signal: str | None = None
    """Signal of the model that such a channel measures, or a formula as in a channel table; omitted: unknown."""
    label: str | None = None

    @field_validator("factor")
    @classmethod
    def _not_zero(cls, factor: float) -> float:
        if factor == 0.0:
            raise ValueError("another number than 0")
        return factor


class Defaults(LowPass):
    """Defaults for channels that do not set the value themselves."""


class Rotate(_Section):
    """Conversion of two probes at any two angles to horizontal and vertical."""

    channels: tuple[str, str]
    """Channels of the two probes; they become x and y."""
    angles_deg: tuple[Degrees, Degrees]
    """Angle of each probe: direction of positive values, from x (EAST) toward y (up) [degrees]."""


class Align(_Section):
    """Alignment of two clocks by a signal that both recorded."""

    reference: SignalName
    moved: SignalName
    """Signal whose file (or whose group, with scope "group") is moved."""
    scope: Literal["file", "group"] = "file"
    method: Literal["edge", "correlation"] = "edge"
    threshold: FiniteFloat | None = None
    """Level of the edge, in the unit of both signals; omitted: midway between the lowest and the highest value."""
    within_s: PositiveFloat = 10.0
    """Largest shift to search [s]."""


class KeyphasorMapping(SignalName):
    """Pulse train that gives the keyphasor edges."""

    threshold: FiniteFloat | None = None
    """Level of the edge in the signal's unit; omitted: midway between the lowest and the highest value."""
    edge: Literal["rising", "falling"] = "rising"
    hysteresis: Annotated[FiniteFloat, Field(ge=0.0)] | None = None
    """Distance by which the signal must fall back before the next edge counts; omitted: a tenth of its range."""
    pulses_per_turn: Annotated[int, Field(ge=1)] = 1
    angle_deg: Degrees | None = None
    """Angle of the shaft at the edge: direction of its zero mark, from which `shaft.unbalance_phase` counts, from x
    (EAST) toward y (up) [degrees]; omitted: unknown."""
    angle_uncertainty_deg: PositiveFloat = 5.0
    """Standard deviation of `angle_deg` [degrees]."""


class HammerMapping(_Section):
    """Detection of hammer pulses in the channel `hammer`."""

    threshold_n: PositiveFloat = 10.0
    """Force from which a hammer pulse counts [N]."""
    dead_s: PositiveFloat | None = None
    """Dead time after a hammer pulse [s]; omitted: 0.1, except for a pulse that is clearly separate."""
    pre_s: Annotated[FiniteFloat, Field(ge=0.0)] | None = None
    """Time from the start of the recording to the first hammer pulse [s]."""
    delay_us: FiniteFloat = 0.0
    """Delay of the channel [us], for example of a filter; corrects the time of hammer pulses, not the samples."""
    direction: str | float = "x"
    """Direction of the impact, as in a scene."""


class ExperimentMapping(_Section):
    """Experiment as a scene that can be simulated."""

    scene: str
    """Name of a scene, or path of a file."""
    set: dict[str, Any] = {}
    """Changes of the scene or its parameters, by dotted key."""
    speed_hz: FiniteFloat | Literal["measured"] | None = None
    """Drive speed [Hz]; measured: from the channel `speed`, the edges or the probes, before the first pulse; omitted:
    that of the scene."""
    commands: tuple[dict[str, Any], ...] | Literal["scene", "detected"] = "scene"
    """Commands with at_s in the recording's time, those of the scene, or the detected hammer pulses."""
    lead_s: Annotated[FiniteFloat, Field(ge=0.0, le=60.0)] | None = None
    """Time from the start of the scene to the first sample [s]; omitted: 0. With commands other than the scene's, the
    rig was already running, and the initial state of the shaft is taken from the samples."""


class Mapping(_Section):
    """Mapping file."""

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

    @property
    def mark_deg(self) -> tuple[float, float] | None:
        """Angle of the shaft at the keyphasor's edge and its standard deviation [degrees]; None if unknown."""
        mark = self.keyphasor
        return None if mark is None or mark.angle_deg is None else (mark.angle_deg, mark.angle_uncertainty_deg)

    def document(self) -> dict[str, Any]:
        """Return the mapping as JSON, without defaults."""
        return json.loads(self.model_dump_json(exclude_defaults=True))


def load_mapping(path: Path) -> Mapping:
    """Read and check a mapping file.

    Raises:
        InputError: The first error, with file and field.
    """
    return parse_mapping(read_toml(path), name=path.name)


def parse_mapping(data: dict[str, Any], *, name: str) -> Mapping:
    """Check a mapping, and apply its defaults to the channels.

    Args:
        data: Content of the TOML file.
        name: Name of the file, for errors.

    Raises:
        InputError: The first error, with its field.
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
        raise InputError(f"{name}: experiment.commands", "used together with a table [hammer]", "detected")
    channels = {}
    for channel, entry in mapping.channels.items():
        shape = entry.shape if entry.filter else mapping.defaults.shape | entry.shape
        kind = shape.get("filter", "butterworth")
        for key, kinds in USED_BY.items():
            if key in shape and kind not in kinds:
                must = f"left out with the filter {kind}"
                raise InputError(f"{name}: channels.{channel}.{key}", must, shape[key])
        corner_hz = entry.bandwidth_hz or mapping.defaults.bandwidth_hz
        channels[channel] = entry.model_copy(update=shape | {"bandwidth_hz": corner_hz})
        if entry.bandwidth_hz is None:
            channels[channel].model_fields_set.discard("bandwidth_hz")  # still counts as a default in later checks
    return mapping.model_copy(update={"channels": channels})
