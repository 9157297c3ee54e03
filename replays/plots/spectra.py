"""Spectra of orbits: full spectrum, waterfall over time, cascade over speed, and order spectra by keyphasor phase."""

from __future__ import annotations

from typing import Any

import numpy as np

from replays.plots.plot import Plot, Table, describe_frame, describe_span, describe_title, kind, make_axes
from replays.plots.signals import Pair, Signals, check_speeds, compute_revolutions, find_pieces
from replays.report.canvas import BLACK, BLUE, RED, axis_label
from rig.base.errors import InputError
from rig.channels.orbit import SPECTRUM_HZ
from rig.channels.orbit import full_spectrum as compute_spectrum
from rig.channels.orbit import waterfall as compute_waterfall

_SPECTRUM_S = 2.0
"""Length of the end of the data that a full spectrum shows by default [s]; its lines are 0.5 Hz apart."""
_PADDING, _MAX_PADDED = 8, 1 << 19
"""Lines per sample of a full spectrum, and largest number of samples with more than one. With one line per sample the
peak of a frequency between two lines is up to 15 % too low, with eight 0.3 %; a long record has close lines anyway."""
_MAX_SPECTRA = 200
"""Largest number of spectra in a picture, about one per three pixels."""
_CASCADE_LINES, _CASCADE_PEAK = 40, 6.0
"""Spectra of a cascade, and the height of the largest peak in distances between two of them."""
_MAX_ORDER = 50.0
"""Largest order drawn by default."""
_MIN_SHOWN = 0.01
"""Amplitude, relative to the largest, up to whose frequency spectra are drawn by default."""
_DYNAMIC_RANGE = 1e-4
"""Smallest amplitude in a picture, relative to the largest."""
_SCALE_FLOOR = 1e-30
"""Smallest amplitude for a scale; a channel of zeros has one as well."""
_SIDES = "frequency [Hz]\n← backward      forward →"


@kind(last_s=_SPECTRUM_S)
def full_spectrum(signals: Signals, *, pair: str | None = None, max_hz: float | None = None, axes: Any = None) -> Plot:
    """Draw the full spectrum of an orbit: forward whirl on the right, backward whirl on the left.

    Args:
        signals: The data; by default the last 2 s. With gaps, their longest part without one is used.
        pair: Common part of the two probes' names; None for the first pair.
        max_hz: Largest frequency drawn [Hz]; None for all with 1 % of the largest amplitude, up to 200 Hz.
        axes: Axes to draw on; None for a new figure.

    Returns:
        Axes and table: frequency and amplitude.
    """
    probes, edges_s = signals.read_pair(pair), signals.edges_s
    piece = max(find_pieces(probes.samples), key=lambda each: each.stop - each.start)
    times_s = probes.samples.times_s[piece]
    x, y = probes.x[piece], probes.y[piece]
    lines = _PADDING * len(x) if len(x) <= _MAX_PADDED else None
    frequency, amplitude = compute_spectrum(x, y, probes.samples.rate_hz, lines=lines)
    frequency, amplitude = _limit(frequency, amplitude, max_hz, SPECTRUM_HZ)
    note = f"{describe_frame(signals)}; Hann window, {times_s[0]:.3f} to {times_s[-1]:.3f} s"
    title = describe_title(signals, f"Full spectrum at {probes.name}")
    (panel,) = make_axes(axes, 1, 1, height=4.6, title=title, note=note)
    if len(edges_s) > 1:
        speed_hz = (len(edges_s) - 1) / (edges_s[-1] - edges_s[0])
        for side in (-1.0, 1.0):
            panel.axvline(side * speed_hz, color=RED, ls=":", lw=1.0, label="±1X" if side > 0.0 else "")
        panel.legend(loc="upper right")
    highest, top = max(float(amplitude.max()), _SCALE_FLOOR), int(np.argmax(amplitude))
    panel.set(yscale="log", ylim=(_DYNAMIC_RANGE * highest, 3.0 * highest))
    panel.plot(frequency, np.maximum(amplitude, _DYNAMIC_RANGE * highest), color=BLUE, lw=0.9)
    label = f"{highest:.3g} {probes.unit} at {frequency[top]:.2f} Hz".replace("-", "−")
    panel.annotate(label, (frequency[top], highest), xytext=(0, 3), textcoords="offset points", ha="center", fontsize=9)
    panel.set(xlabel=_SIDES, ylabel=axis_label("amplitude", probes.unit), xlim=frequency[[0, -1]])
    return Plot((panel,), Table.from_columns(note, frequency=("Hz", frequency), amplitude=(probes.unit, amplitude)))


@kind()
def waterfall(
    signals: Signals,
    *,
    pair: str | None = None,
    max_hz: float | None = None,
    window_s: float | None = None,
    axes: Any = None,
) -> Plot:
    """Draw the full spectra of an orbit over time, as a waterfall in colour.

    Args:
        signals: The data.
        pair: Common part of the two probes' names; None for the first pair.
        max_hz: Largest frequency drawn [Hz]; None for all with 1 % of the largest amplitude, up to 200 Hz.
        window_s: Length of the window of each spectrum [s]; None for a tenth of the data, from 0.15 to 1 s.
        axes: Axes to draw on; None for a new figure.

    Returns:
        Axes and table: time, frequency and amplitude.
    """
    probes = signals.read_pair(pair)
    window_s = choose_window(probes) if window_s is None else window_s
    times_s, frequency, amplitude = read_spectra(signals, probes, max_hz, window_s)
    note = f"{describe_frame(signals)}; Hann windows of {window_s:g} s; gaps in the data are left open"
    title = describe_title(signals, f"Waterfall at {probes.name}")
    return _draw_map(axes, probes, times_s, frequency, amplitude, title, note, ("frequency", "Hz", _SIDES))


@kind()
def orders(
    signals: Signals, *, pair: str | None = None, max_order: float | None = None, turns: int = 8, axes: Any = None
) -> Plot:
    """Draw the order spectra of an orbit over time: order tracking by resampling at equal angles of the shaft.

    Args:
        signals: The data.
        pair: Common part of the two probes' names; None for the first pair.
        max_order: Largest order drawn; None for all with 1 % of the largest amplitude, up to 50.
        turns: Revolutions in the window of each spectrum; its lines are 1/turns apart.
        axes: Axes to draw on; None for a new figure.

    Returns:
        Axes and table: time, order and amplitude.

    Raises:
        InputError: There is no keyphasor, or fewer revolutions.
    """
    from scipy.interpolate import CubicSpline

    probes, edges_s = signals.read_pair(pair), signals.require_edges("order spectrum")
    samples_s = probes.samples.times_s
    revolutions, places = compute_revolutions(samples_s, edges_s), np.searchsorted(samples_s, edges_s)
    orbit, found = probes.xy, []
    for first in range(0, len(edges_s) - turns, max(1, turns // 2, len(edges_s) // _MAX_SPECTRA)):
        begin, end = max(0, places[first] - 1), min(len(samples_s), places[first + turns] + 1)
        angle = revolutions[begin:end]
        if (
            len(angle) < 8 * turns
            or np.diff(angle).max() > 0.25
            or angle[0] > first
            or angle[-1] < first + turns - 0.25
        ):
            continue  # a gap
        count = 1 << int(np.ceil(np.log2(len(angle))))
        even = first + turns * np.arange(count) / count
        x, y = CubicSpline(angle, orbit[begin:end])(even).T
        order, amplitude = compute_spectrum(x, y, count / turns)
        found.append((edges_s[first : first + turns + 1].mean(), order, amplitude))
    if not found:
        raise InputError("turns", "at most the number of revolutions without a gap", turns)
    # The number of samples, and with it the highest order, differs between slow and fast revolutions.
    highest = 1e-9 + min(max_order or _MAX_ORDER, *(order.max() for _, order, _ in found))
    times_s, order = np.array([at_s for at_s, _, _ in found]), found[0][1][np.abs(found[0][1]) <= highest]
    amplitude = np.array([each[np.abs(lines) <= highest] for _, lines, each in found])
    order, amplitude = _limit(order, amplitude, max_order, _MAX_ORDER)
    note = f"{describe_frame(signals)}; resampled at equal angles by the keyphasor, Hann windows of {turns} revolutions"
    title = describe_title(signals, f"Order spectra at {probes.name}")
    return _draw_map(
        axes, probes, times_s, order, amplitude, title, note, ("order", "1", "order\n← backward      forward →")
    )


@kind()
def cascade(
    signals: Signals,
    *,
    pair: str | None = None,
    max_hz: float | None = None,
    window_s: float | None = None,
    axes: Any = None,
) -> Plot:
    """Draw the full spectra of an orbit over the speed of a run-up or a coast-down, as a cascade of lines.

    Args:
        signals: The data.
        pair: Common part of the two probes' names; None for the first pair.
        max_hz: Largest frequency drawn [Hz]; None for all with 1 % of the largest amplitude, up to 200 Hz.
        window_s: Length of the window of each spectrum [s]; None for a tenth of the data, from 0.15 to 1 s.
        axes: Axes to draw on; None for a new figure.

    Returns:
        Axes and table: speed, frequency and amplitude of the spectra drawn.

    Raises:
        InputError: The speed changes by less than a tenth, or there is no keyphasor.
    """
    probes, edges_s = signals.read_pair(pair), signals.require_edges("cascade")
    window_s = choose_window(probes) if window_s is None else window_s
    times_s, frequency, amplitude = read_spectra(signals, probes, max_hz, window_s)
    speed_hz = np.interp(times_s, 0.5 * (edges_s[1:] + edges_s[:-1]), 1.0 / np.diff(edges_s))
    usable = np.isfinite(amplitude).all(axis=1) & (times_s >= edges_s[0]) & (times_s <= edges_s[-1])
    speed_hz, amplitude = speed_hz[usable], amplitude[usable]
    check_speeds(speed_hz)
    top = int(np.argmax(speed_hz))
    part = slice(0, top + 1) if speed_hz[top] - speed_hz[0] > speed_hz[top] - speed_hz[-1] else slice(top, None)
    speed_hz, amplitude = speed_hz[part], amplitude[part]
    wanted = np.linspace(speed_hz.min(), speed_hz.max(), _CASCADE_LINES)
    rows = np.unique(np.abs(speed_hz - wanted[:, None]).argmin(axis=1))
    rows = rows[np.argsort(speed_hz[rows])][::-1]
    note = (
        f"{describe_frame(signals)}; Hann windows of {window_s:g} s; speed {'rising' if part.start == 0 else 'falling'}"
    )
    title = describe_title(signals, f"Cascade at {probes.name}")
    (panel,) = make_axes(axes, 1, 1, height=6.4, title=title, note=note)
    largest = float(amplitude[rows].max()) or 1.0
    height = _CASCADE_PEAK * (wanted[1] - wanted[0]) / largest
    for depth, row in enumerate(rows):
        line = speed_hz[row] + height * amplitude[row]
        panel.fill_between(frequency, speed_hz[row], line, color="white", lw=0, zorder=2 + depth)
        panel.plot(frequency, line, color=BLUE, lw=0.8, zorder=2 + depth)
    bar, edge = np.array([0.0, height * largest]) + speed_hz[rows[-1]], 0.96 * frequency[-1]
    panel.plot([edge, edge], bar, color=BLACK, lw=2.0, zorder=99)
    label = f"{largest:.3g} {probes.unit} "
    panel.text(0.98 * edge, bar.mean(), label, ha="right", va="center", fontsize=9, backgroundcolor="white", zorder=99)
    panel.set(xlabel=_SIDES, ylabel="speed [Hz]", xlim=frequency[[0, -1]])
    ends = np.array([speed_hz[rows[-1]], panel.get_ylim()[1]])
    for order in (-2, -1, 1, 2):
        if abs(order) * ends[1] < frequency[-1]:
            panel.plot(order * ends, ends, color=RED, ls=":", lw=1.0, zorder=99)
            text = f"{order}X".replace("-", "−")
            panel.annotate(text, (order * ends[1], ends[1]), color=RED, fontsize=8, va="bottom", ha="center")
    panel.set_ylim(top=ends[1])
    columns = {
        "speed": ("Hz", np.repeat(speed_hz[rows], len(frequency))),
        "frequency": ("Hz", np.tile(frequency, len(rows))),
        "amplitude": (probes.unit, amplitude[rows].ravel()),
    }
    return Plot((panel,), Table.from_columns(note, **columns))


def _limit(
    frequency: np.ndarray, amplitude: np.ndarray, limit: float | None, most: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lines of spectra up to a limit, by default those with 1 % of the largest amplitude and a margin."""
    if limit is None:
        largest = np.nanmax(amplitude.reshape(-1, len(frequency)), axis=0, initial=0.0)
        limit = min(
            most,
            1.5 * np.abs(frequency[largest >= _MIN_SHOWN * largest.max(initial=0.0)]).max(initial=0.0)
            + 2.0 * np.diff(frequency[:2]).sum(),
        )
    shown = np.abs(frequency) <= limit
    if (lines := int(np.count_nonzero(shown))) < 3:
        raise InputError("spectrum", "of at least 3 lines; use more rows or a higher limit", lines)
    return frequency[shown], amplitude[..., shown]


def choose_window(probes: Pair) -> float:
    """Return the length of a window for the length of the data [s]."""
    span_s = float(np.ptp(probes.samples.times_s))
    return round(min(max(0.1 * span_s, 0.15), 1.0, 0.5 * span_s), 3)


def read_spectra(
    signals: Signals, probes: Pair, max_hz: float | None, window_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, frequencies and amplitudes of a pair's spectra, with nan at gaps.

    Raises:
        InputError: No part without a gap is as long as the window.
    """
    return signals.recall("spectra", lambda: _compute_spectra(probes, max_hz, window_s), probes.name, max_hz, window_s)


def _compute_spectra(probes: Pair, max_hz: float | None, window_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    samples = probes.samples
    pieces = [each for each in find_pieces(samples) if each.stop - each.start >= round(window_s * samples.rate_hz)]
    if not pieces:
        raise InputError("window_s", "shorter than a part of the data without a gap", window_s)
    hop_s = max(0.1 * window_s, float(np.ptp(samples.times_s)) / _MAX_SPECTRA)
    times_s, amplitudes, frequency = list[np.ndarray](), list[np.ndarray](), np.empty(0)
    for each in pieces:
        at_s, frequency, amplitude = compute_waterfall(
            probes.x[each], probes.y[each], samples.rate_hz, samples.times_s[each],
            window_s=window_s, hop_s=hop_s, limit_hz=max_hz or SPECTRUM_HZ,
        )  # fmt: skip
        if times_s:
            open_s = min(hop_s, (at_s[0] - times_s[-1][-1]) / 3.0)
            times_s.append(np.array([times_s[-1][-1] + open_s, at_s[0] - open_s]))
            amplitudes.append(np.full((2, len(frequency)), np.nan))
        times_s.append(at_s)
        amplitudes.append(amplitude)
    return np.concatenate(times_s), *_limit(frequency, np.concatenate(amplitudes), max_hz, SPECTRUM_HZ)


def _draw_map(
    axes: Any, probes: Pair, times_s: np.ndarray, across: np.ndarray, amplitude: np.ndarray, title: str, note: str,
    axis: tuple[str, str, str],
) -> Plot:  # fmt: skip
    """Return the picture of amplitudes over time and frequency or order in colour.

    Args:
        axes: Axes to draw on, or None.
        probes: The probes.
        times_s: Times [s], shape (t,).
        across: Frequencies or orders, shape (f,).
        amplitude: Amplitudes, nan at gaps, shape (t, f).
        title: Title.
        note: Conventions.
        axis: Name, unit and label of `across`.
    """
    from matplotlib.colors import LogNorm

    (panel,) = make_axes(axes, 1, 1, height=5.6, title=f"{title}, {describe_span(probes)}", note=note)
    highest = max(float(np.nanmax(amplitude)), _SCALE_FLOOR)
    shown = np.ma.masked_invalid(np.maximum(amplitude, _DYNAMIC_RANGE * highest))
    norm = LogNorm(_DYNAMIC_RANGE * highest, highest)
    if len(times_s) == 1:
        times_s, shown = times_s + np.array([-0.1, 0.1]), np.ma.concatenate([shown, shown])
        amplitude = np.concatenate([amplitude, amplitude])
    mesh = panel.pcolormesh(across, times_s, shown, norm=norm, cmap="cividis", shading="nearest", rasterized=True)
    panel.figure.colorbar(mesh, ax=panel, label=axis_label("amplitude", probes.unit), pad=0.02)
    panel.grid(visible=False)
    panel.set(xlabel=axis[2], ylabel="time [s]")
    columns = {
        "time": ("s", np.repeat(times_s, len(across))),
        axis[0]: (axis[1], np.tile(across, len(times_s))),
        "amplitude": (probes.unit, amplitude.ravel()),
    }
    return Plot((panel,), Table.from_columns(note, **columns))
