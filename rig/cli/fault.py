"""`rig fault`: make channels of a running rig misbehave, and end that."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Annotated, Any

import typer

from rig.cli.connection import Connection, show
from rig.cli.groups import panel
from rig.cli.tables import echo, new_table, table_console
from rig.errors import InputError, UnknownNameError, Words
from rig.faults import KINDS

_numbers = panel("Numbers of the kinds")


def _fields() -> dict[str, list[str]]:
    """All numbers by name, with the kinds that have them."""
    found: dict[str, list[str]] = {}
    for name, kind in KINDS.items():
        for field in kind.model_fields:
            if field != "kind":
                found.setdefault(field, []).append(name)
    return found


def _with_numbers(function: Callable[..., None]) -> Callable[..., None]:
    """A command with an option for each number of a kind."""
    signature = inspect.signature(function, eval_str=True)
    own = [one for one in signature.parameters.values() if one.kind is not one.VAR_KEYWORD]
    for name, kinds in _fields().items():
        texts = any(KINDS[kind].model_fields[name].annotation is str for kind in kinds)
        option = _numbers(f"Of {', '.join(kinds)}.", f"--{name.replace('_', '-')}", metavar="CHANNEL" if texts else "X")
        kind = Annotated[str | None, option] if texts else Annotated[float | None, option]
        own.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind))
    function.__signature__ = signature.replace(parameters=own)  # pyright: ignore[reportFunctionMemberAccess]
    function.__annotations__ = {one.name: one.annotation for one in own}
    return function


@_with_numbers
def fault(
    channel: Annotated[
        str | None, typer.Argument(metavar="[CHANNEL|GROUP]", help="A channel, or a group for all of its channels.")
    ] = None,
    kind: Annotated[str | None, typer.Argument(metavar="[KIND]", help="What it does: see --list.")] = None,
    *,
    for_s: Annotated[float | None, typer.Option(metavar="S", help="How long, in s; until it is cleared.")] = None,
    clear: Annotated[str | None, typer.Option(metavar="ID|all", help="End a fault by its number, or all.")] = None,
    listed: Annotated[bool, typer.Option("--list", help="Show all kinds and their numbers.")] = False,
    connection: Connection,
    **numbers: Any,
) -> None:
    """Make a channel of a running rig misbehave, to the sample; the reply tells the first row."""
    if listed:
        _show_kinds()
        return
    if (clear is None) == (channel is None):
        raise InputError("arguments", "CHANNEL and KIND, or --clear, or --list", Words("both" if clear else "none"))
    if clear is not None:
        with connection.console("fault") as rig:
            show(rig.clear(int(clear) if clear.isdecimal() else clear), "clear")
        return
    if kind not in KINDS:
        raise UnknownNameError("KIND", "one of `rig fault --list`", kind or "nothing", KINDS)
    given = {name: _plain(value) for name, value in numbers.items() if value is not None}
    with connection.console("fault") as rig:
        accepted = rig.fault(str(channel), kind, for_s=for_s, **given)
    show(accepted, "fault")
    rows = ", ".join(f"row {row} of {group}" for group, row in accepted.first_row.items())
    echo(
        f"fault {accepted.fault} of {', '.join(accepted.channels)}, from {rows} on; rig fault --clear {accepted.fault}"
    )


def _plain(value: Any) -> Any:
    """Whole numbers are whole: bits are."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _show_kinds() -> None:
    table = new_table("", "kind", "stage", "what it does", "numbers", "on", wrapped=("what it does", "numbers"))
    for name, kind in KINDS.items():
        doc = " ".join(inspect.cleandoc(kind.__doc__ or "").split())
        numbers = []
        for field, info in kind.model_fields.items():
            if field != "kind":
                numbers.append(field if info.is_required() else f"{field} ({info.get_default()})")
        table.add_row(name, kind.stage, doc, ", ".join(numbers), kind.channel_only or "any")
    table_console().print(table)
