"""Table of the rig's CAN messages, generated from the channel table, and encoding of commands.

This module defines identifiers, lengths, bit positions, scaling and units of all messages; the DBC, the gateway, the
load and the drivers are derived from it. Everything is little-endian ("Intel"), and identifiers have 11 bits. The lower
identifier wins the bus: commands, then the time base, then waveforms, then slow messages.

Two layouts carry samples. `classic` has all channels at 1 kHz in 16 bits (the upper bits of the recorded counts), with
three channels and a running number per frame: five frames of 8 bytes per instant, below 70 % of 1 Mbit/s. `fd` has the
counts as recorded in 24 bits at 10 kHz, one channel group per message, with as many instants as fill 64 bytes, and the
number of the first instant in the recording. Both decimate the stream without a filter: frequencies above half the
slower rate are aliased, and the receiver must allow for that.

Noise must not produce a command. A command has a kind (4 of 256 values), a counter that is 1 to 15 above that of the
last command that reached the rig, a constant key, reserved bits at zero, and a CRC-8 over identifier and data; a hammer
pulse is also limited in force and duration, and faults have their own identifier. Of random frames of 8 bytes with the
identifier of commands, one in `ODDS` passes all these checks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Any

from drivers.can.bus.frame import FD_LENGTHS
from drivers.can.devices import DeviceRequest, device_messages, parse_device_frame
from drivers.can.faults import FaultKind, fault_raw, fault_request, fault_signals, number_targets
from drivers.can.message import ABSENT, KEY, CanMessage, CanSignal, MessageTable, SampleLayout, checksum
from rig.base.errors import InputError
from rig.channels.table import Channel, ChannelTable, default_table
from rig.run.commands.table import COMMANDS

CLASSIC_HZ = 1_000
FD_HZ = 10_000
"""Usual rates of the two layouts [Hz]."""
CLASSIC_SHARE = 0.7
"""Largest share of its bus for the classic layout with all other messages; beyond it, the start warns."""

_FD_CHANNELS = 20
"""Number of 24-bit channels that fit into a frame with their running number."""
MAX_LEAD = 15
"""Largest lead of a command's counter over that of the last command that reached the rig."""
ODDS = 2.7e9
"""Number of random frames of 8 bytes with the identifier of commands per accepted one, which is nearly always a hammer
pulse: 256 kinds x 256 / 15 counters x 256 keys x 256 checksums x 1 / (0.15 forces x 0.78 durations x 0.94 directions).
"""

RIG = "Rig"
CONTROLLER = "Controller"


_FRAMES = {name: command.CAN for name, command in COMMANDS.items() if hasattr(command, "CAN")}
_COMMANDS = {name: COMMANDS[name].quantities() for name, frame in _FRAMES.items() if frame.message == "Command"}
"""Commands of the message Command, each with its fields."""
_SIGNALS = {
    name: {field: each.quantity.can for field, each in fields.items() if each.quantity.can is not None}
    for name, fields in _COMMANDS.items()
}
"""Signals of their fields, in the order of the frame."""
EVENT_VALUES = {name: COMMANDS[name].SHOWN_FIELD for name, frame in _FRAMES.items() if frame.shown}
"""Field of an event that its frame carries, by command."""


class CommandKind(IntEnum):
    """Kind of a command of the message Command, or Stop; any two differ in at least four bits."""

    STOP = 0xC7
    vars().update({name.upper(): _FRAMES[name].kind for name in _COMMANDS})


Kind = CommandKind
"""Former name."""


class Result(IntEnum):
    """Result of a command."""

    ACCEPTED = 0
    BAD_LENGTH = 1
    BAD_CHECKSUM = 2
    BAD_KEY = 3
    BAD_KIND = 4
    RESERVED_BITS = 5
    STALE_COUNTER = 6
    OUT_OF_RANGE = 7
    REFUSED = 8
    TIMED_OUT = 9
    BUSY = 10


class Field(IntEnum):
    """Field of a command that was out of range."""

    NONE = 0
    vars().update({each.name.upper(): each.number for signals in _SIGNALS.values() for each in signals.values()})


class RigState(IntEnum):
    """State of the rig."""

    PREPARING = 0
    RUNNING = 1
    ENDED = 2
    LOCKSTEP = 3


class EventKind(IntEnum):
    """Kind of an event."""

    START = 1
    COMMAND = 2
    WARNING = 6
    END = 7
    DEVICE = 10
    OTHER = 15
    vars().update({name.upper(): frame.event for name, frame in _FRAMES.items()})


def _choices(names: type[IntEnum]) -> dict[int, str]:
    return {member.value: member.name.lower() for member in sorted(names)}


_TIME = "Simulated time, modulo 2^32 us (71.6 min)"

_HEAD = (
    CanSignal(
        "counter", 8, 8, label=f"1 to {MAX_LEAD} more than that of the last command received by the rig, modulo 256"
    ),
    CanSignal("key", 48, 8, label=f"Always {KEY:#x}"),
    CanSignal("checksum", 56, 8, label="CRC-8 (SAE J1850) over identifier, low byte first, and the other seven bytes"),
)
_STOP_SIGNALS = (
    CanSignal("kind", 0, 8, label="Kind of command", choices={int(CommandKind.STOP): "stop"}),
    CanSignal("reserved", 16, 32, label="Always 0"),
    *_HEAD,
)
LIMITS = {
    field: (each.low, each.high)
    for fields in _COMMANDS.values()
    for field, each in fields.items()
    if not each.takes_text and math.isfinite(each.high)
}
"""Range of a command's field [N], [ms]; the drive's top speed is a parameter of the rig."""
_VALUE_BITS = range(16, 48)
"""Bits of the fields in a command's frame."""


def _field_signals() -> Iterator[CanSignal]:
    """Yield the signals of each command's fields in order, and a reserved signal for the remaining bits."""
    bare = tuple(int(CommandKind[name.upper()]) for name, signals in _SIGNALS.items() if not signals)
    for name, signals in _SIGNALS.items():
        start, kind = _VALUE_BITS.start, (int(CommandKind[name.upper()]),)
        for field, each in signals.items():
            unit = each.unit or _COMMANDS[name][field].quantity.unit
            label = "{}, {:g} to {:g}".format(each.label, *LIMITS[field]) if field in LIMITS else each.label
            yield CanSignal(each.name, start, each.bits, scale=each.scale, unit=unit, label=label, selected_by=kind)
            start += each.bits
        if signals and start < _VALUE_BITS.stop:
            yield CanSignal(f"reserved_{name}", start, _VALUE_BITS.stop - start, label="Always 0", selected_by=kind)
    yield CanSignal("reserved", _VALUE_BITS.start, len(_VALUE_BITS), label="Always 0", selected_by=bare)


_COMMAND_SIGNALS = (
    CanSignal(
        "kind", 0, 8, label="Kind of command", selects=True,
        choices={value: name for value, name in _choices(CommandKind).items() if value != CommandKind.STOP},
    ),
    *_field_signals(),
    *_HEAD,
)  # fmt: skip


def _other_messages() -> list[CanMessage]:
    command = (
        "Command: 8 bytes; kind, counter, key and checksum are checked, unused bits must be 0. "
        "The rig checks ranges and replies with the simulated time of effect (Acknowledge)"
    )
    shown = ", ".join(frame.shown for frame in _FRAMES.values() if frame.shown)
    spin = CanSignal("spin", 8, 16, scale=0.001, unit="Hz", label="Spin speed of the shaft; 65.535: or more")
    return [
        CanMessage("Stop", 0x010, 8, False, 0.1, False, CONTROLLER, f"Ends the run. {command}", _STOP_SIGNALS),
        CanMessage("Command", 0x020, 8, False, 0.1, False, CONTROLLER, command, _COMMAND_SIGNALS),
        CanMessage(
            "Acknowledge", 0x021, 8, False, 0.05, False, RIG,
            "Reply to a command; after a burst of 20, at most 50 refusals per second are acknowledged",
            (
                CanSignal("counter", 0, 8, label="Counter of the command"),
                CanSignal("result", 8, 4, label="Result of the command", choices=_choices(Result)),
                CanSignal("field", 12, 4, label="Field that is out of range", choices=_choices(Field)),
                CanSignal("time", 16, 32, unit="us", label=f"Time of effect if accepted, otherwise now. {_TIME}"),
                CanSignal("limit", 48, 16, scale=0.1, label="Exceeded limit, or number of the new fault"),
            ),
        ),
        CanMessage(
            "Event", 0x310, 8, False, 0.1, False, RIG, "Event in the rig; sent after all earlier samples",
            (
                CanSignal("event", 0, 8, label="Kind of event", choices=_choices(EventKind)),
                CanSignal("number", 8, 8, label="Running number, modulo 256"),
                CanSignal("time", 16, 32, unit="us", label=_TIME),
                CanSignal("value", 48, 16, scale=0.1, label=shown[0].upper() + shown[1:]),
            ),
        ),
        CanMessage(
            "Sync", 0x080, 8, False, 0.1, True, RIG,
            "Relates bus time to the stream: sent when the sample of this number is due, Rates.latency after its time",
            (
                CanSignal("index", 0, 32, label="Number of the sample in the recording"),
                CanSignal("time", 32, 32, unit="us", label=f"Time of the sample. {_TIME}"),
            ),
        ),
        CanMessage(
            "Keyphasor", 0x300, 8, False, 0.02, False, RIG,
            "Exact edge of the keyphasor (the bus load assumes at most 50 per second)",
            (
                CanSignal("number", 0, 16, label="Number of the edge, modulo 65536"),
                CanSignal("time", 16, 32, unit="us", label=f"Whole microseconds. {_TIME}"),
                CanSignal("fraction", 48, 16, scale=1.0 / 65536, unit="us", label="Fraction of the time"),
            ),
        ),
        CanMessage(
            "Clock", 0x6FF, 8, False, 1.0, True, RIG,
            "Whole seconds, to count wraps of time and index; and which samples to expect",
            (
                CanSignal("seconds", 0, 32, unit="s", label="End of the last block, whole seconds of simulated time"),
                CanSignal("fd_messages", 32, 16, label="Number of sample messages of this run in FD frames"),
                CanSignal("classic_messages", 48, 16, label="Number of sample messages of this run in classic frames"),
            ),
        ),
        CanMessage(
            "Status", 0x700, 8, False, 0.5, True, RIG, "Status of the rig; rig/status has all of it",
            (
                CanSignal("state", 0, 4, label="State of the rig", choices=_choices(RigState)),
                CanSignal("warnings", 4, 4, label="Number of warnings; 15: or more"),
                spin,
                CanSignal("lateness", 24, 16, scale=0.01, unit="ms", label="p99 of block lateness; 655.35: or more"),
                CanSignal("dropped", 40, 12, label="Sample frames that were not sent, modulo 4096"),
                CanSignal("refused", 52, 12, label="Commands refused, modulo 4096"),
            ),
        ),
        CanMessage(
            "Heartbeat", 0x701, 8, False, 1.0, True, RIG, "Sign of life; without it for 3 s the rig is lost",
            (
                CanSignal("state", 0, 8, label="State of the rig", choices=_choices(RigState)),
                CanSignal("beat", 8, 8, label="Running number, modulo 256"),
                CanSignal("counter", 16, 8, label="Counter of the last received command; the next has one more"),
                CanSignal("time", 24, 32, unit="us", label=f"End of the last block. {_TIME}"),
                CanSignal("layout", 56, 8, label="Number of the sample layout; another number needs another DBC"),
            ),
        ),
        CanMessage(
            "Rates", 0x702, 8, False, 1.0, True, RIG, "Decimation and latency of samples",
            (
                CanSignal("rate", 0, 24, unit="Hz", label="Rate of the recording"),
                CanSignal("fd_step", 24, 12, label="Decimation of samples in FD frames; 0: not sent"),
                CanSignal("classic_step", 36, 12, label="Decimation of samples in classic frames"),
                CanSignal("latency", 48, 16, scale=0.01, unit="ms", label="Time from a sample to its frame"),
            ),
        ),
    ]  # fmt: skip


def _decimation(channel: Channel) -> str:
    return (
        f"{channel.label}. {channel.kind.capitalize()} calibration: {channel.sensitivity_v:g} V per {channel.unit}, "
        f"bias {channel.bias_v:g} V, low-pass {channel.bandwidth_hz:g} Hz"
    )


def _sample_signals(samples: SampleLayout, index_label: str) -> tuple[CanSignal, ...]:
    width = 8 * samples.width
    rows = [CanSignal("index", 0, 8 * samples.index_width, label=index_label)]
    for row in range(samples.rows):
        for column, channel in enumerate(samples.channels):
            start = 8 * samples.index_width + width * (row * len(samples.channels) + column)
            name = channel.name if samples.rows == 1 else f"{channel.name}_{row}"
            scale = channel.scale * 2.0 ** int(samples.shifts[column])
            label = _decimation(channel) if row == 0 else ""
            rows.append(
                CanSignal(name, start, width, True, scale, channel.offset, channel.unit, label, channel=channel)
            )  # fmt: skip
    return tuple(rows)


def _fault_message(table: ChannelTable) -> CanMessage:
    about = (
        "Begin or end of a fault: 8 bytes, checked as those of Command. Acknowledge has its "
        "number and the time of its first row; rig/KEYS.md has the equations"
    )
    return CanMessage("Fault", 0x022, 8, False, 0.1, False, CONTROLLER, about, (*fault_signals(table), *_HEAD))


def _fd_messages(table: ChannelTable) -> list[CanMessage]:
    messages, used_names = [], {row.name for row in _other_messages()}
    parts = [
        (group, group.channels[first : first + _FD_CHANNELS])
        for group in table.groups.values()
        for first in range(0, len(group.channels), _FD_CHANNELS)
    ]
    spacing = 0x10 if len(parts) <= 0x10 else 1
    if len(parts) > 0x100:
        raise InputError("channels", "few enough for 256 CAN FD messages", len(table.channels))
    for position, (group, channels) in enumerate(parts):
        for channel in channels:
            if channel.adc_bits > 24:
                raise InputError(f"channel {channel.name}.adc_bits", "at most 24 on a CAN bus", channel.adc_bits)
        rows = 60 // (3 * len(channels))
        samples = SampleLayout(channels, rows, 3, 4)
        name = group.name.capitalize()
        if len(channels) < len(group.channels) or name in used_names:
            name = f"{name}_{position}"
        label = (
            f"{group.title}: {rows} instants of counts as recorded. Every n-th sample of the {group.rate_hz} Hz stream "
            f"(n = {group.rate_hz // FD_HZ} at {FD_HZ} Hz; Rates.fd_step), no further filter: "
            "what lies above half the slower rate folds back"
        )
        index = "Number of the first instant in the recording, modulo 2^32; the others follow by Rates.fd_step"
        length = next(size for size in FD_LENGTHS[8:] if size >= 4 + 3 * rows * len(channels))
        messages.append(
            CanMessage(
                name, 0x100 + spacing * position, length, True, rows / FD_HZ, True, RIG, label,
                _sample_signals(samples, index), samples,
            )
        )  # fmt: skip
    return messages


def _classic_messages(table: ChannelTable) -> list[CanMessage]:
    channels = tuple(table.channels.values())
    messages = []
    for number, first in enumerate(range(0, len(channels), 3), start=1):
        samples = SampleLayout(channels[first : first + 3], 1, 2, 2)
        step = samples.channels[0].rate_hz // CLASSIC_HZ
        label = (
            f"{', '.join(channel.name for channel in samples.channels)}: upper 16 bits of counts; {ABSENT}: no value. "
            f"Every n-th sample of the stream (n = {step} at {CLASSIC_HZ} Hz; Rates.classic_step), no further filter: "
            "what lies above half the slower rate folds back"
        )
        index = "Number in the recording divided by Rates.classic_step, modulo 65536"
        messages.append(
            CanMessage(
                f"Samples_{number}", 0x200 + number, 2 + 2 * len(samples.channels), False, 1.0 / CLASSIC_HZ, True, RIG,
                label, _sample_signals(samples, index), samples,
            )
        )  # fmt: skip
    return messages


def make_table(channels: ChannelTable) -> MessageTable:
    """Build all messages for a channel table."""
    devices = device_messages(RIG, CONTROLLER, _TIME, number_targets(channels))
    samples = [*_fd_messages(channels), *_classic_messages(channels)]
    rows = [*_other_messages(), _fault_message(channels), *devices, *samples]
    return MessageTable(tuple(sorted(rows, key=lambda row: row.identifier)))


def messages_for(channels: ChannelTable) -> MessageTable:
    """Return the standard messages if they carry these channels, otherwise messages for this table.

    Raises:
        InputError: The channels do not fit into messages.
    """
    return default_messages() if find_mismatch(channels, default_table().channels) is None else make_table(channels)


def find_mismatch(channels: ChannelTable, calibrated: Mapping[str, Channel]) -> str | None:
    """Return the name of the first channel that is not known with the same calibration and unit."""
    for name, channel in channels.channels.items():
        like = calibrated.get(name)
        if like is None or (like.scale, like.offset, like.unit) != (channel.scale, channel.offset, channel.unit):
            return name
    return None


@cache
def default_messages() -> MessageTable:
    """Return the messages of the standard channel table."""
    return make_table(default_table())


@dataclass(frozen=True, slots=True)
class Command:
    """A decoded command.

    Attributes:
        kind: Kind of the command.
        counter: Counter, 0 to 255.
        values: Fields in the units of the rig's commands: `force_n` [N], `duration_ms` [ms], `direction` [degrees],
            `speed_hz` [Hz]; for a fault the fields of `rig.run.commands.FaultCommand`, with its kind's main number.
    """

    kind: CommandKind | FaultKind
    counter: int
    values: dict[str, Any]


FIELDS = {field: Field(each.number) for signals in _SIGNALS.values() for field, each in signals.items()}


def command_frame(kind: CommandKind, counter: int, **values: float | str | None) -> tuple[int, bytes]:
    """Encode a command as a controller sends it; return identifier and data. The rig itself checks the ranges.

    Args:
        kind: Kind of the command.
        counter: One more than that of the last command (see Heartbeat), modulo 256; 1 for the first.
        values: Fields of the rig's command of that name, in their units, rounded to the steps of the frame; an angle
            is 0 by default.

    Raises:
        InputError: A value is missing, has the wrong type, or does not fit into the frame.
    """
    message = default_messages().by_name["Stop" if kind is CommandKind.STOP else "Command"]
    signals = {signal.name: signal for signal in message.signals}
    raw = {}
    for name, each in _SIGNALS.get(kind.name.lower(), {}).items():
        signal, value = signals[each.name], values.pop(name, None)
        if isinstance(value, str):
            if value not in each.words:
                must = ", ".join(each.words) + (", or an angle" if each.full_turn else "")
                raise InputError(name, must or "a number", value)
            value = each.words[value]
        if each.full_turn:
            value = (value or 0.0) % (each.full_turn * each.scale)
        most = signal.raw_range[1] * signal.scale
        if value is None or not 0.0 <= value <= most:
            raise InputError(name, f"a value for {kind.name} from 0 to {most:g} {signal.unit}", value)
        raw[each.name] = round(value / signal.scale)
        if each.full_turn:
            raw[each.name] %= each.full_turn
    for name, value in values.items():
        if value is not None:
            raise InputError(name, f"left out: {kind.name} has no such value", value)
    return _signed(message, counter, kind=int(kind), **raw)


def fault_frame(
    channel: str, kind: str, counter: int, *, number: float | str | None = None, table: MessageTable | None = None
) -> tuple[int, bytes]:
    """Encode a command that injects a fault; return identifier and data.

    Args:
        channel: Name of a channel or channel group.
        kind: Kind of fault; `rig fault --list` lists them.
        counter: As for `command_frame`.
        number: Main number of the kind (named in `rig.dbc`), or the other channel; None if the kind needs none.
        table: Messages; by default those of the standard channel table.

    Raises:
        InputError: The fault or channel does not exist, or the number does not fit.

    Example:
        >>> fault_frame("P_E", "gain", 1, number=1.05)[1].hex()
        '6b0101090de89d4b'
    """
    message = (table or default_messages()).by_name["Fault"]
    return _signed(message, counter, **fault_raw(message, channel, kind, number))


def clear_frame(counter: int, *, number: int = 0) -> tuple[int, bytes]:
    """Encode a command that clears a fault by its number, or all by 0; return identifier and data."""
    return _signed(default_messages().by_name["Fault"], counter, kind=int(FaultKind.CLEAR), id=number)


def _signed(message: CanMessage, counter: int, **raw: int) -> tuple[int, bytes]:
    data = message.encode(counter=counter & 0xFF, key=KEY, **raw)
    return message.identifier, data[:7] + bytes([checksum(message.identifier, data)])


def parse_command(
    identifier: int, data: bytes, last_counter: int, table: MessageTable | None = None
) -> Command | DeviceRequest | Result:
    """Decode a command from the bus, or return the reason for refusing it.

    Args:
        identifier: Identifier of Stop, Command, Fault or Device.
        data: Data of the frame.
        last_counter: Counter of the last command that reached the rig.
        table: Messages; by default those of the standard channel table.
    """
    if len(data) != 8:
        return Result.BAD_LENGTH
    if data[7] != checksum(identifier, data):
        return Result.BAD_CHECKSUM
    if data[6] != KEY:
        return Result.BAD_KEY
    message = (table or default_messages()).by_identifier[identifier]
    if message.name == "Device":
        return parse_device_frame(message, data) or Result.BAD_KIND
    try:
        kind = FaultKind(data[0]) if message.name == "Fault" else CommandKind(data[0])
    except ValueError:
        return Result.BAD_KIND
    if (message.name == "Stop") != (kind is CommandKind.STOP):
        return Result.BAD_KIND
    raw = message.decode(data)
    fields = _SIGNALS.get(kind.name.lower(), {})
    turned = [each for each in fields.values() if each.full_turn and raw[each.name] >= each.full_turn]
    if turned or any(raw[name] for name in raw if name.startswith("reserved")):
        return Result.RESERVED_BITS
    if not 1 <= (data[1] - last_counter) % 256 <= MAX_LEAD:
        return Result.STALE_COUNTER
    if isinstance(kind, FaultKind):
        request = fault_request(message, raw)
        return Result.OUT_OF_RANGE if request is None else Command(kind, data[1], request)
    # Rounded to the steps of the frame, so that 0.1 N x 800 is 80 N.
    values = {field: round(raw[each.name] * each.scale, 6) for field, each in fields.items()}
    return Command(kind, data[1], values)
