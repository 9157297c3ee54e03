"""Option groups: dataclasses whose fields become options of a command."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from functools import wraps
from typing import Any, get_type_hints

import typer


def panel(title: str) -> Callable[..., Any]:
    """Return a function that creates options under a heading of the help, from help text, names and settings."""
    return lambda says, *names, **settings: typer.Option(*names, help=says, rich_help_panel=title, **settings)


def expand_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with its option groups, nested ones too, replaced by their fields.

    Args:
        command: A function whose keyword parameters may have such a dataclass as type.
    """
    hints = get_type_hints(command, include_extras=True)
    hints.pop("return", None)
    groups = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        parameters += _fields(groups[name]) if name in groups else [parameter.replace(annotation=hints[name])]

    @wraps(command)
    def call(*arguments: Any, **options: Any) -> None:
        built = {name: _build(group, options) for name, group in groups.items()}
        command(*arguments, **options, **built)

    del call.__wrapped__  # pyrefly: ignore[missing-attribute]
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return call


def _fields(group: Any) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    parameters: list[inspect.Parameter] = []
    for field in fields(group):
        hint = hints[field.name]
        if is_dataclass(hint):
            parameters += _fields(hint)
        else:
            default = inspect.Parameter.empty if field.default is MISSING else field.default
            keyword = inspect.Parameter.KEYWORD_ONLY
            parameters.append(inspect.Parameter(field.name, keyword, default=default, annotation=hint))
    return parameters


def _build(group: Any, options: dict[str, Any]) -> Any:
    """Return the group built from its options, which are removed from `options`."""
    hints = get_type_hints(group, include_extras=True)
    values: dict[str, Any] = {}
    for field in fields(group):
        if is_dataclass(hints[field.name]):
            values[field.name] = _build(hints[field.name], options)
        elif field.name in options:
            values[field.name] = options.pop(field.name)
    return group(**values)
