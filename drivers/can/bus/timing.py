"""Bit rates of a bus, and bits and durations of its frames.

The compiled part is loaded at the first count, so that a client that only sends and receives starts fast.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drivers.can.bus import frame as frames
from rig.base.errors import InputError

if TYPE_CHECKING:
    import can

_MIN_BIT_S = 1_000
_MAX_NOMINAL_BIT_S = 1_000_000
_MAX_DATA_BIT_S = 12_000_000
_RATE = re.compile(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([kKM]?)\s*(?:bit/s)?\s*")
_RATE_FORM = 'as "500k", "1M", or "1M/5M" for CAN FD'


class Encoded(NamedTuple):
    """Bits of an acknowledged frame on the bus, from start of frame to the end of the intermission.

    Attributes:
        bits: Levels, 0 dominant, 1 recessive, shape (bits,).
        fast: Which bits are sent at the data rate, shape (bits,). The bit BRS counts as nominal, the CRC delimiter as
            fast: each is divided at its sample point, and together they last one bit of each rate.
        stuff: Which bits are stuff bits by content, shape (bits,).
        fixed: Which bits are fixed stuff bits of CAN FD, shape (bits,).
        crc: CRC sequence, of 15, 17 or 21 bits.
    """

    bits: np.ndarray
    fast: np.ndarray
    stuff: np.ndarray
    fixed: np.ndarray
    crc: int


class Speed(NamedTuple):
    """Bit rates of a bus.

    The position of the sample points does not matter here: an FD frame changes its rate at the sample point of BRS and
    back at that of the CRC delimiter, and together the two bits always last one nominal and one data bit time.

    Attributes:
        nominal_bit_s: Rate of the arbitration, and of all of a classic frame [bit/s].
        data_bit_s: Rate of the data phase of frames with bit rate switch [bit/s].
        fd: Whether the bus supports CAN FD frames.
        nominal_ps: Bit time of the arbitration, rounded [ps].
        data_ps: Bit time of the data phase, rounded [ps].
    """

    nominal_bit_s: float
    data_bit_s: float
    fd: bool
    nominal_ps: int
    data_ps: int

    def duration_ns(self, nominal: int, fast: int = 0) -> int:
        """Return the duration of a number of bits, rounded [ns].

        Args:
            nominal: Bits at the nominal rate.
            fast: Bits at the data rate.
        """
        return (nominal * self.nominal_ps + fast * self.data_ps + 500) // 1000

    def duration(self, frame: frames.Frame) -> float:
        """Return the time that a frame takes on the bus, with its intermission [s]."""
        return self.duration_ns(*frame_bits(frame)) * 1e-9

    def __str__(self) -> str:
        """Return the text that `speed` parses."""
        return f"{_text(self.nominal_bit_s)}/{_text(self.data_bit_s)}" if self.fd else _text(self.nominal_bit_s)


def speed(timing: str | float | Speed | can.BitTiming | can.BitTimingFd, data_bit_s: float | None = None) -> Speed:
    """Read bit rates from text, numbers or python-can's bit timings.

    Args:
        timing: "1M", "500k", "1M/5M" (CAN FD), a number [bit/s], or a `can.BitTiming` or `can.BitTimingFd`.
        data_bit_s: Rate of the data phase if `timing` is a number [bit/s]; makes the bus a CAN FD bus.
    """
    if isinstance(timing, Speed):
        return timing
    if isinstance(timing, str):
        parts = timing.split("/") if "bit/s" not in timing else re.split(r"/(?!s)", timing)
        if len(parts) > 2 or data_bit_s is not None:
            raise InputError("bit rate", _RATE_FORM, timing)
        return _speed(*[_parse_rate(part, timing) for part in parts])
    if isinstance(timing, (int, float)) and not isinstance(timing, bool):
        return _speed(float(timing), None if data_bit_s is None else float(data_bit_s))
    nominal: Any = getattr(timing, "nom_bitrate", getattr(timing, "bitrate", None))
    if nominal is None or data_bit_s is not None:
        raise InputError("bit rate", f"{_RATE_FORM}, or a can.BitTiming or can.BitTimingFd", timing)
    # The exact quotient of the clock: `bitrate` is rounded to whole bits per second.
    clock = getattr(timing, "f_clock", None)
    if hasattr(timing, "nom_bitrate"):
        fd: Any = timing
        return _speed(clock / (fd.nom_brp * fd.nbt), clock / (fd.data_brp * fd.dbt)) if clock else _speed(nominal)
    classic: Any = timing
    return _speed(clock / (classic.brp * classic.nbt) if clock else nominal)


def _parse_rate(part: str, whole: str) -> float:
    match = _RATE.fullmatch(part)
    if match is None:
        raise InputError("bit rate", _RATE_FORM, whole)
    return float(match[1]) * {"": 1.0, "k": 1e3, "K": 1e3, "M": 1e6}[match[2]]


def _speed(nominal: float, data: float | None = None) -> Speed:
    if not _MIN_BIT_S <= nominal <= _MAX_NOMINAL_BIT_S:
        raise InputError("bit rate", "between 1 kbit/s and 1 Mbit/s", nominal)
    if data is not None and not nominal <= data <= _MAX_DATA_BIT_S:
        raise InputError("data bit rate", "between the nominal bit rate and 12 Mbit/s", data)
    fast = nominal if data is None else data
    return Speed(nominal, fast, data is not None, round(1e12 / nominal), round(1e12 / fast))


def _text(rate: float) -> str:
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if rate >= size:
            return f"{rate / size:g}{letter}"
    return f"{rate:g}"


def encode(frame: frames.Frame) -> Encoded:
    """Return all bits of a frame on the bus."""
    from drivers.can.bus import kernels

    work = np.zeros((3, kernels.MAX_BITS), np.uint8)
    count, crc = kernels.encode(frames.records([frame])[0], work)
    bits, kinds = work[:2, :count]
    return Encoded(bits, kinds & kernels.FAST != 0, kinds & kernels.STUFF != 0, kinds & kernels.FIXED != 0, int(crc))


def frame_bits(frame: frames.Frame) -> tuple[int, int]:
    """Count the bits of a frame at the nominal rate and at the data rate, with stuffing and intermission."""
    from drivers.can.bus import kernels

    row, work = frames.records([frame])[0], np.empty((3, kernels.MAX_BITS), np.uint8)
    return kernels.count_bits(int(row["identifier"]), int(row["length"]), int(row["flags"]), row["data"], work)
