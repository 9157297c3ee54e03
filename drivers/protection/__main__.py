"""Protect a rig: `python -m drivers.protection URL --alert-um 500 --danger-um 1500`; Ctrl-C ends it.

Prints one line for each action, with its simulated time. Each is also written to the stream as a note with the tag
`protection` and its kind, such as `danger` or `trip`, as a contact that other programs can read. A note of another
program is a contact of the monitor: see `take_input`.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Literal, get_args, get_origin

from drivers.protection.monitor import Action, Protection
from drivers.protection.settings import Settings
from rig.base.checks import check
from rig.base.errors import InputError, RefusedError
from rig.serve.transport import DEFAULT_ENDPOINT

_MAX_NOTE = 1000
"""Longest text of a note [characters]."""


def protect(machine: Any, protection: Protection, show: Callable[[str], object] = print) -> None:
    """Watch a rig to the end of its run.

    Args:
        machine: A `drivers.client.Rig` that reads the settings' channels.
        protection: The monitor.
        show: Called with each line.
    """
    for samples in machine.blocks():
        for event in _events(machine):
            if "protection" not in (tags := event.get("tags", ())):
                take_input(protection, tags, event.get("text", ""))
        act(machine, protection.settings, protection.feed(samples), show)


def take_input(protection: Protection, tags: Iterable[str], text: str) -> None:
    """Apply contacts: `reset`; `bypass` and `bypass-off` with a channel as text; `multiply` with 1 to 3 as text."""
    for tag in tags:
        if tag == "reset":
            protection.reset()
        elif tag == "bypass":
            protection.bypassed |= {text} & set(protection.settings.channels)
        elif tag == "bypass-off":
            protection.bypassed -= {text}
        elif tag == "multiply":
            with contextlib.suppress(ValueError):  # not a number: no change
                protection.multiply = factor if 1.0 <= (factor := float(text)) <= 3.0 else protection.multiply


def act(machine: Any, settings: Settings, actions: Iterable[Action], show: Callable[[str], object] = print) -> None:
    """Report the monitor's actions, then trip if one is a trip; a refused trip is reported too."""
    actions = list(actions)
    for action in actions:
        show(str(action))
        report(machine, str(action), action.kind, show)
    for trip in [action for action in actions if action.kind == "trip"]:
        try:
            if settings.trip == "stop":
                machine.stop()
            else:
                machine.speed(0.0)
        except RefusedError as error:
            show(line := f"{trip.time_s:.6f} s  trip-refused  {error}")
            report(machine, line, "trip-refused", show)


def report(machine: Any, line: str, kind: str, show: Callable[[str], object] = print) -> None:
    """Add a line to the stream as a note; a refusal is shown, and does not end the monitor."""
    try:
        machine.note(line[:_MAX_NOTE], tags=["protection", kind])
    except InputError as error:
        show(f"note refused: {error}")


def _events(machine: Any) -> list[dict[str, Any]]:
    """Return the events since the last call."""
    events = []
    try:
        while True:
            events.append(machine.event(lambda _: True, timeout_s=0.0))
    except TimeoutError:
        return events


def parse(arguments: Sequence[str]) -> tuple[str, Settings]:
    """Parse a command line into URL and settings; each setting is an option.

    Args:
        arguments: Command line without the program's name.

    Raises:
        InputError: A setting is out of range.
    """
    parser = argparse.ArgumentParser(
        prog="python -m drivers.protection", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("url", nargs="?", default="zenoh:" + DEFAULT_ENDPOINT)
    for name, field in Settings.model_fields.items():
        kind: Any = field.annotation
        option: dict[str, Any] = {"type": kind, "required": field.is_required()}
        if kind is bool:
            option = {"action": argparse.BooleanOptionalAction}
        elif get_origin(kind) is Literal:
            option = {"choices": get_args(kind)}
        elif get_origin(kind) is tuple:
            option = {"action": "append", "metavar": "CHANNEL"}
        parser.add_argument("--" + name.replace("_", "-"), default=argparse.SUPPRESS, **option)
    options = vars(parser.parse_args(arguments))
    return options.pop("url"), check(Settings, options, field="")


def main(arguments: Sequence[str] | None = None) -> None:
    """Protect the rig at a URL until its run ends, or Ctrl-C; exit status 2 for wrong input or a lost rig."""
    from drivers.client import connect

    try:
        url, settings = parse(sys.argv[1:] if arguments is None else arguments)
        with connect(url, channels=settings.channels, name="protection") as machine:
            show = partial(print, flush=True)
            show(f"Connected to {url}: {', '.join(settings.channels)}; Ctrl-C ends it")
            report(machine, f"protection of {settings.x}, {settings.y} started", "on", show)
            protect(machine, Protection(settings), show)
    except KeyboardInterrupt:
        return
    except (ConnectionError, TimeoutError, EOFError, InputError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
