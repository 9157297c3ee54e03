"""Frames of devices under test in lockstep: end of a block, join, done, leave, and the resulting state.

A node number represents the name: the rig calls device 7 of a bus "CAN 7".
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from drivers.can.message import KEY, CanMessage, CanSignal, checksum
from rig.base.errors import InputError

_DEVICE_NAME = re.compile(r"CAN (\d{1,3})")
_WORD_32 = 0xFFFFFFFF
_PATIENCE_STEP_S = 0.1


class DeviceKind(IntEnum):
    """Kind of a device's frame; any two differ in at least four bits."""

    JOIN = 0x0F
    DONE = 0xF0
    LEAVE = 0x33


class DeviceState(IntEnum):
    """State of a device for the rig."""

    JOINED = 1
    LEFT = 2
    LOST = 3
    REFUSED = 4


@dataclass(frozen=True, slots=True)
class DeviceRequest:
    """Content of a device's frame.

    Attributes:
        kind: Join, done or leave.
        node: Number of the device, 0 to 255.
        values: Fields of the rig's command of that name.
    """

    kind: DeviceKind
    node: int
    values: Mapping[str, Any]

    @property
    def counter(self) -> int:
        """Counter for the Acknowledge of an unreadable frame: the byte that holds a command's counter."""
        return self.node


def device_messages(rig: str, controller: str, time: str) -> list[CanMessage]:
    """Return the messages, with the names of the two sending nodes and the label of a time."""
    join, done, leave = ((int(kind),) for kind in DeviceKind)
    node = CanSignal("node", 8, 8, label="Number of the device, unique on the bus")
    return [
        CanMessage(
            "Device", 0x023, 8, False, math.inf, False, controller,
            "From a device under test to a rig in lockstep: a block waits until all joined devices have finished the "
            "previous one. Without counter, may be repeated; DeviceState replies to join and leave",
            (
                CanSignal(
                    "kind", 0, 8, label="Kind of message", selects=True,
                    choices={member.value: member.name.lower() for member in DeviceKind},
                ),
                node,
                CanSignal(
                    "patience", 16, 16, scale=_PATIENCE_STEP_S, unit="s", selected_by=join,
                    label="Longest wait of the rig for the device, wall time; 0: 10 s",
                ),
                CanSignal("reserved_join", 32, 16, label="Always 0", selected_by=join),
                CanSignal("block", 16, 32, label="Number of the block that the device has finished", selected_by=done),
                CanSignal("reserved", 16, 32, label="Always 0", selected_by=leave),
                CanSignal("key", 48, 8, label=f"Always {KEY:#x}"),
                CanSignal(
                    "checksum", 56, 8,
                    label="CRC-8 (SAE J1850) over identifier, low byte first, and the other seven bytes",
                ),
            ),
        ),
        CanMessage(
            "DeviceState", 0x024, 8, False, math.inf, False, rig,
            "Start or end of the rig's waiting for a device; lost: not finished in time, or another block",
            (
                CanSignal("node", 0, 8, label="Number of the device"),
                CanSignal(
                    "state", 8, 8, label="State of the device",
                    choices={member.value: member.name.lower() for member in DeviceState},
                ),
                CanSignal("reserved", 16, 16, label="Always 0"),
                CanSignal("time", 32, 32, unit="us", label=f"Time of the change. {time}"),
            ),
        ),
        CanMessage(
            "Block", 0x320, 8, False, math.inf, False, rig,
            "In lockstep with joined devices: end of a block, sent after all its frames. A command that "
            "was acknowledged before the last device is done takes effect at its end",
            (
                CanSignal("block", 0, 32, label="Number of the block in this run, from 1"),
                CanSignal("time", 32, 32, unit="us", label=f"End of the block. {time}"),
            ),
        ),
    ]  # fmt: skip


def device_frame(
    message: CanMessage, kind: DeviceKind, node: int, *, block: int = 0, patience_s: float = 0.0
) -> tuple[int, bytes]:
    """Encode a device's frame; return its identifier and data.

    Args:
        message: The message `Device` of a table.
        kind: Join, done or leave.
        node: Number of the device, 0 to 255.
        block: Number of the block that the device has finished.
        patience_s: When it joins, how long the rig waits for it, in steps of 0.1 [s]; 0 for 10 s.

    Raises:
        InputError: A value does not fit.
    """
    raw: dict[str, int] = {}
    if kind is DeviceKind.JOIN:
        raw["patience"] = round(patience_s / _PATIENCE_STEP_S)
    if kind is DeviceKind.DONE:
        raw["block"] = block & _WORD_32
    try:
        data = message.encode(kind=int(kind), node=node, key=KEY, **raw)
    except ValueError as error:
        raise InputError("device", "one with a node from 0 to 255 and a patience up to 6553.5 s", str(error)) from None
    return message.identifier, data[:7] + bytes([checksum(message.identifier, data)])


def parse_device_frame(raw: Mapping[str, int]) -> DeviceRequest | None:
    """Decode a device's frame with valid length, key and checksum; return None if its content is invalid."""
    try:
        kind = DeviceKind(raw["kind"])
    except ValueError:
        return None
    if raw.get("reserved", 0) or raw.get("reserved_join", 0):
        return None
    values: dict[str, Any] = {"device": device_name(raw["node"])}
    if kind is DeviceKind.JOIN and raw["patience"]:
        values["patience_s"] = round(raw["patience"] * _PATIENCE_STEP_S, 6)
    if kind is DeviceKind.DONE:
        values["block"] = raw["block"]
    return DeviceRequest(kind, raw["node"], values)


def device_name(node: int) -> str:
    """Return the rig's name for a device on a bus."""
    return f"CAN {node}"


def device_node(name: object) -> int | None:
    """Return the number of a device on a bus from its name; None for another device."""
    match = _DEVICE_NAME.fullmatch(str(name))
    return int(match[1]) if match and int(match[1]) < 256 else None
