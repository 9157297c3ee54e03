"""`rig keys`: keys, messages and units; `rig keys init`: who may connect to a rig that is exposed."""

from __future__ import annotations

import json
import re
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.options import Force
from rig.cli.output.tables import Form, Table, echo, echo_document, echo_json, new_table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.text import Text


def keys(
    context: typer.Context,
    *,
    markdown: Annotated[bool, typer.Option("--markdown", help="As the Markdown source of rig/KEYS.md.")] = False,
    form: Form,
) -> None:
    """Show every key, message and unit of the rig's streams, and who may use them; or make certificates (`init`)."""
    if context.invoked_subcommand is not None:
        return
    from rig.serve.interface import page

    if markdown:
        echo_document(page())
        return
    if form.as_json:
        echo_json(_document(page()))
        return
    console = form.console()
    for part in _parts(page()):
        console.print(part)


def _parts(page: str) -> Iterator[Table | Text | str]:
    """What stands on a page of Markdown: its tables, its headings, and every other line, such as code, as it is."""
    from rich.text import Text

    pieces = [piece.splitlines() for piece in re.split(r"^```.*\n", page, flags=re.MULTILINE)]
    marked = [(number % 2 or line[:1], line) for number, piece in enumerate(pieces) for line in piece]
    for kind, group in groupby(marked, key=lambda pair: pair[0]):
        lines = [line for _, line in group]
        if kind == "|":
            bare = (line.replace("`", "").strip("|").split("|") for line in lines)
            headings, _, *rows = ([cell.strip() for cell in cells] for cells in bare)
            table = new_table("", *headings, wrapped=("what", "fields", "keys"), keys=1 + (headings[0] == "column"))
            for row in rows:
                table.add_row(*row)
            yield table
        elif kind == "#":
            yield from (Text(line.lstrip("# "), "bold") for line in lines)
        else:
            yield from lines


def _document(page: str) -> dict[str, list[dict[str, Any]]]:
    """The rows of a page's tables, each by its headings, under what they are of."""
    found, title = {}, ""
    for part in _parts(page):
        if isinstance(part, Table):
            columns = [_values([cells[at].plain for cells, _ in part.rows]) for at in range(len(part.headings))]
            found[title] = [dict(zip(part.headings, row, strict=True)) for row in zip(*columns, strict=True)]
        elif not isinstance(part, str):
            title = part.plain.replace("`", "").partition(":")[0]
    return found


def _values(texts: list[str]) -> list[Any]:
    """A column, as numbers where all of it is."""
    try:
        return [json.loads(text) for text in texts]
    except ValueError:
        return list(texts)


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="New folder.")],
    *,
    host: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST", help="Name or address by which others reach the rig's computer; may be repeated."),
    ] = None,
    days: Annotated[int, typer.Option(min=1, max=3650, help="How long the certificates are valid.")] = 365,
    truth: Annotated[
        list[str] | None, typer.Option(metavar="ROLE", help="A role that may read the truth too; may be repeated.")
    ] = None,
    force: Force = False,
) -> None:
    """Make the certificates of a rig that is exposed: its own, and one for each role.

    The roles are operator, recorder and viewer; `rig keys` shows what each may do.
    """
    from rig.serve.transport import EXPOSED_PORT
    from rig.serve.transport.exposure.access import ROLES
    from rig.serve.transport.exposure.certificates import SERVER, make

    names = make(folder, hosts=host or [], days=days, truth=truth or [], force=force)
    echo(f"{folder / SERVER}: stays on this computer, {', '.join(names)}:")
    echo(f"    rig run SCENE --expose {names[0]} --tls {folder}")
    for role in ROLES:
        granted = ", who may read the truth" if role in (truth or []) else ""
        echo(f"{folder / role}: for the role {role}{granted}; copy it to where it is used:")
        echo(f"    rig status --connect {names[0]}:{EXPOSED_PORT} --tls {role}")
    if not host:
        echo("Without --host they hold on this computer only.")
    echo(f"Valid for {days} days. Whoever has a folder has its role: copy it by a safe way, such as scp -r.")
    echo("The key that signed them is not kept: to add or withdraw one, make all anew (--force).")
