"""Parameter sets: their contents, units removed at loading, overrides, users' own files."""

from __future__ import annotations

import ast
import json
import math
import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.base.errors import InputError
from rig.physics.model import build_model
from rig.physics.parameters import DEFAULT_SET, SETS, SI, ParameterSet, load_parameters, set_names

DEFAULT = load_parameters()
NUMBERS = [key for key, entry in DEFAULT.entries.items() if not isinstance(entry.value, str)]


def user_file(folder: Path, text: str) -> ParameterSet:
    path = folder / "mine.toml"
    path.write_text(text)
    return load_parameters(str(path))


def test_names_put_the_default_first() -> None:
    assert set_names() == [DEFAULT_SET, "as-printed", "dtu-2019"]


@pytest.mark.parametrize("name", set_names())
def test_every_value_has_a_source(name: str) -> None:
    parameters = load_parameters(name)
    assert set(parameters.entries) == set(DEFAULT.entries)
    for key, entry in parameters.entries.items():
        assert entry.source.strip(), key
        assert entry.symbol.strip(), key
        assert entry.range[0] < entry.range[1], key
        assert entry.unit == DEFAULT.entries[key].unit, key


@pytest.mark.parametrize("name", [name for name in set_names() if name != DEFAULT_SET])
def test_another_set_differs_only_in_the_values_of_its_file(name: str) -> None:
    data = tomllib.loads((SETS / f"{name}.toml").read_text())
    listed = {f"{section}.{key}" for section, members in data.items() if isinstance(members, dict) for key in members}
    parameters = load_parameters(name)
    assert {key for key, entry in parameters.entries.items() if entry != DEFAULT.entries[key]} == listed


@pytest.mark.parametrize(
    ("key", "si"),
    [
        ("shaft.mass", 1.28),
        ("shaft.radius", 12.5e-3),
        ("ring.clearance", 0.926e-3),
        ("contact.smoothing_speed", 5e-3),
        ("magnet.stiffness", 1700.0),
        ("magnet.magnetisation", 705e3),
        ("drive.top_speed", 2 * math.pi * 15.0),
        ("drive.ramp_rate", 2 * math.pi * 2.0),
        ("shaft.young_modulus", 70e9),
    ],
)
def test_units_are_converted_at_loading(key: str, si: float) -> None:
    assert DEFAULT[key] == pytest.approx(si, rel=1e-15)


@given(key=st.sampled_from(NUMBERS), part=st.floats(0.0, 1.0))
def test_override_uses_the_parameters_unit(key: str, part: float) -> None:
    entry = DEFAULT.entries[key]
    low, high = entry.range
    value = min(high, low + part * (high - low))
    if entry.unit == "count":
        value = float(round(value))
    changed = DEFAULT.override({key: value}, kind="fitted", source="here")
    assert changed[key] == pytest.approx(value * SI[entry.unit], rel=1e-15)
    assert (changed.entries[key].kind, changed.entries[key].source) == ("fitted", "here")
    others = {other: entry for other, entry in changed.entries.items() if other != key}
    assert others == {other: entry for other, entry in DEFAULT.entries.items() if other != key}


ARITHMETIC = (
    ast.Expression, ast.BinOp, ast.UnaryOp, ast.Constant, ast.Name, ast.Load, ast.Add, ast.Sub, ast.Mult, ast.Div,
    ast.Pow, ast.USub, ast.UAdd,
)  # fmt: skip


def is_formula(text: str, variables: tuple[str, ...]) -> bool:
    """Return whether a short text is a formula and not a wrong name: numbers and variables, with a digit, an operator
    or a space.
    """
    try:
        nodes = list(ast.walk(ast.parse(text.strip(), mode="eval")))
    except (SyntaxError, ValueError):
        return False
    constants = [node.value for node in nodes if isinstance(node, ast.Constant)]
    return (
        re.search(r"[\d\s()*/+]", text) is not None
        and all(isinstance(node, ARITHMETIC) for node in nodes)
        and all(type(value) in (int, float) and abs(value) < 1e300 for value in constants)
        and all(node.id in {*variables, "pi"} for node in nodes if isinstance(node, ast.Name))
    )


@given(key=st.sampled_from(list(DEFAULT.entries)), value=st.floats() | st.text(max_size=5))
def test_override_accepts_only_the_range_of_the_entry(key: str, value: float | str) -> None:
    entry = DEFAULT.entries[key]
    if isinstance(value, str):
        good = value in entry.rules or (bool(entry.formula) and is_formula(value, entry.formula))
    else:
        good = entry.range[0] <= value <= entry.range[1] and (entry.unit != "count" or value.is_integer())
    if good:
        assert DEFAULT.override({key: value}).entries[key].value == value
    else:
        must = "a (whole )?number from " if isinstance(value, float) or not entry.formula else ""
        with pytest.raises(InputError, match=f"^{key} must be {must}"):
            DEFAULT.override({key: value})


def test_override_does_not_change_the_loaded_set() -> None:
    before = DEFAULT["contact.friction"]
    DEFAULT.override({"contact.friction": 0.9})
    assert load_parameters()["contact.friction"] == before


@pytest.mark.parametrize("value", [True, None, [0.1], {"value": 0.1}, 1j])
def test_override_refuses_values_that_are_neither_number_nor_rule(value: object) -> None:
    with pytest.raises(InputError, match=r"^contact\.friction must be a number from 0 to 2"):
        DEFAULT.override({"contact.friction": value})


def test_unknown_key_names_its_neighbours() -> None:
    with pytest.raises(InputError, match=r"contact\.frictoin must be a parameter of the set, .*contact\.friction"):
        DEFAULT.override({"contact.frictoin": 0.1})


def test_a_rule_has_no_number_before_the_model() -> None:
    assert DEFAULT.rule("contact.stiffness") == "internal-sphere"
    assert DEFAULT.rule("contact.friction") is None
    with pytest.raises(TypeError, match="internal-sphere"):
        DEFAULT["contact.stiffness"]
    with pytest.raises(KeyError):
        DEFAULT["contact.nothing"]


def test_document_is_json_with_unit_and_provenance_of_every_value() -> None:
    document = json.loads(json.dumps(DEFAULT.document(), allow_nan=False))
    assert (document["set"], document["title"]) == (DEFAULT.name, DEFAULT.title)
    assert list(document["values"]) == list(DEFAULT.entries)
    for key, fields in document["values"].items():
        entry = DEFAULT.entries[key]
        assert fields == {
            "value": entry.value,
            "unit": entry.unit,
            "symbol": entry.symbol,
            "source": entry.source,
            "kind": entry.kind,
        }


def test_users_file_contains_numbers_or_tables(tmp_path: Path) -> None:
    parameters = user_file(
        tmp_path,
        """
        title = "Mine"
        base = "dtu-2019"
        [contact]
        friction = 0.11
        stiffness = "internal-sphere"
        [contact.restitution]
        value = 0.7
        unit = "1"
        source = "drop test"
        kind = "fitted"
        """,
    )
    assert parameters.title == "Mine"
    assert parameters["contact.friction"] == 0.11
    assert parameters.entries["contact.friction"].kind == "assumed"
    assert parameters.entries["contact.friction"].source == "mine.toml"
    assert parameters.rule("contact.stiffness") == "internal-sphere"
    restitution = parameters.entries["contact.restitution"]
    assert (restitution.value, restitution.kind, restitution.source) == (0.7, "fitted", "drop test")
    assert parameters.entries["house.inner_mass"] == load_parameters("dtu-2019").entries["house.inner_mass"]


def test_users_file_may_be_based_on_another_file(tmp_path: Path) -> None:
    below = tmp_path / "below.toml"
    below.write_text('base = "corrected"\n[contact]\nfriction = 0.11\n')
    parameters = user_file(tmp_path, f'base = "{below.as_posix()}"\n[shaft]\nmass = 1.5\n')
    assert (parameters["contact.friction"], parameters["shaft.mass"]) == (0.11, 1.5)


def test_a_changed_users_file_is_reloaded(tmp_path: Path) -> None:
    assert user_file(tmp_path, 'base = "corrected"\n[contact]\nfriction = 0.11\n')["contact.friction"] == 0.11
    assert user_file(tmp_path, 'base = "corrected"\n[contact]\nfriction = 0.22\n')["contact.friction"] == 0.22


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("base = 4\n", id="base-number"),
        pytest.param('base = ["corrected"]\n', id="base-list"),
        pytest.param('base = "corrected"\n[contact]\nfriction = true\n', id="bool"),
        pytest.param('base = "corrected"\n[contact.friction]\nvalue = 9.0\nrange = [0.0, 99.0]\n', id="own-range"),
        pytest.param('base = "corrected"\n[contact.friction]\nvalue = "x"\nrules = ["x"]\n', id="own-rule"),
    ],
)
def test_users_file_cannot_extend_the_models_limits(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match="must be"):
        user_file(tmp_path, text)


def test_circular_parameter_files_are_refused(tmp_path: Path) -> None:
    one, other = tmp_path / "one.toml", tmp_path / "other.toml"
    one.write_text(f'base = "{other.as_posix()}"\n')
    other.write_text(f'base = "{one.as_posix()}"\n')
    with pytest.raises(InputError, match="base must be"):
        load_parameters(str(one))


def _corners() -> list[object]:
    corners = []
    for key, entry in DEFAULT.entries.items():
        for value in (*entry.range, *entry.rules):
            corners.append(pytest.param(key, value, id=f"{key}={value}"))
    return corners


@pytest.mark.parametrize(("key", "value"), _corners())
def test_every_accepted_value_gives_a_model_or_an_error_message(key: str, value: float | str) -> None:
    parameters = DEFAULT.override({key: value})
    try:
        model = build_model(parameters)
    except InputError:
        # The magnets alone can be too weak, or too close to each other.
        assert key.startswith("magnet.") or key == "shaft.arm_magnet"
        return
    numbers = [number for part in model.constants[:4] for number in part]
    assert all(math.isfinite(number) for number in numbers)
    assert model.sag < 0.0 or parameters["gravity.acceleration"] == 0.0
