"""`rig fault`: inject faults into channels of a running rig, and clear them."""

from __future__ import annotations

import inspect
from typing import Annotated, Any, get_args

import typer

from rig.base.errors import InputError, UnknownNameError, Words
from rig.channels.faults import KINDS, BlockFault
from rig.cli.connections.connection import Connection, show
from rig.cli.groups import panel
from rig.cli.output.tables import Form, echo, echo_json, new_table, table_console
from rig.run.commands.channel import check_fault

_LIST_WIDTH = 120
"""Width of the list of kinds in a pipe, as its texts are sentences [characters]."""
_parameters = panel("Parameters of the kinds")
_TEXTS = (
    "factor: Factor of sensitivity or noise", "ramp_s: Time to the full effect in s",
    "value: Offset in the channel's unit, or value of the bit", "rate: Drift in the channel's unit per s",
    "tau_s: Time constant in s at which the drift settles", "end: End of the linear range in the channel's unit",
    "level_v: Output of the open cable in V", "part: Fraction of time, range, turns or blocks, 0 to 1",
    "slot_s: Duration of a single contact loss in s", "amplitude_v: Amplitude of the hum in V",
    "frequency_hz: Frequency in Hz", "third: Third harmonic of the hum, 0 to 1", "offset_v: Offset of the hum in V",
    "source: Channel that couples in", "db: Coupling in dB", "other: Channel at the other cable",
    "quality: Quality factor of the resonance", "corner_hz: Corner frequency of the low-pass in Hz",
    "late_us: Delay of the samples in us", "ppm: Error of the sampling clock in ppm", "rms_us: RMS of the jitter in us",
    "amplitude_us: Amplitude of the time error in us", "period_s: Period of the time error in s",
    "rate_hz: Mean rate of the spikes in Hz", "size_v: Height of the spikes in V", "lost: Number of lost lowest bits",
    "bit: Number of the bit, 0 for the lowest", "door: Transport that is affected",
    "block_s: Length of the blocks in s", "delay_s: Delay of the blocks in s",
)  # fmt: skip
"""Help of the parameters of the kinds of faults, by field."""


def _options() -> dict[str, Any]:
    """Return the option of each parameter of the kinds of faults, by name."""
    options, texts = dict[str, Any](), {each.partition(": ")[0]: each.partition(": ")[2] for each in _TEXTS}
    for field in dict.fromkeys(field for kind in KINDS.values() for field in kind.model_fields if field != "kind"):
        own = {name: kind.model_fields[field] for name, kind in KINDS.items() if field in kind.model_fields}
        hint = next(iter(own.values())).annotation
        words = get_args(hint) if field == "door" else ()
        values = {None if each.is_required() else each.default for each in own.values()}
        default = "" if len(values) > 1 or None in values else f"; default {values.pop()}"
        kinds = "all kinds of blocks" if field in BlockFault.model_fields else ", ".join(own)
        text = f"{texts.get(field, field)} ({kinds}{default})"
        option = _parameters(text, metavar="|".join(words) or ("CHANNEL" if hint is str else "X"))
        options[field] = Annotated[str | None if words or hint is str else float | None, option]
    return options


def fault(
    channel: Annotated[
        str | None, typer.Argument(metavar="[CHANNEL|GROUP]", help="Channel, or group for all of its channels")
    ] = None,
    kind: Annotated[str | None, typer.Argument(metavar="[KIND]", help="Kind of fault; see --list")] = None,
    *,
    for_s: Annotated[float | None, typer.Option(metavar="S", help="Duration in s; default: until cleared")] = None,
    clear: Annotated[str | None, typer.Option(metavar="ID|all", help="Clear the fault of this number, or all")] = None,
    listed: Annotated[
        bool, typer.Option("--list", help="Show all kinds; with CHANNEL: its kinds; with KIND: that one")
    ] = False,
    connection: Connection,
    form: Form,
    **numbers: float | str | None,
) -> None:
    """Inject a fault into a channel of a running rig, or clear it; prints the first row that changes."""
    parameters = {name: _plain(value) for name, value in numbers.items() if value is not None}
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
    try:
        check_fault({"kind": kind, **parameters})
    except InputError as error:
        option = error.field.removeprefix(f"{kind}.").replace("_", "-")
        raise InputError(f"--{option} of {kind}", error.must, error.received) from None
    with connection.console("fault") as rig:
        accepted = rig.fault(str(channel), kind, for_s=for_s, **parameters)
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
    """Return a whole number as an int, as fields for bits require."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _show_kinds(channel: str | None, form: Form) -> None:
    from rig.channels.faults import describe_kinds, list_refusals
    from rig.run.scenes import rig_table

    table = rig_table()
    rows = describe_kinds(table)
    if channel is not None:
        targets = [*table.channels, *table.groups, *KINDS]
        if channel not in targets:
            raise UnknownNameError("CHANNEL", "a channel, a group or a kind of fault", channel, targets)
        names = {channel, *(table.groups[channel].names if channel in table.groups else ())}
        kinds = {key for key, kind in KINDS.items() if "" in map(list_refusals(kind, table).get, names)}
        rows = [row for row in rows if row[0] in {channel, *kinds}]
    headings = ("kind", "stage", "effect", "parameters", "channels", "transports")
    if form.as_json:
        words = ("kind", "stage", "what it does", "numbers", "on", "at")
        echo_json([dict(zip(words, row, strict=True)) for row in rows])
        return
    table_shown = new_table("", *headings, wrapped=("effect", "parameters"), spare=("transports", "channels", "stage"))
    for row in rows:
        table_shown.add_row(*row)
    table_console(wide=form.wide, pipe_width=_LIST_WIDTH).print(table_shown)
