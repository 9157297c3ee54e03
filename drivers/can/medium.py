"""Sans-IO codec of the virtual CAN medium: frames to packed records and back, and the keys they travel under.

A message is a header and records of one width. Endpoints offer messages of frames to the hub of their channel; the
hub sends all endpoints messages of frames, in the order of the bus and with its time stamps, and of node reports. The
identifier word carries its flags as a SocketCAN frame does.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import can

DEFAULT_ENDPOINT = "127.0.0.1:7461"
"""Where a hub listens, and endpoints look for one, unless told otherwise."""

ROOT = "rig/can"
ALIVE = f"{ROOT}/*/alive"

EXTENDED = 1 << 31
REMOTE = 1 << 30
ERROR = 1 << 29
STANDARD_MASK = (1 << 11) - 1
EXTENDED_MASK = (1 << 29) - 1

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

FD = 1
BIT_RATE_SWITCH = 2
ERROR_STATE = 4

NO_NODE = 0xFFFF
"""Where a frame has no sender: an offer, or an error frame of the whole bus."""

CLASSIC_WIDTH = 8
FD_WIDTH = 64
FD_LENGTHS = frozenset((*range(9), 12, 16, 20, 24, 32, 48, 64))
"""Data lengths that a CAN FD frame can have [bytes]."""

MAX_RECORDS = 512
"""Records a message may have: at most 41 kB, which one send takes and no receiver has to allocate much for."""

FRAMES = 0
REPORTS = 1

_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_IS_FD_LENGTH = np.isin(np.arange(256), list(FD_LENGTHS))
_MAGIC = b"RCB1"
_HEADER = struct.Struct("<4sBBH")
_RECORDS = {width: struct.Struct(f"<QIBBH{width}s") for width in (CLASSIC_WIDTH, FD_WIDTH)}
_REPORT = struct.Struct("<HBBHHQQ")

RECORDS = {
    width: np.dtype(
        [
            ("time_ns", "<u8"),
            ("identifier", "<u4"),
            ("length", "u1"),
            ("flags", "u1"),
            ("node", "<u2"),
            ("data", f"V{width}"),
        ]
    )
    for width in (CLASSIC_WIDTH, FD_WIDTH)
}
"""Layout of a frame's record by width of its data field: `time_ns` since the Unix epoch [ns], at the end of the frame
(0 in an offer); `identifier` with EXTENDED, REMOTE, ERROR; `length` of the data, or the one asked for [bytes]; `flags`
FD, BIT_RATE_SWITCH, ERROR_STATE; `node` number of the sender."""


class MediumError(ValueError):
    """A payload is not a message of this medium."""


class Record(NamedTuple):
    """One frame as it travels; the fields are those of `RECORDS`, the data without its padding."""

    time_ns: int
    identifier: int
    length: int
    flags: int
    node: int
    data: bytes


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


def fault_of(record: Record, *, fd: bool = True) -> str | None:
    """Why no controller could send such a frame; None if one could.

    Args:
        record: A frame that somebody wants to send.
        fd: Whether the bus takes CAN FD frames.
    """
    word, length, flags = record.identifier, record.length, record.flags
    if word & ERROR:
        return "an error frame: controllers send those by themselves"
    if not word & REMOTE and length != len(record.data):
        return f"{length} bytes of data in a field of {len(record.data)}"
    if word & EXTENDED_MASK > (EXTENDED_MASK if word & EXTENDED else STANDARD_MASK):
        return f"identifier {word & EXTENDED_MASK:#x} has more than 11 bits, and the frame is not extended"
    if flags & ~(FD | BIT_RATE_SWITCH | ERROR_STATE):
        return f"unknown flags {flags:#x}"
    if flags & FD:
        if not fd:
            return "a CAN FD frame, on a bus for classic CAN"
        if word & REMOTE:
            return "a remote frame, which CAN FD does not have"
        if length not in FD_LENGTHS:
            return f"{length} bytes, which is no length of a CAN FD frame"
    elif flags:
        return "a bit rate switch or error state indicator, which classic CAN does not have"
    elif length > CLASSIC_WIDTH:
        return f"{length} bytes in a classic frame"
    return None


def sendable(records: np.ndarray, *, fd: bool = True) -> np.ndarray:
    """Of which frames `fault_of` finds no fault, shape of `records`.

    Args:
        records: Array of one of the `RECORDS` layouts.
        fd: Whether the bus takes CAN FD frames.
    """
    word, length, flags = records["identifier"], records["length"], records["flags"]
    extended, remote, is_fd = word & EXTENDED != 0, word & REMOTE != 0, flags & FD != 0
    good = (word & ERROR == 0) & (extended | (word & EXTENDED_MASK <= STANDARD_MASK))
    good &= remote | (length <= records.dtype["data"].itemsize)
    if not fd:
        good &= ~is_fd
    good &= np.where(is_fd, ~remote & _IS_FD_LENGTH[length], (length <= CLASSIC_WIDTH) & (flags == 0))
    return good & (flags & ~np.uint8(FD | BIT_RATE_SWITCH | ERROR_STATE) == 0)


def widen(records: np.ndarray | Iterable[Record]) -> np.ndarray:
    """A copy of frames in the widest layout, zeros behind their data."""
    if not isinstance(records, np.ndarray):
        pack = _RECORDS[FD_WIDTH].pack
        return np.frombuffer(bytearray(b"".join([pack(*row) for row in records])), RECORDS[FD_WIDTH])
    found = np.zeros(len(records), RECORDS[FD_WIDTH])
    for name in ("time_ns", "identifier", "length", "flags", "node"):
        found[name] = records[name]
    width = records.dtype["data"].itemsize
    _bytes_of(found)[:, :width] = _bytes_of(records)
    return found


def narrow(records: np.ndarray) -> np.ndarray:
    """A copy of frames of at most 8 bytes in the narrow layout."""
    found = np.zeros(len(records), RECORDS[CLASSIC_WIDTH])
    for name in ("time_ns", "identifier", "length", "flags", "node"):
        found[name] = records[name]
    _bytes_of(found)[:] = _bytes_of(records)[:, :CLASSIC_WIDTH]
    return found


def _bytes_of(records: np.ndarray) -> np.ndarray:
    """The data fields as bytes, shape (frames, width); a view."""
    width = records.dtype["data"].itemsize
    names = ["time_ns", "identifier", "length", "flags", "node", "data"]
    formats = ["<u8", "<u4", "u1", "u1", "<u2", ("u1", (width,))]
    return records.view(np.dtype({"names": names, "formats": formats}))["data"]


def encode(records: Iterable[Record]) -> bytes:
    """One message of at most MAX_RECORDS frames, as narrow as they allow."""
    rows = list(records)
    width = FD_WIDTH if any(len(row.data) > CLASSIC_WIDTH for row in rows) else CLASSIC_WIDTH
    pack = _RECORDS[width].pack
    return _HEADER.pack(_MAGIC, FRAMES, width, len(rows)) + b"".join([pack(*row) for row in rows])


def encode_array(records: np.ndarray) -> bytes:
    """One message of at most MAX_RECORDS frames that are an array of one of the `RECORDS` layouts."""
    width = records.dtype["data"].itemsize
    return _HEADER.pack(_MAGIC, FRAMES, width, len(records)) + records.tobytes()


def encode_reports(reports: Iterable[Report]) -> bytes:
    """One message of node reports."""
    rows = [_REPORT.pack(row.node, row.state, 0, *row[2:]) for row in reports]
    return _HEADER.pack(_MAGIC, REPORTS, _REPORT.size, len(rows)) + b"".join(rows)


def kind_of(payload: bytes) -> int:
    """Whether a message has FRAMES or REPORTS; its length is checked too.

    Raises:
        MediumError: It is no message of this medium.
    """
    if len(payload) < _HEADER.size:
        raise MediumError(f"{len(payload)} bytes, fewer than a header has")
    magic, kind, width, count = _HEADER.unpack_from(payload)
    if magic != _MAGIC or kind not in (FRAMES, REPORTS):
        raise MediumError("no header of this medium")
    size = _REPORT.size if kind == REPORTS else _RECORDS[width].size if width in _RECORDS else 0
    if not size or (kind == REPORTS and width != size):
        raise MediumError(f"records of unknown width {width}")
    if count > MAX_RECORDS or len(payload) != _HEADER.size + count * size:
        raise MediumError(f"{len(payload)} bytes for {count} records of {size} bytes")
    return kind


def decode(payload: bytes) -> Iterator[Record]:
    """The frames of a message, in order.

    Raises:
        MediumError: It is no message of frames.
    """
    if kind_of(payload) != FRAMES:
        raise MediumError("reports where frames were expected")
    layout = _RECORDS[payload[5]]
    for time_ns, word, length, flags, node, data in layout.iter_unpack(memoryview(payload)[_HEADER.size :]):
        yield Record(time_ns, word, length, flags, node, b"" if word & REMOTE else data[:length])


def decode_array(payload: bytes) -> np.ndarray:
    """The frames of a message as a read-only array of one of the `RECORDS` layouts, shape (frames,).

    Raises:
        MediumError: It is no message of frames.
    """
    if kind_of(payload) != FRAMES:
        raise MediumError("reports where frames were expected")
    return np.frombuffer(payload, RECORDS[payload[5]], offset=_HEADER.size)


def decode_reports(payload: bytes) -> list[Report]:
    """The node reports of a message.

    Raises:
        MediumError: It is no message of reports.
    """
    if kind_of(payload) != REPORTS:
        raise MediumError("frames where reports were expected")
    rows = _REPORT.iter_unpack(memoryview(payload)[_HEADER.size :])
    return [Report(node, state, *counts) for node, state, _, *counts in rows]


def record_of(message: can.Message) -> Record:
    """A python-can message as an offered frame.

    Raises:
        MediumError: Its identifier has more than 29 bits.
    """
    word = message.arbitration_id
    if not 0 <= word <= EXTENDED_MASK:
        raise MediumError(f"identifier {word:#x} does not have 29 bits")
    if message.is_extended_id:
        word |= EXTENDED
    flags = 0
    if message.is_remote_frame:
        word |= REMOTE
    if message.is_error_frame:
        word |= ERROR
    if message.is_fd:
        flags = FD | message.bitrate_switch * BIT_RATE_SWITCH | message.error_state_indicator * ERROR_STATE
    data = b"" if message.is_remote_frame else bytes(message.data)
    return Record(0, word, message.dlc if message.is_remote_frame else len(data), flags, NO_NODE, data)


def records_of(messages: Iterable[can.Message]) -> np.ndarray:
    """Python-can messages as an array of offered frames, shape (messages,)."""
    rows = [record_of(message) for message in messages]
    width = FD_WIDTH if any(len(row.data) > CLASSIC_WIDTH for row in rows) else CLASSIC_WIDTH
    pack = _RECORDS[width].pack
    return np.frombuffer(b"".join([pack(*row) for row in rows]), RECORDS[width])


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
        bitrate_switch=flags & BIT_RATE_SWITCH != 0,
        error_state_indicator=flags & ERROR_STATE != 0,
    )
