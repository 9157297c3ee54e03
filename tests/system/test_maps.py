"""Maps: borders of known curves, continuation, picked scenes, wrong plans, and a small map of the rig."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rig
from replays.studies.maps.lattice import Lattice
from replays.studies.maps.picture import draw_map
from replays.studies.maps.plan import MapWork, plan_names, read_map_plan
from replays.studies.maps.results import CHECK, POINTS, SUMMARY, Map, Table
from rig.cli.main import main
from rig.ensemble.batch import QUANTITIES

PLAN = """
scene = "hammer"
title = "a circle"
border = 0.01

[x]
key = "contact.friction"
from = 0.0
to = 1.0

[y]
key = "hammer.force_n"
from = 10.0
to = 1000.0
scale = "log"
"""
RADIUS = 0.3


def is_inside(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return whether points in fractions of the axes are in the circle."""
    return np.hypot(x - 0.5, y - 0.45) < RADIUS


def simulate_circle(values: np.ndarray) -> Table:
    """Return a whirl within the circle; the other quantities are the friction."""
    force, friction = values.T[-2:]
    outcomes = np.where(is_inside(friction, np.log10(force / 10.0) / 2.0), "backward whirl", "free").astype(object)
    table: Table = {name: friction.copy() for name in QUANTITIES}
    engine = np.full(len(values), "none", object)
    return table | {"outcome": outcomes, "trusted": np.ones(len(values), bool), "engine": engine}


def read(tmp_path: Path, text: str = PLAN, *, quick: bool = False) -> MapWork:
    (tmp_path / "plan.toml").write_text(text, encoding="utf-8")
    return read_map_plan(str(tmp_path / "plan.toml"), quick=quick)


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        main([*map(str, arguments)])
    printed = capsys.readouterr()
    return int(end.value.code or 0), printed.out, printed.err


def test_a_known_border_lies_in_border_cells_of_the_wanted_width(tmp_path: Path) -> None:
    with Map(read(tmp_path), tmp_path / "map") as found:
        found.run(simulate_circle)
        size = found.lattice.size
        classes, border = found.lattice.paint()
    assert size == 128
    angle = np.linspace(0.0, 2.0 * math.pi, 20_000)
    x, y = 0.5 + RADIUS * np.cos(angle), 0.45 + RADIUS * np.sin(angle)
    # A chord of the circle within a cell is longer than its part in a corner that no point sees.
    assert border[0, (y * size).astype(int), (x * size).astype(int)].mean() > 0.97
    row, column = np.nonzero(border[0])
    off = np.abs(np.hypot((column + 0.5) / size - 0.5, (row + 0.5) / size - 0.45) - RADIUS)
    assert off.max() < 0.5 * math.sqrt(2.0) / size + 1e-9
    # The circle crosses each of its 4 x 2 R size grid lines, and begins a new cell at each.
    assert len(row) == pytest.approx(8.0 * RADIUS * size, rel=0.03)
    centre = (np.arange(size) + 0.5) / size
    inside = is_inside(centre[None], centre[:, None])
    assert ((classes[0] == 4) == inside)[~border[0]].all()
    summary = json.loads((tmp_path / "map" / SUMMARY).read_text())
    assert summary["panels"][0]["shares"]["backward whirl"] == pytest.approx(math.pi * RADIUS**2, rel=2e-3)
    assert summary["border_share"] == pytest.approx(len(row) / size**2, abs=1e-6)
    assert summary["full_grid_ratio"] > 5.0
    assert summary["x"]["cell_width"] == 1 / 128
    assert summary["y"]["cell_ratio"] == pytest.approx(100.0 ** (1 / 128))
    check = summary["check"]
    assert (check["runs"], check["errors_outside_border"]) == (500, 0)
    assert check["error_share_below_95"] == pytest.approx(1.0 - 0.05 ** (1.0 / check["outside_border"]), abs=1e-5)


def test_the_check_counts_what_the_map_missed(tmp_path: Path) -> None:
    def simulate(values: np.ndarray) -> Table:
        table = simulate_circle(values)
        # An island within one coarse cell, off its corners.
        friction = values[:, 1]
        table["outcome"][(friction > 1 / 16 + 1e-6) & (friction < 2 / 16 - 1e-6)] = "impacts"
        return table

    with Map(read(tmp_path), tmp_path / "map") as found:
        found.run(simulate)
        check = found.summarise()["check"]
    assert check["errors_outside_border"] > 10
    assert check["error_share_below_95"] > check["errors_outside_border"] / check["outside_border"]


def test_a_point_on_an_edge_divides_the_cell_beside_it() -> None:
    lattice = Lattice(1, 2, 2, margins=0)
    for _, places in lattice.refine():
        # A class at the middle of the right cell's left edge, found only from the left.
        odd = (places[:, 1:] == (2, 4)).all(axis=1) | (places[:, 1:] == (0, 0)).all(axis=1)
        lattice.codes[tuple(places.T)] = odd
    _, border = lattice.paint()
    assert border[0, 1:3, 3].all()
    assert border[0, 1:3, 4].all()


def test_a_map_continues_with_the_same_bytes(tmp_path: Path) -> None:
    work, runs, calls = read(tmp_path), [], [0]

    def break_off(values: np.ndarray) -> Table:
        calls[0] += 1
        if calls[0] == 4:
            raise KeyboardInterrupt
        return simulate_circle(values)

    def count(values: np.ndarray) -> Table:
        runs.append(len(values))
        return simulate_circle(values)

    with Map(work, tmp_path / "whole") as found:
        found.run(simulate_circle)
        total = len(found.points["panel"])
    with pytest.raises(KeyboardInterrupt), Map(work, tmp_path / "part") as found:
        found.run(break_off)
    with Map(work, tmp_path / "part") as found:
        found.run(count)
        assert 0 < found.resumed < total
        assert sum(runs) == total - found.resumed + 500
    for name in (POINTS, CHECK, SUMMARY):
        assert (tmp_path / "part" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    with Map(work, tmp_path / "part") as found:
        found.run(lambda values: pytest.fail("nothing is left to run"))


def test_a_quantity_is_drawn_without_refinement_or_in_classes_by_limits(tmp_path: Path) -> None:
    text = 'quantity = "peak_force_n"\ncells = 8\n'
    with Map(read(tmp_path, text + PLAN), tmp_path / "colours") as found:
        found.run(simulate_circle)
        assert len(found.points["panel"]) == 81
        assert found.summarise()["largest"] == 1.0
        assert len(draw_map(found).axes) == 2
    with Map(read(tmp_path, "limits = [0.3, 0.7]\n" + text + PLAN), tmp_path / "classes") as found:
        found.run(simulate_circle)
        shares = found.summarise()["panels"][0]["shares"]
    assert list(shares) == ["below 0.3 N", "0.3 to 0.7 N", "above 0.7 N"]
    assert shares["0.3 to 0.7 N"] == pytest.approx(0.4, abs=0.005)


def test_a_small_map_of_the_rig_and_the_scene_of_a_point(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = PLAN.replace("to = 1.0", "to = 0.4").replace("to = 1000.0", "to = 200.0")
    text = "check_runs = 20\ncells = 4\n" + text.replace("0.01", "0.125")
    text += '\n[panels]\nkey = "drive.speed_hz"\nvalues = [5.0, 6.2]\n[[marks]]\nx = 0.25\ny = 100.0\nlabel = "pulse"\n'
    (tmp_path / "plan.toml").write_text("overlay = 'dry whirl'\n" + text, encoding="utf-8")
    folder, scene = tmp_path / "map", tmp_path / "point.toml"
    status, out, err = call(capsys, "map", tmp_path / "plan.toml", "-o", folder)
    assert status == 0, err
    assert "backward whirl" in out
    assert {path.name for path in folder.iterdir()} > {"map.png", "map.svg", POINTS, CHECK, SUMMARY}
    assert call(capsys, "map", tmp_path / "plan.toml", "-o", folder)[2].startswith("0 runs in")
    status, out, _ = call(capsys, "map", "info", folder, "--json")
    summary: dict[str, Any] = json.loads(out)
    assert [each["class"] for each in summary["marks"]] == ["backward whirl"] * 2
    for force, outcome in ((100.0, "backward whirl"), (10.0, "free")):
        assert call(capsys, "map", "pick", folder, 0.25, force, "--panel", 6.2, "-o", scene)[0] == 0
        picked = rig.load_scene(scene)
        assert (picked.drive.speed_hz, picked.commands[0].request.force_n) == (6.2, force)
        assert picked.load_parameters().entries["contact.friction"].value == 0.25
        assert rig.ensemble(picked, {"seed": [1]})["outcome"].tolist() == [outcome]
    status, _, err = call(capsys, "map", "pick", folder, 0.25, 100.0, "-o", scene)
    assert (status, err) == (2, "rig: --panel must be one of 5, 6.2; received nothing\n")


def test_the_ready_plans_are_accepted_and_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert {read_map_plan(name, quick=True).plan.title for name in plan_names()}
    status, out, _ = call(capsys, "map")
    assert status == 0
    assert all(name in out for name in plan_names())


WRONG = {
    PLAN.replace("contact.friction", "contact.fricton"): "over.contact.fricton must be ",
    PLAN.replace("to = 1000.0", "to = 5.0"): "y.to must be greater than from, and from greater than 0 with scale log; ",
    PLAN.replace("from = 10.0", "from = 0.0"): "y.to must be greater than from, and from greater than 0 with scale log",
    PLAN.replace("hammer.force_n", "contact.friction"): "y.key must be another key than that of x; received ",
    'quantity = "peak_forc"\n' + PLAN: "quantity must be outcome, or a number of a run, such as peak_force_n",
    "limits = [1.0]\n" + PLAN: "limits must be increasing numbers, of a quantity other than outcome; received [1.0]",
    "band_runs = 9\n" + PLAN: "band_runs must be left out, except for a quantity without limits; received 9",
    'overlay = "dry whirl"\n' + PLAN.replace("hammer.force_n", "ring.clearance"): "overlay must be left out unless x ",
    "border = 0.0\n" + PLAN.replace("border = 0.01", ""): "border must be ",
}  # fmt: skip


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_plan_is_refused_on_one_line(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "plan.toml").write_text(text, encoding="utf-8")
    status, out, err = call(capsys, "map", tmp_path / "plan.toml", "-o", tmp_path / "map")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"rig: {WRONG[text]}")


def test_wrong_arguments_and_another_plan_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Map(read(tmp_path), tmp_path / "map") as found:
        found.run(simulate_circle)
    read(tmp_path, PLAN.replace("0.01", "0.02"))
    for arguments, message in (
        ((tmp_path / "plan.toml", "-o", tmp_path / "map"), "--output must be a folder with the same plan and versions"),
        (("where-does-it-whirl", "-o", tmp_path / "x"), "PLAN must be one of "),
        (("info", tmp_path), "FOLDER must be a folder of `rig map`; received "),
        (("info",), "arguments must be info FOLDER; received info"),
        (("pick", tmp_path / "map", "a", "1", "-o", "x.toml"), "X Y must be two numbers, in the units of the axes; "),
        (("pick", tmp_path / "map", "0.2", "50", "-o", "x.csv"), "--output must be given: a .toml file for the scene"),
    ):
        status, _, err = call(capsys, "map", *arguments)
        assert (status, err.startswith(f"rig: {message}")) == (2, True), err


SWEEP = """
scene = "hammer"
runs = 64
sampling = "random"
quantities = ["peak_force_n"]
[set]
duration_s = 0.03
[over."hammer.force_n"]
distribution = "uniform"
from = 80.0
to = 160.0
[over."contact.friction"]
distribution = "uniform"
from = 0.1
to = 0.3
"""


def test_sobol_indices_of_a_sum(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from replays.studies.maps import sobol
    from rig.ensemble.plan import read_plan

    def simulate(batch: Any, workers: Any, step: Any, values: np.ndarray) -> Table:
        return {"peak_force_n": values[:, 0] / 80.0 + values[:, 1] / 0.2 * 2.0}

    monkeypatch.setattr(sobol, "simulate_points", simulate)
    (tmp_path / "plan.toml").write_text(SWEEP.replace("runs = 64", "runs = 8000"), encoding="utf-8")
    found = sobol.find_indices(read_plan(tmp_path / "plan.toml"), None)  # type: ignore[arg-type]
    assert found["runs"] == 4 * 1024
    for key, share in (("hammer.force_n", 0.2), ("contact.friction", 0.8)):  # variances 1 and 4 twelfths
        index = found["indices"][key]
        assert index["first"] == pytest.approx(share, abs=0.02)
        assert index["total"] == pytest.approx(share, abs=0.02)
        assert index["total_95"][0] <= index["total"] <= index["total_95"][1]
