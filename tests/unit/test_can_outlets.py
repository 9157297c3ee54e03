"""A bus for programs without zenoh: socketcand and SLCAN, with python-can's own interfaces as clients."""

from __future__ import annotations

import contextlib
import os
import random
import re
import select
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any

import can  # noqa: TID253 - the subject
import pytest
from can.bus import BusState  # noqa: TID253
from can.interfaces.slcan import slcanBus  # noqa: TID253
from can.interfaces.socketcand.socketcand import SocketCanDaemonBus  # noqa: TID253

from drivers.can.bus import codec
from drivers.can.bus.codec import CodecError
from drivers.can.bus.hub import Hub
from drivers.can.bus.model import BusModel
from drivers.can.bus.outlets import slcan, socketcand
from drivers.can.bus.outlets.outlet import Outlet
from drivers.can.bus.outlets.slcan import Lines, SlcanPort
from drivers.can.bus.outlets.socketcand import SocketcandServer, Splitter
from drivers.can.bus.timing import speed
from drivers.can.interface import HubBus
from drivers.instruments.twins import Twins
from rig.base.errors import InputError
from rig.cli.commands.run import run
from rig.cli.connections.can_outlets import CanOutlets
from rig.cli.connections.can_output import CanOptions, CanOutput
from rig.cli.groups import expand_groups
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.processes import free_endpoint
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.wallclock


class Bench:
    """A bus, and everything that is opened on it."""

    def __init__(self, way: str, rate: str = "1M/8M") -> None:
        self.stack = ExitStack()
        if way == "hub":
            self.hub = self.stack.enter_context(Hub(BusModel(rate), "can0"))
            self.open: Callable[..., can.BusABC] = partial(HubBus, self.hub)
        else:
            self.open = partial(can.Bus, interface="virtual", channel=uuid.uuid4().hex)

    def bus(self, **settings: Any) -> can.BusABC:
        return self.stack.enter_context(self.open(**settings))

    def serve(self, **settings: Any) -> SocketcandServer:
        return self.stack.enter_context(SocketcandServer({"can0": self.open}, port=0, **settings))

    def port(self, **settings: Any) -> SlcanPort:
        return self.stack.enter_context(SlcanPort(self.open, **settings))

    def socketcand(self, server: SocketcandServer) -> Any:
        return self.stack.enter_context(SocketCanDaemonBus("can0", server.host, server.port, tcp_tune=True))

    def slcan(self, port: SlcanPort, **settings: Any) -> Any:
        """Open a python-can SLCAN bus, which must be closed before the port."""
        bus = slcanBus(port.path, sleep_after_open=0, **settings)
        until(lambda: port.figures()["open"] == 1)
        return bus

    def raw(self, server: SocketcandServer) -> Text:
        return self.stack.enter_context(Text(server))


class Text:
    """A client that sends text and checks the replies."""

    def __init__(self, server: SocketcandServer) -> None:
        self.socket = socket.socket()
        # A small buffer, so that unread data is noticed soon.
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.socket.settimeout(PATIENCE_S)
        self.socket.connect((server.host, server.port))
        self.seen = ""

    def __enter__(self) -> Text:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, text: str) -> None:
        self.socket.sendall(text.encode())

    def next(self) -> str:
        while ">" not in self.seen:
            more = self.socket.recv(4096).decode()
            if not more:
                return ""
            self.seen += more
        text, _, self.seen = self.seen.partition(">")
        return text.lstrip() + ">"

    def ask(self, text: str) -> str:
        self.send(text)
        return self.next()


class Terminal:
    """A program that writes lines to a port and checks the replies."""

    def __init__(self, port: SlcanPort) -> None:
        self.descriptor = os.open(port.path, os.O_RDWR | os.O_NOCTTY)
        self.seen = b""

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.descriptor)

    def next(self, *, timeout_s: float = 5.0) -> bytes:
        """Return the next line or bell; empty after the timeout."""
        while not (match := re.match(rb"[^\r\a]*[\r\a]", self.seen)):
            if not select.select([self.descriptor], [], [], timeout_s)[0]:
                return b""
            self.seen += os.read(self.descriptor, 4096)
        self.seen = self.seen[match.end() :]
        return match[0]

    def ask(self, line: str) -> bytes:
        os.write(self.descriptor, line.encode() + b"\r")
        return self.next()


@pytest.fixture(params=["hub", "virtual"])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    bench = Bench(request.param)
    with bench.stack:
        yield bench


@pytest.fixture
def hub_bench() -> Iterator[Bench]:
    bench = Bench("hub")
    with bench.stack:
        yield bench


def message(identifier: int = 0x123, data: bytes = b"abc", **settings: Any) -> can.Message:
    settings.setdefault("is_extended_id", False)
    return can.Message(arbitration_id=identifier, data=data, check=True, **settings)


CLASSIC = [
    message(),
    message(0, b""),
    message(0x7FF, bytes(range(8))),
    message(0x1FFFFFFF, b"\x00\xff", is_extended_id=True),
    message(1, b"low", is_extended_id=True),
]
REMOTE = [
    can.Message(arbitration_id=0x321, is_extended_id=False, is_remote_frame=True, dlc=5, check=True),
    can.Message(arbitration_id=0x321, is_remote_frame=True, dlc=0, check=True),
]
FD = [
    message(0x10, bytes(range(64)), is_fd=True, bitrate_switch=True),
    message(0x11, bytes(range(12)), is_fd=True),
    message(0x12, b"", is_fd=True),
    message(0x12345, bytes(48), is_fd=True, bitrate_switch=True, is_extended_id=True),
    message(0x1, bytes(7), is_fd=True, is_extended_id=True),
]


def same(one: can.Message, other: can.Message) -> bool:
    return one.equals(other, timestamp_delta=None, check_channel=False, check_direction=False)


def read(bus: can.BusABC, count: int, *, timeout_s: float = 5.0) -> list[can.Message]:
    found = []
    for _ in range(count):
        item = bus.recv(timeout_s)
        assert item is not None
        found.append(item)
    return found


def alike(sent: list[can.Message], found: list[can.Message]) -> bool:
    return len(sent) == len(found) and all(same(*pair) for pair in zip(sent, found, strict=True))


# socketcand.


def test_python_cans_socketcand_client_sends_and_receives(bench: Bench) -> None:
    other, server = bench.bus(), bench.serve()
    client = bench.socketcand(server)
    for each in CLASSIC:
        client.send(each)
        assert alike([each], read(other, 1))
    before = time.time()
    for each in CLASSIC:
        # One by one: on the hub's bus, waiting frames are sent in the order of their identifiers.
        other.send(each)
        (found,) = read(client, 1)
        assert same(each, found)
        assert before - 1 < found.timestamp < time.time() + 1
    assert client.recv(0.05) is None  # Not its own.
    assert server.counts() == dict.fromkeys(server.counts(), 0) | {"clients": 1}


def test_clients_of_one_server_receive_each_others_frames(bench: Bench) -> None:
    server = bench.serve()
    clients = [bench.socketcand(server) for _ in range(3)]
    clients[0].send(CLASSIC[0])
    for other in clients[1:]:
        assert alike([CLASSIC[0]], read(other, 1))
    assert clients[0].recv(0.05) is None


def test_the_words_of_the_protocol(bench: Bench) -> None:
    other, server = bench.bus(), bench.serve()
    client = bench.raw(server)
    assert client.next() == "< hi >"
    assert client.ask("< echo >") == "< echo >"
    assert client.ask("< open can0 >") == "< ok >"
    other.send(message(0x7))
    until(lambda: server.clients[0].traffic[1] == 1)
    assert client.ask("<echo>") == "< echo >"  # Frames come in raw mode, or when subscribed to.
    assert client.ask("< controlmode >< rawmode >") == "< ok >"
    assert client.next() == "< ok >"
    client.send("< send 123 2 1 F1 >< send 1AAAAAAA 0 >\n< sendrtr 123 4 >")
    found = sorted(read(other, 3), key=lambda found: (found.is_extended_id, found.is_remote_frame))
    assert alike(
        [
            message(0x123, b"\x01\xf1"),
            can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=4),
            message(0x1AAAAAAA, b"", is_extended_id=True),
        ],
        found,
    )
    for each, shown in [
        (message(0x12, b"\x01\xab"), r"< frame 012 \d+\.\d{6} 01AB >"),
        (message(0x12, b"", is_extended_id=True), r"< frame 00000012 \d+\.\d{6}  >"),
        (REMOTE[0], r"< rtr 321 \d+\.\d{6} 5 >"),
    ]:
        other.send(each)
        assert re.fullmatch(shown, client.next())
    client.send("< statistics 20 >")
    assert client.next() == "< stat 5 4 2 3 >"
    client.send("< statistics 0 >")


def test_subscriptions(bench: Bench) -> None:
    other, client = bench.bus(), bench.raw(bench.serve())
    client.next()
    client.send("< open can0 >< subscribe 0 0 123 >< subscribe 3600 0 00000005 >< unsubscribe 7 >< echo >")
    assert [client.next(), client.next()] == ["< ok >", "< echo >"]
    for identifier, extended in [(0x5, True), (0x5, True), (0x5, False), (0x123, True), (0x123, False), (0x123, False)]:
        other.send(message(identifier, b"", is_extended_id=extended))
        time.sleep(0.01)
    assert [client.next().split()[2] for _ in range(3)] == ["00000005", "123", "123"]


@pytest.mark.parametrize(
    "command",
    [
        "< send >",
        "< send 123 >",
        "< send 123 9 1 2 3 4 5 6 7 8 9 >",
        "< send 123 2 1 >",
        "< send 123 1 1 2 >",
        "< send 800 0 >",
        "< send 20000000 0 >",
        "< send 1234 0 >",
        "< send 0x1 0 >",
        "< send 123 1 100 >",
        "< send 123 1 -1 >",
        "< send 123 40 " + "AA " * 64 + ">",
        "< sendrtr 123 2 1 2 >",
        "< add 1 0 123 0 >",
        "< isotpmode >",
        "< statistics -1 >",
        "< statistics 1 >",
        "< statistics 9999999999 >",
        "< open can0 >",
        "< >",
        "<>",
        "< send\x00 123 0 >",
        "rubbish < echo>",
        "< " + "x" * 5000,
        "\xff\xfe",
    ],
)
def test_an_invalid_command_gets_an_error_reply(command: str) -> None:
    bench = Bench("virtual")
    with bench.stack:
        other, server = bench.bus(), bench.serve()
        client = bench.raw(server)
        client.next()
        client.ask("< open can0 >")
        assert re.fullmatch(r"< error 000 \d+\.\d{6} [^<>]+ >", client.ask(command))
        client.send(" < send 1 0 >")
        assert alike([message(1, b"")], read(other, 1))
        until(lambda: server.counts()["malformed"] >= 1)


def test_before_a_bus_is_open(bench: Bench) -> None:
    server = bench.serve()
    client = bench.raw(server)
    client.next()
    assert client.ask("< rawmode >").startswith("< error 000")
    assert client.ask("< open can7 >") == "< error could not open bus >"
    assert client.next() == ""
    until(lambda: server.counts()["clients"] == 0)


def test_fd_frames_are_skipped_and_counted(bench: Bench) -> None:
    other, server = bench.bus(), bench.serve()
    client = bench.socketcand(server)
    other.send(FD[0])
    other.send(CLASSIC[0])
    assert alike([CLASSIC[0]], read(client, 1))
    assert server.counts()["fd_left_out"] == 1
    # A bad frame from the client causes an error, which its reader handles as an error frame before it continues.
    client.send(FD[0])
    assert read(client, 1)[0].is_error_frame
    other.send(CLASSIC[0])
    assert alike([CLASSIC[0]], read(client, 1))


def test_error_frames_reach_the_client(hub_bench: Bench) -> None:
    other, server = hub_bench.bus(), hub_bench.serve()
    client = hub_bench.socketcand(server)
    (outlet,) = server.clients
    outlet.put(outlet.show_frame(codec.make_message(codec.error_record(10**9, codec.BUS_OFF))) or b"")
    other.send(CLASSIC[0])
    first, second = read(client, 2)
    assert first.is_error_frame
    assert first.arbitration_id == codec.BUS_OFF
    assert first.timestamp == 1.0
    assert same(second, CLASSIC[0])


def test_a_stalled_client_is_dropped_while_others_receive_all_frames() -> None:
    bench = Bench("virtual")
    with bench.stack:
        other, server = bench.bus(), bench.serve(room=100, patience_s=0.3)
        stalled, good = bench.raw(server), bench.socketcand(server)
        stalled.next()
        assert stalled.ask("< open can0 >") == "< ok >"
        assert stalled.ask("< rawmode >") == "< ok >"
        sent = got = 0
        deadline = time.monotonic() + PATIENCE_S
        while server.counts()["given_up"] == 0 and time.monotonic() < deadline:
            for _ in range(20):
                other.send(message(0x100, sent.to_bytes(8, "big")))
                sent += 1
            for found in read(good, 20):
                assert int.from_bytes(found.data, "big") == got
                got += 1
        counts = server.counts()
        assert got == sent
        assert counts["given_up"] == 1
        assert counts["dropped"] > 0
        until(lambda: server.counts()["clients"] == 1)


def test_a_client_that_reads_no_replies_is_no_longer_served() -> None:
    bench = Bench("virtual")
    with bench.stack:
        server = bench.serve(room=100, patience_s=0.3)
        client = bench.raw(server)
        client.socket.settimeout(PATIENCE_S)
        with contextlib.suppress(ConnectionError):
            for _ in range(100_000):
                client.send("< echo >" * 1000)
        assert server.counts()["given_up"] == 1


def test_a_killed_client_leaves_the_bus_and_clients_are_limited() -> None:
    bench = Bench("hub")
    with bench.stack:
        server = bench.serve()
        clients = [bench.raw(server) for _ in range(socketcand.MAX_CLIENTS)]
        for client in clients:
            client.next()
            assert client.ask("< open can0 >") == "< ok >"
        assert len(bench.hub.status()["nodes"]) == socketcand.MAX_CLIENTS
        assert bench.raw(server).next() == "< error too many clients >"
        for client in clients:
            client.socket.close()
        until(lambda: server.counts() == dict.fromkeys(server.counts(), 0) | {"turned_away": 1})
        until(lambda: not bench.hub.status()["nodes"])
        assert bench.socketcand(server)


def test_random_bytes_have_no_effect() -> None:
    random_ = random.Random(4)
    bench = Bench("virtual")
    with bench.stack:
        other, server = bench.bus(), bench.serve()
        client = bench.raw(server)
        client.next()
        client.ask("< open can0 >")
        words = [b"<", b">", b" ", b"send", b"123", b"rawmode", b"0", b"\xff", b"\n", b"subscribe", b"x" * 600]
        client.socket.settimeout(0.01)
        for _ in range(300):
            client.socket.sendall(b"".join(random_.choices(words, k=20)))
            with contextlib.suppress(TimeoutError):
                client.socket.recv(1 << 16)
        good = bench.socketcand(server)
        good.send(CLASSIC[0])
        until(lambda: any(same(CLASSIC[0], found) for found in iter(lambda: other.recv(0), None)))
        assert server.counts()["clients"] >= 1


def test_a_server_listens_on_this_machine_only() -> None:
    with pytest.raises(InputError, match=r"socketcand must be on 127\.0\.0\.1, .*ssh -L 29536:127.*'0\.0\.0\.0:29536'"):
        SocketcandServer({}, host="0.0.0.0", port=0)
    with SocketcandServer({}, port=0) as server:
        assert server.host == "127.0.0.1"
        with pytest.raises(InputError, match="free"):
            SocketcandServer({}, port=server.port)


@pytest.mark.parametrize("place", ["0.0.0.0:29536", "192.0.2.1:29536", "[::]:29536", "example.org:29536"])
def test_no_port_of_the_bus_is_open_to_other_machines(place: str) -> None:
    from rig.cli.commands.can import hub

    loopback = (
        r"must be on 127\.0\.0\.1, since there is no password; from another machine: ssh -L 29536:127.0.0.1:29536 "
    )
    for opening in (
        lambda: expand_groups(run)("hammer", can="virtual:x", can_socketcand=place, listen=free_endpoint()),
        lambda: CanOutput("virtual:x", CanOptions(can_socketcand=place)),
        lambda: CanOutlets({}, speed("1M"), socketcand=place),
        lambda: expand_groups(run)("hammer", can=f"zenoh:can0?endpoint={place}", listen=free_endpoint()),
        lambda: hub(["can0"], socketcand=place),
        lambda: hub(["can0"], listen=place),
        lambda: Twins(MemoryClient(MemoryServer())).serve_zenoh(place),
    ):
        with pytest.raises(InputError, match=loopback):
            opening()


@pytest.mark.parametrize("size", [1, 2, 7, 1000])
def test_commands_may_arrive_in_any_portions(size: int) -> None:
    text = b"x< hi ><echo>\n < send 1 0 > y z < " + b"a" * 600 + b"> < end >"
    splitter = Splitter()
    found = [each for k in range(0, len(text), size) for each in splitter.feed(text[k : k + size])]
    assert [each.split() for each in found if each is not None] == [["hi"], ["echo"], ["send", "1", "0"], ["end"]]
    assert found[0] is None
    assert None in found[4:-1]


def test_text_form_of_a_frame() -> None:
    for each in CLASSIC:
        digits = 8 if each.is_extended_id else 3
        words = [f"{each.arbitration_id:0{digits}X}", f"{len(each.data)}", *(f"{byte:x}" for byte in each.data)]
        assert same(socketcand.parse_frame(words), each)
    with pytest.raises(CodecError):
        socketcand.parse_frame([])
    assert socketcand.show(FD[0]) is None


# SLCAN.


def test_python_cans_slcan_client_sends_and_receives(bench: Bench) -> None:
    other, port = bench.bus(), bench.port(speed=speed("1M/8M"))
    with bench.slcan(port, bitrate=1_000_000) as client:
        for each in CLASSIC + REMOTE + FD:
            client.send(each)
            assert alike([each], read(other, 1))
            other.send(each)
            assert alike([each], read(client, 1))
        assert client.recv(0.05) is None
        assert client.get_version(5.0) == (1, 1)
        assert client.get_serial_number(5.0) == "RIG0"
    until(lambda: port.figures()["open"] == 0)


def test_a_port_serves_one_program_after_another(bench: Bench) -> None:
    other, port = bench.bus(), bench.port()
    for _ in range(2):
        with bench.slcan(port) as client:
            other.send(CLASSIC[0])
            assert alike([CLASSIC[0]], read(client, 1))
        until(lambda: port.figures()["open"] == 0)


def test_answers_of_the_adapter(bench: Bench) -> None:
    other, port = bench.bus(), bench.port(speed=speed("1M/8M"))
    with Terminal(port) as terminal:
        answers = {
            "": b"\r",
            "V": b"V0101\r",
            "N": b"NRIG0\r",
            "C": b"\r",
            "F": b"\a",
            "t1230": b"\a",
            "S8": b"\r",
            "S6": b"\a",
            "S9": b"\a",
            "s0014": b"\r",  # 8 MHz, divided by 1, bits of 1 + 5 + 2 quanta.
            "s011C": b"\a",
            "Y8": b"\r",
            "Y2": b"\a",
            "U1": b"\r",
            "M00000000": b"\r",
            "mFFFFFFFF": b"\r",
            "m00000000": b"\a",
            "X0": b"\a",
            "Z0": b"\r",
            "Z2": b"\a",
            "?": b"\a",
            "\x00": b"\a",
            "\nO": b"\r",
        }
        assert {line: terminal.ask(line) for line in answers} == answers
        answers = {
            "O": b"\a",
            "S8": b"\a",
            "Z1": b"\a",
            "F": b"F00\r",
            "t12321122": b"\r",
            "t1232112": b"\a",
            "t12321": b"\a",
            "t8000": b"\a",
            "T200000000": b"\a",
            "t12391122334455667788AA": b"\a",
            "t1230AA": b"\a",
            "r1232AA": b"\a",
            "r1239": b"\a",
            "t" + "1" * 1000: b"\a",
            "R000001238": b"\r",
            "d1239" + "AB" * 12: b"\r",
            "d1239" + "AB" * 11: b"\a",
            "b123F" + "ab" * 64: b"\r",
        }
        assert {line: terminal.ask(line) for line in answers} == answers
        found = read(other, 4)
        assert sorted(len(each.data) for each in found) == [0, 2, 12, 64]
        assert terminal.ask("C") == b"\r"


def test_a_classic_bus_has_no_fd_frames() -> None:
    bench = Bench("hub", "500k")
    with bench.stack, Terminal(bench.port(speed=speed("500k"))) as terminal:
        answers = [terminal.ask(line) for line in ("S6", "Y5", "O", "d1230", "t1230", "C")]
        assert answers == [b"\r", b"\a", b"\r", b"\a", b"\r", b"\r"]


def test_time_stamps_are_milliseconds_of_the_minute(bench: Bench) -> None:
    other, port = bench.bus(), bench.port()
    with Terminal(port) as terminal:
        assert [terminal.ask("Z1"), terminal.ask("O")] == [b"\r", b"\r"]
        other.send(CLASSIC[0])
        line = terminal.next()
        now = time.time() * 1000 % 60_000
        assert re.fullmatch(rb"t1233616263[0-9A-F]{4}\r", line)
        assert (now - int(line[-5:-1], 16)) % 60_000 < 5000
        assert [terminal.ask("C"), terminal.ask("Z0"), terminal.ask("O")] == [b"\r"] * 3
        other.send(CLASSIC[0])
        assert terminal.next() == b"t1233616263\r"
    # python-can's client has no use for them, and reads only what precedes.
    port.close()


def test_listening_only_sends_nothing(bench: Bench) -> None:
    other, port = bench.bus(), bench.port()
    with Terminal(port) as terminal:
        assert [terminal.ask("L"), terminal.ask("t1230")] == [b"\r", b"\a"]
        if hasattr(bench, "hub"):
            assert port.bus is not None
            assert port.bus.state is BusState.PASSIVE
        other.send(CLASSIC[0])
        assert terminal.next() == b"t1233616263\r"
        assert other.recv(0.05) is None


def test_status_flags_agree_with_error_frames(bench: Bench) -> None:
    port = bench.port()
    with Terminal(port) as terminal:
        terminal.ask("O")
        for record, flags in [
            (codec.make_overflow(0), 0x09),
            (codec.error_record(0, codec.CONTROLLER, data=bytes((0, 0x20, 0, 0, 0, 0, 0, 0))), 0x20),
            (codec.error_record(0, codec.BUS_ERROR | codec.PROTOCOL), 0x80),
            (codec.error_record(0, codec.BUS_OFF), 0xA0),
        ]:
            assert port.show_frame(codec.make_message(record)) is None
            assert terminal.ask("F") == b"F%02X\r" % flags
            assert terminal.ask("F") == b"F00\r"


def test_a_program_that_stops_reading_loses_frames_and_its_channel(hub_bench: Bench) -> None:
    other, port = hub_bench.bus(), hub_bench.port(room=50, patience_s=0.3)
    with Terminal(port) as terminal:
        terminal.ask("O")
        deadline = time.monotonic() + PATIENCE_S
        while port.figures()["given_up"] == 0 and time.monotonic() < deadline:
            for _ in range(100):
                other.send(CLASSIC[2], timeout=PATIENCE_S)
            time.sleep(0.02)
        figures = port.figures()
        assert (figures["given_up"], figures["open"]) == (1, 0)
        assert figures["dropped"] > 0
        # It can start again, without the remaining frames.
        assert terminal.ask("C") == b"\r"
        assert terminal.ask("O") == b"\r"
        other.send(CLASSIC[0])
        assert terminal.next() == b"t1233616263\r"


def test_dropped_frames_set_flags_when_there_is_room_again() -> None:
    bench = Bench("virtual")
    with bench.stack:
        other, port = bench.bus(), bench.port(room=50)
        with Terminal(port) as terminal:
            terminal.ask("O")
            for _ in range(2000):
                other.send(CLASSIC[2])
            until(lambda: port.figures()["dropped"] > 0)
            got = 0
            while terminal.next(timeout_s=0.3):
                got += 1
            assert got + port.figures()["dropped"] == 2000
            other.send(CLASSIC[0])
            assert terminal.next() == b"t1233616263\r"
            assert terminal.ask("F") == b"F09\r"


def test_random_lines_have_no_effect() -> None:
    random_ = random.Random(5)
    bench = Bench("virtual")
    with bench.stack:
        other, port = bench.bus(), bench.port()
        with Terminal(port) as terminal:
            for _ in range(500):
                os.write(
                    terminal.descriptor, bytes(random_.choices(b"OLdDbBtrRSVNFZMmU?\n\r\r0123456789ABEF\xff", k=30))
                )
                if select.select([terminal.descriptor], [], [], 0)[0]:
                    os.read(terminal.descriptor, 4096)
            os.write(terminal.descriptor, b"\rC\rO\r")
            os.write(terminal.descriptor, b"T000000017" + b"\r")
            os.write(terminal.descriptor, b"T000000010\r")
            wanted = can.Message(arbitration_id=1, data=b"")
            until(lambda: any(same(wanted, found) for found in iter(lambda: other.recv(0), None)))
            assert port.figures()["given_up"] == 0


def test_lines_may_arrive_in_any_portions() -> None:
    text = b"O\r" + b"t" * 500 + b"\rt1230\r\n\rC\r"
    for size in (1, 3, 1000):
        lines = Lines()
        found = [line for k in range(0, len(text), size) for line in lines.feed(text[k : k + size])]
        assert found == ["O", None, "t1230", "", "C"]


def test_lines_and_frames_convert_in_both_directions() -> None:
    for each in CLASSIC + REMOTE + FD:
        line = slcan.show(each)
        assert line is not None
        assert same(slcan.parse(line.decode().rstrip("\r")), each)


# Common to both.


def test_a_frame_refused_by_the_bus_is_reported() -> None:
    class Full(can.BusABC):
        """A port that accepts nothing."""

        def __init__(self) -> None:
            super().__init__("x")

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            raise can.CanOperationError("queue <full>")

        def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
            time.sleep(timeout or 0.0)
            return None, True

    with SocketcandServer({"x": Full}, port=0) as server, Text(server) as client:
        client.next()
        client.ask("< open x >")
        assert client.ask("< send 1 0 >").endswith(" not sent: queue full >")
        assert server.counts()["refused"] == 1
    with SlcanPort(Full) as port, Terminal(port) as terminal:
        assert [terminal.ask("O"), terminal.ask("t1230"), terminal.ask("F")] == [b"\r", b"\a", b"F02\r"]


def test_a_failed_bus_ends_the_connection_and_can_be_reopened() -> None:
    class Broken(can.BusABC):
        """Fails when something is sent."""

        def __init__(self) -> None:
            super().__init__("x")
            self.broken = threading.Event()

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            self.broken.set()

        def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
            if self.broken.wait(timeout):
                raise can.CanOperationError("unplugged")
            return None, True

    with SocketcandServer({"x": Broken}, port=0) as server, Text(server) as client:
        client.next()
        client.ask("< open x >< send 1 0 >")
        assert client.next() == ""
    with SlcanPort(Broken) as port, Terminal(port) as terminal:
        assert [terminal.ask("O"), terminal.ask("t1230")] == [b"\r", b"\r"]
        until(lambda: terminal.ask("F") == b"FA0\r")
        assert [terminal.ask("C"), terminal.ask("O")] == [b"\r", b"\r"]


class EchoBus(Outlet):
    """A port that returns its input, without a bus."""

    def _take(self, data: bytes) -> None:
        self._answer(data)


def test_messages_are_bounded_and_never_split_by_short_reads() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        ours.setblocking(False)
        outlet = EchoBus(ours.fileno(), name="echo", room=50)
        messages = [b"<%d %s>" % (number, b"x" * (number % 700)) for number in range(400)]
        thread = threading.Thread(target=outlet.serve)
        thread.start()
        kept, received, turn = [], b"", random.Random(3)
        for each in messages:
            if outlet.put(each):
                kept.append(each)
            if turn.random() < 0.3:
                with contextlib.suppress(BlockingIOError):
                    received += theirs.recv(turn.randrange(1, 600), socket.MSG_DONTWAIT)
        assert 50 <= len(kept) < 400
        theirs.settimeout(PATIENCE_S)
        while len(received) < len(b"".join(kept)):
            received += theirs.recv(333)
        assert received == b"".join(kept)
        theirs.sendall(b"<end>")
        assert theirs.recv(100) == b"<end>"
        theirs.close()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def test_each_write_contains_complete_messages() -> None:
    # Here all that was written is read at once.
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        ours.setblocking(False)
        outlet = EchoBus(ours.fileno(), name="echo")
        messages = [b"< frame %03X 1.000000 %s >" % (number, b"AB" * (number % 9)) for number in range(1000)]
        for each in messages:
            assert outlet.put(each)
        thread = threading.Thread(target=outlet.serve)
        thread.start()
        writes: list[bytes] = []
        while len(b"".join(writes)) < len(b"".join(messages)):
            writes.append(theirs.recv(1 << 16))
        assert all(each.startswith(b"< ") and each.endswith(b" >") and len(each) <= 1024 for each in writes)
        assert b"".join(writes) == b"".join(messages)
        outlet.stop()
        thread.join(PATIENCE_S)


def test_an_internal_error_of_a_port_is_reported_and_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench("virtual")
    with bench.stack:
        other, server = bench.bus(), bench.serve()
        client = bench.raw(server)
        client.next()
        client.ask("< open can0 >")
        client.ask("< rawmode >")
        for name in ("show", "parse_frame"):
            monkeypatch.setattr(socketcand, name, lambda *_, **__: 1 / 0)
        other.send(message(1))
        client.send("< send 1 0 >")
        until(lambda: any("socketcand 1 failed 2 times" in text for text in server.warnings()))
        monkeypatch.undo()
        other.send(message(2))
        assert client.next().startswith("< frame 002 ")
        client.send("< send 3 0 >")
        assert read(other, 1)[0].arbitration_id == 3


def test_outlets_of_the_command_line() -> None:
    bench = Bench("hub")
    endpoint = free_endpoint()
    with bench.stack, CanOutlets({"can0": bench.open}, speed("1M/8M"), socketcand=endpoint, slcan=True) as outlets:
        first, second = outlets.lines()
        assert second == f"CAN by socketcand on {endpoint}, classic frames only"
        host, _, port = endpoint.partition(":")
        with (
            slcanBus(first.rpartition(" ")[2], bitrate=1_000_000, sleep_after_open=0) as client,
            SocketCanDaemonBus("can0", host, int(port)) as other,
        ):
            assert client.get_version(5.0) == (1, 1)  # Its channel is open by now.
            other.send(CLASSIC[0])
            assert alike([CLASSIC[0]], read(client, 1))
            assert outlets.summary()
    with pytest.raises(InputError, match="socketcand must be HOST:PORT"):
        CanOutlets({}, speed("1M"), socketcand="29536")
    with pytest.raises(InputError, match=r"--can must be on zenoh, virtual or socketcan with --can-socketcand"):
        CanOutput("slcan:/dev/pts/99", CanOptions(can_slcan=True))
    with pytest.raises(InputError, match="--can must be given"):
        expand_groups(run)("hammer", can_slcan=True)
