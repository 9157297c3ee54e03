"""Picture of the signals of a log, for completing the mapping."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from replays.recordings.formats.guessing.guess import Guess
from replays.report.canvas import BLACK, BLUE, RED, axis_label, house_style, new_figure, save

_ROW_HEIGHT = 1.15
"""Height of a row [inch]."""
_MAX_SIGNALS = 40
"""Signals in one picture at most."""
_DETAIL_S = 0.3
"""Length of the detail view [s], and its minimum number of samples."""
_MIN_DETAIL_SAMPLES = 60
_INTERVALS = 1000
"""Intervals into which a long signal is divided for drawing."""
_COLOURS = {"sure": BLUE, "likely": BLUE, "open": RED}


@house_style()
def draw(guesses: Sequence[Guess], path: Path) -> None:
    """Draw each signal, whole and in the window where most signals move, with its guessed channel; red: to be checked.

    Raises:
        InputError: The file is neither .png nor .svg.
    """
    shown = guesses[:_MAX_SIGNALS]
    figure = new_figure(0.6 + _ROW_HEIGHT * len(shown), "Signals, whole and in detail, with their guessed channels")
    axes = figure.subplots(len(shown), 2, squeeze=False, width_ratios=(2, 1))
    zero_s = min(guess.features.axis.first_s for guess in shown)
    end_s = max(guess.features.axis.last_s for guess in shown) - zero_s
    window = _find_window([(guess.features.axis.instants() - zero_s, guess.features.values) for guess in shown], end_s)
    for (whole, close), guess in zip(axes, shown, strict=True):
        times, values = guess.features.axis.instants() - zero_s, guess.features.values
        colour = _COLOURS.get(guess.confidence, BLACK)
        whole.plot(*reduce_samples(times, values), color=colour, lw=0.9)
        part = slice(*np.searchsorted(times, window))
        close.plot(times[part], values[part], color=colour, lw=0.9)
        close.set_xlim(window)
        close.tick_params(labelbottom=whole is axes[-1, 0])
        target = f"{guess.channel} ({guess.confidence})" if guess.channel else "a channel of its own"
        whole.set_title(f"{axis_label(guess.entry.name, guess.entry.unit or 'no unit')} \N{RIGHTWARDS ARROW} {target}")
        whole.set_xlim(0.0, end_s)
        whole.tick_params(labelbottom=whole is axes[-1, 0])
    for ax in axes[-1]:
        ax.set_xlabel("time from the first sample [s]")
    save(figure, path)


def _find_window(signals: Sequence[tuple[np.ndarray, np.ndarray]], end_s: float) -> tuple[float, float]:
    """Return the window of the detail view in which the signals move most, each relative to its range [s]."""
    fastest_s = min(
        (float(times[-1] - times[0]) / (len(times) - 1) for times, _ in signals if len(times) > 1), default=0.0
    )
    length_s = min(end_s, max(_DETAIL_S, _MIN_DETAIL_SAMPLES * fastest_s))
    starts = np.arange(0.0, max(end_s - length_s, 1e-9), max(0.5 * length_s, 1e-9))
    moves = np.zeros(len(starts))
    for times, values in signals:
        size = float(np.nanmax(values) - np.nanmin(values)) if np.isfinite(values).any() else 0.0
        places = zip(*(np.searchsorted(times, starts + off_s) for off_s in (0.0, length_s)), strict=True)
        for n, (first, last) in enumerate(places):
            if size > 0.0 and np.isfinite(part := values[first:last]).any():
                moves[n] += float(np.nanmax(part) - np.nanmin(part)) / size
    start_s = float(starts[int(np.argmax(moves))])
    return start_s, start_s + length_s


def reduce_samples(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return minimum and maximum of each interval, alternating; a line through them looks like all samples."""
    if len(values) <= 2 * _INTERVALS:
        return times, values
    starts = np.linspace(0, len(values), _INTERVALS, endpoint=False).astype(int)
    extremes = np.stack([np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)], axis=1)
    return np.repeat(times[starts], 2), extremes.ravel()
