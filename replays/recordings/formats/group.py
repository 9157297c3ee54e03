"""Channels of one sensor group on a common time axis, unmodified or resampled, and their conversion to counts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import count, islice
from typing import Any

import numpy as np

from replays.estimate.spool import ROWS, Spool, blocks, find_extent, spool
from replays.recordings.formats import clock
from replays.recordings.formats.exporting.selection import NO_VOLTS
from replays.recordings.formats.guessing import noise
from replays.recordings.formats.mapped import BITS, MappedSignal
from replays.recordings.formats.mapping import LowPass, Mapping
from rig.base import units
from rig.base.checks import check
from rig.base.errors import InputError, Words
from rig.channels.table import VERSION, Channel, ChannelTable, Group, default_table

_MAX_ROWS_FACTOR, _MAX_EXTRA_ROWS = 1000, 1_000_000
"""Limit of resampled rows: this multiple of the values in the file, plus this number of rows."""
_INSTANT_TOLERANCE = 0.01
"""Largest distance of unmodified samples from the instants of the group [samples]."""
_MIN_VALUE, _MAX_VALUE = 1e-30, 1e30
"""Plausible values of a measurement, in any unit."""
_MIN_RATE_HZ, _MAX_RATE_HZ = 0.01, 1e6
"""Rates that a recording can have [Hz]; its clock has 1e6 ticks per second."""
_ROUNDING = 1e-4
"""Largest accumulated error of a rate written with few digits [samples]."""
_MAX_CLOCK_ERROR = 2e-4
"""Largest relative clock error of a converter."""


@dataclass
class PlacedGroup:
    """Channels of one sensor group on a common axis.

    Attributes:
        rate_hz: True rate, not always a whole number [Hz].
        start_s: Time of the first row, on the clock of the source [s].
        rows: Number of rows.
        channels: Signals on this axis, by name of the channel.
    """

    rate_hz: float
    start_s: float
    rows: int
    channels: dict[str, MappedSignal]


def nominal_hz(rate_hz: float) -> int:
    """Return the nominal rate of a converter [Hz]: the whole number of fewest digits within the clock tolerance."""
    if rate_hz >= 1.0 and float(rate_hz).is_integer():
        return int(rate_hz)
    candidates = (float(f"{rate_hz:.{digits}g}") for digits in range(1, 8))
    return max(1, round(next((each for each in candidates if abs(each / rate_hz - 1.0) < _MAX_CLOCK_ERROR), rate_hz)))


def true_rate(axis: clock.TimeAxis) -> float:
    """Return the rate of even samples [Hz], rounded to a whole number if the accumulated error is negligible."""
    whole = max(1, round(axis.rate_hz))
    if abs(whole - axis.rate_hz) / axis.rate_hz * axis.rows <= clock.EVENNESS_TOLERANCE:
        return float(whole)
    candidates = (float(f"{axis.rate_hz:.{digits}g}") for digits in range(1, 15))  # removes rounding errors
    return next((each for each in candidates if abs(each / axis.rate_hz - 1.0) * axis.rows < _ROUNDING), axis.rate_hz)


def place_groups(
    signals: Sequence[MappedSignal], mapping: Mapping, low_s: float, high_s: float
) -> tuple[dict[str, PlacedGroup], float]:
    """Place all channels on the axes of their groups.

    Returns:
        Groups by name, and the source time that becomes time zero [s].

    Raises:
        InputError: The channels of a group have no common range, or resampling gives too many rows.
    """
    members = _group_signals(signals, mapping)
    order = list(members)
    rates = {name: _group_rate(name, entries, mapping) for name, entries in members.items()}
    first = {name: max(low_s, *(entry.axis.first_s for entry in entries)) for name, entries in members.items()}
    last = {name: min(high_s, *(entry.axis.last_s for entry in entries)) for name, entries in members.items()}
    for name in order:
        if not last[name] - first[name] >= 1.0 / rates[name]:
            spans = ", ".join(f"{e.name} {e.axis.first_s:g} to {e.axis.last_s:g} s" for e in members[name])
            raise InputError("range", f"one in which all channels of {name} have samples ({spans})",
                             Words(f"{first[name]:g} to {last[name]:g} s"))  # fmt: skip
    # Time zero is a sampling instant of the source if its samples are not resampled.
    lead = min(order, key=lambda name: first[name])
    zero_s = _next_sample(members[lead][0].axis, first[lead]) if _is_placed(members[lead], rates[lead]) else first[lead]
    placed = {}
    for name in order:
        entries, rate = members[name], rates[name]
        if mapping.resample.method == "none" or _is_placed(entries, rate):
            start, slack = _next_sample(entries[0].axis, first[name]), clock.EVENNESS_TOLERANCE
        else:
            start, slack = zero_s + math.ceil((first[name] - zero_s) * rate - 1e-6) / rate, 1e-6
        rows = math.floor((last[name] - start) * rate + slack) + 1
        held = max(entry.axis.rows for entry in entries)
        if rows > _MAX_ROWS_FACTOR * held + _MAX_EXTRA_ROWS:
            must = f"such that {held} values in {name} become at most {_MAX_ROWS_FACTOR * held + _MAX_EXTRA_ROWS} rows"
            raise InputError("resample.rate_hz", must, Words(f"{rate} Hz, {rows} rows"))
        placed[name] = PlacedGroup(rate, start, rows, {entry.name: entry for entry in entries})
        for entry in entries:
            _place_signal(placed[name], entry, mapping)
    return placed, zero_s


def _group_signals(signals: Sequence[MappedSignal], mapping: Mapping) -> dict[str, list[MappedSignal]]:
    """Return signals by sensor group, in the order of the rig's table; without resampling, one group per time axis.

    If a group is split, its largest part keeps the name (ties: the part with the first channel); others are numbered.
    """
    table, moved = default_table(), mapping.resample.method != "none"
    places, last = {name: number for number, name in enumerate((*table.groups, *table.channels))}, math.inf
    names = sorted(dict.fromkeys(entry.target.group for entry in signals), key=lambda name: places.get(name, last))
    groups: dict[str, list[MappedSignal]] = {}
    for name in names:
        parts: list[list[MappedSignal]] = []
        for entry in (entry for entry in signals if entry.target.group == name):
            own = next((one for one in parts if moved or _share_axis(one[0].axis, entry.axis)), None)
            if own is None:
                parts.append([entry])
            else:
                own.append(entry)
        parts.sort(key=lambda one: (-len(one), min(places.get(entry.name, len(places)) for entry in one)))
        free = (text for number in count(2) if (text := f"{name}_{number}") not in names)
        groups |= dict(zip((name, *islice(free, len(parts) - 1)), parts, strict=True))
    return groups


def _share_axis(a: clock.TimeAxis, b: clock.TimeAxis) -> bool:
    """Return whether two axes have the same instants, within a small fraction of a sample from end to end."""
    if (a.times_s is None) != (b.times_s is None):
        return False
    if a.times_s is not None and b.times_s is not None:
        return np.array_equal(a.times_s, b.times_s)
    apart = (b.first_s - a.first_s) * a.rate_hz
    drift = abs(a.rate_hz / b.rate_hz - 1.0) * min(a.rows, b.rows)
    return abs(apart - round(apart)) < _INSTANT_TOLERANCE and drift < clock.EVENNESS_TOLERANCE


def _is_placed(entries: Sequence[MappedSignal], rate_hz: float) -> bool:
    """Return whether all samples already lie on one even axis of the requested rate."""
    return all(true_rate(entry.axis) == rate_hz and _share_axis(entries[0].axis, entry.axis) for entry in entries)


def _next_sample(axis: clock.TimeAxis, time_s: float) -> float:
    # On an axis whose rate is a whole number within `EVEN`, this is the sample's own time.
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
                f"up to {largest} (rms {rms}) from an even rate of {axis.rate_hz:.6g} Hz"
            )
            raise InputError("resample.method", must, method)
    if method != "none" and mapping.resample.rate_hz is not None:
        return float(mapping.resample.rate_hz)
    if method == "none" and mapping.resample.rate_hz is not None:
        raise InputError("resample.method", '"polyphase" or "linear" with resample.rate_hz', method)
    rates = {true_rate(entry.axis) for entry in entries}
    rate, rates_text = true_rate(entries[0].axis), ", ".join(f"{e.name} {e.axis.rate_hz:.9g} Hz" for e in entries[:6])
    if len(rates) > 1 and method != "none":
        must = f'set with method "{method}", as rates in {name} differ (or set time.rate_hz'
        raise InputError("resample.rate_hz", f"{must}, if the file has rounded ones)", rates_text)
    if not _MIN_RATE_HZ <= rate <= _MAX_RATE_HZ:
        must = f'set with method "polyphase" or "linear", for rates outside {_MIN_RATE_HZ:g} to {_MAX_RATE_HZ:g} Hz'
        must += " (or file.time_unit, if times are not in the unit assumed)"
        raise InputError("resample.rate_hz", must, rates_text)
    return rate


def _place_signal(group: PlacedGroup, entry: MappedSignal, mapping: Mapping) -> None:
    """Place a signal on the axis of its group."""
    axis, rate, method = entry.axis, group.rate_hz, mapping.resample.method
    shift = (group.start_s - axis.first_s) * axis.rate_hz
    stays = axis.times_s is None and abs(rate / axis.rate_hz - 1.0) * axis.rows <= clock.EVENNESS_TOLERANCE
    if stays and abs(shift - round(shift)) < _INSTANT_TOLERANCE:
        part = slice(round(shift), round(shift) + group.rows)
        entry.values = entry.values[part]
        if entry.signal.values.dtype.kind in "iu" and not entry.missing:
            entry.raw = entry.signal.values[part]
        entry.noise = noise.estimate_noise(entry.values)
        return
    if any(np.isnan(entry.values[rows]).any() for rows in blocks(axis.rows, entry.values)):
        raise InputError(f"channels.{entry.name}.missing", '"hold" where samples are resampled', entry.mapping.missing)
    wanted = group.start_s + np.arange(group.rows) / rate
    # Interpolated samples have less noise, and it is not white.
    entry.noise = noise.estimate_noise(entry.values)
    if method == "linear":
        values, gain = clock.interpolate_linear(entry.values, axis, wanted), clock.linear_gain(axis, wanted)
        how = "straight lines between samples"
    else:
        values = clock.resample_polyphase(entry.values, axis, group.start_s, rate, group.rows)
        how, gain = clock.FILTER, clock.polyphase_gain(axis, rate)
    entry.values = spool([values])
    entry.noise *= gain
    entry.touched.append(f"{axis.rate_hz:.9g} Hz to {rate:.9g} Hz: {how}; noise {gain:.3f} times that of the samples")


def rotate(groups: dict[str, PlacedGroup], mapping: Mapping, remarks: list[str]) -> None:
    """Convert pairs of probes to x and y.

    Raises:
        InputError: Two channels are not a pair, or the angles of two probes are nearly equal.
    """
    for number, entry in enumerate(mapping.rotate):
        a, b = entry.channels
        group = next((group.channels for group in groups.values() if {a, b} <= set(group.channels)), None)
        if group is None or group[a].target.unit != group[b].target.unit or a == b:
            raise InputError(f"rotate.{number}.channels", "two channels of one group and unit", Words(f"{a}, {b}"))
        angles = np.radians(entry.angles_deg)
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        if abs(np.linalg.det(directions)) < 0.1:
            raise InputError(f"rotate.{number}.angles_deg", "different (sine of the difference 0.1 or more)",
                             list(entry.angles_deg))  # fmt: skip
        probes = f"probes at {entry.angles_deg[0]:g} and {entry.angles_deg[1]:g} deg"
        inverse = np.linalg.inv(directions)
        pair, mixed = [group[a].values, group[b].values], (Spool(), Spool())
        for rows in blocks(len(pair[0]), *pair):
            for each, values in zip(mixed, inverse @ np.stack([values[rows] for values in pair]), strict=True):
                each.add(values)
        noises = np.hypot(*(inverse * [group[a].noise, group[b].noise]).T)
        for name, values, level in zip((a, b), mixed, noises.tolist(), strict=True):
            group[name].mix(values.array(), noise=level)
            group[name].touched.append(f"x and y of {probes}")
        remarks.append(f"{a} and {b} computed from {probes}")


@dataclass(frozen=True)
class ImportedChannel:
    """Description of an imported channel and its origin."""

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
        """Return the description as JSON."""
        return asdict(self)


def quantise(
    groups: dict[str, PlacedGroup],
) -> tuple[ChannelTable, dict[str, np.ndarray], dict[str, np.ndarray], list[ImportedChannel]]:
    """Return channel table, int32 counts and present rows by group, and a description of each channel."""
    tables, counts, present, imported = {}, {}, {}, []
    for name, group in groups.items():
        columns, channels = [], []
        for entry in group.channels.values():
            channel, column, rule = _counts(entry, name, group.rate_hz)
            channels.append(channel)
            columns.append(column)
            imported.append(_make_imported_channel(entry, channel, rule, group.rate_hz))
        signals, raw = [e.values for e in group.channels.values()], [e.raw for e in group.channels.values()]
        default_group = default_table().groups.get(next(iter(group.channels.values())).target.group)
        title = default_group.title if default_group is not None else name
        tables[name] = Group(name=name, title=title, rate_hz=channels[0].rate_hz, channels=tuple(channels))
        everything = [*signals, *(each for each in raw if each is not None)]
        size = ROWS // len(columns) + 1
        counts[name] = spool(
            np.stack([column(rows) for column in columns], axis=1)
            for rows in blocks(group.rows, *everything, size=size)
        )
        present[name] = spool(
            np.all([np.isfinite(values[rows]) for values in signals], axis=0)
            for rows in blocks(group.rows, *signals, size=size)
        )
    return ChannelTable(groups=tables, version=VERSION), counts, present, imported


def _counts(entry: MappedSignal, group: str, rate_hz: float) -> tuple[Channel, Callable[[slice], np.ndarray], str]:
    """Return a channel with its scale, the function that gives some rows of int32 counts, and the rule of its counts.

    Unmodified integers are kept. Other values are scaled by a power of two that puts the largest between a quarter and
    half of the int32 range, so that half a count is at most 2^-30 of it.
    """
    signal, values, raw, mixed = entry.signal, entry.values, entry.raw, entry.mixed
    limits = np.iinfo(np.int32)
    keeps = False
    if raw is not None and len(raw):
        ends = [(int(raw[rows].min()), int(raw[rows].max())) for rows in blocks(len(raw), raw)]
        keeps = min(ends)[0] >= limits.min and max(high for _, high in ends) <= limits.max
    volts_per_unit = None if entry.volts is None or mixed else entry.volts / entry.gain
    if keeps:
        scale = entry.gain * signal.scale
        offset = entry.gain * (signal.offset - entry.bias)
    else:
        # Counts of a voltage are relative to 0 V, as those of a converter.
        offset = 0.0 if volts_per_unit is None else -entry.gain * entry.bias
        largest = float(np.nanmax(np.abs(find_extent(values, offset)), initial=0.0))
        if largest and not _MIN_VALUE <= largest <= _MAX_VALUE:
            raise InputError(f"channels.{entry.name}", f"of values from {_MIN_VALUE:g} to {_MAX_VALUE:g}", largest)
        scale = math.ldexp(1.0, math.frexp(largest)[1] - 30) if largest else math.ldexp(1.0, -30)
        scale = math.copysign(scale, 1.0 if volts_per_unit is None else volts_per_unit)
    if not (_MIN_VALUE * 1e-10 <= abs(scale) <= _MAX_VALUE and abs(offset) <= _MAX_VALUE):
        raise InputError(f"channels.{entry.name}", f"of counts from {_MIN_VALUE * 1e-10:g} to {_MAX_VALUE:g}", scale)
    # If the voltage is unknown, one unit is represented by 1 V.
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
    shapeless = channel.model_dump(exclude={*LowPass.model_fields} - {"bandwidth_hz"})
    channel = check(Channel, shapeless | entry.mapping.shape, field=f"channels.{entry.name}")
    if keeps and raw is not None:
        rule = f"integers of the source, {abs(channel.scale):.6g} {channel.unit} each"
        return channel, lambda rows: raw[rows].astype(np.int32), rule

    def quantise_rows(rows: slice) -> np.ndarray:
        counts = np.rint((np.nan_to_num(values[rows]) - channel.offset) / channel.scale)
        if len(counts) and not limits.min <= counts.min() <= counts.max() <= limits.max:
            largest = float(np.nanmax(np.abs(find_extent(values))))
            raise InputError(f"channels.{entry.name}", "within the range of its counts", largest)
        return counts.astype(np.int32)

    return channel, quantise_rows, f"2^{round(math.log2(abs(scale)))} {channel.unit}"


def _make_imported_channel(entry: MappedSignal, channel: Channel, rule: str, rate_hz: float) -> ImportedChannel:
    unit = units.canonical(entry.mapping.unit or entry.entry.unit or "1")
    source = f"(source {'-' if entry.bias > 0.0 else '+'} {abs(entry.bias):.6g})" if entry.bias else "source"
    ratio = "" if unit == channel.unit else f" {channel.unit} per {unit}".replace(" 1 per", " per")
    gain = f"{entry.gain:.9g}{ratio} * " if ratio or entry.gain != 1.0 else ""
    delay = f", {-entry.mapping.delay_us:+g} µs" if entry.mapping.delay_us else ""
    drift = (entry.axis.rate_hz / channel.rate_hz - 1.0) * 1e6
    low, high = find_extent(entry.values)
    drift = drift if abs(drift) < _MAX_CLOCK_ERROR * 1e6 and not entry.touched else 0.0
    return ImportedChannel(
        name=entry.name, unit=channel.unit,
        source=" ".join(text for text in (entry.source.path.name, entry.entry.group, entry.entry.name) if text),
        formula=f"{gain}{source}",
        time=f"{entry.axis.note}{delay}; " + ("; ".join(entry.touched) or "samples as they were"),
        counts=rule, rate_hz=rate_hz, jitter_us=entry.axis.jitter_s[1] * 1e6, drift_ppm=drift, missing=entry.missing,
        overrange=entry.overrange, low=low, high=high,
    )  # fmt: skip
