"""Speed of the rig: simulated over wall time, in cases that share one process and take turns."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable
from typing import Any

from rig.kernels import compiled_before
from rig.scenes import load_scene
from rig.simulation import Simulation

CASES = {
    "rk4 10 us, hammer, one sensor": (
        "hammer",
        {"engine.name": "rk4", "engine.step_us": 10, "sensors.groups": ["hammer"]},
    ),
    "rk8 25 us, hammer, one sensor": ("hammer", {"sensors.groups": ["hammer"]}),
    "rk8 25 us, hammer, all sensors": ("hammer", {}),
    "rk8 25 us, stable run, all sensors": ("stable-run", {}),
    "rk8 25 us, drop, all sensors": ("drop", {}),
}
"""Scene and changes by name; the first is what the others are compared with."""


def measure(*, runs: int, simulated_s: float, progress: Callable[[str], None]) -> dict[str, Any]:
    """Run every case several times, one after the other in turn.

    Args:
        runs: Runs of each case.
        simulated_s: Simulated time of a run [s].
        progress: Told what is measured.

    Returns:
        A JSON document: machine, time until the kernels were ready [s], and per case times real time (median, min,
        max, all) and the median ratio to the first case of the same round.
    """
    cached = compiled_before()
    begin = time.perf_counter()
    progress("loading or compiling the kernels")
    for scene, changes in CASES.values():
        Simulation(load_scene(scene, dict(changes))).warm_up()
    ready_s = time.perf_counter() - begin
    speeds: dict[str, list[float]] = {name: [] for name in CASES}
    for turn in range(runs):
        progress(f"round {turn + 1} of {runs}")
        for name, (scene, changes) in CASES.items():
            simulation = Simulation(load_scene(scene, dict(changes)))
            # Blocks of 10 ms, as the service runs it.
            block = 10_000
            end = round(simulated_s * simulation.tick_rate_hz) // block * block
            begin = time.perf_counter()
            while simulation.tick < end:
                simulation.advance(block)
            speeds[name].append(end / simulation.tick_rate_hz / (time.perf_counter() - begin))
    first = next(iter(CASES))
    return {
        "machine": {"processor": platform.processor() or platform.machine(), "python": platform.python_version()},
        "simulated_s": simulated_s,
        "runs": runs,
        "ready_s": ready_s,
        "cached": cached,
        "cases": [
            {
                "name": name,
                "median": statistics.median(values),
                "min": min(values),
                "max": max(values),
                "all": values,
                "ratio": statistics.median(value / base for value, base in zip(values, speeds[first], strict=True)),
            }
            for name, values in speeds.items()
        ],
    }
