"""Devices under test in processes of their own: they react at an exact tick, however slow, and none hangs the rig."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rig
from drivers.client import Rig
from tests import processes

DEVICE = """
import random, sys, time

import rig

with rig.connect(sys.argv[1], channels=["disk_x", "keyphasor"], name="guard") as machine:
    rows = 0
    for samples in machine.blocks():
        assert (samples.index, samples.gap) == (rows, 0)
        rows += len(samples)
        time.sleep(random.uniform(0.0, float(sys.argv[2])))
        if rows > 1000 and samples["keyphasor"].max() > 0.5:
            print(machine.speed(2.0).tick, rows, flush=True)
            break
"""
WAITS = """
import sys
import rig

with rig.connect(sys.argv[1], channels=["P_E"], name="a") as machine:
    for _ in machine.blocks(patience_s=0.5):
        pass
"""
PLAIN = str(processes.ROOT / "drivers/examples/plain_device.py")


@contextmanager
def bench(*arguments: str) -> Iterator[tuple[Rig, str]]:
    endpoint = processes.free_endpoint()
    changes = ("--set", "drive.speed_hz=12", "--set", "commands=[]", "--duration-s", "4", *arguments)
    with processes.rig("run", "hammer", "--pace", "lockstep", "--listen", endpoint, *changes) as child:
        with rig.connect(f"zenoh:{endpoint}", wait_s=processes.COMPILE_S) as machine:
            yield machine, endpoint
        child.terminate()
        child.communicate(timeout=30.0)


def reactions(slow_s: float) -> tuple[list[str], list[dict[str, Any]]]:
    """What two devices say that they did, over zenoh and of plain sockets over CAN, and what the stream says."""
    hub, port = processes.free_port(), processes.free_port()
    can = ("--can", f"zenoh:can0?endpoint=127.0.0.1:{hub}", "--can-socketcand", f"127.0.0.1:{port}")
    with (
        bench(*can) as (machine, endpoint),
        processes.python("-c", DEVICE, f"zenoh:{endpoint}", str(slow_s)) as guard,
        processes.python("-I", PLAIN, str(port)) as plain,
    ):
        joined = [machine.event("device", timeout_s=60.0) for _ in range(2)]
        assert {event["device"]: (event["state"], event["tick"]) for event in joined} == {
            "guard": ("joined", 0),
            "CAN 7": ("joined", 0),
        }
        machine.step(100_000)
        machine.hammer(force_n=150.0)
        assert machine.step(200_000).lost == {}
        said = []
        for device in (guard, plain):
            output, errors = device.communicate(timeout=30.0)
            assert errors == ""
            said.append(output)
        events = [machine.event(name) for name in ("speed", "device", "speed", "device")]
    return said, [{name: value for name, value in event.items() if name != "wall_s"} for event in events]


def test_devices_over_zenoh_and_over_can_react_at_the_same_ticks_however_slow_they_are() -> None:
    one, two = reactions(0.0), reactions(0.02)
    assert one == two
    (guard, plain), (slower, guard_left, halt, plain_left) = one
    tick, rows = map(int, guard.split())
    assert tick == rows * 50, "at the end of the block in which it saw it"
    assert (slower["tick"], slower["speed_hz"]) == (tick, 2.0)
    assert plain == f"stopped at {halt['tick']} us, with block {halt['tick'] // 10_000}\n"
    assert halt["speed_hz"] == 0.0
    assert 50_000 < tick < 100_000 < halt["tick"] < 300_000
    assert [(each["device"], each["state"], each["tick"]) for each in (guard_left, plain_left)] == [
        ("guard", "left", tick),
        ("CAN 7", "left", halt["tick"]),
    ]


def test_a_device_that_is_killed_is_told_and_the_rig_goes_on() -> None:
    with bench() as (machine, endpoint), processes.python("-c", WAITS, f"zenoh:{endpoint}") as device:
        machine.event("device", timeout_s=60.0)
        machine.step(10_000)
        device.kill()
        device.wait()
        reason = "it was not done with the block that ends at tick 20000 within 0.5 s"
        assert machine.step(50_000).lost == {"a": reason}
        lost = machine.event("device")
        assert (lost["state"], lost["tick"], lost["reason"]) == ("lost", 20_000, reason)
