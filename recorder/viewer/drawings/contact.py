"""Contact of shaft and ring: as sensed by the probes and, on a separate path, as computed by the model."""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from recorder.viewer.canvas import Canvas
from rig.channels.table import Channel

SENSED = "/contact/sensed_by_ring_probes"
TRUTH = "/contact/truth_of_the_model"
TOUCH, FREE = "contact", "free"


def resolution_mm(channel: Channel) -> float:
    """Return the resolution of a probe [mm]: three standard deviations of noise and converter step."""
    step = channel.lsb_v / math.sqrt(12.0)
    return 3.0 * math.hypot(channel.noise_v, step) / abs(channel.sensitivity_v) * channel.si * 1e3


class Touch:
    """Contact state with hysteresis: on when a quantity reaches `enter`, off when it falls below `leave`."""

    def __init__(self, *, enter: float, leave: float) -> None:
        self._enter = enter
        self._leave = leave
        self.state: bool | None = None

    def changes(self, times_s: np.ndarray, quantity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the instants of change [s] and the new states (bool); the first known state counts as a change."""
        decided = np.where(quantity >= self._enter, 1, np.where(quantity < self._leave, 0, -1))
        decided_rows = np.flatnonzero(decided >= 0)
        before = self.state
        if not len(decided_rows):
            return times_s[:0], np.zeros(0, dtype=bool)
        states = decided[decided_rows].astype(bool)
        previous = np.concatenate(([not states[0] if before is None else before], states[:-1]))
        changed = states != previous
        self.state = bool(states[-1])
        return times_s[decided_rows][changed], states[changed]


class ContactPlot:
    """Lane of the contact view."""

    def __init__(self, canvas: Canvas, *, path: str, touch: Touch) -> None:
        self._canvas = canvas
        self._path = path
        self._touch = touch
        self._times: list[float] = []
        self._words: list[str] = []
        self.last_contact_s: float | None = None
        canvas.fix(
            path,
            rr.StateConfiguration(
                values=[TOUCH, FREE], labels=["contact", "free"], colors=[(240, 100, 75), (70, 78, 92)]
            ),
        )

    @property
    def touching(self) -> bool:
        """True if the last row was in contact."""
        return bool(self._touch.state)

    def add(self, times_s: np.ndarray, quantity: np.ndarray) -> None:
        """Add rows of the quantity that determines contact, shape (n,)."""
        times, states = self._touch.changes(times_s, quantity)
        if len(times_s) and self.touching:
            self.last_contact_s = float(times_s[-1])
        elif states[:-1].any():
            self.last_contact_s = float(times[-1])
        self._times += times.tolist()
        self._words += [TOUCH if state else FREE for state in states]

    def flush(self) -> None:
        """Draw the changes of state."""
        if self._times:
            self._canvas.plot(self._path, np.array(self._times), rr.StateChange.columns(state=self._words))
            self._times, self._words = [], []

    def interrupt(self) -> None:
        """Reset the state to unknown, because rows are missing."""
        self._touch.state = None
