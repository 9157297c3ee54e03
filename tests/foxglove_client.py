"""A WebSocket client with Foxglove's protocol, on a plain socket: independent of the SDK that the server uses."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Self

from tests.waiting import PATIENCE_S

TEXT, BINARY, CLOSE = 1, 2, 8
SUBPROTOCOL = "foxglove.sdk.v1"


@dataclass
class FoxgloveClient:
    """Connected to a server on the loopback; `received` are its JSON messages, `messages` those of each topic."""

    port: int
    origin: str = ""
    received: list[dict[str, Any]] = field(default_factory=list)
    messages: dict[str, list[tuple[int, bytes]]] = field(default_factory=dict)
    answers: deque[dict[str, Any]] = field(default_factory=deque)
    states: list[dict[str, Any]] = field(default_factory=list)
    channels: dict[str, dict[str, Any]] = field(default_factory=dict)
    services: dict[str, dict[str, Any]] = field(default_factory=dict)
    time_ns: int = 0

    def __enter__(self) -> Self:
        self._socket = socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE_S)
        origin = f"Origin: {self.origin}\r\n" if self.origin else ""
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n{origin}"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Protocol: {SUBPROTOCOL}\r\n\r\n".encode()
        )
        self._buffer = b""
        while b"\r\n\r\n" not in self._buffer:
            self._buffer += self._socket.recv(4096)
        head, _, self._buffer = self._buffer.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 101"), head
        self._topics: dict[int, str] = {}
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def _exactly(self, size: int) -> bytes:
        while len(self._buffer) < size:
            more = self._socket.recv(1 << 16)
            assert more, "the server closed the connection"
            self._buffer += more
        data, self._buffer = self._buffer[:size], self._buffer[size:]
        return data

    def send(self, payload: bytes, kind: int = TEXT) -> None:
        """Send one masked frame."""
        size = len(payload)
        length = struct.pack(">BQ", 0x80 | 127, size)
        if size < 65536:
            length = bytes([0x80 | size]) if size < 126 else struct.pack(">BH", 0x80 | 126, size)
        mask = os.urandom(4)
        masked = bytes(byte ^ mask[n % 4] for n, byte in enumerate(payload))
        self._socket.sendall(bytes([0x80 | kind]) + length + mask + masked)

    def tell(self, **message: Any) -> None:
        self.send(json.dumps(message).encode())

    def read(self) -> None:
        """Read one frame, and file it."""
        first, second = self._exactly(2)
        size = second & 0x7F
        if size >= 126:
            size = int.from_bytes(self._exactly(2 if size == 126 else 8), "big")
        payload, kind = self._exactly(size), first & 0x0F
        assert kind != CLOSE, payload
        if kind == TEXT:
            self._take(json.loads(payload))
        elif kind == BINARY and payload[0] == 1:
            subscription, time_ns = struct.unpack_from("<IQ", payload, 1)
            self.messages.setdefault(self._topics[subscription], []).append((time_ns, payload[13:]))
        elif kind == BINARY and payload[0] == 2:
            self.time_ns = int.from_bytes(payload[1:9], "little")
        elif kind == BINARY and payload[0] == 3:
            _, call, size = struct.unpack_from("<III", payload, 1)
            self.answers.append({"op": "reply", "callId": call, **json.loads(payload[13 + size :])})
        elif kind == BINARY and payload[0] == 5:
            status, time_ns, rate, sought = struct.unpack_from("<BQfB", payload, 1)
            name = payload[19:].decode()
            self.states.append({"status": status, "ns": time_ns, "rate": rate, "sought": sought, "request": name})

    def _take(self, message: dict[str, Any]) -> None:
        self.received.append(message)
        if message["op"] == "advertise":
            self.channels |= {each["topic"]: each for each in message["channels"]}
        elif message["op"] == "advertiseServices":
            self.services |= {each["name"]: each for each in message["services"]}
        elif message["op"] == "serviceCallFailure":
            self.answers.append(message)

    def until(self, condition: Callable[[], object]) -> None:
        """Read until a condition holds."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            self.read()

    def find(self, op: str) -> list[dict[str, Any]]:
        return [message for message in self.received if message["op"] == op]

    def subscribe(self, *topics: str) -> None:
        """Subscribe to topics, which are advertised first; the subscription has the number of the channel."""
        self.until(lambda: all(topic in self.channels for topic in topics))
        ids = {self.channels[topic]["id"]: topic for topic in topics}
        self._topics |= ids
        self.tell(op="subscribe", subscriptions=[{"id": each, "channelId": each} for each in ids])

    def call(self, service: str, request: Any) -> dict[str, Any]:
        """Call a service and return its reply, or the message of its failure."""
        self.until(lambda: service in self.services)
        data = request if isinstance(request, bytes) else json.dumps(request).encode()
        head = struct.pack("<BIII", 2, self.services[service]["id"], 7, 4)
        self.send(head + b"json" + data, BINARY)
        self.until(lambda: self.answers)
        return self.answers.popleft()

    def play(self, *, command: int, rate: float, seek_ns: int | None, request: str) -> dict[str, Any]:
        """Use the play bar: command 0 plays, 1 pauses; return the state that answers it."""
        name = request.encode()
        seek = struct.pack("<BQ", seek_ns is not None, seek_ns or 0)
        self.send(struct.pack("<BBf", 3, command, rate) + seek + struct.pack("<I", len(name)) + name, BINARY)
        self.until(lambda: any(request in state["request"] for state in self.states))
        return next(state for state in self.states if request in state["request"])
