"""End of a rig: signals at any time, slow clients, and hostile clients."""

from __future__ import annotations

import itertools
import json
import re
import signal
import socket
import subprocess
import time

import pytest

from rig.base import wire
from rig.serve.transport.zenoh import ZenohClient
from tests.processes import free_endpoint, read_line, start_python
from tests.processes import start_rig as command
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.wallclock

SLOW = """
import json, sys, time, zenoh
settings = {"mode": sys.argv[2], "connect/endpoints": ["tcp/" + sys.argv[1]], "listen/endpoints": [],
            "scouting/multicast/enabled": False, "scouting/gossip/enabled": False}
config = zenoh.Config()
for key, value in settings.items():
    config.insert_json5(key, json.dumps(value))
session = zenoh.open(config)
subscriber = session.declare_subscriber("rig/**", lambda _: time.sleep(0.2))
print("ready", flush=True)
time.sleep(60.0)
"""


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_a_slow_subscriber_does_not_delay_the_end(mode: str) -> None:
    endpoint = free_endpoint()
    with command("run", "stable-run", "--listen", endpoint) as rig:
        read_line(rig, "listening on")
        with start_python("-c", SLOW, endpoint, mode) as slow, ZenohClient(endpoint, wait_s=PATIENCE_S) as client:
            assert slow.stdout is not None
            assert slow.stdout.readline() == "ready\n"

            def stalled() -> bool:
                return wire.decode_document(client.request(wire.STATUS))["congestion"].get("stalled_links", 0) > 0

            until(stalled, of=rig)
            begin = time.monotonic()
            rig.send_signal(signal.SIGTERM)
            output, _ = rig.communicate(timeout=PATIENCE_S)
            seconds = time.monotonic() - begin
    assert rig.returncode == 0
    assert "stopped at" in output
    # Independent of the machine's speed: 13 to 15 s if both deadlines were waited for.
    assert seconds < 8.0


@pytest.mark.parametrize(
    ("number", "ignored", "words"),
    [
        (signal.SIGINT, True, "rig: scene"),  # as a shell starts background programs
        (signal.SIGTERM, False, "rig: scene"),
        (signal.SIGHUP, False, "rig: scene"),
        (signal.SIGINT, True, "listening on"),
        (signal.SIGHUP, False, "listening on"),
        (signal.SIGHUP, True, "listening on"),  # as nohup does
    ],
)
def test_a_signal_at_any_time_ends_a_rig_in_good_order(number: signal.Signals, ignored: bool, words: str) -> None:
    ignoring = (lambda: signal.signal(number, signal.SIG_IGN)) if ignored else None
    deaf = ignored and number == signal.SIGHUP
    # Only a rig that ignores the signal ends at its duration: another could end before the signal arrives.
    arguments = ("run", "stable-run", "--listen", free_endpoint(), *(("--duration-s", "1") if deaf else ()))
    with command(*arguments, preexec_fn=ignoring) as rig:
        read_line(rig, words)
        rig.send_signal(number)
        output, errors = rig.communicate(timeout=PATIENCE_S)
    assert "Traceback" not in errors
    if deaf:
        assert rig.returncode == 0
        assert "completed" in output, "it ignored the signal"
    elif words == "rig: scene":
        assert rig.returncode == 130
        assert errors.splitlines()[-1] == "rig: interrupted"
    else:
        # 130 if the signal arrived between the line and the first block.
        assert (rig.returncode, "stopped at" in output) in ((0, True), (130, False))


def test_every_connected_client_gets_a_reply() -> None:
    endpoint = free_endpoint()
    host, port = endpoint.split(":")

    def accepts() -> bool:
        with socket.socket() as probe:
            probe.settimeout(0.2)
            return probe.connect_ex((host, int(port))) == 0

    with command("run", "stable-run", "--listen", endpoint) as rig:
        until(accepts, of=rig)
        with ZenohClient(endpoint, wait_s=PATIENCE_S) as client:
            assert wire.decode_document(client.request(wire.STATUS, timeout_s=PATIENCE_S))["state"] == "running"
        rig.terminate()
        output, _ = rig.communicate(timeout=PATIENCE_S)
    assert rig.returncode == 0, output


def test_two_thousand_commands_delay_neither_status_nor_blocks() -> None:
    flood = f"""
import json, sys, time, zenoh
config = zenoh.Config()
for key, value in {{"mode": "client", "connect/endpoints": ["tcp/" + sys.argv[1]],
                   "scouting/multicast/enabled": False, "scouting/gossip/enabled": False}}.items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config) as session:
    time.sleep(0.3)
    begin = time.perf_counter()
    for number in range(2000):
        session.get("{wire.command_key("speed")}", lambda _: None, payload=b'{{"speed_hz": 6.2}}', timeout=5.0)
    print("sent in", time.perf_counter() - begin, flush=True)
    sys.stdin.read()
"""
    endpoint = free_endpoint()
    with command("run", "stable-run", "--listen", endpoint) as rig:
        read_line(rig, "listening on")
        stamps: list[float] = []
        with ZenohClient(endpoint, wait_s=PATIENCE_S) as client:
            client.subscribe(wire.STATUS, lambda *_: stamps.append(time.monotonic()))
            until(lambda: bool(stamps), of=rig)
            with start_python("-c", flood, endpoint, stdin=subprocess.PIPE) as hostile:
                assert hostile.stdout is not None
                assert hostile.stdout.readline().startswith("sent in")
                begin = time.monotonic()
                reply = json.loads(client.request(wire.STATUS, timeout_s=PATIENCE_S))
                assert reply["state"] == "running"
                until(lambda: stamps[-1] > begin + 1.0, of=rig)
                rig.terminate()
                output, _ = rig.communicate(timeout=PATIENCE_S)
    assert rig.returncode == 0
    assert max(b - a for a, b in itertools.pairwise(stamps)) < 2.0, "twice a second, but for a busy machine"
    found = re.search(r"blocks dropped (\d+), commands accepted (\d+)", output)
    assert found is not None
    assert int(found[1]) == 0
