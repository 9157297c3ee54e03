"""A rig that is killed raises in every client, and a restarted rig is another rig."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Callable
from itertools import count

import pytest

import rig
from drivers.client import Rig
from drivers.console import Console
from rig.serve.transport import RigLostError
from rig.serve.transport.zenoh import ZenohClient
from tests import processes
from tests.waiting import PATIENCE_S, until

LOOPS: dict[str, Callable[[Rig], object]] = {
    "blocks": lambda machine: list(machine.blocks()),
    "daq": lambda machine: list(machine.daq.blocks(timeout_s=PATIENCE_S)),
    "turns": lambda machine: list(machine.turns()),
    "advance": lambda machine: [machine.advance(0.05) for _ in count()],
    "until": lambda machine: machine.until(lambda rows: rows["disk_x"] > 99.0, within_s=1e6),
}


@pytest.mark.parametrize("pace", ["lockstep", "real-time"])
def test_a_killed_rig_raises_in_every_loop_of_a_client(pace: str) -> None:
    can = f"zenoh:can0?endpoint={processes.free_endpoint()}"
    options = ("--pace", pace, "--set", "commands=[]", "--can", can)
    with processes.running_rig("hammer", *options) as (child, endpoint), Console.open(f"zenoh:{endpoint}") as console:
        loops = {f"{name} over zenoh": (f"zenoh:{endpoint}", loop) for name, loop in LOOPS.items()}
        loops |= {f"{name} over CAN": (f"can:{can}&node=9", LOOPS[name]) for name in ("blocks", "daq")}
        caught: dict[str, BaseException | None] = {}
        machines = [
            rig.connect(url, channels=["disk_x", "keyphasor"], name=name.replace(" ", "-"), wait_s=PATIENCE_S)
            for name, (url, _) in loops.items()
        ]

        def run(name: str, machine: Rig, loop: Callable[[Rig], object]) -> None:
            caught[name] = None
            try:
                loop(machine)
            except Exception as error:
                caught[name] = error

        threads = [
            threading.Thread(target=run, args=(name, machine, loop))
            for machine, (name, (_, loop)) in zip(machines, loops.items(), strict=True)
        ]
        for thread in threads:
            thread.start()
        until(lambda: len(caught) == len(loops) and console.status()["time_s"] > 0.5, of=child)
        assert not any(caught.values())
        child.kill()
        for thread in threads:
            thread.join(PATIENCE_S)
        for machine in machines:
            machine.close()
    assert {name: isinstance(error, ConnectionError) for name, error in caught.items()} == dict.fromkeys(loops, True)
    assert all("\n" not in str(error) for error in caught.values())


def test_a_restarted_rig_takes_no_commands_of_a_client_of_the_one_before() -> None:
    endpoint = processes.free_endpoint()
    arguments = ("-m", "tests.unit.service_fake", endpoint.rpartition(":")[2], "real-time")
    with processes.start_python(*arguments, stderr=subprocess.STDOUT) as first:
        processes.read_line(first, "ready")
        client = ZenohClient(endpoint, wait_s=PATIENCE_S)
        before, old = client.rig, Console(client)
        assert old.hammer().id == 1
        first.kill()
        first.wait()
    with old, processes.start_python(*arguments, stderr=subprocess.STDOUT) as second:
        with pytest.raises(ConnectionError):
            old.hammer()  # waits for a rig, which comes
        processes.read_line(second, "ready")
        until(lambda: client.rig not in (None, before), of=second)
        for ask in (old.hammer, old.status, old.stop):
            with pytest.raises(RigLostError, match=r"^the rig was lost, and another runs there now: connect again$"):
                ask()
        with Console.open(f"zenoh:{endpoint}") as new:
            assert new.status()["commands"] == 0
            assert new.hammer().id == 1
