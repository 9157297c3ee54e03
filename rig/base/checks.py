"""Validation of input from clients, files and buses, done once where it enters.

A document has limited size and depth, plain numbers, and each key once. A model derived from `StrictModel` has typed
fields with ranges, and no others. Validated input is not checked again; invalid input raises `InputError`.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from rig.base.errors import InputError, RefusedError, Words, such_as
from rig.base.files import read_file
from rig.base.text import printable

DOCUMENT_BYTES = 16 << 20
"""Largest document of a rig or a recording [bytes]."""
TOML_BYTES = 1 << 20
"""Largest file written by a person [bytes]."""
DEPTH = 32
"""Deepest nesting of a document."""
MAX_INTEGER = 2**63 - 1
"""Largest whole number: the range of ticks, row numbers and seeds."""

Count = Annotated[int, Field(ge=0, lt=2**62)]
"""A number of rows, messages or ticks; the sum of two still fits into 64 bits."""


class StrictModel(BaseModel):
    """A document from outside, or part of one: `"100"` and true are not numbers; unknown fields are refused."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class Written(BaseModel):
    """A table written by a person, in a scene or another file; unknown fields are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _refuse_wrong_types(cls, data: Any) -> Any:
        # Python treats true as 1; a file with true means something else.
        for name, value in data.items() if isinstance(data, dict) else ():
            kind = cls.model_fields[name].annotation if name in cls.model_fields else bool
            if isinstance(value, bool) and bool not in (kind, *get_args(kind)):
                raise InputError(name, "something else than true or false", value)
            if (
                isinstance(value, str)
                and value[:1].isdigit()
                and not cls.model_config.get("strict")
                and name in cls.model_fields
                and cls.model_fields[name].annotation in (int, float)
            ):
                raise InputError(name, "a number", value)
        return data


def a_line(most: int) -> AfterValidator:
    """Return a validator for a line of 1 to `most` printable characters, not all blank."""

    def check_line(text: str) -> str:
        if not text.isprintable() or not text.strip() or len(text) > most:
            raise ValueError(f"a line of 1 to {most} printable characters, not all blank")
        return text

    return AfterValidator(check_line)


Name = Annotated[str, a_line(100)]
"""Name that a client gives itself."""


def read_json(payload: bytes, *, field: str = "payload", most_bytes: int = DOCUMENT_BYTES) -> dict[str, Any]:
    """Return the JSON object in a payload.

    Args:
        payload: UTF-8.
        field: Name of the payload, for errors.
        most_bytes: Largest payload.

    Raises:
        InputError: The payload is too large, not UTF-8, not a JSON object, or nested too deep, has a key twice, or a
            number beyond a double or 64-bit integer.
    """
    if len(payload) > most_bytes:
        raise InputError(field, f"at most {most_bytes} bytes", len(payload))
    try:
        text = payload.decode("utf-8")
        document = json.loads(
            text,
            object_pairs_hook=_refuse_duplicate_keys,
            parse_int=_parse_int,
            parse_float=_parse_float,
            parse_constant=_parse_float,
        )
        if "\\u" in text:
            # Half of an escaped surrogate pair cannot be written anywhere.
            json.dumps(document, ensure_ascii=False).encode("utf-8")
    except RecursionError:
        raise InputError(field, f"nested at most {DEPTH} deep", Words("a document nested deeper")) from None
    except InputError as error:
        raise InputError(field, error.must, error.received) from None
    except ValueError as error:
        raise InputError(field, f"a JSON object in UTF-8 ({printable(str(error), 200)})", payload[:60]) from None
    if not isinstance(document, dict):
        raise InputError(field, "a JSON object", document)
    if text.count("[") + text.count("{") > DEPTH:
        check_depth(document, field=field)
    return document


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file written by a person: a scene, a set, a mapping, criteria, a channel table.

    Raises:
        InputError: The file cannot be read, is not TOML, or is out of bounds (see `parse_toml`).
    """
    try:
        return parse_toml(read_file(path, TOML_BYTES).decode("utf-8-sig"), field=str(path))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(str(path), "a TOML file", Words(printable(str(error), 200))) from None
    except OSError as error:
        raise InputError(str(path), "a readable file", Words(error.strerror)) from None


def parse_toml(text: str, *, field: str) -> dict[str, Any]:
    """Return the document in a TOML text.

    Args:
        text: The text.
        field: Name of the text, for errors.

    Raises:
        tomllib.TOMLDecodeError: The text is not TOML.
        InputError: The text is too large, nested too deep, or has a whole number beyond 64 bits.
    """
    if len(text) > TOML_BYTES:
        raise InputError(field, f"at most {TOML_BYTES} bytes", Words("a longer text"))
    # The parser's time grows with the square of the number of parts of a dotted key.
    if max(map(len, map(_DOTTED.findall, re.split(r"[,=\n]", text)))) > DEPTH:
        raise InputError(field, f"keys of at most {DEPTH} parts", Words("a longer one"))
    try:
        document = tomllib.loads(text)
    except RecursionError:
        raise InputError(field, f"nested at most {DEPTH} deep", Words("a document nested deeper")) from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:  # digits beyond Python's own limit
        number = _LONG_NUMBER.search(text)
        if number is not None and "\n" in text:
            field += f", line {text.count(chr(10), 0, number.start()) + 1}"
        received = Words(printable(str(error), 100) if number is None else "one of thousands of digits")
        raise InputError(field, f"without whole numbers beyond +-{MAX_INTEGER}", received) from None
    check_depth(document, field=field)
    return document


def check_depth(document: Any, *, field: str) -> None:
    """Raise an error for a document nested deeper than `DEPTH`, or with a whole number beyond `MAX_INTEGER`.

    Raises:
        InputError: The document exceeds a limit.
    """
    level = [document]
    for _ in range(DEPTH + 1):
        for item in level:
            if isinstance(item, int) and abs(item) > MAX_INTEGER:
                raise InputError(field, f"without whole numbers beyond +-{MAX_INTEGER}", item)
        level = [
            item
            for each in level
            if isinstance(each, dict | list)
            for item in (each.values() if isinstance(each, dict) else each)
        ]
        if not level:
            return
    raise InputError(field, f"nested at most {DEPTH} deep", Words("a document nested deeper"))


def get_table(data: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return a table in a document; an empty one if it is missing.

    Raises:
        InputError: The entry is not a table.
    """
    table = data.get(name, {})
    if not isinstance(table, dict):
        raise InputError(name, "a table of named fields", table)
    return table


_LONG_NUMBER = re.compile(r"\d[\d_]{4000,}")
_DOTTED = re.compile(r"\.[ \t]*[\w\"'-]")


def _refuse_duplicate_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) < len(pairs):
        names = [name for name, _ in pairs]
        raise InputError("", "without duplicate keys", next(name for name in names if names.count(name) > 1))
    return document


def _parse_int(digits: str) -> int:
    # Well below Python's own limit of 4300 digits, above which it raises.
    if len(digits) > len(str(-MAX_INTEGER)) or not -MAX_INTEGER - 1 <= (number := int(digits)) <= MAX_INTEGER:
        raise InputError("", f"without whole numbers beyond +-{MAX_INTEGER}", printable(digits, 60))
    return number


def _parse_float(digits: str) -> float:
    if not math.isfinite(number := float(digits)):
        raise InputError("", "with finite numbers only", printable(digits, 60))
    return number


Model = TypeVar("Model", bound=BaseModel)
Extension = TypeVar("Extension")


def check(model: type[Model], document: Any, *, field: str, most_bytes: int = 10_000) -> Model:
    """Return a document as its model.

    Args:
        model: The model.
        document: The document, or its payload.
        field: Name of the document, for errors; its fields are named after a dot.
        most_bytes: Largest payload.

    Raises:
        InputError: The document does not fit; the message names the first wrong field.
    """
    if isinstance(document, bytes):
        document = read_json(document, field=field, most_bytes=most_bytes)
    if not isinstance(document, Mapping) or not all(isinstance(name, str) for name in document):
        raise InputError(field or "document", "a set of named fields", document)
    try:
        return model.model_validate(document)
    except ValidationError as error:
        raise input_error(error, field, model) from None


# Names of union branches, which pydantic adds to the location of an error.
_BRANCH = re.compile(r"(function-\w+|tuple|list|dict|set|literal|nullable|chain)\[.*\]|constrained-\w+", re.DOTALL)
_PLAIN_BRANCH = {"float": ("float", "finite", "greater", "less"), "int": ("int", "greater", "less"), "str": ("string",)}


def describe_error(error: BaseException) -> str:
    """Return class and text of another package's error on one line."""
    try:
        return printable(f"{type(error).__name__}: {error}", 200)
    except Exception:  # of its __str__
        return type(error).__name__


@cache
def find_entry_points(group: str) -> tuple[Any, ...]:
    """Return the entry points of a group in all installed packages; a search takes 20 ms, so it is done once."""
    from importlib.metadata import entry_points

    return tuple(entry_points(group=group))


def load_extensions(
    group: str, kind: type[Extension], used_names: Iterable[str]
) -> tuple[dict[str, Extension], list[str]]:
    """Return the entries that other packages add to a table, by name, and why others are unusable.

    Args:
        group: Group of the entry points.
        kind: Class of an entry.
        used_names: Names in the table.
    """
    entries: dict[str, Extension] = {}
    broken = []
    for point in find_entry_points(group):
        try:
            entry = point.load()
        except (Exception, SystemExit) as error:  # external code may raise anything
            broken.append(f"{point.name} ({point.value} cannot be loaded: {describe_error(error)})")
            continue
        if point.name in {*used_names, *entries}:
            broken.append(f"{point.name} ({point.value} has a name that is in use)")
        elif not isinstance(entry, kind):
            broken.append(f"{point.name} ({point.value} must be a {kind.__module__}.{kind.__qualname__})")
        else:
            try:
                entries[point.name] = TypeAdapter(kind).validate_python(entry, strict=True)
            except ValidationError as error:
                mismatch = input_error(error, "", BaseModel)
                broken.append(f"{point.name} ({point.value}: {mismatch})")
    return entries, broken


def _name_location(parts: tuple[str | int, ...], kind: str) -> list[str]:
    """Return the names of an error's location that occur in the file."""
    named = kind in ("extra_forbidden", "missing")
    names = []
    for number, part in enumerate(parts):
        name, last = str(part), number == len(parts) - 1
        branch = _BRANCH.fullmatch(name) or (last and kind.startswith(_PLAIN_BRANCH.get(name, ("\0",))))
        # A timed command's own fields are next to its time.
        inner = name == "request" and number > 0 and isinstance(parts[number - 1], int)
        if (last and named) or not (branch or inner):
            names.append(printable(name, 100) or '""')
    return names


def _fields(models: list[type[BaseModel]], parts: tuple[str | int, ...]) -> list[str]:
    """Return the field names at a location in documents of the models; of all models that fit there."""
    for part in parts:
        fields = [field for each in models for name, field in each.model_fields.items() if name == part]
        models = [inner for field in fields for inner in _models(field.annotation)] or models
        # The union member selected by the tag.
        tagged = (each for each in models if get_args(next(iter(each.model_fields.values())).annotation) == (part,))
        models = list(tagged) or models
    return [field.alias or name for each in models for name, field in each.model_fields.items()]


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [inner for part in get_args(annotation) for inner in _models(part)]


def _join(place: str, field: str) -> str:
    """Return the path of a field of a place; the field's own path may begin with the end of the place."""
    parts = place.split(".") if place else []
    for count in range(len(parts), 0, -1):
        if f"{field}.".startswith(f"{'.'.join(parts[-count:])}."):
            return ".".join([*parts[:-count], field])
    return ".".join([*parts, field])


def input_error(error: ValidationError, field_prefix: str, model: type[BaseModel]) -> InputError:
    """Return the first error of a validation in the one-line form for users."""
    first = error.errors()[0]
    cause = first.get("ctx", {}).get("error")
    field = ".".join(part for part in (field_prefix, *_name_location(first["loc"], first["type"])) if part)
    if isinstance(cause, InputError):  # a rule over several fields names its own
        named = _join(field, cause.field)
        whole = named == cause.field or isinstance(cause, RefusedError)
        return cause if whole else InputError(named, cause.must, cause.received)
    message = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ").partition(", unable")[0]
    message = re.sub(r"^\w+ should have ", "a value of ", message).replace("a valid tuple", "a list")
    message = message.partition(" after validation, not ")[0]
    message += "".join(  # words that the field accepts in addition to the first kind of value
        f" or {other.get('ctx', {}).get('expected')}"
        for other in error.errors()[1:]
        if other["type"] == "literal_error" and other["loc"][:-1] == first["loc"][:-1]
    )
    if first["type"] == "union_tag_invalid":
        context = first.get("ctx", {})
        name = str(context.get("discriminator")).strip("'")
        return InputError(f"{field}.{name}", f"one of {context.get('expected_tags')}", context.get("tag"))
    if first["type"] == "extra_forbidden":
        names = _fields([model], first["loc"][:-1])
        message = such_as("a known field", first["loc"][-1], names) if names else "left out (it has no fields)"
    elif first["type"] == "missing":
        message = "given"
    return InputError(field, message, None if first["type"] == "missing" else first["input"])
