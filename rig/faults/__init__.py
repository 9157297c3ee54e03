"""Faults of channels, and where they make sense."""

from __future__ import annotations

from rig.channels import ChannelTable
from rig.errors import InputError, UnknownNameError
from rig.faults.kind import At, Draws, Kind
from rig.faults.kinds import KINDS, AnyKind, NoFilter, Swap

__all__ = ["KINDS", "AnyKind", "At", "Draws", "Kind", "NoFilter", "Swap", "channels_of", "described"]


def channels_of(what: Kind, target: str, table: ChannelTable, *, ideal: bool, noisy: bool) -> tuple[str, ...]:
    """Channels that a fault changes.

    Args:
        what: The fault.
        target: A channel, or a group for all of its channels.
        table: The channels that there are.
        ideal: Whether the scene leaves filters and noise out.
        noisy: Whether its sensors are noisy.

    Raises:
        InputError: There is no such channel, or the fault makes no sense on it; the message says what would.
    """
    known = table.channels
    if target not in {*known, *table.groups}:
        raise UnknownNameError(
            "fault.channel", "one of the channels, or of their groups", target, [*known, *table.groups]
        )
    names = table.groups[target].names if target in table.groups else (target,)
    for other in what.reads:
        if other not in known or other in names:
            raise UnknownNameError(
                f"fault.{what.name()}", "with another channel", other, [n for n in known if n not in names]
            )
    if what.channel_only:
        marks = [name for name, channel in known.items() if channel.signal == what.channel_only]
        if not set(names) & set(marks):
            must = f"{' or '.join(marks) or 'a keyphasor'} for {what.name()}, which is about its pulses"
            raise InputError("fault.channel", must, target)
        names = tuple(name for name in names if name in marks)
    names = what.on(names)
    if isinstance(what, Swap) and len(names) != 2:
        raise InputError("fault.channel", "one channel for swap", target)
    for name in names:
        what.refuse(known[name], ideal=ideal, noisy=noisy)
    return names


def described() -> list[tuple[str, str, str, str, str]]:
    """Of each kind its name, stage, equation, numbers with defaults, and the channels that it is for."""
    found = []
    for name, kind in KINDS.items():
        numbers = [
            key + ("" if field.is_required() else " (none)" if field.default is None else f" ({field.default:g})")
            for key, field in kind.model_fields.items()
            if key != "kind"
        ]
        doc = " ".join((kind.__doc__ or "").split())
        found.append((name, kind.stage, doc, ", ".join(numbers) or "none", kind.channel_only or "any"))
    return found
