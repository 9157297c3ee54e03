"""Where mapped signals lie in time: all channels of a group on one axis, untouched or at other instants."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from replays.recordings.formats import clock
from replays.recordings.formats.mapped import MappedSignal
from replays.recordings.formats.mapping import Mapping
from rig.channels import default_table
from rig.errors import InputError

_MOST_TIMES, _MOST_ROWS = 1000, 1_000_000
"""So many times the values that a file has, and so many rows more, samples may become at another rate."""
_NEAR = 0.01
"""Part of a sample by which untouched samples may lie beside the instants that they are given."""


@dataclass
class PlacedGroup:
    """Channels of one sensor group on one axis.

    Attributes:
        rate_hz: Their rate [Hz].
        start_s: Time of the first row, in the time of the source [s].
        rows: Number of rows.
        values: Engineering values by channel, nan where missing, each shape (rows,).
        raw: Integers of the source by channel, where they are untouched, each shape (rows,).
        taken: Where each is from.
    """

    rate_hz: int
    start_s: float
    rows: int
    values: dict[str, np.ndarray]
    raw: dict[str, np.ndarray]
    taken: dict[str, MappedSignal]


def whole_rate(axis: clock.Axis) -> int | None:
    """The whole rate that an axis has, within a small part of a sample from end to end; None: it has none."""
    rate = round(axis.rate_hz)
    if axis.times_s is not None or rate < 1 or abs(rate - axis.rate_hz) / axis.rate_hz * axis.rows > clock.EVEN:
        return None
    return rate


def place(
    taken: Sequence[MappedSignal], mapping: Mapping, low_s: float, high_s: float
) -> tuple[dict[str, PlacedGroup], float]:
    """All channels on the axes of their groups, and the time in the source that becomes zero [s]."""
    names = list(dict.fromkeys(entry.target.group for entry in taken))
    order = [name for name in default_table().groups if name in names]
    order += [name for name in names if name not in order]
    members = {name: [entry for entry in taken if entry.target.group == name] for name in order}
    rates = {name: _group_rate(name, entries, mapping) for name, entries in members.items()}
    first = {name: max(low_s, *(entry.axis.first_s for entry in entries)) for name, entries in members.items()}
    last = {name: min(high_s, *(entry.axis.last_s for entry in entries)) for name, entries in members.items()}
    for name in order:
        if not last[name] - first[name] >= 1.0 / rates[name]:
            spans = ", ".join(f"{e.name} {e.axis.first_s:g} to {e.axis.last_s:g} s" for e in members[name])
            raise InputError("range", f"one in which all channels of {name} have samples ({spans})",
                             f"{first[name]:g} to {last[name]:g} s")  # fmt: skip
    # Time zero is an instant of the source wherever its samples stay as they are.
    lead = min(order, key=lambda name: first[name])
    zero_s = _next_sample(members[lead][0].axis, first[lead]) if _untouched(members[lead], rates[lead]) else first[lead]
    placed = {}
    for name in order:
        entries, rate = members[name], rates[name]
        if mapping.resample.method == "none" or _untouched(entries, rate):
            start, hair = _next_sample(entries[0].axis, first[name]), clock.EVEN
        else:
            start, hair = zero_s + math.ceil((first[name] - zero_s) * rate - 1e-6) / rate, 1e-6
        rows = math.floor((last[name] - start) * rate + hair) + 1
        held = max(entry.axis.rows for entry in entries)
        if rows > _MOST_TIMES * held + _MOST_ROWS:
            must = f"such that {held} values in {name} become at most {_MOST_TIMES * held + _MOST_ROWS} rows"
            raise InputError("resample.rate_hz", must, f"{rate} Hz, {rows} rows")
        group = PlacedGroup(rate, start, rows, {}, {}, {entry.name: entry for entry in entries})
        for entry in entries:
            _put(group, entry, mapping)
        placed[name] = group
    return placed, zero_s


def _untouched(entries: Sequence[MappedSignal], rate_hz: int) -> bool:
    """Whether all samples already lie on one even axis of the wanted rate."""
    base = entries[0].axis
    return all(
        whole_rate(entry.axis) == rate_hz
        and abs((entry.axis.first_s - base.first_s) * rate_hz - round((entry.axis.first_s - base.first_s) * rate_hz))
        < _NEAR
        for entry in entries
    )


def _next_sample(axis: clock.Axis, time_s: float) -> float:
    # Of an axis with a whole rate within EVEN of a sample, the sample's own time.
    number = math.ceil((time_s - axis.first_s) * axis.rate_hz - 1e-6)
    return axis.first_s + number / axis.rate_hz


def _group_rate(name: str, entries: Sequence[MappedSignal], mapping: Mapping) -> int:
    method = mapping.resample.method
    for entry in entries:
        axis = entry.axis
        if axis.times_s is not None and method != "linear":
            rms, largest = (f"{1e6 * value:.3g} us" for value in axis.jitter_s)
            must = (
                f'"linear" (or time.stamps = "line", or time.rate_hz), as the time stamps of {entry.entry.name} lie '
                f"up to {largest} (rms {rms}) off even ones of {axis.rate_hz:.6g} Hz"
            )
            raise InputError("resample.method", must, method)
    if method != "none" and mapping.resample.rate_hz is not None:
        return mapping.resample.rate_hz
    if method == "none" and mapping.resample.rate_hz is not None:
        raise InputError("resample.method", '"polyphase" or "linear" with resample.rate_hz', method)
    rates = {whole_rate(entry.axis) for entry in entries}
    if len(rates) == 1 and None not in rates:
        return next(rate for rate in rates if rate is not None)
    told = ", ".join(f"{entry.name} {entry.axis.rate_hz:.9g} Hz" for entry in entries[:6])
    why = "no whole number" if len(rates) == 1 else "not one rate"
    must = f'given, with method "polyphase" or "linear", as the rates in {name} are {why} (or time.rate_hz'
    raise InputError("resample.rate_hz", f"{must}, where the file rounds its own)", told)


def _put(group: PlacedGroup, entry: MappedSignal, mapping: Mapping) -> None:
    """Put a signal on the axis of its group."""
    axis, rate, method = entry.axis, group.rate_hz, mapping.resample.method
    shift = (group.start_s - axis.first_s) * axis.rate_hz
    if whole_rate(axis) == rate and abs(shift - round(shift)) < _NEAR:
        part = slice(round(shift), round(shift) + group.rows)
        group.values[entry.name] = entry.values[part]
        if entry.signal.values.dtype.kind in "iu" and not entry.missing:
            group.raw[entry.name] = entry.signal.values[part]
        return
    if method == "none":
        if whole_rate(axis) != rate:
            must = f'"polyphase" or "linear", as {entry.name} has {axis.rate_hz:.9g} Hz'
        else:
            must = (
                f'"polyphase" or "linear", as {entry.name} has to move by {abs(shift - round(shift)):.3f} of a sample'
            )
        raise InputError("resample.method", must, method)
    if np.isnan(entry.values).any():
        raise InputError(f"channels.{entry.name}.missing", '"hold" where samples are resampled', entry.mapping.missing)
    wanted = group.start_s + np.arange(group.rows) / rate
    if method == "linear":
        group.values[entry.name] = clock.linear(entry.values, axis, wanted)
        entry.touched.append(f"{axis.rate_hz:.9g} Hz to {rate} Hz: straight lines between samples")
    else:
        group.values[entry.name] = clock.polyphase(entry.values, axis, group.start_s, rate, group.rows)
        entry.touched.append(f"{axis.rate_hz:.9g} Hz to {rate} Hz: {clock.FILTER}")


def rotate(groups: dict[str, PlacedGroup], mapping: Mapping, remarks: list[str]) -> set[str]:
    """Make x and y of pairs of probes; gives the channels that were so.

    Raises:
        InputError: Two channels that are no pair, or probes that look nearly the same way.
    """
    rotated: set[str] = set()
    for number, entry in enumerate(mapping.rotate):
        a, b = entry.channels
        group = next((group for group in groups.values() if a in group.values and b in group.values), None)
        if group is None or group.taken[a].target.unit != group.taken[b].target.unit or a == b:
            raise InputError(f"rotate.{number}.channels", "two channels of one group and unit", f"{a}, {b}")
        angles = np.radians(entry.angles_deg)
        seen = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        if abs(np.linalg.det(seen)) < 0.1:
            raise InputError(f"rotate.{number}.angles_deg", "well apart (the sine of their difference 0.1 or more)",
                             list(entry.angles_deg))  # fmt: skip
        x, y = np.linalg.inv(seen) @ np.stack([group.values[a], group.values[b]])
        group.values[a], group.values[b] = x, y
        for name in (a, b):
            group.raw.pop(name, None)
            group.taken[name].touched.append(
                f"x and y of probes at {entry.angles_deg[0]:g} and {entry.angles_deg[1]:g} deg"
            )
        rotated |= {a, b}
        told = f"{entry.angles_deg[0]:g} and {entry.angles_deg[1]:g} deg"
        remarks.append(f"{a} and {b} worked out of probes at {told}")
    return rotated
