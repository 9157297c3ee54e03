"""Devices under test in lockstep, in frames: a block is over, a device joins, is done, leaves, and what becomes of it.

A node number stands for a name: the rig knows the device 7 of a bus as "CAN 7".
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from drivers.can.message import KEY, Message, Signal, checksum
from rig.base.errors import InputError

_NAME = re.compile(r"CAN (\d{1,3})")
_WORD_32 = 0xFFFFFFFF
_PATIENCE_STEP_S = 0.1


class DeviceKind(IntEnum):
    """What a device says; any two differ in at least four bits."""

    JOIN = 0x0F
    DONE = 0xF0
    LEAVE = 0x33


class Standing(IntEnum):
    """How the rig holds with a device."""

    JOINED = 1
    LEFT = 2
    LOST = 3
    REFUSED = 4


@dataclass(frozen=True, slots=True)
class Said:
    """What a device said.

    Attributes:
        kind: What.
        node: Its number, 0 to 255; what answers are told to.
        values: Fields of the rig's command of that name.
    """

    kind: DeviceKind
    node: int
    values: Mapping[str, Any]

    @property
    def counter(self) -> int:
        """What an Acknowledge of a frame that could not be read names: where a command has its counter."""
        return self.node


def device_messages(rig: str, controller: str, time: str) -> list[Message]:
    """The messages, given the names of both senders and what a time is."""
    join, done, leave = ((int(kind),) for kind in DeviceKind)
    node = Signal("node", 8, 8, label="The device; any number that no other device on the bus has")
    return [
        Message(
            "Device", 0x023, 8, False, math.inf, False, controller,
            "A device under test, to a rig in lockstep: no block is run before all that have joined are done with the "
            "one before. Not counted, and harmless to repeat; DeviceState answers join and leave",
            (
                Signal(
                    "kind", 0, 8, label="What it says", selects=True,
                    choices={member.value: member.name.lower() for member in DeviceKind},
                ),
                node,
                Signal(
                    "patience", 16, 16, scale=_PATIENCE_STEP_S, unit="s", selected_by=join,
                    label="How long the rig waits for it, wall time; 0: 10 s",
                ),
                Signal("reserved_join", 32, 16, label="Always 0", selected_by=join),
                Signal("block", 16, 32, label="Number of the block that it is done with", selected_by=done),
                Signal("reserved", 16, 32, label="Always 0", selected_by=leave),
                Signal("key", 48, 8, label=f"Always {KEY:#x}"),
                Signal(
                    "checksum", 56, 8,
                    label="CRC-8 (SAE J1850) over identifier, low byte first, and the other seven bytes",
                ),
            ),
        ),
        Message(
            "DeviceState", 0x024, 8, False, math.inf, False, rig,
            "The rig waits for a device from now on, or no longer; lost: not done in time, or with another block",
            (
                Signal("node", 0, 8, label="The device"),
                Signal(
                    "state", 8, 8, label="How the rig holds with it",
                    choices={member.value: member.name.lower() for member in Standing},
                ),
                Signal("reserved", 16, 16, label="Always 0"),
                Signal("time", 32, 32, unit="us", label=f"Since when. {time}"),
            ),
        ),
        Message(
            "Block", 0x320, 8, False, math.inf, False, rig,
            "In lockstep, while a device has joined: a block is over, and all frames of it went before. A command that "
            "was acknowledged before the last device is done takes effect at its end",
            (
                Signal("block", 0, 32, label="Its number in this run, from 1 on"),
                Signal("time", 32, 32, unit="us", label=f"Its end. {time}"),
            ),
        ),
    ]  # fmt: skip


def device_frame(
    message: Message, kind: DeviceKind, node: int, *, block: int = 0, patience_s: float = 0.0
) -> tuple[int, bytes]:
    """Identifier and data of what a device says.

    Args:
        message: `Device` of a table.
        kind: What.
        node: Its number, 0 to 255.
        block: The block that it is done with.
        patience_s: How long the rig waits when it joins, to 0.1 [s]; 0 is 10 s.

    Raises:
        InputError: A value finds no room.
    """
    raw: dict[str, int] = {}
    if kind is DeviceKind.JOIN:
        raw["patience"] = round(patience_s / _PATIENCE_STEP_S)
    if kind is DeviceKind.DONE:
        raw["block"] = block & _WORD_32
    try:
        data = message.encode(kind=int(kind), node=node, key=KEY, **raw)
    except ValueError as error:
        raise InputError("device", "of a node from 0 to 255 and a patience up to 6553.5 s", str(error)) from None
    return message.identifier, data[:7] + bytes([checksum(message.identifier, data)])


def said_in(raw: Mapping[str, int]) -> Said | None:
    """What a device said, of a frame whose length, key and checksum are right; None where it is nothing."""
    try:
        kind = DeviceKind(raw["kind"])
    except ValueError:
        return None
    if raw.get("reserved", 0) or raw.get("reserved_join", 0):
        return None
    values: dict[str, Any] = {"device": name_of(raw["node"])}
    if kind is DeviceKind.JOIN and raw["patience"]:
        values["patience_s"] = round(raw["patience"] * _PATIENCE_STEP_S, 6)
    if kind is DeviceKind.DONE:
        values["block"] = raw["block"]
    return Said(kind, raw["node"], values)


def name_of(node: int) -> str:
    """What the rig calls a device of a bus."""
    return f"CAN {node}"


def node_of(name: object) -> int | None:
    """Number of the device that the rig calls so; None of one that is not on a bus."""
    match = _NAME.fullmatch(str(name))
    return int(match[1]) if match and int(match[1]) < 256 else None
