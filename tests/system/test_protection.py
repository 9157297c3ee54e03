"""The protection monitor in a separate process trips a rig: at an exact tick in lockstep, with a contact in the
stream.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import rig
from drivers.protection import Protection
from drivers.protection.__main__ import parse
from drivers.sources.samples import Samples
from tests import processes
from tests.waiting import PATIENCE_S

OPTIONS = ("--alert-um", "500", "--danger-um", "1500", "--startup-s", "0.02", "--danger-delay-s", "0.0123")  # 246 rows
BLOCK_TICKS = 10_000


def run_until_trip() -> tuple[list[str], list[dict[str, Any]], list[Samples]]:
    """Return the monitor's lines, its events in the stream, and the rows before and after an impact."""
    changes = ("--pace", "lockstep", "--set", "commands=[]", "--block-ms", str(BLOCK_TICKS // 1000))
    with processes.running_rig("hammer", *changes) as (child, endpoint):
        url = f"zenoh:{endpoint}"
        with rig.connect(url, channels=["disk_x", "disk_y", "speed"], wait_s=PATIENCE_S) as machine:
            with processes.start_python("-m", "drivers.protection", url, *OPTIONS) as device:
                assert machine.event("device", timeout_s=PATIENCE_S)["state"] == "joined"
                rows = [machine.advance(0.1)]
                machine.hammer(force_n=120.0, direction=30.0)
                rows.append(machine.advance(0.4))
                machine.stop()
                output, errors = device.communicate(timeout=PATIENCE_S)
                assert (device.returncode, errors) == (0, "")
            lines = output.splitlines()[1:]
            # A note at its start, one for each line, and the trip's command.
            events = [machine.event(lambda event: event["event"] in ("speed", "note")) for _ in range(len(lines) + 2)]
        child.wait(timeout=PATIENCE_S)
    return lines, [{**event, "wall_s": 0.0} for event in events], rows


@pytest.mark.parametrize("transport", ["zenoh", "can"])
def test_a_monitor_whose_trip_is_refused_reports_it_and_monitors_to_the_end(transport: str) -> None:
    """A test signal has no drive: the rig refuses the speed."""
    can = f"zenoh:can0?endpoint={processes.free_endpoint()}"
    changes = ("--set", "generator.amplitude_v=2.2", "--set", "generator.frequency_hz=50")
    with processes.running_rig("test-sine", *changes, "--pace", "lockstep", "--can", can) as (_, endpoint):
        url = f"zenoh:{endpoint}" if transport == "zenoh" else f"can:{can}&node=4"
        options = ("--alert-um", "500", "--danger-um", "1010", "--startup-s", "0.02", "--danger-delay-s", "0.01")
        with (
            rig.connect(f"zenoh:{endpoint}", channels=["disk_x"], wait_s=PATIENCE_S) as machine,
            processes.start_python("-m", "drivers.protection", url, *options) as device,
        ):
            assert machine.event("device", timeout_s=PATIENCE_S)["state"] == "joined"
            machine.advance(0.5)
            assert machine.lost == {}, "it still takes part"
            notes = [machine.event("note")["tags"][-1]]
            while notes[-1] != "trip-refused":
                notes.append(machine.event("note")["tags"][-1])
            assert "trip" in notes, "it is reported first"
            machine.stop()
            output, errors = device.communicate(timeout=PATIENCE_S)
    assert (device.returncode, errors) == (0, "")
    assert "trip-refused  speed" in output


def test_an_impact_trips_the_rig_at_the_end_of_its_block_reproducibly() -> None:
    lines, events, rows = run_until_trip()
    again = run_until_trip()
    assert (again[0], again[1]) == (lines, events)
    assert all(np.array_equal(one.values, other.values) for one, other in zip(rows, again[2], strict=True))
    # The same rows at once, fed to the same rules.
    whole = Samples(0, 0, 20_000.0, 1e6, rows[0].names, rows[0].units, np.vstack([each.values for each in rows]))
    actions = Protection(parse(OPTIONS)[1]).feed(whole)
    assert lines == [str(action) for action in actions]
    danger, tripped = actions[0], next(action for action in actions if action.kind == "trip")
    assert (danger.kind, danger.row) == ("danger", tripped.row)
    end = tripped.tick // BLOCK_TICKS * BLOCK_TICKS + BLOCK_TICKS
    speed = next(event for event in events if event["event"] == "speed")
    assert (speed["tick"], speed["speed_hz"]) == (end, 0.0)
    contact = next(event for event in events if "trip" in event.get("tags", ()))
    assert (contact["tick"], contact["tags"], contact["from"]) == (end, ["protection", "trip"], "protection")
    # Its level exceeded 1500 um one delay earlier, within two rows, because the gap is removed slowly.
    level = 1e3 * (np.maximum.accumulate(whole[danger.name]) - np.minimum.accumulate(whole[danger.name]))
    assert abs(int(np.argmax(level > 1500.0)) + 246 - danger.row) <= 2
    assert (whole["speed"][tripped.row] > 5.0, whole["speed"][-1] < 5.6) == (True, True)
