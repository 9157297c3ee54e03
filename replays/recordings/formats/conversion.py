"""Other systems' logs into a recording of this rig's kind: counts, calibration, edges, events, and what was done."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from replays.estimate.runs import true_runs
from replays.recordings.formats import clock
from replays.recordings.formats.events import events
from replays.recordings.formats.events.motion import Motion
from replays.recordings.formats.events.pulses import HammerPulse, find_pulses
from replays.recordings.formats.group import ImportedChannel, PlacedGroup, nominal_hz, place, quantise, rotate
from replays.recordings.formats.mapped import Log, MappedSignal, check_rows, engineering
from replays.recordings.formats.mapping import Mapping
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import ChannelTable, default_table

TICK_RATE_HZ = 1_000_000
_BLOCK_S = 0.05
_LATE = 2.6131 / (2.0 * math.pi)
"""Delay of a Butterworth low-pass of order 4 far below its corner, times the corner [1]."""
_BESIDE = 1.01
"""So far above half of the rate a corner may be told, as clocks are off."""
_REST = 0.25
"""Part of the time between two hammer pulses behind which a log may begin to be judged by the second."""
NO_SCENE = "none (imported)"
_EPOCH_S = (946_684_800.0, 4_102_444_800.0)
"""Times from 2000 to 2100 in seconds since 1970: none that a measurement began at 0 would reach."""


@dataclass(frozen=True)
class Conversion:
    """A recording in the making.

    Attributes:
        table: Its channel table.
        counts: int32 counts by group, shape (rows, channels).
        present: Which rows there are, by group, shape (rows,).
        first_s: Time of the first row [s], by group.
        rates_hz: True rate [Hz], by group; that of the table where it is a whole one.
        edges: Keyphasor edges [ticks], float64, shape (turns,).
        pulses: Hammer pulses that were found.
        channels: What was done, channel by channel.
        remarks: What was done to the whole, and what was assumed.
        document: All of that, the mapping and the files, as JSON.
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
        """Tick behind the last row."""
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
    """Read files and make of them what a mapping says.

    Args:
        files: The files; the first one's time is the time of all, unless others are aligned.
        mapping: What becomes what.
        doubts: What of it is guessed, and stands among the remarks.
        say: Told what is being done.

    Raises:
        InputError: Something in the files is not as the mapping says, or would be lost silently.
    """
    log = Log(files, mapping)
    remarks = log.remarks
    remarks += doubts
    say("reading")
    taken = [log.take(name, wanted) for name, wanted in mapping.channels.items()]
    say("aligning")
    log.align()
    for entry in taken:
        axis = log.on_common_clock(entry.axis, entry.source, entry.entry)
        entry.axis = axis.moved(-entry.mapping.delay_us * 1e-6)
    check_rows(taken)
    for entry in taken:
        _check_corner(entry, mapping, remarks)
        engineering(entry, mapping)
    pulses, low_s, high_s = _range(taken, log)
    say("placing samples")
    groups, zero_s = place(taken, mapping, low_s, high_s)
    rotate(groups, mapping, remarks)
    remarks += [*_of_the_axes(groups), *_of_the_filters(groups)]
    table, counts, present, channels = quantise(groups)
    lead_s = (mapping.experiment.lead_s or 0.0) if mapping.experiment is not None else 0.0
    rates_hz = {name: group.rate_hz for name, group in groups.items()}
    whole = [rate for rate in rates_hz.values() if rate.is_integer()]
    if any(abs(lead_s * rate - round(lead_s * rate)) > 1e-6 for rate in whole):
        raise InputError("experiment.lead_s", "a whole number of samples", lead_s)
    if not (leading := min(groups.values(), key=lambda group: group.start_s).rate_hz).is_integer():
        lead_s = math.ceil(lead_s * leading - 1e-6) / leading  # its rows then lie on whole numbers over its rate
    zero_s -= lead_s
    if lead_s:
        remarks.append(f"time zero lies {lead_s:g} s before the first sample: there the scene begins")
    first_s = {name: group.start_s - zero_s for name, group in groups.items()}
    edges = _edges(log, zero_s, groups)
    since = tuple(replace(pulse, at_s=pulse.at_s - zero_s) for pulse in pulses)
    kept = tuple(pulse for pulse in since if pulse.at_s >= 0.0)
    begin = _began(log, zero_s)
    end_s = max(first_s[name] + group.rows / group.rate_hz for name, group in groups.items())
    experiment = None
    if mapping.experiment is not None:
        motions = [
            Motion(channel, entry.values, clock.Axis(first_s[name], group.rate_hz, group.rows))
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
    }
    return Conversion(
        table=table, counts=counts, present=present, first_s=first_s, rates_hz=rates_hz, edges=edges, pulses=kept,
        channels=tuple(channels), remarks=tuple(remarks), document=document, start=begin, experiment=experiment,
    )  # fmt: skip


def _check_corner(entry: MappedSignal, mapping: Mapping, remarks: list[str]) -> None:
    """Refuse the default of all as the corner of a channel too slow for it; what a channel says itself is remarked.

    Raises:
        InputError: The channel has to say its own.
    """
    corner_hz, most_hz = entry.mapping.bandwidth_hz, 0.5 * entry.axis.rate_hz
    if corner_hz is None or corner_hz <= _BESIDE * most_hz:
        return
    if "bandwidth_hz" not in entry.mapping.model_fields_set:
        must = f"given, as that of [defaults] is above half of its rate ({most_hz:.6g} Hz)"
        raise InputError(f"channels.{entry.name}.bandwidth_hz", must, corner_hz)
    remarks.append(
        f"{entry.name}: bandwidth_hz {corner_hz:g} is above half of its rate ({most_hz:.6g} Hz), as of a converter "
        "without a low-pass of its own: what is faster appears as something slower"
    )


def _of_the_axes(groups: dict[str, PlacedGroup]) -> list[str]:
    """What is to be known of groups that came apart, and of rates that are no whole numbers."""
    told, alike = list[str](), dict[float, list[str]]()
    for name, group in groups.items():
        own = next(iter(group.channels.values())).target.group
        if name != own:
            told.append(
                f"{', '.join(group.channels)}: in a group {name} with instants of its own, not those of {own}; nothing "
                "is resampled (pictures that need both at once: [resample])"
            )
        if not group.rate_hz.is_integer():
            alike.setdefault(group.rate_hz, []).append(name)
    for rate_hz, names in alike.items():
        set_hz = nominal_hz(rate_hz)
        off = (rate_hz / set_hz - 1.0) * 1e6
        fast = f", {off:+.3g} ppm on {set_hz} Hz" if abs(off) < 1e3 else ""
        told.append(f"{', '.join(names)}: {rate_hz:.9g} Hz{fast}, as the clock says; samples are as they were")
    return told


def _of_the_filters(groups: dict[str, PlacedGroup]) -> list[str]:
    """What follows from filters that nobody tells."""
    own = default_table().channels
    untold = {
        name: group.rate_hz
        for group in groups.values()
        for name, entry in group.channels.items()
        if name in own and name != "keyphasor" and entry.mapping.bandwidth_hz is None
    }
    if not untold:
        return []
    late_us = 1e6 * _LATE * (4.0 - 2.0) / max(untold.values())
    return [
        f"no bandwidth_hz told of {', '.join(untold)}: taken for half of the rate; were it a quarter, they would be "
        f"{late_us:.0f} µs late, by which models would see impacts shifted, and fits end at the first contact"
    ]


def _began(log: Log, zero_s: float) -> datetime:
    """Wall time of the recording's time zero."""
    start, remarks = log.mapping.time.start or log.sources[0].start, log.remarks
    if start is not None:
        if start.tzinfo is None:
            remarks.append(f"{start.isoformat()} has no time zone: taken as UTC (time.start says otherwise)")
            start = start.replace(tzinfo=UTC)
        return datetime.fromtimestamp(start.timestamp() + zero_s, tz=UTC)
    if _EPOCH_S[0] < zero_s < _EPOCH_S[1]:
        remarks.append("times are so large that they were read as seconds since 1970-01-01, UTC")
        return datetime.fromtimestamp(zero_s, tz=UTC)
    remarks.append("the source does not tell when it was: the wall times in the recording are those of the import")
    return datetime.now(tz=UTC)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _range(taken: Sequence[MappedSignal], log: Log) -> tuple[tuple[HammerPulse, ...], float, float]:
    """Hammer pulses (in the time of the source), and from when to when is imported [s]."""
    mapping = log.mapping
    low = -math.inf if mapping.time.from_s is None else mapping.time.from_s
    high = math.inf if mapping.time.to_s is None else mapping.time.to_s
    pulses: tuple[HammerPulse, ...] = ()
    if mapping.hammer is not None:
        hammer = next(entry for entry in taken if entry.name == "hammer")
        found, passed_over = find_pulses(hammer.values, hammer.axis, mapping.hammer)
        pulses = tuple(pulse for pulse in found if low <= pulse.at_s <= high)
        if not pulses:
            largest = float(np.nanmax(hammer.values))
            raise InputError("hammer.threshold_n", f"below the largest force, {largest:.3g} N, in what is imported",
                             mapping.hammer.threshold_n)  # fmt: skip
        told = ", ".join(f"{b.force_n:.4g} N for {b.duration_ms:.3g} ms" for b in pulses[:5])
        log.remarks.append(f"{len(pulses)} hammer pulses found: {told}")
        if lost := [f"{b.force_n:.4g} N at {b.at_s:.4f} s" for b in passed_over if low <= b.at_s <= high]:
            log.remarks.append(
                f"{len(lost)} hammer pulses too soon behind another do not count, and nothing foretells what they do "
                f"(hammer.dead_s, hammer.threshold_n): {', '.join(lost[:5])}"
            )
        for second in pulses[1:2]:
            from_s = pulses[0].at_s + _REST * (second.at_s - pulses[0].at_s)
            log.remarks.append(
                f"`rig validate` begins before the first of them and compares samples for as long as motion behind it "
                f"can be foretold; to begin behind it: [time] from_s = {from_s:.4g}"
            )
        if mapping.hammer.pre_s is not None:
            low = max(low, pulses[0].at_s - mapping.hammer.pre_s)
    return pulses, low, high


def _edges(log: Log, zero_s: float, groups: dict[str, PlacedGroup]) -> np.ndarray:
    """Keyphasor edges in ticks from time zero."""
    wanted = log.mapping.keyphasor
    if wanted is None:
        return np.empty(0)
    source, entry = log.find(wanted, "keyphasor")
    signal, axis = log.read(source, entry, "keyphasor")
    values, axis = signal.physical, log.on_common_clock(axis, source, entry)
    found, level = clock.crossings(
        values, axis, threshold=wanted.threshold, hysteresis=wanted.hysteresis, falling=wanted.edge == "falling"
    )
    if not len(found):
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        raise InputError("keyphasor.threshold", f"between {low:.4g} and {high:.4g}, the ends of {entry.name}", level)
    found = found[:: wanted.pulses_per_turn]
    end_s = max(group.start_s + group.rows / group.rate_hz for group in groups.values())
    kept = found[(found >= zero_s) & (found < end_s)]
    log.remarks.append(
        f"{len(kept)} keyphasor edges: {entry.name} {wanted.edge} through {level:.4g}, straight line between samples"
    )
    return (kept - zero_s) * TICK_RATE_HZ


def write_recording(
    conversion: Conversion, path: Path, *, force: bool = False, progress: Callable[[float], None] = lambda part: None
) -> None:
    """Write a recording; nothing is left behind on an error.

    Args:
        conversion: What to write.
        path: File name, ends in .mcap.
        force: Replace an existing file.
        progress: Told the part done, 0 to 1.

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
    texts = {"Imported": "no samples of this rig; what was done to them stands below and in scene.json under `import`"}
    for channel in conversion.channels:
        texts[channel.name] = f"{channel.source}; {channel.formula}; {channel.time}; counts: {channel.counts}"
    texts |= {f"Remark {n + 1}": remark for n, remark in enumerate(conversion.remarks)}
    return {
        "root": wire.ROOT, "tick_rate_hz": TICK_RATE_HZ, "table": conversion.table.model_dump(mode="json"), "truth": {},
        "reference": texts, "rates_hz": conversion.rates_hz,
    }  # fmt: skip


def _payloads(conversion: Conversion) -> Iterator[tuple[int, str, bytes]]:
    """Tick, key and bytes of everything, in order of time."""
    yield 0, wire.EVENTS, _event(0, "import", files=", ".join(file["name"] for file in conversion.document["files"]))
    due: list[tuple[int, str, bytes | wire.Block]] = sorted(
        [
            *((tick, wire.EVENTS, payload) for tick, payload in _happenings(conversion)),
            *(block for name in conversion.counts for block in _blocks(conversion, name)),
            *_edge_blocks(conversion),
        ],
        key=lambda item: item[0],
    )
    rows = wire.Continuity()
    for tick, key, content in due:
        if isinstance(content, wire.Block):
            rows.follow(key, content.index, len(content.values))
            content = wire.encode_block(content)
        yield tick, key, content
    yield conversion.end_tick, wire.EVENTS, _event(conversion.end_tick, "end", reason="completed", rows=rows.next)


def _event(tick: int, event: str, **about: Any) -> bytes:
    return wire.encode_document({"tick": tick, "time_s": tick / TICK_RATE_HZ, "event": event, **about})


def _happenings(conversion: Conversion) -> Iterator[tuple[int, bytes]]:
    """The commands of the scene, or the hammer pulses that were found where there is none."""
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
        for low, high in true_runs(present[start:stop]):
            at = start + low
            values = np.ascontiguousarray(counts[at : start + high])
            block = wire.Block(round(first + at * TICK_RATE_HZ / rate), base + at, rate, float(TICK_RATE_HZ), values)
            yield block.tick, wire.sensor_key(name), block


def block_starts(rows: int, first: float, rate: float) -> list[int]:
    """Rows with which blocks begin: a block tells the whole tick of its first row, so those that are nearest to one.

    Args:
        rows: Number of rows.
        first: Time of the first one [ticks].
        rate: Rows a second [Hz].
    """
    if rate.is_integer():
        # All of them as near as the first one: their times are exact at any rate.
        unit = int(rate) // math.gcd(int(rate), TICK_RATE_HZ)
        return list(range(0, rows, unit * max(1, round(_BLOCK_S * rate / unit))))
    length = max(1, round(_BLOCK_S * rate))
    found = [0]
    while found[-1] + length < rows:
        near = np.arange(found[-1] + (length + 1) // 2, found[-1] + length + 1)
        ticks = first + near * (TICK_RATE_HZ / rate)
        found.append(int(near[np.argmin(np.abs(ticks - np.rint(ticks)))]))
    return found


def _edge_blocks(conversion: Conversion) -> Iterator[tuple[int, str, wire.Block]]:
    length = round(_BLOCK_S * TICK_RATE_HZ)
    numbers = (conversion.edges // length).astype(np.int64)
    for number in np.unique(numbers).tolist():
        inside = np.flatnonzero(numbers == number)
        values = (conversion.edges[inside] - number * length)[:, None]
        block = wire.Block(number * length, int(inside[0]), 0.0, float(TICK_RATE_HZ), values)
        yield block.tick, wire.EDGES, block
