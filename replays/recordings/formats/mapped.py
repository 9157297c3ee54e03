"""Mapped signals: located in their files, aligned on a common clock, and converted to the channel's unit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from replays.estimate.spool import are_equal, blocks, nan_mean, spool
from replays.recordings.formats import clock
from replays.recordings.formats.mapping import ChannelMapping, Mapping, SignalName
from replays.recordings.formats.source import Entry, FileSignal, Source, even_rate_hz, open_source
from rig.base import units
from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.text import find_similar
from rig.channels.formula import Formulas
from rig.channels.table import Channel, default_table
from rig.physics.parameters import load_parameters

BITS = 32
"""Word length of the counts of an imported channel."""
_RATE_TOLERANCE = 0.01
"""Relative error to which a file may round its rate; a larger difference from the mapping is an error."""


@dataclass
class MappedSignal:
    """Mapped signal during conversion."""

    name: str
    mapping: ChannelMapping
    source: Source
    entry: Entry
    signal: FileSignal
    axis: clock.TimeAxis
    target: Channel
    gain: float
    """Channel unit per source unit, with sign and factor."""
    volts: float | None
    """Volts per source unit, if the unit is a voltage."""
    bias: float = 0.0
    values: np.ndarray = field(default_factory=lambda: np.empty(0))
    """Engineering values, nan if missing, first on their own axis, later on that of the group, shape (rows,)."""
    raw: np.ndarray | None = None
    """Unmodified integers of the source on the axis of the group, shape (rows,); None if modified."""
    mixed: bool = False
    """True if computed from two signals."""
    touched: list[str] = field(default_factory=list)
    """Processing steps that changed samples."""
    missing: int = 0
    overrange: int = 0
    noise: float = 0.0
    """Standard deviation of the noise of `values`, with the processing taken into account."""

    def mix(self, values: np.ndarray, *, noise: float) -> None:
        """Replace the values by a combination of two signals, with its noise."""
        self.values, self.raw, self.mixed, self.noise = values, None, True, noise


class Log:
    """Files of one log with their mapping.

    Attributes:
        mapping: Assignment of signals to channels.
        sources: The files; the first one's clock is the reference.
        remarks: Processing and assumptions, in order.
    """

    def __init__(self, files: Sequence[Path], mapping: Mapping) -> None:
        if len({path.name for path in files}) < len(files):
            raise InputError("file", "files of different names", ", ".join(path.name for path in files))
        self.mapping = mapping
        self.sources = [open_source(path, mapping.file) for path in files]
        self.remarks = [f"{source.path.name}: {remark}" for source in self.sources for remark in source.remarks]
        self._stamps: tuple[np.ndarray, clock.TimeAxis] | None = None  # of the signal before, often the same
        self._moves: list[tuple[str, str | None, clock.Shift]] = []  # by file, or by group in a file

    def find(self, wanted: SignalName, where: str) -> tuple[Source, Entry]:
        """Return the one signal with a name.

        Args:
            wanted: Name, and optionally group and file.
            where: Field of the mapping, for errors.

        Raises:
            InputError: No signal has the name, or several have it.
        """
        sources = self.sources
        if wanted.file is not None and all(source.path.name != wanted.file for source in sources):
            raise InputError(f"{where}.file", f"one of {', '.join(s.path.name for s in sources)}", wanted.file)
        inside = [
            (source, entry)
            for source in sources
            if wanted.file in (None, source.path.name)
            for entry in source.entries
            if wanted.group in (None, entry.group)
        ]
        matches = [pair for pair in inside if pair[1].name == wanted.source]
        if len(matches) == 1:
            return matches[0]
        if matches:
            places = ", ".join(f"{source.path.name} {entry.group}".strip() for source, entry in matches)
            raise InputError(f"{where}.group", f"set, as {wanted.source} occurs in {places}", wanted.group or None)
        if not inside:
            groups = dict.fromkeys(e.group for s in sources if wanted.file in (None, s.path.name) for e in s.entries)
            must = f"one of {', '.join(groups)}" if any(groups) else "omitted: the file has no groups"
            raise InputError(f"{where}.group", must, wanted.group)
        names = [entry.name for _, entry in inside]
        raise UnknownNameError(f"{where}.source", "a signal of the file", wanted.source, names)

    def read(self, source: Source, entry: Entry, where: str) -> tuple[FileSignal, clock.TimeAxis]:
        """Return a signal and its time axis; nan for samples missing from an even one.

        Raises:
            InputError: The signal is empty, its rate is unknown, or its time stamps do not ascend.
        """
        signal = source.read(entry)
        if not len(signal.values):
            raise InputError(where, "a signal with values", Words(f"{entry.name}, which is empty"))
        axis = self._axis(signal, f"{entry.name} in {source.path.name}")
        signal = replace(signal, times_s=None)
        if axis.numbers is not None:
            signal = replace(signal, values=axis.place_samples(signal.values))
        return signal, axis

    def _axis(self, signal: FileSignal, what: str) -> clock.TimeAxis:
        """Return the time axis of a signal, from the file or the mapping."""
        rows, time = len(signal.values), self.mapping.time
        if time.rate_hz is not None:
            rate_hz = signal.rate_hz if signal.times_s is None else even_rate_hz(signal.times_s)
            if rate_hz is not None and abs(rate_hz / time.rate_hz - 1.0) > _RATE_TOLERANCE:
                must = f'within {_RATE_TOLERANCE:.0%} of the {rate_hz:.6g} Hz of {what} (or file.time_column = "none")'
                raise InputError("time.rate_hz", must, time.rate_hz)
            first_s = signal.first_s if signal.times_s is None else float(signal.times_s[0])
            return clock.TimeAxis(first_s, time.rate_hz, rows, note="rate from the mapping")
        if signal.times_s is not None:
            if self._stamps is None or not are_equal(self._stamps[0], signal.times_s):
                axis = clock.make_axis(signal.times_s, line=time.stamps == "line", what=what)
                self._stamps = (signal.times_s, axis)
            axis = self._stamps[1]
            name = what.rpartition(" in ")[2]
            if axis.steps and (remark := f"{name}: {clock.describe_steps(axis.steps)}") not in self.remarks:
                self.remarks.append(remark)
            return axis
        if signal.rate_hz is not None:
            return clock.TimeAxis(signal.first_s, signal.rate_hz, rows, note="rate from the file")
        raise InputError("time.rate_hz", f"set, as the file has no rate for {what}", None)

    def take(self, name: str, wanted: ChannelMapping) -> MappedSignal:
        """Find and read the signal of a channel.

        Raises:
            InputError: The signal does not exist, or its unit cannot be converted to the channel's.
        """
        where = f"channels.{name}"
        source, entry = self.find(wanted, where)
        target = default_table().channels.get(name)
        if target is None:
            if wanted.to is None or wanted.to_unit is None:
                close = find_similar(name, default_table().channels, most=1)
                hint = f" (such as {close[0]})" if close else ""
                must = f"a channel of the rig{hint}, or one with `to` (a group) and `to_unit`"
                raise InputError(where, must, name)
            if "/" in wanted.to or "/" in name or not wanted.to:
                raise InputError(f"{where}.to", "a plain name", wanted.to)
            if wanted.signal is not None:
                Formulas(load_parameters().numbers()).column(name, wanted.signal)
            target = _foreign_channel(name, wanted.to, units.canonical(wanted.to_unit), wanted.signal or "")
        elif extra := wanted.to or wanted.to_unit or wanted.signal:
            raise InputError(f"{where}.to", f"omitted, as {name} is one of the rig's channels", extra)
        unit = entry.unit if wanted.unit is None else wanted.unit
        volts = units.size_si(unit) if units.get_quantity(unit) == "voltage" else None
        if wanted.bits is not None:
            raise InputError(f"{where}.bits", "omitted, as only `rig score` uses it", wanted.bits)
        if wanted.sensitivity is not None:
            per_unit_v = units.sensitivity_v(wanted.sensitivity, target.unit, field=f"{where}.sensitivity")
            if volts is None:
                raise InputError(f"{where}.unit", "V or mV with a sensitivity", unit or None)
            gain = volts / per_unit_v
        else:
            if wanted.unit is None and not entry.unit and target.unit != "1":
                raise InputError(f"{where}.unit", f"set, as {source.path.name} has none", None)
            # A pulse train may stay in volts: only its crossings of a level matter.
            pulse = volts is not None and target.unit == "1"
            gain = volts if pulse and volts is not None else units.factor(unit, target.unit, field=f"{where}.unit")
        signal, axis = self.read(source, entry, where)
        return MappedSignal(
            name=name, mapping=wanted, source=source, entry=entry, signal=signal, axis=axis, target=target,
            gain=gain * wanted.sign * wanted.factor, volts=volts,
        )  # fmt: skip

    def align(self) -> None:
        """Determine the clock shift of each file and group, in the order of the mapping.

        Raises:
            InputError: The common signal of two clocks is not found.
        """
        self._align_start_times()
        for number, wanted_align in enumerate(self.mapping.align):
            where = f"align.{number}"
            pairs, places = [], []
            for wanted, side in ((wanted_align.reference, "reference"), (wanted_align.moved, "moved")):
                source, entry = self.find(wanted, f"{where}.{side}")
                signal, axis = self.read(source, entry, f"{where}.{side}")
                pairs.append((signal.physical, self.align_clock(axis, source, entry)))
                places.append((source, entry))
            (source, entry), (base, base_entry) = places[1], places[0]
            group = entry.group if wanted_align.scope == "group" else None
            if source is base and (group is None or group == base_entry.group):
                must = 'of another file than the reference (or of another group: scope "group")'
                raise InputError(f"{where}.moved", must, wanted_align.moved.source)
            if wanted_align.method == "edge":
                shift = clock.shift_by_edges(
                    pairs[0], pairs[1], threshold=wanted_align.threshold, within_s=wanted_align.within_s
                )
            else:
                shift = clock.shift_by_correlation(pairs[0], pairs[1], within_s=wanted_align.within_s)
            self._moves.append((source.path.name, group, shift))
            what = source.path.name if group is None else f"{source.path.name}, group {group}"
            self.remarks.append(
                f"{what}: moved by {shift.offset_s * 1e3:+.4f} ms, {shift.note} of {wanted_align.moved.source}"
            )

    def align_clock(self, axis: clock.TimeAxis, source: Source, entry: Entry) -> clock.TimeAxis:
        """Return the time axis of a signal on the clock of the first file."""
        for file, group, shift in self._moves:
            if file == source.path.name and group in (None, entry.group):
                axis = axis.shift(shift.offset_s, shift.stretch)
        return axis

    def _align_start_times(self) -> None:
        """Align the files by their wall-clock start times."""
        sources = self.sources
        base = sources[0].start
        for source in sources[1:]:
            if base is None or source.start is None:
                self.remarks.append(
                    f"{source.path.name}: assumed to start with {sources[0].path.name}, before any alignment"
                )
                continue
            late_s = (_utc(source.start) - _utc(base)).total_seconds()
            self._moves.append((source.path.name, None, clock.Shift(late_s, 1.0, "")))
            zones = {source.start.tzinfo is None, base.tzinfo is None}
            unsure = " (one of them without a time zone, read as UTC)" if len(zones) > 1 else ""
            self.remarks.append(f"{source.path.name}: {late_s:+.6f} s by the start times in the files{unsure}")


def _foreign_channel(name: str, group: str, unit: str, signal: str) -> Channel:
    """Return a channel that the rig does not have."""
    return Channel(
        name=name, label=name, group=group, signal=signal, unit=unit, si=units.size_si(unit), sensitivity_v=1.0,
        bias_v=0.0, range_v=(-1.0, 1.0), bandwidth_hz=1.0, highpass_hz=0.0, noise_v=0.0, adc_v=1.0, adc_bits=BITS,
        rate_hz=1, kind="imported",
    )  # fmt: skip


def _utc(moment: datetime) -> datetime:
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)


def check_rows(signals: Sequence[MappedSignal]) -> None:
    """Check that each signal has two values or more.

    Raises:
        InputError: The first one that has not.
    """
    for entry in signals:
        if entry.axis.rows < 2:
            raise InputError(f"channels.{entry.name}", "a signal of two or more values", entry.axis.rows)


def _is_inside(times_s: np.ndarray, mapping: Mapping) -> np.ndarray:
    low, high = mapping.time.from_s, mapping.time.to_s
    return (times_s >= (-math.inf if low is None else low)) & (times_s <= (math.inf if high is None else high))


def convert_to_engineering(entry: MappedSignal, mapping: Mapping) -> None:
    """Convert values to the channel's unit; count missing and overrange values and treat missing ones."""
    wanted, where, signal, rows = entry.mapping, f"channels.{entry.name}", entry.signal, len(entry.signal.values)
    first_bad: int | None = None
    first_good: float | None = None
    for part in blocks(rows, signal.values):
        physical = signal.convert(part)
        good = np.isfinite(physical)
        entry.missing += int((~good).sum())
        if first_bad is None and not good.all():
            first_bad = part.start + int(np.argmin(good))
        if first_good is None and good.any():
            first_good = float(physical[np.argmax(good)])
        if wanted.full_scale is not None:
            entry.overrange += int((np.abs(physical) >= wanted.full_scale).sum())
        elif signal.rails is not None:
            low, high = signal.rails
            entry.overrange += int(((signal.values[part] <= low) | (signal.values[part] >= high)).sum())
    if first_good is None:
        raise InputError(where, "a signal with finite values", entry.entry.name)
    if first_bad is not None:
        if wanted.missing == "refuse":
            time_s = float(entry.axis.instants()[first_bad])
            must = 'free of missing values (missing = "gap" or "hold")'
            text = f"{entry.missing} of them, the first in row {first_bad + 1} at {time_s:g} s"
            raise InputError(where, must, Words(text))
        if wanted.missing == "hold":
            entry.touched.append(f"{entry.missing} missing values held")

    def fill() -> Iterator[tuple[slice, np.ndarray]]:
        """Yield physical values in which missing ones are nan, or the value before."""
        last = first_good
        for part in blocks(rows, signal.values):
            physical = signal.convert(part)
            good = np.isfinite(physical)
            if wanted.missing == "hold":
                before = np.maximum.accumulate(np.where(good, np.arange(len(good)), -1))
                physical = np.where(before < 0, last, physical[before])
                last = physical[-1]
            yield part, np.where(np.isfinite(physical), physical, np.nan)

    if wanted.bias == "mean":
        inside = spool(values[_is_inside(entry.axis.instants(part), mapping)] for part, values in fill())
        entry.bias = nan_mean(inside) if len(inside) else 0.0
    else:
        entry.bias = float(wanted.bias)
    entry.values = spool(entry.gain * (values - entry.bias) for _, values in fill())
