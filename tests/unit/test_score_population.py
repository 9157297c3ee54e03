"""A few cases of the population of DAQs under test; `python -m tests.score_population` has all of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.score_population import Population, binomial_interval, summarise


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the sessions, which several cases share."""
    return tmp_path_factory.mktemp("population")


@pytest.mark.parametrize("number", [1, 10])
def test_a_foreign_record_does_not_pass(number: int, folder: Path) -> None:
    assert Population("foreign", 1, folder).judged(number)["outcome"] != "pass"


@pytest.mark.parametrize("number", [3])
def test_a_perfect_daq_passes(number: int, folder: Path) -> None:
    line = Population("perfect", 1, folder).judged(number)
    assert (line["outcome"], line["red"]) == ("pass", [])


@pytest.mark.parametrize(
    ("seed", "number"), [(1, 0), (1, 4), (1, 6), pytest.param(11, 47, id="a doubled sample in a signal that repeats")]
)
def test_one_defect_fails_its_own_quantity(seed: int, number: int, folder: Path) -> None:
    line = Population("defects", seed, folder).judged(number)
    assert (line["outcome"], line["right"], line["other"]) == ("fail", True, [])


def test_one_wrong_verdict_misses_the_goal() -> None:
    line = {"outcome": "fail", "right": True, "other": [], "cpu_s": 0.0, "by": "function"}
    refused, passed = line | {"outcome": "refused"}, line | {"outcome": "pass"}
    assert summarise("foreign", [refused] * 20)[1]
    assert not summarise("foreign", [refused] * 19 + [passed])[1]
    assert summarise("perfect", [passed] * 19 + [line | {"outcome": "inconclusive"}])[1]
    assert not summarise("perfect", [passed] * 18 + [line | {"outcome": "inconclusive"}] * 2)[1]
    assert not summarise("perfect", [passed] * 19 + [line])[1]
    assert not summarise("perfect", [passed] * 19 + [refused])[1]
    assert summarise("defects", [line] * 19 + [line | {"other": ["clock"]}])[1]
    assert not summarise("defects", [line] * 18 + [line | {"right": False}] * 2)[1]
    assert not summarise("defects", [line] * 19 + [line | {"outcome": "crashed"}])[1]
    assert binomial_interval(0, 200)[1] == pytest.approx(1.0 - 0.025 ** (1.0 / 200.0))  # the closed form of 0 of n
