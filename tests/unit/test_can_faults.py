"""Faults over CAN: requested by a frame, and faults of blocks that become frames."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from drivers.can.faults import FaultKind
from drivers.can.message import checksum
from drivers.can.schedule import Schedule
from drivers.can.signals import (
    Command,
    CommandKind,
    EventKind,
    Result,
    clear_frame,
    fault_frame,
    messages_for,
    parse_command,
)
from rig.base.errors import InputError
from rig.base.wire import SAMPLE_SCHEMA, decode_block, sensor_key
from rig.channels.faults import KINDS
from rig.run.scenes import load_scene, parse_scene, scene_document
from rig.run.simulation import Simulation
from rig.serve.pacing import FreeRun
from rig.serve.service import Service
from rig.serve.transport.fanout import Fanout
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.fault_cases import BLOCKS, EXAMPLES
from tests.unit.test_can_gateway import rig
from tests.waiting import until

pytestmark = pytest.mark.wallclock
ROOT = Path(__file__).parents[2]
SCENE = load_scene("hammer", {"duration_s": 0.4})
SIMULATION = Simulation(SCENE)
SIMULATION.tick = 10_000  # at the first row there is nothing to restart


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_acknowledged_with_its_main_parameter(kind: str) -> None:
    main, numbers = KINDS[kind].main(), (EXAMPLES | BLOCKS)[kind]
    channel = "probes" if kind in BLOCKS else "keyphasor" if KINDS[kind].channel_only else "disk_x"
    found = parse_command(*fault_frame(channel, kind, 7, number=numbers.get(main)), 6)
    given = {main: numbers[main]} if main in numbers else {}
    assert found == Command(FaultKind.FAULT, 7, {"channel": channel, "kind": kind, **given})
    # The frame has all fields that a kind requires: the rig accepts the request unchanged.
    assert isinstance(found, Command)
    SIMULATION.submit("fault", found.values)
    SIMULATION.submit("clear", {})


def test_clear_and_invalid_frames() -> None:
    assert parse_command(*clear_frame(1), 0) == Command(FaultKind.CLEAR, 1, {"id": "all"})
    assert parse_command(*clear_frame(1, number=300), 0) == Command(FaultKind.CLEAR, 1, {"id": 300})
    identifier, data = fault_frame("P_E", "freeze", 1)

    def change(place: int, value: int) -> Any:
        changed = data[:place] + bytes([value]) + data[place + 1 : 7]
        return parse_command(identifier, changed + bytes([checksum(identifier, changed)]), 0)

    assert change(2, max(kind.number for kind in KINDS.values()) + 1) is Result.OUT_OF_RANGE
    assert change(3, 0) is Result.OUT_OF_RANGE
    assert change(4, 1) is Result.OUT_OF_RANGE  # freeze has no number
    assert change(0, CommandKind.HAMMER) is Result.BAD_KIND
    others = (*FaultKind, CommandKind.HAMMER, CommandKind.SPEED, CommandKind.RELEASE, CommandKind.STOP)
    assert min((one ^ other).bit_count() for one in FaultKind for other in others if one != other) >= 4
    for given, line in (
        (("P_Q", "freeze", 1), "fault.channel must be the name of a channel"),
        (("P_E", "frieze", 1), "fault.kind must be one of the kinds, such as freeze"),
    ):
        with pytest.raises(InputError, match=line):
            fault_frame(*given)
    with pytest.raises(InputError, match="left out: freeze has no main number"):
        fault_frame("P_E", "freeze", 1, number=3.0)


def test_a_users_channel_table_has_its_own_targets() -> None:
    table = messages_for(load_scene("stable-run", {"channels": str(ROOT / "docs/daq24.toml")}).table)
    frame = fault_frame("end_u", "freeze", 1, table=table)
    assert parse_command(*frame, 0, table) == Command(FaultKind.FAULT, 1, {"channel": "end_u", "kind": "freeze"})
    with pytest.raises(InputError, match=r"fault\.channel must be the name of a channel"):
        fault_frame("end_u", "freeze", 1)


def test_a_fault_is_acknowledged_with_its_number_and_ends() -> None:
    with rig(Simulation(load_scene("hammer", {"duration_s": 60.0})), paced=True) as setup:  # type: ignore[arg-type]
        setup.start()
        until(lambda: bool(setup.tap.of("Probes")))
        reply = setup.tap.ask(*fault_frame("P_E", "gain", 1, number=1.5))
        assert (reply["result"], reply["limit"]) == (Result.ACCEPTED, 10)
        until(lambda: any(row["event"] == EventKind.FAULT for row in setup.tap.decoded("Event")))
        (event,) = (row for row in setup.tap.decoded("Event") if row["event"] == EventKind.FAULT)
        assert (event["value"], event["time"]) == (10, reply["time"])
        assert setup.tap.ask(*clear_frame(2, number=1))["result"] == Result.ACCEPTED
        assert setup.tap.ask(*clear_frame(3, number=1))["result"] == Result.REFUSED
        assert setup.tap.ask(*fault_frame("P_E", "miss-pulses", 4))["result"] == Result.REFUSED
        assert setup.tap.ask(*fault_frame("probes", "dropout", 5))["result"] == Result.ACCEPTED
        until(lambda: sum(row["event"] == EventKind.FAULT for row in setup.tap.decoded("Event")) > 1)
        time.sleep(0.05)
        setup.tap.ask(*clear_frame(6))

        def steps() -> set[int]:
            numbers = [row["index"] for row in setup.tap.decoded("Probes")]
            return {later - one for one, later in pairwise(numbers)}

        until(lambda: len(steps()) > 1)  # 50 ms of rows and more were never sent
        assert max(steps()) >= 1000


def record_frames(*faults: dict[str, Any]) -> dict[str, list[bytes]]:
    """Return all frames of some messages of a run."""
    scene = parse_scene({**scene_document(SCENE), "commands": [], "faults": faults})
    with rig(Simulation(scene), schedule=Schedule(1000, 10_000)) as setup:  # type: ignore[arg-type]
        setup.start()
        setup.join()
        until(lambda: any(row["event"] == EventKind.END for row in setup.tap.decoded("Event")))
        assert setup.gateway.dropped == 0  # frames removed by a fault do not count as dropped by the bus
        return {name: setup.tap.of(name) for name in ("Probes", "Forces", "Samples_1", "Sync")}


@pytest.fixture(scope="module")
def sound() -> dict[str, list[bytes]]:
    return record_frames()


@pytest.mark.parametrize("kind", BLOCKS)
def test_faults_of_blocks_show_on_the_bus_and_on_their_stream_alone(kind: str, sound: dict[str, list[bytes]]) -> None:
    there = record_frames({"at_s": 0.1, "channel": "probes", "kind": kind, "for_s": 0.2, **BLOCKS[kind]})
    assert there["Forces"] == sound["Forces"]
    shown = ("Sync",) if kind == "stale-stamps" else ("Probes", "Samples_1")
    if kind != "late-blocks":  # a run without the clock sends the same frames in the same order
        assert all(there[name] != sound[name] for name in shown)
    whole = {"dropout": 0.5, "lose-blocks": 0.8}.get(kind, 2.0)
    assert len(there["Probes"]) <= whole * len(sound["Probes"])


def test_a_fault_on_can_does_not_affect_zenoh() -> None:
    """The effect of a fault on CAN is not visible on zenoh, and vice versa."""
    faults = [
        {"at_s": at_s, "channel": "probes", "kind": "dropout", "for_s": 0.1, "door": door}
        for at_s, door in ((0.0, "can"), (0.2, "zenoh"))
    ]
    simulation = Simulation(parse_scene({**scene_document(SCENE), "commands": [], "faults": faults}))
    servers, rows = {door: MemoryServer() for door in ("zenoh", "can")}, dict[str, list[int]]()
    for door, server in servers.items():
        MemoryClient(server).subscribe(
            sensor_key("probes"),
            lambda _, payload, door=door: rows.setdefault(door, []).append(decode_block(payload, SAMPLE_SCHEMA).index),
        )
    Service(simulation, Fanout([*servers.values()], transports=servers), FreeRun(), block_ticks=10_000).run()
    assert rows == {"can": [*range(2000, 8000, 200)], "zenoh": [*range(0, 4000, 200), *range(6000, 8000, 200)]}
    with pytest.raises(InputError, match="door must be one that this rig has: zenoh"):
        Service(Simulation(simulation.scene), MemoryServer(), FreeRun(), block_ticks=10_000)
