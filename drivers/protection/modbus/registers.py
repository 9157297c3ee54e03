"""Register map of the gateway, made from a channel table, and the contents of its registers. Does no input or output.

Each channel except the keyphasor has the four proportional values of a monitor: overall, gap, 1X amplitude and phase.
The contents belong to a multiple of 0.1 s of simulated time, so they do not depend on how rows are divided into blocks.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.protection.monitor import Protection
from drivers.protection.settings import Settings
from drivers.sources.samples import Samples, merge_samples
from drivers.sources.turns import find_pulses, measure_turn
from rig.base.errors import InputError, Words
from rig.base.units import factor
from rig.channels.table import Channel, ChannelTable

COILS = ("trip", "stop", "reset")
"""Commands by coil."""
FLOATS = 1000
"""Address of the first value as float32."""
PERIOD_S = 0.1
KEYPHASOR = "keyphasor"
_COMMON_BITS, _CHANNEL_BITS = ("live", "speed valid", "any alert", "any danger"), ("OK", "1X valid", "alert", "danger")
_HISTORY_S = 2.0
"""Length of the window in which the last turn is found [s]: a slower shaft has no 1X."""
_OK_MARGIN = 1.0 / 32.0
"""Distance of the OK limits from the limits of the output, a fraction of its range; 0.5 V for a range of 16 V."""


@dataclass(frozen=True, slots=True)
class Entry:
    """An entry of the map.

    Attributes:
        table: register, discrete input or coil.
        address: Address, counted from 0.
        channel: Channel; empty for a value of the rack.
        value: Name of the value.
        unit: Unit of the value.
        lsb: Value of one count; a register has the nearest count, limited to the range.
        lowest: Lowest count; a negative count is a two's complement.
        highest: Highest count.
        float_address: Address of the value as float32, high word first.
    """

    table: str
    address: int
    channel: str
    value: str
    unit: str = ""
    lsb: float | None = None
    lowest: int | None = None
    highest: int | None = None
    float_address: int | None = None


class RegisterMap:
    """The registers and bits of a channel table.

    Args:
        table: Channels of the rig.

    Raises:
        InputError: The table has too many channels, or none.
    """

    def __init__(self, table: ChannelTable) -> None:
        self.table = table
        self.channels = tuple(channel for name, channel in table.channels.items() if name != KEYPHASOR)
        if not 0 < len(self.channels) <= (most := (FLOATS - 2) // 4):
            raise InputError("channels", f"1 to {most} besides the keyphasor", Words(f"{len(self.channels)}"))
        values: list[tuple[Any, ...]] = [
            ("", "simulated time, modulo 6553.6 s", "s", PERIOD_S),
            ("", "speed", "rpm", 0.1),
        ]
        for channel in self.channels:
            span = (channel.range_v[1] - channel.range_v[0]) / abs(channel.sensitivity_v)
            gap_lsb = _round_up(max(map(abs, channel.range_v)) / 0x7FFF)
            values += [
                (channel.name, "overall, peak-to-peak", channel.unit, _round_up(span / 0xFFFF)),
                (channel.name, "gap (mean of the output)", "V", gap_lsb, -0x8000, 0x7FFF),
                (channel.name, "1X amplitude, zero-to-peak", channel.unit, _round_up(0.5 * span / 0xFFFF)),
                (channel.name, "1X phase lag", "deg", 0.01, 0, 35_999),
            ]
        self.registers = [
            Entry("register", at, *value, *(() if len(value) > 4 else (0, 0xFFFF)), float_address=FLOATS + 2 * at)
            for at, value in enumerate(values)
        ]
        bits = [("", name) for name in _COMMON_BITS] + [
            (one.name, bit) for one in self.channels for bit in _CHANNEL_BITS
        ]
        self.bits = [Entry("discrete input", at, *bit) for at, bit in enumerate(bits)]
        self.entries = [*self.registers, *self.bits, *(Entry("coil", at, "", name) for at, name in enumerate(COILS))]
        """The whole map."""

    def encode(self, values: np.ndarray) -> tuple[list[int], list[int]]:
        """Return values as 16-bit registers and as pairs of registers; one that is not a number is 0."""
        values = np.nan_to_num(values, nan=0.0)
        lsb, low, high = np.array([(each.lsb, each.lowest, each.highest) for each in self.registers]).T
        counts = np.rint(values / lsb)
        counts[0] %= 0x10000
        words = np.clip(counts, low, high).astype(int) & 0xFFFF
        return words.tolist(), np.frombuffer(values.astype(">f4").tobytes(), ">u2").astype(int).tolist()


def _round_up(value: float) -> float:
    """Return the next larger 1, 2 or 5 times a power of ten."""
    exponent = math.floor(math.log10(value))
    return next(float(f"{one}e{exponent}") for one in (1, 2, 5, 10) if float(f"{one}e{exponent}") >= value)


class Contents:
    """Contents of the registers, computed from samples.

    Args:
        registers: Register map.
        settings: Set points of the alarms: fields of `drivers.protection.Settings`.

    Attributes:
        values: Value of each register, in its unit.
        bits: The discrete inputs.
        monitors: Protection monitors, one for each pair of displacement probes.
    """

    def __init__(self, registers: RegisterMap, settings: dict[str, float]) -> None:
        self._map, self._parts = registers, list[Samples]()
        self.values, self.bits = np.zeros(len(registers.registers)), [False] * len(registers.bits)
        self.monitors = [Protection(Settings(**settings, **pair)) for pair in _find_pairs(registers.table)]
        self._window_s = Settings(**settings).window_s

    def invalidate(self) -> None:
        """Clear all bits and forget the samples: the rig is lost."""
        self._parts, self.bits = [], [False] * len(self.bits)

    def rows_needed(self, rate_hz: float) -> int:
        """Return the number of rows to the next multiple of 0.1 s."""
        last = self._parts[-1] if self._parts else None
        period = round(PERIOD_S * rate_hz)
        return period - ((last.index + len(last)) % period if last is not None else 0)

    def feed(self, samples: Samples) -> None:
        """Process the next rows."""
        period = round(PERIOD_S * samples.rate_hz)
        while len(samples):
            rows = min(len(samples), period - samples.index % period)
            self._take(samples.rows(0, rows), period)
            samples = samples.rows(rows, len(samples))

    def _take(self, samples: Samples, period: int) -> None:
        """Process rows up to the next multiple of 0.1 s, and measure there."""
        end = samples.index + len(samples)
        if self._parts and samples.index != self._parts[-1].index + len(self._parts[-1]):
            self.invalidate()
        for monitor in self.monitors:
            monitor.feed(samples)
        self._parts.append(samples)
        while end - (self._parts[0].index + len(self._parts[0])) >= round(_HISTORY_S * samples.rate_hz):
            del self._parts[0]
        if end % period == 0 and end - self._parts[0].index >= round(self._window_s * samples.rate_hz):
            self._measure(merge_samples(*self._parts))

    def _measure(self, window: Samples) -> None:
        channels, end = self._map.channels, len(window)
        recent = window.rows(end - round(self._window_s * window.rate_hz), end)
        end_s = float(window.times_s[-1]) + 1.0 / window.rate_hz
        edges_s = find_pulses(window) if KEYPHASOR in window.names else np.zeros(0)
        turning = len(edges_s) > 1 and end_s - edges_s[-1] < 2.0 * (edges_s[-1] - edges_s[-2])
        turn = measure_turn(window, edges_s[-2], edges_s[-1]) if turning else None
        active = {alarm for monitor in self.monitors for alarm in monitor.active}
        values, bits = [end_s, 60.0 * turn.speed_hz if turn else 0.0], list[bool]()
        for channel in channels:
            rows, name = recent[channel.name], channel.name
            vector = turn.synchronous[name] if turn else complex(math.nan, math.nan)
            low, high = _ok_limits(channel)
            volts = channel.bias_v + channel.sensitivity_v * rows
            gap = turn.gap[name] if turn else float(rows.mean())
            lag_deg = -math.degrees(np.angle(vector)) % 360.0
            values += [float(np.ptp(rows)), channel.bias_v + channel.sensitivity_v * gap, abs(vector), lag_deg]
            inside = bool(volts.min() >= low and volts.max() <= high)
            bits += [inside and ("not-ok", name) not in active, inside and bool(np.isfinite(vector))]
            bits += [(kind, name) in active for kind in ("alert", "danger")]
        kinds = {kind for kind, _ in active}
        self.values = np.array(values)
        self.bits = [True, turn is not None, "alert" in kinds, "danger" in kinds, *bits]


def _ok_limits(channel: Channel) -> tuple[float, float]:
    low, high = channel.range_v
    margin = _OK_MARGIN * (high - low)
    return low + margin, high - margin


def _find_pairs(table: ChannelTable) -> Iterator[dict[str, Any]]:
    """Yield the settings of the monitor of each pair of probes NAME_x and NAME_y with the same calibration."""
    for name, x in table.channels.items():
        y = table.channels.get(f"{name.removesuffix('_x')}_y")
        if y is None or y.unit != x.unit or (y.sensitivity_v, y.bias_v) != (x.sensitivity_v, x.bias_v):
            continue
        with contextlib.suppress(InputError):  # not a length
            scale = x.sensitivity_v / factor(x.unit, "mm", field=name)
            # A monitor assumes that a larger value is a larger voltage.
            low, high = sorted(x.bias_v + math.copysign(1.0, scale) * (limit - x.bias_v) for limit in _ok_limits(x))
            calibration = {"bias_v": x.bias_v, "scale_v_per_mm": abs(scale), "ok_low_v": low, "ok_high_v": high}
            yield {"x": name, "y": y.name, **calibration}
