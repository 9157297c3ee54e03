"""Drawing of a recording on a canvas."""

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

MAX_ROWS_PER_S = 2000.0
"""Largest number of points per second of one curve."""
MAX_ROWS = 60_000
"""Largest number of points of one curve, for any length of file; full rate around hammer pulses is additional."""
MAX_FRAMES = 6_000
"""Largest number of orbit and rotor frames: 25 Hz up to four minutes, fewer per second in longer files."""
_FRAMES_PER_FLUSH = 100


@dataclass(frozen=True, slots=True)
class Painted:
    """Result of drawing a file.

    Attributes:
        start_s: Time of the first row [s].
        end_s: Time of the last row [s].
        last_contact_s: Last instant of sensed contact [s]; None without contact.
        points: Number of curve values drawn.
    """

    start_s: float
    end_s: float
    last_contact_s: float | None
    points: int


def rows_per_s(duration_s: float) -> float:
    """Return the points of a curve per second [Hz] for a file of a length [s]."""
    return min(MAX_ROWS_PER_S, MAX_ROWS / max(duration_s, 1e-3))


def frame_s(duration_s: float) -> float:
    """Return the time between two frames [s] for a file of a length [s]."""
    return max(FRAME_S, duration_s / MAX_FRAMES)


def paint(recording: Recording, canvas: Canvas) -> Painted:
    """Draw a whole recording."""
    for simulated_s, wall_s in recording.clock:
        canvas.clock.mark(float(simulated_s), float(wall_s))
    # Hammer pulses determine where the other curves keep their full rate, so draw the hammer first.
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
            if count % _FRAMES_PER_FLUSH == 0:
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
        hold_s=0.0,
        frame_s=frame_s(duration_s),
    )
    for event in recording.events:
        painter.add_event(event)
    return painter


def _in_order(samples: Samples) -> tuple[np.ndarray, np.ndarray]:
    """Return times and values sorted by row number without duplicates; recovered blocks may be recorded late."""
    if np.all(np.diff(samples.index) > 0):
        return samples.times_s, samples.values
    _, order = np.unique(samples.index, return_index=True)
    return samples.times_s[order], samples.values[order]


def _frames(times_s: np.ndarray, rate_hz: float, *, rows: int) -> Iterator[slice]:
    """Yield slices of one frame each, split where rows are missing."""
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
