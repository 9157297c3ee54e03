"""The twelve scenes: the contents of each window, and their panel of `rig chart`. No timing asserted."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replays.studies.chart import session
from replays.studies.chart.drawing.figure import draw
from replays.studies.chart.drawing.scene_panel import Ratio, compare
from replays.studies.chart.measure import Budget
from replays.studies.chart.methods import competitors
from replays.studies.chart.phases import SCENE_TARGETS, scene_problem
from replays.studies.chart.profile import find_cheapest
from replays.studies.chart.session import make_chart
from replays.studies.chart.store import COLUMNS, KEY, read_table
from replays.studies.common.run import Course
from replays.studies.common.twelve_scenes import TWELVE_SCENES
from rig.base.errors import InputError
from rig.physics.engines.common.memory import CONTACTS
from rig.physics.kernels.signals import COLUMN, N_ROW

_WHIRL_S = 0.1
"""Minimum contact time at the end of a window with whirl [s]."""
_IMPACTS = {"drop", "run-up", "partial-rub"}
_FREE = {"stable-run"}


@pytest.fixture(scope="module")
def rows() -> dict[str, tuple[np.ndarray, int]]:
    """Rows of each window at 1 kHz by `split`, and its number of contacts."""
    found = {}
    for name in TWELVE_SCENES:
        problem = scene_problem(name)
        table = np.full((len(problem.times) - 1, N_ROW), np.nan)
        course = Course("split", problem.constants, problem.inputs, problem.y0)
        course.advance(len(table) * 40, 40, table)
        found[name] = table, int(course.memory[CONTACTS])
    return found


def test_list_has_twelve_scenes_whose_windows_fit() -> None:
    assert len(TWELVE_SCENES) == 12
    for name, study in TWELVE_SCENES.items():
        assert study.name == name
        assert 0.2 <= study.window_s <= study.load().duration_s
        assert scene_problem(name).duration_s == pytest.approx(study.window_s)


@pytest.mark.parametrize("name", TWELVE_SCENES)
def test_a_scene_shows_what_its_name_states(rows: dict[str, tuple[np.ndarray, int]], name: str) -> None:
    table, contacts = rows[name]
    touching = table[:, COLUMN["normal_force"]] > 0.0
    slip = np.abs(table[-int(_WHIRL_S * 1e3) :, COLUMN["sliding_speed"]])
    force_n = max(table[:, COLUMN["normal_force"]])
    assert np.isfinite(table).all()
    if name in _FREE:
        assert not touching.any()
    elif name in _IMPACTS:
        assert contacts >= 10
        assert not touching[: len(table) // 10].any()
    else:
        assert contacts >= 8
        assert touching[-int(_WHIRL_S * 1e3) :].all()
        # Only the smoothed law creeps.
        assert (slip[-1] > 1e-5) == (name == "smoothed")
    problem = scene_problem(name)
    least_n = min(table[:, COLUMN[transducer]].min() for transducer in ("P_N", "P_S", "P_E", "P_W"))
    assert (least_n == 0.0) == (name == "low-preload")
    assert problem.exact_friction == (name != "smoothed")
    assert problem.constants.contact.offset_x == pytest.approx(
        {"ring-offset": 4e-4, "partial-rub": 8e-4}.get(name, 0.0)
    )
    assert (force_n > 1500.0) == (name == "hammer-300-n")


def point(scene: str, method: str, family: str, speed: float, **columns: Any) -> dict[str, Any]:
    base = {name: None for name in COLUMNS if name not in KEY}
    base |= {"mode": "full", "panel": "scenes", "phase": scene, "case": "0.01", "rung": "cheapest", "failure": ""}
    base |= {"commit": "abc", "date": "2026-01-01", "machine": "m", "versions": "v", "known_failure": ""}
    return base | {"method": method, "title": method, "family": family, "speed": speed, "cpu_s": 1.0} | columns


def hand_made() -> list[dict[str, Any]]:
    return [
        point("drop", "split", "rig", 100.0),
        point("drop", "taylor", "rig", 900.0),  # no peer
        point("drop", "heyoka", "heyoka", 40.0, own_cpu_s=0.2),  # 200 times real time by its own time
        point("drop", "cvode-adams", "SUNDIALS", 50.0),
        point("drop", "scipy-lsoda", "scipy", 500.0, failure="target"),
        point("drop", "semi-implicit-euler", "rig", 0.0, failure="law"),
        point("run-up", "split", "rig", 100.0, failure="target"),
        point("run-up", "cvode-adams", "SUNDIALS", 50.0),
        point("smoothed", "split", "rig", 100.0),
        point("smoothed", "cvode-adams", "SUNDIALS", 50.0, failure="budget"),
        point("stable-run", "split", "rig", 100.0, failure="reference"),
        point("stable-run", "cvode-adams", "SUNDIALS", 50.0, failure="reference"),
        point("hammer-3.2", "split", "rig", 100.0),
    ]


def test_ratios_of_given_rows() -> None:
    found = compare(hand_made(), "0.01")
    assert found == {
        "drop": Ratio(2.0, 0.5), "run-up": Ratio(0.0, 0.0), "smoothed": Ratio(math.inf, math.inf)
    }  # fmt: skip
    assert compare(hand_made(), "0.0001") == {}


def test_figure_states_ratios_failures_and_median(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("replays.report.canvas.png", lambda _figure, **_about: b"")
    draw(hand_made(), tmp_path, ["scenes"], command="rig chart")
    drawn = (tmp_path / "chart-scenes.svg").read_text(encoding="utf-8")
    assert "split at 2 times the speed of the best peer (median)," in drawn
    assert "0.5 times by its library's own time; slower in 1 of 3 scenes" in drawn
    assert "no peer" in drawn
    assert "no reference sharp enough" in drawn
    assert 'id="failure-split-stable-run"' not in drawn
    for method, scene in (("semi-implicit-euler", "drop"), ("scipy-lsoda", "drop"), ("split", "run-up")):
        assert f'id="failure-{method}-{scene}"' in drawn
    assert 'id="heyoka-drop"' in drawn


def test_a_method_walks_to_each_target() -> None:
    problem = scene_problem("hammer-6.2", end_s=0.06)
    reference = session.own_reference(problem)
    assert reference is not None
    found, start = [], ""
    for target in SCENE_TARGETS:
        found.append(
            find_cheapest(competitors(peers=False)["tsit5"], problem, reference, Budget(30.0, 1), target, start)
        )
        start = found[-1]["rung"]
        assert found[-1]["failure"] == ""
        assert found[-1]["error"] <= target
    assert found[1]["tolerance"] < found[0]["tolerance"]
    from_the_first = find_cheapest(
        competitors(peers=False)["tsit5"], problem, reference, Budget(30.0, 1), SCENE_TARGETS[1]
    )
    assert from_the_first["rung"] == start


def test_panel_of_one_short_scene_is_journalled_and_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("replays.report.canvas.png", lambda _figure, **_about: b"")
    monkeypatch.setattr(session, "TWELVE_SCENES", {name: TWELVE_SCENES[name] for name in ("hammer-6.2", "smoothed")})
    monkeypatch.setattr(session, "find_reference", lambda *_problem, **_options: None)  # peers take long to compile

    def chart() -> session.ChartOutcome:
        methods = ["split", "tsit5", "semi-implicit-euler"]
        return make_chart(tmp_path, panels=["scenes"], peers=False, end_s=0.04, methods=methods)

    first = chart()
    assert (first.measured, first.resumed, first.left) == (12, 0, 0)
    table = {(row["phase"], row["case"], row["method"]): row for row in read_table(tmp_path)}
    assert len(table) == 12
    for (scene, case, method), row in table.items():
        if method == "semi-implicit-euler" and scene == "hammer-6.2":
            assert (row["failure"], row["message"]) == ("law", "cannot run exact friction")
        elif not row["failure"]:
            assert row["error"] <= float(case)
            assert row["speed"] > 0.0
    assert all(not table["hammer-6.2", case, "split"]["failure"] for case in ("0.01", "0.0001"))
    assert {row["friction"] for row in table.values() if row["phase"] == "smoothed"} == {"smoothed"}
    assert (tmp_path / "chart-scenes.svg").stat().st_size > 500
    second = chart()
    assert (second.measured, second.resumed, second.left) == (0, 12, 0)


def test_only_takes_a_scene_of_the_panel() -> None:
    assert (
        session.select_points("smoothed", ["scenes"])
        == session.select_points("smoothed", None)
        == (["scenes"], None, "smoothed")
    )
    assert session.select_points("drop", ["scenes"])[2] == "drop"
    assert session.select_points("drop", None)[1:] == ("drop", None), "a phase, if the panel is not given"
    with pytest.raises(InputError, match=r"only must be one of hammer-3\.2, .*received 'x'"):
        session.select_points("x", ["scenes"])
