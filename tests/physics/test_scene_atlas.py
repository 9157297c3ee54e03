"""Atlas of the twelve scenes: required results, and results that theory or measurement excludes.

| method              | must be                                                                                    |
|---------------------|--------------------------------------------------------------------------------------------|
| split               | right at each tolerance up to 0.1: its step error is a ten-thousandth of it                |
| verlet at 50 us     | wrong, shown by its energy ledger: some six steps per impact, of order 2                   |
| verlet at 10 us     | wrong without a warning: the ledger closes to 1e-3, and the error grows a thousand times   |
| semi-implicit-euler | refused: it takes no set-valued friction                                                   |
| a scipy solver      | wrong at a tolerance of 1e-3 without a warning: a step's error grows, with no estimate     |
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from replays.studies.common.twelve_scenes import TWELVE_SCENES
from replays.studies.stability.scenes import scene_atlas
from replays.studies.stability.scenes.scene_atlas import (
    HATCHES,
    OUTCOMES,
    SceneOutcome,
    draw_scene_atlas,
    is_silent,
    outcomes,
    select_scenes,
)
from rig.base.errors import InputError
from tests.commands import run_captured
from tests.physics import ladder_runs

ENGINES = ["split", "verlet", "semi-implicit-euler"]


@pytest.fixture(scope="module")
def found() -> list[SceneOutcome]:
    return [*outcomes(["hammer-6.2"], [*ENGINES, "scipy-lsoda"])]


def kinds(found: list[SceneOutcome], method: str) -> dict[str, str]:
    return {one.setting: one.kind for one in found if one.method == method}


def test_the_default_engine_is_accurate_at_each_setting(found: list[SceneOutcome]) -> None:
    assert set(kinds(found, "split").values()) == {"right"}
    assert not any(is_silent(one) for one in found if one.method == "split")


def test_verlet_is_wrong_with_or_without_a_warning(found: list[SceneOutcome]) -> None:
    verlet = kinds(found, "verlet")
    assert (verlet["50 us"], verlet["10 us"]) == ("warned", "silent")


def test_an_unsupported_law_is_refused(found: list[SceneOutcome]) -> None:
    assert set(kinds(found, "semi-implicit-euler").values()) == {"refused"}


def test_a_peer_at_a_loose_tolerance_is_wrong_without_warning(found: list[SceneOutcome]) -> None:
    assert kinds(found, "scipy-lsoda")["1e-3"] == "silent"
    assert kinds(found, "scipy-lsoda")["1e-8"] == "right"


def test_each_outcome_is_drawn(found: list[SceneOutcome], tmp_path: Path) -> None:
    every = [SceneOutcome(scene, "split", kind, kind, None) for scene in TWELVE_SCENES for kind in OUTCOMES]
    picture, vector = draw_scene_atlas(tmp_path, [*every, *found])
    assert picture.stat().st_size > 20_000
    assert all(title.split(",")[0] in vector.read_text() for _, title in OUTCOMES.values())


def test_an_unknown_scene_is_refused() -> None:
    assert select_scenes(None) == list(TWELVE_SCENES)
    assert select_scenes("run-up, Drop,drop,") == ["drop", "run-up"]
    with pytest.raises(InputError, match=r"--only must be one or more of hammer-3.2, .*; received 'hamer'"):
        select_scenes("drop,hamer")
    with pytest.raises(InputError, match=r"--only must be one or more of .*; received ','"):
        select_scenes(",")


@pytest.mark.parametrize("more", [["--full"], ["--random", "3"]])
def test_an_option_of_another_study_is_refused(more: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    status, _, error = run_captured(capsys, "stability", "--scenes", *more)
    assert status == 2
    assert "--scenes must be given without --full and --random; received" in error


def test_a_stopped_atlas_shows_its_measurements(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: object, **__: object) -> Iterator[SceneOutcome]:
        yield SceneOutcome("drop", "split", "1e-2", "right", 1e-3)
        raise KeyboardInterrupt

    monkeypatch.setattr(scene_atlas, "outcomes", stopped)
    status, shown, error = run_captured(capsys, "stability", "--scenes", "--json", "-o", tmp_path)
    assert (status, "no picture was drawn" in error) == (130, True)
    assert [one["kind"] for one in json.loads(shown)["outcomes"]] == ["right"]
    assert not list(tmp_path.iterdir())


def test_kinds_of_outcome_differ_in_grey() -> None:
    plain = sorted(mean_grey(colour) for kind, (colour, _) in OUTCOMES.items() if kind not in HATCHES)
    assert min(high - low for low, high in pairwise(plain)) > 0.1


def mean_grey(colour: str) -> float:
    """Return the luma of a colour, 0 black to 1 white."""
    from matplotlib.colors import to_rgb

    return float(np.dot(to_rgb(colour), (0.299, 0.587, 0.114)))


def test_a_ladder_of_an_unknown_scene_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["ladder_runs", "drop", "hamer"])
    assert ladder_runs.main() == 2
    assert "must be one or more of hammer-3.2," in capsys.readouterr().err


def test_a_row_without_a_pick_has_each_column(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise InputError("--quantity", "one that the scene has", "reaction_amplitude")

    monkeypatch.setattr(ladder_runs, "search", refuse)
    text, holds = ladder_runs.row(TWELVE_SCENES["drop"], "reaction_amplitude")
    assert holds
    assert text.count("|") == 8
