"""Faults of channels and of blocks, and the checks of where each kind can be injected."""

from __future__ import annotations

from rig.base.errors import InputError, UnknownNameError
from rig.channels.faults.blocks import TRANSPORTS, BlockFault, Message, Restart
from rig.channels.faults.effect import check_draws, check_size, check_time
from rig.channels.faults.kind import At, Draws, Kind, Setting, acts
from rig.channels.faults.kinds import KINDS, AnyKind, NoFilter, Swap, connect_swaps
from rig.channels.table import ChannelTable

__all__ = [
    "KINDS", "TRANSPORTS", "AnyKind", "At", "BlockFault", "Draws", "Kind", "Message", "NoFilter", "Restart", "Setting",
    "Swap", "acts", "check_draws", "check_size", "check_time", "connect_swaps", "describe_kinds",
    "find_channels", "find_group", "list_refusals",
]  # fmt: skip


def list_refusals(kind: type[Kind], table: ChannelTable, setting: Setting = Setting()) -> dict[str, str]:  # noqa: B008
    """Return where a kind of fault can be injected, whatever its numbers.

    Args:
        kind: The kind.
        table: Channel table.
        setting: Properties of the scene.

    Returns:
        By channel, or by group for a kind that acts on blocks: what is required instead; empty if the kind is
        supported.
    """
    if kind.of_blocks:
        return dict.fromkeys(table.groups, "")
    wanted = kind.channel_only
    marks = [name for name, channel in table.channels.items() if channel.signal == wanted]
    away = f"{' or '.join(marks) or 'a keyphasor'} for {kind.name()}, which acts on its pulses"
    return {
        name: kind.needs(channel, setting) or (away if wanted and name not in marks else "")
        for name, channel in table.channels.items()
    }


def find_channels(
    what: Kind, target: str, table: ChannelTable, *, ideal: bool, noisy: bool, generated: bool = False
) -> tuple[str, ...]:
    """Return the channels whose counts a fault changes; none for a fault of blocks.

    Args:
        what: The fault.
        target: A channel, or a group for all of its channels.
        table: Channel table.
        ideal: The scene has neither filters nor noise.
        noisy: The sensors have noise.
        generated: Test signals replace the physics.

    Raises:
        InputError: The channel is unknown, or the kind is not supported on it; the message names what is required.
    """
    if isinstance(what, BlockFault):
        return ()
    channels = table.channels
    if target not in {*channels, *table.groups}:
        must = "one of the channels, or of their groups"
        raise UnknownNameError("fault.channel", must, target, [*channels, *table.groups])
    names = table.groups[target].names if target in table.groups else (target,)
    for other in what.reads:
        if other not in channels or other in names:
            raise UnknownNameError(
                f"fault.{what.name()}", "with another channel", other, [n for n in channels if n not in names]
            )
    refused = list_refusals(type(what), table, Setting(ideal, noisy, generated))
    if what.channel_only:
        names = tuple(name for name in names if not refused[name]) or names[:1]
    names = what.on(names)
    if isinstance(what, Swap) and len(names) != 2:
        raise InputError("fault.channel", "one channel for swap", target)
    for name in names:
        if must := refused[name]:
            pulses = must.endswith("pulses")
            raise InputError("fault.channel" if pulses else "kind", must, target if pulses else what.name())
        what.refuse(channels[name])
    return names


def find_group(what: BlockFault, target: str, table: ChannelTable, buses: tuple[str, ...]) -> str:
    """Return the group whose blocks a fault changes.

    Args:
        what: The fault.
        target: A group.
        table: Channel table.
        buses: Transports of the rig by which blocks are sent.

    Raises:
        InputError: The group or the transport is unknown; the message lists the known ones.
    """
    refusals = list_refusals(type(what), table)
    if target in table.channels and target not in refusals:
        must = f"a group for {what.name()}, as a block has all its channels, such as {table.channels[target].group}"
        raise InputError("fault.channel", must, target)
    if target not in refusals:
        raise UnknownNameError("fault.channel", f"one of the groups for {what.name()}", target, refusals)
    if not set(what.transports) & set(buses):
        raise InputError("door", f"one that this rig has: {', '.join(buses)} (a CAN bus: rig run --can)", what.door)
    if must := what.needs_at(what.door, target, tuple(refusals)):
        raise InputError("fault.channel", must, target)
    return target


def describe_kinds(table: ChannelTable, setting: Setting = Setting()) -> list[tuple[str, ...]]:  # noqa: B008
    """Return each kind's name, stage, equation, numbers with defaults, supported channels or groups, and transports.

    Args:
        table: Channel table.
        setting: Properties of the scene.
    """
    rows: list[tuple[str, ...]] = []
    for name, kind in KINDS.items():
        numbers = [
            key + ("" if field.is_required() else f" ({'none' if field.default is None else _text(field.default)})")
            for key, field in kind.model_fields.items()
            if key != "kind"
        ]
        places = list_refusals(kind, table, setting)
        on = [place for place, must in places.items() if not must]
        many = "groups" if kind.of_blocks else "channels"
        where = f"all {len(on)} {many}" if len(on) == len(places) else ", ".join(on) or "none"
        doc = " ".join((kind.__doc__ or "").split())
        transports = ", ".join(TRANSPORTS)
        if issubclass(kind, BlockFault):
            groups = tuple(table.groups)
            some = {door: [one for one in groups if not kind.needs_at(door, one, groups)] for door in TRANSPORTS}
            transports += ", or one" + "".join(
                f" ({door} alone: {', '.join(there)})" for door, there in some.items() if len(there) < len(groups)
            )
        rows.append((name, kind.stage, doc, ", ".join(numbers) or "none", where, transports))
    return rows


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
