"""Parameter sets: data files, checked and converted to frozen SI values. Only this module knows units.

A set is a TOML file of values with unit, symbol, source and kind. `corrected` lists every parameter. Any other set, a
user's file included, names a `base` and the values that differ from it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    StrictFloat,
    StrictInt,
    StrictStr,
    field_validator,
)

from rig.base.checks import check, read_toml
from rig.base.errors import InputError, UnknownNameError, such_as
from rig.base.files import is_file
from rig.base.maths.expression import Grammar
from rig.base.text import build_html_table

SETS = Path(__file__).with_name("sets")
DEFAULT_SET = "corrected"

SI = {
    "1": 1.0, "count": 1.0, "kg": 1.0, "kg m^2": 1.0, "m": 1.0, "mm": 1e-3, "rad": 1.0, "Pa": 1.0, "N": 1.0,
    "N/m": 1.0, "kN/m": 1e3, "N/m^n": 1.0, "N s/m": 1.0, "m/s": 1.0, "mm/s": 1e-3, "m/s^2": 1.0,
    "A/m": 1.0, "kA/m": 1e3, "N m s": 1.0, "Hz": 2.0 * math.pi, "Hz/s": 2.0 * math.pi,
}  # fmt: skip
"""Factor to SI of every unit that a set may use (a frequency becomes rad/s)."""

_NAME = re.compile(r"\s*([^\W\d][\w-]*)?\s*")
_MODEL_FIELDS = ("range", "rules", "formula")
"""Parameter fields that belong to the model: no file may change them, and no recording contains them."""
Kind = Literal["paper", "corrected", "literature", "datasheet", "fitted", "assumed"]


def _number(value: float | str) -> float | str:
    return value if isinstance(value, str) else float(value)


class Parameter(BaseModel, frozen=True, extra="forbid"):
    """Parameter value with its unit, symbol in the paper, provenance and accepted values."""

    value: Annotated[StrictFloat | StrictInt | StrictStr, AfterValidator(_number)]
    unit: str
    symbol: str
    source: str
    kind: Kind
    range: tuple[float, float]
    rules: tuple[str, ...] = ()
    """Rules accepted in place of a number."""
    formula: tuple[str, ...] = ()
    """Variables of a formula accepted in place of a number; empty if no formula is accepted."""

    @field_validator("unit")
    @classmethod
    def _known_unit(cls, unit: str) -> str:
        if unit not in SI:
            raise ValueError(f"one of {', '.join(SI)}")
        return unit


class ParameterSet:
    """All parameters of a rig, checked and frozen.

    Attributes:
        name: Name of the set, or path of a user's file.
        title: One-line description.
        entries: Parameters by dotted key, in file order.

    Example:
        >>> import rig
        >>> parameters = rig.load_parameters().override({"contact.friction": 0.3})
        >>> parameters
        ParameterSet(corrected: 50 parameters)
        >>> f"{parameters['drive.top_speed']:.1f} rad/s", parameters.entries["drive.top_speed"].unit  # SI; its own unit
        ('94.2 rad/s', 'Hz')
        >>> parameters["contact.fricton"]
        Traceback (most recent call last):
        rig.base.errors.UnknownNameError: parameter must be one of the set, such as contact.friction, ...
    """

    def __init__(self, name: str, title: str, entries: dict[str, Parameter]) -> None:
        self.name = name
        self.title = title
        self.entries = entries
        for key, entry in entries.items():
            _check(key, entry)

    def __getitem__(self, key: str) -> float:
        """Return the value of a numeric parameter in SI.

        Raises:
            UnknownNameError: There is no such parameter.
            TypeError: The value is a rule; the model computes its number.
        """
        entry = self._entry(key)
        if isinstance(entry.value, str):
            raise TypeError(f"{key} is the rule {entry.value!r}; the model computes its number")
        return entry.value * SI[entry.unit]

    def numbers(self) -> dict[str, float]:
        """Return the numeric values in SI, by key."""
        return {key: self[key] for key, entry in self.entries.items() if not isinstance(entry.value, str)}

    def rule(self, key: str) -> str | None:
        """Return the name of the rule that gives a value, or None for a number."""
        value = self._entry(key).value
        return value if isinstance(value, str) else None

    def _entry(self, key: str) -> Parameter:
        if key not in self.entries:
            raise UnknownNameError("parameter", "one of the set", key, self.entries)
        return self.entries[key]

    def __repr__(self) -> str:
        return f"ParameterSet({self.name}: {len(self.entries)} parameters)"

    def _repr_html_(self) -> str:
        rows = [(key, each.value, each.unit, each.symbol, each.kind, each.source) for key, each in self.entries.items()]
        return build_html_table(
            f"{self!r}: {self.title}", ("parameter", "value", "unit", "symbol", "kind", "source"), rows
        )

    def override(self, changes: dict[str, Any], *, kind: Kind = "assumed", source: str = "override") -> ParameterSet:
        """Return the set with some values replaced, each in its parameter's own unit.

        Args:
            changes: New values (numbers or names of rules) by dotted key.
            kind: Provenance recorded for the changed values.
            source: Source recorded for the changed values.

        Raises:
            InputError: Unknown key, or a value that the parameter does not accept.
        """
        entries = dict(self.entries)
        for key, value in changes.items():
            if key not in entries:
                raise InputError(key, such_as("a parameter of the set", key, entries), value)
            if isinstance(value, bool) or not isinstance(value, int | float | str):
                raise InputError(key, _accepts(entries[key]), value)
            value = value if isinstance(value, str) else float(value)
            entries[key] = entries[key].model_copy(update={"value": value, "kind": kind, "source": source})
        return ParameterSet(self.name, self.title, entries)

    def document(self) -> dict[str, Any]:
        """Return the set as the JSON document that is recorded with every stream."""
        return {
            "set": self.name,
            "title": self.title,
            "values": {
                key: entry.model_dump(mode="json", exclude=set(_MODEL_FIELDS)) for key, entry in self.entries.items()
            },
        }


def set_names() -> list[str]:
    """Return the names of the built-in sets, the default first."""
    return list(_own_names())


@cache
def _own_names() -> tuple[str, ...]:
    # Each simulation needs the names several times, and the files are part of the package.
    return tuple(sorted((path.stem for path in SETS.glob("*.toml")), key=lambda name: (name != DEFAULT_SET, name)))


def load_parameters(name_or_path: str = DEFAULT_SET) -> ParameterSet:
    """Load a built-in set by name, or a user's file by path.

    Raises:
        InputError: No such set, not a set file, an unknown key, or a value that the model does not accept.

    Example:
        >>> parameters = load_parameters("as-printed")
        >>> entry = parameters.entries["contact.friction"]
        >>> entry.value, entry.unit, entry.kind
        (0.25, '1', 'paper')
        >>> f"{parameters['ring.clearance']:.6f} m"  # a number in SI; the set has 0.926 mm
        '0.000926 m'
    """
    return _load(name_or_path, "parameters", ())


def apply_changes(parameters: ParameterSet, changes: Mapping[str, Any], *, source: str) -> ParameterSet:
    """Return `parameters.override(changes)`; the same changes of the same set return the same object.

    Setting up a simulation needs its parameters several times.

    Args:
        parameters: Parameter set.
        changes: New values by dotted key, as in `ParameterSet.override`.
        source: Source recorded for the changed values.

    Raises:
        InputError: Unknown key, or a value that the parameter does not accept.
    """
    # The type is part of the key: 1, 1.0 and true are equal, but not interchangeable.
    return _overridden(parameters, tuple((key, type(value), value) for key, value in changes.items()), source)


@lru_cache(maxsize=16)
def _overridden(parameters: ParameterSet, changes: tuple[tuple[str, type, Any], ...], source: str) -> ParameterSet:
    return parameters.override({key: value for key, _, value in changes}, source=source)


def _load(name: Any, field: str, loading: tuple[str, ...]) -> ParameterSet:
    """Load a set for the field that names it.

    Args:
        name: Name of a built-in set, or path of a file.
        field: Field to name in errors.
        loading: Paths of the files that depend on this set, to detect a cycle.
    """
    if isinstance(name, str) and name in _own_names():
        return _own_set(name)
    path = Path(name) if isinstance(name, str) else None
    if path is None or path.suffix != ".toml" or not is_file(path):
        sets = f"one of {', '.join(set_names())}, or the path of an existing .toml file"
        raise InputError(field, f"the set that the file changes, {sets}" if name is None else sets, name)
    place = str(path.resolve())
    if place in loading:
        raise InputError(field, "a set other than the file itself and those based on it", name)
    return _parse(str(name), read_toml(path), path, (*loading, place))


@cache
def _own_set(name: str) -> ParameterSet:
    path = SETS / f"{name}.toml"
    return _parse(name, read_toml(path), path, ())


def _parse(name: str, data: dict[str, Any], path: Path, loading: tuple[str, ...]) -> ParameterSet:
    data = dict(data)
    title = data.pop("title", name)
    base = data.pop("base", None)
    foundation = name == DEFAULT_SET
    entries = {} if foundation else dict(_load(base, f"{path.name}: base", loading).entries)
    for section, members in data.items():
        if not isinstance(members, dict):
            raise InputError(f"{path.name}: {section}", "a table of parameters", members)
        for member, fields in members.items():
            key = f"{section}.{member}"
            # Users may write a bare number for a table with only a value.
            changed = fields if isinstance(fields, dict) else {"value": fields, "kind": "assumed", "source": path.name}
            if not foundation and key not in entries:
                must = such_as(f"a parameter of the set {base}", key, entries)
                raise InputError(f"{path.name}: {key}", must, changed.get("value"))
            entry = entries[key].model_dump() if key in entries else {}
            for fixed in _MODEL_FIELDS:
                if fixed in changed and entry:
                    raise InputError(
                        f"{path.name}: {key}.{fixed}", "unchanged, as the model defines it", changed[fixed]
                    )
            if "unit" in changed and entry and changed["unit"] != entry["unit"]:
                raise InputError(f"{path.name}: {key}.unit", entry["unit"], changed["unit"])
            entries[key] = check(Parameter, {**entry, **changed}, field=f"{path.name}: {key}")
    return ParameterSet(name, title, entries)


def _accepts(entry: Parameter) -> str:
    low, high = entry.range
    whole = entry.unit == "count"
    text = f"a {'whole ' if whole else ''}number from {low:g} to {high:g}"
    text += "" if whole or entry.unit == "1" else f" {entry.unit}"
    text += f" or one of {', '.join(entry.rules)}" if entry.rules else ""
    return text + (f", or a formula of {', '.join(entry.formula)}" if entry.formula else "")


def _check(key: str, entry: Parameter) -> None:
    value = entry.value
    low, high = entry.range
    if isinstance(value, str):
        good = value in entry.rules
        if not good and entry.formula and not _is_unknown_name(value, entry.formula):
            Grammar(entry.formula).read(value, key)
            good = True
    else:
        good = low <= value <= high and (entry.unit != "count" or float(value).is_integer())
    if not good:
        raise InputError(key, _accepts(entry), value)


def _is_unknown_name(value: str, variables: Iterable[str]) -> bool:
    """Return True for text such as `hunt-crosley`, a misspelt rule, and False for variables, as in `R_S-r0`."""
    return _NAME.fullmatch(value) is not None and not set(value.strip().split("-")) <= set(variables)
