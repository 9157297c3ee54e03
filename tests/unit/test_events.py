"""Events: every kind that a rig can publish is recorded, read, and accepted by a validation."""

from __future__ import annotations

import ast
import threading
from pathlib import Path
from typing import Any

import pytest

import rig
from drivers.console import Console
from recorder.reader import Recording
from recorder.session import RecordingSession
from replays.campaigns.files.event_fields import check_event
from replays.campaigns.files.expectation import EventOf
from replays.recordings.export import write_run
from replays.recordings.validation import validate
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import default_table
from rig.run.commands.table import COMMANDS, EVENT_KINDS, MECHANICAL
from rig.run.scenes import parse_scene
from rig.run.simulation import Simulation
from rig.serve.pacing import Lockstep
from rig.serve.service import Service
from rig.serve.stream_check import parse_event
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.waiting import PATIENCE_S, until

SENSORS = {"groups": ["probes", "forces"]}


def find_event_kinds() -> set[str]:
    """Return the kinds of events in the code, in `_event("...")` and in `{"event": "..."}`."""
    found = set[str]()
    folder = Path(rig.__file__).parent
    for path in (*folder.rglob("*.py"), folder.parent / "replays/recordings/export.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "_event":
                found |= {arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant)}
            elif isinstance(node, ast.Dict):
                pairs = zip(node.keys, node.values, strict=True)
                found |= {
                    value.value
                    for key, value in pairs
                    if isinstance(key, ast.Constant) and key.value == "event" and isinstance(value, ast.Constant)
                }
    return found - {"blocks"}  # of rig/truth/faults


def test_the_table_of_events_is_complete() -> None:
    assert set(COMMANDS) | find_event_kinds() == set(EVENT_KINDS)


def check_fields(event: dict[str, Any]) -> None:
    """Raise an error unless a campaign can select the event by all of its fields."""
    where = {name: value for name, value in event.items() if name != "event" and value not in (None, {})}
    selector = EventOf(event=event["event"], where=where)
    check_event(selector, [*default_table().channels, *default_table().groups], field="event")


def test_every_kind_of_event_is_recorded_and_validated(tmp_path: Path) -> None:
    """In one run: a new kind in the table without a case here fails."""
    # A hammer pulse of the scene overlaps a commanded one: a warning.
    timed = [{"at_s": 0.042, "command": "hammer", "duration_ms": 1.0}]
    scene = parse_scene({"duration_s": 0.1, "commands": timed, "sensors": SENSORS})
    server = MemoryServer()
    service = Service(Simulation(scene), server, Lockstep(), block_ticks=10_000)
    session = RecordingSession(MemoryClient(server), tmp_path / "a.mcap", history=True)
    service.prepare()
    threads = [threading.Thread(target=service.run), threading.Thread(target=lambda: summaries.append(session.run()))]
    summaries = list[Any]()
    for thread in threads:
        thread.start()
    console = Console(MemoryClient(server), name="bench")
    until(lambda: console.status()["state"] == "running")
    console.note("begin")
    console.join("dut")
    console.leave("dut")
    for name in MECHANICAL:
        needed = {field: 5.0 for field, each in COMMANDS[name].quantities().items() if each.required}
        if name != "hammer":  # below, as it overlaps another
            console.send(name, **needed)
    for number in (1.1, 1.2, 1.3):
        console.fault("P_E", "gain", factor=number)
    console.fault("probes", "dropout", for_s=0.01)
    console.step(10_000)
    console.clear(1)
    console.step(30_000)
    console.hammer(force_n=50.0, duration_ms=5.0)
    console.clear()
    console.step(60_000)
    for thread in threads:
        thread.join(PATIENCE_S)
    (summary,) = summaries
    assert (summary.malformed, summary.good) == (0, True)
    recording = Recording.open(tmp_path / "a.mcap")
    events = recording.events
    assert {event["event"] for event in events} == set(EVENT_KINDS)
    for event in events:  # the checks of campaigns know every field
        check_fields(event)
    cleared = [event for event in events if event["event"] == "clear"]
    assert [(event["id"], event["fault"]) for event in cleared] == [(4, [4]), (1, [1]), (2, [2]), (3, [3])]
    assert recording.doubts == ()
    assert validate(recording).good


@pytest.mark.parametrize(("commands", "ids"), [
    ([{"at_s": 0.02, "command": "clear"}], [1, 2]),
    ([{"at_s": 0.02, "command": "clear", "id": 2}, {"at_s": 0.03, "command": "clear"}], [2, 1]),
    ([{"at_s": 0.02, "command": "clear"}, {"at_s": 0.03, "command": "clear"}], [1, 2, None]),
    ([{"at_s": 0.02, "command": "clear", "id": 1}, {"at_s": 0.02, "command": "clear"}], [1, 2]),
])  # fmt: skip
def test_a_scene_that_clears_all_faults_is_good(
    commands: list[dict[str, Any]], ids: list[int | None], tmp_path: Path
) -> None:
    gain = {"at_s": 0.01, "command": "fault", "channel": "P_E", "kind": "gain", "factor": 1.1}
    lost = {"at_s": 0.01, "command": "fault", "channel": "probes", "kind": "dropout"}
    scene = parse_scene({"duration_s": 0.05, "commands": [gain, lost, *commands], "sensors": SENSORS})
    write_run(Simulation(scene), tmp_path / "a.mcap")
    recording = Recording.open(tmp_path / "a.mcap")
    assert [event["id"] for event in recording.events if event["event"] == "clear"] == ids
    assert validate(recording).good


def test_events_of_earlier_recordings_are_read() -> None:
    cleared = {"event": "clear", "tick": 1, "time_s": 1e-6, "id": "all", "fault": [1]}
    assert parse_event(wire.encode_document(cleared)) == cleared
    with pytest.raises(InputError):
        parse_event(wire.encode_document({**cleared, "id": "some"}))
