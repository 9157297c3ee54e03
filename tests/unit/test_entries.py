"""What comes as one of many has every part of it: half an entry fails here, with what is missing.

A contact law, an engine, a scorecard's quantity, a command of `rig`, an instrument; channels, commands of a run, faults
and file formats have their checks in test_registries.py and test_command_table.py.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

from drivers.instruments.twins import TWINS
from replays.score.card.scorecard import QUANTITIES
from rig.cli import app
from rig.cli.commands import requests
from rig.physics.contacts import DAMPING, STIFFNESS
from rig.physics.engines import ENGINES
from rig.physics.parameters import load_parameters
from rig.run.commands import SUMMARIES

ROOT = Path(__file__).parents[2]
SHARED = {"common", "tape", "split", "taylor"}
"""Folders in rig/physics/engines; the last two are engines and are looked at by their names."""


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


@pytest.mark.parametrize(("key", "laws"), [("damping_factor", DAMPING), ("stiffness", STIFFNESS)])
def test_a_contact_law_has_a_row_and_a_rule(key: str, laws: dict) -> None:
    rules = set(load_parameters().entries[f"contact.{key}"].rules)
    where = f"contact.{key}.rules in rig/physics/sets/corrected.toml"
    assert not laws.keys() - rules, f"{where} must name what rig/physics/contacts.py has"
    assert not rules - laws.keys(), f"rig/physics/contacts.py must have what {where} names"
    for name, law in laws.items():
        assert law.formula, f"{name} needs a formula"
        assert law.source, f"{name} needs a source"


def test_an_engine_has_a_module_a_row_and_a_contract() -> None:
    folder = ROOT / "rig/physics/engines"
    modules = {path.stem.replace("_", "-") for path in folder.glob("[!_]*.py")} | {"split", "taylor"}
    assert not modules - ENGINES.keys(), "a module in rig/physics/engines needs its row in ENGINES"
    own = {name for name, row in ENGINES.items() if not row.module}
    assert not own - modules, "a row in ENGINES needs its module in rig/physics/engines"
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    named = {name.rpartition(".")[2].replace("_", "-") for each in contracts for name in each.get("modules", ())}
    assert not own - named - {"split"}, "pyproject.toml: the contract 'An engine does not know another' must name it"
    for name in own:
        code = ast.parse((folder / f"{name.replace('-', '_')}.py").read_text() if name not in SHARED else "")
        defined = {ast.unparse(target) for node in code.body if isinstance(node, ast.Assign) for target in node.targets}
        if code.body:
            assert "ORDER" in defined, f"{name} needs ORDER"
            assert "METHOD" in defined or {"start", "advance"} <= {
                node.name for node in code.body if isinstance(node, ast.FunctionDef)
            }, f"{name} needs METHOD, or start and advance"


def test_a_quantity_of_a_scorecard_is_made_somewhere_and_on_the_page() -> None:
    texts = {
        node.value
        for path in (ROOT / "replays/score").rglob("*.py")
        if path.name != "scorecard.py"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    for path, quantities in QUANTITIES.items():
        for name in quantities:
            assert name in texts, f"{path} quantity {name}: no module of replays/score makes a row of it"
            assert name in page("score.md"), f"{path} quantity {name}: docs/score.md must say what it is"


def test_a_command_has_a_line_a_function_and_is_on_the_page() -> None:
    named = {name: text for commands in app.COMMANDS.values() for name, text in commands.items()}
    for name, text in named.items():
        if hasattr(requests, name) or (name in SUMMARIES and name != "fault"):
            continue  # a request, or made of the command's own class
        module = name.replace("import", "import_")
        place = f"rig/cli/commands/{module}.py"
        assert find_spec(f"rig.cli.commands.{module}"), f"command {name}: {place} is missing"
        function = getattr(importlib.import_module(f"rig.cli.commands.{module}"), module, None)
        assert function is not None, f"command {name}: {place} has no function of its name"
        told = inspect.getdoc(function) or ""
        assert told.startswith(text), f"command {name}: the docstring in {place} must begin with its line in app.py"
        assert f"rig {name}" in page("commands.md"), f"command {name}: docs/commands.md must name it"
    modules = {path.stem.rstrip("_") for path in (ROOT / "rig/cli/commands").glob("[!_]*.py")} - {"requests"}
    assert not modules - named.keys(), "a module in rig/cli/commands needs its line in COMMANDS of rig/cli/app.py"


def test_an_instrument_has_a_protocol_a_driver_a_twin_and_is_served() -> None:
    folder = ROOT / "drivers/instruments"
    found = {path.name for path in folder.iterdir() if path.is_dir() and path.name not in ("common", "__pycache__")}
    for name in found:
        for part in ("protocol", "driver", "twin"):
            assert (folder / name / f"{part}.py").is_file(), f"instrument {name}: {part}.py is missing"
        assert (folder / name / "__init__.py").is_file(), f"instrument {name}: __init__.py is missing"
    served = {twin.__module__.split(".")[2] for twin in TWINS}
    assert not found - served, "TWINS in drivers/instruments/twins.py must have its twin"
    numbers = [twin.CODEC.address.number for twin in TWINS]
    assert len(set(numbers)) == len(numbers), "each instrument needs a number of its own"
