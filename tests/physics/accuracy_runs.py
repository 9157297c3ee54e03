"""Twenty runs with an error of radius or force above their tolerance, and whether each warns.

Run `python -m tests.physics.accuracy_runs`. Real errors refer to `taylor` at 1e-12; the last column is the difference
between 1e-12 and 1e-11.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rig.channels.orbit import whirl_frequency
from rig.run.offline import simulate

BARE = {"sensors.chain": "ideal", "sensors.rate_hz": 1000, "sensors.truth_rate_hz": 1000}
EXACT = {"engine.name": "taylor", "engine.companion": False}


class Case(NamedTuple):
    """A run: scene, changes of it, engine, its tolerance, duration [s]."""

    scene: str
    changes: dict[str, Any]
    engine: str
    tolerance: float
    duration_s: float = 0.2


CASES = [
    *(Case("hammer", {}, "tsit5", tolerance) for tolerance in (1e-5, 1e-3)),
    *(Case("hammer", {}, "rosenbrock", tolerance) for tolerance in (1e-5, 1e-4, 1e-3)),
    *(Case("hammer", {"model.friction": "none"}, engine, 1e-3) for engine in ("tsit5", "rosenbrock")),
    *(Case("hammer", {"model.friction": "smoothed"}, engine, 1e-3) for engine in ("split", "tsit5", "rosenbrock")),
    *(Case("hammer", {"house.preload": 300.0}, engine, 1e-3) for engine in ("tsit5", "rosenbrock")),
    *(Case("hammer", {"contact.stiffness": "palmgren-cylinder"}, engine, 1e-3) for engine in ("tsit5", "rosenbrock")),
    Case("hammer", {"parameters": "as-printed"}, "rosenbrock", 1e-4),
    Case("hammer", {"parameters": "dtu-2019"}, "tsit5", 1e-5),
    Case("hammer", {"model.stator": "rigid"}, "rosenbrock", 1e-4),
    Case("drop", {}, "split", 3e-4),
    Case("drop", {}, "tsit5", 1e-3),
    Case("partial-rub", {}, "split", 3e-4, 0.45),
    Case("partial-rub", {}, "split", 3e-3, 0.45),
    Case("partial-rub", {}, "tsit5", 1e-3, 0.3),
]


def main() -> None:
    """Print a row for each run."""
    print("scene, changes, engine | real: um, N, Hz, deg | reported: um, N, Hz, deg | tolerance | verdict | spread")
    for case in CASES:
        given = {**BARE, **case.changes}
        exact, checked = (
            simulate(case.scene, {**given, **EXACT, "engine.tolerance": tolerance}, duration_s=case.duration_s)
            for tolerance in (1e-12, 1e-11)
        )
        own = {"engine.name": case.engine, "engine.tolerance": case.tolerance, "engine.companion": True}
        run = simulate(case.scene, {**given, **own}, duration_s=case.duration_s)
        health = run.simulation.health()
        found = health["accuracy"]["quantities"]
        real, spread = _errors(run, exact), _errors(checked, exact)
        over = [real[0] > found["radius"]["tolerance"], real[1] > found["force"]["tolerance"]]
        warned = any(text.startswith("accuracy: ") for text in health["warnings"])
        print(
            f"{case.scene} {case.changes} {case.engine} {case.tolerance:g}",
            " ".join(f"{value:.2g}" for value in real),
            " ".join(f"{found[name]['error']:.2g}" for name in ("radius", "force", "frequency", "angle")),
            f"tolerance {found['radius']['tolerance']:.2g} um {found['force']['tolerance']:.2g} N",
            "exceeded" if any(over) else "kept",
            "warned" if warned else "not warned",
            f"reference {spread[0]:.1g} um {spread[1]:.1g} N",
            sep=" | ",
            flush=True,
        )


def _errors(run: Any, exact: Any) -> tuple[float, ...]:
    """Return the largest error of radius [um], force [N], frequency over the last half [Hz] and angle [deg]."""
    orbit, other = (one["ring_x"] + 1j * one["ring_y"] for one in (run, exact))
    whirls = np.minimum(np.abs(orbit), np.abs(other)) > 0.5e-3
    half = len(orbit) // 2
    whirl_hz = [
        whirl_frequency(z.real[half:], z.imag[half:], run.times_s[half:], about=0j) if whirls[half:].all() else 0.0
        for z in (orbit, other)
    ]
    angle = np.degrees(np.abs(np.angle(orbit * np.conj(other))))[whirls].max(initial=0.0)
    radius = np.abs(np.abs(orbit) - np.abs(other)).max() * 1e6
    force = np.abs(run["normal_force"] - exact["normal_force"]).max()
    return float(radius), float(force), abs(whirl_hz[0] - whirl_hz[1]), float(angle)


if __name__ == "__main__":
    main()
