"""The Modbus gateway: registers equal to the detectors of a recording, commands by coils, and malformed requests."""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

import rig
from drivers.protection.modbus.registers import Contents, RegisterMap
from drivers.protection.modbus.server import Server, serve
from drivers.sources.samples import Samples
from rig.base.errors import RefusedError
from rig.channels.table import default_table
from tests.processes import ROOT, free_port
from tests.unit.modbus_client import ModbusClient, ModbusError
from tests.waiting import PATIENCE_S

SETTINGS = {"alert_um": 500.0, "danger_um": 1500.0}
REGISTERS = RegisterMap(default_table())


def read_session(name: str) -> Samples:
    """Return all channels of a reference session, in the order of the table."""
    recording = rig.open_session(name)
    parts = [recording.samples(group) for group in default_table().groups]
    names = tuple(name for part in parts for name in part.names)
    units = tuple(unit for part in parts for unit in part.units)
    values = np.concatenate([part.values for part in parts], axis=1)
    return Samples(0, 0, parts[0].rate_hz, 1e6, names, units, values)


@pytest.fixture(scope="module")
def session() -> Samples:
    return read_session("stable-run")


@contextlib.contextmanager
def served(command: object = None) -> Iterator[tuple[int, object]]:
    with serve(REGISTERS, ("127.0.0.1", port := free_port()), command) as publish:
        yield port, publish


def test_contents_do_not_depend_on_the_blocks(session: Samples) -> None:
    whole, parts = Contents(REGISTERS, SETTINGS), Contents(REGISTERS, SETTINGS)
    end = len(session) - round(0.025 * session.rate_hz)
    whole.feed(session.rows(0, end))
    draw, at = np.random.default_rng(3), 0
    while at < end:
        step = int(draw.integers(1, 900))
        parts.feed(session.rows(at, min(at + step, end)))
        at += step
    assert whole.values[0] == pytest.approx(0.5)
    assert whole.bits == parts.bits
    assert np.array_equal(whole.values, parts.values)


def bits_of(contents: Contents, name: str) -> dict[str, bool]:
    return {entry.value: on for entry, on in zip(REGISTERS.bits, contents.bits, strict=True) if entry.channel == name}


def test_a_channel_at_its_limit_is_not_ok_and_missing_rows_clear_all_bits(session: Samples) -> None:
    values = session.values.copy()
    force, probe = session.names.index("P_N"), session.names.index("disk_x")
    values[-50:, force] = 9_900.0
    values[-50:, probe] = 2.03  # -2 V
    contents = Contents(REGISTERS, SETTINGS)
    contents.feed(replace(session, values=values).rows(0, len(session) - len(session) % round(0.1 * session.rate_hz)))
    assert [bits_of(contents, name)["OK"] for name in ("P_N", "disk_x", "P_S", "disk_y")] == [False, False, True, True]
    late = session.rows(100, 200)
    contents.feed(replace(late, index=10**6, tick=2 * 10**8))
    assert not any(contents.bits)


def test_a_channel_is_ok_again_after_a_window_and_a_probe_after_the_recovery_of_the_monitor(session: Samples) -> None:
    values = session.values.copy()
    values[100:150, session.names.index("P_N")] = 9_900.0
    values[100:150, session.names.index("disk_x")] = 2.03
    contents = Contents(REGISTERS, SETTINGS)
    contents.feed(replace(session, values=values))
    assert [bits_of(contents, name)["OK"] for name in ("P_N", "disk_x", "disk_y")] == [True, False, True]


def test_alarm_bits_are_those_of_the_monitor() -> None:
    rows = read_session("hammer-6.2")
    quiet, loud = (Contents(REGISTERS, {"alert_um": high, "danger_um": high}) for high in (9e3, 1.0))
    for contents in (quiet, loud):
        for start in range(0, 15_000, len(rows)):  # 3 s: the monitor has no alarms in the first second
            contents.feed(replace(rows, index=start, tick=200 * start))
    for name in ("disk_x", "disk_y", "ring_x", "ring_y"):
        on, off = bits_of(loud, name), bits_of(quiet, name)
        assert (on["alert"], on["danger"], off["alert"], off["danger"]) == (True, True, False, False)
    assert (bits_of(loud, "")["any danger"], bits_of(quiet, "")["any alert"]) == (True, False)
    assert (bits_of(loud, "P_N")["danger"], len(loud.monitors)) == (False, 2)


# ---- requests ----


def make_malformed(draw: random.Random) -> bytes:
    """Return a message that no server may carry out: header, length, function, address, count or value is wrong."""
    kind = draw.randrange(8)
    transaction, unit = draw.randrange(65536), draw.randrange(256)

    def frame(pdu: bytes, protocol: int = 0, length: int | None = None) -> bytes:
        return struct.pack(">HHHB", transaction, protocol, len(pdu) + 1 if length is None else length, unit) + pdu

    trip = struct.pack(">BHH", 5, 0, 0xFF00)
    if kind == 0:
        return draw.randbytes(draw.randrange(1, 300))
    if kind == 1:
        return frame(trip, protocol=draw.randrange(1, 65536))
    if kind == 2:
        return frame(trip, length=draw.choice([0, 1, 2, 3, 4, 5, 7, 8, 255, 300, 65535]))
    if kind == 3:
        return frame(bytes([draw.choice([0, *range(6, 15), *range(16, 256)])]) + draw.randbytes(draw.randrange(12)))
    if kind == 4:
        return frame(struct.pack(">BHH", 5, 0, draw.choice([1, 0xFF, 0xFF01, 0xFFFF, draw.randrange(1, 0xFF00)])))
    if kind == 5:
        return frame(struct.pack(">BHH", draw.choice([1, 2, 3, 4, 5]), draw.randrange(3000, 65536), 0xFF00))
    if kind == 6:
        data = draw.randbytes(draw.randrange(4))
        return frame(
            struct.pack(">BHHB", 15, draw.randrange(2), draw.randrange(65536), draw.randrange(256)) + data + b"!" * 9
        )
    return frame(trip + draw.randbytes(draw.randrange(1, 9)))


class FakeTransport(asyncio.Transport):
    def __init__(self) -> None:
        super().__init__()
        self.sent, self.closed = b"", False

    def write(self, data: object) -> None:
        self.sent += bytes(data)  # type: ignore[call-overload]

    def close(self) -> None:
        self.closed = True


def test_ten_thousand_malformed_messages_are_refused_and_nothing_moves() -> None:
    draw, commands = random.Random(1), list[str]()
    counts = dict.fromkeys(("refused", "closed", "waiting"), 0)

    async def send_all() -> None:
        server = Server(REGISTERS, ("127.0.0.1", free_port()), commands.append)
        before = [await server.async_getValues(0, code, 0, 58 if code > 2 else 3) for code in (1, 2, 3, 4)]
        for _ in range(10_000):
            handler, link = server.callback_new_connection(), FakeTransport()
            handler.connection_made(link)
            handler.data_received(make_malformed(draw))
            for _ in range(3):
                await asyncio.sleep(0.0)
            counts["closed" if link.closed else "refused" if link.sent else "waiting"] += 1
            assert not link.sent or link.sent[7] & 0x80
        after = [await server.async_getValues(0, code, 0, 58 if code > 2 else 3) for code in (1, 2, 3, 4)]
        assert before == after

    asyncio.run(send_all())
    assert commands == []
    assert counts["refused"] > 5000
    assert counts["closed"] > 1000


@pytest.mark.parametrize(
    ("pdu", "code"),
    [
        (struct.pack(">BHH", 4, 0, 0), 3), (struct.pack(">BHH", 4, 0, 126), 3), (struct.pack(">BHH", 4, 57, 2), 2),
        (struct.pack(">BHH", 4, 999, 1), 2), (struct.pack(">BHH", 2, 60, 1), 2), (struct.pack(">BHH", 1, 0, 4), 2),
        (struct.pack(">BHH", 5, 0, 1), 3), (struct.pack(">BHH", 5, 3, 0xFF00), 2), (struct.pack(">BHH", 6, 0, 1), 1),
        (struct.pack(">BHHBB", 15, 0, 3, 2, 7), 3), (struct.pack(">BHHBH", 16, 0, 1, 2, 7), 1),
        (b"\x2b\x0e\x01\x00", 1),
    ],
)  # fmt: skip
def test_each_wrong_request_has_the_exception_code_of_the_specification(pdu: bytes, code: int) -> None:
    commands: list[str] = []
    with served(commands.append) as (port, _), ModbusClient(port) as client:
        with pytest.raises(ModbusError) as caught:
            client.request(pdu)
        assert client.bits(0, 3, code=1) == [False] * 3
    assert (caught.value.args, commands) == ((code,), [])


def test_coils_are_commands_if_they_are_allowed() -> None:
    commands: list[str] = []

    def execute(name: str) -> None:
        commands.append(name)
        if name == "stop":
            raise RefusedError("not now")
        if name == "trip" and len(commands) > 3:
            raise ConnectionError("no rig")

    with served() as (port, _), ModbusClient(port) as client:
        for request in (struct.pack(">BHH", 5, 0, 0xFF00), struct.pack(">BHHBB", 15, 0, 3, 1, 7)):
            with pytest.raises(ModbusError, match="1"):
                client.request(request)
    with served(execute) as (port, _), ModbusClient(port) as client:
        client.write_coil(0)
        client.write_coil(0, 0)
        assert client.request(struct.pack(">BHHBB", 15, 0, 3, 1, 0b101)) == struct.pack(">HH", 0, 3)
        assert commands == ["trip", "trip", "reset"]
        with pytest.raises(ModbusError, match="4"):
            client.write_coil(1)
        with pytest.raises(ModbusError, match="11"):
            client.write_coil(0)


def test_requests_sent_before_the_reply_are_answered_in_order() -> None:
    with served(lambda _: None) as (port, publish), ModbusClient(port) as client:
        publish(np.arange(58.0), [False] * len(REGISTERS.bits))
        requests = [struct.pack(">HHHBBHH", number, 0, 6, 17, 4, number, 1) for number in range(20)]
        data = b"".join(requests)
        client.link.sendall(data[:100])
        client.link.sendall(data[100:])
        replies = [client.receive(number, 4) for number in range(20)]
    words, _ = REGISTERS.encode(np.arange(58.0))
    assert [int.from_bytes(reply[1:], "big") for reply in replies] == words[:20]


def test_a_request_waits_for_the_command_before_it() -> None:
    done = threading.Event()
    with (
        served(lambda _: done.wait(PATIENCE_S)) as (port, _),
        ModbusClient(port) as client,
        ModbusClient(port) as other,
    ):
        client.link.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 17, 5, 0, 0xFF00))
        for _ in range(5):
            other.registers(0, 1)  # the server continues
        client.link.sendall(struct.pack(">HHHBBHH", 2, 0, 6, 17, 4, 0, 1))
        for _ in range(5):
            other.registers(0, 1)
        done.set()
        assert client.receive(1, 5) == struct.pack(">HH", 0, 0xFF00)
        assert client.receive(2, 4) == b"\2\0\0"


def test_a_message_of_another_protocol_closes_its_connection() -> None:
    with served() as (port, _), ModbusClient(port) as client:
        client.link.sendall(struct.pack(">HHHBBHH", 1, 1, 6, 17, 4, 0, 1))
        assert client.link.recv(1) == b""


def test_values_out_of_range_are_limited_and_those_that_are_not_numbers_are_zero() -> None:
    values = np.zeros(58)
    values[:6] = 6553.7, 1e6, -1.0, -99.0, np.nan, 359.999
    words, floats = REGISTERS.encode(values)
    assert words[:6] == [1, 0xFFFF, 0, 0x8000, 0, 35_999]
    assert struct.unpack(">f", struct.pack(">2H", *floats[2:4])) == (1e6,)


# ---- command ----


def run_command(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "rig", "modbus", *arguments]
    return subprocess.run(command, cwd=ROOT, text=True, capture_output=True, timeout=120)


def test_the_page_has_the_map_that_the_command_prints() -> None:
    page = Path(ROOT / "docs/modbus.md").read_text(encoding="utf-8")
    done = run_command("--map", "--markdown")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout in page, "rig modbus --map --markdown"
    assert json.loads(run_command("--map", "--json").stdout) == [asdict(entry) for entry in REGISTERS.entries]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--listen", "0.0.0.0:5020"), "--listen must be on 127.0.0.1"),
        (("--alert-um", "0"), "--alert-um must be"),
        (("--alert-um", "9", "--danger-um", "8"), "--alert-um must be at most --danger-um, 8"),
        (("--json",), "must be given with --map; received no --map"),
    ],
)
def test_a_wrong_option_is_an_error_of_one_line(arguments: tuple[str, ...], words: str) -> None:
    done = run_command(*arguments)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert words in done.stderr
