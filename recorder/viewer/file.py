"""A recorded file on a canvas."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from recorder.contents.samples import Samples
from recorder.reader import Recording
from recorder.viewer.canvas import Canvas
from recorder.viewer.drawings.geometry import Geometry
from recorder.viewer.painter import FRAME_S, Painter

MOST_ROWS_PER_S = 2000.0
MOST_ROWS = 60_000
"""Points of one curve, whatever the length of the file; full rate around hammer pulses comes on top."""
MOST_FRAMES = 6_000
"""Orbits and places of the rotor; 25 Hz up to four minutes, fewer in longer files."""
_FLUSH_EVERY = 100


@dataclass(frozen=True, slots=True)
class Painted:
    """What was drawn.

    Attributes:
        start_s: Time of the first row [s].
        end_s: Time of the last row [s].
        last_contact_s: Last instant of sensed contact [s], or None.
        points: Values of curves drawn.
    """

    start_s: float
    end_s: float
    last_contact_s: float | None
    points: int


def rows_per_s(duration_s: float) -> float:
    """Points of a curve per second [Hz] for a file of that length."""
    return min(MOST_ROWS_PER_S, MOST_ROWS / max(duration_s, 1e-3))


def frame_s(duration_s: float) -> float:
    """Time between two frames [s] for a file of that length."""
    return max(FRAME_S, duration_s / MOST_FRAMES)


def paint(recording: Recording, canvas: Canvas) -> Painted:
    """Draw a whole recording."""
    for simulated_s, wall_s in recording.clock:
        canvas.clock.mark(float(simulated_s), float(wall_s))
    # The hammer comes first: its pulses decide where the other curves keep their full rate.
    names = sorted(recording.table.groups, key=lambda name: name != "hammer")
    painter: Painter | None = None
    start_s, end_s = np.inf, -np.inf
    for name in names:
        samples = recording.samples(name)
        if not len(samples.times_s):
            continue
        times_s, values = _in_order(samples)
        start_s, end_s = min(start_s, float(times_s[0])), max(end_s, float(times_s[-1]))
        if painter is None:
            painter = _new_painter(recording, canvas, end_s - start_s)
        rows = max(1, round(frame_s(float(times_s[-1] - times_s[0])) * samples.rate_hz))
        for count, part in enumerate(_frames(times_s, samples.rate_hz, rows=rows)):
            painter.add(name, times_s[part], values[part])
            painter.frame(name)
            if count % _FLUSH_EVERY == 0:
                painter.flush()
    if painter is None:
        painter = _new_painter(recording, canvas, 0.0)
        start_s = end_s = 0.0
    _paint_truth(recording, painter)
    painter.close()
    return Painted(start_s=start_s, end_s=end_s, last_contact_s=painter.last_contact_s, points=painter.points)


def _new_painter(recording: Recording, canvas: Canvas, duration_s: float) -> Painter:
    geometry = Geometry.from_parameters(recording.parameters)
    painter = Painter(
        canvas,
        recording.table,
        geometry,
        rows_per_s=rows_per_s(duration_s),
        whole=True,
        held_s=0.0,
        frame_s=frame_s(duration_s),
    )
    for event in recording.events:
        painter.add_event(event)
    return painter


def _in_order(samples: Samples) -> tuple[np.ndarray, np.ndarray]:
    """Times and values in order and once each: a recorder may have taken a recovered block late."""
    if np.all(np.diff(samples.index) > 0):
        return samples.times_s, samples.values
    _, order = np.unique(samples.index, return_index=True)
    return samples.times_s[order], samples.values[order]


def _frames(times_s: np.ndarray, rate_hz: float, *, rows: int) -> Iterator[slice]:
    """Slices of one frame each, broken where rows are missing."""
    holes = np.flatnonzero(np.abs(np.diff(times_s) * rate_hz - 1.0) > 0.5) + 1
    edges = [0, *holes.tolist(), len(times_s)]
    for start, end in pairwise(edges):
        for at in range(start, end, rows):
            yield slice(at, min(at + rows, end))


def _paint_truth(recording: Recording, painter: Painter) -> None:
    if "contact" not in recording.catalogue.get("truth", {}):
        return
    table = recording.truth("contact")
    if "normal_force" in table.names and len(table.times_s):
        times_s, values = _in_order(table)
        painter.add_truth(times_s, values[:, table.names.index("normal_force")])
