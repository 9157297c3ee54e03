"""The one table of CAN messages, made from the channel table, and their bytes.

Identifiers, lengths, bit positions, scaling and units of everything that the rig has on a bus stand here; the DBC, the
gateway, the load and the drivers derive from it. All is little-endian ("Intel"), identifiers have 11 bits, and the
lower wins the bus: commands, then the time base, then waveforms, then slow messages.

Two layouts carry samples. `classic` has all channels at 1 kHz in 16 bits (the upper bits of the recorded counts), three
channels and a running number a frame: five frames of 8 bytes an instant, below 70 % of 1 Mbit/s. `fd` has the counts as
recorded in 24 bits at 10 kHz, one sensor group a message, as many instants as fill 64 bytes, with the number of the
first one in the recording. Both pick every n-th sample of the stream as it is: what lies above half the slower rate
folds back, which is the receiver's to know.

A command must not arise from noise. It has a kind (4 of 256 values), a counter that goes on by 1 to 15 from that of
the last command that reached the rig, a constant key, reserved bits at zero, and a CRC-8 over identifier and data; a
hammer pulse is also limited in force and duration; faults have an identifier of their own. Of random frames of 8 bytes
on the very identifier of commands, one of `ODDS` passes all that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Any

from drivers.can.bus.frame import FD_LENGTHS
from drivers.can.devices import Said, device_messages, said_in
from drivers.can.faults import FaultKind, fault_raw, fault_request, fault_signals
from drivers.can.message import ABSENT, KEY, Message, MessageTable, Samples, Signal, checksum
from rig.base.errors import InputError
from rig.channels.table import Channel, ChannelTable, default_table
from rig.run.commands.table import COMMANDS

CLASSIC_HZ = 1_000
FD_HZ = 10_000
"""Usual rates of the two layouts [Hz]."""
CLASSIC_SHARE = 0.7
"""Most that the classic layout is to take of its bus, with everything that goes with it; beyond, a start warns."""

_FD_CHANNELS = 20
"""As many of 24 bits fit into a frame with their number."""
AHEAD = 15
"""How far the counter of a command may be ahead of that of the last one that reached the rig."""
ODDS = 2.7e9
"""Random frames of 8 bytes on the identifier of commands for one that is taken: a hammer pulse by nearly all of
it, 256 kinds x 256 / 15 counters x 256 keys x 256 checksums x 1 / (0.15 forces x 0.78 durations x 0.94 directions)."""

RIG = "Rig"
CONTROLLER = "Controller"


_FRAMES = {name: command.CAN for name, command in COMMANDS.items() if hasattr(command, "CAN")}
_COMMANDS = {name: COMMANDS[name].quantities() for name, frame in _FRAMES.items() if frame.message == "Command"}
"""Commands of the message Command, each with its fields."""
_SIGNALS = {
    name: {field: each.quantity.can for field, each in fields.items() if each.quantity.can is not None}
    for name, fields in _COMMANDS.items()
}
"""Signals of their fields, in their order in the frame."""
EVENT_VALUES = {name: COMMANDS[name].SHOWN_FIELD for name, frame in _FRAMES.items() if frame.shown}
"""Field of an event that its frame carries, by command."""


class Kind(IntEnum):
    """Kind of a command of the message Command, or Stop; any two differ in at least four bits."""

    STOP = 0xC7
    vars().update({name.upper(): _FRAMES[name].kind for name in _COMMANDS})


class Result(IntEnum):
    """What became of a command."""

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
    """Which value of a command was out of range."""

    NONE = 0
    vars().update({each.name.upper(): each.number for signals in _SIGNALS.values() for each in signals.values()})


class State(IntEnum):
    """What the rig does."""

    PREPARING = 0
    RUNNING = 1
    ENDED = 2
    LOCKSTEP = 3


class EventKind(IntEnum):
    """What has happened."""

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
    Signal("counter", 8, 8, label=f"1 to {AHEAD} above that of the last one that reached the rig, modulo 256"),
    Signal("key", 48, 8, label=f"Always {KEY:#x}"),
    Signal("checksum", 56, 8, label="CRC-8 (SAE J1850) over identifier, low byte first, and the other seven bytes"),
)
_STOP_SIGNALS = (
    Signal("kind", 0, 8, label="What to do", choices={int(Kind.STOP): "stop"}),
    Signal("reserved", 16, 32, label="Always 0"),
    *_HEAD,
)
LIMITS = {
    field: (each.low, each.high)
    for fields in _COMMANDS.values()
    for field, each in fields.items()
    if not each.takes_text and math.isfinite(each.high)
}
"""Least and largest value of a command's field that the rig takes [N], [ms]; the drive's top speed is its parameter."""
_VALUE_BITS = range(16, 48)
"""Bits of the fields in the frame of a command."""


def _field_signals() -> Iterator[Signal]:
    """Give the signals of each command's fields one after another, and a reserved one for the bits that are left."""
    bare = tuple(int(Kind[name.upper()]) for name, signals in _SIGNALS.items() if not signals)
    for name, signals in _SIGNALS.items():
        start, kind = _VALUE_BITS.start, (int(Kind[name.upper()]),)
        for field, each in signals.items():
            unit = each.unit or _COMMANDS[name][field].quantity.unit
            label = "{}, {:g} to {:g}".format(each.label, *LIMITS[field]) if field in LIMITS else each.label
            yield Signal(each.name, start, each.bits, scale=each.scale, unit=unit, label=label, selected_by=kind)
            start += each.bits
        if signals and start < _VALUE_BITS.stop:
            yield Signal(f"reserved_{name}", start, _VALUE_BITS.stop - start, label="Always 0", selected_by=kind)
    yield Signal("reserved", _VALUE_BITS.start, len(_VALUE_BITS), label="Always 0", selected_by=bare)


_COMMAND_SIGNALS = (
    Signal(
        "kind", 0, 8, label="What to do", selects=True,
        choices={value: name for value, name in _choices(Kind).items() if value != Kind.STOP},
    ),
    *_field_signals(),
    *_HEAD,
)  # fmt: skip


def _other_messages() -> list[Message]:
    command = (
        "A command: 8 bytes; kind, counter, key, checksum are checked, bits that the kind does not use must be 0. "
        "The rig checks ranges and says at which simulated time it takes effect (Acknowledge)"
    )
    shown = ", ".join(frame.shown for frame in _FRAMES.values() if frame.shown)
    spin = Signal(
        "spin", 8, 16, scale=0.001, unit="Hz", label="Spin speed of the shaft, as the status has it; 65.535: more"
    )
    return [
        Message("Stop", 0x010, 8, False, 0.1, False, CONTROLLER, f"Ends the run. {command}", _STOP_SIGNALS),
        Message("Command", 0x020, 8, False, 0.1, False, CONTROLLER, command, _COMMAND_SIGNALS),
        Message(
            "Acknowledge", 0x021, 8, False, 0.05, False, RIG,
            "What became of a command; beyond a burst of 20, at most 50 refusals a second are acknowledged",
            (
                Signal("counter", 0, 8, label="That of the command"),
                Signal("result", 8, 4, label="What became of it", choices=_choices(Result)),
                Signal("field", 12, 4, label="Value that was out of range", choices=_choices(Field)),
                Signal("time", 16, 32, unit="us", label=f"When an accepted command takes effect, else now. {_TIME}"),
                Signal("limit", 48, 16, scale=0.1, label="Limit passed, or number of the fault that began"),
            ),
        ),
        Message(
            "Event", 0x310, 8, False, 0.1, False, RIG, "Something took effect; behind all samples before it",
            (
                Signal("event", 0, 8, label="What", choices=_choices(EventKind)),
                Signal("number", 8, 8, label="Running number, modulo 256"),
                Signal("time", 16, 32, unit="us", label=_TIME),
                Signal("value", 48, 16, scale=0.1, label=shown[0].upper() + shown[1:]),
            ),
        ),
        Message(
            "Sync", 0x080, 8, False, 0.1, True, RIG,
            "Ties bus time to the stream: sent when the sample of this number is due, Rates.latency after its time",
            (
                Signal("index", 0, 32, label="Number of the sample in the recording"),
                Signal("time", 32, 32, unit="us", label=f"Its time. {_TIME}"),
            ),
        ),
        Message(
            "Keyphasor", 0x300, 8, False, 0.02, False, RIG,
            "An exact edge of the keyphasor (the load assumes at most 50 a second)",
            (
                Signal("number", 0, 16, label="Number of the edge, modulo 65536"),
                Signal("time", 16, 32, unit="us", label=f"Whole microseconds. {_TIME}"),
                Signal("fraction", 48, 16, scale=1.0 / 65536, unit="us", label="Rest of the time"),
            ),
        ),
        Message(
            "Clock", 0x6FF, 8, False, 1.0, True, RIG, "How often the times and the index of other frames have wrapped",
            (Signal("seconds", 0, 32, unit="s", label="End of the last block, whole seconds of simulated time"),),
        ),
        Message(
            "Status", 0x700, 8, False, 0.5, True, RIG, "How the rig does; rig/status has it all",
            (
                Signal("state", 0, 4, label="What the rig does", choices=_choices(State)),
                Signal("warnings", 4, 4, label="Number of warnings; 15: more"),
                spin,
                Signal("lateness", 24, 16, scale=0.01, unit="ms", label="p99 of the lateness of blocks; 655.35: more"),
                Signal("dropped", 40, 12, label="Sample frames that were not sent, modulo 4096"),
                Signal("refused", 52, 12, label="Commands refused, modulo 4096"),
            ),
        ),
        Message(
            "Heartbeat", 0x701, 8, False, 1.0, True, RIG, "The rig is there; without it for 3 s, it has gone",
            (
                Signal("state", 0, 8, label="What the rig does", choices=_choices(State)),
                Signal("beat", 8, 8, label="Running number, modulo 256"),
                Signal("counter", 16, 8, label="Of the last command that reached the rig; the next has one more"),
                Signal("time", 24, 32, unit="us", label=f"End of the last block. {_TIME}"),
                Signal("layout", 56, 8, label="Which sample messages these are; another number: another DBC"),
            ),
        ),
        Message(
            "Rates", 0x702, 8, False, 1.0, True, RIG, "How samples were picked",
            (
                Signal("rate", 0, 24, unit="Hz", label="Rate of the recording"),
                Signal("fd_step", 24, 12, label="Samples from one to the next in FD frames; 0: not sent"),
                Signal("classic_step", 36, 12, label="Samples from one to the next in classic frames"),
                Signal("latency", 48, 16, scale=0.01, unit="ms", label="From a sample to when its frame is due"),
            ),
        ),
    ]  # fmt: skip


def _decimation(channel: Channel) -> str:
    return (
        f"{channel.label}. {channel.kind.capitalize()} calibration: {channel.sensitivity_v:g} V per {channel.unit}, "
        f"bias {channel.bias_v:g} V, low-pass {channel.bandwidth_hz:g} Hz"
    )


def _sample_signals(samples: Samples, index_label: str) -> tuple[Signal, ...]:
    width = 8 * samples.width
    rows = [Signal("index", 0, 8 * samples.index_width, label=index_label)]
    for row in range(samples.rows):
        for column, channel in enumerate(samples.channels):
            start = 8 * samples.index_width + width * (row * len(samples.channels) + column)
            name = channel.name if samples.rows == 1 else f"{channel.name}_{row}"
            scale = channel.scale * 2.0 ** int(samples.shifts[column])
            label = _decimation(channel) if row == 0 else ""
            rows.append(
                Signal(name, start, width, True, scale, channel.offset, channel.unit, label, channel=channel)
            )  # fmt: skip
    return tuple(rows)


def _fault_message(table: ChannelTable) -> Message:
    about = (
        "A fault of a channel or a stream begins, or ends: 8 bytes, checked as those of Command. Acknowledge tells its "
        "number, and when its first row is; rig/KEYS.md has the equations"
    )
    return Message("Fault", 0x022, 8, False, 0.1, False, CONTROLLER, about, (*fault_signals(table), *_HEAD))


def _fd_messages(table: ChannelTable) -> list[Message]:
    found, taken = [], {row.name for row in _other_messages()}
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
        samples = Samples(channels, rows, 3, 4)
        name = group.name.capitalize()
        if len(channels) < len(group.channels) or name in taken:
            name = f"{name}_{position}"
        label = (
            f"{group.title}: {rows} instants of counts as recorded. Every n-th sample of the {group.rate_hz} Hz stream "
            f"(n = {group.rate_hz // FD_HZ} at {FD_HZ} Hz; Rates.fd_step), not filtered again: "
            "what lies above half the slower rate folds back"
        )
        index = "Number of the first instant in the recording, modulo 2^32; the others follow by Rates.fd_step"
        length = next(size for size in FD_LENGTHS[8:] if size >= 4 + 3 * rows * len(channels))
        found.append(
            Message(
                name, 0x100 + spacing * position, length, True, rows / FD_HZ, True, RIG, label,
                _sample_signals(samples, index), samples,
            )
        )  # fmt: skip
    return found


def _classic_messages(table: ChannelTable) -> list[Message]:
    channels = tuple(table.channels.values())
    found = []
    for number, first in enumerate(range(0, len(channels), 3), start=1):
        samples = Samples(channels[first : first + 3], 1, 2, 2)
        step = samples.channels[0].rate_hz // CLASSIC_HZ
        label = (
            f"{', '.join(channel.name for channel in samples.channels)}: upper 16 bits of counts; {ABSENT}: not there. "
            f"Every n-th sample of the stream (n = {step} at {CLASSIC_HZ} Hz; Rates.classic_step), not filtered again: "
            "what lies above half the slower rate folds back"
        )
        index = "Number in the recording divided by Rates.classic_step, modulo 65536"
        found.append(
            Message(
                f"Samples_{number}", 0x200 + number, 2 + 2 * len(samples.channels), False, 1.0 / CLASSIC_HZ, True, RIG,
                label, _sample_signals(samples, index), samples,
            )
        )  # fmt: skip
    return found


def make_table(channels: ChannelTable) -> MessageTable:
    """All messages for a channel table."""
    devices = device_messages(RIG, CONTROLLER, _TIME)
    samples = [*_fd_messages(channels), *_classic_messages(channels)]
    rows = [*_other_messages(), _fault_message(channels), *devices, *samples]
    return MessageTable(tuple(sorted(rows, key=lambda row: row.identifier)))


def messages_for(channels: ChannelTable) -> MessageTable:
    """The rig's own messages where these channels are among them as they are, else messages of their own.

    Raises:
        InputError: They do not fit into messages.
    """
    return default_messages() if unlike(channels, default_table().channels) is None else make_table(channels)


def unlike(channels: ChannelTable, known: Mapping[str, Channel]) -> str | None:
    """Name of the first channel that is not among those known, with the same calibration and unit."""
    for name, channel in channels.channels.items():
        like = known.get(name)
        if like is None or (like.scale, like.offset, like.unit) != (channel.scale, channel.offset, channel.unit):
            return name
    return None


@cache
def default_messages() -> MessageTable:
    """The messages of the rig's own channel table."""
    return make_table(default_table())


@dataclass(frozen=True, slots=True)
class Command:
    """A command as it travels.

    Attributes:
        kind: What to do.
        counter: 0 to 255.
        values: Values in the units of the rig's own commands: `force_n` [N], `duration_ms` [ms], `direction` [degrees],
            `speed_hz` [Hz]; of a fault the fields of `rig.run.commands.FaultCommand`, with its kind's main number.
    """

    kind: Kind | FaultKind
    counter: int
    values: dict[str, Any]


FIELDS = {field: Field(each.number) for signals in _SIGNALS.values() for field, each in signals.items()}


def command_frame(kind: Kind, counter: int, **values: float | str | None) -> tuple[int, bytes]:
    """Identifier and data of a command, as a controller sends it. Whether the rig takes its values, the rig says.

    Args:
        kind: What to do.
        counter: One more than that of the last one (see Heartbeat), modulo 256; the first has 1.
        values: Fields of the rig's command of that name, in their units, rounded to the steps of the frame; an angle
            is 0 unless given.

    Raises:
        InputError: A value is missing, is one of another kind, or finds no room in the frame.
    """
    message = default_messages().by_name["Stop" if kind is Kind.STOP else "Command"]
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
            raise InputError(name, f"given for {kind.name}, from 0 to {most:g} {signal.unit}", value)
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
    """Identifier and data of a command that begins a fault.

    Args:
        channel: A channel, or a group.
        kind: What it does: `rig fault --list`.
        counter: As of `command_frame`.
        number: Its main number (`rig.dbc` names it), or the channel that it is with; None where it needs none.
        table: Messages; those of the rig's own channel table unless given.

    Raises:
        InputError: There is no such fault or channel, or no room for the number.

    Example:
        >>> fault_frame("P_E", "gain", 1, number=1.05)[1].hex()
        '6b0101090de89d4b'
    """
    message = (table or default_messages()).by_name["Fault"]
    return _signed(message, counter, **fault_raw(message, channel, kind, number))


def clear_frame(counter: int, *, number: int = 0) -> tuple[int, bytes]:
    """Identifier and data of a command that ends a fault by its number, or all by 0."""
    return _signed(default_messages().by_name["Fault"], counter, kind=int(FaultKind.CLEAR), id=number)


def _signed(message: Message, counter: int, **raw: int) -> tuple[int, bytes]:
    data = message.encode(counter=counter & 0xFF, key=KEY, **raw)
    return message.identifier, data[:7] + bytes([checksum(message.identifier, data)])


def parse_command(
    identifier: int, data: bytes, last_counter: int, table: MessageTable | None = None
) -> Command | Said | Result:
    """A command from the bus, or why it is none.

    Args:
        identifier: Of Stop, Command, Fault or Device.
        data: What came.
        last_counter: Counter of the last command that reached the rig.
        table: Messages; those of the rig's own channel table unless given.
    """
    if len(data) != 8:
        return Result.BAD_LENGTH
    if data[7] != checksum(identifier, data):
        return Result.BAD_CHECKSUM
    if data[6] != KEY:
        return Result.BAD_KEY
    message = (table or default_messages()).by_identifier[identifier]
    if message.name == "Device":
        return said_in(message.decode(data)) or Result.BAD_KIND
    try:
        kind = FaultKind(data[0]) if message.name == "Fault" else Kind(data[0])
    except ValueError:
        return Result.BAD_KIND
    if (message.name == "Stop") != (kind is Kind.STOP):
        return Result.BAD_KIND
    raw = message.decode(data)
    fields = _SIGNALS.get(kind.name.lower(), {})
    turned = [each for each in fields.values() if each.full_turn and raw[each.name] >= each.full_turn]
    if turned or any(raw[name] for name in raw if name.startswith("reserved")):
        return Result.RESERVED_BITS
    if not 1 <= (data[1] - last_counter) % 256 <= AHEAD:
        return Result.STALE_COUNTER
    if isinstance(kind, FaultKind):
        request = fault_request(message, raw)
        return Result.OUT_OF_RANGE if request is None else Command(kind, data[1], request)
    # Rounded to the steps of the wire, so that 0.1 N x 800 is 80 N.
    values = {field: round(raw[each.name] * each.scale, 6) for field, each in fields.items()}
    return Command(kind, data[1], values)
