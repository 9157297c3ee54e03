"""The paper's runs, made again with one parameter set, and every number that a statement asks for."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from replays.studies.paper.pulse import FORCE_N, SPEED_HZ, Outcome, Pulse, outcomes, pulse_scene, read
from replays.studies.paper.spread import column, phases
from replays.studies.paper.statement import statements
from rig.magnets import map_force
from rig.offline import Run, simulate
from rig.orbit import full_spectrum, waterfall, whirl_frequency
from rig.scenes import load_scene

SPEEDS_HZ = (3.2, 4.2, 5.2, 6.2)
"""Fig. 17's."""
FIG_7_M = 0.010
PULSE_S = 0.5
"""When the pulse comes in the long run [s]."""
_RATE_HZ = 20_000
_RESTS = 0.01
"""A drop has settled when it leaves the ring by less than this part of the clearance."""


@dataclass(frozen=True)
class Reproduction:
    """The paper's runs with one parameter set.

    Attributes:
        parameters: The set.
        drop: Section 6.1, all sensors on.
        whirl: Sections 6.2 and 6.3, all sensors on; the pulse comes at `PULSE_S`.
        speeds: Section 6.4 by speed of the drive [Hz], truth alone.
        ensemble: The pulse at several places of the shaft's turn.
        numbers: What each statement asks for, in its unit.
    """

    parameters: str
    drop: Run
    whirl: Run
    speeds: dict[float, Run]
    ensemble: list[Outcome]
    numbers: dict[str, float]


def reproduce(parameters: str, *, quick: bool = False, progress: Callable[[str], None] | None = None) -> Reproduction:
    """Run all of it.

    Args:
        parameters: The set.
        quick: Shorter runs, fewer of them.
        progress: Told what is done.
    """
    tell = progress or (lambda _: None)
    sensed = {"parameters": parameters, "sensors.rate_hz": _RATE_HZ}
    drop = simulate(load_scene("drop", {**sensed, "duration_s": 1.5}))
    tell(f"drop, {parameters}")
    command = {"at_s": PULSE_S, "command": "hammer", "force_n": FORCE_N, "duration_ms": 5.0, "direction": "x"}
    whirl = simulate(
        load_scene(
            "hammer",
            {**sensed, "duration_s": 2.0 if quick else 4.0, "drive.speed_hz": SPEED_HZ, "commands": [command]},
        )
    )
    tell(f"hammer run, {parameters}")
    speeds = {}
    for speed in SPEEDS_HZ:
        speeds[speed] = simulate(pulse_scene(Pulse(parameters=parameters, speed_hz=speed)))
        tell(f"{speed:g} Hz, {parameters}")
    held = next(iter(outcomes([Pulse(parameters=parameters, changes={"drive.mode": "ideal"})], processes=1)))
    ensemble = list(outcomes(phases(Pulse(parameters=parameters), 3 if quick else 15), processes=1))
    tell(f"pulses, {parameters}")
    numbers = {
        **_magnet_numbers(whirl),
        **drop_numbers(drop),
        **_whirl_numbers(whirl),
        "whirl_held_hz": abs(held.whirl_hz),
        "peak_x": float(np.median(column(ensemble, "peak_x_n"))),
        "peak_y": float(np.median(column(ensemble, "peak_y_n"))),
        **_speed_numbers({speed: read(run, at_s=0.02) for speed, run in speeds.items()}),
    }
    missing = [entry.quantity for entry in statements() if entry.quantity not in numbers]
    if missing:
        raise KeyError(f"no measure for the statements {', '.join(missing)}")
    return Reproduction(parameters, drop, whirl, speeds, ensemble, numbers)


def _magnet_numbers(run: Run) -> dict[str, float]:
    line = np.linspace(0.0, FIG_7_M, 101)
    force = map_force(line, np.zeros_like(line), run.simulation.model.constants.magnet)[:, 0]
    return {"magnet_force_10mm": float(np.abs(force).max())}


def drop_impact(run: Run) -> tuple[float, float]:
    """When the shaft first reaches the ring [s], and how fast [m/s].

    The fall before is a parabola to within 1e-5 (the shaft turns by some mrad): fitted, and carried on to the ring.
    """
    first = int(np.argmax(run["contact_impulse"] > 0.0))
    height = run["ring_y"] + run.simulation.model.constants.contact.clearance
    before = slice(0, first - 1)
    a, b, c = np.polyfit(run.times_s[before], height[before], 2)
    time_s = (-b - math.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    return float(time_s), float(-2.0 * a * time_s - b)


def drop_impulse(run: Run) -> float:
    """Impulse of the first contact [N s]."""
    impulse = run["contact_impulse"]
    first = int(np.argmax(impulse > 0.0))
    still = np.flatnonzero(np.diff(impulse[first:]) == 0.0)
    return float(impulse[first + int(still[0])]) if len(still) else math.nan


def drop_numbers(run: Run) -> dict[str, float]:
    """Numbers of a drop, after its start at the top."""
    contact = run.simulation.model.constants.contact
    leaves = np.flatnonzero(run["penetration"] < -_RESTS * contact.clearance)
    south = run["P_S"] - run["P_N"]
    sensed = run.samples["P_S"] - run.samples["P_N"]
    settled = float(run.times_s[leaves[-1] + 1]) if leaves[-1] + 1 < len(run.times_s) else math.inf
    return {
        "drop_span": float(np.abs(run["ring_y"]).max() * 1e3),
        "drop_span_disk": float(np.abs(run["disk_y"]).max() * 1e3),
        "drop_impact_ms": drop_impact(run)[0] * 1e3,
        "drop_settled_s": settled,
        "drop_reaction": float(south.max()),
        "drop_acceleration": float(np.abs(run["inner_ay"]).max()),
        "drop_sensed": float(sensed.max() - np.median(sensed[:200])),
    }


def _whirl_numbers(run: Run) -> dict[str, float]:
    truth = read(run, at_s=PULSE_S)
    last = run.times_s > run.times_s[-1] - 0.5
    sensed = [run.samples[a][last] - run.samples[b][last] for a, b in (("P_E", "P_W"), ("P_N", "P_S"))]
    east = run["P_E"][last]
    after = run.times_s > PULSE_S
    frequencies, amplitude = full_spectrum(run.samples["disk_x"][last], run.samples["disk_y"][last], _RATE_HZ)
    return {
        "backward": float(truth.whirls and truth.whirl_hz < 0.0),
        "orbit_ring": float(np.hypot(run["ring_x"], run["ring_y"])[last].mean() * 1e3),
        "orbit_disk": float(np.abs(run["disk_x"][last]).max() * 1e3),
        "spin_lowest": float(run["spin_rate"][after].min() / (2.0 * math.pi)),
        "whirl_hz": abs(whirl_frequency(run["ring_x"][last], run["ring_y"][last], run.times_s[last])),
        "whirl_per_spin": abs(truth.whirl_hz) / truth.spin_hz,
        "spectrum_hz": float(frequencies[np.argmax(amplitude)]),
        "steady": truth.ripple_n / truth.normal_n,
        "sensed_x": float(np.ptp(sensed[0]) / 2),
        "sensed_y": float(np.ptp(sensed[1]) / 2),
        "east": truth.reaction_x_n,
        "east_alone": float(np.ptp(east)),
        "east_ms": 500.0 / abs(truth.whirl_hz),
        "over_measured": truth.reaction_x_n / 500.0,
    }


def _speed_numbers(found: dict[float, Outcome]) -> dict[str, float]:
    low, high = found[SPEEDS_HZ[0]], found[SPEEDS_HZ[-1]]
    return {
        **{f"force_{speed:g}": result.reaction_x_n for speed, result in found.items()},
        "whirls_at": float(sum(result.whirls for result in found.values())),
        "period_ratio": low.whirl_hz / high.whirl_hz,
        "impulsive_ratio": high.slope_n_s / low.slope_n_s,
    }


def spectra(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Full spectra of the disk's probes over time, as `rig.orbit.waterfall` gives them [mm]."""
    return waterfall(run.samples["disk_x"], run.samples["disk_y"], float(_RATE_HZ), run.times_s)
