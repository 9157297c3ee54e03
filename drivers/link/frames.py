"""Messages in a stream of bytes: consistent overhead byte stuffing and a CRC-16; does no input or output itself.

A frame is a zero byte, the message with its CRC-16, and a zero byte. Message and CRC are stuffed to contain no zero
byte. The CRC has the CCITT polynomial 0x1021 and the initial value 0, as in XMODEM, most significant byte first. A
reader that starts in the middle, or receives a corrupted frame, resynchronises at the next zero. Stuffing: S. Cheshire
and M. Baker, "Consistent overhead byte stuffing", IEEE/ACM Transactions on Networking 7 (1999) 159-172.
"""

from __future__ import annotations

import binascii
import struct

_MAX_RUN = 254
_CRC = struct.Struct(">H")


def stuff(data: bytes) -> bytes:
    """Return the data encoded without zero bytes: longer by one byte, and by at most one more for every 254 bytes."""
    out = bytearray()
    parts = data.split(b"\0")
    for number, part in enumerate(parts):
        while len(part) >= _MAX_RUN:
            out.append(_MAX_RUN + 1)
            out += part[:_MAX_RUN]
            part = part[_MAX_RUN:]
            # A full run has no implied zero after it, so it may end the data.
            if not part and number == len(parts) - 1:
                return bytes(out)
        out.append(len(part) + 1)
        out += part
    return bytes(out)


def unstuff(data: bytes) -> bytes:
    """Return the data that `stuff` encoded.

    Raises:
        ValueError: The bytes are not an output of `stuff`.
    """
    out = bytearray()
    position = 0
    while position < len(data):
        code = data[position]
        end = position + code
        if code == 0 or end > len(data):
            raise ValueError(f"stuffed bytes must hold whole runs; received one of {code} at {position}")
        out += data[position + 1 : end]
        position = end
        if code <= _MAX_RUN and position < len(data):
            out.append(0)
    return bytes(out)


def encode_frame(message: bytes) -> bytes:
    """Encode a message as a frame."""
    return b"\0" + stuff(message + _CRC.pack(binascii.crc_hqx(message, 0))) + b"\0"


class Deframer:
    """Extracts messages from bytes that arrive in portions of any size.

    Args:
        max_bytes: Length of the longest message [bytes]; longer ones are not stored, and are counted in `spoilt`.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._max_stuffed_bytes = max_bytes + 2 + (max_bytes + 2) // _MAX_RUN + 1
        self._part = bytearray()
        self._too_long = False
        self.spoilt = 0
        """Frames that were cut, too long, or had a wrong CRC."""

    def __len__(self) -> int:
        """Return the number of bytes of the incomplete frame."""
        return len(self._part)

    def feed(self, data: bytes) -> list[bytes]:
        """Add bytes, and return the messages that they complete."""
        messages = []
        *ended, rest = data.split(b"\0")
        for part in ended:
            self._append(part)
            if (message := self._end()) is not None:
                messages.append(message)
        self._append(rest)
        return messages

    def _append(self, part: bytes) -> None:
        if len(self._part) + len(part) > self._max_stuffed_bytes:
            self._too_long = True
            self._part.clear()
        elif not self._too_long:
            self._part += part

    def _end(self) -> bytes | None:
        stuffed, too_long = bytes(self._part), self._too_long
        self._part.clear()
        self._too_long = False
        if not stuffed and not too_long:
            return None
        try:
            data = b"" if too_long else unstuff(stuffed)
        except ValueError:
            data = b""
        if len(data) < _CRC.size or binascii.crc_hqx(data, 0) or len(data) > self._max_bytes + _CRC.size:
            # The CRC over a message and its own CRC is zero.
            self.spoilt += 1
            return None
        return data[: -_CRC.size]
