"""Band of a quantity along the x axis of a map, from the assumed values of the parameter set."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from replays.studies.maps.plan import MapWork
from replays.studies.maps.results import simulate_points
from replays.studies.paper.scans.spread import assumed_values
from rig.ensemble.axes import Design
from rig.ensemble.ensemble import Workers

_PLACES = 9


def find_band(work: MapWork, workers: Workers, step: Callable[[int], None]) -> tuple[np.ndarray, np.ndarray]:
    """Return places along x, and the 2.5, 50 and 97.5 % quantiles of the quantity there, shapes (9,) and (3, 9).

    The assumed values are parameters in the report of the paper that are independent of others, with their ranges, in
    a Latin hypercube, the same at each place. The key of y has its value in the scene.

    Args:
        work: A plan with a quantity.
        workers: Threads.
        step: Called with the number of finished runs.
    """
    plan, own, axes = work.plan, work.scene.load_parameters().entries, dict[str, Any]()
    for each in assumed_values():
        if each.key in own and each.key not in work.keys and not each.tied and not each.name:
            scale = "log" if each.log else "linear"
            axes[each.key] = {"distribution": "uniform", "from": each.low, "to": each.high, "scale": scale}
            if each.whole:
                axes[each.key] = list(range(int(each.low), int(each.high) + 1))
    if plan.x.key == "ring.clearance":  # its printed ratio to the shaft is left open by the map, too
        axes.pop("shaft.radius", None)
    design = Design.create(work.scene, axes, runs=plan.band_runs, sampling="latin", seed=plan.seed)
    places = plan.x.place(np.linspace(0.0, 1.0, _PLACES))
    drawn = design.values(0, plan.band_runs)
    values = np.column_stack([np.repeat(places, len(drawn)), np.tile(drawn, (_PLACES, 1))])
    table = simulate_points(work.create_batch((plan.x.key, *axes)), workers, step, values)
    found = work.read_quantity(table).reshape(_PLACES, -1)
    return places, np.nanquantile(found, (0.025, 0.5, 0.975), axis=1)
