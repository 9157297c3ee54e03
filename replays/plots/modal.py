"""Modal analysis of hammer hits: frequency response with coherence, and modes of the free decay with intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from replays.estimate.intervals import format_with_half_width, sandwich, student
from replays.estimate.least_squares import fit, solve
from replays.estimate.runs import block_means, find_true_runs
from replays.estimate.spectra import spectrum, window_spectra
from replays.plots.plot import Plot, Table, describe_title, kind, make_axes
from replays.plots.signals import TRUTH, Signals, break_lines, compute_revolutions
from replays.report.canvas import BLACK, BLUE, ORANGE, axis_label
from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.samples import Samples

_FOOT = 0.1
"""Force relative to the largest that counts as a hit."""
_MIN_SIGNAL_TO_NOISE = 10.0
_MIN_PAUSE_S = 0.02
"""Time between two hits; pulses that are closer are one hit."""
_EVENT_S = 0.01
"""Largest distance of a hit from its event."""
_MIN_POWER = 0.01
"""Power of the force relative to the largest up to which a frequency response is drawn."""
_MAX_MODES = 4
_FIT_ROUNDS, _ROWS_PER_PERIOD, _MAX_BLOCKS = 20, 8, 600
"""Steps of a fit; rows per period at the frequency limit, and rows of a decay."""
_MAX_DAMPING, _MAX_ERROR, _MIN_AMPLITUDE = 0.5, 0.1, 0.05
"""Largest damping ratio of a mode, half interval of its frequency, relative, and amplitude relative to the largest."""
_MAX_REMAINING = 0.7
"""RMS of the last fifth of a window relative to the first above which an oscillation does not decay."""
_MIN_COHERENCE = 0.5
"""Coherence below which a phase is noise."""


class Hits(NamedTuple):
    """Hammer hits and the responses to them, in windows of equal length without gaps.

    Attributes:
        unit: Unit of the force.
        direction: Direction of the hits; empty if it is not known.
        times_s: Start of each pulse [s], shape (hits,).
        force: Force, 0 outside the pulse, shape (hits, rows).
        responses: Responses, shape (hits, rows, channels).
        after: First row after the pulse, shape (hits,).
        samples: Channels and rate.
        dropped: Number of hits with a gap in the window.
    """

    unit: str
    direction: str
    times_s: np.ndarray
    force: np.ndarray
    responses: np.ndarray
    after: np.ndarray
    samples: Samples
    dropped: int

    def describe(self) -> str:
        """Return number, direction and window of the hits in words."""
        count, window_s = len(self.times_s), self.force.shape[1] / self.samples.rate_hz
        angle = "" if self.direction.strip("-xy and") == "" else "°"
        along = f" along {self.direction}{angle}" if self.direction else ""
        lost = f", {self.dropped} left out for a gap" if self.dropped else ""
        return f"{count} hit{'s' * (count > 1)}{along}, windows of {window_s:.3g} s{lost}"


def read_hits(
    signals: Signals, channels: Sequence[str] | str, window_s: float | None, direction: Any, axis: str = ""
) -> Hits:
    """Return hits and the responses of channels to them.

    The force is that of the channel `hammer`, else the half sines of the events of hammer pulses.

    Args:
        signals: The data.
        channels: Channels or pairs; none for the first pair.
        window_s: Length of the window of each hit [s]; None for the shortest time to the next hit or the end.
        direction: Direction of the hits; None for those along the axis.
        axis: x or y; hits of the first direction if there are none along it; empty for all hits.

    Raises:
        InputError: There is no hit with a whole window, or an argument is invalid.
    """
    names, pulses = signals.list_channels(channels), [each for each in signals.events() if each["event"] == "hammer"]
    source = next((each for each in ("hammer", TRUTH + "hammer_force") if each in signals.channels), None)
    if not (pulses if source != "hammer" else _has_hits(signals)):
        raise InputError("hammer", "in the data, as a channel `hammer` or as events of hits", Words("no hit"))
    if source == "hammer":
        samples = signals.read(*names, source)
        force, unit = samples.values[:, -1], samples.units[-1]
    else:
        samples, unit = signals.read(*names), "N"
        force = np.zeros(len(samples))
        for each in pulses:
            phase = (samples.times_s - each["time_s"]) / (1e-3 * each["duration_ms"])
            force += np.where((phase > 0.0) & (phase < 1.0), each["force_n"] * np.sin(math.pi * phase), 0.0)
    noise = _estimate_noise(force)
    if not force.max(initial=0.0) > _MIN_SIGNAL_TO_NOISE * noise:
        raise InputError("hammer", "in the data, as a channel `hammer` or as events of hits", Words("no hit"))
    high, rate_hz = force > max(_FOOT * force.max(), 0.5 * _MIN_SIGNAL_TO_NOISE * noise), samples.rate_hz
    times_s = samples.times_s
    runs: list[list[int]] = []
    for begin, end in find_true_runs(high):
        if runs and times_s[begin] - times_s[runs[-1][1] - 1] < _MIN_PAUSE_S:
            runs[-1][1] = end
        else:
            runs.append([begin, end])
    starts_s = np.array([times_s[begin] for begin, _ in runs])
    labels = [
        next((str(each["direction"]) for each in pulses if abs(each["time_s"] - at_s) < _EVENT_S), "")
        for at_s in starts_s
    ]
    wanted = next((each for each in labels if each.lstrip("-") == axis), labels[0])
    if direction is not None and (wanted := str(direction)) not in labels:
        raise UnknownNameError("direction", "that of a hit", wanted, labels)
    chosen = [at for at, label in enumerate(labels) if label == wanted or (direction is None and not axis)]
    longest_s = float(min([*np.diff(starts_s), times_s[-1] - starts_s[-1]]))
    if window_s is not None and not 0.0 < window_s <= longest_s:
        raise InputError("window_s", f"above 0, and at most {longest_s:.4g} between hits and to the end", window_s)
    rows = int((longest_s if window_s is None else window_s) * rate_hz)
    # The window begins ahead of the hit by the foot of its pulse.
    ahead = [end - begin for begin, end in runs]
    whole = [
        at for at in chosen
        if runs[at][0] >= ahead[at] and runs[at][0] - ahead[at] + rows <= len(samples)
        and samples.index[runs[at][0] - ahead[at] + rows - 1] - samples.index[runs[at][0] - ahead[at]] == rows - 1
        and rows > 3 * ahead[at]
    ]  # fmt: skip
    if not whole:
        raise InputError("hammer", "in the data with a whole window without a gap", Words(f"{len(chosen)} hits"))
    first = np.array([runs[at][0] - ahead[at] for at in whole])
    after = np.array([3 * ahead[at] for at in whole])
    places = first[:, None] + np.arange(rows)
    pulse = np.where(np.arange(rows) < after[:, None], force[places], 0.0)
    responses = samples.values[places][:, :, : len(names)]
    dropped = len(chosen) - len(whole)
    wanted = " and ".join(dict.fromkeys(labels[at] for at in chosen))
    return Hits(unit, wanted, starts_s[whole], pulse, responses, after, samples.select(*names), dropped)


def _has_hits(signals: Signals) -> bool:
    """Return whether the channel `hammer` has a hit, before other channels are read."""

    def compute() -> tuple[bool]:
        force = signals.read("hammer").values[:, 0]
        return (force.max(initial=0.0) > _MIN_SIGNAL_TO_NOISE * _estimate_noise(force),)

    return signals.recall("has hits", compute)[0]


def _estimate_noise(force: np.ndarray) -> float:
    """Return the noise of a force, from its median absolute deviation."""
    return 1.5 * float(np.median(np.abs(force - np.median(force)))) if len(force) else 0.0


@kind()
def frequency_response(
    signals: Signals,
    *,
    channels: Sequence[str] = (),
    direction: str | float | None = None,
    window_s: float | None = None,
    max_hz: float | None = None,
    axes: Any = None,
) -> Plot:
    """Draw frequency responses of channels to hammer hits: amplitude and phase of H1 and H2, and coherence.

    Args:
        signals: The data.
        channels: Channels or pairs, such as `disk` or `inner`; none for the first pair.
        direction: Direction of the hits that are averaged; None for those along each probe, or else the first.
        window_s: Length of the window of each hit [s]; None for the shortest time to the next hit or the end.
        max_hz: Largest frequency [Hz]; None for that at which the force's power falls to 1 % of its largest.
        axes: Axes to draw on: amplitudes of all channels, then phases, then coherences; None for a new figure.

    Returns:
        Axes and table: frequency, and amplitude and phase of H1 and H2, and coherence of each channel. Coherence is nan
        with one hit.

    Raises:
        InputError: There is no hit.
    """
    names = signals.list_channels(channels)
    axis_of = {name: "y" if abs(signals.get_direction_deg(name) - 90.0) < 45.0 else "x" for name in names}
    by_axis = {axis: read_hits(signals, names, window_s, direction, axis) for axis in dict.fromkeys(axis_of.values())}
    hits = by_axis[axis_of[names[0]]]
    rows, rate_hz = hits.force.shape[1], hits.samples.rate_hz
    frequency, power, _, _ = window_spectra(hits.force, hits.force, rate_hz)
    if max_hz is None:
        weak = np.flatnonzero(power[1:] < _MIN_POWER * power.max())
        max_hz = float(frequency[1 + weak[0]]) if len(weak) else float(frequency[-1])
    shown = (frequency > 0.0) & (frequency <= max_hz)
    if not shown.any():
        raise InputError("max_hz", f"at least {frequency[1]:g}, one line of the window", max_hz)
    count = len(names)
    note = (
        f"{' and '.join(dict.fromkeys(each.describe() for each in by_axis.values()))}, without taper; phase: lead of "
        "the response" + f"; phases of coherence below {_MIN_COHERENCE:g} left out" * (len(hits.times_s) > 1)
    )
    title = describe_title(signals, "Frequency response to hammer hits")
    panels = make_axes(
        axes, 3, count, height=7.6, title=title, note=note, sharex=True, height_ratios=(2.0, 1.4, 1.0)
    )  # fmt: skip
    columns: dict[str, tuple[str, np.ndarray]] = {"frequency": ("Hz", frequency[shown])}
    for column, name in enumerate(names):
        hits = by_axis[axis_of[name]]
        unit, response, one = hits.samples.units[column], hits.responses[:, :, column], len(hits.times_s) == 1
        remaining = np.ptp(response[:, -max(2, rows // 20) :], axis=1).max() / max(
            np.ptp(response, axis=1).max(), 1e-300
        )
        power, own, cross = (each[shown] for each in window_spectra(hits.force, response, rate_hz)[1:])
        with np.errstate(invalid="ignore", divide="ignore"):  # a channel of zeros has no H2 and no coherence
            estimates = {"H1": cross / power, "H2": own / np.conj(cross)}
            coherence = np.abs(cross) ** 2 / (power * own) * (math.nan if one else 1.0)
        ratio = f"({unit})/{hits.unit}" if "/" in unit else f"{unit}/{hits.unit}"
        amplitude, phase, bottom = panels[column::count]
        for (label, values), colour, line in zip(estimates.items(), (BLUE, ORANGE), ("-", "--"), strict=True):
            angle = np.degrees(np.angle(values))
            wraps = np.abs(np.diff(angle)) > 180.0
            drawn = np.where(coherence < _MIN_COHERENCE, np.nan, angle)
            amplitude.semilogy(frequency[shown], np.abs(values), line, color=colour, lw=1.2, label=label)
            phase.plot(*break_lines(wraps, frequency[shown], drawn), line, color=colour, lw=1.2)
            columns |= {f"{name} {label}": (ratio, np.abs(values)), f"{name} {label} phase": ("deg", angle)}
        columns[f"{name} coherence"] = ("1", coherence)
        bottom.plot(frequency[shown], coherence, color=BLACK, lw=1.0)
        if one:
            text = "one hit: coherence is 1\nby construction, not shown"
            bottom.text(0.5, 0.5, text, transform=bottom.transAxes, ha="center", va="center", fontsize=9)
        text = f"range at the end of the window: {remaining:.1%}"
        amplitude.set_title(text, loc="right", fontsize=8, fontweight="normal", color="0.35")
        amplitude.set(title=name, ylabel=axis_label("amplitude", ratio))
        phase.set(ylabel="phase [°]" if column == 0 else "", ylim=(-190, 190), yticks=range(-180, 181, 90))
        bottom.set(xlabel="frequency [Hz]", ylabel="coherence" if column == 0 else "", ylim=(0.0, 1.05))
    panels[0].legend(loc="upper right")
    return Plot(tuple(panels), Table.from_columns(note, **columns))


class Modes(NamedTuple):
    """Modes of a free decay.

    Attributes:
        frequency_hz: Natural frequency |s|/2π and half of its 95 % interval [Hz], shape (modes, 2).
        damping: Damping ratio -Re s/|s| and half of its 95 % interval, shape (modes, 2).
        fitted: Fitted decays, each of shape (n, channels).
    """

    frequency_hz: np.ndarray
    damping: np.ndarray
    fitted: list[np.ndarray]


def fit_modes(decays: Sequence[np.ndarray], step_s: float, extra: Sequence[np.ndarray]) -> Modes:
    """Fit modes that are common to free decays, each channel of each with its own amplitudes and mean.

    Starts from the poles of ESPRIT; the number of modes is that of the smallest BIC. Intervals are those of
    `estimate.intervals.sandwich`, for noise of unknown spectrum.

    Args:
        decays: Free decays, each of shape (n, channels).
        step_s: Time between two rows [s].
        extra: Further columns of each decay, such as 1X, shape (n, k).
    """
    best, lowest, rows = None, math.inf, sum(each.size for each in decays)
    project = partial(_project, decays=decays, step_s=step_s, extra=extra)
    for count in range(1, _MAX_MODES + 1):
        poles = _find_poles(decays, step_s, extra, count)
        start = np.stack([poles.real, poles.imag]).ravel()
        if len(poles) < count:
            continue
        found = fit(
            lambda z: np.concatenate([part.residual.T.ravel() for part in project(z)]),
            lambda z, _: -np.concatenate([part.slopes.T.reshape(len(z), -1).T for part in project(z)]),
            start, rounds=_FIT_ROUNDS,
        )  # fmt: skip
        assert found is not None
        own = sum(each.shape[1] * (2 * count + 1 + more.shape[1]) for each, more in zip(decays, extra, strict=True))
        score = rows * math.log(max(found.squares, 1e-300)) + (2 * count + own) * math.log(rows)
        if score < lowest:
            best, lowest = found.values, score
    if best is None:
        return Modes(np.empty((0, 2)), np.empty((0, 2)), [np.full(each.shape, np.nan) for each in decays])
    values, parts = best, project(best)
    tangents = np.concatenate([part.slopes.T.reshape(len(values), -1).T for part in parts])
    covariance, dof = sandwich(tangents, np.concatenate([part.residual.T.ravel() for part in parts]), even=True)
    amplitude = np.max([part.amplitudes.max(axis=1) for part in parts], axis=0)
    rate, turn = values.reshape(2, -1)
    count, size = len(rate), np.hypot(rate, turn)
    each = np.arange(count)
    slopes = np.zeros((2 * count, 2 * count))  # of frequency and damping ratio by rate and turn
    slopes[each, each], slopes[each, count + each] = rate / size / (2.0 * math.pi), turn / size / (2.0 * math.pi)
    slopes[count + each, each], slopes[count + each, count + each] = -(turn**2) / size**3, rate * turn / size**3
    half = np.sqrt(np.diag(slopes @ covariance @ slopes.T)).reshape(2, -1) * student(dof.reshape(2, -1).min(axis=0))
    frequency, damping = np.stack([size / (2.0 * math.pi), half[0]], axis=1), np.stack([-rate / size, half[1]], axis=1)
    large = amplitude > _MIN_AMPLITUDE * amplitude.max()
    good = (
        large
        & (damping[:, 0] > damping[:, 1])
        & (damping[:, 0] < _MAX_DAMPING)
        & (half[0] < _MAX_ERROR * frequency[:, 0])
    )
    order = np.flatnonzero(good)[np.argsort(frequency[good, 0])]
    return Modes(frequency[order], damping[order], [part.fitted for part in parts])


def _find_poles(decays: Sequence[np.ndarray], step_s: float, extra: Sequence[np.ndarray], count: int) -> np.ndarray:
    """Return poles that start a fit [1/s], by ESPRIT on all decays together, with imaginary parts above 0."""
    length = min(len(each) for each in decays) // 3
    square = np.zeros((length, length))
    for each, more in zip(decays, extra, strict=True):
        basis = np.column_stack([np.ones(len(each)), more])
        for column in (each - basis @ solve(basis, each)).T:
            hankel = np.lib.stride_tricks.sliding_window_view(column, length)
            square += hankel.T @ hankel
    signal = np.linalg.eigh(square)[1][:, -2 * count :]
    poles = np.log(np.linalg.eigvals(solve(signal[:-1], signal[1:])).astype(complex)) / step_s
    return poles[poles.imag > 0.0]


class _Part(NamedTuple):
    """One decay in a fit: residual, its negative slopes by the poles, fitted decay, and size of the amplitudes."""

    residual: np.ndarray
    slopes: np.ndarray
    fitted: np.ndarray
    amplitudes: np.ndarray


def _project(
    values: np.ndarray, *, decays: Sequence[np.ndarray], step_s: float, extra: Sequence[np.ndarray]
) -> list[_Part]:
    """Return each decay with the best amplitudes for given poles.

    This is variable projection (Golub & Pereyra 1973) with the slopes of Kaufman 1975.
    """
    rate, turn = values.reshape(2, -1)
    parts, count = [], len(rate)
    for each, more in zip(decays, extra, strict=True):
        time_s = step_s * np.arange(len(each))
        waves = np.exp(np.outer(time_s, np.minimum(rate, 0.0) + 1j * turn))
        basis = np.column_stack([waves.real, -waves.imag, np.ones(len(each)), more])
        span, solved = np.linalg.qr(basis)[0], solve(basis, each)
        amplitudes, fitted = solved[:count] + 1j * solved[count : 2 * count], basis @ solved
        moved = time_s[:, None, None] * waves[:, None, :] * amplitudes.T
        slopes = np.concatenate([moved.real, -moved.imag], axis=2)
        slopes -= np.tensordot(span, np.tensordot(span.T, slopes, 1), 1)
        parts.append(_Part(each - fitted, slopes, fitted, np.abs(amplitudes)))
    return parts


@kind()
def modes(
    signals: Signals,
    *,
    channels: Sequence[str] = (),
    direction: str | float | None = None,
    window_s: float | None = None,
    max_hz: float | None = None,
    axes: Any = None,
) -> Plot:
    """Draw natural frequencies and damping ratios of the free decay after hammer hits, with 95 % intervals.

    Decaying sines that are common to all hits and channels are fitted; their number is that of the smallest BIC. A 1X
    component of a shaft that rotates is fitted with them.

    Args:
        signals: The data.
        channels: Channels or pairs; none for the first pair.
        direction: Direction of the hits; None for all.
        window_s: Length of the window of each hit [s]; None for the shortest time to the next hit or the end.
        max_hz: Frequency that the fit must resolve [Hz]; None for four times that of the largest response.
        axes: Axes to draw on: decays of all channels, then damping ratio over frequency; None for a new figure.

    Returns:
        Axes and table: natural frequency and damping ratio of each mode with the limits of their intervals.

    Raises:
        InputError: There is no hit, or no decaying oscillation after it.
    """
    hits = read_hits(signals, channels, window_s, direction)
    rate_hz, names = hits.samples.rate_hz, hits.samples.names
    last = hits.after.max()
    if max_hz is None:
        free = hits.responses[:, last:].transpose(0, 2, 1)
        lines = np.abs(spectrum(free - free.mean(axis=2)[:, :, None]))
        max_hz = 4.0 * rate_hz * float(np.argmax(lines.max(axis=(0, 1))) or 1) / (hits.force.shape[1] - last)
    block = max(1, int(rate_hz / (_ROWS_PER_PERIOD * max_hz)))
    # The mean of a decaying sine over a block is a decaying sine with the same pole.
    decays = [
        np.stack([block_means(column[after:], block) for column in response.T], axis=1)[:_MAX_BLOCKS]
        for response, after in zip(hits.responses, hits.after, strict=True)
    ]
    fifth = max(1, len(decays[0]) // 5)
    first, last_fifth = (
        np.std(np.stack([each[part] for each in decays]), axis=(0, 1)) for part in (slice(fifth), slice(-fifth, None))
    )
    if np.all(last_fifth >= _MAX_REMAINING * first):  # also without any response
        raise InputError("modes", "drawn of oscillations that decay after a hit", Words("some that do not"))
    # Channels of a unit have the same weight, so that a response that is small does not count as much as a large one.
    spreads, units = np.std(np.concatenate(decays), axis=0), np.array(hits.samples.units)
    scale = np.array([spreads[units == unit].max() or 1.0 for unit in units])
    edges_s, extra = signals.edges_s, []
    for each, at_s, after in zip(decays, hits.times_s, hits.after, strict=True):
        # The window begins a third of `after` ahead of the hit.
        times_s = at_s + (2 * after // 3 + block * (np.arange(len(each)) + 0.5)) / rate_hz
        angle = 2.0 * math.pi * compute_revolutions(times_s, edges_s) if len(edges_s) > 1 else np.empty(0)
        extra.append(np.stack([np.cos(angle), np.sin(angle)], axis=1) if len(angle) else np.empty((len(each), 0)))
    found = fit_modes([each / scale for each in decays], block / rate_hz, extra)
    if not len(found.damping):
        raise InputError("modes", "drawn of decaying oscillations after a hit", Words("none found"))
    note = (
        f"{hits.describe()}; natural frequency |s|/2π, damping ratio −Re s/|s|; bars: 95 % intervals; "
        f"amplitudes below {_MIN_AMPLITUDE:.0%} left out"
    )
    title, count = describe_title(signals, "Modes of the free decay"), len(names)
    figure = make_axes(axes, 1, count + 1, height=4.8, title=title, note=note)
    for column, (panel, name) in enumerate(zip(figure, names, strict=False)):
        times_s = (hits.after[0] + block * (np.arange(len(decays[0])) + 0.5)) / rate_hz
        panel.plot(times_s, decays[0][:, column], color=BLUE, lw=1.0, label="measured")
        panel.plot(times_s, scale[column] * found.fitted[0][:, column], "--", color=BLACK, lw=0.9, label="fitted")
        panel.set(
            title=f"{name}, first hit",
            xlabel="time in the window [s]",
            ylabel=axis_label(name, hits.samples.units[column]),
        )
    figure[0].legend(loc="upper right")
    (hz, hz_half), (ratio, ratio_half) = found.frequency_hz.T, found.damping.T
    panel = figure[-1]
    panel.errorbar(hz, 100.0 * ratio, 100.0 * ratio_half, hz_half, "o", ms=4.5, color=BLUE, capsize=3)
    lines = [
        f"{format_with_half_width(*one)} Hz, {format_with_half_width(*(100.0 * two))} %"
        for one, two in zip(found.frequency_hz, found.damping, strict=True)
    ]
    for line, at, high in zip(lines, hz, ratio + ratio_half, strict=True):
        panel.annotate(
            line.replace(", ", "\n"), (at, 100.0 * high), xytext=(0, 6), textcoords="offset points", ha="center",
            fontsize=8.5,
        )  # fmt: skip
    panel.set_title("modes")
    panel.set(
        xlabel="natural frequency [Hz]", ylabel="damping ratio [%]", ylim=(0.0, 140.0 * (ratio + ratio_half).max())
    )
    panel.margins(x=1.0)
    columns = {
        "frequency": ("Hz", hz), "frequency low": ("Hz", hz - hz_half), "frequency high": ("Hz", hz + hz_half),
        "damping ratio": ("1", ratio), "damping ratio low": ("1", ratio - ratio_half),
        "damping ratio high": ("1", ratio + ratio_half),
    }  # fmt: skip
    return Plot(tuple(figure), Table.from_columns(note, **columns))
