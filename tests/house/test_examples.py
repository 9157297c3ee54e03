"""The examples in docstrings give what they say, and what a notebook calls has one."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

import rig
from drivers.console import Console
from drivers.daq import Daq
from recorder.reader import Recording
from rig import contacts, magnets

MODULES = (
    "drivers.console",
    "drivers.daq",
    "recorder.reader",
    "rig.contacts",
    "rig.errors",
    "rig.magnets",
    "rig.offline",
    "rig.orbit",
    "rig.parameters",
    "rig.samples",
    "rig.scenes",
    "rig.simulation",
    "rig.text",
)
CALLED = (
    *(getattr(rig, name) for name in rig.__all__), contacts.restitution_factor, contacts.returned_restitution,
    contacts.linear_damping_ratio, contacts.fit_power, contacts.free_impact, magnets.field_sum_force,
    magnets.cylinder_force, magnets.pair_force, Recording, Daq, Console,
)  # fmt: skip


@pytest.mark.parametrize("name", MODULES)
def test_examples_of_a_module(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(__file__).parents[2])  # where the reference sessions are
    said: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    for example in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(name)):
        runner.run(example, out=said.append)
    assert runner.tries > 0
    assert runner.failures == 0, "".join(said)


@pytest.mark.parametrize("called", CALLED, ids=lambda called: called.__name__)
def test_what_a_notebook_calls_has_an_example(called: object) -> None:
    assert ">>> " in (called.__doc__ or "")
    assert getattr(called, "__module__", "") in MODULES
