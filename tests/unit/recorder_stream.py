"""A rig that only publishes: documents and streams for the recorder's tests, and a client that delivers them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rig.base.wire import (
    CATALOGUE,
    EDGES,
    EVENTS,
    PARAMETERS,
    SCENE,
    STATUS,
    Block,
    encode_block,
    encode_document,
    sensor_key,
    truth_key,
)
from rig.channels.table import default_table
from rig.serve.transport import NoReplyError

TICK_RATE_HZ = 1_000_000
TRUTH_COLUMNS = {"state": 28, "contact": 5}


def make_documents() -> dict[str, dict[str, Any]]:
    """Return the catalogue, parameters and scene by key."""
    truth = {
        table: {
            "columns": [{"name": f"{table}_{k}", "unit": "m", "label": f"column {k}"} for k in range(columns)],
            "rate_hz": 2000,
        }
        for table, columns in TRUTH_COLUMNS.items()
    }
    return {
        CATALOGUE: {
            "root": "rig",
            "tick_rate_hz": TICK_RATE_HZ,
            "table": default_table().model_dump(mode="json"),
            "truth": truth,
            "reference": {"disk_zero": "the centre line of the ring at rest"},
        },
        PARAMETERS: {"set": "corrected", "values": {"m": {"value": 1.0, "unit": "kg", "source": "-", "kind": "paper"}}},
        SCENE: {"name": "hammer", "seed": 7, "scene": {"duration_s": 1.0}},
    }


def make_block(key: str, number: int, *, block_ms: int = 10, seed: int = 1) -> Block:
    """Return block `number` of a stream, the same on every call."""
    tick = number * block_ms * 1000
    rng = np.random.default_rng([seed, number, len(key)])
    for table, columns in TRUTH_COLUMNS.items():
        if key == truth_key(table):
            rows = 2 * block_ms
            values = rng.normal(size=(rows, columns)).cumsum(axis=0)
            return Block(tick=tick, index=number * rows, rate_hz=2000.0, tick_rate_hz=TICK_RATE_HZ, values=values)
    group = default_table().groups[key.rsplit("/", 1)[1]]
    rows = 20 * block_ms
    time_s = (np.arange(rows) + number * rows) / 20_000
    wave = 3e5 * np.sin(2 * np.pi * 84 * time_s)[:, None] * np.arange(1, len(group.channels) + 1)
    counts = (wave + rng.normal(scale=200.0, size=wave.shape)).astype(np.int32)
    return Block(tick=tick, index=number * rows, rate_hz=20_000.0, tick_rate_hz=TICK_RATE_HZ, values=counts)


def generate_stream(blocks: int, *, block_ms: int = 10) -> Iterator[tuple[str, bytes]]:
    """Yield keys and payloads of a short run: start, blocks of all streams, one edge per block, two statuses per
    second,
    end.
    """
    yield EVENTS, encode_document({"event": "start", "tick": 0, "time_s": 0.0, "scene": "hammer", "seed": 7})
    keys = [sensor_key(group) for group in default_table().groups] + [truth_key(table) for table in TRUTH_COLUMNS]
    for number in range(blocks):
        for key in keys:
            yield key, encode_block(make_block(key, number, block_ms=block_ms))
        tick = number * block_ms * 1000
        edge = Block(tick, number, 0.0, TICK_RATE_HZ, np.array([[0.25]]) + np.arange(1)[:, None])
        yield EDGES, encode_block(edge)
        if number % (500 // block_ms) == 0:
            yield STATUS, encode_document({"tick": tick, "time_s": tick / 1e6, "state": "running"})
    tick = blocks * block_ms * 1000
    yield EVENTS, encode_document({"event": "end", "tick": tick, "time_s": tick / 1e6, "reason": "completed"})


class ScriptedClient:
    """A client whose rig is the test: publications are delivered on the caller's thread."""

    foreign = 0
    rig = "a rig"

    def __init__(self) -> None:
        self.replies = {key: encode_document(document) for key, document in make_documents().items()}
        self.reported: list[tuple[str, bytes]] = []
        self.subscribed: list[str] = []
        self.on_alive: Callable[[bool], None] = lambda alive: None
        self.on_miss: Callable[[str, int], None] | None = None
        self._callbacks: dict[str, Callable[[str, bytes], None]] = {}

    def publish(self, key: str, payload: bytes) -> None:
        for pattern, callback in list(self._callbacks.items()):
            if key == pattern or (pattern.endswith("/**") and key.startswith(pattern[:-2])):
                callback(key, payload)

    def subscribe(
        self,
        key: str,
        on_message: Callable[[str, bytes], None],
        *,
        on_miss: Callable[[str, int], None] | None = None,
        history: bool = False,
        lossless: bool = True,
    ) -> None:
        self.on_miss = on_miss
        self._callbacks[key] = on_message
        self.subscribed.append(key)

    def request(self, key: str, payload: bytes = b"", *, timeout_s: float = 2.0) -> bytes:
        if key not in self.replies:
            raise NoReplyError(f"no reply on {key}")
        return self.replies[key]

    def watch(self, key: str, callback: Callable[[bool], None]) -> None:
        self.on_alive = callback
        callback(True)

    def report(self, key: str, payload: bytes) -> None:
        self.reported.append((key, payload))

    def close(self) -> None:
        self._callbacks.clear()
