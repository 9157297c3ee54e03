"""A picture of the signals of a log, for who has to say what they are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from replays.recordings.formats.guessing.guess import Guess
from replays.report.canvas import BLACK, BLUE, RED, house_style, label_of, new_figure, save

_HEIGHT = 1.15
"""Of a row [inch]."""
_MOST = 40
"""Signals that one picture shows."""
_CLOSE_S = 0.3
"""Length of what is shown close up [s], but at least so many samples:"""
_FEW = 60
_STRETCHES = 1000
"""Of time, into which a long signal is divided."""
_COLOURS = {"sure": BLUE, "likely": BLUE, "ask": RED}


@house_style()
def draw(guesses: Sequence[Guess], path: Path) -> None:
    """Draw each signal, whole and close up where it moves most, with what it is taken for; red: to be asked.

    Raises:
        InputError: The file is neither .png nor .svg.
    """
    shown = guesses[:_MOST]
    figure = new_figure(0.6 + _HEIGHT * len(shown), "Signals, whole and close up, and what they are taken for")
    axes = figure.subplots(len(shown), 2, squeeze=False, width_ratios=(2, 1))
    zero_s = min(guess.look.axis.first_s for guess in shown)
    end_s = max(guess.look.axis.last_s for guess in shown) - zero_s
    for (whole, close), guess in zip(axes, shown, strict=True):
        times, values = guess.look.axis.instants() - zero_s, guess.look.values
        colour = _COLOURS.get(guess.sure, BLACK)
        whole.plot(*course(times, values), color=colour, lw=0.9)
        length = min(len(values), max(_FEW, round(_CLOSE_S * guess.look.axis.rate_hz)))
        starts = np.arange(0, len(values) - length + 1, max(1, length // 2))
        start = max(
            starts.tolist(), key=lambda at, values=values, length=length: float(np.ptp(values[at : at + length]))
        )
        part = slice(start, start + length)
        close.plot(times[part], values[part], color=colour, lw=0.9)
        taken = f"{guess.channel} ({guess.sure})" if guess.channel else "a channel of its own"
        whole.set_title(f"{label_of(guess.entry.name, guess.entry.unit or 'no unit')} \N{RIGHTWARDS ARROW} {taken}")
        whole.set_xlim(0.0, end_s)
        whole.tick_params(labelbottom=whole is axes[-1, 0])
    for ax in axes[-1]:
        ax.set_xlabel("time from the first sample [s]")
    save(figure, path)


def course(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest of as many stretches as there is room for, in turn: what a line of all samples shows."""
    if len(values) <= 2 * _STRETCHES:
        return times, values
    starts = np.linspace(0, len(values), _STRETCHES, endpoint=False).astype(int)
    extremes = np.stack([np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)], axis=1)
    return np.repeat(times[starts], 2), extremes.ravel()
