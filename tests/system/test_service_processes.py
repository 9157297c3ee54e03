"""A rig, its clients and its commands in separate processes, over loopback."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from typing import Any

import pytest

from rig.base import wire
from rig.base.errors import InputError, RefusedError
from rig.cli import app
from rig.serve.transport.zenoh import ZenohClient, ZenohServer
from tests.processes import free_endpoint, read_line, start_python
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.wallclock


@contextmanager
def rig(pace: str, *duration_s: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    endpoint = free_endpoint()
    arguments = ("-m", "tests.unit.service_fake", endpoint.rpartition(":")[2], pace, *duration_s)
    with start_python(*arguments, stdin=subprocess.PIPE, stderr=subprocess.STDOUT) as child:
        read_line(child, "ready")
        yield child, endpoint


class Listener:
    """Follows a stream and detects gaps."""

    def __init__(self, client: ZenohClient) -> None:
        self.follow = wire.Continuity()
        self.first: dict[str, int] = {}
        self.gaps: list[wire.Gap] = []
        self.missed = 0
        self.events: list[dict[str, Any]] = []
        self.alive: list[bool] = []
        client.watch(wire.ALIVE, self.alive.append)
        client.subscribe("rig/**", self._take, on_miss=self._miss, history=True)

    def _take(self, key: str, payload: bytes) -> None:
        schema = wire.get_schema(key)
        if schema is not None:
            block = wire.decode_block(payload, schema)
            self.first.setdefault(key, block.index)
            if (gap := self.follow.follow(key, block.index, len(block.values))) is not None:
                self.gaps.append(gap)
        elif key == wire.EVENTS:
            self.events.append(wire.decode_document(payload))

    def _miss(self, _: str, count: int) -> None:
        self.missed += count

    def complete(self) -> bool:
        """Return whether all rows that the rig has published are present."""
        ends = [event for event in self.events if event["event"] == "end"]
        return bool(ends) and self.follow.received == ends[0]["rows"] and not any(self.first.values())


def test_a_paced_rig_keeps_time_and_loses_nothing() -> None:
    with rig("real-time", "2") as (child, endpoint), ZenohClient(endpoint, wait_s=PATIENCE_S) as client:
        listener = Listener(client)
        output, _ = child.communicate("start\n", timeout=PATIENCE_S)
        until(listener.complete)
        summary = json.loads(output)
    assert child.returncode == 0
    assert summary["reason"] == "completed"
    # The run may end late on a busy machine, by as much as it reports, and never early.
    late_s = 1e-3 * summary["lateness_ms"]["last"]
    assert 2.0 / summary["real_time_factor"] == pytest.approx(2.0 + late_s, abs=0.02)
    assert late_s < 1.0
    assert summary["queue"]["dropped"] == 0
    assert listener.gaps == []
    assert listener.missed == 0
    assert [event["event"] for event in listener.events] == ["start", "end"]


def test_a_free_rig_waits_for_its_subscribers_and_loses_nothing() -> None:
    with rig("free", "20") as (child, endpoint), ZenohClient(endpoint, wait_s=PATIENCE_S) as client:
        listener = Listener(client)
        output, _ = child.communicate("start\n", timeout=PATIENCE_S)
        until(listener.complete)
        summary = json.loads(output)
    assert listener.gaps == []
    assert summary["queue"]["dropped"] == 0
    assert summary["real_time_factor"] > 1.0


def test_a_signal_ends_the_stream_in_good_order() -> None:
    with rig("real-time") as (child, endpoint), ZenohClient(endpoint, wait_s=PATIENCE_S) as client:
        listener = Listener(client)
        until(lambda: bool(listener.follow.received), of=child)
        child.send_signal(signal.SIGTERM)
        output, _ = child.communicate(timeout=PATIENCE_S)
        until(listener.complete)
        until(lambda: listener.alive == [True, False])
    assert child.returncode == 0
    assert json.loads(output)["reason"] == "stopped"
    assert listener.events[-1]["reason"] == "stopped"


def test_a_killed_rig_is_noticed_long_before_the_lease_ends() -> None:
    with rig("real-time") as (child, endpoint), ZenohClient(endpoint, wait_s=PATIENCE_S) as client:
        listener = Listener(client)
        until(lambda: bool(listener.follow.received and listener.events) and listener.alive == [True], of=child)
        child.kill()
        until(lambda: listener.alive == [True, False])
    assert listener.gaps == []
    assert [event["event"] for event in listener.events] == ["start"]


SUBSCRIBER = """
import sys, time
from rig.serve.transport.zenoh import ZenohClient

endpoint, total = sys.argv[1], int(sys.argv[2])
numbers, missed = [], []

def account():
    return len(numbers) + sum(missed)

def until(count):
    deadline = time.monotonic() + 120.0
    while account() < count and time.monotonic() < deadline:
        time.sleep(0.01)

with ZenohClient(endpoint, wait_s=120.0) as client:
    client.subscribe("rig/sensors/a", lambda _, payload: numbers.append(int.from_bytes(payload[:8], "little")),
                     on_miss=lambda key, count: missed.append(count), history=True)
    until(1)
    client.request("rig/scene", timeout_s=120.0)
    until(total)
print(len(numbers), numbers == sorted(set(numbers)), sum(missed))
"""


def run_stalled_subscriber(messages: int) -> tuple[str, dict[str, float]]:
    """Stop a subscriber, publish far more than its link buffers, and let it continue.

    Returns:
        Its report, and the server's figures meanwhile.
    """
    ready = threading.Event()
    with ZenohServer(free_endpoint()) as server:

        def answer(_: bytes) -> bytes:
            ready.set()
            return b""

        server.answer("rig/scene", answer)
        server.publish("rig/sensors/a", (0).to_bytes(8, "little"))
        with start_python("-c", SUBSCRIBER, server.endpoint, str(messages), stderr=None) as child:
            assert ready.wait(PATIENCE_S)
            child.send_signal(signal.SIGSTOP)
            for number in range(1, messages):
                server.publish("rig/sensors/a", number.to_bytes(8, "little") + bytes(20_000))
            congestion = server.congestion()
            child.send_signal(signal.SIGCONT)
            report, _ = child.communicate(timeout=PATIENCE_S)
        return report, congestion


def test_a_stopped_subscriber_is_reported_and_then_receives_everything() -> None:
    # 50 MB, ten times the sockets' buffers; within the cache.
    report, congestion = run_stalled_subscriber(2500)
    assert report.split() == ["2500", "True", "0"]
    if congestion["backlog_bytes"]:
        assert congestion["stalled_links"] == congestion["stalls"] == 1
    # Waiting 1 ms in each dropped put would make nearly all slow; a busy machine makes some slow.
    assert congestion["slow_puts"] < 2500 / 4


def test_messages_dropped_from_the_cache_are_reported_as_missed() -> None:
    report, _ = run_stalled_subscriber(8000)
    received, in_order, missed = report.split()
    assert in_order == "True"
    assert int(missed) > 0
    assert int(received) + int(missed) == 8000


def test_a_script_without_close_still_ends() -> None:
    script = (
        "import sys; from rig.serve.transport.zenoh import ZenohClient; client = ZenohClient(sys.argv[1], wait_s=120);"
        "client.subscribe('rig/**', print); client.subscribe('rig/**', print, lossless=False);"
        "client.watch('rig/alive', print)"
    )
    with ZenohServer(free_endpoint()) as server:
        server.announce()
        with start_python("-c", script, server.endpoint) as child:
            assert child.wait(timeout=PATIENCE_S) == 0


class PrintedOutput(StringIO):
    """Standard output of a command, with an action at its first line."""

    def __init__(self, at_first_line: Callable[[], object] = bool) -> None:
        super().__init__()
        self._at_first_line = at_first_line

    def write(self, text: str) -> int:
        first = "\n" not in self.getvalue()
        written = super().write(text)
        if first and "\n" in text:
            self._at_first_line()
        return written


def invoke(endpoint: str, *arguments: str, at_first_line: Callable[[], object] = bool) -> str:
    """Run a command and return its output; exceptions pass."""
    with redirect_stdout(PrintedOutput(at_first_line)) as printed:
        app.rig().main([*arguments, "--connect", endpoint], standalone_mode=False)
    return printed.getvalue()


def test_the_commands_reach_a_rig_in_lockstep() -> None:
    with rig("lockstep") as (child, endpoint):
        assert invoke(endpoint, "step", "20000") == "stepped to 0.020000 s (tick 20000)\n"
        assert (
            invoke(endpoint, "hammer", "--force-n", "80") == "hammer accepted: number 2, at 0.020000 s (tick 20000)\n"
        )
        assert invoke(endpoint, "hammer", "--direction", "30").startswith("hammer accepted: number 3")
        assert invoke(endpoint, "speed", "5.2").startswith("speed 5.2 Hz accepted: number 4")
        assert invoke(endpoint, "release").startswith("release accepted: number 5")
        with pytest.raises(RefusedError, match=r"^force_n must be above 0 and at most 1000; received 1000000000"):
            invoke(endpoint, "hammer", "--force-n", "1e9")
        with pytest.raises(InputError, match="HZ must be a number; received nan"):
            invoke(endpoint, "speed", "nan")
        document = json.loads(invoke(endpoint, "status", "--json"))
        assert document["tick"] == 20_000
        assert document["commands"] == 5
        table = invoke(endpoint, "status")
        assert "lockstep" in table
        with ZenohClient(endpoint) as client:
            listener = Listener(client)
            assert invoke(endpoint, "stop").startswith("stop accepted: number 6")
            until(lambda: bool(listener.events) and listener.events[-1]["event"] == "end")
            commands = [event for event in listener.events if event["event"] == "command"]
        assert [event["command"] for event in commands] == ["step", "hammer", "hammer", "speed", "release", "stop"]
        assert [event["request"].get("direction") for event in commands[1:3]] == ["x", 30.0]
        assert all(event["from"].startswith(f"rig {event['command']} pid ") for event in commands)
        assert child.wait(timeout=PATIENCE_S) == 0


@pytest.mark.parametrize("arguments", [("hammer",), ("status", "--json"), ("status", "--watch"), ("step", "1000")])
def test_without_a_rig_every_command_prints_one_line(arguments: tuple[str, ...]) -> None:
    endpoint = free_endpoint()
    with pytest.raises(RefusedError) as caught:
        invoke(endpoint, *arguments)
    start = "start one with: rig run stable-run (--wait-s 60 waits for one that still compiles)"
    assert str(caught.value) == f"no rig answers at {endpoint}; {start}"


def test_a_malformed_endpoint_is_refused() -> None:
    with pytest.raises(InputError, match=r"^--connect must be HOST:PORT"):
        invoke("nowhere", "stop")


def test_watch_ends_with_the_rig() -> None:
    with rig("real-time") as (child, endpoint):
        lines = invoke(endpoint, "status", "--watch", "--json", at_first_line=child.terminate).splitlines()
        ticks = [json.loads(line)["tick"] for line in lines]
        assert ticks == sorted(ticks)
        assert len(ticks) >= 1
        assert child.wait(timeout=PATIENCE_S) == 0
