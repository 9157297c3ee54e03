"""The twelve scenes' atlas: outcomes that must hold, and those that theory or measurement says must not.

| method              | must be                                                                                    |
|---------------------|--------------------------------------------------------------------------------------------|
| split               | right at each tolerance up to 0.1: its step error is a ten-thousandth of it                |
| verlet at 50 us     | wrong, and its energy ledger says so: some six steps an impact, of order 2                 |
| verlet at 10 us     | wrong, and silent: the ledger closes to 1e-3, and the error grows a thousand times         |
| semi-implicit-euler | refused: it takes no set-valued friction                                                   |
| a scipy solver      | wrong at a tolerance of 1e-3, and silent: a step's error grows, and nothing estimates that |
"""

from __future__ import annotations

from pathlib import Path

import pytest

from replays.studies.scene_atlas import (
    OUTCOMES,
    Outcome,
    chosen_scenes,
    draw_scene_atlas,
    is_silent,
    outcomes,
)
from replays.studies.twelve_scenes import TWELVE_SCENES
from rig.errors import InputError

ENGINES = ["split", "verlet", "semi-implicit-euler"]


@pytest.fixture(scope="module")
def found() -> list[Outcome]:
    return [*outcomes(["hammer-6.2"], [*ENGINES, "scipy-lsoda"])]


def kinds(found: list[Outcome], method: str) -> dict[str, str]:
    return {one.setting: one.kind for one in found if one.method == method}


def test_the_default_engine_is_right_at_each_setting(found: list[Outcome]) -> None:
    assert set(kinds(found, "split").values()) == {"right"}
    assert not any(is_silent(one) for one in found if one.method == "split")


def test_verlet_is_wrong_with_a_warning_and_without(found: list[Outcome]) -> None:
    verlet = kinds(found, "verlet")
    assert (verlet["50 us"], verlet["10 us"]) == ("told", "silent")


def test_a_law_that_an_engine_cannot_take_is_refused(found: list[Outcome]) -> None:
    assert set(kinds(found, "semi-implicit-euler").values()) == {"refused"}


def test_a_peer_at_a_loose_tolerance_is_wrong_and_silent(found: list[Outcome]) -> None:
    assert kinds(found, "scipy-lsoda")["1e-3"] == "silent"
    assert kinds(found, "scipy-lsoda")["1e-8"] == "right"


def test_each_outcome_is_drawn(found: list[Outcome], tmp_path: Path) -> None:
    every = [Outcome(scene, "split", kind, kind, None) for scene in TWELVE_SCENES for kind in OUTCOMES]
    picture, vector = draw_scene_atlas(tmp_path, [*every, *found])
    assert picture.stat().st_size > 20_000
    assert all(title.split(",")[0] in vector.read_text() for _, title in OUTCOMES.values())


def test_a_scene_that_is_not_there_is_refused() -> None:
    assert chosen_scenes(None) == list(TWELVE_SCENES)
    with pytest.raises(InputError, match=r"--only must be one or more of hammer-3.2, .*; instead received 'hamer'"):
        chosen_scenes("drop,hamer")
