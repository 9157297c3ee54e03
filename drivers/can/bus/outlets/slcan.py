"""SLCAN (Lawicel) adapter at a pseudo-terminal: a CAN bus for any program that opens a serial port.

The commands are those of Lawicel's CAN232 and CANUSB manuals, and for CAN FD those of the CANable 2.0 firmware, as in
python-can's interface `slcan`. A line ends with a carriage return; the reply is a carriage return, or a bell.

    S0-S8 sXXYY Yn   bit rate, accepted if it is the bus's, which cannot be changed here; Yn: n Mbit/s for FD data
    O L C            open, open to listen only, close the channel
    t T r R          a frame, an extended one, a remote one, an extended remote one
    d D b B          CAN FD frames: standard, extended, with bit rate switch, extended with bit rate switch
    V N F Z0 Z1      version, serial number, status flags, without or with time stamps (milliseconds of the minute)
    M00000000 mFFFFFFFF  acceptance of all frames, the only one; Un: any speed of the terminal

Frames are sent without a request: polling (P, A, X0) is not supported. The protocol has no error frames; they set
status flags. It has no error state indicator either.
"""

from __future__ import annotations

import contextlib
import os
import re
import termios
import threading
import tty
from collections.abc import Iterator
from typing import TYPE_CHECKING

from drivers.can.bus import codec
from drivers.can.bus.codec import CodecError
from drivers.can.bus.frame import FD_LENGTHS
from drivers.can.bus.outlets.outlet import PATIENCE_S, ROOM, OpenBus, Outlet, make_message
from drivers.can.bus.timing import Speed

if TYPE_CHECKING:
    import can

OK = b"\r"
BELL = b"\a"
VERSION = b"V0101\r"
SERIAL_NUMBER = b"NRIG0\r"

RECEIVE_FULL = 1 << 0
TRANSMIT_FULL = 1 << 1
ERROR_WARNING = 1 << 2
OVERRUN = 1 << 3
ERROR_PASSIVE = 1 << 5
ARBITRATION_LOST = 1 << 6
BUS_ERROR = 1 << 7

_RATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
"""Bit rates of S0 to S8 [bit/s]."""
_CLOCK_HZ = 8e6
"""Clock of the SJA1000 whose registers `s` sets [Hz]: half of its 16 MHz crystal."""
_MAX_CHARS = 160
"""Longest line [characters]: the longest FD frame has 138."""
_FRAME = re.compile(r"(?:[tdbr]([0-9A-Fa-f]{3})|[TDBR]([0-9A-Fa-f]{8}))([0-9A-Fa-f])((?:[0-9A-Fa-f]{2})*)")
_MINUTE_MS = 60_000


class Lines:
    """Splits a stream of bytes into lines."""

    def __init__(self) -> None:
        self._rest = b""
        self._spoilt = False

    def feed(self, data: bytes) -> Iterator[str | None]:
        """Yield the lines that are complete with this data; None for one that is too long or has invalid bytes.

        Args:
            data: The next bytes, in portions of any size.
        """
        *lines, self._rest = (self._rest + data).split(b"\r")
        for line in lines:
            # Terminal programs end lines with both characters.
            text = line.lstrip(b"\n").decode("ascii", errors="replace")
            good = not self._spoilt and len(text) <= _MAX_CHARS and text.isascii() and (text.isprintable() or not text)
            self._spoilt = False
            yield text if good else None
        if len(self._rest) > _MAX_CHARS:
            self._rest, self._spoilt = b"", True


def parse(line: str) -> can.Message:
    """Parse the frame of a line.

    Raises:
        CodecError: The line is not a frame.
    """
    match = _FRAME.fullmatch(line)
    if match is None:
        raise CodecError("no frame")
    kind, extended = line[0].lower(), line[0].isupper()
    identifier = int(match[1] or match[2], 16)
    code, data = int(match[3], 16), bytes.fromhex(match[4])
    fd, remote = kind in "db", kind == "r"
    length = FD_LENGTHS[code]
    if len(data) != (0 if remote else length):
        raise CodecError("not as long as it says")
    return make_message(
        identifier, data, length=length, extended=extended, remote=remote, is_fd=fd, bitrate_switch=kind == "b"
    )


def show(message: can.Message, *, stamped: bool = False) -> bytes | None:
    """Format a frame as a line; None for an error frame, which the protocol does not have.

    Args:
        message: The frame.
        stamped: Whether to add its time stamp.
    """
    if message.is_error_frame:
        return None
    kind = "r" if message.is_remote_frame else "t" if not message.is_fd else "b" if message.bitrate_switch else "d"
    if message.is_extended_id:
        head = f"{kind.upper()}{message.arbitration_id:08X}"
    else:
        head = f"{kind}{message.arbitration_id:03X}"
    length = message.dlc if message.is_remote_frame else len(message.data)
    code = FD_LENGTHS.index(length) if message.is_fd else length
    data = "" if message.is_remote_frame else message.data.hex().upper()
    stamp = f"{int(message.timestamp * 1000) % _MINUTE_MS:04X}" if stamped else ""
    return f"{head}{code:X}{data}{stamp}\r".encode()


class SlcanPort(Outlet):
    """SLCAN adapter at a pseudo-terminal. Like a real one, it can be used by one program at a time.

    Args:
        open_bus: Opens the adapter's node on the bus, each time its channel is opened.
        speed: Bit rates of the bus; None accepts any.
        room: Largest number of messages that wait for the program.
        patience_s: Longest time for which the program may read nothing of waiting text before the channel is closed
            [s].
    """

    def __init__(
        self, open_bus: OpenBus, *, speed: Speed | None = None, room: int = ROOM, patience_s: float = PATIENCE_S
    ) -> None:
        # Our end stays open: otherwise each program that closes its end would end the terminal's raw mode.
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        """Path for programs to open."""
        super().__init__(self._master, name=f"slcan {self.path}", room=room, patience_s=patience_s)
        self._open_bus = open_bus
        self._speed = speed
        self._lines = Lines()
        self._listen_only = False
        self._stamped = False
        self._flags = 0
        self._thread = threading.Thread(target=self.serve, name=f"slcan {self.path}", daemon=True)

    def __enter__(self) -> SlcanPort:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove the adapter."""
        self.stop()
        if self._thread.is_alive():
            self._thread.join(timeout=6.0)
        for descriptor in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def figures(self) -> dict[str, int]:
        """Return counts: `open` channels, `dropped` frames, `bells`, frames `refused` by the bus, `given_up`."""
        names = ("dropped", "bells", "refused", "given_up")
        return {"open": int(self.bus is not None), **{name: self.counts[name] for name in names}}

    # ---- from the program ----

    def _take(self, data: bytes) -> None:
        for line in self._lines.feed(data):
            if self._ending:
                return
            answer = None if line is None else self._execute(line)
            if answer is None:
                answer = BELL
            if answer == BELL:
                self.counts["bells"] += 1
            self._answer(answer)

    def _execute(self, line: str) -> bytes | None:
        """Execute a line, and return the reply; None if it is not a command, or not allowed now."""
        command, rest = line[:1], line[1:]
        if command and command in "tTrRdDbB":
            return self._transmit(line)
        is_open = self.bus is not None
        match command:
            case "":
                return OK
            case "V" | "N" if not rest:
                return VERSION if command == "V" else SERIAL_NUMBER
            case "F" if is_open and not rest:
                flags, self._flags = self._flags, 0
                return f"F{flags:02X}\r".encode()
            case "O" | "L" if not is_open and not rest:
                return self._open(listen_only=command == "L")
            case "C" if not rest:
                # Also if it is closed already: every program begins with it.
                self._close()
                return OK
            case "Z" if not is_open and rest in ("0", "1"):
                self._stamped = rest == "1"
                return OK
            case "S" | "s" | "Y" if not is_open:
                return OK if self._is_rate(command, rest) else None
            case "M" if not is_open and rest == "00000000":
                return OK
            case "m" if not is_open and rest.upper() == "FFFFFFFF":
                return OK
            case "U" if not is_open and re.fullmatch(r"[0-6]", rest):
                return OK
        return None

    def _is_rate(self, command: str, rest: str) -> bool:
        """Return whether a command requests the rate of the bus."""
        speed = self._speed
        if command == "S" and re.fullmatch(r"[0-8]", rest):
            requested, bus_rate = _RATES[int(rest)], None if speed is None else speed.nominal_bit_s
        elif command == "Y" and re.fullmatch(r"[1-9]", rest):
            if speed is not None and not speed.fd:
                return False
            requested, bus_rate = 1e6 * int(rest), None if speed is None else speed.data_bit_s
        elif command == "s" and re.fullmatch(r"[0-9A-Fa-f]{4}", rest):
            # Bus timing registers 0 and 1 of the SJA1000.
            first, second = bytes.fromhex(rest)
            quanta = 1 + (second & 15) + 1 + (second >> 4 & 7) + 1
            requested = _CLOCK_HZ / (((first & 63) + 1) * quanta)
            bus_rate = None if speed is None else speed.nominal_bit_s
        else:
            return False
        return bus_rate is None or abs(requested - bus_rate) < 1e-3 * bus_rate

    def _transmit(self, line: str) -> bytes | None:
        import can

        if self.bus is None or self._listen_only:
            return None
        try:
            message = parse(line)
            if message.is_fd and self._speed is not None and not self._speed.fd:
                return None
            self._send(message)
        except CodecError:
            return None
        except can.CanError:
            self.counts["refused"] += 1
            self._flags |= TRANSMIT_FULL
            return BELL
        return OK

    def _open(self, *, listen_only: bool) -> bytes:
        import can

        try:
            bus = self._open_bus()
        except (can.CanError, OSError, ValueError):
            self.counts["refused"] += 1
            return BELL
        if listen_only:
            # Buses of other kinds may not support it; then nothing is sent, but they may acknowledge.
            with contextlib.suppress(NotImplementedError, can.CanError):
                bus.state = can.BusState.PASSIVE
        self._listen_only = listen_only
        self._flags = 0
        self._enter(bus)
        return OK

    def _close(self) -> None:
        self._leave()
        if self._messages or self._rest:
            # Text for a program that no longer reads: the next program must not receive it.
            self._forget()

    def _forget(self) -> None:
        super()._forget()
        with contextlib.suppress(termios.error):
            termios.tcflush(self._slave, termios.TCIFLUSH)

    # ---- to the program, on the thread that receives from the bus ----

    def show_frame(self, message: can.Message) -> bytes | None:
        """Return the text of a frame; None if it is not for the client."""
        if message.is_error_frame:
            self._flags |= status_flags(message)
        return show(message, stamped=self._stamped)

    def _overflow(self) -> bytes:
        self._flags |= RECEIVE_FULL | OVERRUN
        return b""

    def _lose(self) -> None:
        # Frames are refused from now on; the bus may be available when the channel is opened again.
        self._flags |= ERROR_PASSIVE | BUS_ERROR

    def _give_up(self) -> None:
        # The program can start again.
        self._leave()
        self._forget()


def status_flags(message: can.Message) -> int:
    """Return the status flags that an error frame sets; its classes are those of SocketCAN."""
    kind, data = message.arbitration_id, bytes(message.data).ljust(8, b"\0")
    flags = 0
    if kind & codec.CONTROLLER:
        flags |= RECEIVE_FULL | OVERRUN if data[1] & 0x01 else 0
        flags |= TRANSMIT_FULL if data[1] & 0x02 else 0
        flags |= ERROR_WARNING if data[1] & 0x0C else 0
        flags |= ERROR_PASSIVE if data[1] & 0x30 else 0
    flags |= ARBITRATION_LOST if kind & 0x002 else 0
    flags |= BUS_ERROR if kind & (codec.PROTOCOL | codec.BUS_ERROR | codec.NO_ACKNOWLEDGE) else 0
    flags |= ERROR_PASSIVE | BUS_ERROR if kind & codec.BUS_OFF else 0
    return flags
