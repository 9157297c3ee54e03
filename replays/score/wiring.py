"""Which channel of the rig each recorded signal is, with which polarity and how late: by correlation, all at once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

ALIKE = 0.2
"""Correlation from which a signal counts as found."""
_DISTINCT = 0.95
"""What correlates by more than this part of the best is not told from it."""
_CLEAR = 0.98
"""From which it needs no second look."""
_APART, _FAR_S = 3, 5e-3
"""Samples that a signal may be off the others; and where nothing is much like it there, so long [s]."""
_MOST = 1 << 17
"""Samples of a signal that are correlated, at most."""
_TAKEN_S = (2.0, 0.25)
"""Stretches of a recording that are looked for, the second where clocks are apart, or rows lost, in the first."""


@dataclass(frozen=True)
class Wire:
    """What one recorded signal is connected to.

    Attributes:
        channel: Name of the rig's channel; empty: none is like it.
        polarity: 1 or -1.
        likeness: Its correlation, 0 to 1.
        rivals: Other channels that are as alike.
        turned: Whether the other polarity, at another time, is as alike: as of a sine.
        late_s: Time in the session less time in the recording, of all signals together [s], ...
        within_s: ... in this stretch of the recording [s].
        own_s: The same as `late_s` of this signal alone, which may be somewhat off the others [s].
    """

    channel: str
    polarity: int
    likeness: float
    rivals: tuple[str, ...]
    turned: bool
    late_s: float
    within_s: tuple[float, float]
    own_s: float


def find_wires(
    recorded: Mapping[str, tuple[np.ndarray, float]], sent: Mapping[str, tuple[np.ndarray, float]]
) -> dict[str, Wire]:
    """Connect recorded signals to what was sent.

    Args:
        recorded: Values and rate [Hz] of each by name, from the beginning of the file.
        sent: The same of each channel of the rig, from the beginning of the session.

    Returns:
        A wire for each recorded signal.
    """
    long, short = _TAKEN_S
    wires = _find(recorded, sent, 0.0, long)
    if all(wire.likeness > _CLEAR for wire in wires.values()):
        return wires
    # Where most of them vary most.
    rate = min(each for _, each in recorded.values())
    powers = [np.nan_to_num(np.diff(_even(values, each, rate, long)) ** 2) for values, each in recorded.values()]
    rows, size = min(map(len, powers)), max(1, round(short * rate))
    whole = np.sum([power[:rows] / max(float(power.sum()), 1e-300) for power in powers], axis=0)
    sums = np.cumsum(np.concatenate([[0.0], whole]))
    begin = int(np.argmax(sums[size:] - sums[:-size])) if rows > size else 0
    more = _find(recorded, sent, begin / rate, short)
    clear = [sum(w.likeness > ALIKE for w in found.values()) for found in (wires, more)]
    return more if clear[1] > clear[0] else wires


def _find(
    recorded: Mapping[str, tuple[np.ndarray, float]], sent: Mapping[str, tuple[np.ndarray, float]], from_s: float,
    taken_s: float,
) -> dict[str, Wire]:  # fmt: skip
    """Wires by a stretch of the recording."""
    recorded = {name: (values[round(from_s * each) :], each) for name, (values, each) in recorded.items()}
    rate = max(each for _, each in sent.values())
    length = max(len(values) / each for values, each in sent.values())
    taken_s = min(taken_s, max(len(values) / each for values, each in recorded.values()))
    rate = min(rate, _MOST / taken_s, 8.0 * _MOST / length)
    behind = math.ceil(taken_s * rate) // 2
    there, even = _spectra(sent, rate, length, math.ceil((length + taken_s) * rate))
    taken = {name: _even(values, each, rate, taken_s) for name, (values, each) in recorded.items()}
    lengths = {n: _lengths(even, behind, n) for n in {len(here) for here in taken.values()}}
    curves = {name: _likeness(here, behind, there, lengths[len(here)]) for name, here in taken.items()}
    names = list(sent)
    # All signals of a file began together: the lag at which most of the best pairs are alike.
    best = {name: int(np.argmax(np.abs(curve).max(axis=1))) for name, curve in curves.items()}
    clear = [np.abs(curves[name][k]) for name, k in best.items() if np.abs(curves[name][k]).max() > ALIKE]
    lag = _nearest_peak(np.mean(clear, axis=0), behind) if clear else behind
    found = {}
    for name, curve in curves.items():
        for apart in (_APART, round(_FAR_S * rate)):
            first = max(0, lag - apart)
            near = curve[:, first : lag + apart + 1]
            amounts = np.abs(near).max(axis=1)
            if amounts.max() > 0.5:
                break
        k = int(np.argmax(amounts))
        rivals = tuple(names[j] for j in np.flatnonzero(amounts >= _DISTINCT * amounts[k]) if j != k)
        if name in rivals and name in names:  # its own name decides between equals
            rivals = (*(each for each in rivals if each != name), names[k])
            k = names.index(name)
        at = int(np.argmax(np.abs(near[k])))
        peak = near[k][at]
        polarity = 1 if peak >= 0.0 else -1
        turned = float((-polarity * curve[k]).max()) > 0.9 * amounts[k]
        known = amounts[k] > ALIKE
        late_s = (lag - behind) / rate - from_s
        found[name] = Wire(
            names[k] if known else "", polarity, float(amounts[k]), rivals if known else (), bool(turned),
            late_s, (from_s, from_s + taken_s), late_s if turned else late_s + (first + at - lag) / rate,
        )  # fmt: skip
    return found


def _even(values: np.ndarray, rate: float, wanted: float, seconds: float) -> np.ndarray:
    held = np.nan_to_num(values, nan=float(np.nanmean(values)) if np.isfinite(values).any() else 0.0)
    rows = max(2, min(math.floor(seconds * wanted), math.floor((len(held) - 1) / rate * wanted) + 1))
    return np.interp(np.arange(rows) * (rate / wanted), np.arange(len(held)), held)


def _spectra(
    sent: Mapping[str, tuple[np.ndarray, float]], rate: float, length: float, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Spectra of what was sent, and its even samples, all of one length."""
    from scipy.fft import next_fast_len

    size = 2 * int(next_fast_len(size) or size)
    rows = []
    for values, each in sent.values():
        even = _even(values, each, rate, length)
        rows.append(np.pad(even - even.mean(), (0, math.ceil(length * rate) - len(even))))
    return np.fft.rfft(rows, size, axis=1), np.array(rows)


def _lengths(sent: np.ndarray, before: int, n: int) -> np.ndarray:
    """Length of each channel without its mean in stretches of n, from so many samples before the session on."""
    padded = np.pad(sent, ((0, 0), (before + 1, n)))
    sums, squares = np.cumsum(padded, axis=1), np.cumsum(padded**2, axis=1)
    power = squares[:, n:] - squares[:, :-n] - (sums[:, n:] - sums[:, :-n]) ** 2 / n
    power = power[:, : before + sent.shape[1]]
    # Where next to nothing was sent, nothing is alike.
    return np.sqrt(np.maximum(power, np.maximum(1e-2 * power.max(axis=1, keepdims=True), 1e-300)))


def _likeness(here: np.ndarray, before: int, there: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Correlation with each channel by lag, from so many samples before the session on."""
    size = 2 * (there.shape[1] - 1)
    here = here - here.mean()
    whole = np.fft.irfft(np.conj(np.fft.rfft(here, size)) * there, size, axis=1)
    curve = np.concatenate([whole[:, size - before :], whole[:, : lengths.shape[1] - before]], axis=1)
    return curve / (lengths * max(math.sqrt(float(here @ here)), 1e-150))


def _nearest_peak(curve: np.ndarray, zero: int) -> int:
    """The peak nearest to no lag, of those that are as good as the best: a sine has one each period."""
    high = curve >= 0.98 * curve.max()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], high.astype(np.int8), [0]])))
    peaks = [low + int(np.argmax(curve[low:up])) for low, up in edges.reshape(-1, 2)]
    return min(peaks, key=lambda at: abs(at - zero))
