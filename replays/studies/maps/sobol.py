"""Sobol indices of a quantity over the axes of a sweep's plan."""

from __future__ import annotations

from typing import Any

import numpy as np

from replays.studies.maps.results import simulate_points
from rig.base.errors import InputError, Words
from rig.ensemble.batch import QUANTITIES, Batch
from rig.ensemble.ensemble import ALWAYS, Workers
from rig.ensemble.plan import Work

_DEFAULT_RUNS = 8192


def find_indices(work: Work, workers: Workers) -> dict[str, Any]:
    """Return first-order and total indices by key, with their 95 % intervals by bootstrap.

    Args:
        work: A plan whose axes are distributions, and whose first numeric quantity is analysed. Its `runs` are rounded
            down to a power of two of base points, times the number of axes and 2.
        workers: Threads.

    Raises:
        InputError: An axis is not a distribution, there is no number among the quantities, or it has no value in a run.
    """
    from scipy.stats import sobol_indices, uniform

    design, keys = work.design, work.design.keys
    quantity = next((each for each in work.document["quantities"] if each not in ALWAYS), "")
    if not quantity or QUANTITIES[quantity].kind != "number":
        raise InputError("quantities", "a list that begins with a number, such as peak_force_n", quantity or None)
    for key in keys:
        if design.axes[key].distribution is None:
            raise InputError(f"over.{key}", "a distribution, for Sobol indices", Words(design.axes[key]))
    batch = Batch(work.scene, keys, early_end=work.document["early_end"])

    def simulate(parts: np.ndarray) -> np.ndarray:
        columns = [
            design.axes[key].quantiles(part, design.bounds[key], key) for key, part in zip(keys, parts, strict=True)
        ]
        values = simulate_points(batch, workers, lambda runs: None, np.column_stack(columns))[quantity].astype(float)
        if not np.isfinite(values).all():
            raise InputError("quantities", "one with a value in each run", quantity)
        return values[None]

    runs = work.design.runs if work.document["sampling"] != "grid" else _DEFAULT_RUNS
    base = max(8, 1 << ((runs // (len(keys) + 2)).bit_length() - 1))
    seed = np.random.default_rng(work.document["seed"])
    found = sobol_indices(func=simulate, n=base, dists=[uniform()] * len(keys), rng=seed)
    intervals = found.bootstrap(confidence_level=0.95)
    indices = {}
    for number, key in enumerate(keys):
        indices[key] = {}
        for kind, values, spread in (("first", found.first_order, intervals.first_order),
                                     ("total", found.total_order, intervals.total_order)):  # fmt: skip
            ends = spread.confidence_interval
            indices[key][kind] = float(np.ravel(values)[number])
            indices[key][f"{kind}_95"] = [float(np.ravel(each)[number]) for each in (ends.low, ends.high)]
    return {"title": work.document["title"], "quantity": quantity, "runs": base * (len(keys) + 2), "indices": indices}
