"""Modbus TCP client written from the specification, MODBUS Messaging on TCP/IP 1.0b, without the server's library."""

from __future__ import annotations

import socket
import struct

from tests.waiting import PATIENCE_S


class ModbusError(Exception):
    """The server answered with an exception code."""


class ModbusClient:
    """Client of one connection; numbers are big-endian."""

    def __init__(self, port: int) -> None:
        self.link = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        self._transaction = 0

    def __enter__(self) -> ModbusClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.link.close()

    def request(self, pdu: bytes) -> bytes:
        """Send a request, and return the data of its reply.

        Raises:
            ModbusError: With the exception code.
        """
        self._transaction += 1
        self.link.sendall(struct.pack(">HHHB", self._transaction, 0, len(pdu) + 1, 17) + pdu)
        return self.receive(self._transaction, pdu[0])

    def receive(self, transaction: int, code: int) -> bytes:
        number, protocol, length, unit = struct.unpack(">HHHB", self._read(7))
        reply = self._read(length - 1)
        assert (number, protocol, unit, reply[0] & 0x7F) == (transaction, 0, 17, code & 0x7F)
        if reply[0] & 0x80:
            raise ModbusError(*reply[1:])
        return reply[1:]

    def _read(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self.link.recv(count - len(data))
            if not part:
                raise ConnectionError("closed by the server")
            data += part
        return data

    def registers(self, address: int, count: int, code: int = 4) -> list[int]:
        data = self.request(struct.pack(">BHH", code, address, count))
        assert data[0] == 2 * count == len(data) - 1
        return list(struct.unpack(f">{count}H", data[1:]))

    def bits(self, address: int, count: int, code: int = 2) -> list[bool]:
        data = self.request(struct.pack(">BHH", code, address, count))
        assert data[0] == (count + 7) // 8 == len(data) - 1
        return [bool(data[1 + place // 8] >> place % 8 & 1) for place in range(count)]

    def write_coil(self, address: int, value: int = 0xFF00) -> None:
        request = struct.pack(">HH", address, value)
        assert self.request(b"\x05" + request) == request
