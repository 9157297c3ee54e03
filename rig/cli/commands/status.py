"""`rig status`: the state of a running rig."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.connections.connection import Connection
from rig.cli.output.display import accuracy_text, engine_text, motion_text, number_text
from rig.cli.output.tables import Form, Table, echo_json, fact_table, make_printable, new_table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from drivers.console import Console


def status(
    *,
    watch: Annotated[bool, typer.Option("--watch", help="Repeat every 0.5 s, until Ctrl-C or the end")] = False,
    listed: Annotated[bool, typer.Option("--list", help="List the running rigs that have a name (--name)")] = False,
    form: Form,
    connection: Connection,
) -> None:
    """Show the time, pace, lateness and losses of a running rig, its clients and its warnings."""
    if listed:
        _list(form)
        return
    with connection.console("status") as rig:
        if watch:
            try:
                _watch(rig, form)
            except KeyboardInterrupt:
                return
        elif form.as_json:
            echo_json(_ask(rig))
        else:
            form.console().print(status_table(_ask(rig)))


def _list(form: Form) -> None:
    from rig.serve.transport.names import list_running

    rigs = [entry.model_dump() for entry in list_running()]
    if form.as_json:
        echo_json(rigs)
        return
    table = new_table("rigs by name", "name", "listens on", "process")
    for entry in rigs:
        table.add_row(entry["name"], entry["endpoint"], str(entry["pid"]))
    form.console().print(table)


def _watch(rig: Console, form: Form) -> None:
    from rich.live import Live

    if form.as_json:
        for document in _documents(rig):
            echo_json(document, indent=None)
        return
    console = form.console()
    if not console.is_terminal:
        for document in _documents(rig):
            console.print(status_table(document))
        return
    with Live(console=console, auto_refresh=False) as live:
        for document in _documents(rig):
            live.update(status_table(document), refresh=True)


def _documents(rig: Console) -> Iterator[dict[str, Any]]:
    """Yield the status twice a second until the rig has ended."""
    import time

    from rig.serve.transport import NoReplyError

    document = _ask(rig)
    while True:
        yield document
        if document["state"] != "running":
            return
        time.sleep(0.5)
        try:
            document = _ask(rig)
        except NoReplyError:
            # The run ended before the next request.
            return


def _ask(rig: Console) -> dict[str, Any]:
    return {**rig.status(), "connection": rig.connection}


def status_table(document: dict[str, Any]) -> Table:
    """Return a status document as a table of two columns."""
    document = make_printable(document)
    late, queue, energy = document["lateness_ms"], document["queue"], document["energy"]
    rows: list[tuple[str, str]] = []
    end = "" if document["end_s"] is None else f" of {document['end_s']:g} s"
    rows.append(("simulated time", f"{document['time_s']:.3f} s{end} (tick {document['tick']})"))
    if (play := document.get("replay")) is not None:
        rate = "burst" if play["rate"] is None else f"x{play['rate']:g}"
        if play["waiting_for"]:
            rate += f", waiting for clients ({len(document['clients'])} of {play['waiting_for']})"
        elif play["paused"]:
            rate += ", paused"
        passes = "endless" if play["passes"] is None else play["passes"]
        rows.append(("replay of", ", ".join(play["files"])))
        rows.append(("replayed", f"{play['from_s']:g} to {play['to_s']:g} s, {rate}, pass {play['pass']} of {passes}"))
    rows.append(("pace", f"{document['pace']}, blocks of {document['block_ms']:g} ms"))
    rows.append(("real-time factor" if play is None else "achieved rate", f"{document['real_time_factor']:.6f}"))
    figures = ", ".join(f"{name} {late[name]:.3f}" for name in ("p50", "p99", "max", "last"))
    rows.append(("lateness", f"{figures} ms"))
    rows.append(("overruns", str(document["overruns"])))
    if play is None:
        text = f"{queue['depth']} of {queue['capacity']}, at most {queue['high_water']}, dropped {queue['dropped']}"
        rows.append(("queue", text))
    else:
        rows.append(("read ahead", f"{queue['depth']} instants"))
    rows.append(("spin", number_text(document["spin_hz"], "Hz")))
    if motion := document.get("motion"):
        rows.append(("motion", motion_text(motion)))
    if energy:  # test signals and recordings have none
        residual, dissipated = number_text(energy.get("residual_j"), "J"), number_text(energy.get("dissipated_j"), "J")
        rows.append(("energy", f"residual {residual}, dissipated {dissipated}"))
    engine, share = document.get("engine") or {}, energy.get("residual_share")
    if engine and share is not None:
        rows.append(("engine", engine_text(engine)))
        if accuracy := document.get("accuracy"):
            rows.append(("error estimate", accuracy_text(accuracy)))
        # An error measure without a reference: energy that the method gains or loses.
        alarm = energy.get("alarm_share", 1e-3)
        rows.append(("energy residual share", f"{share:.1e} of the dissipated energy (warning at {alarm:g})"))
    rows.append(("samples published", str(document["samples_published"])))
    rows.append(("commands accepted", str(document["commands"])))
    counts = document["congestion"]
    links = [f"{name} {value:g}" for name, value in counts.items() if not name.startswith("can_")]
    rows.append(("links", ", ".join(links) or "-"))
    if document.get("connection"):
        rows.append(("connection", document["connection"]))
    if "can_load" in counts:
        shares = [f"load at most {100 * counts['can_load']:.1f} %"]
        shares += [
            f"{name.removeprefix('can_').replace('_', ' ')} {value:g}"
            for name, value in counts.items()
            if name.startswith("can_") and name != "can_load"
        ]
        rows.append(("CAN", ", ".join(shares)))
    for device in document.get("devices", ()):
        reason = f": {device['reason']}" if device["reason"] else f", finished tick {device['tick']}"
        reason += f", late for {behind:.1f} s" if (behind := device["behind_s"]) else ""
        rows.append((f"device {device['name']}", f"{device['state']}{reason}"))
    for name, client in document["clients"].items():
        text = f"lag {client['lag_s']:.3f} s, last message {client['last_heard_s']:.1f} s ago, lost {client['lost']}"
        rows.append((f"client {name}", text))
    rows += [("note", text) for text in document.get("remarks", [])]
    for text in document["warnings"]:
        rows.append(("warning", text))
    return fact_table(f"rig: {document['scene']}, {document['state']}", rows, warning="yellow")
