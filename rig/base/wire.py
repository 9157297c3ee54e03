"""Sans-IO codec: blocks of samples and documents to bytes and back, and the keys they travel under.

A block is one CDR message (little-endian, ROS 2 message definitions below), so that any reader of ROS 2 messages
decodes it without this project. A document is JSON. A stream is an event `start`, blocks, and an event `end` with a
reason; any step of a block's index other than its length is a gap, counted by `Continuity` and never hidden. What of
it comes from outside is taken by an `Intake` (`rig.serve.stream_check`).
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
"""What is told of faults, row by row: documents, beside the blocks of truth."""
BLOCK = f"{ROOT}/block"
"""What is told behind all else of a block while devices have joined: that it is over."""
ENDED = "a run that ended"
"""What a command that comes too late is told that it met; why it ended follows."""
COMMAND = f"{ROOT}/command"
CLIENTS = f"{ROOT}/clients"


def sensor_key(group: str) -> str:
    """Key of one sensor group's blocks."""
    return f"{SENSORS}/{group}"


def truth_key(table: str) -> str:
    """Key of one truth table's blocks."""
    return f"{TRUTH}/{table}"


def command_key(name: str) -> str:
    """Key on which a command is answered."""
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
_MOST = 1 << 53
"""Ticks and row numbers up to here are exact in every number that they become: 285 years of microseconds."""
_MOST_RATE_HZ = 1e12
_MOST_BLOCK_S = 1e6


def schema_of(key: str) -> str | None:
    """Block schema of a key's payloads, or None where they are JSON documents."""
    if key == EDGES or (key.startswith(TRUTH + "/") and key != FAULTS):
        return TRUTH_SCHEMA
    return SAMPLE_SCHEMA if key.startswith(SENSORS + "/") else None


def _row(tick: int, rate_hz: float, tick_rate_hz: float) -> float:
    """Number of the row that is told to the nearest tick, from time zero on.

    Rows of an even stream lie at whole numbers over the rate, which need not be whole ticks.
    """
    row = tick * rate_hz / tick_rate_hz
    return round(row) if abs(round(row) * tick_rate_hz / rate_hz - tick) <= 0.5 else row


def row_times_s(tick: int, rate_hz: float, tick_rate_hz: float, rows: int) -> np.ndarray:
    """Times of consecutive rows of which the first is told to the nearest tick [s], shape (rows,)."""
    return (_row(tick, rate_hz, tick_rate_hz) + np.arange(rows)) / rate_hz


def row_tick(tick: int, rate_hz: float, tick_rate_hz: float, row: int) -> int:
    """Tick of a row so many behind one that is told to the nearest tick: not rounded twice."""
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
    """One block as a CDR message; the schema follows from the dtype of its values."""
    values = np.ascontiguousarray(block.values)
    if values.dtype not in (_DTYPES[SAMPLE_SCHEMA], _DTYPES[TRUTH_SCHEMA]) or values.ndim != 2 or not values.shape[1]:
        raise TypeError(f"values must be int32 or float64 in columns; instead received {values.dtype}, {values.shape}")
    head = _HEAD.pack(block.tick, block.index, block.rate_hz, block.tick_rate_hz, values.shape[1], values.size)
    return b"".join((_ENCAPSULATION, head, values.tobytes()))


class ImplausibleError(ValueError):
    """A whole message that names a time, a number or a rate that no stream can have."""


def decode_block(payload: bytes, schema: str) -> Block:
    """The block in a CDR message.

    Raises:
        ValueError: The payload is not a whole message of that schema.
        ImplausibleError: It is one that no stream can have. A rate of 0 is that of edges, which have none.
    """
    dtype = _DTYPES[schema]
    start = len(_ENCAPSULATION) + _HEAD.size
    if len(payload) < start or payload[:4] != _ENCAPSULATION:
        raise ValueError(f"payload must be a {schema} message; instead received {len(payload)} bytes that are none")
    tick, index, rate_hz, tick_rate_hz, columns, size = _HEAD.unpack_from(payload, len(_ENCAPSULATION))
    if columns == 0 or size % columns or len(payload) != start + size * dtype.itemsize:
        raise ValueError(
            f"payload must hold whole rows of {columns} values, {size} in all; instead received {len(payload)} bytes"
        )
    rows = size // columns
    if not (
        0 <= tick <= _MOST
        and 0 <= index <= _MOST - rows
        and 1.0 <= tick_rate_hz <= _MOST_RATE_HZ
        and (1e-6 <= rate_hz <= tick_rate_hz or (rate_hz == 0.0 and schema == TRUTH_SCHEMA))
        and (rate_hz == 0.0 or rows <= _MOST_BLOCK_S * rate_hz)
    ):
        raise ImplausibleError(
            "payload must have times and numbers that a clock can have; "
            f"instead received {rows} rows from {index} on at tick {tick}, {rate_hz} Hz of {tick_rate_hz} Hz"
        )
    values = np.frombuffer(payload, dtype, offset=start).reshape(-1, columns)
    return Block(tick=tick, index=index, rate_hz=rate_hz, tick_rate_hz=tick_rate_hz, values=values)


def encode_document(document: dict[str, Any]) -> bytes:
    """A JSON document as bytes."""
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


def decode_document(payload: bytes) -> dict[str, Any]:
    """The JSON document in a payload.

    Raises:
        InputError: The payload is no JSON object, or one out of bounds (`rig.base.checks`).
    """
    return read_json(payload)


@dataclass(frozen=True, slots=True)
class Gap:
    """A step of the row numbers of a stream, before row `index + size`.

    Attributes:
        key: The stream.
        index: Number of the row that was due.
        size: Rows that never arrived, from that one on; below 0 the numbers have stepped back by so many.
    """

    key: str
    index: int
    size: int


class Continuity:
    """Follows the row numbers of any number of streams, and counts what has come and what has not.

    Attributes:
        next: Number of the row that is due next, by key.
        received: Rows that have come, each once, by key.
        lost: Rows that never came, by key.
        stale: Rows that came twice, or after later ones.
        runs: How often the numbers of a stream began anew, by key; 0 where they never did.
    """

    def __init__(self) -> None:
        self.next: dict[str, int] = {}
        self.received: dict[str, int] = {}
        self.lost: dict[str, int] = {}
        self.stale = 0
        self.runs: dict[str, int] = {}

    def follow(self, key: str, index: int, rows: int, *, late_rows: float = 0.0) -> Gap | None:
        """Take the next rows of a stream; return the step before them, if there is one.

        Args:
            key: The stream.
            index: Number of the first row.
            rows: How many.
            late_rows: Rows that are at most so far behind come late or a second time; with others, and with row 0, the
                numbers begin anew.
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

    def tell(self, event: dict[str, Any]) -> dict[str, Any]:
        """An event as it is published: an `end` with the number of the row after the last one, by key.

        Blocks and events travel apart: whoever has the end can tell from its `rows` what it still lacks.
        """
        return {**event, "rows": dict(self.next)} if event.get("event") == "end" else event
