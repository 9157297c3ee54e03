"""Faults in the four bytes of a CAN command: kind, target, and the main number with three digits."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

from drivers.can.message import CanMessage, CanSignal
from rig.base.errors import InputError, UnknownNameError
from rig.channels.faults import KINDS
from rig.channels.table import ChannelTable
from rig.run.commands.table import ClearCommand, FaultCommand

MAX_NUMBER = 2047e7
"""Largest value of `number` and `exponent`."""


class FaultKind(IntEnum):
    """Kind of a command of the message Fault; the two differ in at least four bits."""

    FAULT = FaultCommand.CAN.kind
    CLEAR = ClearCommand.CAN.kind


_FAULT, _CLEAR = (int(FaultKind.FAULT),), (int(FaultKind.CLEAR),)


def fault_signals(channels: ChannelTable) -> tuple[CanSignal, ...]:
    """Return the signals of the first six bytes, except the counter."""
    main_numbers = ", ".join(f"{name}: {kind.main()}" for name, kind in KINDS.items() if kind.main())
    return (
        CanSignal(
            "kind", 0, 8, label="Kind of command", selects=True,
            choices={member.value: member.name.lower() for member in FaultKind},
        ),
        CanSignal(
            "fault", 16, 8, label=f"Kind of fault; main numbers: {main_numbers}", selected_by=_FAULT,
            choices=dict(sorted((kind.number, name) for name, kind in KINDS.items())),
        ),
        CanSignal(
            "target", 24, 8, label="Group or channel", selected_by=_FAULT, choices=number_targets(channels)
        ),
        CanSignal(
            "number", 32, 12, signed=True, selected_by=_FAULT,
            label="Main number divided by 10^exponent; a channel by its target; 0: the default, if there is one",
        ),
        CanSignal("exponent", 44, 4, signed=True, label="Exponent of ten", selected_by=_FAULT),
        CanSignal("id", 16, 16, label="Number of the fault to end; 0: all", selected_by=_CLEAR),
        CanSignal("reserved", 32, 16, label="Always 0", selected_by=_CLEAR),
    )  # fmt: skip


def number_targets(channels: ChannelTable) -> dict[int, str]:
    """Return the channel groups and channels by their numbers on the bus, from 1."""
    return dict(enumerate([*channels.groups, *channels.channels], start=1))


def fit_number(value: float, *, field: str) -> dict[str, int]:
    """Return the raw values of `number` and `exponent` nearest to a value, with at least three digits.

    Raises:
        InputError: The value is too large for them, or not finite.
    """
    fits = (e for e in range(-8, 8) if abs(value) <= MAX_NUMBER and abs(round(value / 10.0**e)) <= 2047)
    exponent = next(fits, None)
    if exponent is None:
        raise InputError(field, "at most 2.047e10 in a CAN frame", value)
    return {"number": round(value / 10.0**exponent), "exponent": exponent}


def fault_raw(message: CanMessage, channel: str, kind: str, number: float | str | None) -> dict[str, int]:
    """Return the raw values of a request for a fault.

    Raises:
        InputError: The fault or channel does not exist, or its number does not fit.
    """
    if kind not in KINDS:
        raise UnknownNameError("fault.kind", "one of the kinds", kind, KINDS)
    targets = _targets(message)
    raw = {"kind": int(FaultKind.FAULT), "fault": KINDS[kind].number, "target": _find_target(channel, targets)}
    if number is None:
        return raw
    main = KINDS[kind].main()
    if not main:
        raise InputError("number", f"left out: {kind} has no main number", number)
    if isinstance(number, str):
        return raw | {"number": _find_target(number, targets)}
    return raw | fit_number(number, field=main)


def fault_request(message: CanMessage, raw: dict[str, int]) -> dict[str, Any] | None:
    """Convert raw values to the rig's request; None if the fault or target does not exist."""
    if raw["kind"] == FaultKind.CLEAR:
        return {"id": raw["id"] or "all"}
    targets, value = _targets(message), raw["number"]
    kind = next((each for each in KINDS.values() if each.number == raw["fault"]), None)
    if kind is None or raw["target"] not in targets:
        return None
    request: dict[str, Any] = {"channel": targets[raw["target"]], "kind": kind.name()}
    main = kind.main()
    if not main:
        return None if value or raw["exponent"] else request
    field = kind.model_fields[main]
    if field.annotation is str:
        return request | {main: targets.get(value, f"target {value}")}
    if value or field.is_required():
        number = float(f"{value}e{raw['exponent']}")
        request[main] = int(number) if number.is_integer() else number
    return request


def _targets(message: CanMessage) -> dict[int, str]:
    return dict(next(signal for signal in message.signals if signal.name == "target").choices or {})


def _find_target(name: str, targets: dict[int, str]) -> int:
    target = next((value for value, other in targets.items() if other == name), None)
    if target is None:
        raise UnknownNameError("fault.channel", "the name of a channel or channel group", name, targets.values())
    return target
