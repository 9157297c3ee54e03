"""What happened during a recording, as other programs are told: impacts, commands and notes."""

from __future__ import annotations

from typing import Any, NamedTuple

from recorder.files.schemas import event_text
from recorder.reader import Recording
from rig.base.text import printable

_MOST_S = 1e12
"""Latest time that an event may have [s]."""


class ExportEvent(NamedTuple):
    """What happened during a recording.

    Attributes:
        time_s: Simulated time [s].
        name: `hammer`, `speed`, `note`, ...
        text: All of it in a line, for a person.
        document: The same as the rig told it.
    """

    time_s: float
    name: str
    text: str
    document: dict[str, Any]


def happenings(recording: Recording, from_s: float, to_s: float) -> tuple[ExportEvent, ...]:
    """The events of a range [s], in order; a command that took effect at once stands once, with who sent it."""
    low_s, high_s = max(from_s, 0.0), min(to_s, _MOST_S)
    told = [each for each in recording.events if each.get("time_s") is not None and low_s <= each["time_s"] <= high_s]
    effects = {(event.get("tick"), event["event"]) for event in told}
    sent = [event for event in told if event["event"] == "command"]
    senders = {(event["tick"], event["command"]): event.get("from") for event in sent}
    events = []
    for event in sorted(told, key=lambda event: event["time_s"]):
        if event["event"] == "command" and (event["tick"], event["command"]) in effects:
            continue
        sender = senders.get((event.get("tick"), event["event"]))
        whole = event if sender is None else {**event, "from": sender}
        text = printable(event_text(whole)[1])
        events.append(ExportEvent(float(event["time_s"]), printable(event["event"]), text, whole))
    return tuple(events)
