"""Codec of the virtual CAN bus: frames to packed records and back, and zenoh keys; does no input or output itself.

A message is a header and records of one width. Endpoints offer messages of frames to the hub of their channel. The hub
sends messages to all endpoints: frames in the order of the bus with its time stamps, and reports on nodes. The
identifier word carries its flags as in a SocketCAN frame. Requests to the hub are JSON objects, of the models here.
An endpoint receives a secret when it joins; the secret precedes its offers and is part of its requests, and proves that
the name is its own.
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
    find_fault,
    pack_records,
)
from rig.base.checks import Count, StrictModel

if TYPE_CHECKING:
    import can

DEFAULT_ENDPOINT = "127.0.0.1:7461"
"""Default address of a hub."""

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
"""Node number of a frame without a sender: an offer, or an error frame of the whole bus."""

MAX_RECORDS = 512
"""Largest number of records per message: at most 41 kB, for which no receiver has to allocate much."""

FRAMES = 0
REPORTS = 1

_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_MAGIC = b"RCB1"
_HEADER = struct.Struct("<4sBBH")
_REPORT = struct.Struct("<HBBHHQQ")

SECRET_BYTES = 16
"""Length of the secret that an endpoint receives when it joins."""
Endpoint = Annotated[str, Field(pattern=rf"\A{_NAME.pattern}\z")]
Secret = Annotated[str, Field(pattern=rf"\A[0-9a-f]{{{2 * SECRET_BYTES}}}\z")]


class JoinRequest(StrictModel):
    """Request to join; with its secret an endpoint joins again under its name."""

    endpoint: Endpoint
    listen_only: bool = False
    in_order: bool = False
    secret: Secret | None = None


class FlushRequest(StrictModel):
    """Request to withdraw frames that wait to be sent."""

    endpoint: Endpoint
    secret: Secret


class SetRequest(FlushRequest):
    """Request to take part, or only to listen."""

    listen_only: bool


class StatusRequest(StrictModel):
    """Request for the status."""


REQUESTS = {"join": JoinRequest, "set": SetRequest, "flush": FlushRequest, "status": StatusRequest}


class JoinReply(StrictModel):
    """Reply to a request to join."""

    node: Annotated[int, Field(ge=1, lt=NO_NODE)]
    secret: Secret
    window: Annotated[int, Field(ge=1, le=1 << 16)]
    fd: bool
    nominal_bit_s: float
    data_bit_s: float
    epoch_ns: Count


class CodecError(ValueError):
    """A payload is not a message of this bus, or no controller can send a frame."""


class NodeReport(NamedTuple):
    """State of one node.

    Args:
        node: Number of the node.
        state: 0 error active, 1 error passive, 2 bus off.
        transmit_errors: Transmit error counter.
        receive_errors: Receive error counter.
        done: Frames offered by it that no longer wait: sent, dropped or withdrawn.
        dropped: Frames offered by it that were not sent.
    """

    node: int
    state: int
    transmit_errors: int
    receive_errors: int
    done: int
    dropped: int


HubMessage = np.ndarray | list[NodeReport]
"""Content of a hub's message: frames, as an array of one of the `RECORDS` layouts, or states of nodes."""


def offer_key(channel: str, endpoint: str) -> str:
    """Return the key on which one endpoint offers frames; `*` for all endpoints."""
    return f"{ROOT}/{channel}/offer/{endpoint}"


def bus_key(channel: str) -> str:
    """Return the key of the hub's messages."""
    return f"{ROOT}/{channel}/bus"


def alive_key(channel: str) -> str:
    """Return the key of the hub's token."""
    return f"{ROOT}/{channel}/alive"


def node_key(channel: str, endpoint: str) -> str:
    """Return the key of an endpoint's token; `*` for all endpoints."""
    return f"{ROOT}/{channel}/node/{endpoint}"


def request_key(channel: str, name: str) -> str:
    """Return the key of the hub's requests: `join`, `set`, `flush`, `status`."""
    return f"{ROOT}/{channel}/{name}"


def is_name(text: str) -> bool:
    """Return whether a text is a valid name of a channel or endpoint: letters, digits, `-` and `_`, at most 64."""
    return bool(_NAME.fullmatch(text))


def error_record(time_ns: int, kind: int, *, data: bytes = bytes(8), node: int = NO_NODE) -> Record:
    """Return an error frame as in SocketCAN.

    Args:
        time_ns: Time since the Unix epoch [ns].
        kind: Error class, such as NO_ACKNOWLEDGE, or several combined.
        data: Details of the class, 8 bytes.
        node: Number of the node that failed to send.
    """
    return Record(time_ns, ERROR | kind, 8, 0, node, data)


def make_overflow(time_ns: int) -> Record:
    """Return the error frame of a receiver that lost frames."""
    return error_record(time_ns, CONTROLLER, data=bytes((0, RECEIVE_OVERFLOW, 0, 0, 0, 0, 0, 0)))


def encode(records: np.ndarray) -> bytes:
    """Encode at most MAX_RECORDS frames, an array of one of the `RECORDS` layouts, as one message."""
    width = records.dtype["data"].itemsize
    return _HEADER.pack(_MAGIC, FRAMES, width, len(records)) + records.tobytes()


def encode_reports(reports: Iterable[NodeReport]) -> bytes:
    """Encode node reports as one message."""
    rows = [_REPORT.pack(row.node, row.state, 0, *row[2:]) for row in reports]
    return _HEADER.pack(_MAGIC, REPORTS, _REPORT.size, len(rows)) + b"".join(rows)


def decode(payload: bytes) -> HubMessage:
    """Decode a message: frames as a read-only array of one of the `RECORDS` layouts, shape (frames,), or reports.

    Raises:
        CodecError: The payload is not a message of this bus.
    """
    if len(payload) < _HEADER.size:
        raise CodecError(f"a message must have a header; received {len(payload)} bytes")
    magic, kind, width, count = _HEADER.unpack_from(payload)
    if magic != _MAGIC or kind not in (FRAMES, REPORTS):
        raise CodecError("the header must be one of this bus")
    size = _REPORT.size if kind == REPORTS else RECORDS[width].itemsize if width in RECORDS else 0
    if not size or (kind == REPORTS and width != size):
        raise CodecError(f"records of unknown width {width}")
    if count > MAX_RECORDS or len(payload) != _HEADER.size + count * size:
        raise CodecError(f"{len(payload)} bytes for {count} records of {size} bytes")
    if kind == FRAMES:
        return np.frombuffer(payload, RECORDS[width], offset=_HEADER.size)
    rows = _REPORT.iter_unpack(memoryview(payload)[_HEADER.size :])
    return [NodeReport(node, state, *counts) for node, state, _, *counts in rows]


def make_record(message: can.Message) -> Record:
    """Convert a python-can message to an offered frame.

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


def make_offer(message: can.Message, *, fd: bool = True) -> Record:
    """Convert a python-can message that a controller can send to an offered frame.

    Args:
        message: The message.
        fd: Whether the bus supports CAN FD frames.

    Raises:
        CodecError: No controller can send it, for the reason in the message.
    """
    record = make_record(message)
    if (fault := find_fault(record, fd=fd)) is not None:
        raise CodecError(fault)
    return record


def make_records(messages: Iterable[can.Message]) -> np.ndarray:
    """Convert python-can messages to an array of offered frames, shape (messages,)."""
    return pack_records(map(make_record, messages))


def make_messages(records: np.ndarray, *, channel: Any = None, node: int = NO_NODE) -> list[can.Message]:
    """Convert frames from the bus to python-can messages.

    Args:
        records: Array of one of the `RECORDS` layouts.
        channel: Channel to name in the messages.
        node: The receiver's own number: frames from it are not marked as received.
    """
    return [make_message(Record(*fields), channel=channel, node=node) for fields in records.tolist()]


def make_message(record: Record, *, channel: Any = None, node: int = NO_NODE) -> can.Message:
    """Convert one frame from the bus to a python-can message; arguments as for `make_messages`."""
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
