"""`rig foxglove` as its users start it, with a rig that is killed and started again."""

from __future__ import annotations

import re
import signal
import subprocess
from collections.abc import Callable

import pytest

from tests.foxglove_client import FoxgloveClient
from tests.processes import free_endpoint, read_line, start_rig

pytest.importorskip("foxglove")
pytestmark = pytest.mark.wallclock
PLOTS = "view/probes+forces+accelerations+hammer"


def read_port(child: subprocess.Popen[str]) -> int:
    assert child.stdout is not None
    found = re.match(r"ws://127\.0\.0\.1:(\d+) serves", child.stdout.readline())
    assert found is not None
    return int(found[1])


def test_a_command_reaches_the_rig_and_a_restart_continues_the_streams() -> None:
    endpoint = free_endpoint()
    run = ("run", "hammer", "--listen", endpoint, "--duration-s", "3600")
    with start_rig(*run) as first:
        read_line(first, "listening on")
        options = ("--connect", endpoint, "--listen", "127.0.0.1:0")
        with start_rig("foxglove", *options, "--allow-commands") as server, start_rig("foxglove", *options) as reader:
            with FoxgloveClient(read_port(server)) as client, FoxgloveClient(read_port(reader)) as other:
                client.subscribe(PLOTS, "view/events")
                reply = client.call("hammer", {"force_n": 120.0, "duration_ms": 4.0})
                assert reply["command"] == "hammer"
                client.until(lambda: any(b"hammer" in data for _, data in client.messages.get("view/events", ())))
                assert "--allow-commands" in other.call("hammer", {})["message"]
                assert "force_n" in client.call("hammer", {"force_n": -1.0})["message"]
                client.until(lambda: client.messages.get(PLOTS))
                first.kill()
                client.until(says(client, "the rig was lost"))
                sessions = len(client.find("serverInfo"))
                with start_rig(*run) as second:
                    read_line(second, "listening on")
                    client.until(lambda: len(client.find("serverInfo")) > sessions)
                    client.messages.clear()
                    again = client.call("speed", {"speed_hz": 6.0})
                    assert again.get("id") == 1, again  # the first command of another run
                    client.until(lambda: any(row[0] > 1000 * again["tick"] for row in client.messages.get(PLOTS, ())))
                    assert client.call("stop", {})["op"] == "reply"
            for child in (server, reader):
                child.send_signal(signal.SIGINT)
                _, error = child.communicate(timeout=60.0)
                assert (child.returncode, "Traceback" in error) == (0, False), error


def says(client: FoxgloveClient, words: str) -> Callable[[], bool]:
    return lambda: any(words in each["message"] for each in client.find("status"))


def test_a_recording_is_played_by_the_play_bar() -> None:
    with start_rig("foxglove", "--replay", "tests/recordings/hammer-table-1.mcap", "--listen", "127.0.0.1:0") as child:
        with FoxgloveClient(read_port(child)) as client:
            client.until(lambda: client.channels)
            topic = next(topic for topic in client.channels if topic != "view/events")
            client.subscribe(topic)
            assert client.play(command=0, rate=1.0, seek_ns=None, request="play")["status"] == 0
            client.until(lambda: client.messages.get(topic))
        child.send_signal(signal.SIGTERM)
        _, error = child.communicate(timeout=60.0)
        assert (child.returncode, "Traceback" in error) == (0, False), error
