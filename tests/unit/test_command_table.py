"""The table of scene commands: missing parts of an entry are reported here, and every list of commands follows
from it.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator
from dataclasses import fields
from itertools import combinations
from typing import Annotated, Any, get_args

import pytest
from pydantic import Field, FiniteFloat

from drivers.can.devices import DeviceKind
from drivers.can.faults import FaultKind
from drivers.can.signals import CommandKind, EventKind, command_frame, default_messages, parse_command
from drivers.can.signals import Field as CanFieldNumber
from drivers.console import Console
from drivers.instruments.twins import TWINS
from recorder.output.trigger import EVENT_NAMES
from replays.campaigns.files.expectation import EventName
from replays.recordings.identification.request import fit_unit
from rig.base.errors import InputError
from rig.cli import app
from rig.run import commands
from rig.run.commands import channel, mechanical
from rig.run.commands.command import CanField, CanFrame, Quantity, SceneCommand
from rig.run.commands.table import COMMANDS, EVENT_KINDS, MECHANICAL, TRIGGERS
from rig.run.simulation import Simulation
from rig.serve import service
from tests.generated import missing_in_generated_files

_VALUE_BITS = 32
"""Bits of the fields in the frame of a command."""


def find_missing(name: str, entry: type[SceneCommand]) -> Iterator[str]:
    """Yield the missing parts of an entry, each in one line that names its place."""
    where = f"{entry.__module__.replace('.', '/')}.py"
    if entry.model_fields["command"].default != name:
        yield f'{where}: the field `command` must be Literal["{name}"] = "{name}"'
    if not (entry.__doc__ or "").strip() or entry.__doc__ == SceneCommand.__doc__:
        yield f"{where}: {entry.__name__} has no docstring"
    if not entry.is_implemented():
        yield f"{where}: nothing carries it out in the simulation: take_effect is missing"
    if name not in commands.SUMMARIES:
        yield f'rig/run/commands/__init__.py: SUMMARIES has no line of help for "{name}" (empty: no command line)'
    if not hasattr(entry, "CAN"):
        yield f"{where}: CAN = CanFrame(kind, event=...) is missing: no CAN kind and no CAN event"
    else:
        owner = {other.CAN.event: key for key, other in COMMANDS.items() if key != name and hasattr(other, "CAN")}
        owner |= {int(kind): kind.name.lower() for kind in EventKind if kind.name.lower() not in COMMANDS}
        if entry.CAN.event in owner or not 0 < entry.CAN.event < 256:
            free = next(number for number in range(1, 256) if number not in owner)
            holder = f"taken by {owner[entry.CAN.event]}" if entry.CAN.event in owner else "not 1 to 255"
            yield f"{where}: CAN event {entry.CAN.event} of {name} is {holder}; {free} is free"
        kinds = {
            key: other.CAN.kind for key, other in COMMANDS.items()
            if key != name and getattr(other, "CAN", entry.CAN).message == entry.CAN.message and hasattr(other, "CAN")
        }  # fmt: skip
        kinds["stop"] = int(CommandKind.STOP)
        near = sorted(key for key, kind in kinds.items() if (kind ^ entry.CAN.kind).bit_count() < 4)
        if near:
            good = (k for k in range(1, 256) if all((k ^ other).bit_count() >= 4 for other in kinds.values()))
            yield (f"{where}: CAN kind {entry.CAN.kind:#04x} of {name} differs from that of {', '.join(near)} in fewer "
                   f"than four bits; {next(good):#04x} is free")  # fmt: skip
        if entry.CAN.shown and not entry.SHOWN_FIELD:
            yield f"{where}: SHOWN_FIELD is missing: the CAN event has a description of its value, and no value"
    if not entry.MECHANICAL:
        return
    if entry.SHOWN_FIELD and entry.SHOWN_FIELD not in entry.model_fields:
        yield f"{where}: SHOWN_FIELD is {entry.SHOWN_FIELD}, which is no field of the command"
    bits = 0
    numbers = {each.can.number: (key, field) for key, other in COMMANDS.items() if key != name
               for field, (each, *_) in other.quantities().items() if each.can is not None}  # fmt: skip
    for field in entry.model_fields.keys() - {"command"}:
        known = entry.quantities().get(field)
        if known is None:
            yield f"{where}: field {field} has no Quantity: no unit, no help and no CAN signal"
            continue
        quantity = known.quantity
        for part in ("unit", "help"):
            if not getattr(quantity, part):
                yield f"{where}: field {field} has no {part}"
        if not math.isfinite(known.low):
            yield f"{where}: field {field} has no least value: Field(ge=...) or the Quantity's span is missing"
        if quantity.can is None:
            yield f"{where}: field {field} has no CAN signal (can=CanField(...))"
            continue
        bits += quantity.can.bits
        if quantity.can.number in numbers or not 0 < quantity.can.number < 16:
            used = numbers.get(quantity.can.number)
            free = next((number for number in range(1, 16) if number not in numbers), "none")
            holder = f"that of {used[1]} of {used[0]}" if used else "not 1 to 15"
            yield f"{where}: CAN number {quantity.can.number} of field {field} is {holder}; {free} is free"
        largest = ((1 << quantity.can.bits) - 1) * quantity.can.scale
        if not known.takes_text and largest < known.high < math.inf:
            yield f"{where}: the largest {field}, {known.high:g}, does not fit into its CAN signal"
        if -math.inf < known.low < 0.0 and not quantity.can.full_turn:
            yield f"{where}: field {field} can be negative, and its CAN signal cannot"
    if bits > _VALUE_BITS:
        yield f"{where}: the CAN signals have {bits} bits, and a frame has room for {_VALUE_BITS}"


def test_all_entries_are_complete() -> None:
    missing = [line for name, entry in COMMANDS.items() for line in find_missing(name, entry)]
    if missing:
        pytest.fail("\n".join(missing), pytrace=False)


def test_the_generated_files_have_every_command() -> None:
    if missing := [*missing_in_generated_files()]:
        pytest.fail("\n".join(missing), pytrace=False)


def test_every_class_has_a_line_of_help_and_every_line_a_class() -> None:
    classes = {
        each.__name__ for module in (mechanical, channel) for each in vars(module).values()
        if inspect.isclass(each) and issubclass(each, SceneCommand) and each.__name__.endswith("Command")
    }  # fmt: skip
    classes -= {"SceneCommand", "_ChannelCommand"}
    named = {f"{name.capitalize()}Command" for name in commands.SUMMARIES}
    missing = [f"rig/run/commands/__init__.py: SUMMARIES has no line for {each}" for each in classes - named]
    missing += [f"rig/run/commands/mechanical.py: class {each} of SUMMARIES is missing" for each in named - classes]
    if missing:
        pytest.fail("\n".join(missing), pytrace=False)
    assert list(COMMANDS) == list(commands.SUMMARIES)


class TiltCommand(SceneCommand):
    """An incomplete entry; each case below omits a part."""


FORCE = Quantity("N", "Force, in N.", CanField("tilt", 15, 16, 0.1, "Force"))
FIELD = Annotated[FiniteFloat, Field(ge=0.0, le=10.0), FORCE]
EVENT = max(EventKind) + 1
KIND = next(kind for kind in range(256) if all((kind ^ other).bit_count() >= 4 for other in CommandKind))
FREE_CAN_NUMBER = next(number for number in range(1, 16) if number not in {
    each.quantity.can.number for entry in COMMANDS.values() for each in entry.quantities().values() if each.quantity.can
})  # fmt: skip
WHOLE: dict[str, Any] = {
    "__doc__": "Tilt the foundation.", "CAN": CanFrame(KIND, event=EVENT),
    "take_effect": lambda self, run: [{}],
}  # fmt: skip


def half(field: Any = FIELD, name: str = "tilt", **parts: Any) -> Any:
    given = {key: value for key, value in {**WHOLE, **parts}.items() if value is not None}
    hints = {"command": str, "force_n": field}
    return type("TiltCommand", (SceneCommand,), {**given, "__annotations__": hints, "command": name, "force_n": 1.0,
                                                 "__module__": __name__})  # fmt: skip


def sized(**quantity: Any) -> Any:
    found = {each.name: getattr(FORCE, each.name) for each in fields(Quantity)} | quantity
    return Annotated[FiniteFloat, Field(ge=0.0, le=10.0), Quantity(**found)]


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (half(name="title"), "the field `command` must be"),
        (half(__doc__=None), "has no docstring"),
        (half(take_effect=None), "nothing carries it out in the simulation: take_effect is missing"),
        (half(CAN=None), "no CAN kind and no CAN event"),
        (half(CAN=CanFrame(KIND, event=3)), "CAN event 3 of tilt is taken by hammer; "),
        (half(CAN=CanFrame(KIND, event=10)), "CAN event 10 of tilt is taken by device; "),
        (
            half(CAN=CanFrame(CommandKind.HAMMER ^ 1, event=EVENT)),
            "of tilt differs from that of hammer in fewer than four bits; 0x",
        ),
        (half(CAN=CanFrame(KIND, event=EVENT, shown="tilt, deg")), "SHOWN_FIELD is missing"),
        (half(SHOWN_FIELD="force"), "SHOWN_FIELD is force, which is no field"),
        (half(FiniteFloat), "field force_n has no Quantity"),
        (half(sized(unit="")), "field force_n has no unit"),
        (half(sized(help="")), "field force_n has no help"),
        (half(sized(can=None)), "field force_n has no CAN signal"),
        (
            half(sized(can=CanField("tilt", 1, 16, 0.1, ""))),
            f"CAN number 1 of field force_n is that of force_n of hammer; {FREE_CAN_NUMBER} is free",
        ),
        (half(sized(can=CanField("tilt", 15, 4, 0.1, ""))), "the largest force_n, 10, does not fit"),
        (half(sized(can=CanField("tilt", 15, 40, 0.1, ""))), "the CAN signals have 40 bits"),
        (half(Annotated[FiniteFloat, FORCE]), "field force_n has no least value"),
        (half(Annotated[FiniteFloat, Field(ge=-1.0), FORCE]), "field force_n can be negative"),
        (half(), "SUMMARIES has no line of help"),
    ],
)
def test_an_incomplete_entry_is_reported_with_the_missing_part(entry: Any, words: str) -> None:
    found = [line for line in find_missing("tilt", entry) if ("SUMMARIES" in line) == ("SUMMARIES" in words)]
    assert words in " ".join(found)
    assert len(found) == 1 or all("CAN kind" in line for line in found)  # two commands share the number


def make_request(entry: type[SceneCommand]) -> dict[str, Any]:
    """Return fields of a command that a rig accepts."""
    needed = {field: max(each.low, 1.0) for field, each in entry.quantities().items() if each.required}
    return {"channel": "disk_x", "kind": "gain", "factor": 2.0} if "channel" in entry.model_fields else needed


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_takes_effect_with_an_event_of_its_name(name: str) -> None:
    run = Simulation("stable-run")
    command = COMMANDS[name](**make_request(COMMANDS[name]))
    assert command.command == name
    before = command.check(run, [])
    assert isinstance(before, dict)
    (event, *_) = command.take_effect(run)
    assert isinstance(event, dict)
    assert "event" not in event  # the simulation gives it the command's name


def test_every_list_of_commands_follows() -> None:
    names = set(COMMANDS)
    assert names <= set(service.COMMANDS)
    assert names <= set(EVENT_KINDS) <= set(get_args(EventName))
    assert set(get_args(EventName)) == {*EVENT_KINDS, *service.REPLAY_COMMANDS}
    assert names | {"stop"} == {kind.name.lower() for kind in (*CommandKind, *FaultKind)}
    assert {kind.name.lower() for kind in EventKind} - {"other"} == set(EVENT_KINDS) - {"note"}
    assert set(TRIGGERS) == set(EVENT_NAMES) - {"note", "warning"}
    (trigger,) = (each for each in app.rig().get_command(None, "record").params if each.name == "trigger")
    assert f"({', '.join(EVENT_NAMES)})" in trigger.help
    assert {"hammer", "speed", "release"} <= set(MECHANICAL)
    assert not {"fault", "clear"} & set(MECHANICAL)
    listed = {name: line for group in app.COMMANDS.values() for name, line in group.items()}
    assert {name: line for name, line in commands.SUMMARIES.items() if line}.items() <= listed.items()
    assert all(fit_unit(f"{name}.1.{field}") for name in COMMANDS for field in COMMANDS[name].quantities())
    assert [each.name for each in CanFieldNumber][:5] == ["NONE", "FORCE", "DURATION", "DIRECTION", "SPEED"]


@pytest.mark.parametrize("name", COMMANDS)
def test_the_console_has_each_command_with_the_fields_of_the_table(name: str) -> None:
    quantities = COMMANDS[name].quantities()
    given = inspect.signature(getattr(Console, name)).parameters
    typed = {field: each for field, each in given.items() if field in quantities}
    assert name == "speed" or set(typed) in (set(quantities), set())  # speed calls its one field hz
    assert all(each.default == quantities[field].default for field, each in typed.items())
    requests: list[tuple[str, bytes]] = []

    class Rig:
        rig = None

        def request(self, key: str, payload: bytes, **_: Any) -> bytes:
            requests.append((key, payload))
            return b'{"accepted": true, "id": 1, "tick": 0, "time_s": 0.0}'

    Console(Rig()).send(name, **make_request(COMMANDS[name]))
    assert requests[0][0] == f"rig/command/{name}"


@pytest.mark.parametrize("name", MECHANICAL)
def test_a_command_survives_its_can_frame(name: str) -> None:
    quantities = COMMANDS[name].quantities()
    values = {field: max(1.0, each.low) for field, each in quantities.items() if not each.takes_text}
    words = {field: "y" for field, each in quantities.items() if each.takes_text}
    found = parse_command(*command_frame(CommandKind[name.upper()], 7, **values, **words), 6)
    degrees = {field: quantities[field].quantity.can.words["y"] for field in words}
    assert found.kind is CommandKind[name.upper()]
    assert found.values == pytest.approx({**values, **degrees})
    for field in words:
        with pytest.raises(InputError, match=f"{field} must be x, y, -x, -y, or an angle; received 'z'"):
            command_frame(CommandKind[name.upper()], 7, **values, **{field: "z"})


def test_all_bits_of_a_can_frame_belong_to_one_signal_of_each_kind() -> None:
    message = default_messages().by_name["Command"]
    for kind in {int(kind) for kind in CommandKind} - {int(CommandKind.STOP)}:
        bits = [bit for signal in message.signals if not signal.selected_by or kind in signal.selected_by
                for bit in range(signal.start, signal.start + signal.bits)]  # fmt: skip
        assert sorted(bits) == list(range(64))
    for kinds in (CommandKind, FaultKind, DeviceKind):
        assert min((one ^ other).bit_count() for one, other in combinations(kinds, 2)) >= 4


def test_requests_to_instruments_have_the_fields_of_commands() -> None:
    commands = {command for twin in TWINS for command in twin.CODEC.commands}
    assert {"hammer", "speed", "release"} <= {command.COMMAND for command in commands} <= set(MECHANICAL)
    for command in commands:
        assert {each.name for each in fields(command)} == set(COMMANDS[command.COMMAND].quantities()), command
