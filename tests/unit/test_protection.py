"""The protection monitor: hand-computed rows, its settings, and its broken mutants."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from drivers.protection import Settings
from drivers.protection.__main__ import parse
from rig.base.errors import InputError
from tests.unit import protection_scenarios
from tests.unit.protection_mutants import MUTANTS, Mutant
from tests.unit.protection_scenarios import SCENARIOS, sound


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_monitor(name: str) -> None:
    SCENARIOS[name](sound())


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_each_mutant_is_detected_by_its_scenario(mutant: Mutant) -> None:
    assert mutant.fails(mutant.told_by)


def test_each_scenario_detects_a_mutant() -> None:
    assert {mutant.told_by for mutant in MUTANTS} == set(SCENARIOS)


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


def test_each_setting_is_an_option() -> None:
    line = "zenoh:127.0.0.1:1 --alert-um 500 --danger-um 1500 --vote 2oo2 --bypass disk_x --no-latch-danger --trip stop"
    url, settings = parse(line.split())
    assert url == "zenoh:127.0.0.1:1"
    assert settings == Settings(
        alert_um=500, danger_um=1500, vote="2oo2", bypass=("disk_x",), latch_danger=False, trip="stop"
    )
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
