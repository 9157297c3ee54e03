"""Events of a recording for other programs: impacts, commands and notes."""

from __future__ import annotations

from typing import Any, NamedTuple

from recorder.files.schemas import event_text
from recorder.reader import Recording
from rig.base.text import printable

_MAX_TIME_S = 1e12
"""Latest time of an event [s]."""


class ExportEvent(NamedTuple):
    """Event of a recording.

    Attributes:
        time_s: Simulated time [s].
        name: `hammer`, `speed`, `note`, ...
        text: Description in one line.
        document: Event as the rig sent it.
    """

    time_s: float
    name: str
    text: str
    document: dict[str, Any]


def list_events(recording: Recording, from_s: float, to_s: float) -> tuple[ExportEvent, ...]:
    """Return the events of a range [s] in order; a command that took effect at once appears once, with its sender."""
    low_s, high_s = max(from_s, 0.0), min(to_s, _MAX_TIME_S)
    timed = [each for each in recording.events if each.get("time_s") is not None and low_s <= each["time_s"] <= high_s]
    effects = {(event.get("tick"), event["event"]) for event in timed}
    sent = [event for event in timed if event["event"] == "command"]
    senders = {(event["tick"], event["command"]): event.get("from") for event in sent}
    events = []
    for event in sorted(timed, key=lambda event: event["time_s"]):
        if event["event"] == "command" and (event["tick"], event["command"]) in effects:
            continue
        sender = senders.get((event.get("tick"), event["event"]))
        whole = event if sender is None else {**event, "from": sender}
        text = printable(event_text(whole)[1])
        events.append(ExportEvent(float(event["time_s"]), printable(event["event"]), text, whole))
    return tuple(events)
