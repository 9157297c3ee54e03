"""Completeness of entries: an incomplete entry fails here, and the message names the entry and the missing part.

Contact laws, engines, channels, kinds of faults, file formats, quantities of a scorecard, commands of `rig` and
instruments. Commands of a run have test_command_table.py; test_registries.py tests the refusal of incomplete entries.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import tomllib
from collections.abc import Collection, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import get_args

import pytest

from replays.recordings.formats.exporting.export import FormatWriter
from replays.recordings.formats.source import FORMATS
from replays.score.card.scorecard import QUANTITIES
from rig.channels import faults
from rig.channels.faults.defects import DEFECTS, alternatives, defects_in
from rig.cli import app
from rig.cli.commands import requests
from rig.cli.commands.export import EXPORTED
from rig.cli.commands.import_ import IMPORTED
from rig.physics.contacts import DAMPING, STIFFNESS
from rig.physics.engines import ENGINES
from rig.physics.parameters import load_parameters
from rig.run.commands import SUMMARIES
from tests import fault_cases
from tests.generated import missing_in_generated_files

ROOT = Path(__file__).parents[2]
DEFECT_TABLE = "rig/channels/faults/defects.toml"
SHARED = {"common", "tape", "split", "taylor"}
"""Folders in rig/physics/engines; the last two are engines and are checked by their names."""


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def require(problems: Collection[str]) -> None:
    """Fail with a line for each problem, and nothing else."""
    if problems:
        pytest.fail("\n".join(problems), pytrace=False)


@pytest.mark.parametrize(("key", "laws"), [("damping_factor", DAMPING), ("stiffness", STIFFNESS)])
def test_a_contact_law_has_a_row_and_a_rule(key: str, laws: dict) -> None:
    rules = set(load_parameters().entries[f"contact.{key}"].rules)
    where = f"contact.{key} in rig/physics/sets/corrected.toml"
    missing = [f"contact law {name}: `rules` of {where} must name it" for name in sorted(laws.keys() - rules)]
    missing += [f"contact law {name}: {where} names it, and rig/physics/contacts.py has no row of it"
                for name in sorted(rules - laws.keys())]  # fmt: skip
    missing += [f"contact law {name}: its row in rig/physics/contacts.py needs a {part}"
                for name, law in laws.items() for part in ("formula", "source") if not getattr(law, part)]  # fmt: skip
    require(missing)


def test_an_engine_has_a_module_a_row_and_a_contract() -> None:
    folder = ROOT / "rig/physics/engines"
    modules = {path.stem.replace("_", "-") for path in folder.glob("[!_]*.py")} | {"split", "taylor"}
    own = {name for name, row in ENGINES.items() if not row.module}
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    named = {name.rpartition(".")[2].replace("_", "-") for each in contracts for name in each.get("modules", ())}
    missing = [f"engine {name}: rig/physics/engines/__init__.py has no row of it in ENGINES"
               for name in sorted(modules - ENGINES.keys())]  # fmt: skip
    missing += [f"engine {name}: rig/physics/engines/{name.replace('-', '_')}.py is missing"
                for name in sorted(own - modules)]  # fmt: skip
    missing += [f"engine {name}: pyproject.toml: the contract 'An engine does not know another' must name it"
                for name in sorted(own - named - {"split"})]  # fmt: skip
    for name in sorted((own & modules) - SHARED):
        place = f"rig/physics/engines/{name.replace('-', '_')}.py"
        code = ast.parse((ROOT / place).read_text())
        defined = {ast.unparse(target) for node in code.body if isinstance(node, ast.Assign) for target in node.targets}
        functions = {node.name for node in code.body if isinstance(node, ast.FunctionDef)}
        if "ORDER" not in defined:
            missing.append(f"engine {name}: {place} needs ORDER")
        if "METHOD" not in defined and not {"start", "advance"} <= functions:
            missing.append(f"engine {name}: {place} needs METHOD, or start and advance")
    require(missing)


def test_an_observed_signal_is_computed() -> None:
    """Compare texts: importing and running the kernels would compile them again after such a change."""
    kernels = "rig/physics/kernels"
    table = (ROOT / kernels / "signals.py").read_text()
    stages = "".join(path.read_text() for path in (ROOT / kernels).rglob("*.py") if path.name != "signals.py")
    places = re.findall(r"^(?:(\w+) = )?_observed\(\s*\"(\w+)\"", table, re.MULTILINE)
    assert len(places) > 20
    require([f"signal {name}: {kernels}/observe.py must have the line that computes it"
             for constant, name in places if not constant or not re.search(rf"\b{constant}\b", stages)])  # fmt: skip


def test_a_channel_is_in_the_generated_files() -> None:
    require([*missing_in_generated_files()])


def test_a_kind_of_fault_is_in_the_union_and_on_the_page() -> None:
    """A class outside the union would have tests but could not be used."""

    def concrete(cls: type[faults.Kind]) -> Iterator[type[faults.Kind]]:
        for each in cls.__subclasses__():
            yield from concrete(each)
            if "kind" in each.model_fields:
                yield each

    for module in pkgutil.iter_modules(faults.__path__, "rig.channels.faults."):
        importlib.import_module(module.name)
    classes = {each for each in concrete(faults.Kind) if each.__module__.startswith("rig.channels.faults")}
    missing = [f"kind of fault {each.name()}: AnyKind in rig/channels/faults/kinds.py must name {each.__name__}"
               for each in classes - set(get_args(faults.AnyKind))]  # fmt: skip
    missing += [f"kind of fault {each.name()}: {each.__module__} has two classes of that name"
                for each in classes if faults.KINDS.get(each.name(), each) is not each]  # fmt: skip
    numbers = [kind.number for kind in faults.KINDS.values()]
    kinds_by_number = dict(enumerate(fault_cases.NUMBERED, start=1))
    free = next(number for number in range(len(kinds_by_number) + 1, 256) if number not in numbers)
    for name, kind in faults.KINDS.items():
        holder = kinds_by_number.get(kind.number, name if numbers.count(kind.number) == 1 else "another kind")
        if holder != name or not 1 <= kind.number <= 255:
            was = next((number for number, each in kinds_by_number.items() if each == name), None)
            missing.append(
                f"kind of fault {name}: {kind.__module__}: number={kind.number or 'none'} of class "
                f"{kind.__name__} must be {was or f'one that no kind has or had; {free} is free'}"
            )
    listed = dict(re.findall(r"^\| ([a-z]+) \| (.*) \|$", page("faults.md"), re.MULTILINE))
    missing += [f"kind of fault {name}: docs/faults.md, Kinds of faults, must list it under {kind.stage}"
                for name, kind in faults.KINDS.items()
                if name not in listed.get(kind.stage, "").split(", ")]  # fmt: skip
    injected = {kind for each in DEFECTS.values() for kind in each.faults}
    missing += [f"kind of fault {name}: `faults` of a row in {DEFECT_TABLE} must name it, and which number is its size"
                for name in faults.KINDS if name not in injected]  # fmt: skip
    of_channels = {name for name, kind in faults.KINDS.items() if not kind.of_blocks}
    unfiltered = {name for name, kind in faults.KINDS.items() if kind.stage == "filter"}  # test signals have no filter
    for table, needed, has in (
        ("EXAMPLES", of_channels, fault_cases.EXAMPLES),
        ("BLOCKS", faults.KINDS.keys() - of_channels, fault_cases.BLOCKS),
        ("MONITORED", faults.KINDS.keys() - unfiltered, fault_cases.MONITORED | fault_cases.MONITORED_PULSES),
        ("SCORED", of_channels, fault_cases.SCORED), ("BLIND_SIZES", of_channels, fault_cases.BLIND_SIZES),
    ):  # fmt: skip
        where = f"{table} in tests/fault_cases.py"
        missing += [f"kind of fault {name}: {where} needs a case of it" for name in needed - {*has}]
        missing += [f"kind of fault {name}: {where} has a case of no such kind" for name in {*has} - needed]
    require(missing)


def test_a_defect_is_injected_sized_and_recognised_or_has_a_reason() -> None:
    calls = [
        node for path in (ROOT / "replays/recordings/validation/explanations").glob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
    ]  # fmt: skip
    words = {each for node in calls if isinstance(node, ast.Constant) and isinstance(node.value, str)
            for text in (node.value, node.value.split()[-1:] and node.value.split()[-1])
            for each in alternatives(str(text))}  # fmt: skip
    missing = []
    for name, row in DEFECTS.items():
        where = f"defect {name}: {DEFECT_TABLE}"
        names = row.validation or [name]
        readers = {"validation": row.doubts or words & {name, *names}, "score": row.score or row.digital}
        for reader, recognises in readers.items():
            if not recognises and reader not in row.undetected:
                missing.append(
                    f"{where} must say how {reader} recognises it, or in `undetected.{reader}` why it cannot"
                )
            if recognises and reader in row.undetected:
                missing.append(f"{where} has `undetected.{reader}`, and {reader} recognises it")
        missing += [f"{where}: {each} of `{part}` is no quantity of the {path} scorecard"
                    for part, path in (("score", "analogue"), ("digital", "digital"))
                    for each in getattr(row, part) if each not in QUANTITIES[path]]  # fmt: skip
        for kind, number in row.faults.items():
            if kind not in faults.KINDS:
                missing.append(f"{where}: {kind} of `faults` is no kind of fault")
            elif number and number not in faults.KINDS[kind].model_fields:
                missing.append(f"{where}: {number} of `faults` is no number of {kind}")
            elif number and not row.size:
                missing.append(f"{where} needs `size`: what {number} of {kind} means")
        if not row.text.endswith("."):
            missing.append(f"{where} needs `text`: a sentence")
    for call in calls:
        if isinstance(call, ast.Call) and ast.unparse(call.func) in ("one.law", "SignalFault"):
            name = call.args[ast.unparse(call.func) == "SignalFault"]
            missing += [f"defect {each}: {DEFECT_TABLE} has no row of it, and explanations/ reports it"
                        for part in ([name.body, name.orelse] if isinstance(name, ast.IfExp) else [name])
                        if isinstance(part, ast.Constant) for each in alternatives(str(part.value))
                        if not defects_in(each)]  # fmt: skip
    require(missing)


def test_a_file_format_has_a_row_and_a_reader() -> None:
    readers = "replays/recordings/formats/readers"
    missing = []
    for name, form in FORMATS.items():
        where = f"file format {name}: {form.module.replace('.', '/')}.py"
        if find_spec(form.module) is None:
            missing.append(f"{where} is missing")
            continue
        module = importlib.import_module(form.module)
        if not callable(getattr(module, "look_into", None)):
            missing.append(f"{where} needs look_into(path, options)")
        if not form.title or not form.suffixes or not all(each.startswith(".") for each in form.suffixes):
            missing.append(f"file format {name}: its row in FORMATS needs a title, and suffixes that begin with a dot")
        writer = getattr(module, form.writer, None) if form.writer else FormatWriter
        if not (isinstance(writer, type) and issubclass(writer, FormatWriter)):
            missing.append(f"{where} needs a class {form.writer} derived from FormatWriter")
        elif form.writer and writer.write is FormatWriter.write:
            missing.append(f"{where}: {form.writer} needs write")
        for place, text, endings in (
            ("IMPORTED in rig/cli/commands/import_.py", IMPORTED, form.suffixes),
            ("EXPORTED in rig/cli/commands/export.py", EXPORTED, form.suffixes[:1] if form.writer else ()),
        ):
            lacking = [each for each in endings if each not in re.findall(r"\.\w+", text)]
            missing += [f"file format {name}: {place} must name {each}" for each in lacking]
    used = {form.module for form in FORMATS.values()}
    for path in (ROOT / readers).glob("*.py"):
        if f"{readers}/{path.stem}".replace("/", ".") not in used and "\ndef look_into(" in path.read_text():
            missing.append(f"file format {path.stem}: FORMATS in replays/recordings/formats/source.py has no row of it")
    ends = [suffix for form in FORMATS.values() for suffix in form.suffixes]
    missing += [f"suffix {each}: two rows of FORMATS have it" for each in set(ends) if ends.count(each) > 1]
    require(missing)


def _texts(node: ast.AST) -> Iterator[str]:
    for each in ast.walk(node):
        if isinstance(each, ast.Constant) and isinstance(each.value, str):
            yield each.value


def test_a_quantity_of_a_scorecard_has_an_entry_a_row_and_is_on_the_page() -> None:
    trees = {path.relative_to(ROOT): ast.parse(path.read_text()) for path in (ROOT / "replays/score").rglob("*.py")
             if path.name != "scorecard.py"}  # fmt: skip
    texts = {text for tree in trees.values() for text in _texts(tree)}
    entries = "replays/score/card/scorecard.py"
    missing = [f"quantity {name}: no module of replays/score adds a row of it to the {path} scorecard"
               for path, quantities in QUANTITIES.items() for name in quantities if name not in texts]  # fmt: skip
    for path, quantities in QUANTITIES.items():
        listed = page("score-reference.md").partition(f"\n- {path}: ")[2].partition("\n-")[0].partition("\n\n")[0]
        names = listed.replace("\n ", "").split(", ")
        missing += [f"quantity {name}: docs/score-reference.md must list it under {path}"
                    for name in quantities if name not in names]  # fmt: skip
    found = 0
    for path, tree in trees.items():
        for call in ast.walk(tree):
            if not isinstance(call, ast.Call) or len(call.args) < 2:
                continue
            function = ast.unparse(call.func)
            if function in ("add", "card.add"):
                name = call.args[0]
            elif function in ("text_row", "judge_row"):
                name = call.args[1]
            else:
                continue
            if isinstance(name, ast.Constant):
                found += 1
                known = QUANTITIES["digital" if path.name in ("digital.py", "judgement.py") else "analogue"]
                if name.value not in known:
                    missing.append(f"quantity {name.value}: {path} adds a row, and {entries} has no Quantity of it")
    assert found > 20
    require(missing)


def test_a_command_has_a_line_a_function_and_is_on_the_page() -> None:
    named = {name: text for commands in app.COMMANDS.values() for name, text in commands.items()}
    missing = []
    for name, text in named.items():
        if hasattr(requests, name) or (name in SUMMARIES and name != "fault"):
            continue  # a request, or built from the command's own class
        module = name.replace("import", "import_")
        place = f"rig/cli/commands/{module}.py"
        if not re.search(rf"\brig {name}\b", page("commands.md")):
            missing.append(f"command {name}: docs/commands.md must name `rig {name}`")
        if find_spec(f"rig.cli.commands.{module}") is None:
            missing.append(f"command {name}: {place} is missing")
            continue
        function = getattr(importlib.import_module(f"rig.cli.commands.{module}"), module, None)
        if function is None:
            missing.append(f"command {name}: {place} has no function of its name")
        elif not (inspect.getdoc(function) or "").startswith(text):
            missing.append(f"command {name}: the docstring in {place} must begin with its line in rig/cli/app.py")
    modules = {path.stem.rstrip("_") for path in (ROOT / "rig/cli/commands").glob("[!_]*.py")} - {"requests"}
    missing += [f"command {name}: COMMANDS in rig/cli/app.py has no line of it" for name in modules - named.keys()]
    require(missing)


def test_an_instrument_has_a_protocol_a_driver_a_twin_and_is_served() -> None:
    folder = ROOT / "drivers/instruments"
    found = {path.name for path in folder.iterdir() if path.is_dir() and path.name not in ("common", "__pycache__")}
    parts = [f"{name}/{part}.py" for name in found for part in ("__init__", "protocol", "driver", "twin")]
    require([f"instrument: drivers/instruments/{part} is missing" for part in parts if not (folder / part).is_file()])
    from drivers.instruments.twins import TWINS  # a missing twin would be an error of the import

    served = {twin.__module__.split(".")[2] for twin in TWINS}
    missing = [f"instrument {name}: TWINS in drivers/instruments/twins.py must name its twin"
               for name in found - served]  # fmt: skip
    numbers = [twin.CODEC.address.number for twin in TWINS]
    missing += [f"instrument {twin.CODEC.address.name}: its number {twin.CODEC.address.number} is another's; "
                f"{next(n for n in range(1, 256) if n not in numbers)} is free"
                for twin in TWINS if numbers.count(twin.CODEC.address.number) > 1]  # fmt: skip
    for name in found:
        code = ast.parse((folder / name / "driver.py").read_text())
        bases = [ast.unparse(base).partition("[")[0] for node in code.body if isinstance(node, ast.ClassDef)
                 for base in node.bases]  # fmt: skip
        missing += [f"instrument {name}: drivers/instruments/{name}/driver.py needs a class derived from {kind}Sampler "
                    f"or {kind}Instrument of drivers.instruments.common"
                    for kind in ("", "Async") if not {f"{kind}Sampler", f"{kind}Instrument"} & {*bases}]  # fmt: skip
    require(missing)
