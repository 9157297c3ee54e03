"""Serial line or pseudo-terminal: frames of `drivers.link.frames` in a stream of bytes (POSIX)."""

from __future__ import annotations

import contextlib
import os
import select
import termios
import threading
import tty
from collections.abc import Iterator
from pathlib import Path

from drivers.link import FORMS, LinkClosedError, LinkTimeoutError
from drivers.link.frames import Deframer, encode_frame
from rig.base.errors import InputError
from rig.serve.waiting import Deadline

_MAX_BYTES = 1 << 16
_READ_BYTES = 1 << 16


class SerialLink:
    """One end of a serial line.

    Args:
        descriptor: File descriptor of an open terminal; closed with the link.
        keep: Another descriptor to keep open as long as the link.
    """

    def __init__(self, descriptor: int, *, keep: int | None = None) -> None:
        os.set_blocking(descriptor, False)
        self._descriptor = descriptor
        self._keep = keep
        # Wakes threads that wait for the line when it is closed.
        self._wake_read, self._wake = os.pipe()
        self._sending = threading.Lock()
        self._receiving = threading.Lock()
        self._closing = threading.Lock()
        self._closed = False
        self._deframer = Deframer(_MAX_BYTES)
        self._messages: list[bytes] = []
        self.max_bytes = _MAX_BYTES

    @property
    def lost(self) -> int:
        """Frames that arrived corrupted."""
        return self._deframer.spoilt

    def send(self, message: bytes, *, timeout_s: float) -> None:
        """Write one frame. A frame that the line does not accept in time stays cut, and the other end skips it."""
        if len(message) > _MAX_BYTES:
            raise InputError("message", f"at most {_MAX_BYTES} bytes long", len(message))
        deadline = Deadline(timeout_s)
        rest = memoryview(encode_frame(message))
        with self._sending:
            while rest:
                self._wait(select.POLLOUT, deadline, f"the line accepted no data for {timeout_s:g} s")
                with self._errors(), contextlib.suppress(BlockingIOError):
                    rest = rest[os.write(self._descriptor, rest) :]

    def receive(self, *, timeout_s: float) -> bytes | None:
        """Return the next message, or None if none arrived in time."""
        deadline = Deadline(timeout_s)
        with self._receiving:
            while not self._messages:
                try:
                    self._wait(select.POLLIN, deadline, "")
                except LinkTimeoutError:
                    return None
                with self._errors(), contextlib.suppress(BlockingIOError):
                    data = os.read(self._descriptor, _READ_BYTES)
                    if not data:
                        raise LinkClosedError("the other end of the line was closed")
                    self._messages = self._deframer.feed(data)
            return self._messages.pop(0)

    def _wait(self, event: int, deadline: Deadline, text: str) -> None:
        if self._closed:
            raise LinkClosedError("the line is closed")
        poll = select.poll()
        poll.register(self._descriptor, event)
        poll.register(self._wake_read, select.POLLIN)
        ready = dict(poll.poll(deadline.left_s * 1e3))
        if self._closed or self._wake_read in ready:
            raise LinkClosedError("the line is closed")
        state = ready.get(self._descriptor, 0)
        if state & (select.POLLERR | select.POLLNVAL) or (state & select.POLLHUP and not state & event):
            raise LinkClosedError("the other end of the line was closed")
        if not state:
            raise LinkTimeoutError(text)

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except LinkClosedError:
            raise
        except OSError as error:
            raise LinkClosedError(f"the line failed: {error.strerror}") from None

    def close(self) -> None:
        """Close the line, after waking the threads that send or receive."""
        with self._closing:
            if self._closed:
                return
            self._closed = True
            os.write(self._wake, b"x")
            with self._sending, self._receiving:
                for descriptor in (self._descriptor, self._keep, self._wake, self._wake_read):
                    if descriptor is not None:
                        os.close(descriptor)


def open_serial(text: str, *, field: str = "serial") -> SerialLink:
    """Open the host's end of a serial line.

    Args:
        text: Path of a terminal, with `@` and a bit rate for a real serial line.
        field: Name of the value in an error.

    Raises:
        InputError: The path is not a terminal, or the system has no such bit rate.
    """
    path, at, baud = text.rpartition("@") if "@" in text else (text, "", "")
    speed = getattr(termios, f"B{baud}", None) if at else None
    if at and (not baud.isdecimal() or speed is None):
        raise InputError(field, "PATH@BAUD with a bit rate of this system, such as 115200 or 921600", text)
    if not Path(path).is_char_device():
        raise InputError(field, f"an existing terminal ({FORMS})", text)
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        raise InputError(field, f"a terminal that can be opened ({error.strerror})", text) from None
    try:
        tty.setraw(descriptor, termios.TCSANOW)
        if speed is not None:
            settings = termios.tcgetattr(descriptor)
            settings[4] = settings[5] = speed
            termios.tcsetattr(descriptor, termios.TCSANOW, settings)
        # Discard what was sent to an earlier reader.
        termios.tcflush(descriptor, termios.TCIFLUSH)
    except termios.error:
        os.close(descriptor)
        raise InputError(field, f"a terminal ({FORMS})", text) from None
    return SerialLink(descriptor)


def open_pty() -> tuple[SerialLink, str]:
    """Open a pseudo-terminal; return the instrument's end, and the path of the host's end."""
    master, slave = os.openpty()
    tty.setraw(slave, termios.TCSANOW)
    # Kept open: otherwise the line would count as disconnected while no host has it open.
    return SerialLink(master, keep=slave), os.ttyname(slave)
