"""Tables of ensembles: columns with units, conversions, and independence of the number of threads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rig
from rig.base.errors import InputError, UnknownNameError
from rig.ensemble.ensemble import Ensemble

OVER: dict[str, Any] = {
    "contact.friction": [0.1, 0.2],
    "hammer.force_n": {"from": 50.0, "to": 150.0, "count": 3},
}
CHANGES = {"duration_s": 0.03}


@pytest.fixture(scope="module")
def grid() -> rig.Ensemble:
    return rig.ensemble("hammer", OVER, changes=CHANGES)


def test_a_grid_is_a_dataset_over_its_axes(grid: rig.Ensemble) -> None:
    data = grid.to_xarray()
    assert dict(data.sizes) == {"contact.friction": 2, "hammer.force_n": 3}
    assert data["peak_force_n"].attrs == {"units": "N"}
    found = data["peak_force_n"].sel({"contact.friction": 0.2, "hammer.force_n": 100.0})
    assert float(found) == grid["peak_force_n"][4]


def test_tables_keep_names_and_units(grid: rig.Ensemble, tmp_path: Path) -> None:
    from pyarrow import parquet

    frame = grid.to_pandas()
    assert frame.index.name == "run"
    assert np.array_equal(frame["hammer.force_n"], [50.0, 100.0, 150.0] * 2)
    assert frame.attrs["units"]["hammer.force_n"] == "N"
    grid.to_parquet(tmp_path / "runs.parquet")
    written = parquet.read_table(tmp_path / "runs.parquet")
    assert tuple(written.column_names) == grid.names
    assert [each.metadata[b"unit"].decode() for each in written.schema] == [grid.unit(name) for name in grid]
    assert np.array_equal(written["peak_force_n"], grid["peak_force_n"])
    assert repr(grid).startswith("Ensemble(6 runs over contact.friction, hammer.force_n; ")
    assert "<td>peak_force_n</td><td>N</td>" in grid._repr_html_()
    with pytest.raises(UnknownNameError, match="such as peak_force_n"):
        grid["peak_force"]


def test_runs_do_not_depend_on_threads_and_report_progress() -> None:
    over = {"contact.friction": {"distribution": "normal", "mean": 0.2, "std": 0.05}}
    parts: list[float] = []
    settings: dict[str, Any] = {"runs": 1100, "changes": {"duration_s": 0.021}, "sampling": "latin"}
    one = rig.ensemble("hammer", over, ["end_s"], workers=1, progress=parts.append, **settings)
    assert one.to_arrow().equals(rig.ensemble("hammer", over, ["end_s"], workers=3, **settings).to_arrow())
    assert parts == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert one.names == ("run", "contact.friction", "seed", "outcome", "trusted", "engine", "end_s")


def test_wrong_settings_are_refused() -> None:
    for settings, line in (
        ({"quantities": ["peak"]}, "quantities must be names of quantities"),
        ({"workers": 0}, "workers must be a whole number of at least 1"),
        ({"seed": -1}, "seed must be a whole number"),
    ):
        with pytest.raises(InputError, match=f"^{line}"):
            rig.ensemble("hammer", OVER, changes=CHANGES, **settings)


def test_a_band_has_its_share_of_the_runs() -> None:
    import pyarrow

    rng = np.random.default_rng(1)
    x = rng.uniform(0.0, 1.0, 20_000)
    columns = {"contact.friction": x, "peak_force_n": 100.0 * x + rng.normal(size=len(x)), "outcome": ["free"] * len(x)}
    arrays = {name: pyarrow.array(values) for name, values in columns.items()}
    fields = [pyarrow.field(name, array.type, metadata={"unit": ""}) for name, array in arrays.items()]
    runs = Ensemble(pyarrow.Table.from_arrays([*arrays.values()], schema=pyarrow.schema(fields)), {})
    axes = runs.plot_band("contact.friction", "peak_force_n", share=0.9, groups=200)
    median = axes.lines[0].get_xydata()
    np.testing.assert_allclose(median[:, 1], 100.0 * median[:, 0], atol=0.7)
    vertices = axes.collections[0].get_paths()[0].vertices
    spreads = [np.ptp(vertices[np.isclose(vertices[:, 0], place, atol=1e-9), 1]) for place in median[:, 0]]
    # Normal noise of width 1, spread further by the slope within a group.
    assert np.median(spreads) == pytest.approx(2 * 1.645, abs=0.4)
    with pytest.raises(InputError, match="outcome must be a column with at least 20 numbers"):
        runs.plot_band("contact.friction", "outcome")
