"""Sans-IO codec of the virtual CAN bus: frames to packed records and back, and the keys they travel under.

A message is a header and records of one width. Endpoints offer messages of frames to the hub of their channel; the
hub sends all endpoints messages of frames, in the order of the bus and with its time stamps, and of node reports. The
identifier word carries its flags as a SocketCAN frame does. Requests to the hub are JSON objects, of the models here.
Whoever joins gets a secret; with it in front of its offers and in its requests it shows that the name is its own.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from drivers.can.bus.frame import (
    BRS,
    ERROR,
    ESI,
    EXTENDED,
    EXTENDED_MASK,
    FD,
    RECORDS,
    REMOTE,
    Record,
    fault_of,
    packed,
)
from rig.base.checks import Count, Outside

if TYPE_CHECKING:
    import can

DEFAULT_ENDPOINT = "127.0.0.1:7461"
"""Where a hub listens, and endpoints look for one, unless told otherwise."""

ROOT = "rig/can"
ALIVE = f"{ROOT}/*/alive"

# Error classes and details, as in SocketCAN's linux/can/error.h.
CONTROLLER = 0x004
PROTOCOL = 0x008
NO_ACKNOWLEDGE = 0x020
BUS_OFF = 0x040
BUS_ERROR = 0x080
RESTARTED = 0x100
COUNTERS = 0x200
RECEIVE_OVERFLOW = 0x01
RECEIVE_PASSIVE = 0x10
TRANSMIT_PASSIVE = 0x20
ACTIVE_AGAIN = 0x40

NO_NODE = 0xFFFF
"""Where a frame has no sender: an offer, or an error frame of the whole bus."""

MAX_RECORDS = 512
"""Records a message may have: at most 41 kB, which one send takes and no receiver has to allocate much for."""

FRAMES = 0
REPORTS = 1

_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_MAGIC = b"RCB1"
_HEADER = struct.Struct("<4sBBH")
_REPORT = struct.Struct("<HBBHHQQ")

SECRET_BYTES = 16
"""Length of what an endpoint gets when it joins."""
Endpoint = Annotated[str, Field(pattern=rf"\A{_NAME.pattern}\z")]
Secret = Annotated[str, Field(pattern=rf"\A[0-9a-f]{{{2 * SECRET_BYTES}}}\z")]


class Joining(Outside):
    """A request to join; with its secret an endpoint joins again under its name."""

    endpoint: Endpoint
    listen_only: bool = False
    secret: Secret | None = None


class Flushing(Outside):
    """A request to withdraw what waits to be sent."""

    endpoint: Endpoint
    secret: Secret


class Setting(Flushing):
    """A request to take part, or only to listen."""

    listen_only: bool


class Asking(Outside):
    """A request for the status."""


REQUESTS: dict[str, type[Outside]] = {"join": Joining, "set": Setting, "flush": Flushing, "status": Asking}


class Joined(Outside):
    """The answer to one who joins."""

    node: Annotated[int, Field(ge=1, lt=NO_NODE)]
    secret: Secret
    window: Annotated[int, Field(ge=1, le=1 << 16)]
    fd: bool
    nominal_bit_s: float
    data_bit_s: float
    epoch_ns: Count


class CodecError(ValueError):
    """A payload is not a message of this bus, or a frame none that a controller can send."""


class Report(NamedTuple):
    """What the hub says of one node.

    Args:
        node: Its number.
        state: 0 error active, 1 error passive, 2 bus off.
        transmit_errors: Transmit error counter.
        receive_errors: Receive error counter.
        done: Frames offered by it that wait no longer: sent, dropped or withdrawn.
        dropped: Frames offered by it that were not sent.
    """

    node: int
    state: int
    transmit_errors: int
    receive_errors: int
    done: int
    dropped: int


Said = np.ndarray | list[Report]
"""What the hub says: frames, as an array of one of the `RECORDS` layouts, or how nodes are."""


def offer_key(channel: str, endpoint: str) -> str:
    """Key on which one endpoint offers frames; `*` for all endpoints."""
    return f"{ROOT}/{channel}/offer/{endpoint}"


def bus_key(channel: str) -> str:
    """Key on which the hub sends what happens on the bus."""
    return f"{ROOT}/{channel}/bus"


def alive_key(channel: str) -> str:
    """Key of the hub's token."""
    return f"{ROOT}/{channel}/alive"


def node_key(channel: str, endpoint: str) -> str:
    """Key of an endpoint's token; `*` for all endpoints."""
    return f"{ROOT}/{channel}/node/{endpoint}"


def request_key(channel: str, name: str) -> str:
    """Key on which the hub answers requests: `join`, `set`, `flush`, `status`."""
    return f"{ROOT}/{channel}/{name}"


def is_name(text: str) -> bool:
    """Whether a channel or endpoint can be called so: letters, digits, `-` and `_`, at most 64."""
    return bool(_NAME.fullmatch(text))


def error_record(time_ns: int, kind: int, *, data: bytes = bytes(8), node: int = NO_NODE) -> Record:
    """An error frame as SocketCAN reports it.

    Args:
        time_ns: When, since the Unix epoch [ns].
        kind: Its class, such as NO_ACKNOWLEDGE; several may be joined.
        data: What the class says in detail, 8 bytes.
        node: Number of the node that failed to send.
    """
    return Record(time_ns, ERROR | kind, 8, 0, node, data)


def overflow(time_ns: int) -> Record:
    """The error frame of a receiver that lost frames."""
    return error_record(time_ns, CONTROLLER, data=bytes((0, RECEIVE_OVERFLOW, 0, 0, 0, 0, 0, 0)))


def encode(records: np.ndarray) -> bytes:
    """One message of at most MAX_RECORDS frames that are an array of one of the `RECORDS` layouts."""
    width = records.dtype["data"].itemsize
    return _HEADER.pack(_MAGIC, FRAMES, width, len(records)) + records.tobytes()


def encode_reports(reports: Iterable[Report]) -> bytes:
    """One message of node reports."""
    rows = [_REPORT.pack(row.node, row.state, 0, *row[2:]) for row in reports]
    return _HEADER.pack(_MAGIC, REPORTS, _REPORT.size, len(rows)) + b"".join(rows)


def decode(payload: bytes) -> Said:
    """What is in a message: frames as a read-only array of one of the `RECORDS` layouts, shape (frames,), or reports.

    Raises:
        CodecError: It is no message of this bus.
    """
    if len(payload) < _HEADER.size:
        raise CodecError(f"{len(payload)} bytes, fewer than a header has")
    magic, kind, width, count = _HEADER.unpack_from(payload)
    if magic != _MAGIC or kind not in (FRAMES, REPORTS):
        raise CodecError("no header of this bus")
    size = _REPORT.size if kind == REPORTS else RECORDS[width].itemsize if width in RECORDS else 0
    if not size or (kind == REPORTS and width != size):
        raise CodecError(f"records of unknown width {width}")
    if count > MAX_RECORDS or len(payload) != _HEADER.size + count * size:
        raise CodecError(f"{len(payload)} bytes for {count} records of {size} bytes")
    if kind == FRAMES:
        return np.frombuffer(payload, RECORDS[width], offset=_HEADER.size)
    rows = _REPORT.iter_unpack(memoryview(payload)[_HEADER.size :])
    return [Report(node, state, *counts) for node, state, _, *counts in rows]


def record_of(message: can.Message) -> Record:
    """A python-can message as an offered frame.

    Raises:
        CodecError: Its identifier has more than 29 bits.
    """
    word = message.arbitration_id
    if not 0 <= word <= EXTENDED_MASK:
        raise CodecError(f"identifier {word:#x} does not have 29 bits")
    if message.is_extended_id:
        word |= EXTENDED
    flags = 0
    if message.is_remote_frame:
        word |= REMOTE
    if message.is_error_frame:
        word |= ERROR
    if message.is_fd:
        flags = FD | message.bitrate_switch * BRS | message.error_state_indicator * ESI
    data = b"" if message.is_remote_frame else bytes(message.data)
    return Record(0, word, message.dlc if message.is_remote_frame else len(data), flags, NO_NODE, data)


def offered(message: can.Message, *, fd: bool = True) -> Record:
    """`record_of`, if a controller can send it.

    Args:
        message: The frame.
        fd: Whether the bus takes CAN FD frames.

    Raises:
        CodecError: None can; it says why.
    """
    record = record_of(message)
    if (fault := fault_of(record, fd=fd)) is not None:
        raise CodecError(fault)
    return record


def records_of(messages: Iterable[can.Message]) -> np.ndarray:
    """Python-can messages as an array of offered frames, shape (messages,)."""
    return packed(map(record_of, messages))


def messages_of(records: np.ndarray, *, channel: Any = None, node: int = NO_NODE) -> list[can.Message]:
    """Frames from the bus as python-can messages.

    Args:
        records: Array of one of the `RECORDS` layouts.
        channel: What the messages name as their channel.
        node: The receiver's own number: frames from it are no received ones.
    """
    return [message_of(Record(*fields), channel=channel, node=node) for fields in records.tolist()]


def message_of(record: Record, *, channel: Any = None, node: int = NO_NODE) -> can.Message:
    """One frame from the bus as a python-can message; arguments as of `messages_of`."""
    import can

    time_ns, word, length, flags, sender, data = record
    remote, error = word & REMOTE != 0, word & ERROR != 0
    return can.Message(
        timestamp=time_ns * 1e-9,
        arbitration_id=word & EXTENDED_MASK,
        is_extended_id=word & EXTENDED != 0,
        is_remote_frame=remote,
        is_error_frame=error,
        channel=channel,
        dlc=length,
        data=None if remote else bytearray(data[:length]),
        is_fd=flags & FD != 0,
        is_rx=error or sender != node,
        bitrate_switch=flags & BRS != 0,
        error_state_indicator=flags & ESI != 0,
    )
