"""Counts of imported channels: a scale for each so that nothing is lost, and what was done to get there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from replays.recordings.formats import unit as units
from replays.recordings.formats.mapped import BITS, MappedSignal
from replays.recordings.formats.placement import PlacedGroup, whole_rate
from replays.recordings.formats.selection import NO_VOLTS
from rig.channels import Channel, ChannelTable, Group, default_table
from rig.errors import InputError
from rig.outside import check

_LEAST, _MOST = 1e-30, 1e30
"""Values that a measurement can have, in any unit."""


@dataclass(frozen=True)
class ImportedChannel:
    """One channel of the recording, and where it is from."""

    name: str
    unit: str
    source: str
    formula: str
    time: str
    counts: str
    rate_hz: int
    jitter_us: float
    drift_ppm: float
    missing: int
    overrange: int
    low: float
    high: float

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return dict(self.__dict__)


def quantise(
    groups: dict[str, PlacedGroup], rotated: set[str]
) -> tuple[ChannelTable, dict[str, np.ndarray], dict[str, np.ndarray], list[ImportedChannel]]:
    """Channel table, int32 counts and present rows by group, and what was done to each channel.

    Args:
        groups: Values by group.
        rotated: Channels that two signals were mixed into.
    """
    tables, counts, present, told = {}, {}, {}, []
    for name, group in groups.items():
        columns, channels = [], []
        good = np.all([np.isfinite(values) for values in group.values.values()], axis=0)
        for wanted, values in group.values.items():
            entry = group.taken[wanted]
            raw = group.raw.get(wanted)
            channel, column, rule = _counts(entry, values, raw, group.rate_hz, mixed=wanted in rotated)
            channels.append(channel)
            columns.append(column)
            told.append(_told(entry, channel, rule, values, group.rate_hz))
        known = default_table().groups.get(name)
        title = known.title if known is not None else name
        tables[name] = Group(name=name, title=title, rate_hz=group.rate_hz, channels=tuple(channels))
        counts[name] = np.stack(columns, axis=1)
        present[name] = good
    return ChannelTable(groups=tables), counts, present, told


def _counts(
    entry: MappedSignal, values: np.ndarray, raw: np.ndarray | None, rate_hz: int, *, mixed: bool
) -> tuple[Channel, np.ndarray, str]:
    """A channel with its scale, and its int32 counts.

    Integers that nobody has touched stay as they are. All else is counted in a power of two that leaves the largest
    value between a quarter and a half of int32: half a count is at most 2^-30 of the largest value.
    """
    signal = entry.signal
    limits = np.iinfo(np.int32)
    keeps = raw is not None and len(raw) and int(raw.min()) >= limits.min and int(raw.max()) <= limits.max
    volts_per_unit = None if entry.volts is None or mixed else entry.volts / entry.gain
    if keeps:
        scale = entry.gain * signal.scale
        offset = entry.gain * (signal.offset - entry.bias)
    else:
        # Counts of a voltage count from 0 V, as a converter's do.
        offset = 0.0 if volts_per_unit is None else -entry.gain * entry.bias
        largest = float(np.nanmax(np.abs(values - offset), initial=0.0))
        if largest and not _LEAST <= largest <= _MOST:
            raise InputError(f"channels.{entry.name}", f"of values from {_LEAST:g} to {_MOST:g}", largest)
        scale = math.ldexp(1.0, math.frexp(largest)[1] - 30) if largest else math.ldexp(1.0, -30)
        scale = math.copysign(scale, 1.0 if volts_per_unit is None else volts_per_unit)
    if not (_LEAST * 1e-10 <= abs(scale) <= _MOST and abs(offset) <= _MOST):
        raise InputError(f"channels.{entry.name}", f"of counts from {_LEAST * 1e-10:g} to {_MOST:g}", scale)
    # Where nothing is known of volts, a unit is told as one volt.
    sensitivity = volts_per_unit if volts_per_unit is not None else math.copysign(1.0, scale)
    lsb_v = abs(scale * sensitivity)
    sensitivity = lsb_v / scale
    reach_v = math.ldexp(lsb_v, BITS - 1)
    low_v, high_v = -reach_v, reach_v
    bias_v = -offset * sensitivity
    if entry.mapping.full_scale is not None and not mixed:
        ends = sorted(
            bias_v + sensitivity * entry.gain * (sign * entry.mapping.full_scale - entry.bias) for sign in (-1.0, 1.0)
        )
        low_v, high_v = max(low_v, ends[0]), min(high_v, ends[1])
        if not low_v < high_v:
            low_v, high_v = -reach_v, reach_v
    target = entry.target
    channel = target.model_copy(
        update={
            "label": entry.mapping.label or target.label, "sensitivity_v": sensitivity, "bias_v": bias_v,
            "range_v": (low_v, high_v), "bandwidth_hz": entry.mapping.bandwidth_hz or rate_hz / 2.0,
            "highpass_hz": entry.mapping.highpass_hz,
            "noise_v": abs(sensitivity) * _noise(values), "adc_v": reach_v, "adc_bits": BITS, "rate_hz": rate_hz,
            "kind": NO_VOLTS if volts_per_unit is None else "imported",
        }
    )  # fmt: skip
    channel = check(Channel, channel.model_dump(), field=f"channels.{entry.name}")
    if keeps and raw is not None:
        return channel, raw.astype(np.int32), f"the source's own integers, {abs(channel.scale):.6g} {channel.unit} each"
    found = np.rint((np.nan_to_num(values) - channel.offset) / channel.scale)
    if len(found) and not limits.min <= found.min() <= found.max() <= limits.max:
        raise InputError(f"channels.{entry.name}", "in reach of its counts", float(np.nanmax(np.abs(values))))
    return channel, found.astype(np.int32), f"2^{round(math.log2(abs(scale)))} {channel.unit}"


_MANY = 5
"""Of more stretches than this, the quietest tenth is below the mean."""


def _noise(values: np.ndarray) -> float:
    """White noise of a signal [its unit, rms], from its second differences where they are smallest.

    Of white noise, second differences have the variance 6 sigma^2. What the signal does slowly drops out of them; in
    the quietest tenth of its stretches, so does what it does at times.
    """
    length = 256
    second = np.diff(values, 2)
    second = second[np.isfinite(second)]
    stretches = len(second) // length
    if not stretches:
        return 0.0
    rms = np.sqrt(np.mean(second[: stretches * length].reshape(stretches, length) ** 2, axis=1) / 6.0)
    # Of plain noise, that tenth is too quiet: the mean of n squares has the relative variance 2 (1 + 2 sum rho^2) / n,
    # with the correlations -2/3 and 1/6 of second differences one and two samples apart.
    quiet = 1.0 - 1.2816 * math.sqrt(2.0 * (1.0 + 2.0 * (4.0 / 9.0 + 1.0 / 36.0)) / length) / 2.0
    return float(np.quantile(rms, 0.1)) / (quiet if stretches > _MANY else 1.0)


def _told(entry: MappedSignal, channel: Channel, rule: str, values: np.ndarray, rate_hz: int) -> ImportedChannel:
    unit = units.canonical(entry.mapping.unit or entry.entry.unit or "1")
    source = f"(source {'-' if entry.bias > 0.0 else '+'} {abs(entry.bias):.6g})" if entry.bias else "source"
    ratio = "" if unit == channel.unit else f" {channel.unit} per {unit}".replace(" 1 per", " per")
    gain = f"{entry.gain:.9g}{ratio} * " if ratio or entry.gain != 1.0 else ""
    delay = f", {-entry.mapping.delay_us:+g} us" if entry.mapping.delay_us else ""
    drift = (entry.axis.rate_hz / rate_hz - 1.0) * 1e6 if entry.axis.rows and whole_rate(entry.axis) == rate_hz else 0.0
    return ImportedChannel(
        name=entry.name, unit=channel.unit,
        source=" ".join(text for text in (entry.source.path.name, entry.entry.group, entry.entry.name) if text),
        formula=f"{gain}{source}",
        time=f"{entry.axis.note}{delay}; " + ("; ".join(entry.touched) or "samples as they were"),
        counts=rule, rate_hz=rate_hz, jitter_us=entry.axis.jitter_s[1] * 1e6, drift_ppm=drift, missing=entry.missing,
        overrange=entry.overrange, low=float(np.nanmin(values)), high=float(np.nanmax(values)),
    )  # fmt: skip
