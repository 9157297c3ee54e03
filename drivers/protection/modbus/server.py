"""Modbus TCP server of the gateway, by pymodbus; each request is checked before pymodbus decodes it.

pymodbus accepts any value other than 0 as ON, answers an unknown function without its code, and loses a request that
arrives before the reply to the one before, and all that are beyond its buffer. Requests are therefore checked and
passed on one at a time here, and a connection is read no faster than its client reads the replies. A message that is
not Modbus TCP closes its connection.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse
from pymodbus.server import ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import DataType, SimData, SimDevice

from drivers.protection.modbus.registers import COILS, FLOATS, RegisterMap
from rig.base.errors import InputError

_READ_BITS, _READ_REGISTERS, _WRITE_COILS = (1, 2), (3, 4), (5, 15)
_MAX_COUNT = {1: 2000, 2: 2000, 3: 125, 4: 125, 15: 1968}
"""Largest number of values in a request, by function code."""
_HEADER_BYTES, _MAX_BYTES = 7, 254
"""Length of the header, and largest length that it may state."""
_START_S = 10.0


class Server(ModbusTcpServer):
    """Server of the registers; its methods belong on the thread of its loop.

    Args:
        registers: Register map.
        address: Host and port.
        command: Executes a command of `COILS`, on its own thread; None refuses all writes.
    """

    def __init__(
        self, registers: RegisterMap, address: tuple[str, int], command: Callable[[str], object] | None
    ) -> None:
        self._command, count, bits = command, len(registers.registers), len(registers.bits)
        self._spans = {1: [(0, len(COILS))], 2: [(0, bits)], 3: [(0, count), (FLOATS, FLOATS + 2 * count)]}

        def block() -> list[SimData]:
            return [
                SimData(start, values=[0] * (end - start), datatype=DataType.REGISTERS) for start, end in self._spans[3]
            ]

        inputs = [SimData(0, values=[False] * bits, datatype=DataType.BITS)]
        coils = [SimData(0, values=[False] * len(COILS), datatype=DataType.BITS)]
        super().__init__(SimDevice(0, (coils, inputs, block(), block()), action=self._act), address=address)

    def callback_new_connection(self) -> ServerRequestHandler:
        """Return the handler of a new connection."""
        return _Handler(self, self.trace_packet, self.trace_pdu, self.trace_connect)

    def find_fault(self, request: bytes) -> ExcCodes | None:
        """Return the exception code for a request that must be refused.

        Args:
            request: Function code and data.
        """
        code, numbers = request[0], [int.from_bytes(request[at : at + 2], "big") for at in (1, 3)]
        if code not in (*_READ_BITS, *_READ_REGISTERS, *(_WRITE_COILS if self._command else ())):
            return ExcCodes.ILLEGAL_FUNCTION
        address, count = numbers[0], 1 if code == 5 else numbers[1]
        packed = (count + 7) // 8
        length = 6 + packed if code == 15 else 5
        if len(request) != length or (code == 15 and request[5] != packed):
            return ExcCodes.ILLEGAL_VALUE
        if numbers[1] not in (0, 0xFF00) if code == 5 else not 1 <= count <= _MAX_COUNT[code]:
            return ExcCodes.ILLEGAL_VALUE
        spans = self._spans[3 if code in _READ_REGISTERS else 2 if code == 2 else 1]
        within = any(start <= address and address + count <= end for start, end in spans)
        return None if within else ExcCodes.ILLEGAL_ADDRESS

    async def _act(
        self, code: int, _start: int, address: int, _count: int, _current: list[int], values: list[Any] | None
    ) -> ExcCodes | None:
        """Execute the commands of a request that writes coils, in the order of their addresses."""
        for name, value in zip(COILS[address:], values or (), strict=False) if code in _WRITE_COILS else ():
            if value and self._command:
                try:
                    await asyncio.to_thread(self._command, name)
                except InputError:
                    return ExcCodes.DEVICE_FAILURE
                except (OSError, EOFError):
                    return ExcCodes.GATEWAY_NO_RESPONSE
        return None

    async def publish(self, words: list[int], floats: list[int], bits: list[bool]) -> None:
        """Replace the contents, between two requests."""
        for code in _READ_REGISTERS:
            await self.async_setValues(0, code, 0, words)
            await self.async_setValues(0, code, FLOATS, floats)
        await self.async_setValues(0, 2, 0, bits)


class _Handler(ServerRequestHandler):
    """Connection of a client, with one request in work at a time."""

    _busy = _is_full = _is_paused = False

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        # Above the largest part that asyncio reads at once, 256 KiB: pymodbus discards everything beyond it.
        self.max_buffer_size = 1 << 20

    def pause_writing(self) -> None:
        """Wait with the next request: the client does not read its replies."""
        self._is_full = True

    def resume_writing(self) -> None:
        """Take the next request."""
        self._is_full = False
        self._continue()

    def data_received(self, data: bytes) -> None:
        """Take the next request; read no further while others wait."""
        super().data_received(data)
        if (paused := bool(self.recv_buffer) and (self._busy or self._is_full)) != self._is_paused:
            self._is_paused, transport = paused, cast("asyncio.Transport", self.transport)
            (transport.pause_reading if paused else transport.resume_reading)()

    def callback_data(self, data: bytes, addr: tuple | None = None) -> int:
        """Pass on the next request, if it is complete, and return its length."""
        length = int.from_bytes(data[4:6], "big")
        if len(data) >= _HEADER_BYTES and (any(data[2:4]) or not 2 <= length <= _MAX_BYTES):
            self.close()
            return len(data)
        end = _HEADER_BYTES - 1 + length
        if self._busy or self._is_full or len(data) <= _HEADER_BYTES or len(data) < end:
            return 0
        self._busy = True
        if (fault := self.server.find_fault(data[_HEADER_BYTES:end])) is None:
            return super().callback_data(data[:end], addr)
        self.last_pdu = None
        transaction = int.from_bytes(data[:2], "big")
        self.pdu_send(ExceptionResponse(data[_HEADER_BYTES], fault, device_id=data[6], transaction=transaction))
        return end

    def send(self, data: bytes, addr: tuple | None = None) -> None:
        """Send a reply, then take the next request."""
        waiting = self.recv_buffer
        super().send(data, addr)
        self.recv_buffer, self._busy = waiting, False
        self.loop.call_soon(self._continue)

    def _continue(self) -> None:
        if not self.is_closing:
            self.data_received(b"")


@contextmanager
def serve(
    registers: RegisterMap, address: tuple[str, int], command: Callable[[str], object] | None
) -> Iterator[Callable[[np.ndarray, list[bool]], object]]:
    """Serve the registers on a thread; yield a function that replaces their values and bits.

    Args:
        registers: Register map.
        address: Host and port.
        command: As of `Server`.
    """
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL + 1)  # reports of malformed requests
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, name="modbus", daemon=True)

    def call(work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, loop).result(_START_S)

    async def start() -> Server:
        server = Server(registers, address, command)
        await server.serve_forever(background=True)
        return server

    async def stop() -> None:
        await server.shutdown()
        await asyncio.sleep(0.0)  # connections close at the next turn of the loop

    thread.start()
    try:
        server = call(start())
        try:
            yield lambda values, bits: call(server.publish(*registers.encode(values), bits))
        finally:
            call(stop())
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join(_START_S)
        loop.close()
