"""`rig keys`: keys, messages and units; `rig keys init`: certificates of an exposed rig."""

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
    markdown: Annotated[bool, typer.Option("--markdown", help="Print the Markdown source of rig/KEYS.md")] = False,
    form: Form,
) -> None:
    """Show every key, message and unit of the rig's streams, and the roles that may use them (`init`: certificates)."""
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
    """Yield the parts of a Markdown page: its tables, its headings, and all other lines unchanged."""
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
    """Return the rows of the page's tables by table title; a row maps headings to cells."""
    rows_by_title, title = {}, ""
    for part in _parts(page):
        if isinstance(part, Table):
            columns = [_values([cells[at].plain for cells, _ in part.rows]) for at in range(len(part.headings))]
            rows_by_title[title] = [dict(zip(part.headings, row, strict=True)) for row in zip(*columns, strict=True)]
        elif not isinstance(part, str):
            title = part.plain.replace("`", "").partition(":")[0]
    return rows_by_title


def _values(texts: list[str]) -> list[Any]:
    """Return a column, as numbers if all its cells are numbers."""
    try:
        return [json.loads(text) for text in texts]
    except ValueError:
        return list(texts)


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="New folder")],
    *,
    host: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST", help="Name or address of the rig's computer; repeatable"),
    ] = None,
    days: Annotated[int, typer.Option(min=1, max=3650, help="Validity of the certificates in days")] = 365,
    truth: Annotated[
        list[str] | None, typer.Option(metavar="ROLE", help="Role that may also read the truth; repeatable")
    ] = None,
    keep_authority: Annotated[
        bool, typer.Option("--keep-authority", help="Keep the signing key, for `rig keys add`")
    ] = False,
    force: Force = False,
) -> None:
    """Create the certificates for an exposed rig: its own, and one for each role.

    The roles are operator, recorder and viewer; `rig keys` lists the permissions of each.
    """
    from rig.serve.transport import EXPOSED_PORT
    from rig.serve.transport.exposure.access import ROLES
    from rig.serve.transport.exposure.certificates import AUTHORITY, SERVER, create_keys

    names = create_keys(
        folder, hosts=host or [], days=days, truth=truth or [], keep_authority=keep_authority, force=force
    )
    echo(f"{folder / SERVER}: stays on this computer, {', '.join(names)}:")
    echo(f"    rig run SCENE --expose {names[0]} --tls {folder}")
    for role in ROLES:
        granted = ", with access to the truth" if role in (truth or []) else ""
        echo(f"{folder / role}: for the role {role}{granted}; copy it to the client's computer:")
        echo(f"    rig status --connect {names[0]}:{EXPOSED_PORT} --tls {role}")
    if not host:
        echo("Without --host the certificates are valid on this computer only.")
    echo(f"Valid for {days} days. A folder grants its role: copy it securely, for example with scp -r.")
    if keep_authority:
        echo(f"{folder / AUTHORITY}: the signing key, for `rig keys add`. Who reads it can admit anybody.")
    else:
        echo("The signing key is not kept: to add a certificate, create all again (--keep-authority, --force).")


def add(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder made with --keep-authority")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the device")],
    *,
    role: Annotated[str, typer.Option(metavar="ROLE", help="operator, recorder or viewer")] = "recorder",
    truth: Annotated[bool, typer.Option("--truth", help="It may also read the truth")] = False,
    days: Annotated[int, typer.Option(min=1, max=3650, help="Validity of the certificate in days")] = 365,
) -> None:
    """Add the certificate of one device, which is bound to its name.

    Its commands and reports carry this name, whatever name the device gives itself.
    """
    from rig.serve.transport.exposure.certificates import add_device

    expires = add_device(folder, name, role, truth=truth, days=days)
    echo(f"{folder / name}: for the device {name}, role {role}, until {expires:%Y-%m-%d}; copy it to its computer")
    echo("A running rig admits it after a restart.")


def remove(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder made by `rig keys init`")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a device or role")],
) -> None:
    """Withdraw the certificate of a device or a role."""
    from rig.serve.transport.exposure.certificates import remove_holder

    remove_holder(folder, name)
    echo(f"{name}: withdrawn, and {folder / name} removed. A running rig still admits it until a restart.")
