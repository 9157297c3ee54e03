"""Acceptance of the protection monitor: tables of `protection_acceptance`, with the rig's own faults."""

from __future__ import annotations

import math
from typing import Any

import pytest

from tests.fault_cases import MONITORED, MONITORED_PULSES
from tests.unit import protection_acceptance as table
from tests.unit.protection_acceptance import make_settings, run_monitor, simulate_sine

SETTLED_START = {"startup_s": 2.0}
"""The high-pass of 0.5 Hz has settled."""


def kinds(settings: Any, rows: list[Any]) -> set[str]:
    return {action.kind for action in run_monitor(settings, rows)}


@pytest.mark.parametrize(("peak_to_peak_um", "expected"), table.ALARMS.items())
def test_alarms_are_within_1_percent_of_their_set_points(peak_to_peak_um: float, expected: set[str]) -> None:
    actions = run_monitor(make_settings(**SETTLED_START), simulate_sine(peak_to_peak_um, duration_s=2.5))
    assert {(action.kind, action.name) for action in actions if action.kind != "trip"} == {
        (kind, name) for kind in expected - {"trip"} for name in ("disk_x", "disk_y")
    }
    assert any(action.kind == "trip" for action in actions) == ("trip" in expected)


@pytest.mark.parametrize(("frequency_hz", "measure", "level_um"), table.VALUES)
def test_channel_values_are_accurate_to_1_percent(frequency_hz: float, measure: Any, level_um: float) -> None:
    rows = simulate_sine(800.0, frequency_hz, duration_s=2.5)
    assert kinds(make_settings(**SETTLED_START, measure=measure, alert_um=0.99 * level_um), rows) == {"alert"}
    assert (
        kinds(make_settings(**SETTLED_START, measure=measure, alert_um=1.01 * level_um, danger_um=2000.0), rows)
        == set()
    )


@pytest.mark.parametrize(("times", "gain"), table.CORNER)
def test_the_corner_is_at_its_declared_frequency(times: float, gain: float) -> None:
    rows = simulate_sine(800.0, 4.0 * times, duration_s=1.5)
    for part, expected in ((0.99, {"alert"}), (1.01, set())):
        given = make_settings(corner_hz=4.0, window_s=0.3, startup_s=1.0, alert_um=part * gain * 800.0)
        assert kinds(given, rows) == expected


@pytest.mark.parametrize(("volts", "okay"), table.LIMITS)
def test_ok_limits_are_at_their_declared_voltage(volts: float, okay: bool) -> None:
    rows = simulate_sine(0.0, duration_s=0.6, commands=[table.make_fault("open", level_v=volts)])
    found = [(action.name, action.row) for action in run_monitor(make_settings(alert_um=1e5, danger_um=1e5), rows)]
    assert found == ([] if okay else [("disk_x", 5000)]), "the fault begins at 0.25 s"


@pytest.mark.parametrize("kind", MONITORED)
def test_a_fault_has_the_effect_of_the_vote(kind: str) -> None:
    numbers, expected = MONITORED[kind]
    rows = simulate_sine(200.0, duration_s=0.8, commands=[table.make_fault(kind, **numbers)])
    assert tuple(table.classify_actions(rows, *vote) for vote in table.VOTES) == expected


def test_the_edge_of_a_broken_cable_is_a_danger_only_without_a_delay() -> None:
    changes = {"duration_s": 0.4, "commands": [table.make_fault("open")]}
    rows = list(table.simulate_stream("probes", changes, "stable-run"))  # after the low-pass, which test signals bypass
    for delay_s, expected in ((0.0, True), (1e-4, False)):
        actions = run_monitor(make_settings(danger_delay_s=delay_s), rows)
        assert any(action.kind == "trip" for action in actions) == expected
        assert [(action.name, action.row) for action in actions if action.kind == "not-ok"] == [("disk_x", 5003)]


@pytest.mark.parametrize("kind", MONITORED_PULSES)
def test_a_fault_of_the_keyphasor_has_its_declared_effect(kind: str) -> None:
    numbers, expected = MONITORED_PULSES[kind]
    given = make_settings(overspeed_hz=7.0, speed_lost_s=0.3)
    assert kinds(given, table.simulate_keyphasor(kind, **numbers)) - {"clear"} == expected


@pytest.mark.parametrize(("ramp_hz_s", "delay_s", "established"), table.WHIRL)
def test_a_trip_stops_whirl_where_drive_and_delay_are_fast(ramp_hz_s: float, delay_s: float, established: bool) -> None:
    trip_s, found = table.simulate_trip(ramp_hz_s, delay_s)
    assert found == established
    # The level exceeds its set point 6.3 ms after the start of the pulse; the trip is at the end of a block.
    assert math.isclose(trip_s, 0.01 * math.ceil(100.0 * (0.0063 + delay_s)))


def test_noise_raises_no_alarm() -> None:
    assert table.run_noise(4.0 / 3600.0)[0] == []
