"""Frames of devices under test: notes, senders of commands, and in lockstep end of a block, join, done and leave.

A node number represents the name: the rig calls device 7 of a bus "CAN 7".
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from drivers.can.faults import MAX_NUMBER, fit_number
from drivers.can.message import KEY, CanMessage, CanSignal, checksum
from rig.base.errors import InputError, UnknownNameError

_DEVICE_NAME = re.compile(r"CAN (\d{1,3})")
_WORD_32 = 0xFFFFFFFF
_PATIENCE_STEP_S = 0.1
_NO_NUMBER = -2048
"""Number of a note without a value."""


class DeviceKind(IntEnum):
    """Kind of a device's frame; any two differ in at least four bits."""

    JOIN = 0x0F
    DONE = 0xF0
    LEAVE = 0x33
    NOTE = 0xCC
    COMMAND = 0x55


class NoteKind(IntEnum):
    """Kind of a note, whose lower-case name with hyphens is its tag; a number keeps its meaning."""

    ALERT = 1
    DANGER = 2
    NOT_OK = 3
    TRIP = 4
    CLEAR = 5
    RESET = 6
    OVERSPEED = 7
    SPEED_LOST = 8
    ROWS_LOST = 9
    ON = 10
    REVERSE = 11
    TRIP_REFUSED = 12

    @property
    def tag(self) -> str:
        """Tag of the note in the rig's events."""
        return self.name.lower().replace("_", "-")


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
        kind: Kind of the frame.
        node: Number of the device, 0 to 255.
        values: Fields of the rig's command of that name; for `COMMAND` counter and checksum of the device's command.
    """

    kind: DeviceKind
    node: int
    values: Mapping[str, Any]

    @property
    def counter(self) -> int:
        """Counter for the Acknowledge of an unreadable frame: the byte that holds a command's counter."""
        return self.node


def device_messages(rig: str, controller: str, time: str, targets: Mapping[int, str]) -> list[CanMessage]:
    """Return the messages, with the names of the two sending nodes, the label of a time, and the numbered channels."""
    join, done, leave, note, command = ((int(kind),) for kind in DeviceKind)
    kinds = {member.value: member.tag for member in NoteKind}
    node = CanSignal("node", 8, 8, label="Number of the device, unique on the bus")
    return [
        CanMessage(
            "Device", 0x023, 8, False, math.inf, False, controller,
            "From a device under test to a rig in lockstep: a block waits until all joined devices have finished the "
            "previous one. Without counter, may be repeated; DeviceState replies to join and leave. Note and command "
            "also without lockstep: note is an alarm, recorded as an event; command names the sender of the next "
            "Command, Fault or Stop. They have no reply; Status.refused counts invalid ones",
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
                CanSignal("note", 16, 4, label="Kind of note, its tag in the event", choices=kinds, selected_by=note),
                CanSignal(
                    "alarm", 20, 4, selected_by=note, choices={0: "none", **kinds},
                    label="Alarm that ends by clear or reset; 0 for other kinds",
                ),
                CanSignal("channel", 24, 8, label="Group or channel", choices={0: "none", **targets}, selected_by=note),
                CanSignal(
                    "number", 32, 12, signed=True, selected_by=note,
                    label=f"Value of the alarm divided by 10^exponent; {_NO_NUMBER}: none",
                ),
                CanSignal("exponent", 44, 4, signed=True, label="Exponent of ten", selected_by=note),
                CanSignal("counter", 16, 8, label="Counter of the command that follows", selected_by=command),
                CanSignal("signature", 24, 8, label="Checksum of that command", selected_by=command),
                CanSignal("reserved_command", 32, 16, label="Always 0", selected_by=command),
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
    return _sign(message, kind=int(kind), node=node, **raw)


def note_frame(
    message: CanMessage, kind: NoteKind, node: int, *,
    channel: str | None = None, value: float | None = None, alarm: NoteKind | None = None,
) -> tuple[int, bytes]:  # fmt: skip
    """Encode a device's note; return its identifier and data.

    Args:
        message: The message `Device` of a table.
        kind: Kind of the note.
        node: Number of the device, 0 to 255.
        channel: Name of a channel or channel group, if the note concerns one.
        value: A value, such as the level at the alarm, of which three digits are kept.
        alarm: For clear and reset, the alarm that ends.

    Raises:
        InputError: The channel does not exist, or the value does not fit.
    """
    numbers = {name: number for number, name in _channel_names(message).items()}
    if channel is not None and channel not in numbers:
        raise UnknownNameError("note.channel", "the name of a channel or channel group", channel, numbers)
    raw = {"number": _NO_NUMBER} if value is None else fit_number(value, field="note.value")
    return _sign(
        message, kind=int(DeviceKind.NOTE), node=node, note=int(kind), alarm=int(alarm or 0),
        channel=0 if channel is None else numbers[channel], **raw,
    )  # fmt: skip


def find_value(words: Sequence[str], names: Collection[str]) -> float | None:
    """Return the number after the last kind or channel in a note, as in "danger disk_x 512 um"; None without one.

    A number that does not fit the frame is left out, like all other words that the frame has no field for.
    """
    last = max((place for place, word in enumerate(words) if word in names), default=-1)
    with contextlib.suppress(ValueError, IndexError):
        value = float(words[last + 1])
        return value if last >= 0 and abs(value) <= MAX_NUMBER else None
    return None


def sender_frame(message: CanMessage, node: int, command: bytes) -> tuple[int, bytes]:
    """Encode the frame that names the sender of a command; it precedes the command, whose data are given."""
    return _sign(message, kind=int(DeviceKind.COMMAND), node=node, counter=command[1], signature=command[7])


def _sign(message: CanMessage, **raw: int) -> tuple[int, bytes]:
    try:
        data = message.encode(key=KEY, **raw)
    except ValueError as error:
        raise InputError("device", "one with a node from 0 to 255 and a patience up to 6553.5 s", str(error)) from None
    return message.identifier, data[:7] + bytes([checksum(message.identifier, data)])


def _channel_names(message: CanMessage) -> dict[int, str]:
    return dict(next(signal for signal in message.signals if signal.name == "channel").choices or {})


def parse_device_frame(message: CanMessage, data: bytes) -> DeviceRequest | None:
    """Decode a device's frame with valid length, key and checksum; return None if its content is invalid."""
    raw = message.decode(data)
    try:
        kind = DeviceKind(raw["kind"])
    except ValueError:
        return None
    if any(value for name, value in raw.items() if name.startswith("reserved")):
        return None
    if kind is DeviceKind.NOTE:
        note = _parse_note(message, raw)
        return None if note is None else DeviceRequest(kind, raw["node"], note)
    if kind is DeviceKind.COMMAND:
        return DeviceRequest(kind, raw["node"], {name: raw[name] for name in ("counter", "signature")})
    values: dict[str, Any] = {"device": device_name(raw["node"])}
    if kind is DeviceKind.JOIN and raw["patience"]:
        values["patience_s"] = round(raw["patience"] * _PATIENCE_STEP_S, 6)
    if kind is DeviceKind.DONE:
        values["block"] = raw["block"]
    return DeviceRequest(kind, raw["node"], values)


def _parse_note(message: CanMessage, raw: Mapping[str, int]) -> dict[str, Any] | None:
    """Return text and tags of a note; None if a field is invalid."""
    channels, has_number = _channel_names(message), raw["number"] != _NO_NUMBER
    try:
        kind, alarm = NoteKind(raw["note"]), NoteKind(raw["alarm"]) if raw["alarm"] else None
    except ValueError:
        return None
    if raw["channel"] not in channels or (alarm and kind not in (NoteKind.CLEAR, NoteKind.RESET)):
        return None
    if not has_number and raw["exponent"]:
        return None
    words = [kind.tag, alarm.tag if alarm else "", channels[raw["channel"]] if raw["channel"] else ""]
    words += [f"{float('{number}e{exponent}'.format_map(raw)):g}"] if has_number else []
    return {"text": " ".join(filter(None, words)), "tags": [kind.tag]}


def device_name(node: int) -> str:
    """Return the rig's name for a device on a bus."""
    return f"CAN {node}"


def device_node(name: object) -> int | None:
    """Return the number of a device on a bus from its name; None for another device."""
    match = _DEVICE_NAME.fullmatch(str(name))
    return int(match[1]) if match and int(match[1]) < 256 else None
