"""Two-sided (full) spectrum of x + j y, and its waterfall: forward at positive, backward at negative frequencies."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import rerun as rr

from recorder.viewer.canvas import Canvas, pixels
from recorder.viewer.drawings.history import History
from recorder.viewer.drawings.whirl import BACKWARD_RGB, FORWARD_RGB
from rig.channels.orbit import SPECTRUM_HZ, full_spectrum

ROOT = "/spectrum"
BACKWARD = f"{ROOT}/now/backward"
FORWARD = f"{ROOT}/now/forward"
WATERFALL = f"{ROOT}/waterfall"

LIMIT_HZ = round(SPECTRUM_HZ)
WINDOW_S = 0.5
COLUMN_HZ = 2
"""Width of a waterfall column [Hz]: the resolution of the window."""
HEIGHT = 120
"""Rows of the waterfall's image."""
FLOOR_DB, CEILING_DB = 0.0, 62.0
"""Colour range [dB re 1 um]: 1 um to 1.26 mm."""
_MARKS_RGB = (150, 155, 165)


def limit_spectrum(z: np.ndarray, rate_hz: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the amplitude of each circular component of z about its centre, at whole hertz.

    See `rig.channels.orbit.full_spectrum`.

    Args:
        z: x + j y, shape (n,), n at most `rate_hz`.
        rate_hz: Samples per second [Hz].

    Returns:
        Frequencies -200 .. 200 [Hz] and amplitudes in the unit of z, both of shape (401,); 0 beyond half the rate.
    """
    frequencies = np.arange(-LIMIT_HZ, LIMIT_HZ + 1)
    _, lines = full_spectrum(np.real(z), np.imag(z), rate_hz, lines=rate_hz)
    amplitude = lines[(frequencies + rate_hz // 2) % rate_hz]
    amplitude[np.abs(frequencies) >= rate_hz / 2] = 0.0
    return frequencies, amplitude


class SpectrumPlot:
    """Spectrum of the last half second as bars, with separate colours for backward and forward, and its waterfall."""

    def __init__(self, canvas: Canvas, *, rate_hz: int, interval_s: float, whole: bool) -> None:
        self._canvas = canvas
        self._rate_hz = rate_hz
        self._interval_s = interval_s
        self._drawn_s = -math.inf
        self._history = History(capacity=math.ceil(WINDOW_S * rate_hz), dtype=complex)
        self._waterfall = Waterfall(canvas, whole=whole, interval_s=interval_s)
        for path, start, color in ((BACKWARD, -LIMIT_HZ, BACKWARD_RGB), (FORWARD, 1, FORWARD_RGB)):
            abscissa = np.arange(start, start + LIMIT_HZ, dtype=np.float32)
            chart = rr.BarChart(np.zeros(LIMIT_HZ, dtype=np.float32), abscissa=abscissa, color=color)
            # Abscissa and colour are static. Static bars would hide all later ones.
            static = [
                part
                for part in chart.as_component_batches()
                if part.component_descriptor() != chart.descriptor_values()
            ]
            canvas.fix(path, static)

    def add(self, z: np.ndarray) -> None:
        """Add rows of x + j y [mm], shape (n,)."""
        self._history.add(z)

    def interrupt(self) -> None:
        """Restart, because rows are missing; a spectrum across the gap would be wrong."""
        self._history.clear()
        self._drawn_s = -math.inf

    def draw(self, time_s: float) -> None:
        """Draw the spectrum of the half second that ends at a time [s].

        Draws nothing before half a second of data, or within the interval after the last spectrum.
        """
        z = self._history.last(math.ceil(WINDOW_S * self._rate_hz))
        if len(z) < math.ceil(WINDOW_S * self._rate_hz) or time_s - self._drawn_s < 0.9 * self._interval_s:
            return
        self._drawn_s = time_s
        _, amplitude = limit_spectrum(z, self._rate_hz)
        bars = amplitude.astype(np.float32)
        self._canvas.draw(BACKWARD, time_s, rr.BarChart(bars[:LIMIT_HZ]))
        self._canvas.draw(FORWARD, time_s, rr.BarChart(bars[LIMIT_HZ + 1 :]))
        self._waterfall.add(time_s, amplitude)

    def close(self) -> None:
        """Draw what requires the complete data."""
        self._waterfall.finish()


class Waterfall:
    """Spectra over time as one image of fixed height, newest at the top.

    For a file (`whole`) the image covers all of it and a line marks the current time; a live image covers the latest
    spectra.
    """

    def __init__(self, canvas: Canvas, *, whole: bool, interval_s: float) -> None:
        self._canvas = canvas
        self._whole = whole
        self._interval_s = interval_s
        self._rows: deque[np.ndarray] = deque(maxlen=None if whole else HEIGHT)
        self._times: deque[float] = deque(maxlen=None if whole else HEIGHT)
        self.columns = 2 * LIMIT_HZ // COLUMN_HZ + 1
        self._draw_axes()

    def _draw_axes(self) -> None:
        marks = range(-LIMIT_HZ, LIMIT_HZ + 1, 50)
        ticks = [[(self.x_of(hz), HEIGHT), (self.x_of(hz), HEIGHT + (5 if hz == 0 else 3))] for hz in marks]
        faint = pixels(0.6)
        self._canvas.fix(f"{WATERFALL}/ticks", rr.LineStrips2D(ticks, colors=[_MARKS_RGB], radii=faint, draw_order=2.0))
        named = {(self.x_of(hz), HEIGHT + 7.0): f"{hz:+d} Hz" if hz else "0" for hz in marks if hz % 100 == 0}
        self._canvas.write(f"{WATERFALL}/frequencies", named, [_MARKS_RGB])
        senses = {(self.x_of(-150), -14.0): "BACKWARD", (self.x_of(150), -14.0): "FORWARD"}
        self._canvas.write(f"{WATERFALL}/senses", senses, [BACKWARD_RGB, FORWARD_RGB])

    def x_of(self, frequency_hz: float) -> float:
        """Return the position of a frequency in the image [pixels]."""
        return (frequency_hz + LIMIT_HZ) / COLUMN_HZ + 0.5

    def add(self, time_s: float, amplitude_mm: np.ndarray) -> None:
        """Add a spectrum, shape (401,)."""
        around = np.pad(amplitude_mm, 1)
        widest = np.maximum(np.maximum(around[:-2], around[2:]), amplitude_mm)[::COLUMN_HZ]
        decibel = 20.0 * np.log10(np.maximum(widest * 1e3, 1e-6))
        # Live, spectra that were left out are filled with the next one, so that the image keeps its scale of time.
        passed = (time_s - self._times[-1]) / self._interval_s if self._times and not self._whole else 1.0
        rows = min(max(1, round(passed)), HEIGHT)
        self._rows.extend([np.clip(decibel, FLOOR_DB, CEILING_DB).round().astype(np.uint8)] * rows)
        self._times.extend([time_s] * rows)
        if self._whole:
            return
        self._draw_image(time_s, self.image())

    def image(self) -> np.ndarray:
        """Return levels [dB re 1 um], uint8, shape (HEIGHT, columns), newest row first; unused rows are 0."""
        rows = np.array(self._rows, dtype=np.uint8).reshape(-1, self.columns)
        if self._whole and len(rows):
            edges = np.linspace(0, len(rows), HEIGHT + 1)
            starts = np.minimum(edges[:-1].astype(int), len(rows) - 1)
            ends = np.maximum(np.ceil(edges[1:]).astype(int), starts + 1)
            rows = np.array([rows[start:end].max(axis=0) for start, end in zip(starts, ends, strict=True)])
        full = np.zeros((HEIGHT, self.columns), dtype=np.uint8)
        full[: len(rows)] = rows[::-1][:HEIGHT]
        return full

    def finish(self) -> None:
        """Draw the complete image of a file, its times, and the line at the current time; no effect on a live view."""
        if not self._whole or not self._times:
            return
        self._draw_image(None, self.image())
        start, end = self._times[0], self._times[-1]
        self._draw_times(f"{end:.1f} s", f"{start:.1f} s")
        for time in self._times:
            y = HEIGHT * (end - time) / (end - start) if end > start else 0.5
            line = [[(0.0, y), (float(self.columns), y)]]
            self._canvas.draw(
                f"{WATERFALL}/present",
                time,
                rr.LineStrips2D(line, colors=[(255, 255, 255)], radii=pixels(0.8), draw_order=3.0),
            )

    def _draw_image(self, time_s: float | None, image: np.ndarray) -> None:
        picture = rr.DepthImage(
            image, meter=1.0, colormap="inferno", depth_range=[FLOOR_DB, CEILING_DB], draw_order=0.0
        )
        if time_s is None:
            self._canvas.fix(f"{WATERFALL}/level", picture)
            return
        self._canvas.draw(f"{WATERFALL}/level", time_s, picture)
        if len(self._times) == 1:
            self._draw_times("now", f"-{HEIGHT * self._interval_s:.0f} s")

    def _draw_times(self, newest: str, oldest: str) -> None:
        self._canvas.write(f"{WATERFALL}/times", {(-17.0, 2.0): newest, (-17.0, HEIGHT - 10.0): oldest}, [_MARKS_RGB])
