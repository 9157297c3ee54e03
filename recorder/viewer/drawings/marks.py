"""Faults and commands on the timeline: a lane for what is done to the rig, and one for whatever misbehaves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import rerun as rr

from recorder.viewer.canvas import Canvas
from rig.base.text import printable
from rig.run.commands.table import COMMANDS, MECHANICAL

ROOT = "/marks"
_DONE = {name: COMMANDS[name].SHOWN_FIELD for name in MECHANICAL}
"""Commands that are marked, each with the field that says most."""
_SHOWN_S = 0.05
"""How long a mark of a command is [s]."""
_MOST = 40
"""Lanes."""
_SOUND = "sound"


class Marks:
    """Lanes of what is done and of what misbehaves, from begin to end."""

    def __init__(self, canvas: Canvas) -> None:
        self._canvas = canvas
        self._faults: dict[str, dict[int, str]] = {}
        """Kinds of the faults of each lane, by their number."""

    def take(self, event: Mapping[str, Any], time_s: float) -> None:
        """Take an event of the stream."""
        name, numbers = event.get("event"), event.get("fault")
        if name in _DONE:
            said = event.get(_DONE[name])
            self._draw("commands", time_s, f"{name} {said:g}" if isinstance(said, float | int) else str(name))
            self._draw("commands", time_s + _SHOWN_S, "-")
        elif name == "fault" and isinstance(numbers, int) and isinstance(what := event.get("what"), dict):
            lane = printable(str(event.get("channel")), 40).replace("/", " ")
            if lane in self._faults or len(self._faults) < _MOST:
                self._faults.setdefault(lane, {})[numbers] = printable(str(what.get("kind")), 40)
                self._show(lane, time_s)
        elif name == "clear" and isinstance(numbers, list):
            for lane, faults in self._faults.items():
                if gone := [number for number in faults if number in numbers]:
                    for number in gone:
                        del faults[number]
                    self._show(lane, time_s)

    def _show(self, lane: str, time_s: float) -> None:
        self._draw(f"faults/{lane}", time_s, " + ".join(self._faults[lane].values()) or _SOUND)

    def _draw(self, lane: str, time_s: float, state: str) -> None:
        self._canvas.draw(f"{ROOT}/{lane}", time_s, rr.StateChange(state=state))
