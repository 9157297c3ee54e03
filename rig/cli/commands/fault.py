"""`rig fault`: make channels of a running rig misbehave, and end that."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from rig.base.errors import InputError, UnknownNameError, Words
from rig.cli.connections.connection import Connection, show
from rig.cli.groups import panel
from rig.cli.output.tables import Form, echo, echo_json, new_table

_numbers = panel("Numbers of the kinds")
_OWN = ("channel", "kind", "for_s", "clear", "listed", "connection", "form")
_SOME = "lose-blocks, duplicate-blocks, reorder-blocks"
_BLOCKS = "the kinds of blocks"


def _of(kinds: str, *, metavar: str = "X") -> Any:
    return _numbers(f"Of {kinds}.", metavar=metavar)


def fault(
    channel: Annotated[
        str | None, typer.Argument(metavar="[CHANNEL|GROUP]", help="A channel, or a group for all of its channels.")
    ] = None,
    kind: Annotated[str | None, typer.Argument(metavar="[KIND]", help="What it does: see --list.")] = None,
    *,
    for_s: Annotated[float | None, typer.Option(metavar="S", help="How long, in s; until it is cleared.")] = None,
    clear: Annotated[str | None, typer.Option(metavar="ID|all", help="End a fault by its number, or all.")] = None,
    listed: Annotated[bool, typer.Option("--list", help="Show all kinds, or those that CHANNEL can have.")] = False,
    factor: Annotated[float | None, _of("gain, noise")] = None,
    ramp_s: Annotated[float | None, _of("gain, offset")] = None,
    value: Annotated[float | None, _of("offset, stuck-bit")] = None,
    rate: Annotated[float | None, _of("drift")] = None,
    tau_s: Annotated[float | None, _of("drift")] = None,
    end: Annotated[float | None, _of("nonlinear")] = None,
    level_v: Annotated[float | None, _of("open, short, intermittent")] = None,
    part: Annotated[float | None, _of(f"intermittent, saturation, clip, miss-pulses, extra-pulses, {_SOME}")] = None,
    slot_s: Annotated[float | None, _of("intermittent")] = None,
    amplitude_v: Annotated[float | None, _of("hum")] = None,
    frequency_hz: Annotated[float | None, _of("hum, resonance")] = None,
    quality: Annotated[float | None, _of("resonance")] = None,
    third: Annotated[float | None, _of("hum")] = None,
    offset_v: Annotated[float | None, _of("hum")] = None,
    source: Annotated[str | None, _of("crosstalk", metavar="CHANNEL")] = None,
    db: Annotated[float | None, _of("crosstalk")] = None,
    other: Annotated[str | None, _of("swap", metavar="CHANNEL")] = None,
    corner_hz: Annotated[float | None, _of("bandwidth")] = None,
    late_us: Annotated[float | None, _of("late")] = None,
    ppm: Annotated[float | None, _of("clock")] = None,
    rms_us: Annotated[float | None, _of("jitter, edge-jitter")] = None,
    amplitude_us: Annotated[float | None, _of("wander")] = None,
    period_s: Annotated[float | None, _of("wander")] = None,
    rate_hz: Annotated[float | None, _of("spikes")] = None,
    size_v: Annotated[float | None, _of("spikes")] = None,
    lost: Annotated[float | None, _of("bits")] = None,
    bit: Annotated[float | None, _of("stuck-bit")] = None,
    door: Annotated[str | None, _of(_BLOCKS, metavar="zenoh|can|all")] = None,
    block_s: Annotated[float | None, _of(_BLOCKS)] = None,
    delay_s: Annotated[float | None, _of("late-blocks")] = None,
    connection: Connection,
    form: Form,
) -> None:
    """Make a channel of a running rig misbehave, or end that; the reply tells the first row that changes."""
    given = {name: _plain(value) for name, value in locals().items() if value is not None and name not in _OWN}
    if listed:
        _show_kinds(channel, form)
        return
    if (clear is None) == (channel is None):
        raise InputError("arguments", "CHANNEL and KIND, or --clear, or --list", Words("both" if clear else "none"))
    if clear is not None:
        with connection.console("fault") as rig:
            show(rig.clear(int(clear) if clear.isdecimal() else clear), "clear")
        return
    from rig.channels.faults import KINDS

    if kind not in KINDS:
        raise UnknownNameError("KIND", "one of `rig fault --list`", kind or "nothing", KINDS)
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


def _show_kinds(channel: str | None, form: Form) -> None:
    from rig.channels.faults import KINDS, described, supported
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
