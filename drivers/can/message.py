"""CAN messages: their signals bit by bit, the layout of samples, and encoding."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from rig.channels.table import Channel

KEY = 0x9D
"""Constant key of every command."""
ABSENT = -32768
"""Value of an absent channel in a classic frame; counts stop one above it."""


@dataclass(frozen=True, slots=True)
class CanSignal:
    """A number in a message.

    Attributes:
        name: Unique in its message.
        start: Position of its lowest bit in the little-endian message.
        bits: Width [bits].
        signed: Whether it is in two's complement.
        scale: Unit per step.
        offset: Value at 0.
        unit: Engineering unit.
        label: Description.
        choices: Names of values.
        selects: Whether it selects which of the signals with `selected_by` are present.
        selected_by: Values of the selecting signal with which this signal is present.
        channel: Channel of which it carries a sample, or None.
    """

    name: str
    start: int
    bits: int
    signed: bool = False
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""
    label: str = ""
    choices: Mapping[int, str] | None = None
    selects: bool = False
    selected_by: tuple[int, ...] = ()
    channel: Channel | None = None

    @property
    def raw_range(self) -> tuple[int, int]:
        """Smallest and largest value that the bits can hold."""
        return (-(1 << self.bits - 1), (1 << self.bits - 1) - 1) if self.signed else (0, (1 << self.bits) - 1)


@dataclass(frozen=True, slots=True)
class SampleLayout:
    """Layout of samples in a message: a running number, then instant after instant, channel after channel.

    Attributes:
        channels: Channels, in order.
        rows: Instants per frame.
        width: Bytes per value.
        index_width: Bytes of the running number.
    """

    channels: tuple[Channel, ...]
    rows: int
    width: int
    index_width: int

    @property
    def groups(self) -> tuple[str, ...]:
        """Channel groups of the channels."""
        return tuple(dict.fromkeys(channel.group for channel in self.channels))

    @property
    def shifts(self) -> np.ndarray:
        """Number of low bits of the recorded counts that are left out, shape (channels,)."""
        return np.array([max(0, channel.adc_bits - 8 * self.width) for channel in self.channels])

    def pack(self, numbers: np.ndarray, counts: np.ndarray, length: int) -> np.ndarray:
        """Encode samples as data of frames.

        Args:
            numbers: Running number of each frame's first instant, truncated to `index_width`, shape (frames,).
            counts: Recorded counts, int32, shape (frames * rows, channels).
            length: Bytes per frame.

        Returns:
            uint8, shape (frames, length).
        """
        frames = len(numbers)
        values = counts >> self.shifts
        if self.width == 2:
            values = np.maximum(values, ABSENT + 1)
        out = np.zeros((frames, length), np.uint8)
        head = np.ascontiguousarray(numbers, "<i8").view(np.uint8).reshape(frames, 8)
        out[:, : self.index_width] = head[:, : self.index_width]
        body = np.ascontiguousarray(values, "<i4").view(np.uint8).reshape(frames, -1, 4)[:, :, : self.width]
        out[:, self.index_width : self.index_width + body.shape[1] * self.width] = body.reshape(frames, -1)
        return out

    def unpack(self, data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Decode running numbers and values of frames.

        Args:
            data: uint8, shape (frames, length).

        Returns:
            Number of each frame's first instant, int64, shape (frames,), and the values as in the frames, int32, shape
            (frames * rows, channels).
        """
        frames, size = len(data), self.rows * len(self.channels)
        head = np.zeros((frames, 8), np.uint8)
        head[:, : self.index_width] = data[:, : self.index_width]
        body = np.zeros((frames, size, 4), np.uint8)
        end = self.index_width + size * self.width
        body[:, :, 4 - self.width :] = data[:, self.index_width : end].reshape(frames, size, self.width)
        values = body.view("<i4").reshape(-1, len(self.channels)) >> (32 - 8 * self.width)
        return head.view("<i8").reshape(frames), values

    def engineering(self, values: np.ndarray) -> np.ndarray:
        """Convert values of `unpack` to the channels' units, float64, shape (instants, channels); nan if absent."""
        scale = np.array([channel.scale for channel in self.channels]) * 2.0**self.shifts
        out = values * scale + np.array([channel.offset for channel in self.channels])
        if self.width == 2:
            out[values == ABSENT] = np.nan
        return out


@dataclass(frozen=True, slots=True, eq=False)
class CanMessage:
    """A message: identifier, length, period and signals.

    Attributes:
        name: Unique name.
        identifier: 11 bits.
        length: Length [bytes].
        fd: Whether it is a CAN FD frame with bit rate switch.
        period_s: Period, or shortest period of a message sent by events [s]; infinite for one that is sent in lockstep
            only, where the samples wait for it, so that it takes no share of the bus.
        periodic: Whether it is sent periodically.
        sender: Sending node.
        label: Description.
        signals: Signals.
        samples: Layout of its samples, if any.
    """

    name: str
    identifier: int
    length: int
    fd: bool
    period_s: float
    periodic: bool
    sender: str
    label: str
    signals: tuple[CanSignal, ...]
    samples: SampleLayout | None = None

    def encode(self, **raw: int) -> bytes:
        """Encode raw values; signals that are not named are 0.

        Raises:
            ValueError: A value does not fit its bits.
        """
        total = 0
        signals = {signal.name: signal for signal in self.signals}
        for name, value in raw.items():
            signal = signals[name]
            low, high = signal.raw_range
            if not low <= value <= high:
                raise ValueError(f"{self.name}.{name} must be between {low} and {high}; received {value}")
            total |= (value & (1 << signal.bits) - 1) << signal.start
        return total.to_bytes(self.length, "little")

    def decode(self, data: bytes) -> dict[str, int]:
        """Decode raw values by name; of multiplexed signals, those that are present."""
        total = int.from_bytes(data, "little")
        values: dict[str, int] = {}
        selected = None
        for signal in self.signals:
            value = total >> signal.start & (1 << signal.bits) - 1
            if signal.signed and value >> signal.bits - 1:
                value -= 1 << signal.bits
            if signal.selects:
                selected = value
            if not signal.selected_by or selected in signal.selected_by:
                values[signal.name] = value
        return values

    def is_known(self, raw: Mapping[str, int]) -> bool:
        """Return whether each named value is known here: a rig of another version may send others."""
        choices = {signal.name: signal.choices for signal in self.signals if signal.choices}
        return all(value in choices.get(name, (value,)) for name, value in raw.items())


@dataclass(frozen=True, slots=True)
class MessageTable:
    """All messages of a rig."""

    messages: tuple[CanMessage, ...]
    by_name: dict[str, CanMessage] = field(init=False)
    by_identifier: dict[int, CanMessage] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "by_name", {message.name: message for message in self.messages})
        object.__setattr__(self, "by_identifier", {message.identifier: message for message in self.messages})
        if not len(self.by_name) == len(self.by_identifier) == len(self.messages):
            raise ValueError("names and identifiers of CAN messages must be unique")

    @property
    def classic(self) -> tuple[CanMessage, ...]:
        """Messages of the classic sample layout."""
        return tuple(row for row in self.messages if row.samples is not None and not row.fd)

    @property
    def fd(self) -> tuple[CanMessage, ...]:
        """Messages of the FD sample layout."""
        return tuple(row for row in self.messages if row.samples is not None and row.fd)

    @property
    def layout(self) -> int:
        """Fingerprint of the sample messages, 1 to 255, by which two sides detect different layouts."""
        identity = [
            (
                row.name,
                row.identifier,
                row.length,
                [(each.name, each.start, each.scale, each.offset, each.unit) for each in row.signals],
            )
            for row in (*self.fd, *self.classic)
        ]
        return zlib.crc32(repr(identity).encode()) % 255 + 1

    @property
    def others(self) -> tuple[CanMessage, ...]:
        """Messages without samples."""
        return tuple(row for row in self.messages if row.samples is None)

    def schedule(self, *, classic_hz: float | None = None, fd_hz: float | None = None) -> dict[CanMessage, float]:
        """Return the messages on the bus, and their periods [s].

        Args:
            classic_hz: Rate of the classic layout [Hz], or None if it is not sent.
            fd_hz: Rate of the FD layout [Hz], or None if it is not sent.
        """
        rows = {row: row.period_s for row in self.others if row.period_s < math.inf}
        for messages, rate in ((self.classic, classic_hz), (self.fd, fd_hz)):
            if rate is not None:
                rows |= {row: row.samples.rows / rate for row in messages if row.samples is not None}
        return rows


def _crc_table() -> bytes:
    rows = []
    for value in range(256):
        for _ in range(8):
            value = (value << 1 ^ 0x1D) & 0xFF if value & 0x80 else value << 1
        rows.append(value)
    return bytes(rows)


_CRC = _crc_table()


def crc8(data: bytes) -> int:
    """Calculate CRC-8 SAE J1850: polynomial 0x1D, initial value and final xor 0xFF; 0x4B for b"123456789"."""
    value = 0xFF
    for byte in data:
        value = _CRC[value ^ byte]
    return value ^ 0xFF


def checksum(identifier: int, data: bytes) -> int:
    """Return the last byte of a command from its identifier and its first seven bytes."""
    return crc8(identifier.to_bytes(2, "little") + data[:7])
