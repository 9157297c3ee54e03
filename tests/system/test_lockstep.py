"""Devices under test in processes of their own: they react at an exact tick, however slow, and none hangs the rig."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rig
from drivers.client import Rig
from tests import processes

DEVICE = """
import random, sys, time
import numpy as np
import rig

with rig.connect(sys.argv[1], channels=["disk_x", "disk_y", "P_E"], name=sys.argv[2]) as machine:
    rows = 0
    for samples in machine.blocks():
        assert samples.index == rows, (samples.index, rows)
        rows += len(samples)
        time.sleep(random.uniform(0.0, float(sys.argv[3])))
        if rows > 2000 and np.hypot(samples["disk_x"], samples["disk_y"]).max() > 0.9:
            print(machine.speed(2.0).tick, rows, flush=True)
            break
"""


@contextmanager
def bench(*arguments: str) -> Iterator[tuple[Rig, str]]:
    endpoint = processes.free_endpoint()
    changes = ("--set", "drive.speed_hz=12", "--set", "commands=[]", "--duration-s", "4", *arguments)
    with processes.rig("run", "hammer", "--pace", "lockstep", "--listen", endpoint, *changes) as child:
        with rig.connect(f"zenoh:{endpoint}", wait_s=processes.COMPILE_S) as machine:
            yield machine, endpoint
        child.terminate()
        child.communicate(timeout=30.0)


def reaction(slow_s: float) -> tuple[str, list[dict[str, Any]]]:
    """What the device says that it did, and what the stream says of it."""
    with bench() as (machine, endpoint):
        with processes.python("-c", DEVICE, f"zenoh:{endpoint}", "guard", str(slow_s)) as device:
            assert machine.event("device", timeout_s=60.0)["state"] == "joined"
            machine.step(100_000)
            machine.hammer(force_n=150.0)
            machine.step(200_000)
            said, errors = device.communicate(timeout=30.0)
            assert errors == ""
        events = [machine.event(name) for name in ("speed", "device")]
    return said, [{name: value for name, value in event.items() if name not in ("wall_s",)} for event in events]


def test_a_device_reacts_at_the_same_tick_however_slow_it_is() -> None:
    quick, slow = reaction(0.0), reaction(0.02)
    assert quick == slow
    said, (speed, left) = quick
    tick, rows = map(int, said.split())
    assert tick == rows * 50, "at the end of the block in which it saw it"
    assert (speed["tick"], left["tick"], left["state"]) == (tick, tick, "left")
    assert json.dumps(speed)
