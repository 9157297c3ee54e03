"""`rig fault`: make channels of a running rig misbehave, and end that."""

from __future__ import annotations

import inspect
from typing import Annotated, Any, get_args

import typer

from rig.base.errors import InputError, UnknownNameError, Words
from rig.channels.faults import KINDS
from rig.cli.connections.connection import Connection, show
from rig.cli.groups import panel
from rig.cli.output.tables import Form, echo, echo_json, new_table

_numbers = panel("Numbers of the kinds")


def _options() -> dict[str, Any]:
    """Return an option for each number of the kinds of faults, by name."""
    blocks, found = {name for name, kind in KINDS.items() if kind.of_blocks}, dict[str, Any]()
    for field in dict.fromkeys(field for kind in KINDS.values() for field in kind.model_fields if field != "kind"):
        own = {name: kind.model_fields for name, kind in KINDS.items()}
        hints = {name: fields[field].annotation for name, fields in own.items() if field in fields}
        hint = next(iter(hints.values()))
        words = get_args(hint) if field == "door" else ()
        of = "the kinds of blocks" if hints.keys() == blocks else ", ".join(hints)
        option = _numbers(f"Of {of}.", metavar="|".join(words) or ("CHANNEL" if hint is str else "X"))
        found[field] = Annotated[str | None if words or hint is str else float | None, option]
    return found


def fault(
    channel: Annotated[
        str | None, typer.Argument(metavar="[CHANNEL|GROUP]", help="A channel, or a group for all of its channels.")
    ] = None,
    kind: Annotated[str | None, typer.Argument(metavar="[KIND]", help="What it does: see --list.")] = None,
    *,
    for_s: Annotated[float | None, typer.Option(metavar="S", help="How long, in s; until it is cleared.")] = None,
    clear: Annotated[str | None, typer.Option(metavar="ID|all", help="End a fault by its number, or all.")] = None,
    listed: Annotated[bool, typer.Option("--list", help="Show all kinds, or those that CHANNEL can have.")] = False,
    connection: Connection,
    form: Form,
    **numbers: float | str | None,
) -> None:
    """Make a channel of a running rig misbehave, or end that; the reply tells the first row that changes."""
    given = {name: _plain(value) for name, value in numbers.items() if value is not None}
    if listed:
        _show_kinds(channel, form)
        return
    if (clear is None) == (channel is None):
        raise InputError("arguments", "CHANNEL and KIND, or --clear, or --list", Words("both" if clear else "none"))
    if clear is not None:
        with connection.console("fault") as rig:
            show(rig.clear(int(clear) if clear.isdecimal() else clear), "clear")
        return
    if kind not in KINDS:
        raise UnknownNameError("KIND", "one of `rig fault --list`", kind or "nothing", KINDS)
    with connection.console("fault") as rig:
        accepted = rig.fault(str(channel), kind, for_s=for_s, **given)
    show(accepted, "fault")
    rows = ", ".join(f"row {row} of {group}" for group, row in accepted.first_row.items())
    echo(
        f"fault {accepted.fault} of {', '.join(accepted.channels)}, from {rows} on; rig fault --clear {accepted.fault}"
    )


_own, _given = inspect.signature(fault), _options()
fault.__annotations__ |= _given
fault.__signature__ = _own.replace(  # type: ignore[attr-defined]
    parameters=[
        *list(_own.parameters.values())[:-1],
        *(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None) for name in _given),
    ]
)


def _plain(value: Any) -> Any:
    """Whole numbers are whole: bits are."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _show_kinds(channel: str | None, form: Form) -> None:
    from rig.channels.faults import described, supported
    from rig.run.scenes import rig_table

    table = rig_table()
    rows = described(table)
    if channel is not None:
        known = [*table.channels, *table.groups]
        if channel not in known:
            raise UnknownNameError("CHANNEL", "one of the channels, or of their groups", channel, known)
        names = {channel, *(table.groups[channel].names if channel in table.groups else ())}
        rows = [row for row in rows if any(supported(KINDS[row[0]], table).get(name) == "" for name in names)]
    headings = ("kind", "stage", "what it does", "numbers", "on", "at")
    if form.as_json:
        echo_json([dict(zip(headings, row, strict=True)) for row in rows])
        return
    table_shown = new_table("", *headings, wrapped=("what it does", "numbers"), spare=("at", "on", "stage"))
    for row in rows:
        table_shown.add_row(*row)
    form.console().print(table_shown)
