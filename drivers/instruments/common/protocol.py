"""Sans-IO codec of the instruments: requests, replies and data, to bytes and back.

A message is a head (version, number of the instrument, kind, sequence number; little-endian) and the fields of its
kind. A reply repeats the sequence number of its request; data have a count of their own. Every request is answered, by
`Refused` where it cannot be carried out or read; bytes that are no message raise `ProtocolError` and nothing else.
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
    """Why a request was refused, or bytes are no message."""

    VERSION = 1
    INSTRUMENT = 2
    KIND = 3
    LENGTH = 4
    VALUE = 5
    REFUSED = 6
    """The instrument, or the rig behind it, does not allow it: the text says why."""
    UNAVAILABLE = 7
    """Nothing answers behind the instrument."""


class ProtocolError(ValueError):
    """Bytes that are no message, for the reason given."""

    def __init__(self, reason: Reason, text: str, *, sequence: int = 0) -> None:
        self.reason = reason
        self.sequence = sequence
        """Of the message, where the bytes tell."""
        super().__init__(text)


class Tail:
    """What follows the fields of fixed length, to the end of the message: the last field of a message's class."""

    TEXT = "text"
    COUNTS = "counts"


@dataclass(frozen=True, slots=True)
class Message:
    """Base of all messages: `KIND`, the `struct` layout of the fields in their order, and what the last one is."""

    KIND: ClassVar[int] = 0
    LAYOUT: ClassVar[str] = "<"
    TAIL: ClassVar[str | None] = None


# Requests, from the host.


@dataclass(frozen=True, slots=True)
class Identify(Message):
    """Who are you, and how are you calibrated?"""

    KIND = 0x01


@dataclass(frozen=True, slots=True)
class Configure(Message):
    """Choose channels and rate; ends a stream that runs.

    Attributes:
        rate_hz: Rows per second [Hz]; 0 is the instrument's own rate.
        channels: Bit n is channel n of the datasheet; 0 is all.
    """

    KIND = 0x02
    LAYOUT = "<dI"
    rate_hz: float
    channels: int


@dataclass(frozen=True, slots=True)
class Start(Message):
    """Begin a stream of data."""

    KIND = 0x03


@dataclass(frozen=True, slots=True)
class Stop(Message):
    """End a stream of data; nothing happens where another one runs by now.

    Attributes:
        stream: Number of the stream; 0 is the one that runs.
        discard: Not 0: what was measured and has not been sent yet is not wanted any more.
    """

    KIND = 0x04
    LAYOUT = "<IB"
    stream: int
    discard: int


@dataclass(frozen=True, slots=True)
class Act(Message):
    """Base of what an acting instrument can be told to do; kinds from 0x40 on, each instrument's own.

    It has the fields of the rig's command `COMMAND`, with a text where that takes a word or a number.
    """

    COMMAND: ClassVar[str] = ""


# Replies, from the instrument.


@dataclass(frozen=True, slots=True)
class Identity(Message):
    """The datasheet (`drivers.instruments.common.datasheet`) as JSON."""

    KIND = 0x81
    TAIL = Tail.TEXT
    datasheet: str


@dataclass(frozen=True, slots=True)
class Configured(Message):
    """What was chosen: rate [Hz] and channels as bits."""

    KIND = 0x82
    LAYOUT = "<dI"
    rate_hz: float
    channels: int


@dataclass(frozen=True, slots=True)
class Started(Message):
    """Number of the stream that begins."""

    KIND = 0x83
    LAYOUT = "<I"
    stream: int


@dataclass(frozen=True, slots=True)
class Stopped(Message):
    """Rows that the ended stream has sent, and rows that found no room on the link."""

    KIND = 0x84
    LAYOUT = "<IQQ"
    stream: int
    rows: int
    dropped: int


@dataclass(frozen=True, slots=True)
class Done(Message):
    """An act was accepted: its number in the rig's run, and when it takes effect [ticks], [s]."""

    KIND = 0x85
    LAYOUT = "<qqd"
    id: int
    tick: int
    time_s: float


@dataclass(frozen=True, slots=True)
class Refused(Message):
    """A request was not carried out: a `Reason`, and one line."""

    KIND = 0x86
    LAYOUT = "<B"
    TAIL = Tail.TEXT
    reason: int
    text: str


# Data, from the instrument, unasked while a stream runs.


@dataclass(frozen=True, slots=True)
class Rows(Message):
    """Consecutive rows of ADC counts.

    Attributes:
        stream: Number of the stream.
        index: Number of the first row since the start of the rig's stream, at `rate_hz`.
        tick: Time of the first row [ticks].
        rate_hz: Rows per second [Hz].
        tick_rate_hz: Ticks per second [Hz].
        columns: Values a row.
        counts: int32, shape (rows, columns).
    """

    KIND = 0xC1
    LAYOUT = "<IqqddB"
    TAIL = Tail.COUNTS
    stream: int
    index: int
    tick: int
    rate_hz: float
    tick_rate_hz: float
    columns: int
    counts: np.ndarray


ROWS_HEAD = HEAD.size + struct.calcsize(Rows.LAYOUT)


@dataclass(frozen=True, slots=True)
class Ended(Message):
    """The stream has ended, for a reason."""

    KIND = 0xC2
    LAYOUT = "<I"
    TAIL = Tail.TEXT
    stream: int
    reason: str


COMMON: tuple[type[Message], ...] = (
    Identify, Configure, Start, Stop, Identity, Configured, Started, Stopped, Done, Refused, Rows, Ended,
)  # fmt: skip
M = TypeVar("M", bound=Message)


class Codec:
    """Messages of one instrument to bytes and back.

    Args:
        address: Its name and number.
        acts: What it can be told to do.
    """

    def __init__(self, address: Address, acts: tuple[type[Act], ...] = ()) -> None:
        self.address = address
        self.acts = acts
        self.kinds = {each.KIND: (each, struct.Struct(each.LAYOUT)) for each in (*COMMON, *acts)}

    def encode(self, message: Message, sequence: int) -> bytes:
        """One message as bytes."""
        kind, layout = self.kinds[message.KIND]
        values = [getattr(message, each.name) for each in dataclasses.fields(kind)]
        tail = b""
        if kind.TAIL == Tail.TEXT:
            tail = str(values.pop()).encode()
        elif kind.TAIL == Tail.COUNTS:
            tail = np.ascontiguousarray(values.pop(), _COUNTS).tobytes()
        head = HEAD.pack(VERSION, self.address.number, kind.KIND, sequence & 0xFFFFFFFF)
        return b"".join((head, layout.pack(*values), tail))

    def decode(self, data: bytes) -> tuple[int, Message]:
        """Sequence number and message.

        Raises:
            ProtocolError: The bytes are no message of this instrument.
        """
        if len(data) < HEAD.size:
            raise ProtocolError(Reason.LENGTH, f"a message has at least {HEAD.size} bytes; received {len(data)}")
        version, number, code, sequence = HEAD.unpack_from(data)

        def wrong(reason: Reason, text: str) -> ProtocolError:
            return ProtocolError(reason, text, sequence=sequence)

        if version != VERSION:
            raise wrong(Reason.VERSION, f"version must be {VERSION}; instead received {version}")
        if number != self.address.number:
            text = f"instrument must be {self.address.number} ({self.address.name}); instead received {number}"
            raise wrong(Reason.INSTRUMENT, text)
        if code not in self.kinds:
            raise wrong(Reason.KIND, f"kind must be one that the {self.address.name} has; instead received {code:#04x}")
        kind, layout = self.kinds[code]
        start = HEAD.size + layout.size
        if len(data) < start or (kind.TAIL is None and len(data) != start):
            raise wrong(Reason.LENGTH, f"{kind.__name__} must be of {start} bytes; instead received {len(data)}")
        values: list[Any] = list(layout.unpack_from(data, HEAD.size))
        if any(isinstance(value, float) and not math.isfinite(value) for value in values):
            raise wrong(Reason.VALUE, f"{kind.__name__} must hold finite numbers; instead received {values}")
        if kind.TAIL == Tail.TEXT:
            try:
                values.append(data[start:].decode())
            except UnicodeDecodeError:
                raise wrong(Reason.VALUE, f"text of {kind.__name__} must be UTF-8") from None
        elif kind.TAIL == Tail.COUNTS:
            columns = int(values[-1])
            if not columns or (len(data) - start) % (columns * _COUNTS.itemsize):
                raise wrong(Reason.LENGTH, f"{kind.__name__} must hold whole rows of {columns} values")
            values.append(np.frombuffer(data, _COUNTS, offset=start).reshape(-1, columns))
        return sequence, kind(*values)
