"""Channels of one sensor group: on one time axis, untouched or at other instants, and as counts that lose nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import count, islice
from typing import Any

import numpy as np

from replays.recordings.formats import clock
from replays.recordings.formats.exporting.selection import NO_VOLTS
from replays.recordings.formats.guessing import noise
from replays.recordings.formats.mapped import BITS, MappedSignal
from replays.recordings.formats.mapping import Mapping
from rig.base import units
from rig.base.checks import check
from rig.base.errors import InputError, Words
from rig.channels.table import VERSION, Channel, ChannelTable, Group, default_table

_MOST_TIMES, _MOST_ROWS = 1000, 1_000_000
"""So many times the values that a file has, and so many rows more, samples may become at another rate."""
_NEAR = 0.01
"""Part of a sample by which untouched samples may lie beside the instants that they are given."""
_LEAST, _MOST = 1e-30, 1e30
"""Values that a measurement can have, in any unit."""
_SLOWEST_HZ, _FASTEST_HZ = 0.01, 1e6
"""Rates that a recording may have, whose clock ticks a million times a second."""
_DUST = 1e-4
"""Part of a sample by which a rate of few digits may be off from end to end."""
_CLOCK = 2e-4
"""Part by which the clock of a converter may be off, at most."""


@dataclass
class PlacedGroup:
    """Channels of one sensor group on one axis.

    Attributes:
        rate_hz: Their rate, as true as it is known, a whole number or not [Hz].
        start_s: Time of the first row, in the time of the source [s].
        rows: Number of rows.
        channels: What they show, by name, on this axis.
    """

    rate_hz: float
    start_s: float
    rows: int
    channels: dict[str, MappedSignal]


def nominal_hz(rate_hz: float) -> int:
    """The whole rate that a converter was set to whose clock made it this one: of the fewest digits [Hz]."""
    if rate_hz >= 1.0 and float(rate_hz).is_integer():
        return int(rate_hz)
    told = (float(f"{rate_hz:.{digits}g}") for digits in range(1, 8))
    return max(1, round(next((each for each in told if abs(each / rate_hz - 1.0) < _CLOCK), rate_hz)))


def true_rate(axis: clock.Axis) -> float:
    """Rate of even samples [Hz]: a whole one if they have it within a part of a sample from end to end."""
    whole = max(1, round(axis.rate_hz))
    if abs(whole - axis.rate_hz) / axis.rate_hz * axis.rows <= clock.EVEN:
        return float(whole)
    told = (float(f"{axis.rate_hz:.{digits}g}") for digits in range(1, 15))  # without dust
    return next((each for each in told if abs(each / axis.rate_hz - 1.0) * axis.rows < _DUST), axis.rate_hz)


def place(
    taken: Sequence[MappedSignal], mapping: Mapping, low_s: float, high_s: float
) -> tuple[dict[str, PlacedGroup], float]:
    """All channels on the axes of their groups, and the time in the source that becomes zero [s]."""
    members = _members(taken, mapping)
    order = list(members)
    rates = {name: _group_rate(name, entries, mapping) for name, entries in members.items()}
    first = {name: max(low_s, *(entry.axis.first_s for entry in entries)) for name, entries in members.items()}
    last = {name: min(high_s, *(entry.axis.last_s for entry in entries)) for name, entries in members.items()}
    for name in order:
        if not last[name] - first[name] >= 1.0 / rates[name]:
            spans = ", ".join(f"{e.name} {e.axis.first_s:g} to {e.axis.last_s:g} s" for e in members[name])
            raise InputError("range", f"one in which all channels of {name} have samples ({spans})",
                             Words(f"{first[name]:g} to {last[name]:g} s"))  # fmt: skip
    # Time zero is an instant of the source wherever its samples stay as they are.
    lead = min(order, key=lambda name: first[name])
    zero_s = _next_sample(members[lead][0].axis, first[lead]) if _untouched(members[lead], rates[lead]) else first[lead]
    placed = {}
    for name in order:
        entries, rate = members[name], rates[name]
        if mapping.resample.method == "none" or _untouched(entries, rate):
            start, slack = _next_sample(entries[0].axis, first[name]), clock.EVEN
        else:
            start, slack = zero_s + math.ceil((first[name] - zero_s) * rate - 1e-6) / rate, 1e-6
        rows = math.floor((last[name] - start) * rate + slack) + 1
        held = max(entry.axis.rows for entry in entries)
        if rows > _MOST_TIMES * held + _MOST_ROWS:
            must = f"such that {held} values in {name} become at most {_MOST_TIMES * held + _MOST_ROWS} rows"
            raise InputError("resample.rate_hz", must, Words(f"{rate} Hz, {rows} rows"))
        placed[name] = PlacedGroup(rate, start, rows, {entry.name: entry for entry in entries})
        for entry in entries:
            _put(placed[name], entry, mapping)
    return placed, zero_s


def _members(taken: Sequence[MappedSignal], mapping: Mapping) -> dict[str, list[MappedSignal]]:
    """Signals by sensor group, in the order of the rig's table; without resampling, only those of one axis together.

    The most, and of as many those with the first channel of the rig's, keep the name of its group; others are numbered.
    """
    table, moved = default_table(), mapping.resample.method != "none"
    places = {name: number for number, name in enumerate((*table.groups, *table.channels))}
    names = sorted(dict.fromkeys(entry.target.group for entry in taken), key=lambda name: places.get(name, len(places)))
    found: dict[str, list[MappedSignal]] = {}
    for name in names:
        alike: list[list[MappedSignal]] = []
        for entry in (entry for entry in taken if entry.target.group == name):
            own = next((one for one in alike if moved or _on_one_axis(one[0].axis, entry.axis)), None)
            if own is None:
                alike.append([entry])
            else:
                own.append(entry)
        alike.sort(key=lambda one: (-len(one), min(places.get(entry.name, len(places)) for entry in one)))
        free = (text for number in count(2) if (text := f"{name}_{number}") not in names)
        found |= dict(zip((name, *islice(free, len(alike) - 1)), alike, strict=True))
    return found


def _on_one_axis(a: clock.Axis, b: clock.Axis) -> bool:
    """Whether samples of two axes were taken at the same instants, from end to end within a small part of a sample."""
    if (a.times_s is None) != (b.times_s is None):
        return False
    if a.times_s is not None and b.times_s is not None:
        return np.array_equal(a.times_s, b.times_s)
    apart = (b.first_s - a.first_s) * a.rate_hz
    drift = abs(a.rate_hz / b.rate_hz - 1.0) * min(a.rows, b.rows)
    return abs(apart - round(apart)) < _NEAR and drift < clock.EVEN


def _untouched(entries: Sequence[MappedSignal], rate_hz: float) -> bool:
    """Whether all samples already lie on one even axis of the wanted rate."""
    return all(true_rate(entry.axis) == rate_hz and _on_one_axis(entries[0].axis, entry.axis) for entry in entries)


def _next_sample(axis: clock.Axis, time_s: float) -> float:
    # Of an axis with a whole rate within EVEN of a sample, the sample's own time.
    number = math.ceil((time_s - axis.first_s) * axis.rate_hz - 1e-6)
    return axis.first_s + number / axis.rate_hz


def _group_rate(name: str, entries: Sequence[MappedSignal], mapping: Mapping) -> float:
    method = mapping.resample.method
    for entry in entries:
        axis = entry.axis
        if axis.times_s is not None and method != "linear":
            rms, largest = (f"{1e6 * value:.3g} µs" for value in axis.jitter_s)
            must = (
                f'"linear" (or time.stamps = "line", or time.rate_hz), as the time stamps of {entry.entry.name} lie '
                f"up to {largest} (rms {rms}) off even ones of {axis.rate_hz:.6g} Hz"
            )
            raise InputError("resample.method", must, method)
    if method != "none" and mapping.resample.rate_hz is not None:
        return float(mapping.resample.rate_hz)
    if method == "none" and mapping.resample.rate_hz is not None:
        raise InputError("resample.method", '"polyphase" or "linear" with resample.rate_hz', method)
    rates = {true_rate(entry.axis) for entry in entries}
    rate, told = true_rate(entries[0].axis), ", ".join(f"{e.name} {e.axis.rate_hz:.9g} Hz" for e in entries[:6])
    if len(rates) > 1 and method != "none":
        must = f'given with method "{method}", as the rates in {name} are not one (or time.rate_hz'
        raise InputError("resample.rate_hz", f"{must}, where the file rounds its own)", told)
    if not _SLOWEST_HZ <= rate <= _FASTEST_HZ:
        must = f'given, with method "polyphase" or "linear", for rates beyond {_SLOWEST_HZ:g} to {_FASTEST_HZ:g} Hz'
        raise InputError("resample.rate_hz", must, told)
    return rate


def _put(group: PlacedGroup, entry: MappedSignal, mapping: Mapping) -> None:
    """Put a signal on the axis of its group."""
    axis, rate, method = entry.axis, group.rate_hz, mapping.resample.method
    shift = (group.start_s - axis.first_s) * axis.rate_hz
    stays = axis.times_s is None and abs(rate / axis.rate_hz - 1.0) * axis.rows <= clock.EVEN
    if stays and abs(shift - round(shift)) < _NEAR:
        part = slice(round(shift), round(shift) + group.rows)
        entry.values = entry.values[part]
        if entry.signal.values.dtype.kind in "iu" and not entry.missing:
            entry.raw = entry.signal.values[part]
        entry.noise = noise.white_or_not(entry.values)
        return
    if np.isnan(entry.values).any():
        raise InputError(f"channels.{entry.name}.missing", '"hold" where samples are resampled', entry.mapping.missing)
    wanted = group.start_s + np.arange(group.rows) / rate
    # What is drawn between samples has less noise than they, and of another colour.
    entry.noise = noise.white_or_not(entry.values)
    if method == "linear":
        entry.values, gain = clock.linear(entry.values, axis, wanted), clock.linear_gain(axis, wanted)
        how = "straight lines between samples"
    else:
        entry.values = clock.polyphase(entry.values, axis, group.start_s, rate, group.rows)
        how, gain = clock.FILTER, clock.polyphase_gain(axis, rate)
    entry.noise *= gain
    entry.touched.append(f"{axis.rate_hz:.9g} Hz to {rate:.9g} Hz: {how}; noise {gain:.3f} times that of the samples")


def rotate(groups: dict[str, PlacedGroup], mapping: Mapping, remarks: list[str]) -> None:
    """Make x and y of pairs of probes.

    Raises:
        InputError: Two channels that are no pair, or probes that look nearly the same way.
    """
    for number, entry in enumerate(mapping.rotate):
        a, b = entry.channels
        group = next((group.channels for group in groups.values() if {a, b} <= set(group.channels)), None)
        if group is None or group[a].target.unit != group[b].target.unit or a == b:
            raise InputError(f"rotate.{number}.channels", "two channels of one group and unit", Words(f"{a}, {b}"))
        angles = np.radians(entry.angles_deg)
        seen = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        if abs(np.linalg.det(seen)) < 0.1:
            raise InputError(f"rotate.{number}.angles_deg", "well apart (the sine of their difference 0.1 or more)",
                             list(entry.angles_deg))  # fmt: skip
        told = f"probes at {entry.angles_deg[0]:g} and {entry.angles_deg[1]:g} deg"
        inverse = np.linalg.inv(seen)
        mixed = inverse @ np.stack([group[a].values, group[b].values])
        noises = np.hypot(*(inverse * [group[a].noise, group[b].noise]).T)
        for name, values, level in zip((a, b), mixed, noises.tolist(), strict=True):
            group[name].mix(values, noise=level)
            group[name].touched.append(f"x and y of {told}")
        remarks.append(f"{a} and {b} worked out of {told}")


@dataclass(frozen=True)
class ImportedChannel:
    """One channel of the recording, and where it is from."""

    name: str
    unit: str
    source: str
    formula: str
    time: str
    counts: str
    rate_hz: float
    jitter_us: float
    drift_ppm: float
    missing: int
    overrange: int
    low: float
    high: float

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


def quantise(
    groups: dict[str, PlacedGroup],
) -> tuple[ChannelTable, dict[str, np.ndarray], dict[str, np.ndarray], list[ImportedChannel]]:
    """Channel table, int32 counts and present rows by group, and what was done to each channel."""
    tables, counts, present, told = {}, {}, {}, []
    for name, group in groups.items():
        columns, channels = [], []
        for entry in group.channels.values():
            channel, column, rule = _counts(entry, name, group.rate_hz)
            channels.append(channel)
            columns.append(column)
            told.append(_imported(entry, channel, rule, group.rate_hz))
        known = default_table().groups.get(next(iter(group.channels.values())).target.group)
        title = known.title if known is not None else name
        tables[name] = Group(name=name, title=title, rate_hz=channels[0].rate_hz, channels=tuple(channels))
        counts[name] = np.stack(columns, axis=1)
        present[name] = np.all([np.isfinite(entry.values) for entry in group.channels.values()], axis=0)
    return ChannelTable(groups=tables, version=VERSION), counts, present, told


def _counts(entry: MappedSignal, group: str, rate_hz: float) -> tuple[Channel, np.ndarray, str]:
    """A channel with its scale, and its int32 counts.

    Integers that nobody has touched stay as they are. All else is counted in a power of two that leaves the largest
    value between a quarter and a half of int32: half a count is at most 2^-30 of the largest value.
    """
    signal, values, raw, mixed = entry.signal, entry.values, entry.raw, entry.mixed
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
            "noise_v": abs(sensitivity) * entry.noise, "adc_v": reach_v, "adc_bits": BITS,
            "rate_hz": nominal_hz(rate_hz), "group": group,
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


def _imported(entry: MappedSignal, channel: Channel, rule: str, rate_hz: float) -> ImportedChannel:
    unit = units.canonical(entry.mapping.unit or entry.entry.unit or "1")
    source = f"(source {'-' if entry.bias > 0.0 else '+'} {abs(entry.bias):.6g})" if entry.bias else "source"
    ratio = "" if unit == channel.unit else f" {channel.unit} per {unit}".replace(" 1 per", " per")
    gain = f"{entry.gain:.9g}{ratio} * " if ratio or entry.gain != 1.0 else ""
    delay = f", {-entry.mapping.delay_us:+g} µs" if entry.mapping.delay_us else ""
    drift = (entry.axis.rate_hz / channel.rate_hz - 1.0) * 1e6
    drift = drift if abs(drift) < _CLOCK * 1e6 and not entry.touched else 0.0
    return ImportedChannel(
        name=entry.name, unit=channel.unit,
        source=" ".join(text for text in (entry.source.path.name, entry.entry.group, entry.entry.name) if text),
        formula=f"{gain}{source}",
        time=f"{entry.axis.note}{delay}; " + ("; ".join(entry.touched) or "samples as they were"),
        counts=rule, rate_hz=rate_hz, jitter_us=entry.axis.jitter_s[1] * 1e6, drift_ppm=drift, missing=entry.missing,
        overrange=entry.overrange, low=float(np.nanmin(entry.values)), high=float(np.nanmax(entry.values)),
    )  # fmt: skip
