"""Limits of a scorecard, from TOML: each is a number or derived from the channel table, and has its source."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from replays.score.card.scorecard import ANALOGUE, DIGITAL, Bounds
from rig.base import units
from rig.base.checks import check, read_toml
from rig.base.errors import InputError, UnknownNameError, Words
from rig.channels.table import Channel

FOLDER = Path(__file__).parent / "sets"
DEFAULT = "as-calibrated"
Property = Literal[
    "noise",
    "lsb",
    "full_scale",
    "bandwidth_hz",
    "sample_ns",
    "effective_bits",
    "dynamic_range_db",
    "sine_db",
    "sine_bits",
]


class _TableBound(BaseModel):
    """A bound derived from a property in the channel table: times it, plus a constant."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    of: Property
    times: FiniteFloat = 1.0
    plus: FiniteFloat = 0.0


class Limit(BaseModel):
    """A limit of a quantity, and its source."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    low: FiniteFloat | _TableBound | None = None
    high: FiniteFloat | _TableBound | None = None
    source: Annotated[str, Field(min_length=1)]
    """Source of the limit."""
    kind: Literal["table", "assumed", "standard", "exact"]
    edition: str = ""
    clause: str = ""
    second_hand: bool = False
    """True if it is quoted from other texts, as the standard was not available."""
    measures: str | None = None
    """Kind of unit of the channels that it applies to, such as length; None: all."""

    def text(self) -> str:
        """Return the source of the limit as text."""
        parts = [self.source, self.edition, self.clause, "quoted second-hand" if self.second_hand else ""]
        return ", ".join(part for part in (*parts, "assumed" if self.kind == "assumed" else "") if part)


class ScoreLimits(BaseModel):
    """A set of limits by quantity."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    title: str
    digital: dict[str, Limit] = {}
    analogue: dict[str, Limit] = {}

    def bounds(
        self, path: Literal["digital", "analogue"], quantity: str, channel: Channel | None = None, *,
        amplitude: float = math.nan,
    ) -> Bounds | None:  # fmt: skip
        """Return the bounds of a quantity, or None.

        Args:
            path: Path of the scorecard.
            quantity: Name of the quantity.
            channel: Its channel in the session's table.
            amplitude: Amplitude of the sine with which it was measured [unit].
        """
        limit = getattr(self, path).get(quantity)
        if limit is None:
            return None
        if limit.measures is not None and (channel is None or units.get_quantity(channel.unit) != limit.measures):
            return None
        ends = []
        for bound, none in ((limit.low, -math.inf), (limit.high, math.inf)):
            if isinstance(bound, _TableBound):
                if channel is None:
                    return None
                ends.append(bound.times * _read_property(channel, bound.of, amplitude) + bound.plus)
            else:
                ends.append(none if bound is None else bound)
        if any(map(math.isnan, ends)):
            return None
        _check_order(f"limit {quantity}{'' if channel is None else f' of {channel.name}'}", *ends)
        return Bounds(ends[0], ends[1], limit.text())


def _check_order(field: str, low: float | _TableBound | None, high: float | _TableBound | None) -> None:
    """Raise InputError if the low end of a limit is above its high end; ends from the table are checked later."""
    if isinstance(low, float) and isinstance(high, float) and low > high:
        raise InputError(field, "with low at most high", Words(f"low = {low:g}, high = {high:g}"))


def _read_property(channel: Channel, what: Property, amplitude: float) -> float:
    """Return a property of a channel in the table, in the channel's unit."""
    per_volt = 1.0 / abs(channel.sensitivity_v)
    noise_v = math.hypot(channel.noise_v, channel.lsb_v / math.sqrt(12.0))
    sine_db = 20.0 * math.log10(amplitude / math.sqrt(2.0) / (noise_v * per_volt)) if amplitude > 0.0 else math.nan
    return {
        "noise": noise_v * per_volt,
        "lsb": channel.lsb_v * per_volt,
        "full_scale": channel.adc_v * per_volt,
        "bandwidth_hz": channel.bandwidth_hz,
        "sample_ns": 1e9 / channel.rate_hz,
        "effective_bits": math.log2(2.0 * channel.adc_v / (noise_v * math.sqrt(12.0))),
        "dynamic_range_db": 20.0 * math.log10(channel.adc_v / math.sqrt(2.0) / noise_v),
        "sine_db": sine_db,
        "sine_bits": (sine_db - 1.76) / 6.02,
    }[what]


def load_limits(source: Path | str | None = None) -> ScoreLimits:
    """Load limits: a set of the rig's by its name, or a file.

    Raises:
        InputError: The limits do not exist, or are invalid; the message has the first error.
    """
    path = Path(DEFAULT if source is None else source)
    shipped = {file.stem: file for file in FOLDER.glob("*.toml")}
    if path.suffix != ".toml":
        if str(path) not in shipped:
            raise UnknownNameError("limits", "a .toml file or a set of the rig's", str(path), sorted(shipped))
        path = shipped[str(path)]
    limits = check(ScoreLimits, read_toml(path), field=path.name)
    for name, quantities in (("digital", DIGITAL), ("analogue", ANALOGUE)):
        for quantity, limit in getattr(limits, name).items():
            if quantity not in quantities:
                raise UnknownNameError(f"{path.name}: {name}", "a quantity of a scorecard", quantity, quantities)
            where = f"{path.name}: {name}.{quantity}"
            if limit.low is None and limit.high is None:
                raise InputError(where, "with low or high", None)
            if limit.measures not in (None, *units.QUANTITIES):
                raise UnknownNameError(f"{where}.measures", "a kind of unit", limit.measures, units.QUANTITIES)
            _check_order(where, limit.low, limit.high)
    return limits
