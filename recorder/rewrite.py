"""Recordings derived from recordings: recovery of an interrupted file, and cuts of one or several files.

Payloads are copied unchanged through the writer used for recording. Index, counts, gaps and plot messages are derived
again, so the result is like any other recording. The metadata `recovered` or `cut` name the source.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, Literal

import numpy as np

from recorder.contents import documents
from recorder.contents.counts import Counts
from recorder.contents.metadata import Beginning, Commands
from recorder.files import schemas
from recorder.files.payload import Payload, get_tick
from recorder.files.records import COPY
from recorder.files.unfinished_file import check_destination
from recorder.reader import Recording
from recorder.writer import RecordingWriter
from rig.base.errors import InputError, Words
from rig.base.files import PART_SUFFIX, build_read_error, check_output_differs, open_file
from rig.base.wire import EDGES, FAULTS, SENSORS, TRUTH, Block, encode_block, get_schema
from rig.channels.faults.ledger import Declared

_PROGRESS_MESSAGES = 5000
"""Messages between two progress reports."""
_DERIVED_ATTACHMENTS = ("README.txt", "catalogue.json", "parameters.json", "scene.json", COPY)


@dataclass(frozen=True)
class Rewritten:
    """Result of a recovery or a cut.

    Attributes:
        path: The new file.
        counts: Totals of the new file.
        damaged: Number of damaged records of the source that were skipped.
        unchecked: Data of the source without a checksum.
        missing_rows: Losses of the source by its own counts, as lines of text.
    """

    path: Path
    counts: Counts
    damaged: int
    unchecked: tuple[str, ...] = ()
    missing_rows: tuple[str, ...] = ()


def recovered_path(source: Path) -> Path:
    """Return the default output of `recover`: NAME.recovered.mcap in the folder of NAME.mcap.part or NAME.mcap."""
    name = source.name.removesuffix(PART_SUFFIX).removesuffix(".mcap")
    return source.with_name(f"{name}.recovered.mcap")


def is_whole(source: Path, *, on_progress: Callable[[float], None] | None = None) -> bool:
    """Return whether a file needs no recovery: finished, under its final name, complete and readable.

    Args:
        source: The file.
        on_progress: Callback for the fraction done, 0 to 1.

    Raises:
        InputError: The file is being written, or cannot be read.
    """
    if source.name.endswith(PART_SUFFIX):
        return False
    with _unlocked(source):
        try:
            recording = Recording.open(source)
            if not recording.complete:
                return False
            step = _progress(recording, on_progress)
            recording.scan(lambda key, block: step())
            return not recording.missing_rows
        except InputError:
            return False


def recover(
    source: Path,
    output: Path | None = None,
    *,
    force: bool = False,
    on_progress: Callable[[float], None] | None = None,
) -> Rewritten:
    """Write a finished file from one that was interrupted or damaged; the source is not changed.

    Args:
        source: The file.
        output: The new file; None for `recovered_path`.
        force: Replace an existing file.
        on_progress: Callback for the fraction done, 0 to 1.

    Raises:
        InputError: The source is being written, cannot be read, has no complete calibration or no readable rows, or the
            new file cannot be written.
        RecordingError: The disk reports an error.
    """
    output = output or recovered_path(source)
    check_output_differs([source], output)
    with _unlocked(source):
        recording = Recording.open(source, salvage=True)
        about = {
            "source": source.name,
            "source_bytes": str(source.stat().st_size),
            "damaged_records": str(recording.damaged),
            "unchecked": "; ".join(recording.unchecked),
            "short": "; ".join(recording.missing_rows),
        }
        lost = InputError("file", "a recording with readable rows", Words(f"{source}, which has none"))
        due, ends = _lost_ends(recording)
        counts = _write(
            recording,
            output,
            metadata={"recovered": about},
            reason="recovered",
            force=force,
            due=due,
            ends=ends,
            empty=lost if recording.damaged or recording.missing_rows else None,
            on_progress=on_progress,
        )
    return Rewritten(output, counts, recording.damaged, recording.unchecked, recording.missing_rows)


def _lost_ends(recording: Recording) -> tuple[dict[str, int], dict[str, int]]:
    """Return the first and last rows, as stated by the file, of streams that lost rows at their start or end.

    Returns:
        Number of the first row, and number of the row after the last one, by key.
    """
    due: dict[str, int] = {}
    ends: dict[str, int] = {}
    file = recording.parts[0]
    for key, stream in recording.streams.items():
        noted = [gap.size for gap in recording.gaps if gap.key == key and stream.first < gap.index < stream.due]
        rows = stream.missing - max(0, stream.lost - sum(noted))  # losses between blocks count as gaps
        if rows > 0:
            late_s = stream.first_time_s - (file.stated_begin_s or 0.0) if stream.rows else 0.0
            rate_hz = file.formats[key].rate_hz if key in file.formats else 0.0
            first = min(rows, stream.first, max(0, round(late_s * rate_hz)))
            due[key] = stream.first - first
            ends[key] = stream.due + rows - first
    return due, ends


def cut(
    recording: Recording,
    output: Path,
    *,
    from_s: float = -math.inf,
    to_s: float = math.inf,
    only: Literal["sensors", "truth"] | None = None,
    channels: tuple[str, ...] = (),
    force: bool = False,
    on_progress: Callable[[float], None] | None = None,
) -> Rewritten:
    """Write a part of a recording, or several joined files, to a new file.

    Payloads are copied unchanged, except that the blocks at the ends are trimmed to the interval from `from_s` to
    before `to_s`, and blocks of which only some channels are kept lose the other columns.

    Args:
        recording: Source; `join` opens several files as one.
        output: The new file.
        from_s: Start [s of simulated time].
        to_s: End [s of simulated time].
        only: Keep only sensors or only truth; events and status are always kept.
        channels: Keep only these channels; empty for all.
        force: Replace an existing file.
        on_progress: Callback for the fraction done, 0 to 1.

    Raises:
        InputError: Times or channels are invalid, the interval has no rows, or the file cannot be written.
        RecordingError: The disk reports an error.
    """
    if math.isnan(from_s) or math.isnan(to_s) or not from_s < to_s:
        raise InputError("from and to", "times in ascending order", Words(f"{from_s:g} and {to_s:g}"))
    if only not in (None, "sensors", "truth"):
        raise InputError("only", "sensors or truth", only)
    check_output_differs([part.path for part in recording.parts], output)
    recording = recording.between(from_s, to_s)
    catalogue, columns = _select_columns(recording, channels, only)
    tick_rate_hz = recording.catalogue["tick_rate_hz"]
    from_tick, to_tick = (at_s if math.isinf(at_s) else float(round(at_s * tick_rate_hz)) for at_s in (from_s, to_s))
    commands = Commands(recording.scene)
    for event in recording.events:
        tick = get_tick(event)
        if tick is not None and tick < from_tick:
            commands.follow(event)

    declared = Declared()

    def change(payload: Payload) -> Payload | None:
        key, tick, block = payload.key, payload.tick, payload.block
        if key == FAULTS and payload.document is not None:
            declared.declare(payload.document)
            return None if only == "sensors" else payload  # may concern blocks of any time
        if get_schema(key) is None:
            return payload if tick is None or from_tick <= tick < to_tick else None
        if key not in columns:
            return None
        if block is None:
            return payload
        original = declared.true(key, block)
        declared.take(key, block)
        if (original.index, original.tick) != (block.index, block.tick):  # stamped by a fault: keep unchanged or drop
            return payload if from_tick <= original.tick < to_tick else None
        kept = _trim_block(key, block, from_tick, to_tick, columns[key])
        if kept is None or kept is block:
            return payload if kept else None
        return replace(payload, data=encode_block(kept), block=kept)

    about = {
        "sources": json.dumps([part.path.name for part in recording.parts]),
        "source_ends": json.dumps([part.end_reason for part in recording.parts]),
        "from_s": f"{from_s:g}",
        "to_s": f"{to_s:g}",
        "only": only or "",
        "channels": json.dumps(channels),
    }
    first_s, last_s = recording.span_s or (0.0, 0.0)
    must = f"an interval with rows of the recording, {first_s:g} to {last_s:g} s"
    counts = _write(
        recording,
        output,
        scene=commands.scene,
        catalogue=catalogue,
        metadata={"cut": about},
        reason="cut",
        force=force,
        change=change,
        empty=InputError("from and to", must, Words(f"{from_s:g} to {to_s:g} s")),
        on_progress=on_progress,
    )
    return Rewritten(output, counts, recording.damaged, missing_rows=recording.missing_rows)


def _write(
    recording: Recording,
    output: Path,
    *,
    metadata: dict[str, dict[str, str]],
    reason: str,
    force: bool,
    scene: dict[str, Any] | None = None,
    catalogue: dict[str, Any] | None = None,
    change: Callable[[Payload], Payload | None] = lambda payload: payload,
    due: dict[str, int] | None = None,
    ends: dict[str, int] | None = None,
    empty: InputError | None = None,
    on_progress: Callable[[float], None] | None,
) -> Counts:
    """Copy the messages of a recording and derive the rest again.

    Args:
        recording: Source.
        output: The new file.
        metadata: Additional metadata.
        reason: Reason for the end of the recording.
        force: Replace an existing file.
        scene: Scene document; None for the source's.
        catalogue: Catalogue document; None for the source's.
        change: Returns the payload to write; None to drop it.
        due: Number of the first expected row by key, for streams that lost rows at their start.
        ends: Number of the row after the last one by key, for streams that lost rows at their end.
        empty: Error to raise if there is no row.
        on_progress: Callback for the fraction done, 0 to 1.
    """
    check_destination(output, force=force)
    about = recording.metadata["rig"]
    # A cut does not belong to a series.
    left_out = {"rig", "end"} if "recovered" in metadata else {"rig", "end", "series"}
    kept = {name: entries for name, entries in recording.metadata.items() if name not in left_out}
    metadata = {**kept, "rig": {"created": about["created"]}, **metadata}
    attachments = {name: data for name, data in recording.attachments.items() if name not in _DERIVED_ATTACHMENTS}
    with contextlib.ExitStack() as stack:
        writer = RecordingWriter(
            output,
            catalogue=catalogue or recording.catalogue,
            parameters=recording.parameters,
            scene=scene or recording.scene,
            view_rate_hz=float(about.get("view_rate_hz", 0.0)),
            force=force,
            beginning=Beginning(metadata=metadata, attachments=attachments, due=due or {}),
            sync_every_s=2.0,
        )
        stack.callback(writer.abandon)  # remove an incomplete file; no effect after `finish`
        step = _progress(recording, on_progress)
        derived = (schemas.VIEW + "/", schemas.CLOCK)
        topics = {key for key in recording.messages if not key.startswith(derived)}
        for key, _, wall_ns, data in recording.everything(topics):
            step()
            if key == schemas.GAPS:
                with contextlib.suppress(InputError):
                    gap, _ = documents.read(documents.Gap, data, field=key)
                    if gap.get("kind") == "messages":
                        writer.write_missed(gap["key"], gap["size"], wall_ns)
                continue
            changed = change(Payload.read(key, data, wall_ns))
            if changed is not None:
                writer.take(changed)
        if empty is not None and not any(writer.counts().rows.values()):
            raise empty
        writer.note_short(ends or {}, time.time_ns())
        writer.finish(reason)
    return writer.counts()


def _progress(recording: Recording, on_progress: Callable[[float], None] | None) -> Callable[[], None]:
    """Return a function to call for each message; it reports the progress at intervals."""
    total, numbers = max(1, sum(recording.messages.values())), count()

    def step() -> None:
        number = next(numbers)
        if on_progress is not None and number % _PROGRESS_MESSAGES == 0:
            on_progress(number / total)

    return step


@contextlib.contextmanager
def _unlocked(path: Path) -> Iterator[None]:
    """Hold a shared lock on a file, so that no recorder can start writing to it.

    Raises:
        InputError: A recorder is writing to the file, or it cannot be read.
    """
    import fcntl

    try:
        with open_file(path) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError("file", "a file that no recorder is writing to", str(path)) from None
            yield
    except OSError as error:
        if error.filename != str(path):
            raise
        raise build_read_error(path, error) from None


def _select_columns(
    recording: Recording, channels: tuple[str, ...], only: str | None
) -> tuple[dict[str, Any], dict[str, list[int] | None]]:
    """Return the catalogue of a cut, and the columns to keep of each remaining key; None for all columns."""
    table_channels = recording.table.channels
    for name in channels:
        if name not in table_channels:
            raise InputError("channels", f"among {', '.join(table_channels)}", name)
    keys = {key for key in recording.messages if get_schema(key) is not None}
    if only is not None:
        keys = {key for key in keys if key.startswith((SENSORS if only == "sensors" else TRUTH) + "/")}
    columns: dict[str, list[int] | None] = dict.fromkeys(keys)
    groups = dict(recording.catalogue["table"]["groups"])
    for name, group in recording.table.groups.items():
        key = f"{SENSORS}/{name}"
        picked = [column for column, channel in enumerate(group.names) if not channels or channel in channels]
        if key not in keys or not picked:
            groups.pop(name)
            columns.pop(key, None)
        elif len(picked) < len(group.names):
            groups[name] = {**groups[name], "channels": [groups[name]["channels"][column] for column in picked]}
            columns[key] = picked
    if channels and "keyphasor" not in channels:
        columns.pop(EDGES, None)
    truth = {name: table for name, table in recording.catalogue.get("truth", {}).items() if f"{TRUTH}/{name}" in keys}
    return {**recording.catalogue, "table": {**recording.catalogue["table"], "groups": groups}, "truth": truth}, columns


def _trim_block(key: str, block: Block, from_tick: float, to_tick: float, columns: list[int] | None) -> Block | None:
    """Return the rows of a block between two ticks; None without any, and the same block if it is kept completely."""
    rows = len(block.values)
    ticks = block.tick + block.values[:, 0] if key == EDGES else np.round(block.times_s * block.tick_rate_hz, 6)
    kept = np.flatnonzero((ticks >= from_tick) & (ticks < to_tick))
    if not len(kept):
        return None
    first, last = int(kept[0]), int(kept[-1]) + 1
    if (first, last) == (0, rows) and columns is None:
        return block
    values = block.values[first:last] if columns is None else block.values[first:last, columns]
    tick = block.tick if key == EDGES else round(float(ticks[first]))
    return Block(tick, block.index + first, block.rate_hz, block.tick_rate_hz, values)
