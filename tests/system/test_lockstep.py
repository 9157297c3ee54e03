"""Devices under test in separate processes: they react at an exact tick, however slow, and none blocks the rig."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

import rig
from drivers.client import Rig
from drivers.console import AcceptedStep
from rig.base.errors import InputError, RefusedError
from rig.serve.transport import NoReplyError
from tests import processes
from tests.waiting import PATIENCE_S

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
    for _ in machine.blocks(patience_s=float(sys.argv[2])):
        pass
"""
SOCKET_DEVICE = str(processes.ROOT / "docs/plain_device.py")


@contextmanager
def bench(*arguments: str) -> Iterator[tuple[Rig, str]]:
    changes = ("--pace", "lockstep", "--set", "drive.speed_hz=12", "--set", "commands=[]", *arguments)
    with (
        processes.running_rig("hammer", *changes) as (_, endpoint),
        rig.connect(f"zenoh:{endpoint}", wait_s=PATIENCE_S) as machine,
    ):
        yield machine, endpoint


def run_devices(slow_s: float) -> tuple[list[str], list[dict[str, Any]]]:
    """Return the reports of two devices, over zenoh and over CAN by plain sockets, and the events of the stream."""
    hub, port = processes.free_port(), processes.free_port()
    can = ("--can", f"zenoh:can0?endpoint=127.0.0.1:{hub}", "--can-socketcand", f"127.0.0.1:{port}")
    with (
        bench(*can) as (machine, endpoint),
        processes.start_python("-c", DEVICE, f"zenoh:{endpoint}", str(slow_s)) as guard,
        processes.start_python("-I", SOCKET_DEVICE, str(port)) as plain,
    ):
        joined = [machine.event("device", timeout_s=PATIENCE_S) for _ in range(2)]
        assert {event["device"]: (event["state"], event["tick"]) for event in joined} == {
            "guard": ("joined", 0),
            "CAN 7": ("joined", 0),
        }
        machine.step(100_000)
        machine.hammer(force_n=150.0)
        assert machine.step(200_000).lost == {}
        outputs = []
        for device in (guard, plain):
            output, errors = device.communicate(timeout=PATIENCE_S)
            assert errors == ""
            outputs.append(output)
        events = [machine.event(name) for name in ("speed", "device", "speed", "device")]
    return outputs, [{name: value for name, value in event.items() if name != "wall_s"} for event in events]


def test_devices_over_zenoh_and_can_react_at_the_same_ticks_at_any_speed() -> None:
    one, two = run_devices(0.0), run_devices(0.02)
    assert one == two
    (guard, plain), (slower, guard_left, halt, plain_left) = one
    tick, rows = map(int, guard.split())
    assert tick == rows * 50, "at the end of the block in which it saw it"
    assert (slower["tick"], slower["speed_hz"]) == (tick, 2.0)
    assert plain == f"joined\nstopped at {halt['tick']} us, with block {halt['tick'] // 10_000}\n"
    assert halt["speed_hz"] == 0.0
    assert 50_000 < tick < 100_000 < halt["tick"] < 300_000
    assert [(each["device"], each["state"], each["tick"]) for each in (guard_left, plain_left)] == [
        ("guard", "left", tick),
        ("CAN 7", "left", halt["tick"]),
    ]


def test_a_killed_device_is_reported_and_the_rig_continues() -> None:
    with bench() as (machine, endpoint), processes.start_python("-c", WAITS, f"zenoh:{endpoint}", "0.5") as device:
        machine.event("device", timeout_s=PATIENCE_S)
        machine.step(10_000)
        device.kill()
        device.wait()
        reason = "it did not finish the block that ends at tick 20000 within 0.5 s"
        assert machine.step(50_000).lost == {"a": reason}
        lost = machine.event("device")
        assert (lost["state"], lost["tick"], lost["reason"]) == ("lost", 20_000, reason)


def test_a_client_is_informed_that_the_rig_waits_for_a_device() -> None:
    with bench() as (machine, endpoint), processes.start_python("-c", WAITS, f"zenoh:{endpoint}", "60") as device:
        machine.event("device", timeout_s=PATIENCE_S)
        device.send_signal(signal.SIGSTOP)
        with pytest.raises(NoReplyError, match=r"does not answer rig/command/step; the rig waits for a \(\d+ s\)$"):
            machine.step(10_000, timeout_s=1.0)
        (row,) = machine.status()["devices"]
        assert (row["state"], row["tick"]) == ("joined", 0)
        assert row["behind_s"] > 0.5
        device.kill()


def test_a_program_of_the_client_is_the_same_device_over_can() -> None:
    hub = processes.free_port()
    spec = f"can:zenoh:can0?endpoint=127.0.0.1:{hub}&node=3"
    with bench("--can", spec.removeprefix("can:").partition("&")[0]) as (machine, _):
        with rig.connect(spec, channels=["disk_x", "P_E"]) as device:
            with pytest.raises(InputError, match="tags must be with one of alert, danger"):
                device.note("over CAN", tags=["protection"])
            device.note("0.1 s  clear  danger disk_x  512", tags=["protection", "clear"])
            note = machine.event("note", timeout_s=PATIENCE_S)
            assert (note["text"], note["tags"], note["from"]) == ("clear danger disk_x 512", ["clear"], "CAN 3")
            with pytest.raises(InputError, match="fault must be with only its main number"):
                device.fault("P_E", "gain", factor=2.0, for_s=1.0)
            with pytest.raises(RefusedError, match="speed was refused over CAN: out of range"):
                device.speed(1000.0)
            stepped: list[AcceptedStep] = []
            events: list[dict[str, Any]] = []

            def step() -> None:
                # The device joins when it requests its first rows.
                events.append(machine.event("device", timeout_s=PATIENCE_S))
                stepped.append(machine.step(30_000))

            steps = threading.Thread(target=step)
            steps.start()
            ticks = []
            for samples in device.blocks():
                assert len(samples) == 10
                ticks.append((samples.tick, device.hammer(force_n=80.0).tick))
                if len(ticks) == 3:
                    break
                with pytest.raises(RefusedError, match=r"leave\.secret must be that with which CAN 3 has joined"):
                    machine.leave("CAN 3")
            fault = device.fault("P_E", "gain", factor=2.0)
            steps.join(PATIENCE_S)
            assert ticks == [(0, 10_000), (10_000, 20_000), (20_000, 30_000)]
            assert (fault.fault, fault.channels, fault.first_row) == (1, ("P_E",), {"forces": 600})
            assert [device.event("hammer")["force_n"] for _ in range(2)] == [80.0] * 2
            assert stepped[0].lost == {}
        events.append(machine.event("device"))
        assert [(each["device"], each["state"], each["tick"]) for each in events] == [
            ("CAN 3", "joined", 0),
            ("CAN 3", "left", 30_000),
        ]
