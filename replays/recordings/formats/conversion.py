"""Other systems' logs into a recording of this rig's kind: counts, calibration, edges, events, and what was done."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from replays.recordings.formats import clock, events
from replays.recordings.formats.counts import ImportedChannel, quantise
from replays.recordings.formats.mapped import (
    MappedSignal,
    Moves,
    align,
    axis_of,
    check_rows,
    engineering,
    find_signal,
    shifted,
    take,
)
from replays.recordings.formats.mapping import Mapping
from replays.recordings.formats.placement import PlacedGroup, place, rotate
from replays.recordings.formats.source import Source, open_source
from rig.channels import ChannelTable
from rig.errors import InputError

TICK_RATE_HZ = 1_000_000
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
        first_tick: Tick of the first row, by group.
        edges: Keyphasor edges [ticks], float64, shape (turns,).
        blows: Hammer blows that were found.
        channels: What was done, channel by channel.
        remarks: What was done to the whole, and what was assumed.
        document: All of that, the mapping and the files, as JSON.
        start: Wall time of the recording's time zero.
        experiment: Scene, parameters and scene document, or None.
        clock_known: The source told when it was.
    """

    table: ChannelTable
    counts: dict[str, np.ndarray]
    present: dict[str, np.ndarray]
    first_tick: dict[str, int]
    edges: np.ndarray
    blows: tuple[events.Blow, ...]
    channels: tuple[ImportedChannel, ...]
    remarks: tuple[str, ...]
    document: dict[str, Any]
    start: datetime
    experiment: events.ExperimentDocuments | None

    @property
    def end_tick(self) -> int:
        """Tick behind the last row."""
        return max(
            self.first_tick[name] + math.ceil(len(rows) * TICK_RATE_HZ / self.table.groups[name].rate_hz)
            for name, rows in self.counts.items()
        )


def convert(files: Sequence[Path], mapping: Mapping, *, say: Callable[[str], None] = lambda text: None) -> Conversion:
    """Read files and make of them what a mapping says.

    Args:
        files: The files; the first one's time is the time of all, unless others are aligned.
        mapping: What becomes what.
        say: Told what is being done.

    Raises:
        InputError: Something in the files is not as the mapping says, or would be lost silently.
    """
    sources = _open(files, mapping)
    remarks = [f"{source.path.name}: {remark}" for source in sources for remark in source.remarks]
    say("reading")
    taken = [take(name, wanted, sources, mapping) for name, wanted in mapping.channels.items()]
    say("aligning")
    moves = align(sources, mapping, remarks)
    for entry in taken:
        entry.axis = shifted(entry.axis, entry.source, entry.entry, moves).moved(-entry.mapping.delay_us * 1e-6)
    check_rows(taken)
    for entry in taken:
        engineering(entry, mapping)
    blows, low_s, high_s = _range(taken, mapping, remarks)
    say("placing samples")
    groups, zero_s = place(taken, mapping, low_s, high_s)
    rotated = rotate(groups, mapping, remarks)
    table, counts, present, channels = quantise(groups, rotated)
    lead_s = mapping.experiment.lead if mapping.experiment is not None else 0
    zero_s -= lead_s
    if lead_s:
        remarks.append(f"time zero lies {lead_s} s before the first sample: so long the scene runs, to have settled")
    first_tick = {name: round((group.start_s - zero_s) * TICK_RATE_HZ) for name, group in groups.items()}
    edges = _edges(sources, mapping, moves, zero_s, groups, remarks)
    since = tuple(replace(blow, at_s=blow.at_s - zero_s) for blow in blows)
    kept = tuple(blow for blow in since if blow.at_s >= 0.0)
    begin = _began(sources[0], mapping, zero_s, remarks)
    end_s = max(first_tick[name] / TICK_RATE_HZ + group.rows / group.rate_hz for name, group in groups.items())
    experiment = None
    if mapping.experiment is not None:
        speed = events.speed_before(groups, edges, kept, zero_s=zero_s)
        experiment = events.build_experiment(
            mapping.experiment, kept, duration_s=end_s, speed_hz=speed, table=table, remarks=remarks
        )
    document = {
        "files": [
            {"name": source.path.name, "format": source.format, "sha256": _digest(source.path), **source.about}
            for source in sources
        ],
        "zero_s": zero_s,
        "start": begin.isoformat(),
        "mapping": mapping.document(),
        "channels": {channel.name: channel.document() for channel in channels},
        "remarks": remarks,
    }
    return Conversion(
        table=table, counts=counts, present=present, first_tick=first_tick, edges=edges, blows=kept,
        channels=tuple(channels), remarks=tuple(remarks), document=document, start=begin, experiment=experiment,
    )  # fmt: skip


def _open(files: Sequence[Path], mapping: Mapping) -> list[Source]:
    if len({path.name for path in files}) < len(files):
        raise InputError("file", "files of different names", ", ".join(path.name for path in files))
    return [open_source(path, mapping.file) for path in files]


def _began(source: Source, mapping: Mapping, zero_s: float, remarks: list[str]) -> datetime:
    """Wall time of the recording's time zero."""
    start = mapping.time.start or source.start
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


def _range(
    taken: Sequence[MappedSignal], mapping: Mapping, remarks: list[str]
) -> tuple[tuple[events.Blow, ...], float, float]:
    """Blows (in the time of the source), and from when to when is imported [s]."""
    low = -math.inf if mapping.time.from_s is None else mapping.time.from_s
    high = math.inf if mapping.time.to_s is None else mapping.time.to_s
    blows: tuple[events.Blow, ...] = ()
    if mapping.hammer is not None:
        hammer = next(entry for entry in taken if entry.name == "hammer")
        found = events.find_blows(hammer.values, hammer.axis, mapping.hammer)
        blows = tuple(blow for blow in found if low <= blow.at_s <= high)
        if not blows:
            largest = float(np.nanmax(hammer.values))
            raise InputError("hammer.threshold_n", f"below the largest force, {largest:.3g} N, in what is imported",
                             mapping.hammer.threshold_n)  # fmt: skip
        told = ", ".join(f"{b.force_n:.4g} N for {b.duration_ms:.3g} ms" for b in blows[:5])
        remarks.append(f"{len(blows)} hammer blows found: {told}")
        if mapping.hammer.pre_s is not None:
            low = max(low, blows[0].at_s - mapping.hammer.pre_s)
    return blows, low, high


def _edges(
    sources: Sequence[Source], mapping: Mapping, moves: Moves, zero_s: float, groups: dict[str, PlacedGroup],
    remarks: list[str],
) -> np.ndarray:  # fmt: skip
    """Keyphasor edges in ticks from time zero."""
    wanted = mapping.keyphasor
    if wanted is None:
        return np.empty(0)
    source, entry = find_signal(wanted, sources, "keyphasor")
    signal = source.read(entry)
    axis = axis_of(source, entry, signal, mapping)
    values = axis.placed(signal.physical)
    axis = shifted(axis, source, entry, moves)
    found, level = clock.crossings(
        values, axis, threshold=wanted.threshold, hysteresis=wanted.hysteresis, falling=wanted.edge == "falling"
    )
    if not len(found):
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        raise InputError("keyphasor.threshold", f"between {low:.4g} and {high:.4g}, the ends of {entry.name}", level)
    found = found[:: wanted.pulses_per_turn]
    end_s = max(group.start_s + group.rows / group.rate_hz for group in groups.values())
    kept = found[(found >= zero_s) & (found < end_s)]
    remarks.append(
        f"{len(kept)} keyphasor edges: {entry.name} {wanted.edge} through {level:.4g}, straight line between samples"
    )
    return (kept - zero_s) * TICK_RATE_HZ
