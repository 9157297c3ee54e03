"""Codec of the instrument protocol: requests, replies and data to bytes and back; does no input or output itself.

A message is a header (version, number of the instrument, kind, sequence number; little-endian) followed by the fields
of its kind. A reply repeats the sequence number of its request; data messages have their own count. Every request has a
reply: `Refused` if it cannot be decoded or carried out. Bytes that are not a message raise only `ProtocolError`.
"""

from __future__ import annotations

import dataclasses
import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, TypeVar

import numpy as np

from drivers.link import Address

VERSION = 1
HEAD = struct.Struct("<BBBI")
_COUNTS = np.dtype("<i4")


class Reason(IntEnum):
    """Reason for refusing a request, or for rejecting bytes."""

    VERSION = 1
    INSTRUMENT = 2
    KIND = 3
    LENGTH = 4
    VALUE = 5
    REFUSED = 6
    """The instrument or its rig does not allow it: the text gives the reason."""
    UNAVAILABLE = 7
    """The instrument's rig does not reply."""


class ProtocolError(ValueError):
    """Bytes are not a message of the protocol."""

    def __init__(self, reason: Reason, text: str, *, sequence: int = 0) -> None:
        self.reason = reason
        self.sequence = sequence
        """Sequence number of the message, if it can be read."""
        super().__init__(text)


class VariableField:
    """Type of a message's last field if its length varies: it extends to the end of the message."""

    TEXT = "text"
    COUNTS = "counts"


@dataclass(frozen=True, slots=True)
class InstrumentMessage:
    """Base of all messages: number of the kind, `struct` format of the fields, type of a variable last field."""

    KIND: ClassVar[int] = 0
    LAYOUT: ClassVar[str] = "<"
    LAST_FIELD: ClassVar[str | None] = None


# ---- requests, from the host ----


@dataclass(frozen=True, slots=True)
class Identify(InstrumentMessage):
    """Request for the datasheet."""

    KIND = 0x01


@dataclass(frozen=True, slots=True)
class Configure(InstrumentMessage):
    """Request to select channels and rate; ends a stream that runs.

    Attributes:
        rate_hz: Sample rate [Hz]; 0 for the instrument's own rate.
        channels: Bit n is channel n of the datasheet; 0 for all.
    """

    KIND = 0x02
    LAYOUT = "<dI"
    rate_hz: float
    channels: int


@dataclass(frozen=True, slots=True)
class Start(InstrumentMessage):
    """Request to start a stream of data."""

    KIND = 0x03


@dataclass(frozen=True, slots=True)
class Stop(InstrumentMessage):
    """Request to stop a stream of data; without effect if another stream runs.

    Attributes:
        stream: Number of the stream; 0 for the current one.
        discard: Whether to discard measured data that have not been sent (not 0).
    """

    KIND = 0x04
    LAYOUT = "<IB"
    stream: int
    discard: int


@dataclass(frozen=True, slots=True)
class InstrumentCommand(InstrumentMessage):
    """Base of an instrument's commands; kinds from 0x40 on, which differ between instruments.

    Its fields are those of the rig's command `COMMAND`; a field that accepts a word or a number is sent as text.
    """

    COMMAND: ClassVar[str] = ""


# ---- replies, from the instrument ----


@dataclass(frozen=True, slots=True)
class Identity(InstrumentMessage):
    """Reply with the datasheet (`drivers.instruments.common.datasheet`) as JSON."""

    KIND = 0x81
    LAST_FIELD = VariableField.TEXT
    datasheet: str


@dataclass(frozen=True, slots=True)
class Configured(InstrumentMessage):
    """Reply with the selected rate [Hz] and channels as bits."""

    KIND = 0x82
    LAYOUT = "<dI"
    rate_hz: float
    channels: int


@dataclass(frozen=True, slots=True)
class Started(InstrumentMessage):
    """Reply with the number of the new stream."""

    KIND = 0x83
    LAYOUT = "<I"
    stream: int


@dataclass(frozen=True, slots=True)
class Stopped(InstrumentMessage):
    """Reply with the number of rows that the stream has sent, and of rows dropped because the link was full."""

    KIND = 0x84
    LAYOUT = "<IQQ"
    stream: int
    rows: int
    dropped: int


@dataclass(frozen=True, slots=True)
class Done(InstrumentMessage):
    """Acknowledgement of a command: its number in the rig's run, and when it takes effect [ticks], [s]."""

    KIND = 0x85
    LAYOUT = "<qqd"
    id: int
    tick: int
    time_s: float


@dataclass(frozen=True, slots=True)
class Refused(InstrumentMessage):
    """Refusal of a request: a `Reason`, and one line of text."""

    KIND = 0x86
    LAYOUT = "<B"
    LAST_FIELD = VariableField.TEXT
    reason: int
    text: str


# ---- data, sent by the instrument while a stream runs ----


@dataclass(frozen=True, slots=True)
class Rows(InstrumentMessage):
    """Consecutive rows of ADC counts.

    Attributes:
        stream: Number of the stream.
        index: Number of the first row since the start of the rig's stream, at `rate_hz`.
        tick: Time of the first row [ticks].
        rate_hz: Sample rate [Hz].
        tick_rate_hz: Ticks per second [Hz].
        columns: Values per row.
        counts: int32, shape (rows, columns).
    """

    KIND = 0xC1
    LAYOUT = "<IqqddB"
    LAST_FIELD = VariableField.COUNTS
    stream: int
    index: int
    tick: int
    rate_hz: float
    tick_rate_hz: float
    columns: int
    counts: np.ndarray


ROWS_HEAD = HEAD.size + struct.calcsize(Rows.LAYOUT)


@dataclass(frozen=True, slots=True)
class Ended(InstrumentMessage):
    """End of a stream, with the reason."""

    KIND = 0xC2
    LAYOUT = "<I"
    LAST_FIELD = VariableField.TEXT
    stream: int
    reason: str


COMMON_MESSAGES: tuple[type[InstrumentMessage], ...] = (
    Identify, Configure, Start, Stop, Identity, Configured, Started, Stopped, Done, Refused, Rows, Ended,
)  # fmt: skip
M = TypeVar("M", bound=InstrumentMessage)


class Codec:
    """Converts messages of one instrument to bytes and back.

    Args:
        address: Name and number of the instrument.
        commands: Classes of its commands.
    """

    def __init__(self, address: Address, commands: tuple[type[InstrumentCommand], ...] = ()) -> None:
        self.address = address
        self.commands = commands
        self.kinds = {each.KIND: (each, struct.Struct(each.LAYOUT)) for each in (*COMMON_MESSAGES, *commands)}

    def encode(self, message: InstrumentMessage, sequence: int) -> bytes:
        """Encode one message."""
        kind, layout = self.kinds[message.KIND]
        values = [getattr(message, each.name) for each in dataclasses.fields(kind)]
        tail = b""
        if kind.LAST_FIELD == VariableField.TEXT:
            tail = str(values.pop()).encode()
        elif kind.LAST_FIELD == VariableField.COUNTS:
            tail = np.ascontiguousarray(values.pop(), _COUNTS).tobytes()
        head = HEAD.pack(VERSION, self.address.number, kind.KIND, sequence & 0xFFFFFFFF)
        return b"".join((head, layout.pack(*values), tail))

    def decode(self, data: bytes) -> tuple[int, InstrumentMessage]:
        """Decode one message; return its sequence number and the message.

        Raises:
            ProtocolError: The bytes are not a message of this instrument.
        """
        if len(data) < HEAD.size:
            raise ProtocolError(Reason.LENGTH, f"message must be at least {HEAD.size} bytes; received {len(data)}")
        version, number, code, sequence = HEAD.unpack_from(data)

        def error(reason: Reason, text: str) -> ProtocolError:
            return ProtocolError(reason, text, sequence=sequence)

        if version != VERSION:
            raise error(Reason.VERSION, f"version must be {VERSION}; received {version}")
        if number != self.address.number:
            text = f"instrument must be {self.address.number} ({self.address.name}); received {number}"
            raise error(Reason.INSTRUMENT, text)
        if code not in self.kinds:
            raise error(Reason.KIND, f"kind must be a kind of the {self.address.name}; received {code:#04x}")
        kind, layout = self.kinds[code]
        start = HEAD.size + layout.size
        if len(data) < start or (kind.LAST_FIELD is None and len(data) != start):
            raise error(Reason.LENGTH, f"{kind.__name__} must be {start} bytes long; received {len(data)}")
        values: list[Any] = list(layout.unpack_from(data, HEAD.size))
        if any(isinstance(value, float) and not math.isfinite(value) for value in values):
            raise error(Reason.VALUE, f"{kind.__name__} must contain finite numbers; received {values}")
        if kind.LAST_FIELD == VariableField.TEXT:
            try:
                values.append(data[start:].decode())
            except UnicodeDecodeError:
                raise error(Reason.VALUE, f"text of {kind.__name__} must be UTF-8") from None
        elif kind.LAST_FIELD == VariableField.COUNTS:
            columns = int(values[-1])
            if not columns or (len(data) - start) % (columns * _COUNTS.itemsize):
                raise error(Reason.LENGTH, f"{kind.__name__} must contain whole rows of {columns} values")
            values.append(np.frombuffer(data, _COUNTS, offset=start).reshape(-1, columns))
        return sequence, kind(*values)
