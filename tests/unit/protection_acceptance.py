"""Acceptance tables of the protection monitor: alarms, channel values, corners, OK limits, faults and votes.

Signals are test scenes, fed to the converters' inputs, with the rig's own faults on the probe disk_x; expected results
are in each table. `python -m tests.unit.protection_acceptance [HOURS]` feeds an hour just below an alert, and no alarm
must occur.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.protection import Action, Protection, Settings
from drivers.sources.samples import Samples
from rig.base.wire import Block
from rig.physics.kernels.signals import COLUMN
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

ALERT_UM, DANGER_UM = 500.0, 1000.0
BEGIN_S, END_S = 0.25, 0.75
"""Start and end of a fault [s]: after the start-up, and longer than all delays."""


def make_settings(**changes: Any) -> Settings:
    """Return the monitor's settings: alarms after 0.1 s, over 0.25 s."""
    base = {
        "alert_um": ALERT_UM,
        "danger_um": DANGER_UM,
        "alert_delay_s": 0.05,
        "danger_delay_s": 0.05,
        "startup_s": 0.15,
        "window_s": 0.1,
    }
    return Settings(**{**base, **changes})


def simulate_stream(group: str, changes: dict[str, Any], scene: str = "test-sine") -> Iterator[Samples]:
    """Yield blocks of a channel group as the rig sends them."""
    simulation = Simulation(load_scene(scene, {"sensors.groups": [group], "drive.speed_hz": 6.2, **changes}))
    while simulation.tick < simulation.end_tick:
        for message in simulation.advance(min(100_000, simulation.end_tick - simulation.tick)).messages:
            if message.key.endswith(f"/{group}") and len(message.block.values):
                yield convert_block(simulation, group, message.block)


def convert_block(simulation: Simulation, group: str, block: Block) -> Samples:
    """Convert a block to engineering units."""
    table = simulation.table.groups[group]
    units = tuple(channel.unit for channel in table.channels)
    values = table.engineering(block.values)
    return Samples(block.index, block.tick, block.rate_hz, block.tick_rate_hz, table.names, units, values)


def run_monitor(settings: Settings, rows: list[Samples]) -> list[Action]:
    """Feed rows to a monitor and return its actions."""
    device = Protection(settings)
    return [action for samples in rows for action in device.feed(samples)]


def sine_changes(peak_to_peak_um: float, frequency_hz: float, duration_s: float) -> dict[str, Any]:
    """Return changes that make `test-sine` a sine on both probes, y a quarter period late."""
    return {
        "generator.amplitude_v": 3.94 * 0.5e-3 * peak_to_peak_um, "generator.frequency_hz": frequency_hz,
        "duration_s": duration_s, "generator.channels": {"disk_y": {"phase_deg": -90.0}},
    }  # fmt: skip


def simulate_sine(
    peak_to_peak_um: float, frequency_hz: float = 10.0, duration_s: float = 1.5, **changes: Any
) -> list[Samples]:
    """Return rows of that sine."""
    return list(simulate_stream("probes", {**sine_changes(peak_to_peak_um, frequency_hz, duration_s), **changes}))


ALARMS = {
    # peak-to-peak [um]: alarms of both probes
    0.99 * ALERT_UM: set(),
    1.01 * ALERT_UM: {"alert"},
    0.99 * DANGER_UM: {"alert"},
    1.01 * DANGER_UM: {"alert", "danger", "trip"},
}

VALUES = [
    # frequency [Hz], measure, level [um] of a sine of 800 um peak-to-peak on x and, a quarter period late, on y
    (10.0, "peak-to-peak", 800.0),
    (83.0, "peak-to-peak", 800.0),
    (997.0, "peak-to-peak", 800.0),
    (83.0, "smax", 400.0),
]

CORNER = [
    # frequency [times the corner], gain 1 / sqrt(1 + (corner / f)^2)
    (1.0, 0.7071),
    (2.0, 0.8944),
    (10.0, 0.9950),
]

LIMITS = [
    # constant voltage of disk_x, whether it is OK: the limits are -17.5 and -2.5 V
    (-17.6, False),
    (-17.4, True),
    (-2.6, True),
    (-2.4, False),
]


def make_fault(kind: str, **numbers: Any) -> dict[str, Any]:
    """Return a fault of disk_x as a command of a scene."""
    given = {"channel": "disk_x", **numbers}
    return {"at_s": BEGIN_S, "command": "fault", "kind": kind, "for_s": END_S - BEGIN_S, **given}


VOTES = (("1oo2", "leaves"), ("2oo2", "leaves"), ("2oo2", "for"), ("1oo2", "for"))


def simulate_keyphasor(kind: str, **numbers: Any) -> list[Samples]:
    """Return rows of a shaft at rest between its probes, turning at 6.2 Hz, with a fault of its keyphasor."""
    command = {"at_s": 0.4, "command": "fault", "channel": "keyphasor", "kind": kind, **numbers}
    rows = simulate_stream("drive", {"duration_s": 1.2, "commands": [command]}, "stable-run")
    return [
        replace(each, names=("disk_x", "disk_y", "keyphasor"), units=("mm", "mm", "1"),
                values=np.column_stack([np.zeros((len(each), 2)), each["keyphasor"]]))
        for each in rows
    ]  # fmt: skip


def classify_actions(rows: list[Samples], vote: str, not_ok: str) -> str:
    """Classify the actions: T, a trip; N, NOT OK; a, an alarm without a trip; -, nothing."""
    kinds = {each.kind for each in run_monitor(make_settings(vote=vote, not_ok=not_ok), rows)}
    found = "T" if "trip" in kinds else "a" if kinds & {"alert", "danger"} else ""
    return (found + ("N" if "not-ok" in kinds else "")) or "-"


WHIRL = [
    # Ramp of the drive [Hz/s], delay of danger [s], whether whirl is established after an impact of 100 N at 6.2 Hz.
    (2.0, 0.0, True),  # the rig's own drive: even with the fastest monitor, the shaft keeps turning
    (300.0, 0.02, False),
    (300.0, 0.1, True),
]
FULL_S = 0.05
"""Contact time for an established whirl, a twentieth of it excepted, with backward rotation [s]."""


def simulate_trip(
    ramp_hz_s: float, delay_s: float, force_n: float = 100.0, block_ticks: int = 10_000
) -> tuple[float, bool]:
    """Simulate an impact at 0.1 s with the monitor in the loop; return the time to the trip [s], and whether whirl is
    established.
    """
    impact = {"at_s": 0.1, "command": "hammer", "force_n": force_n}
    changes = {"duration_s": 0.4, "drive.ramp_rate": ramp_hz_s, "commands": [impact], "sensors.groups": ["probes"]}
    simulation = Simulation(load_scene("hammer", changes))
    device = Protection(
        Settings(alert_um=1500, danger_um=1500, alert_delay_s=delay_s, danger_delay_s=delay_s, startup_s=0.05)
    )
    rows, trip_s = [], math.nan
    while simulation.tick < simulation.end_tick:
        frame = simulation.advance(block_ticks)
        rows.append(frame.rows[:, [COLUMN[name] for name in ("normal_force", "ring_x", "ring_y")]])
        if any(
            action.kind == "trip"
            for action in device.feed(convert_block(simulation, "probes", frame.samples["probes"]))
        ):
            simulation.submit("speed", {"speed_hz": 0.0})
            trip_s = 1e-6 * simulation.tick - 0.1
    force, x, y = np.vstack(rows).T
    span = round(FULL_S * 1e6 / simulation.row_ticks)
    contact = np.convolve(force > 0.0, np.ones(span) / span, "valid")
    angle = np.unwrap(np.arctan2(y, x))
    turns = (angle[span - 1 :] - angle[: 1 - span]) / (2.0 * math.pi)
    return trip_s, bool(((contact > 0.95) & (turns < -0.25)).any())


def run_noise(hours: float) -> tuple[list[Action], float]:
    """Feed hours at 98 % of the alert with the probes' noise; return the monitor's actions and the run time [s]."""
    begin = time.monotonic()
    device, actions = Protection(make_settings(startup_s=2.0)), []
    for samples in simulate_stream("probes", sine_changes(0.98 * ALERT_UM, 83.0, 3600.0 * hours)):
        actions += device.feed(samples)
    return actions, time.monotonic() - begin


if __name__ == "__main__":
    found, took_s = run_noise(float((sys.argv[1:] or ["1"])[0]))
    print(*found, f"{len(found)} actions, {took_s:.0f} s", sep="\n")
