"""The paper's runs with one parameter set, and the numbers for its statements."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from replays.estimate.least_squares import solve
from replays.studies.paper.scans.pulse import (
    BANDWIDTH,
    FORCE_N,
    MEASURED_N,
    SPEED_HZ,
    Pulse,
    PulseRun,
    apply_low_pass,
    pulse_scene,
    read_outcome,
)
from replays.studies.paper.scans.spread import column, hypercube
from rig.channels.orbit import full_spectrum, waterfall
from rig.physics.magnets import map_force
from rig.physics.parameters import load_parameters
from rig.run.offline import Run, simulate
from rig.run.scenes import load_scene

SPEEDS_HZ = (3.2, 4.2, 5.2, 6.2)
"""Speeds of Fig. 17 [Hz]."""
FIG_7_M = 0.010
PULSE_S = 0.5
"""Time of the pulse in the long run [s]."""
_RATE_HZ = 20_000
_MIN_REBOUND = 0.01
"""Height of a rebound that counts, relative to the fall."""
G = 9.80665
"""Standard gravity [m/s^2]."""
_RESTS = 0.01
"""Distance from the ring, relative to the clearance, below which a drop counts as settled."""


@dataclass(frozen=True)
class Reproduction:
    """The paper's runs with one parameter set.

    Attributes:
        parameters: The set.
        drop: Section 6.1, with all sensors.
        whirl: Sections 6.2 and 6.3, with all sensors; the pulse is at `PULSE_S`.
        held: The same with a drive at constant speed, truth only.
        speeds: Section 6.4 by speed of the drive [Hz], truth only.
        numbers: Numbers from these runs, in the units of their statements.
    """

    parameters: str
    drop: Run
    whirl: Run
    held: Run
    speeds: dict[float, Run]
    numbers: dict[str, float]


def reproduce(parameters: str, *, quick: bool = False, progress: Callable[[str], None] | None = None) -> Reproduction:
    """Run the paper's experiments.

    Args:
        parameters: The set.
        quick: Use shorter runs.
        progress: Function that receives the name of each completed run.
    """
    report = progress or (lambda _: None)
    sensed = {"parameters": parameters, "sensors.rate_hz": _RATE_HZ}
    drop = simulate(load_scene("drop", {**sensed, "duration_s": 1.5}))
    report(f"drop, {parameters}")
    command = {"at_s": PULSE_S, "command": "hammer", "force_n": FORCE_N, "duration_ms": 5.0, "direction": "x"}
    long = {**sensed, "duration_s": 2.0 if quick else 4.0, "drive.speed_hz": SPEED_HZ, "commands": [command]}
    whirl = simulate(load_scene("hammer", long))
    report(f"hammer run, {parameters}")
    ideal = {"drive.mode": "ideal", "sensors.chain": "ideal", "sensors.groups": ["hammer"]}
    held = simulate(load_scene("hammer", {**long, **ideal}))
    report(f"hammer run, drive held, {parameters}")
    speeds = {}
    for speed in SPEEDS_HZ:
        speeds[speed] = simulate(pulse_scene(Pulse(parameters=parameters, speed_hz=speed)))
        report(f"{speed:g} Hz, {parameters}")
    numbers = {
        "magnet_force": magnet_force(whirl),
        "drop_reaction": drop_numbers(drop)["drop_reaction"],
        **_whirl_numbers(whirl),
        **{f"force_{speed:g}": read_outcome(run, at_s=0.02).reaction_x_n for speed, run in speeds.items()},
    }
    return Reproduction(parameters, drop, whirl, held, speeds, numbers)


def magnet_force(run: Run) -> float:
    """Return the largest magnet force over the axis of Fig. 7 [N]."""
    line = np.linspace(0.0, FIG_7_M, 101)
    return float(np.abs(map_force(line, np.zeros_like(line), run.simulation.model.constants.magnet)[:, 0]).max())


def drop_spread(parameters: str, samples: int) -> dict[str, np.ndarray]:
    """Return numbers of the drop with all assumed values varied together, by statement, each of shape (n,).

    Ambiguous statements contribute both readings: the path in the ring or at the probes, the acceleration in m/s² or in
    g, the reaction relative to its own contact force or to that of a rigid housing.
    """
    readings_by_name: dict[str, list[float]] = {}
    own = load_parameters(parameters).entries
    for pulse in hypercube(samples, parameters=parameters)[1]:
        changes = {key: value for key, value in pulse.changes.items() if key in own}
        run, rigid = (
            bare_drop({**changes, "parameters": parameters, **more}) for more in ({}, {"model.stator": "rigid"})
        )
        numbers = drop_numbers(run, bandwidth_hz=pulse.changes[BANDWIDTH])
        for name, value in numbers.items():
            readings = (value, value / G) if name.endswith("acceleration") else (value,)
            readings_by_name.setdefault(name.removesuffix("_disk"), []).extend(readings)
        south = numbers["drop_reaction"]
        contact, still = (float(each["normal_force"].max()) for each in (run, rigid))
        readings_by_name.setdefault("drop_amplified", []).extend((south / contact, south / still))
    return {name: np.array(values) for name, values in readings_by_name.items()}


def bare_drop(changes: dict[str, Any]) -> Run:
    """Run a drop with ideal sensors."""
    ideal = {"sensors.chain": "ideal", "sensors.groups": ["hammer"], "sensors.rate_hz": _RATE_HZ}
    return simulate(load_scene("drop", {**changes, **ideal, "duration_s": 0.4}))


def drop_impact(run: Run) -> tuple[float, float]:
    """Return the time [s] and speed [m/s] at which the shaft first reaches the ring.

    The fall is a parabola to within 1e-5 (the shaft turns by some mrad); it is fitted and extrapolated to the ring.
    """
    first = int(np.argmax(run["contact_impulse"] > 0.0))
    height = run["ring_y"] + run.simulation.model.constants.contact.clearance
    before = slice(0, first - 1)
    a, b, c = solve(np.vander(run.times_s[before], 3), height[before])
    time_s = (-b - math.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    return float(time_s), float(-2.0 * a * time_s - b)


def drop_rebounds(run: Run) -> np.ndarray:
    """Return the heights of the rebounds after the first contact, relative to the fall, of those of at least 1 %."""
    contact = run.simulation.model.constants.contact
    height = (run["ring_y"] + contact.clearance) / (2.0 * contact.clearance)
    pushed = np.flatnonzero(np.diff(run["contact_impulse"]) > 0.0)
    peaks = np.array([height[a + 1 : b + 1].max() for a, b in pairwise(pushed.tolist()) if b - a > 1])
    return peaks[peaks >= _MIN_REBOUND]


def drop_impulse(run: Run) -> float:
    """Return the impulse of the first contact [N s]."""
    impulse = run["contact_impulse"]
    first = int(np.argmax(impulse > 0.0))
    still = np.flatnonzero(np.diff(impulse[first:]) == 0.0)
    return float(impulse[first + int(still[0])]) if len(still) else math.nan


def drop_numbers(run: Run, *, bandwidth_hz: float = 4900.0) -> dict[str, float]:
    """Return numbers of a drop from the top of the ring; measured ones pass a low-pass filter."""
    contact = run.simulation.model.constants.contact
    leaves = np.flatnonzero(run["penetration"] < -_RESTS * contact.clearance)
    south = run["P_S"] - run["P_N"]
    settled = float(run.times_s[leaves[-1] + 1]) if leaves[-1] + 1 < len(run.times_s) else math.inf
    return {
        "drop_span": float(np.abs(run["ring_y"]).max() * 1e3),
        "drop_span_disk": float(np.abs(run["disk_y"]).max() * 1e3),
        "drop_settled": settled * 1e3,
        "drop_bounces": float(len(drop_rebounds(run))),
        "drop_reaction": float(south.max()),
        "drop_acceleration": float(np.abs(run["inner_ay"]).max()),
        "drop_sensed": float(apply_low_pass(run, south, bandwidth_hz).max()),
        "drop_sensed_acceleration": float(np.abs(apply_low_pass(run, run["inner_ay"], bandwidth_hz)).max()),
    }


def pulse_spread(spread: list[PulseRun], slow: list[PulseRun], lasting: list[PulseRun]) -> dict[str, np.ndarray]:
    """Return numbers of the pulse with all assumed values varied together, by statement, each of shape (n,).

    Args:
        spread: Runs at 6.2 Hz; numbers of the whirl come from those that whirl.
        slow: The first of these at 3.2 Hz.
        lasting: The first of these for 20 s, as long as Fig. 13.
    """
    whirling = [one for one in spread if one.whirls]
    pairs = [(low, high) for low, high in zip(slow, spread, strict=False) if low.whirls and high.whirls]

    def values_of(name: str, scale: float = 1.0) -> np.ndarray:
        return scale * column(whirling, name)

    return {
        "backward": np.array([float(one.whirls and one.whirl_hz < 0.0) for one in spread]),
        "roll": values_of("roll_s", 1e3),
        # Two readings: at the disk, or in the clearance.
        "orbit_ring": np.concatenate([values_of("ring_m", 1e3), values_of("disk_m", 1e3)]),
        "orbit_disk": values_of("disk_m", 1e3),
        "spin_lowest": column(spread, "slowest_hz"),
        "whirl_hz": values_of("whirl_hz", -1.0),
        "whirl_per_spin": np.abs(values_of("whirl_hz") / values_of("spin_hz")),
        "peak_x": column(spread, "true_peak_x_n"),
        "peak_y": column(spread, "true_peak_y_n"),
        "peak_sensed": np.maximum(column(spread, "peak_x_n"), column(spread, "peak_y_n")),
        "steady": values_of("ripple_n", 100.0) / values_of("normal_n"),
        "east": values_of("reaction_x_n"),
        # A spectral line at the spin requires a long window.
        "imbalance": 100.0 * column([one for one in lasting if one.whirls], "imbalance"),
        "measured": values_of("reaction_x_n", 1.0 / MEASURED_N),
        "bouncing": values_of("true_peak_x_n") / values_of("reaction_x_n"),
        "lasts": np.array([float(one.whirls) for one in lasting]),
        "slowest_whirls": np.array([float(one.whirls) for one in slow]),
        "period_ratio": np.array([low.whirl_hz / high.whirl_hz for low, high in pairs]),
        "impulsive_ratio": np.array([high.slope_n_s / low.slope_n_s for low, high in pairs]),
    }


def _whirl_numbers(run: Run) -> dict[str, float]:
    truth = read_outcome(run, at_s=PULSE_S)
    last = run.times_s > 0.5 * run.times_s[-1]
    return {
        "orbit_ring": truth.ring_m * 1e3,
        "orbit_disk": truth.disk_m * 1e3,
        "whirl_hz": abs(truth.whirl_hz),
        "sensed_x": float(np.ptp(run.samples["P_E"][last] - run.samples["P_W"][last]) / 2),
        "east": truth.reaction_x_n,
    }


def spectra(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the full spectra of the disk's probes over time, as `rig.channels.orbit.waterfall` [mm]."""
    return waterfall(run.samples["disk_x"], run.samples["disk_y"], float(_RATE_HZ), run.times_s)


def fine_spectrum(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Return the full spectrum of the orbit at the disk over the last half of a run [Hz], [mm]; 2 s resolve 1 Hz."""
    half = len(run.times_s) // 2
    x, y = (run[name][half:] * 1e3 for name in ("disk_x", "disk_y"))
    return full_spectrum(x, y, float(_RATE_HZ), lines=8 * len(x))
