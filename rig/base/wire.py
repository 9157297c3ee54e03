"""Codec without I/O: converts blocks of samples and documents to bytes and back, and defines their keys.

A block is one CDR message (little-endian, ROS 2 message definitions below), which any reader of ROS 2 messages can
decode without this project. A document is JSON. A stream is an event `start`, blocks, and an event `end` with a reason;
a step of a block's index other than its length is a gap, which `Continuity` counts. Messages from outside are validated
by `rig.serve.stream_check`.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rig.base.checks import read_json

ROOT = "rig"
STATUS = f"{ROOT}/status"
EVENTS = f"{ROOT}/events"
CATALOGUE = f"{ROOT}/catalogue"
PARAMETERS = f"{ROOT}/parameters"
SCENE = f"{ROOT}/scene"
ALIVE = f"{ROOT}/alive"
SENSORS = f"{ROOT}/sensors"
EDGES = f"{SENSORS}/keyphasor_edges"
TRUTH = f"{ROOT}/truth"
FAULTS = f"{TRUTH}/faults"
"""Key of declarations of faults: documents, in addition to the blocks of truth."""
BLOCK = f"{ROOT}/block"
"""Key of the end of a block, published last while devices have joined."""
ENDED = "a run that ended"
"""Received part of the error for a command after the end; the reason of the end follows."""
COMMAND = f"{ROOT}/command"
CLIENTS = f"{ROOT}/clients"


def sensor_key(group: str) -> str:
    """Return the key of a sensor group's blocks."""
    return f"{SENSORS}/{group}"


def truth_key(table: str) -> str:
    """Return the key of a truth table's blocks."""
    return f"{TRUTH}/{table}"


def command_key(name: str) -> str:
    """Return the key of a command."""
    return f"{COMMAND}/{name}"


_HEADER_FIELDS = """\
int64 tick             # time of the first row, in ticks of the simulated clock
int64 index            # number of the first row since the start of the stream
float64 rate_hz        # rows per simulated second
float64 tick_rate_hz   # ticks per simulated second
uint32 columns         # values per row
"""
SAMPLE_SCHEMA = "rig_msgs/msg/SampleBlock"
TRUTH_SCHEMA = "rig_msgs/msg/TruthBlock"
SCHEMAS = {
    SAMPLE_SCHEMA: _HEADER_FIELDS + "int32[] values         # ADC counts, row after row\n",
    TRUTH_SCHEMA: _HEADER_FIELDS + "float64[] values       # row after row\n",
}
"""ROS 2 message definitions of the two blocks.

Keyphasor edges travel as TruthBlock rows of one column: ticks from `tick`.
"""

_DTYPES = {SAMPLE_SCHEMA: np.dtype("<i4"), TRUTH_SCHEMA: np.dtype("<f8")}
_ENCAPSULATION = b"\x00\x01\x00\x00"
_HEAD = struct.Struct("<qqddII")
_MAX_TICK = 1 << 53
"""Limit of ticks and row numbers, which are exact in every number type up to here: 285 years of microseconds."""
_MAX_RATE_HZ = 1e12
_MAX_BLOCK_S = 1e6


def get_schema(key: str) -> str | None:
    """Return the block schema of a key's payloads, or None for JSON documents."""
    if key == EDGES or (key.startswith(TRUTH + "/") and key != FAULTS):
        return TRUTH_SCHEMA
    return SAMPLE_SCHEMA if key.startswith(SENSORS + "/") else None


def _row(tick: int, rate_hz: float, tick_rate_hz: float) -> float:
    """Return the row number at a tick that was rounded, from time zero.

    Rows of an even stream are at whole numbers over the rate, which need not be whole ticks.
    """
    row = tick * rate_hz / tick_rate_hz
    return round(row) if abs(round(row) * tick_rate_hz / rate_hz - tick) <= 0.5 else row


def row_times_s(tick: int, rate_hz: float, tick_rate_hz: float, rows: int) -> np.ndarray:
    """Return the times of consecutive rows, of which the first is given to the nearest tick [s], shape (rows,)."""
    return (_row(tick, rate_hz, tick_rate_hz) + np.arange(rows)) / rate_hz


def row_tick(tick: int, rate_hz: float, tick_rate_hz: float, row: int) -> int:
    """Return the tick of a row relative to one that is given to the nearest tick, without rounding twice."""
    return round((_row(tick, rate_hz, tick_rate_hz) + row) * tick_rate_hz / rate_hz)


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive rows of one stream.

    Attributes:
        tick: Time of the first row, to the nearest tick [ticks]; `start_s` is exact.
        index: Number of the first row since the start of the stream.
        rate_hz: Rows per simulated second [Hz].
        tick_rate_hz: Ticks per simulated second [Hz].
        values: int32 counts or float64 values, shape (rows, columns).
    """

    tick: int
    index: int
    rate_hz: float
    tick_rate_hz: float
    values: np.ndarray = field(repr=False)

    @property
    def start_s(self) -> float:
        """Simulated time of the first row [s]."""
        return _row(self.tick, self.rate_hz, self.tick_rate_hz) / self.rate_hz

    @property
    def times_s(self) -> np.ndarray:
        """Simulated time of each row [s], shape (rows,)."""
        return row_times_s(self.tick, self.rate_hz, self.tick_rate_hz, len(self.values))


def encode_block(block: Block) -> bytes:
    """Return a block as a CDR message; the schema follows from the dtype of its values."""
    values = np.ascontiguousarray(block.values)
    if values.dtype not in (_DTYPES[SAMPLE_SCHEMA], _DTYPES[TRUTH_SCHEMA]) or values.ndim != 2 or not values.shape[1]:
        raise TypeError(f"values must be int32 or float64 in columns; received {values.dtype}, {values.shape}")
    head = _HEAD.pack(block.tick, block.index, block.rate_hz, block.tick_rate_hz, values.shape[1], values.size)
    return b"".join((_ENCAPSULATION, head, values.tobytes()))


class ImplausibleError(ValueError):
    """A complete message with a time, number or rate that no stream can have."""


def decode_block(payload: bytes, schema: str) -> Block:
    """Return the block in a CDR message.

    Raises:
        ValueError: The payload is not a complete message of that schema.
        ImplausibleError: No stream can have these values. A rate of 0 is that of edges, which have no rate.
    """
    dtype = _DTYPES[schema]
    start = len(_ENCAPSULATION) + _HEAD.size
    if len(payload) < start or payload[:4] != _ENCAPSULATION:
        raise ValueError(f"payload must be a {schema} message; received {len(payload)} other bytes")
    tick, index, rate_hz, tick_rate_hz, columns, size = _HEAD.unpack_from(payload, len(_ENCAPSULATION))
    if columns == 0 or size % columns or len(payload) != start + size * dtype.itemsize:
        raise ValueError(
            f"payload must hold whole rows of {columns} values, {size} in all; received {len(payload)} bytes"
        )
    rows = size // columns
    if not (
        0 <= tick <= _MAX_TICK
        and 0 <= index <= _MAX_TICK - rows
        and 1.0 <= tick_rate_hz <= _MAX_RATE_HZ
        and (1e-6 <= rate_hz <= tick_rate_hz or (rate_hz == 0.0 and schema == TRUTH_SCHEMA))
        and (rate_hz == 0.0 or rows <= _MAX_BLOCK_S * rate_hz)
    ):
        raise ImplausibleError(
            "payload must have times and numbers that a clock can have; "
            f"received {rows} rows from {index} on at tick {tick}, {rate_hz} Hz of {tick_rate_hz} Hz"
        )
    values = np.frombuffer(payload, dtype, offset=start).reshape(-1, columns)
    return Block(tick=tick, index=index, rate_hz=rate_hz, tick_rate_hz=tick_rate_hz, values=values)


def encode_document(document: dict[str, Any]) -> bytes:
    """Return a JSON document as bytes."""
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


def decode_document(payload: bytes) -> dict[str, Any]:
    """Return the JSON document in a payload.

    Raises:
        InputError: The payload is not a JSON object, or exceeds a limit (`rig.base.checks`).
    """
    return read_json(payload)


@dataclass(frozen=True, slots=True)
class Gap:
    """A step of the row numbers of a stream, before row `index + size`.

    Attributes:
        key: The stream.
        index: Index of the expected row.
        size: Number of missing rows from there; negative if the numbers have stepped back.
    """

    key: str
    index: int
    size: int


class Continuity:
    """Follows the row numbers of any number of streams, and counts received and lost rows.

    Attributes:
        next: Index of the next expected row, by key.
        received: Received rows, each counted once, by key.
        lost: Rows that were not received, by key.
        stale: Rows received twice, or after later ones.
        runs: Number of restarts of a stream's row numbers, by key.
    """

    def __init__(self) -> None:
        self.next: dict[str, int] = {}
        self.received: dict[str, int] = {}
        self.lost: dict[str, int] = {}
        self.stale = 0
        self.runs: dict[str, int] = {}

    def follow(self, key: str, index: int, rows: int, *, late_rows: float = 0.0) -> Gap | None:
        """Count the next rows of a stream; return the step before them, if any.

        Args:
            key: The stream.
            index: Number of the first row.
            rows: Number of rows.
            late_rows: Rows at most this far back are late or repeated; otherwise, and at row 0, the numbers
               restart.
        """
        expected = self.next.get(key, index)
        size = index - expected
        late = index > 0 and 0 < -size <= late_rows
        stale = min(-size, rows) if late else 0
        self.next[key] = max(expected, index + rows) if late else index + rows
        self.received[key] = self.received.get(key, 0) + rows - stale
        self.lost[key] = self.lost.get(key, 0) + max(0, size)
        self.stale += stale
        self.runs[key] = self.runs.get(key, 0) + (size < 0 and not late)
        return Gap(key=key, index=expected, size=size) if size else None

    def add_row_counts(self, event: dict[str, Any]) -> dict[str, Any]:
        """Return an event in its published form: `end` has the index after the last row, by key.

        Blocks and events travel separately: the `rows` of the end show the receiver what is missing.
        """
        return {**event, "rows": dict(self.next)} if event.get("event") == "end" else event
