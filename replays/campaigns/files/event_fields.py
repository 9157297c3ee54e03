"""Fields of events by event, from the tables of commands and requests, and the check of `where` before anything runs.

A misspelt field or a value of another type never occurs in an event: an expectation that an event must not appear would
then always pass.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import chain
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, TypeAdapter, ValidationError

from rig.base.checks import Count, input_error
from rig.base.errors import InputError, UnknownNameError, such_as
from rig.channels.faults import KINDS
from rig.run.commands.table import COMMANDS, SERVICE_COMMANDS
from rig.serve.request_handler import REQUESTS, JoinRequest, NoteRequest
from rig.serve.service import REPLAY_COMMANDS

if TYPE_CHECKING:
    from replays.campaigns.files.expectation import EventOf

_Fields = Iterator[tuple[str, Any]]
_DEVICE_COMMANDS = ("note", "join", "done", "leave")
"""Commands that have another event than `command`, or none."""
_ANY_EVENT = {"tick": Count, "time_s": float, "wall_s": float}
_EFFECTS: dict[str, dict[str, Any]] = {
    "fault": {"fault": int, "channels": list[str], "first_row": dict[str, int]},
    "clear": {"fault": list[int], "channels": list[str], "first_row": dict[str, int], "id": int | None},
}
"""Fields that commands of channels add to those of the request."""
_CHANNEL_FIELDS = ("channel", "channels", "source", "other")
"""Last part of the names of fields that hold channels or groups."""


def _one_of(names: Collection[str]) -> Any:
    def check_name(text: str) -> str:
        if text not in names:
            raise ValueError(such_as("one of the known names", text, names))
        return text

    return Annotated[str, AfterValidator(check_name)]


def _get_types(model: type[BaseModel], prefix: str = "") -> _Fields:
    for name, info in model.model_fields.items():
        kind: Any = info.annotation
        yield f"{prefix}{name}", Annotated[kind, info]


def _command_fields(command: str, kind: object, prefix: str, kind_prefix: str) -> _Fields:
    """Yield the fields of a request; those of a fault's kind, or of all kinds, have a prefix of their own."""
    if command not in COMMANDS:
        yield from _get_types(REQUESTS[command], prefix)
        return
    hidden = {f"{prefix}command", f"{prefix}what", f"{kind_prefix}kind"}
    types = _get_types(COMMANDS[command], prefix)
    if command == "fault":
        yield f"{kind_prefix}kind", _one_of(KINDS)
        kinds = [KINDS[kind]] if isinstance(kind, str) and kind in KINDS else KINDS.values()
        types = chain(types, *(_get_types(each, kind_prefix) for each in kinds))
    yield from ((name, kind) for name, kind in types if name not in hidden)


def _event_fields(event: str, where: Mapping[str, Any]) -> _Fields:
    yield from _ANY_EVENT.items()
    if event in COMMANDS:
        effect = _EFFECTS.get(event, {})
        own = _command_fields(event, where.get("what.kind"), "", "what.")
        yield from ((name, kind) for name, kind in own if name not in effect)
        yield from effect.items()
    elif event == "command":
        known = [name for name in (*COMMANDS, *SERVICE_COMMANDS, *REPLAY_COMMANDS) if name not in _DEVICE_COMMANDS]
        yield from {"id": int, "command": _one_of(known), "from": str}.items()
        for name in [where["command"]] if where.get("command") in known else known:
            yield from _command_fields(name, where.get("request.kind"), "request.", "request.")
    elif event == "note":
        yield from {"id": int, "from": str}.items()
        yield from _get_types(NoteRequest)
    elif event == "device":
        yield from {"state": Literal["joined", "left", "lost"], "reason": str, "from": str}.items()
        yield from _get_types(JoinRequest)
    elif event == "start":
        yield from {"scene": str, "seed": int, "pace": str}.items()
    elif event == "warning":
        yield "text", str
        yield from _command_fields("hammer", None, "", "")  # a pulse that found the hammer in a pulse
    elif event == "end":
        yield from {"reason": str, "rows": dict[str, int]}.items()


def find_fields(event: str, where: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Return the types of an event's fields by dotted name; a command or kind in `where` selects its own fields."""
    found = defaultdict(list)
    for name, kind in _event_fields(event, where):
        found[name].append(kind)
    return dict(found)


def check_event(selector: EventOf, channels: Iterable[str], *, field: str) -> None:
    """Raise an error for a selector that no event can match.

    Args:
        selector: The selector.
        channels: Channels and groups that exist.
        field: Name of the selector in errors.

    Raises:
        InputError: A field is unknown for the event, or its value is impossible.
    """
    fields = find_fields(selector.event, selector.where)
    if selector.text and "text" not in fields:
        raise InputError(f"{field}.text", f"left out, as {selector.event} has no text", selector.text)
    if selector.text.strip() and (error := _find_error(fields["text"][0], selector.text.strip(), f"{field}.text")):
        raise error
    for name, value in selector.where.items():
        place, table = f"{field}.where.{name}", name.rpartition(".")[0]
        if name not in fields and dict[str, int] not in fields.get(table, ()):
            raise UnknownNameError(place, f"a field of the event {selector.event}", name, fields)
        errors = [_find_error(kind, value, place) for kind in fields.get(name, [int])]
        if all(errors):
            raise next(filter(None, errors))
        if name.rpartition(".")[2] in _CHANNEL_FIELDS:
            for channel in value if isinstance(value, list) else [value]:
                if channel not in (known := list(channels)):
                    raise UnknownNameError(place, "a channel or a group", channel, known)


def _find_error(kind: Any, value: Any, place: str) -> InputError | None:
    adapter = TypeAdapter(kind, config=ConfigDict(strict=True, allow_inf_nan=False))
    try:
        adapter.validate_python(value)
    except ValidationError as error:
        try:  # an element of a list
            adapter.validate_python([value])
        except ValidationError:
            return input_error(error, place, BaseModel)
    return None
