"""Commands and faults on the timeline: one lane for commands, and one for each faulty channel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import rerun as rr

from recorder.viewer.canvas import Canvas
from rig.base.text import printable
from rig.run.commands.table import COMMANDS, MECHANICAL

ROOT = "/marks"
_SHOWN_FIELD = {name: COMMANDS[name].SHOWN_FIELD for name in MECHANICAL}
"""Field shown for each marked command."""
_MARK_S = 0.05
"""Length of a command's mark [s]."""
_MAX_LANES = 40
"""Largest number of fault lanes."""
_NO_FAULT = "sound"


class Marks:
    """Lanes of commands and active faults."""

    def __init__(self, canvas: Canvas) -> None:
        self._canvas = canvas
        self._faults: dict[str, dict[int, str]] = {}
        """Fault kinds of each lane by fault number."""

    def take(self, event: Mapping[str, Any], time_s: float) -> None:
        """Draw an event."""
        name, numbers = event.get("event"), event.get("fault")
        if name in _SHOWN_FIELD:
            value = event.get(_SHOWN_FIELD[name])
            self._draw("commands", time_s, f"{name} {value:g}" if isinstance(value, float | int) else str(name))
            self._draw("commands", time_s + _MARK_S, "-")
        elif name == "fault" and isinstance(numbers, int) and isinstance(what := event.get("what"), dict):
            lane = printable(str(event.get("channel")), 40).replace("/", " ")
            if lane in self._faults or len(self._faults) < _MAX_LANES:
                self._faults.setdefault(lane, {})[numbers] = printable(str(what.get("kind")), 40)
                self._show(lane, time_s)
        elif name == "clear" and isinstance(numbers, list):
            for lane, faults in self._faults.items():
                if cleared := [number for number in faults if number in numbers]:
                    for number in cleared:
                        del faults[number]
                    self._show(lane, time_s)

    def _show(self, lane: str, time_s: float) -> None:
        self._draw(f"faults/{lane}", time_s, " + ".join(self._faults[lane].values()) or _NO_FAULT)

    def _draw(self, lane: str, time_s: float, state: str) -> None:
        self._canvas.draw(f"{ROOT}/{lane}", time_s, rr.StateChange(state=state))
