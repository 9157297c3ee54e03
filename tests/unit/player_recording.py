"""A small recording for the player's tests, without physics: known payloads, in many chunks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import count
from pathlib import Path

from recorder.writer import RecordingWriter
from rig.base.wire import CATALOGUE, PARAMETERS, SCENE
from tests.unit.recorder_stream import generate_stream, make_documents

BLOCKS = 60
BLOCK_NS = 10_000_000
DURATION_NS = BLOCKS * BLOCK_NS
Payloads = dict[str, list[bytes]]


def write_recording(
    path: Path, payloads: Iterable[tuple[str, bytes]] | None = None, *, chunk_messages: int = 37
) -> Path:
    """Write payloads as the recorder does."""
    ticks = count()
    written = make_documents()
    writer = RecordingWriter(
        path,
        catalogue=written[CATALOGUE],
        parameters=written[PARAMETERS],
        scene=written[SCENE],
        # A clock that counts its readings: the file is flushed, and a chunk closed, after this number of messages.
        sync_every_s=float(chunk_messages),
        monotonic_s=lambda: float(next(ticks)),
    )
    for number, (key, payload) in enumerate(generate_stream(BLOCKS) if payloads is None else payloads):
        writer.write(key, payload, 1_700_000_000_000_000_000 + 1_000_000 * number)
    writer.finish("completed")
    return path


def group_by_key(payloads: Iterable[tuple[str, bytes]]) -> Payloads:
    """Return the payloads of each key, in order."""
    found: Payloads = {}
    for key, payload in payloads:
        found.setdefault(key, []).append(payload)
    return found


def order_by_key() -> Iterator[tuple[str, bytes]]:
    """Yield the same payloads in the order in which a recorder receives them from history."""
    for key, payloads in group_by_key(generate_stream(BLOCKS)).items():
        for payload in payloads:
            yield key, payload
