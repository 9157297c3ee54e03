"""Benchmark of ensembles: its rows and errors, and the peers that advance many runs at once."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from replays.studies.bench import ensembles
from replays.studies.bench.ensembles import HIGHEST, LOWEST, METHODS, Ended, Method, Runs, measure_ensembles
from rig.cli.commands.bench import ensembles_table

BY_NAME = {method.name: method for method in METHODS}


def test_the_table_has_the_rows_and_errors_of_its_methods() -> None:
    def fail(runs: Runs, tolerance: float) -> Ended:
        return Ended(np.full((len(runs.values), 14), np.nan), 1.0)

    methods = (
        *METHODS[:3], BY_NAME["split, default"], Method("diverging", (1e-3, 1e-4), fail, "numpy"),
        Method("absent", (1e-3,), fail, "no_such_library"),
    )  # fmt: skip
    report = measure_ensembles(count=12, rounds=2, peers=True, progress=lambda _: None, methods=methods)
    rows = {row["name"]: row for row in report["methods"]}
    assert list(rows) == [method.name for method in methods[:-1]]
    assert report["missing_peers"] == ["no_such_library"]
    assert report["reference_difference"] < 1e-5  # two methods, two formulations
    kernel, finer, diverging = rows["batch kernel"], rows["batch kernel, finer"], rows["diverging"]
    for row in (kernel, finer, rows["split, default"]):
        assert row["runs"] == 12
        assert row["failed"] == 0
        assert 0.0 < row["min"] <= row["median"] <= row["max"]
        assert row["error_taylor"] == pytest.approx(row["error"], abs=1e-5)
    assert 1e-8 < finer["error"] < 0.5 * kernel["error"] < 1e-2
    assert rows["batch kernel, as in rig.ensemble"]["error"] == kernel["error"]
    assert (diverging["failed"], diverging["error"], diverging["tolerance"]) == (12, np.inf, 1e-4)
    assert len(ensembles_table(report).rows) == 5


@pytest.mark.skipif(not find_spec("heyoka"), reason="needs the extra `peers`")
def test_heyoka_solves_the_same_runs_in_its_batch_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = Runs(np.random.default_rng(2).uniform(LOWEST, HIGHEST, (20, 2)))
    together = BY_NAME["heyoka, batch mode"].solve(runs, 1e-6)
    alone = BY_NAME["heyoka, run by run"].solve(runs, 1e-6)
    assert ensembles._median_error(together.states, alone.states) < 1e-4
    assert ensembles._median_error(together.states, runs.march(1e-11)) < 1e-4
