"""Inputs that once failed, and fifty generated ones of each interface; see `tests.hostile.generate` for more."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

from tests.hostile import check_tallies, input_count
from tests.hostile.generate import replay, try_generated
from tests.hostile.interfaces import NAMES, Interfaces

# Readers leave files that they could not open to the garbage collector.
pytestmark = [
    pytest.mark.filterwarnings(f"ignore::{name}")
    for name in ("pytest.PytestUnraisableExceptionWarning", "ResourceWarning", "RuntimeWarning")
]


@pytest.fixture(scope="module")
def interfaces(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Interfaces]:
    logging.disable(logging.CRITICAL)
    with Interfaces(tmp_path_factory.mktemp("interfaces")) as interfaces:
        yield interfaces
    logging.disable(logging.NOTSET)


def test_inputs_that_once_failed_are_accepted_or_refused(interfaces: Interfaces) -> None:
    tallies = dict(replay(interfaces))
    assert len(tallies) >= 8
    check_tallies(tallies)


@pytest.mark.parametrize("name", NAMES)
def test_generated_inputs_are_accepted_or_refused(name: str, interfaces: Interfaces) -> None:
    tally = try_generated(interfaces, name, input_count(50), 1, None)
    check_tallies({name: tally})
    assert tally.accepted
