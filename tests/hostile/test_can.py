"""Generated inputs for the interfaces of the CAN bus and of the instruments: frames, messages, requests, text.

Not allowed: an exception that escapes, a thread that ends, a value that is accepted though it is not exactly valid
(each interface has an independent check here, written from the protocol), delayed frames of the rig, growing memory.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import can  # noqa: TID253 - the subject
import numpy as np
import pytest

from drivers.can.bus import codec, endpoints
from drivers.can.bus.frame import find_fault, pack_records
from drivers.can.bus.hub import Hub
from drivers.can.bus.model import BusModel
from drivers.can.bus.outlets import slcan, socketcand
from drivers.can.bus.outlets.slcan import SlcanPort
from drivers.can.bus.outlets.socketcand import SocketcandServer
from drivers.can.gateway import Gateway
from drivers.can.interface import HubBus
from drivers.can.schedule import Schedule
from drivers.can.signals import KEY, MAX_LEAD, CommandKind, checksum, command_frame, default_messages
from drivers.instruments.common.protocol import Codec, ProtocolError
from drivers.instruments.twins import TWINS, Twins
from drivers.link.can import TO_INSTRUMENT, CanLink, CanNode
from drivers.link.frames import Deframer, encode_frame, unstuff
from drivers.link.port import MessagePort
from drivers.sources.can import CanSource
from rig.base import wire
from rig.channels.table import default_table
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.hostile import input_count
from tests.hostile.documents import generate_documents
from tests.unit import link_memory as memory
from tests.unit.instruments_fake import FakeRig
from tests.waiting import PATIENCE_S, until

THREADS = {"can gateway sends", "can gateway receives", "can gateway asks"}
pytestmark = [pytest.mark.wallclock, pytest.mark.timeout(3600)]
_channels = itertools.count()


def mutate(random: np.random.Generator, data: bytes) -> bytes:
    """Return the data with bits flipped or bytes changed, cut, added or repeated."""
    found = bytearray(data)
    for _ in range(random.integers(1, 4)):
        kind, place = random.integers(6), int(random.integers(len(found) + 1))
        if kind == 0 and place < len(found):
            found[place] ^= 1 << int(random.integers(8))
        elif kind == 1 and place < len(found):
            found[place] = int(random.choice((0, 1, 0x7F, 0x80, 0xFF, int(random.integers(256)))))
        elif kind == 2:
            del found[place:]
        elif kind == 3:
            found[place:place] = random.bytes(int(random.integers(1, 9)))
        elif kind == 4:
            found += found[:place]
        elif place < len(found):
            del found[place]
    return bytes(found[: 1 << 16])


# Commands in CAN frames.


class Rig:
    """A rig as a gateway uses it; accepts and stores every command."""

    def __init__(self, reply: Callable[[], bytes]) -> None:
        self.server = MemoryServer(cache=0)
        self.taken: list[tuple[str, dict[str, Any]]] = []
        self._reply = reply
        document = {"table": default_table().model_dump(mode="json"), "tick_rate_hz": 1_000_000}
        self.server.answer(wire.CATALOGUE, lambda _: wire.encode_document(document))
        for kind in CommandKind:
            name = kind.name.lower()
            self.server.answer(wire.command_key(name), lambda payload, name=name: self._take(name, payload))

    def _take(self, name: str, payload: bytes) -> bytes:
        self.taken.append((name, wire.decode_document(payload)))
        return self._reply()


def is_command(message: can.Message, last: int) -> bool:
    """Return whether a frame is exactly one that a controller sends, from the description in the DBC."""
    data = bytes(message.data)
    if message.is_extended_id or message.is_remote_frame or message.is_error_frame or message.is_fd or len(data) != 8:
        return False
    force, duration, direction = int.from_bytes(data[2:4], "little"), data[4], data[5]
    values: dict[CommandKind, dict[str, float]] = {
        CommandKind.HAMMER: {"force_n": force * 0.1, "duration_ms": duration * 0.25, "direction": direction * 1.5},
        CommandKind.SPEED: {"speed_hz": int.from_bytes(data[2:5], "little") * 0.001},
        CommandKind.RELEASE: {},
        CommandKind.STOP: {},
    }
    if data[0] not in set(CommandKind) or not 1 <= (data[1] - last) % 256 <= MAX_LEAD:
        return False
    kind = CommandKind(data[0])
    return (message.arbitration_id, data) == command_frame(kind, data[1], **values[kind])


def make_frame(random: np.random.Generator, last: int) -> can.Message:
    """Return a command frame, nearly a command frame, or any other frame."""
    kind = tuple(CommandKind)[random.integers(len(CommandKind))]
    counter = (last + int(random.integers(-3, MAX_LEAD + 4))) % 256
    most = {
        CommandKind.HAMMER: {"force_n": 6500, "duration_ms": 63, "direction": 360},
        CommandKind.SPEED: {"speed_hz": 16_000},
    }
    values = {name: float(random.uniform(0, end)) for name, end in most.get(kind, {}).items()}
    identifier, data = command_frame(kind, counter, **values)
    flags: dict[str, Any] = {"is_extended_id": False}
    choice = random.integers(10)
    if choice < 4:
        data = mutate(random, data)[:64]
    elif choice == 4:  # consistent except for one thing: fields outside their range, reserved bits, another key
        data = bytes([data[0], data[1], *random.bytes(4), KEY if random.random() < 0.8 else 0, 0])
        data = data[:7] + bytes([checksum(identifier, data)])
    elif choice == 5:
        data = random.bytes(int(random.integers(0, 65)))
    elif choice == 6:
        flags = {name: bool(random.integers(2)) for name in ("is_extended_id", "is_remote_frame", "is_error_frame")}
    if random.random() < 0.1:
        identifier = int(random.integers(1 << 29))
    if len(data) > 8 or random.random() < 0.05:
        flags |= {"is_fd": True, "is_remote_frame": False}
    if flags.get("is_remote_frame"):
        return can.Message(arbitration_id=identifier, dlc=len(data), **flags)
    return can.Message(arbitration_id=identifier, data=data, **flags)


REPLIES = (
    b'{"accepted":true,"id":1,"command":"x","tick":5,"time_s":1.5}',
    b'{"accepted":false,"error":"force_n must be","field":"force_n","must":"between 1 and 1000"}',
    b'{"accepted":false,"error":"no"}',
    b'{"accepted":false,"error":"x","field":"force_n","must":"9e999 -1e400"}',
    b'{"accepted":true}',
    b'{"accepted":1,"time_s":"x"}',
    b'{"accepted":true,"time_s":1e300}',
    b"[]", b"", b"\xff", b"[" * 3000,
)  # fmt: skip


def test_a_command_is_carried_out_only_where_its_frame_is_exactly_valid() -> None:
    random = np.random.default_rng(1)
    rig = Rig(lambda: REPLIES[0] if random.random() < 0.7 else REPLIES[random.integers(len(REPLIES))])
    channel = f"hostile-{next(_channels)}"
    with (
        can.Bus(channel, interface="virtual", ignore_config=True) as own,
        can.Bus(channel, interface="virtual", ignore_config=True) as other,
        Gateway(MemoryClient(rig.server), own, Schedule()) as gateway,
    ):
        valid = 0
        for number in range(input_count(3000)):
            message = make_frame(random, gateway.commands.counter)
            good = is_command(message, gateway.commands.counter)
            before = len(rig.taken)
            gateway.commands.take_message(message)
            if good:
                valid += 1
                until(lambda: len(rig.taken) > before and not gateway.commands.waiting)  # noqa: B023
            assert len(rig.taken) == before + good, message
            if number % 100 == 0:
                while other.recv(0) is not None:
                    pass
        assert valid > number // 10
        assert gateway.commands.accepted > 0
        assert gateway.commands.refused.total() > number // 10
        assert {thread.name for thread in threading.enumerate()} >= THREADS
        assert gateway.warnings() == []
        # The bus, and how the gateway's own thread handles its traffic.
        for _ in range(2000):
            with contextlib.suppress(can.CanError, ValueError):
                other.send(make_frame(random, gateway.commands.counter))
        before = len(rig.taken)
        time.sleep(0.3)
        until(lambda: not gateway.commands.waiting)
        identifier, data = command_frame(CommandKind.SPEED, gateway.commands.counter + 1, speed_hz=5.0)
        other.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        until(lambda: rig.taken[-1][1].get("speed_hz") == 5.0)


# Return the rig's publications as a gateway in another process would receive them.


def test_false_blocks_events_and_states_do_not_stop_a_gateway() -> None:
    random = np.random.default_rng(2)
    rig = Rig(lambda: REPLIES[0])
    channel = f"hostile-{next(_channels)}"
    keys = [*map(wire.sensor_key, default_table().groups), wire.EDGES, wire.EVENTS, wire.STATUS]
    block = wire.encode_block(wire.Block(0, 0, 20_000.0, 1e6, np.zeros((20, 4), np.int32)))
    events = [
        {"event": "hammer", "tick": 1, "time_s": 0.5, "force_n": 3.0},
        {"spin_hz": 6.0, "lateness_ms": {"p99": 1}},
    ]
    with (
        can.Bus(channel, interface="virtual", ignore_config=True) as own,
        can.Bus(channel, interface="virtual", ignore_config=True) as other,
        Gateway(MemoryClient(rig.server), own, Schedule(1000, 10_000)) as gateway,
    ):
        for number, document in enumerate(generate_documents(random, input_count(1000), events)):
            gateway.guard(gateway.unpack, keys[random.integers(len(keys))], document)
            gateway.guard(gateway.unpack, keys[random.integers(len(keys))], mutate(random, block))
            if number % 100 == 0:
                while other.recv(0) is not None:
                    pass
        assert {thread.name for thread in threading.enumerate()} >= THREADS
        # One quarter of the sending time.
        assert gateway.outbox.waiting <= 0.25 * 13_000 + 512
        identifier = default_messages().by_name["Heartbeat"].identifier
        while (found := other.recv(5.0)) is not None and found.arbitration_id != identifier:
            pass
        assert found is not None


# Messages and requests to the hub.


def make_offer(random: np.random.Generator, secret: bytes) -> tuple[bytes, list[codec.Record]]:
    """Return a datagram to the hub, and its frames if it is a valid offer."""
    rows = []
    for _ in range(random.integers(1, 20)):
        word = int(random.choice((0x10, 0x7FF, 0x800, 0x1FFFFFFF))) | int(
            random.choice((0, 0, 0, codec.EXTENDED, codec.REMOTE, codec.ERROR, codec.EXTENDED | codec.REMOTE))
        )
        length = int(random.choice((0, 1, 7, 8, 9, 12, 48, 63, 64, 200)))
        flags = int(random.choice((0, 0, 0, 1, 3, 7, 2, 16, 255)))
        rows.append(codec.Record(0, word, length, flags, int(random.integers(1 << 16)), random.bytes(min(length, 64))))
    message = codec.encode(pack_records(rows))
    kind = random.integers(8)
    if kind == 0:
        return mutate(random, secret + message), []
    if kind == 1:
        return random.bytes(16) + message, []
    if kind == 2:
        return secret + mutate(random, message), []
    return secret + message, rows


def test_hostile_messages_to_the_hub_have_no_effect_on_others() -> None:
    random = np.random.default_rng(3)
    examples: list[dict[str, Any]] = [
        {"endpoint": "a", "listen_only": True, "secret": "0" * 32},
        {"endpoint": "rig", "listen_only": True},
        {"endpoint": "rig", "secret": "0" * 32},
        {},
    ]
    with (
        Hub(BusModel("1M/8M"), "can0") as hub,
        HubBus(hub) as sender,
        HubBus(hub, rx_queue_size=10_000) as receiver,
        HubBus(hub) as villain,
    ):
        names = [sender.name, receiver.name, villain.name, "ghost", "", "x" * 100, "a/b"]
        for example in examples[1:3]:
            example["endpoint"] = sender.name
        secret = bytes.fromhex(villain.secret or "")
        requests = generate_documents(random, input_count(500), examples)
        got: list[int] = []
        strangers = sent = 0

        def read() -> None:
            nonlocal strangers
            while (item := receiver.recv(0)) is not None:
                if item.is_error_frame:
                    continue
                if item.arbitration_id == 1:
                    got.append(int.from_bytes(item.data, "big"))
                else:
                    strangers += 1
                    assert find_fault(codec.make_record(item)) is None

        for number, request in enumerate(requests):
            payload, _ = make_offer(random, secret)
            victim = names[random.integers(len(names))]
            # Under another client's name always with a wrong secret; under its own name at a rate that leaves the bus
            # some capacity.
            if victim == villain.name and hub.endpoints.waiting > 5:
                payload = payload[1:]
            hub.offer(victim, payload)
            if number % 3 == 0:
                hub.reply("join", b'{"endpoint": "ghost%d"}' % number)
            hub.reply(("join", "set", "flush", "status")[random.integers(4)], request)
            name = f"{names[random.integers(3, 7)]}{random.integers(3000)}"
            hub.record_token(f"rig/can/can0/node/{name}", random.random() < 0.7)
            with contextlib.suppress(codec.CodecError):
                villain.receive(codec.decode(payload[16:]))
            if number % 20 == 0:
                sender.send(
                    can.Message(arbitration_id=1, data=sent.to_bytes(4, "big"), is_extended_id=False),
                    timeout=PATIENCE_S,
                )
                sent += 1
                read()
        until(lambda: (read(), len(got) == sent)[1])
        assert got == list(range(sent))
        status = hub.status()
        counts = status["counts"]
        assert strangers > 10
        for name in ("malformed", "invalid", "refused", "forged", "strange", "evicted"):
            assert counts[name] > 3, name
        assert not any("failed" in text for text in hub.warnings())
        assert sum(row["name"] not in names[:3] for row in status["nodes"]) <= endpoints.MAX_ENDPOINTS
        assert len(hub.endpoints.tokens) <= 16 * endpoints.MAX_ENDPOINTS
        rows = {row["name"]: row for row in status["nodes"]}
        assert rows[sender.name]["listen_only"] is False
        assert rows[sender.name]["dropped"] == 0
        assert any(thread.name == "can hub can0" for thread in threading.enumerate())


# Text.


def parse_send(text: bytes) -> tuple[int, bool, bool, bytes | int] | None:
    """Return the frame of a socketcand `send` or `sendrtr`, from its documentation; None if it is not one."""
    if not text.isascii() or len(text) > 510 or not text.decode().isprintable():
        return None
    word, *rest = text.decode().split() or [""]
    if word not in ("send", "sendrtr") or len(rest) < 2:
        return None
    identifier, length, *data = rest
    extended = len(identifier) == 8
    if not re.fullmatch(r"[0-9A-Fa-f]{1,3}|[0-9A-Fa-f]{8}", identifier) or not re.fullmatch(
        r"[0-9A-Fa-f]{1,2}", length
    ):
        return None
    if int(identifier, 16) >= (1 << 29 if extended else 1 << 11) or int(length, 16) > 8:
        return None
    if not all(re.fullmatch(r"[0-9A-Fa-f]{1,2}", byte) for byte in data):
        return None
    if word == "sendrtr":
        return None if data else (int(identifier, 16), extended, True, int(length, 16))
    if len(data) != int(length, 16):
        return None
    return int(identifier, 16), extended, False, bytes(int(byte, 16) for byte in data)


def fields_of(message: can.Message) -> tuple[int, bool, bool, bytes | int]:
    remote = message.is_remote_frame
    return message.arbitration_id, message.is_extended_id, remote, message.dlc if remote else bytes(message.data)


def make_command_text(random: np.random.Generator) -> bytes:
    """Return the text of a command, without brackets."""
    word = ("send", "sendrtr", "subscribe", "unsubscribe", "echo", "statistics", "rawmode", "add", "open")[
        random.integers(9)
    ]
    length = int(random.integers(0, 10))
    digits = int(random.choice((1, 2, 3, 3, 3, 4, 8, 8)))
    identifier = f"{random.integers(1 << 32):x}"[-digits:].rjust(digits, "0")
    data = " ".join(f"{byte:x}" for byte in random.bytes(length))
    if word in ("send", "sendrtr"):
        text = f" {word} {identifier} {length} {data if word == 'send' else ''} "
    elif word in ("subscribe", "unsubscribe"):
        text = f" {word} 0 {random.integers(10**6)} {identifier} "
    else:
        text = f" {word} "
    return text.encode() if random.random() < 0.5 else mutate(random, text.encode())


def test_socketcand_text_gives_a_frame_only_if_valid() -> None:
    random = np.random.default_rng(4)
    frames = 0
    splitter = socketcand.Splitter()
    for _ in range(input_count(3000)):
        command = make_command_text(random).replace(b"<", b"").replace(b">", b"")
        stream, expected = b"<" + command + b">", parse_send(command)
        cut = int(random.integers(len(stream) + 1))
        found = [*splitter.feed(stream[:cut]), *splitter.feed(stream[cut:])]
        assert len(found) == 1
        words = (found[0] or "").split()
        frame_ = None
        if words and words[0] in ("send", "sendrtr"):
            with contextlib.suppress(codec.CodecError):
                frame_ = fields_of(socketcand.parse_frame(words[1:], remote=words[0] == "sendrtr"))
        assert frame_ == expected, command
        frames += expected is not None
    assert frames > 100
    for _ in range(input_count(3000)):
        for each in splitter.feed(
            random.choice((b"<", b">", b" ", b"x" * 600, b"\xff\0", b"send 1 0", random.bytes(9)))
        ):
            assert each is None or len(each) < 512
        assert len(splitter) <= 1024


class Flood:
    """Write given data to a descriptor and discard replies, as fast as possible."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self.seen = 0

    def write(self, data: bytes) -> None:
        rest = memoryview(data)
        deadline = time.monotonic() + PATIENCE_S
        while rest:
            assert time.monotonic() < deadline, "hangs"
            readable, writable, _ = select.select([self._descriptor], [self._descriptor], [], 1.0)
            if readable:
                self.seen += len(self._read())
            if writable:
                with contextlib.suppress(BlockingIOError):
                    rest = rest[os.write(self._descriptor, rest) :]

    def _read(self) -> bytes:
        # A port that drops its queue discards it between `select` and here.
        try:
            return os.read(self._descriptor, 1 << 16)
        except BlockingIOError:
            return b""

    def quiet(self, timeout_s: float = 0.3) -> bytes:
        """Return the last bytes received before `timeout_s` of silence."""
        last = b""
        while select.select([self._descriptor], [], [], timeout_s)[0]:
            last = (last + self._read())[-1000:]
        return last


def test_hostile_text_does_not_stop_a_socketcand_server() -> None:
    random = np.random.default_rng(5)
    with Hub(BusModel("1M"), "can0") as hub, HubBus(hub) as other:  # noqa: SIM117
        with SocketcandServer({"can0": lambda: HubBus(hub)}, port=0) as server:
            for _ in range(3):
                with socket.create_connection((server.host, server.port)) as client:
                    client.setblocking(False)
                    flood = Flood(client.fileno())
                    flood.write(b"< open can0 >< rawmode >")
                    for _ in range(input_count(1500) // 30):
                        texts = [b"<" + make_command_text(random) + b">" for _ in range(10)]
                        flood.write(mutate(random, b"".join(texts)) if random.random() < 0.3 else b"".join(texts))
                        while (item := other.recv(0)) is not None:
                            assert item.is_error_frame or find_fault(codec.make_record(item)) is None
                    flood.quiet()
                    flood.write(b">< statistics 0 ><>< echo >")
                    assert flood.quiet().endswith(b"< echo >")
            until(lambda: server.counts()["clients"] == 0)
            assert server.counts()["malformed"] > 10
            assert server.warnings() == []


def parse_line(line: bytes) -> tuple[Any, ...] | None:
    """Return the frame of an SLCAN line, from the manuals; None if it is not one."""
    match = re.fullmatch(
        rb"(?:([tdbr])([0-9A-Fa-f]{3})|([TDBR])([0-9A-Fa-f]{8}))([0-9A-Fa-f])((?:[0-9A-Fa-f]{2})*)", line
    )
    if match is None:
        return None
    kind, extended = (match[1] or match[3]).decode(), match[3] is not None
    identifier, code, data = int(match[2] or match[4], 16), int(match[5], 16), bytes.fromhex(match[6].decode())
    fd, remote = kind in "dDbB", kind in "rR"
    if identifier >= (1 << 29 if extended else 1 << 11) or (code > 8 and not fd):
        return None
    if len(data) != (0 if remote else (*range(9), 12, 16, 20, 24, 32, 48, 64)[code]):
        return None
    return identifier, extended, remote, fd, kind in "bB", code if remote else data


def a_line(random: np.random.Generator) -> bytes:
    kind = "tTrRdDbBOLCSVNFZMmU"[random.integers(19)]
    digits = 8 if kind.isupper() else 3
    code = int(random.integers(16))
    length = (*range(9), 12, 16, 20, 24, 32, 48, 64)[code]
    identifier = f"{random.integers(1 << 29):0{digits}X}"[-digits:]
    line = f"{kind}{identifier}{code:X}{'' if kind in 'rR' else random.bytes(length).hex().upper()}".encode()
    return line if random.random() < 0.5 else mutate(random, line)


def test_slcan_lines_give_a_frame_only_if_valid() -> None:
    random = np.random.default_rng(6)
    lines = slcan.Lines()
    frames = 0
    for _ in range(input_count(3000)):
        line = a_line(random).replace(b"\r", b"").replace(b"\n", b"")
        (text,) = lines.feed(line + b"\r")
        found = None
        if text:
            with contextlib.suppress(codec.CodecError):
                message = slcan.parse(text)
                found = (
                    *fields_of(message)[:3], message.is_fd, message.bitrate_switch, fields_of(message)[3]
                )  # fmt: skip
        assert found == (None if len(line) > 160 else parse_line(line)), line
        frames += found is not None
    assert frames > 100
    with Hub(BusModel("1M/8M"), "can0") as hub, HubBus(hub) as other, SlcanPort(lambda: HubBus(hub)) as port:
        descriptor = os.open(port.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            flood = Flood(descriptor)
            for _ in range(input_count(1500) // 10):
                flood.write(b"\r".join(a_line(random) for _ in range(10)) + b"\r")
                while (item := other.recv(0)) is not None:
                    assert item.is_error_frame or find_fault(codec.make_record(item)) is None
            flood.write(b"\r\rC\r")
            flood.quiet()
            flood.write(b"V\r")
            assert flood.quiet().endswith(b"V0101\r")
            assert port.warnings() == []
        finally:
            os.close(descriptor)


# Instruments.


def make_request(random: np.random.Generator, codec: Codec) -> bytes:
    """Return a valid request, one with other values, or one that is nearly valid."""
    kinds = list(codec.kinds)
    code = kinds[random.integers(len(kinds))] if random.random() < 0.9 else int(random.integers(256))
    head = struct.pack("<BBBI", 1, codec.address.number, code, int(random.integers(1 << 32)))
    kind, layout = codec.kinds.get(code, (None, struct.Struct("<")))
    doubles = (0.0, 1.0, 100.0, 1e300, -1.0, float("nan"), float("inf"), 5e-324, 20_000.0, 1000.0)
    body = b""
    for each in layout.format.strip("<"):
        value = doubles[random.integers(len(doubles))] if each == "d" else int.from_bytes(random.bytes(8), "little")
        if each != "d":
            size = struct.calcsize("<" + each)
            value = int.from_bytes(
                random.bytes(size) if random.random() < 0.7 else bytes(size), "little", signed=each == "q"
            )
        body += struct.pack("<" + each, value)
    if kind is not None and kind.LAST_FIELD is not None:
        texts = (b"x", b"nan", b"1e5", b"-y", b"\xff", b"\0\x1b[2J", "é".encode(), b"1_0", random.bytes(24), b"9" * 400)
        body += texts[random.integers(len(texts))]
    return head + body if random.random() < 0.6 else mutate(random, head + body)


def test_instruments_reply_to_all_requests_and_execute_valid_ones_only() -> None:
    random = np.random.default_rng(7)
    rig = FakeRig(MemoryServer())
    with Twins(MemoryClient(rig.server)) as twins:
        served = [twins.serve(kind, MessagePort(memory.make_pair()[0], "memory:")) for kind in TWINS]
        for number in range(input_count(3000)):
            twin = served[random.integers(len(served))]
            request, before = make_request(random, twin.CODEC), len(rig.commands)
            _, reply = twin.CODEC.decode(twin.answer(request))
            try:
                sequence, message = twin.CODEC.decode(request)
            except ProtocolError:
                assert type(reply).__name__ == "Refused"
                assert len(rig.commands) == before
            else:
                # The data read must equal the data stored, to the byte.
                assert twin.CODEC.encode(message, sequence) == request
                assert len(rig.commands) == before + (type(reply).__name__ == "Done")
            if number % 500 == 0:
                rig.publish("probes", "forces", "accelerations", "drive", "hammer")
        assert len(rig.commands) > 10
        rig.commands.clear()
    for kind in TWINS:
        with pytest.raises(ProtocolError):
            kind.CODEC.decode(b"")


def test_frames_of_a_serial_line_are_whole_or_dropped() -> None:
    random = np.random.default_rng(8)
    deframer = Deframer(1000)
    frame_count = 0
    for _ in range(input_count(3000)):
        message = random.bytes(int(random.integers(0, 1200)))
        line = encode_frame(message) if random.random() < 0.3 else mutate(random, encode_frame(message))
        good = []
        for part in line.split(b"\0"):
            with contextlib.suppress(ValueError):
                data = unstuff(part)
                if len(data) >= 2 and len(data) <= 1002 and _crc(data) == 0:
                    good.append(data[:-2])
        cut = int(random.integers(len(line) + 1))
        found = [*deframer.feed(b"\0" + line[:cut]), *deframer.feed(line[cut:] + b"\0")]
        assert found == good
        frame_count += len(found)
        assert len(deframer) <= 1100
    assert frame_count > 500


def _crc(data: bytes) -> int:
    """Divide the data, as one number, by the CCITT polynomial and return the remainder."""
    value = int.from_bytes(data, "big") << 16
    while (excess := value.bit_length() - 17) >= 0:
        value ^= 0x11021 << excess
    return value


def test_instruments_on_a_bus_survive_hostile_transport_frames() -> None:
    random = np.random.default_rng(9)
    channel = f"hostile-{next(_channels)}"
    rig = FakeRig(MemoryServer())
    with Twins(MemoryClient(rig.server)) as twins, can.Bus(channel, interface="virtual", ignore_config=True) as villain:
        twins.serve_can(f"virtual:{channel}")
        identifiers = [TO_INSTRUMENT + kind.CODEC.address.number for kind in TWINS]
        for number in range(input_count(1000)):
            data = random.bytes(int(random.integers(0, 9)))
            if data and random.random() < 0.8:
                # Single, first and consecutive frames and flow control of ISO 15765-2, with wrong lengths.
                data = (
                    bytes([int(random.choice((0x00, 0x07, 0x08, 0x10, 0x1F, 0x21, 0x30, 0x31, 0x32, 0xF0)))]) + data[1:]
                )
            villain.send(
                can.Message(
                    arbitration_id=identifiers[random.integers(len(identifiers))],
                    data=data, is_extended_id=bool(random.random() < 0.02),
                )
            )  # fmt: skip
            if number % 200 == 0:
                time.sleep(0.02)
            while villain.recv(0) is not None:
                pass
        assert len(rig.commands) == 0
        codec = TWINS[0].CODEC
        link = CanLink(f"virtual:{channel}", codec.address)
        try:

            def identified() -> bool:
                with contextlib.suppress(ConnectionError):
                    link.send(codec.encode(codec.kinds[1][0](), 77), timeout_s=1.0)
                    while (reply := link.receive(timeout_s=1.0)) is not None:
                        if codec.decode(reply)[0] == 77:
                            return True
                return False

            until(identified)
        finally:
            link.close()


# A DAQ on the bus.


def test_false_frames_do_not_stop_a_daq_and_are_counted() -> None:
    random = np.random.default_rng(10)
    channel = f"hostile-{next(_channels)}"
    table = default_messages()
    source = CanSource(f"virtual:{channel}")
    blocks: list[Any] = []
    ended: list[str] = []
    try:
        with can.Bus(channel, interface="virtual", ignore_config=True) as rig:

            def say(name: str, **raw: int) -> None:
                row = table.by_name[name]
                rig.send(can.Message(arbitration_id=row.identifier, data=row.encode(**raw), is_extended_id=False))

            say("Clock", seconds=0)
            say("Rates", rate=20_000, fd_step=0, classic_step=20, latency=0)
            say("Sync", index=0, time=0)
            say("Samples_1", index=0)
            names = list(source.streams())
            source.start(names, None, lambda name, samples: blocks.append(samples), lambda name, why: ended.append(why))
            rows = [row for row in table.messages if row.name not in ("Rates", "Heartbeat")]
            for number in range(input_count(3000)):
                row = rows[random.integers(len(rows))]
                size = row.length if random.random() < 0.7 else int(random.integers(9))
                source.take(row.identifier, random.bytes(size))
                if number % 50 == 0:
                    say("Sync", index=0, time=0)  # otherwise it assumes that the rig has ended
                    source.take(int(random.integers(1 << 11)), random.bytes(8))
                    source.deliver()
                    blocks.clear()
            for _ in range(200):
                source.take(table.by_name["Rates"].identifier, random.bytes(8))
                source.take(table.by_name["Samples_1"].identifier, random.bytes(table.by_name["Samples_1"].length))
                source.deliver()
            assert source.statistics["malformed"] > 10
            say("Rates", rate=20_000, fd_step=0, classic_step=20, latency=0)
            until(lambda: source.rates is not None and source.rates["rate"] == 20_000)
            before = len(blocks)
            say("Samples_1", index=500)
            until(lambda: len(blocks) > before)
            assert not ended
            assert any(
                thread.name.startswith("can ") and thread.name.endswith(" reads") for thread in threading.enumerate()
            )
    finally:
        source.close()


def test_a_node_for_links_outlives_frames_of_all_kinds() -> None:
    random = np.random.default_rng(11)
    channel = f"hostile-{next(_channels)}"
    received: list[can.Message] = []
    node = CanNode(f"virtual:{channel}", [0x601])
    try:
        node.listen(0x601, received.append)
        with can.Bus(channel, interface="virtual", ignore_config=True) as villain:
            for _ in range(input_count(1000)):
                villain.send(make_frame(random, 0))
            villain.send(can.Message(arbitration_id=0x601, data=b"end", is_extended_id=False))
            until(lambda: bool(received) and bytes(received[-1].data) == b"end")
        assert {frame.arbitration_id for frame in received} == {0x601}
    finally:
        node.close()
