"""The protection monitor: hand-computed rows, its settings, and its broken mutants."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from drivers.protection import Settings
from drivers.protection.__main__ import act, parse
from drivers.protection.monitor import Action
from rig.base.errors import InputError, RefusedError
from rig.serve.transport import DEFAULT_ENDPOINT
from tests.unit import protection_scenarios
from tests.unit.protection_mutants import MUTANTS, Mutant
from tests.unit.protection_scenarios import SCENARIOS, sound


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_monitor(name: str) -> None:
    SCENARIOS[name](sound())


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_each_mutant_is_detected_by_its_scenario(mutant: Mutant) -> None:
    assert mutant.fails(mutant.told_by)


@pytest.mark.parametrize("text", ["Protection", "no such text"])
def test_a_mutant_whose_text_does_not_occur_once_is_an_error(text: str) -> None:
    with pytest.raises(ValueError, match=r"a defect: the replaced text must occur once; received \d+ times"):
        Mutant("a defect", "overspeed_trips", text, "").fails("overspeed_trips")


def test_each_scenario_detects_a_mutant() -> None:
    assert {mutant.told_by for mutant in MUTANTS} == set(SCENARIOS)


class Machine:
    """A rig that refuses what it is told to refuse, and records what it is asked."""

    def __init__(self, *refused: str) -> None:
        self.refused, self.asked = refused, list[str]()

    def note(self, text: str, *, tags: list[str]) -> None:
        self._take("note", tags[1])

    def speed(self, hz: float) -> None:
        self._take("speed", f"speed {hz:g}")

    def stop(self) -> None:
        self._take("stop", "stop")

    def _take(self, command: str, words: str) -> None:
        self.asked.append(words)
        if command in self.refused:
            raise RefusedError(f"{command} must be left out")


ACTIONS = [Action(kind, "disk_x", 7, 350, 0.00035, 1100.0) for kind in ("danger", "trip", "not-ok")]


@pytest.mark.parametrize(("trip", "asked"), [("speed 0", "speed 0"), ("stop", "stop")])
def test_a_trip_is_reported_before_it_is_commanded(trip: Any, asked: str) -> None:
    machine, lines = Machine(), list[str]()
    act(machine, Settings(alert_um=500, danger_um=1000, trip=trip), ACTIONS, lines.append)
    assert machine.asked == ["danger", "trip", "not-ok", asked]
    assert lines == [str(action) for action in ACTIONS]


@pytest.mark.parametrize("trip", ["speed 0", "stop"])
def test_a_refused_trip_is_reported_and_the_monitor_continues(trip: Any) -> None:
    machine, lines = Machine("speed", "stop"), list[str]()
    act(machine, Settings(alert_um=500, danger_um=1000, trip=trip), ACTIONS, lines.append)
    assert machine.asked[-1] == "trip-refused"
    assert lines[-1] == f"0.000350 s  trip-refused  {trip.split()[0]} must be left out"


def test_refused_notes_do_not_prevent_the_trip() -> None:
    machine, lines = Machine("note"), list[str]()
    act(machine, Settings(alert_um=500, danger_um=1000), ACTIONS, lines.append)
    assert machine.asked[-1] == "speed 0"
    assert lines[1] == "note refused: note must be left out"


@pytest.mark.parametrize(
    ("field", "changes"),
    [
        ("alert_um", {"alert_um": 1200.0}),
        ("alert_um", {"alert_um": -1.0}),
        ("danger_um", {"danger_um": "much"}),
        ("danger_delay_s", {"danger_delay_s": float("nan")}),
        ("hysteresis", {"hysteresis": 1.0}),
        ("window_s", {"window_s": 1.0, "ok_recovery_s": 0.5}),
        ("ok_low_v", {"ok_low_v": -2.0}),
        ("bypass", {"bypass": ("P_N",)}),
        ("vote", {"vote": "2oo3"}),
        ("latch_danger", {"latch_danger": 3.5}),
        ("colour", {"colour": "red"}),
    ],
)
def test_impossible_settings_are_refused(field: str, changes: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=f"^{field} must be"):
        Settings(**{"alert_um": 500.0, "danger_um": 1000.0, **changes})


DEFAULTS = {
    "alert_delay_s": 1.0, "danger_delay_s": 0.1, "hysteresis": 0.02, "window_s": 0.25, "corner_hz": 0.5,
    "bias_v": -10.0, "scale_v_per_mm": 3.94, "ok_low_v": -17.5, "ok_high_v": -2.5, "ok_recovery_s": 30.0,
    "latch_alert": False, "latch_danger": True, "startup_s": 1.0, "overspeed_hz": 0.0, "overspeed_turns": 3,
    "speed_lost_s": 0.0, "reverse_turns": 0,
}  # fmt: skip
"""Settings without options: a changed one changes which alarms a user's monitor raises."""


def test_each_setting_is_an_option() -> None:
    line = "zenoh:127.0.0.1:1 --alert-um 500 --danger-um 1500 --vote 2oo2 --bypass disk_x --no-latch-danger --trip stop"
    url, settings = parse(line.split())
    assert url == "zenoh:127.0.0.1:1"
    assert settings == Settings(
        alert_um=500, danger_um=1500, vote="2oo2", bypass=("disk_x",), latch_danger=False, trip="stop"
    )
    assert parse(["--alert-um", "1", "--danger-um", "1"])[0] == "zenoh:" + DEFAULT_ENDPOINT
    assert DEFAULTS.items() <= Settings(alert_um=1, danger_um=1).model_dump().items()
    with pytest.raises(InputError, match=r"^overspeed_hz must be"):
        parse([*line.split(), "--overspeed-hz", "-1"])


def test_another_stream_is_refused() -> None:
    monitor = sound().Protection(protection_scenarios.settings())
    rows = protection_scenarios.samples(disk_x=0.0, disk_y=0.0)
    monitor.feed(rows)
    with pytest.raises(InputError, match="rate_hz must be 1000 Hz as before; received 2000"):
        monitor.feed(replace(rows, rate_hz=2000.0))
    with pytest.raises(InputError, match="unit of disk_x must be"):
        monitor.feed(replace(rows, index=1, units=("N", "mm")))
