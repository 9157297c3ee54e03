"""`rig status`: how a running rig is doing."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.connection import Connection
from rig.cli.tables import echo, shown, table_console

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.table import Table

    from drivers.console import Console


def status(
    *,
    as_json: Annotated[bool, typer.Option("--json", help="The whole status document, as JSON.")] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Again twice a second, until Ctrl-C or the end.")] = False,
    connection: Connection,
) -> None:
    """Show time, pace, lateness, losses, clients and doubts of a running rig."""
    with connection.console("status") as rig:
        if not watch:
            document = _ask(rig)
            if as_json:
                echo(json.dumps(document, indent=2))
            else:
                _print(document)
            return
        try:
            _watch(rig, as_json)
        except KeyboardInterrupt:
            return


def _watch(rig: Console, as_json: bool) -> None:
    from rich.live import Live

    if as_json:
        for document in _documents(rig):
            echo(json.dumps(document))
        return
    with Live(console=table_console(), auto_refresh=False) as live:
        for document in _documents(rig):
            live.update(status_table(document), refresh=True)


def _documents(rig: Console) -> Iterator[dict[str, Any]]:
    """The status twice a second until the rig has ended."""
    import time

    from rig.transport import NoReplyError

    document = _ask(rig)
    while True:
        yield document
        if document["state"] != "running":
            return
        time.sleep(0.5)
        try:
            document = _ask(rig)
        except NoReplyError:
            # It ended, and was gone before it could be asked again.
            return


def _ask(rig: Console) -> dict[str, Any]:
    return {**rig.status(), "connection": rig.connection}


def _print(document: dict[str, Any]) -> None:
    table_console(width=80).print(status_table(document))


def status_table(document: dict[str, Any]) -> Table:
    """A status document as a table of two columns."""
    from rich.table import Table

    document = shown(document)
    late, queue, energy = document["lateness_ms"], document["queue"], document["energy"]
    table = Table(title=f"rig: {document['scene']}, {document['state']}", show_header=False, title_justify="left")
    end = "" if document["end_s"] is None else f" of {document['end_s']:g} s"
    table.add_row("simulated time", f"{document['time_s']:.3f} s{end} (tick {document['tick']})")
    if (play := document.get("replay")) is not None:
        rate = "burst" if play["rate"] is None else f"x{play['rate']:g}"
        if play["waiting_for"]:
            rate += f", waiting for clients ({len(document['clients'])} of {play['waiting_for']})"
        elif play["paused"]:
            rate += ", paused"
        passes = "endless" if play["passes"] is None else play["passes"]
        table.add_row("replay of", ", ".join(play["files"]))
        table.add_row("", f"{play['from_s']:g} to {play['to_s']:g} s, {rate}, pass {play['pass']} of {passes}")
    table.add_row("pace", f"{document['pace']}, blocks of {document['block_ms']:g} ms")
    table.add_row("real-time factor" if play is None else "achieved rate", f"{document['real_time_factor']:.6f}")
    table.add_row(
        "lateness", f"p50 {late['p50']:.3f}, p99 {late['p99']:.3f}, max {late['max']:.3f}, last {late['last']:.3f} ms"
    )
    table.add_row("overruns", str(document["overruns"]))
    if play is None:
        text = f"{queue['depth']} of {queue['capacity']}, at most {queue['high_water']}, dropped {queue['dropped']}"
        table.add_row("queue", text)
    else:
        table.add_row("read ahead", f"{queue['depth']} instants")
    table.add_row("spin", _figure(document["spin_hz"], "Hz"))
    residual, dissipated = _figure(energy.get("residual_j"), "J"), _figure(energy.get("dissipated_j"), "J")
    table.add_row("energy", f"residual {residual}, dissipated {dissipated}")
    engine, share = document.get("engine") or {}, energy.get("residual_share")
    if engine and share is not None:
        # Reference-free: what the method makes or loses of the energy that it should account for.
        table.add_row("engine", f"{engine['name']}, {engine['step_us']} us")
        table.add_row("error estimate", f"energy residual {share:.1e} of what was dissipated (alarm at 1e-3)")
    table.add_row("samples published", str(document["samples_published"]))
    table.add_row("commands taken", str(document["commands"]))
    counts = document["congestion"]
    links = [f"{name} {value:g}" for name, value in counts.items() if not name.startswith("can_")]
    table.add_row("links", ", ".join(links) or "-")
    if document.get("connection"):
        table.add_row("connection", document["connection"])
    if "can_load" in counts:
        shares = [f"load at most {100 * counts['can_load']:.1f} %"]
        shares += [
            f"{name.removeprefix('can_').replace('_', ' ')} {value:g}"
            for name, value in counts.items()
            if name.startswith("can_") and name != "can_load"
        ]
        table.add_row("CAN", ", ".join(shares))
    for name, client in document["clients"].items():
        text = f"lag {client['lag_s']:.3f} s, heard {client['last_heard_s']:.1f} s ago, lost {client['lost']}"
        table.add_row(f"client {name}", text)
    for text in document["warnings"]:
        table.add_row("warning", text, style="yellow")
    return table


def _figure(value: float | None, unit: str) -> str:
    return "not finite" if value is None else f"{value:.4g} {unit}"
