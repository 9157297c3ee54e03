"""Socketcand server: a CAN bus for clients in any language, as text over loopback TCP.

The protocol is that of the Linux daemon socketcand (github.com/linux-can/socketcand, doc/protocol.md), which python-can
(interface `socketcand`), Kayak and others use. Each connection is a separate node on the bus.

Supported: open, rawmode, bcmmode, controlmode, send, sendrtr, subscribe, unsubscribe, echo, statistics. Not supported,
and refused with an error: cyclic sending (add, update, delete), content filters, ISO-TP and the settings of a bus.
The beacon, a broadcast, is not sent. The protocol has no CAN FD frames: they are left out and counted.

An error that is not one of the bus is sent as `< error 000 TIME TEXT >`: like an error frame without a class, because
clients such as python-can's parse every error as a frame and fail at plain text.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import socket
import socketserver
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any

from drivers.can.bus.codec import CONTROLLER, CodecError
from drivers.can.bus.outlets.outlet import PATIENCE_S, ROOM, OpenBus, Outlet, make_message
from rig.base.errors import InputError
from rig.serve.health import Guard
from rig.serve.transport.endpoint import parse_loopback
from rig.serve.waiting import wait_until

if TYPE_CHECKING:
    import can

PORT = 29536
"""Default port of the daemon."""
MAX_CLIENTS = 16

_MAX_COMMAND_CHARS = 512
"""Longest command [characters]."""
_SEND_BUFFER_BYTES = 1 << 16
"""Bytes that the system may buffer for a client in addition to the queue here."""
_HOLD_S = 0.05
"""Delay of frames after the reply to rawmode [s]: clients read that reply in one piece, and would lose frames sent with
it."""
_POLL_S = 0.1
_CLOSE_TIMEOUT_S = 6.0
_MIN_INTERVAL_MS = 10
_MAX_INTERVAL_MS = 3_600_000
_MAX_SUBSCRIPTIONS = 4096
_HEX = re.compile(r"[0-9A-Fa-f]{1,8}")
_BYTE = re.compile(r"[0-9A-Fa-f]{1,2}")
_NUMBER = re.compile(r"[0-9]{1,9}")


class Splitter:
    """Splits a stream of text into commands; text between them is dropped."""

    def __init__(self) -> None:
        self._text = b""

    def __len__(self) -> int:
        """Return the number of bytes of the incomplete command."""
        return len(self._text)

    def feed(self, data: bytes) -> Iterator[str | None]:
        """Yield the commands that are complete with this data, without brackets; None for invalid text.

        Args:
            data: The next bytes, in portions of any size.
        """
        self._text += data
        while self._text:
            start = self._text.find(b"<")
            prefix = self._text if start < 0 else self._text[:start]
            self._text = b"" if start < 0 else self._text[start:]
            if prefix.strip():
                yield None
            end = self._text.find(b">")
            if end < 0:
                if len(self._text) > _MAX_COMMAND_CHARS:
                    self._text = b""
                    yield None
                return
            command, self._text = self._text[1:end], self._text[end + 1 :]
            text = command.decode("ascii", errors="replace")
            yield text if end < _MAX_COMMAND_CHARS and text.isascii() and text.isprintable() and text.strip() else None


def parse_frame(words: list[str], *, remote: bool = False) -> can.Message:
    """Parse the frame of a `send` or `sendrtr` command.

    Args:
        words: Identifier, length and bytes as text: 8 digits make the identifier an extended one.
        remote: Whether it is a remote frame, which has only a length.

    Raises:
        CodecError: The words are not a classic frame.
    """
    identifier, extended = parse_identifier(words[0] if words else "")
    if len(words) < 2 or not _BYTE.fullmatch(words[1]) or int(words[1], 16) > 8:
        raise CodecError("a length of 0 to 8 must follow the identifier")
    length, data_words = int(words[1], 16), words[2:]
    if not all(_BYTE.fullmatch(byte) for byte in data_words):
        raise CodecError("data must be bytes of one or two hexadecimal digits")
    if len(data_words) != (0 if remote else length):
        raise CodecError(f"{len(data_words)} bytes of data for a length of {length}")
    data = bytes(int(byte, 16) for byte in data_words)
    return make_message(identifier, data, length=length, extended=extended, remote=remote)


def parse_identifier(text: str) -> tuple[int, bool]:
    """Parse an identifier; return it, and whether it is an extended one.

    Raises:
        CodecError: The text is not an identifier.
    """
    extended = len(text) == 8
    if not _HEX.fullmatch(text) or not (extended or len(text) <= 3):
        raise CodecError("an identifier must have 1 to 3 or 8 hexadecimal digits")
    return int(text, 16), extended


def show(message: can.Message) -> bytes | None:
    """Format a frame as text; None for a CAN FD frame, which the protocol does not have."""
    if message.is_fd:
        return None
    time_s = f"{message.timestamp:.6f}"
    if message.is_error_frame:
        return f"< error {message.arbitration_id:03X} {time_s} >".encode()
    identifier = f"{message.arbitration_id:08X}" if message.is_extended_id else f"{message.arbitration_id:03X}"
    if message.is_remote_frame:
        return f"< rtr {identifier} {time_s} {message.dlc} >".encode()
    return f"< frame {identifier} {time_s} {message.data.hex().upper()} >".encode()


def format_error(text: str) -> bytes:
    """Format an error that is not one of the bus."""
    return f"< error 000 {time.time():.6f} {text} >".encode()


class Client(Outlet):
    """One connection, from the greeting to its end."""

    def __init__(
        self, descriptor: int, buses: Mapping[str, OpenBus], *, number: int, room: int, patience_s: float
    ) -> None:
        super().__init__(descriptor, name=f"socketcand {number}", room=room, patience_s=patience_s)
        self._buses = buses
        self._splitter = Splitter()
        self._raw = False
        self._held_until_s = 0.0
        self._subscribed: dict[tuple[int, bool], list[float]] = {}
        """Shortest time between two frames [s], and time of the next one [s, monotonic], by identifier."""
        self._every_s = 0.0
        self._next_s = 0.0
        self.traffic = [0, 0, 0, 0]
        """Bytes and frames received, bytes and frames sent."""
        self._answer(b"< hi >")

    # ---- from the client ----

    def _take(self, data: bytes) -> None:
        for command in self._splitter.feed(data):
            if self._ending:
                return
            try:
                if command is None:
                    raise CodecError("a command must be words in angle brackets")
                self._execute(command.split())
            except CodecError as error:
                self.counts["malformed"] += 1
                self._answer(format_error(str(error)))

    def _execute(self, words: list[str]) -> None:
        import can

        word, *rest = words
        if word == "echo":
            self._answer(b"< echo >")
        elif word == "open":
            self._open(rest)
        elif self.bus is None:
            raise CodecError("a bus must be opened first")
        elif word in ("send", "sendrtr"):
            message = parse_frame(rest, remote=word == "sendrtr")
            try:
                self._send(message)
            except can.CanError as error:
                self.counts["refused"] += 1
                # Brackets would end the text early.
                self._answer(format_error(f"not sent: {' '.join(re.sub('[<>]', ' ', str(error)).split())}"))
            else:
                self.traffic[2] += len(message.data)
                self.traffic[3] += 1
        elif word in ("rawmode", "bcmmode", "controlmode") and not rest:
            self._held_until_s = time.monotonic() + _HOLD_S
            # In this order: no frame before the reply, none lost after it.
            self._answer(b"< ok >")
            self._raw = word == "rawmode"
        elif word == "statistics":
            self._every_s = self._parse_numbers(rest, 1)[0] / 1000
            if self._every_s and not _MIN_INTERVAL_MS <= self._every_s * 1000 <= _MAX_INTERVAL_MS:
                self._every_s = 0.0
                raise CodecError(f"an interval must be 0 or from {_MIN_INTERVAL_MS} to {_MAX_INTERVAL_MS} ms")
            self._next_s = time.monotonic() + self._every_s
        elif word == "subscribe" and len(rest) == 3:
            seconds, microseconds = self._parse_numbers(rest[:2], 2)
            if len(self._subscribed) >= _MAX_SUBSCRIPTIONS:
                raise CodecError(f"there may be {_MAX_SUBSCRIPTIONS} subscriptions")
            self._subscribed[parse_identifier(rest[2])] = [seconds + microseconds * 1e-6, 0.0]
        elif word == "unsubscribe" and len(rest) == 1:
            self._subscribed.pop(parse_identifier(rest[0]), None)
        else:
            raise CodecError("unknown command")

    def _open(self, words: list[str]) -> None:
        import can

        if self.bus is not None:
            raise CodecError("a bus is open already")
        open_bus = self._buses.get(words[0]) if len(words) == 1 else None
        try:
            if open_bus is None:
                raise InputError("bus", " or ".join(self._buses), " ".join(words))
            bus = open_bus()
        except (can.CanError, OSError, ValueError):
            # As the daemon does; a bus that is not available now may be at the next connection.
            self.counts["malformed"] += 1
            self._answer(b"< error could not open bus >")
            self._ending = True
            return
        self._answer(b"< ok >")
        self._enter(bus)

    @staticmethod
    def _parse_numbers(words: list[str], count: int) -> list[int]:
        if len(words) != count or not all(_NUMBER.fullmatch(word) for word in words):
            raise CodecError(f"{count} whole numbers must follow")
        return [int(word) for word in words]

    # ---- to the client, on the thread that receives from the bus ----

    def show_frame(self, message: can.Message) -> bytes | None:
        """Return the text of a frame; None if it is not for the client."""
        text = show(message)
        if text is None:
            self.counts["fd_left_out"] += 1
            return None
        if not message.is_error_frame:
            self.traffic[0] += len(message.data)
            self.traffic[1] += 1
        if not self._raw:
            wanted = self._subscribed.get((message.arbitration_id, message.is_extended_id))
            now = time.monotonic()
            if message.is_error_frame or wanted is None or now < wanted[1]:
                return None
            wanted[1] = now + wanted[0]
        if (wait_s := self._held_until_s - time.monotonic()) > 0:
            time.sleep(wait_s)
        return text

    def _overflow(self) -> bytes:
        return f"< error {CONTROLLER:03X} {time.time():.6f} >".encode()

    def _tick(self) -> None:
        now = time.monotonic()
        if self._every_s and now >= self._next_s:
            self._next_s = now + self._every_s
            self.put(f"< stat {' '.join(map(str, self.traffic))} >".encode())

    def _lose(self) -> None:
        self.counts["bus_lost"] += 1
        self._ending = True


class SocketcandServer(socketserver.ThreadingTCPServer):
    """Serves buses to socketcand clients, each on its own thread.

    Args:
        buses: Functions that open a node on a bus, one for each connection, by the name of the bus.
        host: Address to listen on.
        port: Port to listen on; 0 for a free one.
        room: Largest number of messages that wait for one client.
        patience_s: Longest time for which a client may read nothing of waiting text before it is disconnected [s].

    Raises:
        InputError: The host can be reached from other computers, or the port is in use.
    """

    allow_reuse_address = True
    daemon_threads = True

    def __init__(
        self,
        buses: Mapping[str, OpenBus],
        *,
        host: str = "127.0.0.1",
        port: int = PORT,
        room: int = ROOM,
        patience_s: float = PATIENCE_S,
    ) -> None:
        parse_loopback(f"{host}:{port or PORT}", field="socketcand")
        self._buses = dict(buses)
        self._settings: dict[str, Any] = {"room": room, "patience_s": patience_s}
        try:
            super().__init__(("127.0.0.1" if host == "localhost" else host, port), socketserver.BaseRequestHandler)
        except OSError as error:
            raise InputError("socketcand", f"a free HOST:PORT ({error.strerror})", f"{host}:{port}") from None
        self.host, self.port = self.server_address[:2]
        self._ended: Counter[str] = Counter()
        """Counts of connections that have ended."""
        self.clients: list[Client] = []
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._guard = Guard("socketcand")
        self._thread = threading.Thread(target=self.serve_forever, args=(_POLL_S,), name="socketcand", daemon=True)

    def __enter__(self) -> SocketcandServer:
        self._thread.start()
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc_val: BaseException | None, exc_tb: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        if self._thread.is_alive():
            self.shutdown()
        self.server_close()
        with self._lock:
            clients = list(self.clients)
        for client in clients:
            client.stop()
        wait_until(lambda: not self.clients, _CLOSE_TIMEOUT_S)

    def counts(self) -> dict[str, int]:
        """Return counts: connected `clients`, `dropped` frames, `malformed` commands, `given_up`, ..."""
        with self._lock:
            total = sum((client.counts for client in self.clients), self._ended)
            names = ("dropped", "fd_left_out", "malformed", "refused", "given_up", "turned_away")
            return {"clients": len(self.clients), **{name: total[name] for name in names}}

    def warnings(self) -> list[str]:
        """Return the current warnings for the operator."""
        with self._lock:
            return [*self._guard.warnings(), *(text for client in self.clients for text in client.warnings())]

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Return whether there is room for a client; on the server's thread."""
        with self._lock:
            full = len(self.clients) >= MAX_CLIENTS
            self._ended["turned_away"] += full
        if full:
            with contextlib.suppress(OSError):
                request.send(b"< error too many clients >")
        return not full

    def finish_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection to its end, on its own thread."""
        request.setblocking(False)
        request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        with self._lock:
            client = Client(request.fileno(), self._buses, number=next(self._numbers), **self._settings)
            self.clients.append(client)
        try:
            client.serve()
        finally:
            with self._lock:
                self.clients.remove(client)
                self._ended.update(client.counts)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report a connection that failed."""
        self._guard.record_failure("a connection", sys.exception() or RuntimeError())
