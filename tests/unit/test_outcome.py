"""Outcomes and their exit statuses."""

import pytest

from rig.base.outcome import Outcome

PASS, FAIL, INCONCLUSIVE = Outcome


def test_exit_statuses_are_those_of_the_documentation() -> None:
    assert [each.exit_status for each in (PASS, FAIL, INCONCLUSIVE)] == [0, 1, 3]


@pytest.mark.parametrize(
    ("outcomes", "worst"),
    [
        ([], INCONCLUSIVE),
        ([PASS, PASS], PASS),
        ([PASS, INCONCLUSIVE], INCONCLUSIVE),
        ([INCONCLUSIVE, FAIL, PASS], FAIL),
        ([FAIL], FAIL),
    ],
)
def test_the_worst_outcome_decides_and_none_at_all_is_inconclusive(outcomes: list[Outcome], worst: Outcome) -> None:
    assert Outcome.worst(outcomes) is worst
