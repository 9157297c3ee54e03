"""Conversion of other systems' logs to recordings: counts, calibration, edges, events and a record of each step."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from heapq import merge
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from replays.estimate.runs import find_true_runs
from replays.estimate.spool import find_extent, release
from replays.recordings.formats import clock
from replays.recordings.formats.events import events
from replays.recordings.formats.events.motion import ChannelMotion
from replays.recordings.formats.events.pulses import HammerPulse, find_pulses
from replays.recordings.formats.group import ImportedChannel, PlacedGroup, nominal_hz, place_groups, quantise, rotate
from replays.recordings.formats.mapped import Log, MappedSignal, check_rows, convert_to_engineering
from replays.recordings.formats.mapping import Mapping
from rig.base import wire
from rig.base.errors import InputError, Words
from rig.base.files import open_file
from rig.channels.table import ChannelTable, default_table

TICK_RATE_HZ = 1_000_000
_BLOCK_S = 0.05
_BUTTERWORTH_DELAY = 2.6131 / (2.0 * math.pi)
"""Delay of a 4th-order Butterworth low-pass far below its corner, times the corner [1]."""
_MAX_CORNER_RATIO = 1.01
"""Ratio up to which a corner may exceed half of the rate, as clocks are inaccurate."""
_SETTLING_FRACTION = 0.25
"""Fraction of the interval between two hammer pulses after which a log may be cut to validate the second one."""
NO_SCENE = "none (imported)"
_EPOCH_S = (946_684_800.0, 4_102_444_800.0)
"""Times from 2000 to 2100 [s since 1970]; a clock that starts at 0 does not reach them."""


@dataclass(frozen=True)
class Conversion:
    """Recording ready to be written.

    Attributes:
        table: Channel table.
        counts: int32 counts by group, shape (rows, channels).
        present: Mask of the rows that exist, by group, shape (rows,).
        first_s: Time of the first row [s], by group.
        rates_hz: True rate [Hz], by group; equals the rate in the table if that is a whole number.
        edges: Keyphasor edges [ticks], float64, shape (turns,).
        pulses: Detected hammer pulses.
        channels: Processing of each channel.
        remarks: Processing and assumptions that concern the whole recording.
        document: All of these with the mapping and the files, as JSON.
        start: Wall time of the recording's time zero.
        experiment: Scene, parameters and scene document, or None.
    """

    table: ChannelTable
    counts: dict[str, np.ndarray]
    present: dict[str, np.ndarray]
    first_s: dict[str, float]
    rates_hz: dict[str, float]
    edges: np.ndarray
    pulses: tuple[HammerPulse, ...]
    channels: tuple[ImportedChannel, ...]
    remarks: tuple[str, ...]
    document: dict[str, Any]
    start: datetime
    experiment: events.ExperimentDocuments | None

    @property
    def end_tick(self) -> int:
        """Tick after the last row."""
        return max(
            round(self.first_s[name] * TICK_RATE_HZ) + math.ceil(len(rows) * TICK_RATE_HZ / self.rates_hz[name])
            for name, rows in self.counts.items()
        )


def convert(
    files: Sequence[Path],
    mapping: Mapping,
    *,
    doubts: Sequence[str] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Conversion:
    """Read files and convert them according to a mapping.

    Args:
        files: The files; the first one's clock is the reference, to which others are aligned.
        mapping: Assignment of signals to channels.
        doubts: Guessed parts of the mapping, added to the remarks.
        say: Callback for the current step.

    Raises:
        InputError: The files contradict the mapping, or data would be lost without notice.
    """
    log = Log(files, mapping)
    remarks = log.remarks
    remarks += doubts
    say("reading")
    signals = [log.take(name, wanted) for name, wanted in mapping.channels.items()]
    uses: dict[tuple[Path, str | None, str], list[str]] = {}
    for one in signals:
        uses.setdefault((one.source.path, one.entry.group, one.entry.name), []).append(one.name)
    remarks += [f"{' and '.join(names)} have the same source, {key[-1]}" for key, names in uses.items() if names[1:]]
    say("aligning")
    log.align()
    for entry in signals:
        axis = log.align_clock(entry.axis, entry.source, entry.entry)
        entry.axis = axis.shift(-entry.mapping.delay_us * 1e-6)
    check_rows(signals)
    for entry in signals:
        _check_corner(entry, mapping, remarks)
        convert_to_engineering(entry, mapping)
        if entry.bias:
            how = "its mean" if entry.mapping.bias == "mean" else "by the mapping"
            unit = entry.mapping.unit or entry.entry.unit
            remarks.append(f"{entry.name}: an offset of {entry.bias:.6g} {unit} was subtracted ({how}, bias)")
    pulses, low_s, high_s = _range(signals, log)
    say("placing samples")
    groups, zero_s = place_groups(signals, mapping, low_s, high_s)
    rotate(groups, mapping, remarks)
    remarks += [*_describe_axes(groups), *_describe_filters(groups)]
    table, counts, present, channels = quantise(groups)
    lead_s = (mapping.experiment.lead_s or 0.0) if mapping.experiment is not None else 0.0
    rates_hz = {name: group.rate_hz for name, group in groups.items()}
    whole = [rate for rate in rates_hz.values() if rate.is_integer()]
    if any(abs(lead_s * rate - round(lead_s * rate)) > 1e-6 for rate in whole):
        raise InputError("experiment.lead_s", "a whole number of samples", lead_s)
    if not (leading := min(groups.values(), key=lambda group: group.start_s).rate_hz).is_integer():
        lead_s = math.ceil(lead_s * leading - 1e-6) / leading  # so that rows are whole multiples of its period
    zero_s -= lead_s
    if lead_s:
        remarks.append(f"time zero, the start of the scene, is {lead_s:g} s before the first sample")
    first_s = {name: group.start_s - zero_s for name, group in groups.items()}
    edges = _edges(log, zero_s, groups)
    shifted = tuple(replace(pulse, at_s=pulse.at_s - zero_s) for pulse in pulses)
    kept = tuple(pulse for pulse in shifted if pulse.at_s >= 0.0)
    begin = _start_time(log, zero_s)
    end_s = max(first_s[name] + group.rows / group.rate_hz for name, group in groups.items())
    experiment = None
    if mapping.experiment is not None:
        motions = [
            ChannelMotion(channel, entry.values, clock.TimeAxis(first_s[name], group.rate_hz, group.rows))
            for name, group in groups.items()
            for channel, entry in group.channels.items()
        ]
        experiment = events.build_experiment(
            mapping.experiment, kept, duration_s=end_s, motions=motions, edges=edges, table=table, remarks=remarks
        )
    document = {
        "files": [
            {"name": source.path.name, "format": source.format, "sha256": _digest(source.path), **source.about}
            for source in log.sources
        ],
        "zero_s": zero_s,
        "start": begin.isoformat(),
        "mapping": mapping.document(),
        "channels": {channel.name: channel.document() for channel in channels},
        "remarks": remarks,
        **({"unsure": experiment.unsure} if experiment is not None and experiment.unsure else {}),
        **({"mark_deg": mark} if (mark := mapping.mark_deg) is not None else {}),
    }
    return Conversion(
        table=table, counts=counts, present=present, first_s=first_s, rates_hz=rates_hz, edges=edges, pulses=kept,
        channels=tuple(channels), remarks=tuple(remarks), document=document, start=begin, experiment=experiment,
    )  # fmt: skip


def _check_corner(entry: MappedSignal, mapping: Mapping, remarks: list[str]) -> None:
    """Check the low-pass corner of a channel against half of its rate; add a remark if its own corner is too high.

    Raises:
        InputError: The corner comes from [defaults]; the channel must set its own.
    """
    corner_hz, most_hz = entry.mapping.bandwidth_hz, 0.5 * entry.axis.rate_hz
    if corner_hz is None or corner_hz <= _MAX_CORNER_RATIO * most_hz:
        return
    if "bandwidth_hz" not in entry.mapping.model_fields_set:
        must = f"set, as the one in [defaults] is above half of its rate ({most_hz:.6g} Hz)"
        raise InputError(f"channels.{entry.name}.bandwidth_hz", must, corner_hz)
    remarks.append(
        f"{entry.name}: bandwidth_hz {corner_hz:g} is above half of its rate ({most_hz:.6g} Hz), as for a converter "
        "without a low-pass filter: faster signals are aliased"
    )


def _describe_axes(groups: dict[str, PlacedGroup]) -> list[str]:
    """Return remarks on groups that were split and on rates that are not a whole number."""
    remarks, names_by_rate = list[str](), dict[float, list[str]]()
    for name, group in groups.items():
        own = next(iter(group.channels.values())).target.group
        if name != own:
            remarks.append(
                f"{', '.join(group.channels)}: in a separate group {name}, sampled at other instants than {own}; "
                "not resampled (set [resample] for pictures that need both)"
            )
        if not group.rate_hz.is_integer():
            names_by_rate.setdefault(group.rate_hz, []).append(name)
    for rate_hz, names in names_by_rate.items():
        set_hz = nominal_hz(rate_hz)
        off = (rate_hz / set_hz - 1.0) * 1e6
        fast = f", {off:+.3g} ppm on {set_hz} Hz" if abs(off) < 1e3 else ""
        remarks.append(f"{', '.join(names)}: {rate_hz:.9g} Hz{fast} by the source's clock; samples are unchanged")
    return remarks


def _describe_filters(groups: dict[str, PlacedGroup]) -> list[str]:
    """Return a remark on the assumed delay of channels without bandwidth_hz."""
    own = default_table().channels
    unspecified = {
        name: group.rate_hz
        for group in groups.values()
        for name, entry in group.channels.items()
        if name in own and name != "keyphasor" and entry.mapping.bandwidth_hz is None
    }
    if not unspecified:
        return []
    delay_us = 1e6 * _BUTTERWORTH_DELAY * (4.0 - 2.0) / max(unspecified.values())
    return [
        f"no bandwidth_hz for {', '.join(unspecified)}: assumed half of the rate; if it is a quarter, they are "
        f"{delay_us:.0f} µs late: impacts appear shifted, and fits end at the first contact"
    ]


def _start_time(log: Log, zero_s: float) -> datetime:
    """Return the wall time of the recording's time zero."""
    start, remarks = log.mapping.time.start or log.sources[0].start, log.remarks
    if start is not None:
        if start.tzinfo is None:
            remarks.append(f"{start.isoformat()} has no time zone: read as UTC (set time.start to override)")
            start = start.replace(tzinfo=UTC)
        if 0.0 <= (start_s := start.timestamp() + zero_s) < _EPOCH_S[1]:
            return datetime.fromtimestamp(start_s, tz=UTC)
        remarks.append("the start time of the source is not from 1970 to 2100 and is ignored")
    if _EPOCH_S[0] < zero_s < _EPOCH_S[1]:
        remarks.append("times are in the range of seconds since 1970-01-01 and were read as UTC")
        return datetime.fromtimestamp(zero_s, tz=UTC)
    remarks.append("the source has no start time: wall times in the recording are those of the import")
    return datetime.now(tz=UTC)


def _digest(path: Path) -> str:
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _range(signals: Sequence[MappedSignal], log: Log) -> tuple[tuple[HammerPulse, ...], float, float]:
    """Return the hammer pulses (in source time) and the start and end of the imported range [s]."""
    mapping = log.mapping
    low = -math.inf if mapping.time.from_s is None else mapping.time.from_s
    high = math.inf if mapping.time.to_s is None else mapping.time.to_s
    pulses: tuple[HammerPulse, ...] = ()
    if mapping.hammer is not None:
        hammer = next(entry for entry in signals if entry.name == "hammer")
        all_pulses, passed_over = find_pulses(hammer.values, hammer.axis, mapping.hammer)
        pulses = tuple(pulse for pulse in all_pulses if low <= pulse.at_s <= high)
        if all_pulses and not pulses:
            times = ", ".join(f"{pulse.at_s:.4g} s" for pulse in all_pulses[:5])
            raise InputError("time", f"a range with a hammer pulse (at {times})", Words(f"{low:g} to {high:g} s"))
        if not pulses:
            largest = find_extent(hammer.values)[1]
            raise InputError("hammer.threshold_n", f"below the largest force, {largest:.3g} N, in what is imported",
                             mapping.hammer.threshold_n)  # fmt: skip
        first_pulses = ", ".join(f"{b.force_n:.4g} N for {b.duration_ms:.3g} ms" for b in pulses[:5])
        log.remarks.append(f"found hammer pulses ({len(pulses)}): {first_pulses}")
        log.remarks += [
            f"the hammer pulse at {pulse.at_s:.4f} s is incomplete, as the log begins or ends there, or samples "
            "are missing: its force and duration are wrong"
            for pulse in pulses
            if pulse.is_cut
        ]
        if lost := [f"{b.force_n:.4g} N at {b.at_s:.4f} s" for b in passed_over if low <= b.at_s <= high]:
            log.remarks.append(
                f"ignored hammer pulses ({len(lost)}), as too soon after another: predictions do not include "
                f"them (hammer.dead_s, hammer.threshold_n): {', '.join(lost[:5])}"
            )
        for second in pulses[1:2]:
            from_s = pulses[0].at_s + _SETTLING_FRACTION * (second.at_s - pulses[0].at_s)
            log.remarks.append(
                f"`rig validate` begins before the first of them and compares samples for as long as the "
                f"following motion can be predicted; to begin after it: [time] from_s = {from_s:.4g}"
            )
        if mapping.hammer.pre_s is not None:
            low = max(low, pulses[0].at_s - mapping.hammer.pre_s)
            if (before_s := pulses[0].at_s - hammer.axis.first_s) < mapping.hammer.pre_s - 1.0 / hammer.axis.rate_hz:
                log.remarks.append(
                    f"the log has {before_s:.4g} s before the first hammer pulse, less than hammer.pre_s = "
                    f"{mapping.hammer.pre_s:g} s"
                )
    return pulses, low, high


def _edges(log: Log, zero_s: float, groups: dict[str, PlacedGroup]) -> np.ndarray:
    """Return keyphasor edges in ticks from time zero, shape (turns,)."""
    wanted = log.mapping.keyphasor
    if wanted is None:
        return np.empty(0)
    source, entry = log.find(wanted, "keyphasor")
    signal, axis = log.read(source, entry, "keyphasor")
    values, axis = signal.physical, log.align_clock(axis, source, entry)
    edges_s, level = clock.find_crossings(
        values, axis, threshold=wanted.threshold, hysteresis=wanted.hysteresis, falling=wanted.edge == "falling"
    )
    if not len(edges_s) and wanted.threshold is None:
        log.remarks.append(f"no keyphasor pulse: {entry.name} stays within its noise")
    elif not len(edges_s):
        low, high = find_extent(values)
        raise InputError("keyphasor.threshold", f"between {low:.4g} and {high:.4g}, the ends of {entry.name}", level)
    edges_s = edges_s[:: wanted.pulses_per_turn]
    end_s = max(group.start_s + group.rows / group.rate_hz for group in groups.values())
    kept = edges_s[(edges_s >= zero_s) & (edges_s < end_s)]
    log.remarks.append(
        f"{len(kept)} keyphasor edges: {entry.name} {wanted.edge} through {level:.4g}, straight line between samples"
    )
    return (kept - zero_s) * TICK_RATE_HZ


def write_recording(
    conversion: Conversion, path: Path, *, force: bool = False, progress: Callable[[float], None] = lambda part: None
) -> None:
    """Write a recording; remove the file on an error.

    Args:
        conversion: Content of the recording.
        path: File name, ends in .mcap.
        force: Replace an existing file.
        progress: Callback for the completed fraction, 0 to 1.

    Raises:
        InputError: The destination cannot be used.
    """
    from recorder.writer import RecordingWriter

    experiment = conversion.experiment
    scene: dict[str, Any] = {"name": NO_SCENE, "seed": ""}
    parameters: dict[str, Any] = {"set": "", "values": {}}
    if experiment is not None:
        scene, parameters = experiment.scene, experiment.parameters
    writer = RecordingWriter(
        path,
        catalogue=_catalogue(conversion),
        parameters=parameters,
        scene={**scene, "import": conversion.document},
        force=force,
    )
    start_ns = round(conversion.start.timestamp() * 1e9)
    try:
        for tick, key, payload in _payloads(conversion):
            writer.write(key, payload, start_ns + tick * (1_000_000_000 // TICK_RATE_HZ))
            progress(min(1.0, tick / conversion.end_tick))
        writer.finish("completed", notes={"imported": ", ".join(f["name"] for f in conversion.document["files"])})
    finally:
        writer.abandon()


def _catalogue(conversion: Conversion) -> dict[str, Any]:
    texts = {"Imported": "samples of another system; their processing is listed below and in scene.json under `import`"}
    for channel in conversion.channels:
        texts[channel.name] = f"{channel.source}; {channel.formula}; {channel.time}; counts: {channel.counts}"
    texts |= {f"Remark {n + 1}": remark for n, remark in enumerate(conversion.remarks)}
    return {
        "root": wire.ROOT, "tick_rate_hz": TICK_RATE_HZ, "table": conversion.table.model_dump(mode="json"), "truth": {},
        "reference": texts, "rates_hz": conversion.rates_hz,
    }  # fmt: skip


def _payloads(conversion: Conversion) -> Iterator[tuple[int, str, bytes]]:
    """Yield tick, key and bytes of each message, in order of time."""
    yield 0, wire.EVENTS, _event(0, "import", files=", ".join(file["name"] for file in conversion.document["files"]))
    commands = sorted(_scene_events(conversion), key=lambda item: item[0])
    streams: list[Iterable[tuple[int, str, bytes | wire.Block]]] = [
        ((tick, wire.EVENTS, payload) for tick, payload in commands),
        *(_blocks(conversion, name) for name in conversion.counts),
        _edge_blocks(conversion),
    ]
    due = merge(*streams, key=lambda item: item[0])
    rows = wire.Continuity()
    for tick, key, content in due:
        if isinstance(content, wire.Block):
            rows.follow(key, content.index, len(content.values))
            content = wire.encode_block(content)
            release(*conversion.counts.values(), *conversion.present.values())
        yield tick, key, content
    yield conversion.end_tick, wire.EVENTS, _event(conversion.end_tick, "end", reason="completed", rows=rows.next)


def _event(tick: int, event: str, **about: Any) -> bytes:
    return wire.encode_document({"tick": tick, "time_s": tick / TICK_RATE_HZ, "event": event, **about})


def _scene_events(conversion: Conversion) -> Iterator[tuple[int, bytes]]:
    """Yield the commands of the scene, or the detected hammer pulses without a scene."""
    experiment = conversion.experiment
    commands = [pulse.command() for pulse in conversion.pulses] if experiment is None else experiment.commands
    for command in commands:
        tick = round(command["at_s"] * TICK_RATE_HZ)
        if tick < conversion.end_tick:
            about = {key: value for key, value in command.items() if key not in ("at_s", "command")}
            yield tick, _event(tick, command["command"], **about)


def _blocks(conversion: Conversion, name: str) -> Iterator[tuple[int, str, wire.Block]]:
    rate, first = conversion.rates_hz[name], conversion.first_s[name] * TICK_RATE_HZ
    counts, present = conversion.counts[name], conversion.present[name]
    base = round(first * rate / TICK_RATE_HZ)
    starts = [*block_starts(len(counts), first, rate), len(counts)]
    for start, stop in pairwise(starts):
        for low, high in find_true_runs(present[start:stop]):
            at = start + low
            values = np.ascontiguousarray(counts[at : start + high])
            block = wire.Block(round(first + at * TICK_RATE_HZ / rate), base + at, rate, float(TICK_RATE_HZ), values)
            yield block.tick, wire.sensor_key(name), block


def block_starts(rows: int, first: float, rate: float) -> list[int]:
    """Return the first rows of blocks; a block stores a whole tick, so rows near a whole tick are chosen.

    Args:
        rows: Number of rows.
        first: Time of the first row [ticks].
        rate: Sample rate [Hz].
    """
    if rate.is_integer():
        # All block starts have the same distance to a whole tick as the first row: their times are exact at any rate.
        unit = int(rate) // math.gcd(int(rate), TICK_RATE_HZ)
        return list(range(0, rows, unit * max(1, round(_BLOCK_S * rate / unit))))
    length = max(1, round(_BLOCK_S * rate))
    starts = [0]
    while starts[-1] + length < rows:
        near = np.arange(starts[-1] + (length + 1) // 2, starts[-1] + length + 1)
        ticks = first + near * (TICK_RATE_HZ / rate)
        starts.append(int(near[np.argmin(np.abs(ticks - np.rint(ticks)))]))
    return starts


def _edge_blocks(conversion: Conversion) -> Iterator[tuple[int, str, wire.Block]]:
    length = round(_BLOCK_S * TICK_RATE_HZ)
    numbers = (conversion.edges // length).astype(np.int64)
    for number in np.unique(numbers).tolist():
        inside = np.flatnonzero(numbers == number)
        values = (conversion.edges[inside] - number * length)[:, None]
        block = wire.Block(number * length, int(inside[0]), 0.0, float(TICK_RATE_HZ), values)
        yield block.tick, wire.EDGES, block
