"""Channel table: measured channels and the conversion from counts to volts and engineering values.

All code outside the physics (wire, drivers, recorder, viewer, exports) knows the rig only through this table.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Collection, Iterable
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, PositiveFloat, PositiveInt, model_validator

from rig.base.checks import check, parse_toml
from rig.base.errors import InputError, UnknownNameError, Words

VERSION = 2
"""Version of new tables; increased when the rig's own table changes, because recordings are compared with it."""
TABLE = Path(__file__).with_name("channels.toml")


FilterKind = Literal["butterworth", "bessel", "chebyshev", "fir", "sinc", "none"]
ORDERS: dict[str, tuple[int, int, int]] = {
    "butterworth": (4, 1, 8), "bessel": (4, 1, 8), "chebyshev": (4, 1, 8), "fir": (64, 8, 1024), "sinc": (3, 2, 8),
    "none": (4, 1, 8),
}  # fmt: skip
"""Orders by kind of filter: default, smallest, largest."""
LINEAR_PHASE = ("fir", "sinc")
"""Filters with a constant delay, which a recorder may have compensated."""


@cache
def _relative_average(order: int) -> float:
    """Return the length of each of `order` moving averages in series, times their corner at -3 dB."""
    x = np.linspace(0.01, 0.99, 9801)
    return float(np.interp(-(0.5 ** (0.5 / order)), -np.sinc(x), x))


class Channel(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """Measured channel with its complete calibration; an incomplete one is refused on load."""

    name: Annotated[str, Field(min_length=1)]
    label: str
    group: str
    signal: str
    """Signal of the model measured by the sensor (see `rig.physics.kernels.signals`)."""
    unit: str
    si: PositiveFloat
    """One engineering unit in SI."""
    sensitivity_v: float
    """Sensitivity [V per engineering unit]."""
    bias_v: float
    """Output at value zero [V]."""
    range_v: tuple[float, float]
    """Output limits of the conditioner [V]."""
    bandwidth_hz: PositiveFloat
    """Corner of the anti-alias low-pass [Hz]: -3 dB; chebyshev: edge of the passband; fir: -6 dB."""
    filter: FilterKind = "butterworth"
    """Kind of that low-pass; `sinc` is the decimation filter of a sigma-delta converter."""
    filter_order: int = Field(default_factory=lambda data: ORDERS[data.get("filter", "butterworth")][0])
    """Its order; fir: of a Hamming design at the sample rate; sinc: number of moving averages in series."""
    ripple_db: Annotated[float, Field(gt=0, le=12)] = 0.5
    """Ripple in the passband of a chebyshev [dB]."""
    group_delay_us: float | None = None
    """Delay of a fir or sinc [us]; 0: compensated; None: half of its length, as without compensation."""
    highpass_hz: Annotated[float, Field(ge=0)]
    """AC coupling [Hz]; 0 is DC-coupled."""
    noise_v: Annotated[float, Field(ge=0)]
    """White noise [V rms] at the converter."""
    adc_v: PositiveFloat
    """Converter range is +-adc_v [V]."""
    adc_bits: Annotated[int, Field(ge=8, le=32)]
    rate_hz: PositiveInt
    """Sample rate [Hz]."""
    kind: str
    """Provenance of the values, as for parameters."""

    @model_validator(mode="after")
    def _check_filter(self) -> Channel:
        _, least, most = ORDERS[self.filter]
        if not least <= self.filter_order <= most:
            must = f"from {least} to {most} for the filter {self.filter}"
            raise InputError("filter_order", must, self.filter_order)
        if self.group_delay_us is not None and self.filter not in LINEAR_PHASE:
            must = f"left out, as the filter {self.filter} is not one of {', '.join(LINEAR_PHASE)}"
            raise InputError("group_delay_us", must, self.group_delay_us)
        return self

    @model_validator(mode="after")
    def _check_scale(self) -> Channel:
        if self.sensitivity_v == 0.0:
            raise InputError("sensitivity_v", "non-zero", self.sensitivity_v)
        low, high = self.range_v
        if not -self.adc_v <= low < high <= self.adc_v:
            must = f"two ascending values inside +-adc_v ({self.adc_v:g} V)"
            raise InputError("range_v", must, self.range_v)
        if not (math.isfinite(self.scale) and self.scale and math.isfinite(self.offset)):
            raise InputError("sensitivity_v", "one that gives a finite scale", self.sensitivity_v)
        return self

    @property
    def half_length_s(self) -> float:
        """Half of the length of a linear-phase filter's impulse response [s]; 0 for other filters."""
        if self.filter == "sinc":
            return 0.5 * self.filter_order * self.average_s
        return 0.5 * self.filter_order / self.rate_hz if self.filter == "fir" else 0.0

    @property
    def average_s(self) -> float:
        """Length of each moving average of a sinc filter [s]."""
        return _relative_average(self.filter_order) / self.bandwidth_hz

    @property
    def low_pass(self) -> tuple[float | str | None, ...]:
        """The numbers of the low-pass, equal for equal filters."""
        return self.filter, self.bandwidth_hz, self.filter_order, self.ripple_db, self.group_delay_us

    @property
    def shape(self) -> dict[str, Any]:
        """Fields of the low-pass, except for its corner, that differ from those of a fourth-order Butterworth."""
        plain = {"filter": "butterworth", "filter_order": 4, "ripple_db": 0.5, "group_delay_us": None}
        return {key: getattr(self, key) for key, value in plain.items() if getattr(self, key) != value}

    @property
    def has_range(self) -> bool:
        """True if the range is known; an imported channel without one has the limits of its counts."""
        return not self.kind.startswith("imported") or self.range_v != (-self.adc_v, self.adc_v)

    @property
    def lsb_v(self) -> float:
        """Converter step [V]."""
        return 2.0 * self.adc_v / 2**self.adc_bits

    @property
    def scale(self) -> float:
        """Engineering units per count."""
        return self.lsb_v / self.sensitivity_v

    @property
    def offset(self) -> float:
        """Engineering value at count zero."""
        return -self.bias_v / self.sensitivity_v


class Group(BaseModel, frozen=True, extra="forbid"):
    """Channels of one connector: they share key, block and rate."""

    name: str
    title: str
    rate_hz: Annotated[int, Field(ge=1, le=1_000_000_000)]
    channels: Annotated[tuple[Channel, ...], Field(min_length=1)]

    @property
    def names(self) -> tuple[str, ...]:
        """Channel names in column order."""
        return tuple(channel.name for channel in self.channels)

    def engineering(self, counts: np.ndarray) -> np.ndarray:
        """Convert ADC counts to engineering values.

        Args:
            counts: Integer counts, shape (n, channels).

        Returns:
            Values in each channel's unit, float64, shape (n, channels).
        """
        scale = np.array([channel.scale for channel in self.channels])
        offset = np.array([channel.offset for channel in self.channels])
        values = counts * scale
        values += offset
        return values


class ChannelTable(BaseModel, frozen=True, extra="forbid"):
    """All channel groups by name."""

    groups: dict[str, Group]
    version: Annotated[int, Field(ge=1, le=2)] = 1
    """Version of the filters: 1 for recordings before 0.2, with digital filters on rows at an interval of 25 us."""
    curves: dict[str, tuple[tuple[FiniteFloat, FiniteFloat], ...]] = {}
    """Periodic functions of an angle for formulas, as points (degrees, value)."""

    def __repr__(self) -> str:
        groups = [f"{name}: {', '.join(group.names)}" for name, group in self.groups.items()]
        return f"ChannelTable({'; '.join(groups)})"

    __str__ = __repr__

    @model_validator(mode="after")
    def _check_names(self) -> ChannelTable:
        names = [channel.name for group in self.groups.values() for channel in group.channels]
        if len(set(names)) < len(names):
            name = next(name for name in names if names.count(name) > 1)
            raise InputError(f"channel {name}", "in the table once", names.count(name))
        if any(name != group.name or not name for name, group in self.groups.items()):
            raise ValueError("the key of each group must be its name")
        return self

    @property
    def channels(self) -> dict[str, Channel]:
        """All channels by name, in table order."""
        return {channel.name: channel for group in self.groups.values() for channel in group.channels}

    def select_groups(self, names: tuple[str, ...], rate_hz: int | None = None) -> ChannelTable:
        """Return the table limited to the named groups (none for all), with another sample rate if given [Hz]."""
        selected = {}
        for name in names or self.groups:
            group = self.groups[name]
            if rate_hz is not None:
                # A slower channel needs its anti-alias filter at a quarter of its own rate.
                rows = tuple(
                    channel.model_copy(
                        update={"rate_hz": rate_hz, "bandwidth_hz": min(channel.bandwidth_hz, rate_hz / 4.0)}
                    )
                    for channel in group.channels
                )
                group = group.model_copy(update={"rate_hz": rate_hz, "channels": rows})
            selected[name] = group
        return self.model_copy(update={"groups": selected})


def parse_table(text: str) -> ChannelTable:
    """Return the channel table of a TOML text, group defaults merged into each row.

    Raises:
        InputError: The text is not TOML, or a value is missing or invalid.
    """
    try:
        return build_table(raw_groups(text))
    except KeyError as error:
        raise InputError(f"channel table: {error.args[0]}", "given", None) from None
    except (TypeError, AttributeError):
        raise InputError("channel table", "[groups.NAME] with title, rate_hz, kind and channels", text[:80]) from None
    except tomllib.TOMLDecodeError as error:
        raise InputError("channel table", "a TOML file", Words(error)) from None


def raw_groups(text: str) -> dict[str, Any]:
    """Return the groups of a TOML text as parsed, with kind and defaults of the group merged into each row."""
    groups = parse_toml(text, field="channel table")["groups"]
    for body in groups.values():
        shared = {**body.pop("defaults", {}), "kind": body["kind"]}
        body["channels"] = [{**shared, **row} for row in body["channels"]]
    return groups


def build_table(groups: dict[str, Any], curves: dict[str, Any] | None = None) -> ChannelTable:
    """Return the channel table of groups with complete rows, and of curves.

    Raises:
        InputError: A value is missing or invalid.
    """
    merged = {}
    for name, body in groups.items():
        own = {"group": name, "rate_hz": body["rate_hz"]}
        rows = [
            check(Channel, {**row, **own}, field=f"channel {row.get('name', number)}")
            for number, row in enumerate(body["channels"], 1)
        ]
        merged[name] = {"name": name, "title": body["title"], "rate_hz": body["rate_hz"], "channels": tuple(rows)}
    table = {"groups": merged, "version": VERSION, "curves": curves or {}}
    return check(ChannelTable, table, field="channel table")


def check_signals(channels: Iterable[Channel], names: Collection[str]) -> None:
    """Refuse channels of a signal that the model does not have.

    Args:
        channels: The channels.
        names: Names of the model's signals.

    Raises:
        InputError: The message names the first such channel.
    """
    for channel in channels:
        if channel.signal not in names:
            raise UnknownNameError(f"channel {channel.name}.signal", "one of the model's", channel.signal, names)


@cache
def default_table() -> ChannelTable:
    """Return the rig's own channel table."""
    return parse_table(TABLE.read_text())
