"""Campbell diagram: natural frequencies of the levitated shaft over the speed, and measured peaks."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from replays.estimate.spectra import parabola_top
from replays.plots.plot import Plot, Table, describe_title, kind, make_axes
from replays.plots.signals import Signals
from replays.plots.spectra import choose_window, read_spectra
from replays.report.canvas import BLACK, BLUE, ORANGE, RED
from rig.base.errors import InputError
from rig.physics.kernels import signals as S
from rig.physics.kernels.constants import Inputs
from rig.physics.kernels.laws.contact import FLIGHT
from rig.physics.model import Model

_COORDINATES = (S.GAMMA, S.BETA, S.GAMMA_RATE, S.BETA_RATE)
_INCREMENT = 1e-6
"""Half of the change of a coordinate in a central difference [rad, rad/s]; its error is 1e-6 of the largest rate."""
_SPEEDS = 81
"""Speeds of a curve."""
_MIN_PEAK, _MAX_PEAKS, _MAX_POINTS = 0.05, 3, 60
"""Amplitude of a measured peak relative to the largest of its spectrum, peaks per spectrum, and spectra drawn."""
_MODES = ("lower mode", "upper mode")
_NOTE = (
    "lines: model linearised at the equilibrium, |s|/2π; dots: critical speeds; hollow: backward; "
    "whirl: ±1 circle, 0 line"
)


class ShaftMode(NamedTuple):
    """Mode of the levitated shaft."""

    frequency: float  # |s| [rad/s]
    damping_ratio: float  # -Re s/|s| [1]
    whirl: float  # (forward - backward)/(forward + backward): 1 forward circle, 0 line, -1 backward circle


def linearise(model: Model, spin: float) -> np.ndarray:
    """Return A of z' = A z for deviations z = (Gamma, beta, Gamma', beta'), shape (4, 4).

    Args:
        model: The model.
        spin: Constant spin speed [rad/s].
    """
    from rig.physics.engines.common.method import rates

    inputs = Inputs(1e-6, 0.0, 1.0, 0.0, 0, 0, spin, 0.0, 0, True, True)
    columns = []
    for coordinate in _COORDINATES:
        sides = []
        for change in (_INCREMENT, -_INCREMENT):
            y, dy, out = model.state(spin=spin), np.zeros(S.N_VECTOR), np.zeros(S.N_OBSERVED)
            y[coordinate] += change
            rates(model.constants, inputs, 0, 0.0, 1.0, FLIGHT, True, y, dy, out)
            sides.append(dy[list(_COORDINATES)])
        columns.append((sides[0] - sides[1]) / (2.0 * _INCREMENT))
    return np.column_stack(columns)


def find_modes(model: Model, spin: float) -> list[ShaftMode]:
    """Return the modes of the levitated shaft at a spin speed [rad/s] that oscillate, by frequency."""
    poles, vectors = np.linalg.eig(linearise(model, spin))
    modes = []
    for pole, vector in zip(poles, vectors.T, strict=True):
        if pole.imag > 0.0:
            x, y = vector[1], -vector[0]
            forward, backward = abs(x + 1j * y), abs(x - 1j * y)
            whirl = (forward - backward) / (forward + backward)
            modes.append(ShaftMode(abs(pole), -pole.real / abs(pole), whirl))
    return sorted(modes)


@kind()
def campbell(signals: Signals, *, max_speed_hz: float | None = None, pair: str | None = None, axes: Any = None) -> Plot:
    """Draw the Campbell diagram of the levitated shaft, with the peaks of the measured spectra.

    Natural frequencies are those of the model of the run or recording, linearised at the equilibrium. A critical speed
    is the crossing of a natural frequency with 1X or 2X.

    Args:
        signals: The data, of a run or a recording of the rig.
        max_speed_hz: Largest speed drawn [Hz]; None for one above all critical speeds and the data.
        pair: Common part of the names of the probes with the measured peaks; None for the first pair.
        axes: Axes to draw on; None for a new figure.

    Returns:
        Axes and table: speed, and natural frequency, damping ratio and whirl of each mode (1 forward circle, 0 line, -1
        backward circle); then speed and measured peak, negative for backward whirl.

    Raises:
        InputError: The data are without a model, or the speed is invalid.
    """
    model = signals.require_model("campbell")
    if max_speed_hz is not None and not 0.0 < max_speed_hz < 1e4:
        raise InputError("max_speed_hz", "above 0 and below 10000", max_speed_hz)

    def compute(speed_hz: float) -> np.ndarray:
        modes = [*find_modes(model, 2.0 * math.pi * speed_hz)][: len(_MODES)]
        found = np.full((len(_MODES), 3), np.nan)
        found[: len(modes)] = np.reshape(modes, (-1, 3))
        return found * [1.0 / (2.0 * math.pi), 1.0, 1.0]

    peaks = _find_peaks(signals, pair) if signals.pairs else np.empty((0, 2))
    top_hz = max_speed_hz or max(1.6 * np.nanmax(compute(0.0)[:, 0], initial=1.0), 1.1 * peaks[:, 0].max(initial=0.0))
    speeds_hz = np.linspace(0.0, top_hz, _SPEEDS)
    modes = np.array([compute(each) for each in speeds_hz])
    (panel,) = make_axes(axes, 1, 1, height=5.6, title=describe_title(signals, "Campbell diagram"), note=_NOTE)
    for order, line in ((1, ":"), (2, "-.")):
        panel.plot(speeds_hz, order * speeds_hz, line, color=RED, lw=1.2, label=f"{order}X")
    columns = {"speed": ("Hz", np.r_[speeds_hz, peaks[:, 0]])}
    empty = np.full(len(peaks), np.nan)
    for at, (name, colour, line) in enumerate(zip(_MODES, (ORANGE, BLUE), ("--", "-"), strict=True)):
        frequency, damping, whirl = modes[:, at].T
        sense = "forward" if whirl[-1] > 0.0 else "backward"
        label = f"{name}, {sense} (whirl {whirl[-1]:.2f} at {top_hz:.0f} Hz)".replace("-", "−")
        panel.plot(speeds_hz, frequency, line, color=colour, lw=1.6, label=label)
        columns |= {
            f"{name}": ("Hz", np.r_[frequency, empty]),
            f"{name} damping ratio": ("1", np.r_[damping, empty]),
            f"{name} whirl": ("1", np.r_[whirl, empty]),
        }
        for order in (1, 2):
            critical_hz = _find_crossing(lambda speed: compute(speed)[at, 0] - order * speed, top_hz)  # noqa: B023
            if critical_hz is not None:
                panel.plot(
                    critical_hz, order * critical_hz, "o", ms=6, color=BLACK, mfc=BLACK if whirl[-1] > 0 else "w"
                )
                # The two modes are close to each other: one label on each side of the crossing.
                panel.annotate(
                    f"{critical_hz:.2f} Hz", (critical_hz, order * critical_hz), fontsize=9, textcoords="offset points",
                    xytext=(6, -12) if at == 0 else (-6, 8), ha="left" if at == 0 else "right",
                )  # fmt: skip
    highest = 1.8 * float(np.nanmax(modes[:, :, 0], initial=0.5 * top_hz))
    if above := int(np.sum(np.abs(peaks[:, 1]) > highest)):
        text = f"{above} measured peaks lie above"
        panel.set_title(text, loc="right", fontsize=8, fontweight="normal", color="0.35")
    for sign, marker, label in ((1.0, "^", "measured, forward"), (-1.0, "v", "measured, backward")):
        shown = peaks[(sign * peaks[:, 1] > 0.0) & (np.abs(peaks[:, 1]) <= highest)]
        if len(shown):
            face = BLACK if sign > 0.0 else "none"
            panel.plot(shown[:, 0], sign * shown[:, 1], marker, ms=4, color=BLACK, mfc=face, mew=0.7, label=label)
    columns["measured"] = ("Hz", np.r_[np.full(len(speeds_hz), np.nan), peaks[:, 1]])
    panel.set(xlabel="speed [Hz]", ylabel="frequency [Hz]", xlim=(0.0, top_hz), ylim=(0.0, highest))
    panel.legend(loc="lower right")
    return Plot((panel,), Table.from_columns(_NOTE, **columns))


def _find_crossing(excess: Any, top_hz: float) -> float | None:
    """Return the speed at which a frequency's excess over a multiple of the speed is 0 [Hz], or None."""
    from scipy.optimize import brentq

    if not (excess(0.0) > 0.0 > excess(top_hz)):
        return None
    return float(np.asarray(brentq(excess, 0.0, top_hz, xtol=1e-6)))


def _find_peaks(signals: Signals, pair: str | None) -> np.ndarray:
    """Return speed and frequency of the peaks of the measured spectra, negative for backward, shape (n, 2) [Hz]."""
    probes, edges_s = signals.read_pair(pair), signals.edges_s
    times_s, frequency, amplitude = read_spectra(signals, probes, None, choose_window(probes))
    speed_hz = np.zeros(len(times_s))
    if len(edges_s) > 1:
        speed_hz = np.interp(times_s, 0.5 * (edges_s[1:] + edges_s[:-1]), 1.0 / np.diff(edges_s))
        speed_hz[(times_s < edges_s[0]) | (times_s > edges_s[-1])] = np.nan
    found = []
    for row in np.unique(np.linspace(0, len(times_s) - 1, _MAX_POINTS).astype(int)):
        spectrum = np.nan_to_num(amplitude[row] + 0.0 * speed_hz[row])
        inner = spectrum[1:-1]
        high = (inner > spectrum[:-2]) & (inner > spectrum[2:]) & (inner >= max(_MIN_PEAK * spectrum.max(), 1e-300))
        tops = 1 + np.flatnonzero(high)
        for top in sorted(tops, key=lambda at: -spectrum[at])[:_MAX_PEAKS]:
            shift, _ = parabola_top(*np.log(np.maximum(spectrum[top - 1 : top + 2], 1e-300)))
            found.append((speed_hz[row], frequency[top] + shift * (frequency[1] - frequency[0])))
    return np.array(found).reshape(-1, 2)
