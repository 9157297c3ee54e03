"""Frames bit by bit.

| what | agrees with |
|---|---|
| all bits and the CRC | a frame stuffed by hand; eleven frames of another implementation (P. Molinaro's) |
| CRC | long division of one big number by the polynomial, which itself gives the published check values |
| encoding | a decoder written from the standard here |
| lengths | the encoding's own count; formulas of the worst and best case; all data of one byte |
| compiled code | the same code as Python |
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.can.analysis import PeriodicMessage, best_bits, worst_bits
from drivers.can.bus import frame as frames
from drivers.can.bus.frame import FD_LENGTHS, RECORD, Frame, are_sendable, make_record, records
from drivers.can.bus.timing import encode, frame_bits, speed
from rig.base.errors import InputError

CRC15, CRC17, CRC21 = 0xC599, 0x3685B, 0x302899

# Encoded by CANFrameGenerator.h and CANFDFrameGenerator.h of github.com/pierremolinaro/codes-can.
ENCODED = (
    (
        Frame(0x43A, bytes.fromhex("ff")),
        0x724B,
        "0100001110100000100111110111110110010010010111011111111111",
    ),
    (
        Frame(0x496, bytes.fromhex("ffffffff"), remote=True),
        0x62B2,
        "01001001011010001001100010101100101011111111111",
    ),
    (
        Frame(0x56CD9E, bytes.fromhex("fed7"), extended=True),
        0x7E0,
        "0000010010101111011001101100111100000101011111011011010111000011111010000011011111111111",
    ),
    (
        Frame(0x416, bytes.fromhex("a7043ba7ee3138da")),
        0x7A80,
        "010000011011000010001010011100000110000111011101001111101011100011000100111000110110101111010100"
        "0001001011111111111",
    ),
    (
        Frame(0xAF1153, bytes.fromhex("00ffff"), extended=True, remote=True),
        0x1FC9,
        "0000010101011111010001000101010011100001100111110110010011011111111111",
    ),
    (
        Frame(0x5AF94D, b"", extended=True),
        0x191F,
        "00000100101101110111110001010011010000010000110010001111101011111111111",
    ),
    (
        Frame(0x6D1, b"", fd=True, brs=True),
        0x1F030,
        "01101101000100101000001000011111010001000101000101011111111111",
    ),
    (
        Frame(0x6B6, bytes.fromhex("0f0fff"), fd=True, esi=True),
        0x82F9,
        "0110101101100010010011000011110000111110111110110011010100100010011101100111011111111111",
    ),
    (
        Frame(0x3284C3, bytes.fromhex("68efe0"), extended=True, fd=True, brs=True, esi=True),
        0x936E,
        "00000100011001110100001001100001101011001101101000111011111011000001011010100110010101100111001011111111111",
    ),
    (
        Frame(0x6078D, bytes.fromhex("ffffffffffffffffffffffffffffffff"), extended=True, fd=True, brs=True),
        0x75FF,
        "000001000001011110000010111100011010101010101111101111101111101111101111101111101111101111101111"
        "101111101111101111101111101111101111101111101111101111101111101111101111101111101111101111101111"
        "101110110010011010101111101111011011111111111",
    ),
    (
        Frame(0x2F6, bytes.fromhex("29b1250bcf1f4dc7b54236d32e605414cffd5bad"), fd=True, brs=True, esi=True),
        0x9E033,
        "001011110110001011101100101001101100010010010100001011110011110001111100100110111000111101101010"
        "100001000110110110100110010111001100000101010100000110100110011111011111001010110111010110101111"
        "0010011111000001000101001011011111111111",
    ),
)


def crc_remainder(bits: list[int], polynomial: int, *, first: int = 0) -> int:
    """Return the remainder of long division of the bits as one number, with the CRC's number of zeros appended.

    `first` inverts the CRC register's bits before the first bit.
    """
    width = polynomial.bit_length() - 1
    number = int("".join(map(str, bits)), 2) << width
    number ^= first << len(bits)
    while number.bit_length() > width:
        number ^= polynomial << (number.bit_length() - width - 1)
    return number


def decode(bits: list[int]) -> tuple[Frame, int, int]:
    """Take a frame apart: the frame, the CRC that was sent, the number of stuff bits by content.

    Asserts every rule that a receiver checks, except the CRC.
    """
    plain: list[int] = []
    stuffed = 0
    position = 0

    def take(count: int, *, stuffing: bool = True) -> int:
        nonlocal position, stuffed
        value = 0
        for _ in range(count):
            bit = bits[position]
            position += 1
            value = value << 1 | bit
            plain.append(bit)
            history.append(bit)
            if stuffing and len(history) >= 5 and len(set(history[-5:])) == 1:
                assert bits[position] != bit, "six equal bits"
                history.append(bits[position])
                position += 1
                stuffed += 1
        return value

    history: list[int] = []
    assert take(1) == 0
    identifier = take(11)
    second = take(1)
    extended = take(1) == 1
    remote = second
    if extended:
        assert second == 1
        identifier = identifier << 18 | take(18)
        remote = take(1)
    fd = take(1) == 1
    brs = esi = False
    if fd:
        assert remote == 0
        assert take(1) == 0
        brs, esi = take(1) == 1, take(1) == 1
    elif extended:
        assert take(1) == 0
    code = take(4) if not fd else None
    if code is None:
        code = take(3) << 1
        last_of_header = bits[position]
        length = FD_LENGTHS[code | last_of_header]
        take(1, stuffing=length > 0)
    else:
        length = code
    data = b""
    for k in range(0 if remote else length):
        if fd and k == length - 1:
            value = take(7) << 1
            data += bytes([value | take(1, stuffing=False)])
        else:
            data += bytes([take(8)])
    if not fd:
        crc = take(15)
    else:
        width = 17 if length <= 16 else 21
        tail = []
        for k in range(4 + width):
            if k % 4 == 0:
                assert bits[position] != bits[position - 1], "fixed stuff bit"
                position += 1
            tail.append(bits[position])
            position += 1
        count = {(0, 0, 0): 0, (0, 0, 1): 1, (0, 1, 1): 2, (0, 1, 0): 3, (1, 1, 0): 4, (1, 1, 1): 5, (1, 0, 1): 6}
        assert count.get(tuple(tail[:3]), 7) == stuffed % 8
        assert sum(tail[:4]) % 2 == 0
        crc = int("".join(map(str, tail[4:])), 2)
    assert bits[position:] == [1, 0, 1] + [1] * 7 + [1] * 3
    return Frame(identifier, bytes(length) if remote else data, extended, bool(remote), fd, brs, esi), crc, stuffed


payloads = st.one_of(
    st.binary(max_size=64),
    st.lists(st.sampled_from((0x00, 0xFF, 0x0F, 0xF0, 0x1F, 0xE0, 0x07, 0x3C, 0x78, 0x87)), max_size=64).map(bytes),
)


@st.composite
def any_frame(draw: st.DrawFn) -> Frame:
    extended = draw(st.booleans())
    identifier = draw(st.integers(0, (1 << (29 if extended else 11)) - 1))
    data = draw(payloads)
    if draw(st.booleans()):
        data = data.ljust(min(length for length in FD_LENGTHS if length >= len(data)), b"\0")
        return Frame(identifier, data, extended, fd=True, brs=draw(st.booleans()), esi=draw(st.booleans()))
    remote = draw(st.booleans())
    return Frame(identifier, bytes(len(data[:8])) if remote else data[:8], extended, remote)


def test_long_division_gives_the_published_check_values():
    """Catalogue of parametrised CRC algorithms (Greg Cook): check values for the digits 1 to 9."""
    bits = [byte >> k & 1 for byte in b"123456789" for k in range(7, -1, -1)]
    assert crc_remainder(bits, CRC15) == 0x059E
    assert crc_remainder(bits, CRC17) == 0x04F03
    assert crc_remainder(bits, CRC21) == 0x0ED841


def test_frame_stuffed_by_hand():
    """Identifier 0x14, one byte 0x01: five dominant bits three times before the CRC, none in it."""
    expected = (
        "0" "0000" "1" "0010100"  # start of frame, identifier: a stuff bit after the first five
        "000" "1" "0001"  # RTR, IDE, FDF, with the two before five again; length 1
        "00000" "1" "001"  # data
        "111011101010011"  # CRC 0x7753
        "1" "0" "1" "1111111" "111"  # delimiter, ACK, delimiter, end of frame, intermission
    )  # fmt: skip
    encoded = encode(Frame(0x14, b"\x01"))
    assert "".join(map(str, encoded.bits)) == expected
    plain = "0" "00000010100" "000" "0001" "00000001"  # fmt: skip
    assert encoded.crc == crc_remainder([int(bit) for bit in plain], CRC15) == 0x7753
    assert frame_bits(Frame(0x14, b"\x01")) == (58, 0)
    assert speed("500k").duration(Frame(0x14, b"\x01")) == pytest.approx(58 * 2e-6, abs=1e-15)


@pytest.mark.parametrize(("frame", "crc", "bits"), ENCODED)
def test_frames_of_another_implementation(frame: Frame, crc: int, bits: str):
    encoded = encode(frame)
    assert "".join(map(str, encoded.bits)) == bits
    assert encoded.crc == crc


@settings(deadline=None, max_examples=300)
@given(any_frame())
def test_a_receiver_gets_the_frame_back(frame: Frame):
    encoded = encode(frame)
    bits = encoded.bits.tolist()
    received, crc, stuffed = decode(bits)
    assert received == frame
    assert crc == encoded.crc
    assert stuffed == int(encoded.stuff.sum())
    # No six equal bits before the CRC delimiter, and the CRC of all with its CRC is 0.
    inside = bits[:-13]
    assert max(len(run) for run in "".join(map(str, inside)).replace("01", "0 1").replace("10", "1 0").split()) <= 5
    if frame.fd:
        width, polynomial = (17, CRC17) if len(frame.data) <= 16 else (21, CRC21)
        covered = [bit for bit, fixed in zip(inside, encoded.fixed[:-13], strict=True) if not fixed]
        assert crc_remainder(covered, polynomial, first=1 << (width - 1)) == 0
        assert int(encoded.fixed.sum()) == (6 if width == 17 else 7)
    else:
        plain = [bit for bit, stuff in zip(inside, encoded.stuff[:-13], strict=True) if not stuff]
        assert crc_remainder(plain, CRC15) == 0


@settings(deadline=None, max_examples=300)
@given(any_frame())
def test_lengths_are_those_of_the_encoding_and_within_the_formulas(frame: Frame):
    encoded = encode(frame)
    nominal, fast = frame_bits(frame)
    assert (nominal, fast) == (int((~encoded.fast).sum()), int(encoded.fast.sum()))
    n = 0 if frame.remote else len(frame.data)
    shape = PeriodicMessage(frame.identifier, 1.0, n, extended=frame.extended, fd=frame.fd, brs=frame.brs)
    stuffed = int(encoded.stuff.sum())
    assert nominal + fast == sum(best_bits(shape)) + stuffed
    most = worst_bits(shape)
    assert nominal <= most[0]
    assert nominal + fast <= sum(most)
    if not frame.fd:
        g = 54 if frame.extended else 34
        assert sum(best_bits(shape)) == 8 * n + g + 13
        assert sum(most) == 8 * n + g + 13 + (g + 8 * n - 1) // 4


def test_lengths_without_stuff_bits_counted_by_hand():
    """Field by field, ISO 11898-1:2015, figures 12 to 17; the fast part of BRS and of the CRC delimiter as one bit."""
    assert best_bits(PeriodicMessage(0, 1.0, 0)) == (1 + 12 + 6 + 15 + 1 + 2 + 7 + 3, 0) == (47, 0)
    assert best_bits(PeriodicMessage(0, 1.0, 8)) == (111, 0)
    assert best_bits(PeriodicMessage(0, 1.0, 8, extended=True)) == (131, 0)
    # FD, base: SOF 1, identifier 11, RRS, IDE, FDF, res, BRS; ESI 1, DLC 4, data, count 4, CRC, fixed, delimiter.
    assert best_bits(PeriodicMessage(0, 1.0, 8, fd=True, brs=True)) == (17 + 12, 5 + 64 + 4 + 17 + 6 + 1)
    assert best_bits(PeriodicMessage(0, 1.0, 64, fd=True, brs=True)) == (17 + 12, 5 + 512 + 4 + 21 + 7 + 1)
    assert best_bits(PeriodicMessage(0, 1.0, 64, fd=True)) == (17 + 12 + 5 + 512 + 4 + 21 + 7 + 1, 0)
    assert best_bits(PeriodicMessage(0, 1.0, 0, extended=True, fd=True, brs=True)) == (36 + 12, 5 + 4 + 17 + 6 + 1)


@pytest.mark.parametrize("identifier", [0x000, 0x078, 0x555, 0x7FF, 0x0F0, 0x3E0])
@pytest.mark.parametrize("brs", [False, True])
def test_worst_fd_length_is_reached_by_some_content(identifier: int, brs: bool):
    every = [Frame(identifier, bytes([v]), fd=True, brs=brs, esi=esi) for v in range(256) for esi in (False, True)]
    nominal, fast = np.transpose([frame_bits(frame) for frame in every])
    most = worst_bits(PeriodicMessage(identifier, 1.0, 1, fd=True, brs=brs))
    assert nominal.max() == most[0]
    assert (nominal + fast).max() == sum(most)


def test_worst_fd_length_of_long_frames_is_reached():
    """After the header, 1111 and 0000 in turn make a stuff bit in every four bits."""
    most = worst_bits(PeriodicMessage(0x000, 1.0, 64, fd=True, brs=True))
    best = 0
    for phase in range(8):
        pattern = (0x0F0F << phase | 0x0F0F >> (8 - phase)) & 0xFF
        best = max(best, *(sum(frame_bits(Frame(0, bytes([first]) + bytes([pattern]) * 63, fd=True, brs=True, esi=esi)))
                           for first in range(256) for esi in (False, True)))  # fmt: skip
    assert best == sum(most)
    nominal, fast = best_bits(PeriodicMessage(0x000, 1.0, 64, fd=True, brs=True))
    # Two in the arbitration field of ten dominant bits, then one in every four bits.
    assert sum(most) - nominal - fast == 2 + 128


def test_arrays_and_single_frames_agree():
    rng = np.random.default_rng(5)
    some = [
        Frame(int(rng.integers(1 << 29)), rng.bytes(FD_LENGTHS[rng.integers(16)]), extended=True, fd=True, brs=True)
        for _ in range(50)
    ] + [Frame(int(rng.integers(1 << 11)), rng.bytes(int(rng.integers(9)))) for _ in range(50)]
    array = records(some)
    assert array.dtype == RECORD
    assert frames.frames(array) == some


@pytest.mark.parametrize(
    ("frame", "why"),
    [
        (Frame(0x800), "more than 11 bits"),
        (Frame(-1), "received -1"),
        (Frame(1 << 29, extended=True), "received 536870912"),
        (Frame(0, bytes(9)), "9 bytes in a classic frame"),
        (Frame(0, bytes(9), fd=True), "not a CAN FD length"),
        (Frame(0, bytes(65), fd=True), "not a CAN FD length"),
        (Frame(0, remote=True, fd=True), "remote frame"),
        (Frame(0, brs=True), "bit rate switch"),
        (Frame(0, esi=True), "error state indicator"),
    ],
)
def test_frames_that_no_controller_sends(frame: Frame, why: str):
    with pytest.raises(InputError, match=why):
        make_record(frame)
    if len(frame.data) > 64 or not 0 <= frame.identifier < 1 << 29:
        return
    word = frame.identifier | (frames.EXTENDED if frame.extended else 0) | (frames.REMOTE if frame.remote else 0)
    array = np.zeros(2, RECORD)
    array["identifier"][1] = word
    array["length"][1] = len(frame.data)
    array["flags"][1] = frames.FD * frame.fd + frames.BRS * frame.brs + frames.ESI * frame.esi
    assert are_sendable(array.view(frames.RECORDS[64])).tolist() == [True, False]


def test_bit_rates():
    import can

    assert speed("1M")[:3] == (1e6, 1e6, False)
    assert speed("500k")[3:] == (2_000_000, 2_000_000)
    assert speed("1M/5M") == (1e6, 5e6, True, 1_000_000, 200_000)
    assert speed("125 kbit/s").nominal_bit_s == 125e3
    assert speed(500_000, 2_000_000) == speed("500k/2M") == speed(speed("500k/2M"))
    assert str(speed("1M/8M")) == "1M/8M"
    assert str(speed("83.3k")) == "83.3k"
    classic = can.BitTiming.from_sample_point(f_clock=8_000_000, bitrate=500_000, sample_point=75.0)
    assert speed(classic) == speed("500k")
    fd = can.BitTimingFd.from_sample_point(
        f_clock=80_000_000, nom_bitrate=1_000_000, nom_sample_point=80.0, data_bitrate=5_000_000, data_sample_point=75.0
    )
    assert speed(fd) == speed("1M/5M")
    # 80 MHz / 15: 5333333.33 bit/s, which the timing rounds.
    odd = can.BitTimingFd(
        f_clock=80_000_000, nom_brp=1, nom_tseg1=63, nom_tseg2=16, nom_sjw=1, data_brp=1, data_tseg1=10, data_tseg2=4,
        data_sjw=1,
    )  # fmt: skip
    assert speed(odd).data_ps == 187_500


@pytest.mark.parametrize(
    "text", ["", "fast", "0", "2M", "500", "1M/500k", "1M/13M", "1M/2M/4M", "-1M", "1M/", None, True, [1], float("nan")]
)
def test_nonsense_bit_rates(text: object):
    with pytest.raises(InputError):
        speed(text)


_PARITY = """
import json, random
from drivers.can.bus.model import BusModel
from drivers.can.bus.frame import FD_LENGTHS, Frame
from drivers.can.bus.timing import encode, frame_bits

random.seed(3)
rows = []
for fd in (False, True):
    for k in range(16):
        length = FD_LENGTHS[k] if fd else k % 9
        frame = Frame(random.getrandbits(11), random.randbytes(length), fd=fd, brs=fd and k % 2 == 0)
        encoded = encode(frame)
        rows.append([encoded.bits.tolist(), encoded.crc, frame_bits(frame)])
bus = BusModel("500k/2M", error_rate=1e-3, seed=2)
nodes = [bus.attach(queue=3), bus.attach(), bus.attach()]
bus.disturb(nodes[1], count=33)
for k in range(60):
    bus.offer(nodes[k % 3], Frame(random.getrandbits(11), random.randbytes(8)), k * 100_000)
rows.append([list(row[1:]) for row in bus.advance(50_000_000)])
rows.append([str(bus.node(node)) for node in nodes])
print(json.dumps(rows))
"""


def test_compiled_and_not_compiled_agree():
    def run(disabled: str) -> object:
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disabled}
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", _PARITY], env=environment, capture_output=True, text=True, check=True
        )
        return json.loads(done.stdout)

    assert run("0") == run("1")
