"""The doors of a rig: one class each, with which `tests.system.test_doors` starts its server and a client of it.

A client reads up to a simulated time, commands the rig, compares what it read with a recording, and reports how it
learnt of a loss. `time_s` is the simulated time up to which it has read.
"""

from __future__ import annotations

import contextlib
import random
import re
import signal
import socket
import struct
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import can  # noqa: TID253 - one of the doors
import grpc
import nidaqmx
import numpy as np
import pytest
from nidaqmx._stubs.nidaqmx_pb2_grpc import NiDAQmxServicer  # noqa: PLC2701
from nidaqmx.constants import AcquisitionType
from nidaqmx.stream_readers import AnalogUnscaledReader

import rig
from drivers.can.signals import CommandKind, command_frame
from drivers.protection.modbus.registers import COILS, FLOATS, RegisterMap
from recorder.files.schemas import VIEW_EVENTS
from recorder.reader import Recording
from rig.base import wire
from rig.base.errors import RefusedError
from rig.channels.orbit import find_edges, synchronous
from rig.channels.table import ChannelTable
from rig.serve.transport.zenoh import ZenohClient
from tests import processes
from tests.foxglove_client import BINARY, TEXT, FoxgloveClient
from tests.unit.modbus_client import ModbusClient, ModbusError
from tests.waiting import PATIENCE_S, until


@dataclass
class Recorded:
    """The rows of a recording: counts and rate of each channel, and the plots."""

    table: ChannelTable
    counts: dict[str, np.ndarray]
    views: dict[str, list[tuple[int, bytes]]]

    @classmethod
    def read(cls, path: Path) -> Self:
        from mcap.reader import make_reader

        counts, views = {}, {}
        with Recording.open(path) as recording:
            for name, group in recording.table.groups.items():
                rows = np.concatenate([block.values for block in recording.blocks(wire.sensor_key(name))])
                counts |= dict(zip(group.names, rows.T, strict=True))
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                if channel.topic.startswith("view/"):
                    views.setdefault(channel.topic, []).append((message.log_time, message.data))
        return cls(recording.table, counts, views)

    def thinned(self, name: str, rate_hz: float) -> np.ndarray:
        """Return the counts of a channel at a lower rate."""
        return self.counts[name][:: round(self.table.groups[self.table.channels[name].group].rate_hz / rate_hz)]


class Client:
    """A client of a door."""

    time_s = 0.0
    command = "hammer"
    """The command that `act` sends, as the rig's event names it."""

    def __init__(self, table: ChannelTable) -> None:
        self.table = table

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect."""

    def read(self, to_s: float) -> None:
        """Read up to a simulated time."""
        raise NotImplementedError

    def receive(self) -> None:
        """Read the next 0.1 s."""
        self.read(self.time_s + 0.1)

    def resume(self) -> None:
        """Read the rows of another rig at the same address, for doors whose clients may stay connected."""
        raise NotImplementedError


class RowsClient(Client):
    """A client of `rig.connect`, which reads rows in units."""

    def __init__(self, table: ChannelTable, url: str, **settings: Any) -> None:
        super().__init__(table)
        self.machine = rig.connect(url, channels=list(table.channels), wait_s=PATIENCE_S, **settings)
        self.pieces: list[Any] = []

    def __exit__(self, *_: object) -> None:
        self.machine.close()

    def read(self, to_s: float) -> None:
        daq = self.machine.daq
        while (rows := round((to_s - self.time_s) * daq.rate_hz)) > 0:
            self.pieces.append(daq.read(rows, timeout_s=PATIENCE_S))
            self.time_s = self.pieces[-1].times_s[-1] + 1.0 / daq.rate_hz

    def act(self) -> None:
        self.machine.hammer()

    def volts(self, name: str) -> float:
        row = self.table.channels[name]
        return row.bias_v + row.sensitivity_v * float(self.pieces[-1][name][-100:].mean())

    def loss(self) -> str:
        """Find the gap before the next rows; a busy machine may also lose rows before they reach the buffer."""
        daq = self.machine.daq
        until(lambda: daq.dropped)
        least = daq.dropped
        rows = daq.read(100, timeout_s=PATIENCE_S)
        assert least <= rows.gap <= daq.dropped + daq.unmatched + sum(daq.lost.values())
        return f"{rows.gap} rows"

    def end(self) -> str:
        try:
            while True:
                self.receive()
        except ConnectionError as error:
            return str(error)

    def compare(self, recorded: Recorded) -> None:
        """Compare counts, at the lowest rate of the channels; CAN begins when the bus is joined."""
        rate, first = self.machine.daq.rate_hz, self.pieces[0].index
        assert sum(piece.gap for piece in self.pieces[1:]) == 0
        for name, row in self.table.channels.items():
            values = np.concatenate([piece[name] for piece in self.pieces])
            counts = (values - row.offset) / row.scale
            np.testing.assert_allclose(counts, np.round(counts), rtol=0, atol=0.01)
            expected = recorded.thinned(name, rate)[first : first + len(counts)]
            np.testing.assert_array_equal(np.round(counts), expected)


class DaqmxClient(Client):
    """A program that uses nidaqmx."""

    def __init__(self, table: ChannelTable, port: int, *, buffer: int = 1_000_000) -> None:
        super().__init__(table)
        self._stack = ExitStack()
        channel = self._stack.enter_context(grpc.insecure_channel(f"127.0.0.1:{port}"))
        self.options = nidaqmx.GrpcSessionOptions(channel, "")
        self.task = self._stack.enter_context(nidaqmx.Task(grpc_options=self.options))
        self.task.ai_channels.add_ai_voltage_chan(f"rig/ai0:{len(table.channels) - 1}")
        self.rate_hz = min(group.rate_hz for group in table.groups.values())
        self.task.timing.cfg_samp_clk_timing(self.rate_hz, sample_mode=AcquisitionType.CONTINUOUS)
        self.task.in_stream.input_buf_size = buffer
        self.task.start()
        self._reader, self.pieces = AnalogUnscaledReader(self.task.in_stream), list[np.ndarray]()

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def read(self, to_s: float) -> None:
        piece = np.zeros((len(self.table.channels), round((to_s - self.time_s) * self.rate_hz)), dtype=np.int32)
        self._reader.read_int32(piece, piece.shape[1], timeout=PATIENCE_S)
        self.pieces.append(piece)
        self.time_s = to_s

    def act(self) -> None:
        with nidaqmx.Task(grpc_options=self.options) as task:
            task.do_channels.add_do_chan("rig/port0/line0")
            task.write(True)

    def volts(self, name: str) -> float:
        counts = self.pieces[-1][list(self.table.channels).index(name), -100:]
        return self.table.channels[name].lsb_v * float(counts.mean())

    def loss(self) -> str:
        try:
            until(self.task.is_task_done)
        except nidaqmx.DaqError as error:
            return f"{nidaqmx.error_codes.DAQmxErrors(error.error_code).name}"
        return ""

    def end(self) -> str:
        try:
            while True:
                self.receive()
        except nidaqmx.DaqError as error:
            return str(error)

    def compare(self, recorded: Recorded) -> None:
        """Compare counts, at the lowest rate of the channels."""
        for name, counts in zip(self.table.channels, np.concatenate(self.pieces, axis=1), strict=True):
            np.testing.assert_array_equal(counts, recorded.thinned(name, self.rate_hz)[: len(counts)])


class FoxgloveReader(Client):
    """A client of Foxglove's protocol; the door thins the rows to the plots of a recording, by design."""

    def __init__(self, table: ChannelTable, port: int, *, topics: tuple[str, ...] = ()) -> None:
        super().__init__(table)
        self.link = FoxgloveClient(port).__enter__()
        self.link.until(lambda: self.link.services and self.link.channels)
        self.link.subscribe(*(topics or self.link.channels))
        # The reply comes after the subscriptions.
        self.link.tell(op="getParameters", parameterNames=[], id="subscribed")
        self.link.until(lambda: self.link.find("parameterValues"))

    def __exit__(self, *_: object) -> None:
        self.link.__exit__()

    def read(self, to_s: float) -> None:
        self.link.until(lambda: self.link.time_ns > 1e9 * to_s - 1e6)  # that of the last row
        self.time_s = max(to_s, 1e-9 * self.link.time_ns)

    def resume(self) -> None:
        before = len(self.link.find("serverInfo"))
        self.link.until(lambda: len(self.link.find("serverInfo")) > before)
        self.time_s = self.link.time_ns = 0
        self.receive()

    def act(self) -> None:
        if (reply := self.link.call("hammer", {}))["op"] != "reply":
            raise RefusedError(reply["message"])

    def volts(self, name: str) -> float:
        from tests.unit.test_foxglove import decode

        row = self.table.channels[name]
        topic = next(topic for topic in self.link.messages if row.group in topic)
        message = decode(self.link.messages[topic][-1][1])
        at = next(place for place, label in enumerate(message.name) if label.startswith(f"{name} ["))
        values = [each[at] for each in (message.position, message.velocity, message.effort) if each[at] == each[at]]
        return row.bias_v + row.sensitivity_v * values[0]

    def loss(self) -> str:
        """Find the gap in the times of the messages, which have a fixed rate; the newest messages are kept."""
        self.read(self.time_s + FoxgloveDoor.stall_s)
        for topic, messages in self.link.messages.items():
            times = np.unique([time_ns for time_ns, _ in messages])
            if len(times) > 2 and (gap := np.diff(times).max()) > 1.5 * np.diff(times).min():
                return f"{gap} ns without a message of {topic}"
        return ""

    def end(self) -> str:
        self.link.until(lambda: self.link.find("status"))
        return self.link.find("status")[0]["message"]

    def compare(self, recorded: Recorded) -> None:
        """Compare the plots byte for byte, and the events after the start of the run, which precedes this client."""

        def later(messages: dict[str, list[tuple[int, bytes]]]) -> dict[str, list[tuple[int, bytes]]]:
            return {
                topic: sorted(each for each in messages.get(topic, ()) if each[0] or topic != VIEW_EVENTS)
                for topic in recorded.views
            }

        expected = later(recorded.views)
        self.link.until(
            lambda: all(len(rows) >= len(expected[topic]) for topic, rows in later(self.link.messages).items())
        )
        assert later(self.link.messages) == expected


class ModbusReader(Client):
    """A Modbus master; the door thins the rows to detectors, by design. Its only commands are trip, stop and reset."""

    command = "speed"

    def __init__(self, table: ChannelTable, port: int) -> None:
        super().__init__(table)
        self.link, self.map = ModbusClient(port), RegisterMap(table)
        self.found: list[list[int]] = []
        self.read(0.1 * self.link.registers(0, 1)[0])

    def __exit__(self, *_: object) -> None:
        self.link.__exit__()

    def read(self, to_s: float) -> None:
        until(lambda: self.link.registers(0, 1)[0] >= round(10 * to_s))
        self.found.append(self.link.registers(0, len(self.map.registers)))
        self.floats = self.link.registers(FLOATS, 2 * len(self.map.registers))
        self.time_s = 0.1 * self.found[-1][0]

    def resume(self) -> None:
        until(lambda: self.link.bits(0, 1)[0])
        self.time_s = 0.1 * self.link.registers(0, 1)[0]
        self.receive()

    def act(self) -> None:
        self.link.write_coil(COILS.index("trip"))

    def volts(self, name: str) -> float:
        return self.decode(self.found[-1])[name, "gap"][0]

    def decode(self, words: list[int]) -> dict[tuple[str, str], tuple[float, float]]:
        """Return value and resolution by channel and detector."""
        values = {}
        for row, word in zip(self.map.registers, words, strict=True):
            count = word - 0x10000 if (row.lowest or 0) < 0 and word >= 0x8000 else word
            assert row.lsb is not None
            key = row.value.removeprefix("1X ").split(" ")[0].strip(",")
            values[row.channel, key] = count * row.lsb, row.lsb
        return values

    def loss(self) -> str:
        """Send many requests before the first reply is read; each waits for its turn, and another master reads."""
        count = 20_000
        requests = (struct.pack(">HHHBBHH", number, 0, 6, 17, 4, 0, 58) for number in range(count))
        self.link.link.sendall(b"".join(requests))
        with ModbusReader(self.table, self.link.link.getpeername()[1]) as other:
            other.receive()
        assert all(len(self.link.receive(number, 4)) == 117 for number in range(count))
        return "none: flow control"

    def end(self) -> str:
        until(lambda: not any(self.link.bits(0, len(self.map.bits))))
        try:
            self.act()
        except ModbusError as error:
            return f"exception {error}"
        return ""

    def compare(self, recorded: Recorded) -> None:
        """Compare each read with detectors of the recorded rows, within 1 LSB, at the lowest rate of the channels."""
        rate = min(group.rate_hz for group in self.table.groups.values())
        for words in filter(lambda words: words[0], self.found):
            end = round(0.1 * words[0] * rate)
            times_s, recent = np.arange(end) / rate, slice(end - round(0.25 * rate), end)
            rows = {
                name: (row.offset + row.scale * recorded.thinned(name, rate)[:end])
                for name, row in self.table.channels.items()
            }
            edges_s = find_edges(rows["keyphasor"], times_s)[-2:]
            first, last = np.searchsorted(times_s, edges_s)
            found = self.decode(words)
            assert found["", "speed"][0] == pytest.approx(60.0 / np.diff(edges_s)[0], abs=0.1)
            for channel in self.map.channels:
                signal = rows[channel.name]
                vector = synchronous(signal, times_s, edges_s)[1][0]
                expected = {
                    "overall": np.ptp(signal[recent]),
                    "gap": channel.bias_v + channel.sensitivity_v * signal[first:last].mean(),
                    "amplitude": abs(vector),
                }
                for detector, value in expected.items():
                    shown, lsb = found[channel.name, detector]
                    assert abs(shown - value) <= lsb, (channel.name, detector, words[0])
                lag = found[channel.name, "phase"][0]
                assert abs((lag + np.degrees(np.angle(vector)) + 180.0) % 360.0 - 180.0) <= 0.01
        floats = struct.unpack(f">{len(words)}f", struct.pack(f">{2 * len(words)}H", *self.floats))
        for value, (shown, lsb) in zip(floats, found.values(), strict=True):
            assert abs(shown - value) <= lsb


class Door:
    """The rig's own transport, zenoh; the other doors replace what differs."""

    name = "zenoh"
    has_server = continues = False
    """Whether it has a server, and whether a client of that is served by the next rig, too."""
    access: tuple[str, ...] = ()
    """Options of a server that accepts commands."""
    refusal: tuple[Any, str] = (RefusedError, "")
    """Error of a command without `--allow-commands`."""
    stall_settings: ClassVar[dict[str, Any]] = {"buffer_s": 0.6}
    """Settings of a client that loses samples soon if it stalls."""
    stall_options: tuple[str, ...] = ()
    """Options of a server whose clients lose samples soon if they stall."""
    stall_s = 1.5
    """Stall of a reader after which it has lost samples [s]."""

    def __init__(self) -> None:
        self.endpoint = processes.free_endpoint()

    def rig_options(self, channels: Path | None) -> tuple[str, ...]:
        """Return the options of `rig run`."""
        return ("--listen", self.endpoint, *(() if channels is None else ("--channels", str(channels))))

    @contextmanager
    def serve(self, *options: str) -> Iterator[tuple[subprocess.Popen[str] | None, Any]]:
        """Start the server, if there is one; yield its process, and the address of a client."""
        yield None, f"zenoh:{self.endpoint}"

    def open(self, table: ChannelTable, address: Any, **settings: Any) -> Any:
        return RowsClient(table, address, **settings)

    def attack(self, address: Any, draw: random.Random, count: int) -> None:
        """Send malformed messages."""
        names = ("hammer", "speed", "release", "fault", "clear", "stop", "step", "join", "done", "note")
        bodies = (b"", b"\xff", b"[1", b"[]", b"7", b'{"force_n": 1e999}', b'{"a": 1, "a": 2}', b"[" * 5000)
        with ZenohClient(self.endpoint, wait_s=PATIENCE_S) as client:
            for number in range(count):
                body = draw.randbytes(draw.randrange(200)) if number % 2 else draw.choice(bodies[1:])
                reply = client.request(wire.command_key(draw.choice(names)), body, timeout_s=PATIENCE_S)
                assert not wire.decode_document(reply)["accepted"], body


class CanDoor(Door):
    """A virtual CAN bus, whose frames carry counts at 10 kHz."""

    name = "CAN"

    def __init__(self) -> None:
        super().__init__()
        self._medium, self._channels = processes.free_endpoint(), ""

    def rig_options(self, channels: Path | None) -> tuple[str, ...]:
        self._channels = "" if channels is None else f"&channels={channels}"
        return (*super().rig_options(channels), "--can", f"zenoh:can0?endpoint={self._medium}", "--can-fd")

    @contextmanager
    def serve(self, *options: str) -> Iterator[tuple[None, Any]]:
        yield None, f"can:zenoh:can0?endpoint={self._medium}{self._channels}"

    def attack(self, address: Any, draw: random.Random, count: int) -> None:
        """Send frames of commands with a flipped bit, or of another length."""
        with can.Bus("can0", interface="zenoh", ignore_config=True, endpoint=self._medium) as bus:
            for number in range(count):
                kind, values = draw.choice(
                    [(CommandKind.HAMMER, {"force_n": 100.0, "duration_ms": 5.0}), (CommandKind.STOP, {})]
                )
                identifier, data = command_frame(kind, number % 16, **values)
                flipped = (int.from_bytes(data, "big") ^ 1 << draw.randrange(64)).to_bytes(8, "big")
                broken = flipped if number % 2 else draw.randbytes(draw.randrange(8))
                bus.send(can.Message(arbitration_id=identifier, data=broken, is_extended_id=False), timeout=PATIENCE_S)


class ServerDoor(Door):
    """A door with a server process, which is interrupted at the end and must have printed no traceback."""

    has_server, access = True, ("--allow-commands",)
    ready, port = "", ""

    @contextmanager
    def serve(self, *options: str) -> Iterator[tuple[subprocess.Popen[str], Any]]:
        arguments = ("--listen", "127.0.0.1:0", "--connect", self.endpoint, "--wait-s", "600", *options)
        with processes.start_rig(self.name, *arguments, stderr=subprocess.STDOUT) as server:
            yield server, lambda: self.find_port(server)
            server.send_signal(signal.SIGINT)
            output, _ = server.communicate(timeout=PATIENCE_S)
            assert (server.returncode, "Traceback" in output) == (0, False), output

    def find_port(self, server: subprocess.Popen[str]) -> int:
        """Return the port, once the server has printed it; it does not before it has reached a rig."""
        if (port := vars(server).get("port")) is None:
            found = re.search(r"127\.0\.0\.1:(\d+)", processes.read_line(server, self.ready))
            assert found is not None
            port = vars(server)["port"] = int(found[1])
        return port

    def open(self, table: ChannelTable, address: Any, **settings: Any) -> Any:
        return self.client(table, address(), **settings)

    client: Any = None


class DaqmxDoor(ServerDoor):
    """NI-DAQmx over gRPC."""

    name, ready, client = "daqmx", "NI-DAQmx device", DaqmxClient
    stall_settings: ClassVar[dict[str, Any]] = {"buffer": 12_000}
    refusal = nidaqmx.DaqError, "-200022"

    def attack(self, address: Any, draw: random.Random, count: int) -> None:
        """Send bytes that are no gRPC, and random bytes as the request of each call."""
        names = [name for name in vars(NiDAQmxServicer) if not name.startswith("_")]
        for _ in range(20):
            with socket.create_connection(("127.0.0.1", address())) as link, contextlib.suppress(OSError):
                link.sendall(draw.randbytes(100))
        with grpc.insecure_channel(f"127.0.0.1:{address()}") as channel:
            for _ in range(count):
                call: Any = channel.unary_unary(f"/nidaqmx_grpc.NiDAQmx/{draw.choice(names)}")
                with contextlib.suppress(grpc.RpcError):
                    call(draw.randbytes(draw.randrange(60)), timeout=PATIENCE_S)


class FoxgloveDoor(ServerDoor):
    """Foxglove's WebSocket protocol."""

    continues = True
    name, ready, client = "foxglove", "ws://", FoxgloveReader
    stall_settings: ClassVar[dict[str, Any]] = {}
    stall_options = ("--view-rate-hz", "5000")
    stall_s = 6.0
    refusal = RefusedError, "--allow-commands"

    def attack(self, address: Any, draw: random.Random, count: int) -> None:
        """Send random bytes and texts, and requests of services with wrong lengths or contents."""
        operations = ("subscribe", "unsubscribe", "getParameters", "setParameters", "advertise")
        with FoxgloveClient(address()) as client:
            client.until(lambda: client.services)
            for number in range(count):
                kind = number % 5
                if kind == 0:
                    client.send(draw.randbytes(draw.randrange(200)), BINARY)
                elif kind == 1:
                    client.send(b"\x02" + draw.randbytes(draw.randrange(24)), BINARY)
                elif kind == 2:
                    client.send(draw.randbytes(draw.randrange(60)).hex().encode())
                elif kind == 3:
                    broken = (b"\xff" + draw.randbytes(30), b'{"force_n": 1e999}', b'{"a": 1, "a": 2}', b"[]", b"7")
                    assert client.call("hammer", draw.choice(broken))["op"] == "serviceCallFailure"
                else:
                    value: Any = draw.choice([None, -1, 2**70, "x" * 300, [[1]], {"id": {}}])
                    client.tell(op=draw.choice(operations), subscriptions=value, parameterNames=value, parameters=value)
            client.send(b"\x03" + b"\xff" * 40, BINARY)
            client.send(b'{"op": "' + b"\\u0000" * 20_000 + b'"}', TEXT)


class ModbusDoor(ServerDoor):
    """Modbus TCP."""

    continues = True
    name, ready, client = "modbus", "Modbus TCP at", ModbusReader
    stall_settings: ClassVar[dict[str, Any]] = {}
    stall_s = 0.3
    refusal = ModbusError, "1"

    def attack(self, address: Any, draw: random.Random, count: int) -> None:
        """Send requests with a wrong header, function, address, count or value."""
        from tests.unit.test_modbus import make_malformed

        for _ in range(count):
            with ModbusClient(address()) as hostile:
                hostile.link.sendall(make_malformed(draw))
                hostile.link.shutdown(1)
                with contextlib.suppress(OSError):
                    assert not (reply := hostile.link.recv(600)) or reply[7] & 0x80


DOORS = {door.name: door for door in (Door, CanDoor, DaqmxDoor, FoxgloveDoor, ModbusDoor)}
