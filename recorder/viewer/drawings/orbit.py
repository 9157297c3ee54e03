"""Orbits: the last few revolutions in a measuring plane, within its clearance circle.

The 2-D view counts y downward, so everything is drawn with -y: EAST is right, NORTH (up) is up, forward whirl turns
counter-clockwise on screen.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import rerun as rr

from recorder.viewer.canvas import Canvas, Place, pixels
from recorder.viewer.drawings.history import History
from recorder.viewer.drawings.whirl import Whirl, compute_whirl

ROOT = "/orbit"
PLANES = ("ring", "disk")

_REVOLUTIONS = 3.0
_MIN_SPAN_S = 0.02
_MAX_SPAN_S = 0.4
_WHIRL_SPAN_S = 0.33
"""Time over which sense and frequency are determined [s]: two revolutions at the usual spin speed."""
_POINTS = 144
_TAIL = 6
_CLEARANCE_RGB = (140, 146, 158)
_FAINT_RGB = (70, 74, 82)
_TEXT_RGB = (190, 195, 205)
_ARROW_RADIUS = 0.48
"""Radius of the round arrow, relative to the clearance."""


def screen(z: np.ndarray) -> np.ndarray:
    """Return the points of the 2-D view for x + j y, shape (n, 2), with y inverted."""
    return np.stack((np.real(z), -np.imag(z)), axis=-1)


def _to_points(words: dict[complex, str]) -> dict[Place, str]:
    return {(float(np.real(z)), float(-np.imag(z))): text for z, text in words.items()}


def get_display_span_s(whirl: Whirl) -> float:
    """Return the time span of an orbit [s]: a few revolutions of the whirl."""
    if whirl.sense == "none":
        return _MAX_SPAN_S
    return min(_MAX_SPAN_S, max(_MIN_SPAN_S, _REVOLUTIONS / abs(whirl.frequency_hz)))


class OrbitPlot:
    """Orbit of one measuring plane."""

    def __init__(self, canvas: Canvas, *, plane: str, clearance_mm: float, rate_hz: int) -> None:
        self._canvas = canvas
        self._rate_hz = rate_hz
        self._history = History(capacity=math.ceil(_MAX_SPAN_S * rate_hz), dtype=complex)
        self._path = f"{ROOT}/{plane}"
        self._clearance_mm = clearance_mm
        self._draw_frame(plane)

    def _draw_frame(self, plane: str) -> None:
        radius = self._clearance_mm
        circle = radius * np.exp(1j * np.linspace(0.0, 2.0 * math.pi, 181))
        reach = 1.15 * radius
        cross = [screen(np.array([-reach, reach], dtype=complex)), screen(np.array([-1j * reach, 1j * reach]))]
        self._canvas.fix(
            f"{self._path}/axes", rr.LineStrips2D(cross, colors=[_FAINT_RGB], radii=pixels(0.6), draw_order=1.0)
        )
        self._canvas.fix(
            f"{self._path}/clearance",
            rr.LineStrips2D([screen(circle)], colors=[_CLEARANCE_RGB], radii=pixels(3.5), draw_order=2.0),
        )
        at_ring = " (ring at rest)" if plane == "disk" else ""
        words = {
            1.48 * radius: "EAST +x",
            1.42j * radius: "UP +y",
            1.80j * radius: f"clearance {radius:.3f} mm{at_ring}",
        }
        self._canvas.write(f"{self._path}/words", _to_points(words), [_TEXT_RGB, _TEXT_RGB, _CLEARANCE_RGB])

    def add(self, z: np.ndarray) -> None:
        """Add rows of x + j y [mm], shape (n,)."""
        self._history.add(z)

    def interrupt(self) -> None:
        """Restart the orbit, because rows are missing."""
        self._history.clear()

    def draw(self, time_s: float) -> None:
        """Draw the orbit that ends at a time [s], with an arrow in its direction and a text for its sense."""
        whirl = compute_whirl(self._history.last(math.ceil(_WHIRL_SPAN_S * self._rate_hz)), self._rate_hz)
        z = self._history.last(math.ceil(get_display_span_s(whirl) * self._rate_hz))
        if len(z) < 2:
            return
        points = z[np.linspace(0, len(z) - 1, min(len(z), _POINTS)).round().astype(int)]
        color = np.array(whirl.color, dtype=float)
        # Older parts are darker, so that a still picture shows the direction.
        edges = np.linspace(0, len(points) - 1, _TAIL + 1).round().astype(int)
        strips = [screen(points[start : end + 1]) for start, end in itertools.pairwise(edges)]
        shades = [(color * (0.3 + 0.7 * (part + 1) / _TAIL)).astype(np.uint8) for part in range(_TAIL)]
        self._canvas.draw(
            f"{self._path}/trace", time_s, rr.LineStrips2D(strips, colors=shades, radii=pixels(1.5), draw_order=3.0)
        )
        self._canvas.draw(
            f"{self._path}/shaft",
            time_s,
            rr.Points2D(screen(points[-1:]), colors=[(255, 255, 255)], radii=pixels(5.0), draw_order=4.0),
        )
        self._draw_turn(time_s, complex(points[-1] - z.mean()), whirl)
        first, second = format_reading(whirl)
        at = -1.16j * self._clearance_mm
        words = _to_points({at: first, 1.31 * at: second})
        self._canvas.write(f"{self._path}/reading", words, [whirl.color], time_s=time_s)

    def _draw_turn(self, time_s: float, position: complex, whirl: Whirl) -> None:
        """Draw a round arrow in the centre that rotates with the whirl and ends at the shaft's direction."""
        path = f"{self._path}/turn"
        if whirl.sense == "none" or position == 0.0:
            self._canvas.draw(path, time_s, rr.LineStrips2D([]))
            return
        turn = 1.0 if whirl.sense == "forward" else -1.0
        radius = _ARROW_RADIUS * self._clearance_mm
        head = math.atan2(position.imag, position.real)
        arc = radius * np.exp(1j * (head - turn * np.linspace(1.4 * math.pi, 0.0, 40)))
        along = turn * 1j * np.exp(1j * head)
        outward = np.exp(1j * head)
        size = 0.17 * self._clearance_mm
        tip = arc[-1] + size * along
        barbs = [np.array([tip - size * along + side * 0.75 * size * outward, tip]) for side in (1.0, -1.0)]
        strips = [screen(arc), *(screen(barb) for barb in barbs), screen(np.array([arc[-1], tip]))]
        self._canvas.draw(
            path, time_s, rr.LineStrips2D(strips, colors=[whirl.color], radii=pixels(2.2), draw_order=3.5)
        )


def format_reading(whirl: Whirl) -> tuple[str, str]:
    """Return two lines that describe the orbit."""
    if whirl.sense == "none":
        return "no whirl", f"radius {whirl.radius_mm:.3f} mm"
    turn = "clockwise" if whirl.sense == "backward" else "counter-clockwise"
    return f"{whirl.sense.upper()} whirl {whirl.frequency_hz:+.1f} Hz", f"{turn}, radius {whirl.radius_mm:.3f} mm"
