"""A virtual CAN hub, programs on its bus and python-can's own tools in separate processes, over loopback."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import can  # noqa: TID253 - the subject
import pytest

from drivers.can.bus import codec
from drivers.can.interface import ZenohBus
from rig.cli.main import main
from rig.serve.transport.zenoh import ZenohClient
from tests.processes import free_endpoint, read_line, start_python
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.wallclock
process = partial(start_python, stdin=subprocess.PIPE, stderr=subprocess.STDOUT)
"""Both outputs in one stream."""


@contextmanager
def hub_process() -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start `rig can hub` in a separate process; yield it and its endpoint."""
    endpoint = free_endpoint()
    arguments = ("can", "hub", "can0", "can1", "--speed", "1M/8M", "--listen", endpoint)
    with process("-m", "rig", *arguments) as child:
        read_line(child, "Ctrl-C ends it")  # the first start after a change compiles, with a message
        yield child, endpoint


class Bench:
    """A running hub with helpers for a test; everything that it opens ends with it."""

    def __init__(self, stack: ExitStack, child: subprocess.Popen[str], endpoint: str) -> None:
        self.child, self.endpoint = child, endpoint
        self._client = stack.enter_context(ZenohClient(self.endpoint, wait_s=PATIENCE_S))
        self._stack = stack
        self.nodes(0)
        self.nodes(0, "can1")

    def status(self, channel: str = "can0") -> dict[str, Any]:
        return json.loads(self._client.request(codec.request_key(channel, "status"), timeout_s=PATIENCE_S))

    def nodes(self, count: int, channel: str = "can0") -> None:
        until(lambda: len(self.status(channel)["nodes"]) == count, of=self.child)

    def bus(self, channel: str = "can0", **settings: Any) -> ZenohBus:
        return self._stack.enter_context(ZenohBus(channel, endpoint=self.endpoint, **settings))

    def tool(self, name: str, *arguments: str, channel: str = "can0") -> subprocess.Popen[str]:
        """Start one of python-can's tools, unchanged."""
        where = ("-i", "zenoh", "-c", channel, "--bus-kwargs", f"endpoint={self.endpoint}")
        return self._stack.enter_context(process("-m", f"can.{name}", *where, *arguments))


@pytest.fixture(scope="module")
def shared() -> Iterator[tuple[subprocess.Popen[str], str]]:
    with hub_process() as found:
        yield found


@pytest.fixture
def hub(shared: tuple[subprocess.Popen[str], str]) -> Iterator[Bench]:
    """A hub shared by tests."""
    with ExitStack() as stack:
        yield Bench(stack, *shared)


@pytest.fixture
def own_hub() -> Iterator[Bench]:
    """A hub that a test may end."""
    with ExitStack() as stack:
        yield Bench(stack, *stack.enter_context(hub_process()))


def end_process(child: subprocess.Popen[str]) -> str:
    """End it as Ctrl-C does, and return its output."""
    child.send_signal(signal.SIGINT)
    output, _ = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0, output
    return output


def make_messages(count: int) -> list[can.Message]:
    """Return classic, extended and FD frames, all different."""
    found = []
    for number in range(count):
        data = number.to_bytes(4, "big")
        if number % 3 == 0:
            found.append(can.Message(arbitration_id=0x100 + number % 7, data=data, is_extended_id=False))
        elif number % 3 == 1:
            found.append(can.Message(arbitration_id=0x18FF0000 + number, data=data + b"xyz"))
        else:
            settings: Any = {"is_fd": True, "bitrate_switch": True, "is_extended_id": False}
            found.append(can.Message(arbitration_id=0x700, data=data + bytes(44), **settings))
    return found


def sort_contents(found: list[can.Message]) -> list[tuple[int, bool, bool, bytes]]:
    """Return the fields that a log must keep, in the order of the numbers."""
    rows = [(item.arbitration_id, item.is_extended_id, item.is_fd, bytes(item.data)) for item in found]
    return sorted(rows, key=lambda row: row[3][:4])


def take(bus: can.BusABC, count: int) -> list[can.Message]:
    found = [bus.recv(10.0) for _ in range(count)]
    assert None not in found
    return [item for item in found if item is not None]


def log(path: Path) -> list[can.Message]:
    with can.LogReader(path) as reader:
        return list(reader)


def test_stock_logger_and_player_keep_every_frame(hub: Bench, tmp_path: Path) -> None:
    count = 3000
    path = tmp_path / "bus.log"
    before = hub.status()["counts"]
    logger = hub.tool("logger", "-f", str(path))
    hub.nodes(1)
    sender = hub.bus()
    for item in make_messages(count):
        sender.send(item, timeout=PATIENCE_S)
    until(lambda: hub.status()["counts"]["frames"] - before["frames"] == count)

    def has_all() -> bool:
        """Return whether the logger has written the last message; repeats of it make the logger empty its buffer."""
        sender.send_records(codec.make_records(make_messages(count)[-1:] * 100), timeout=PATIENCE_S)
        return path.exists() and path.read_text(encoding="utf-8").count("\n") >= count

    until(has_all, of=logger, every_s=0.05)
    sender.shutdown()
    hub.nodes(1)
    assert "Connected to ZenohBus: zenoh can0" in end_process(logger)
    everything = log(path)
    logged = everything[:count]
    assert sort_contents(logged) == sort_contents(make_messages(count))
    assert [item.timestamp for item in logged] == sorted(item.timestamp for item in logged)
    assert sort_contents(everything[count:]) == sort_contents(make_messages(count)[-1:] * (len(everything) - count))

    hub.nodes(0)
    between = hub.status()["counts"]
    assert between == {**before, "frames": between["frames"]}
    receiver = hub.bus()
    player = hub.tool("player", "--ignore-timestamps", "-g", "0", str(path))
    found = take(receiver, len(everything))
    output, _ = player.communicate(timeout=PATIENCE_S)
    assert player.returncode == 0, output
    assert sort_contents(found) == sort_contents(everything)
    assert hub.status()["counts"] == {**between, "frames": between["frames"] + len(everything)}


def test_stock_bridge_joins_two_channels(hub: Bench) -> None:
    arguments = []
    for bus, channel in (("bus1", "can0"), ("bus2", "can1")):
        settings = {"interface": "zenoh", "channel": channel, "bus-kwargs": f"endpoint={hub.endpoint}"}
        arguments += [text for name, value in settings.items() for text in (f"--{bus}-{name}", value)]
    with process("-m", "can.bridge", *arguments) as bridge:
        hub.nodes(1)
        hub.nodes(1, "can1")
        zero, one = hub.bus("can0"), hub.bus("can1")
        zero.send(can.Message(arbitration_id=1, data=b"there"))
        assert bytes(take(one, 1)[0].data) == b"there"
        one.send(can.Message(arbitration_id=2, data=b"back"))
        assert bytes(take(zero, 1)[0].data) == b"back"
        end_process(bridge)


def test_stock_viewer_knows_the_interface() -> None:
    code = "import sys, can, can.viewer; sys.exit('zenoh' not in can.VALID_INTERFACES)"
    with process("-c", code) as child:
        output, _ = child.communicate(timeout=PATIENCE_S)
    if "curses" in output:
        pytest.skip("no curses here")
    assert child.returncode == 0, output


def test_a_signal_ends_the_hub_and_it_sums_up(own_hub: Bench) -> None:
    hub = own_hub
    with hub.bus() as one, hub.bus() as other:
        one.send(can.Message(arbitration_id=1))
        take(other, 1)
    until(lambda: hub.status()["nodes"] == [])
    output = end_process(hub.child)
    assert [line.split()[0] for line in output.splitlines()] == ["can0", "can1"]
    assert "frames 1" in output


def test_nodes_are_informed_of_a_killed_hub(own_hub: Bench) -> None:
    bus = own_hub.bus()
    own_hub.child.kill()
    until(lambda: bus.state is can.BusState.ERROR)
    with pytest.raises(can.CanOperationError, match="is lost: nothing can be sent"):
        bus.send(can.Message(arbitration_id=1))


UNCLOSED_PROGRAM = """
import sys, threading, can
bus = can.Bus("can0", interface="zenoh", endpoint=sys.argv[1])
notifier = can.Notifier(bus, [lambda message: None])
threading.Thread(target=bus.recv, daemon=True).start()
bus.send(can.Message(arbitration_id=7))
print("sent", flush=True)
"""


def test_a_script_without_close_ends(hub: Bench) -> None:
    with process("-c", UNCLOSED_PROGRAM, hub.endpoint) as child:
        output, _ = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0, output
    assert "sent" in output
    hub.nodes(0)


IDLE_PROGRAM = """
import sys, time, can
bus = can.Bus("can0", interface="zenoh", endpoint=sys.argv[1])
bus.send(can.Message(arbitration_id=7))
print("up", flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("how", [signal.SIGSTOP, signal.SIGKILL], ids=["stopped", "killed"])
def test_a_stalled_or_killed_endpoint_does_not_delay_others(hub: Bench, how: signal.Signals) -> None:
    count = 20_000
    sender, receiver = hub.bus(), hub.bus()
    with process("-c", IDLE_PROGRAM, hub.endpoint) as child:
        read_line(child, "up")
        assert take(receiver, 1)[0].arbitration_id == 7
        child.send_signal(how)
        data = bytes(60)
        found: list[can.Message] = []
        for first in range(0, count, 100):
            rows = [
                can.Message(
                    arbitration_id=0x100, data=number.to_bytes(4, "big") + data, is_fd=True, bitrate_switch=True
                )
                for number in range(first, first + 100)
            ]
            sender.send_records(codec.make_records(rows), timeout=PATIENCE_S)
            while (item := receiver.recv(0)) is not None:
                found.append(item)
        found += take(receiver, count - len(found))
        assert [int.from_bytes(item.data[:4], "big") for item in found] == list(range(count))
        # The bus was never idle: its load is that of the frames.
        share = (found[-1].timestamp - found[0].timestamp) / (count * 123e-6)
        assert 0.8 < share < 2.5
        assert (receiver.missed, receiver.dropped) == (0, 0)
        if how is signal.SIGKILL:
            hub.nodes(2)


def test_two_processes_exchange_frames_without_loss(hub: Bench) -> None:
    echo = """
import sys, can
with can.Bus("can0", interface="zenoh", endpoint=sys.argv[1]) as bus:
    print("up", flush=True)
    while (message := bus.recv(30)).arbitration_id:
        message.arbitration_id = 2
        bus.send(message)
"""
    bus = hub.bus()
    before = hub.status()["counts"]["frames"]
    with process("-c", echo, hub.endpoint) as child:
        read_line(child, "up")
        for number in range(1000):
            bus.send(can.Message(arbitration_id=1, data=number.to_bytes(8, "big")))
            (answer,) = take(bus, 1)
            assert (answer.arbitration_id, int.from_bytes(answer.data, "big")) == (2, number)
        bus.send(can.Message(arbitration_id=0))
        output, _ = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0, output
    assert hub.status()["counts"]["frames"] - before == 2001


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("can 0",), "channel must be letters"),
        (("can0", "can0"), "CHANNEL must be named once each"),
        (("can0", "--speed", "fast"), "--speed must be as"),
        (("can0", "--listen", "0.0.0.0:7999"), "ssh -L 7999:127.0.0.1:7999"),
    ],
)
def test_wrong_options_of_the_hub_are_refused_in_one_line(
    arguments: tuple[str, ...], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["can", "hub", "--listen", free_endpoint(), *arguments])  # the pages of the docs use the default one
    output = "".join(capsys.readouterr())
    assert ended.value.code == 2
    assert line in output
    assert len(output.splitlines()) == 1
