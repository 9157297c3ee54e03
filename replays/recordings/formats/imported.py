"""A conversion written as a recording that every tool of the rig reads."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from replays.recordings.formats.conversion import NO_SCENE, TICK_RATE_HZ, Conversion
from rig import wire

_BLOCK_S = 0.05


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
        "reference": texts,
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
    """The commands of the scene, or the blows that were found where there is none."""
    experiment = conversion.experiment
    commands = [blow.command() for blow in conversion.blows] if experiment is None else experiment.commands
    for command in commands:
        tick = round(command["at_s"] * TICK_RATE_HZ)
        if tick < conversion.end_tick:
            about = {key: value for key, value in command.items() if key not in ("at_s", "command")}
            yield tick, _event(tick, command["command"], **about)


def _blocks(conversion: Conversion, name: str) -> Iterator[tuple[int, str, wire.Block]]:
    rate = conversion.table.groups[name].rate_hz
    counts, present = conversion.counts[name], conversion.present[name]
    first = conversion.first_tick[name]
    # Blocks begin on whole ticks, so that the time of every row is exact at any rate.
    unit = rate // math.gcd(rate, TICK_RATE_HZ)
    rows = unit * max(1, round(_BLOCK_S * rate / unit))
    base = round(first * rate / TICK_RATE_HZ)
    for start in range(0, len(counts), rows):
        stop = min(start + rows, len(counts))
        for low, high in _runs(present[start:stop]):
            at = start + low
            tick = first + at * TICK_RATE_HZ / rate
            values = np.ascontiguousarray(counts[at : start + high])
            block = wire.Block(round(tick), base + at, float(rate), float(TICK_RATE_HZ), values)
            yield block.tick, wire.sensor_key(name), block


def _runs(present: np.ndarray) -> list[tuple[int, int]]:
    """Starts and ends of the stretches that are there."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(np.int8)))
    return [(int(low), int(high)) for low, high in edges.reshape(-1, 2)]


def _edge_blocks(conversion: Conversion) -> Iterator[tuple[int, str, wire.Block]]:
    length = round(_BLOCK_S * TICK_RATE_HZ)
    numbers = (conversion.edges // length).astype(np.int64)
    for number in np.unique(numbers).tolist():
        inside = np.flatnonzero(numbers == number)
        values = (conversion.edges[inside] - number * length)[:, None]
        block = wire.Block(number * length, int(inside[0]), 0.0, float(TICK_RATE_HZ), values)
        yield block.tick, wire.EDGES, block
