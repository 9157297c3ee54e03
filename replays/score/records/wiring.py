"""Assignment of recorded signals to the rig's channels, with polarity and delay, by correlation of all pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from replays.estimate.runs import find_true_runs
from replays.estimate.spectra import correlation, spectrum

_LIMIT, _CHANCE = 0.2, 6.0
"""Smallest correlation of a found signal: the larger of `_LIMIT`, and `_CHANCE` over the square root of its samples."""
_CANDIDATE_RATIO = 0.95
"""Ratio to the best correlation above which another channel, or lag, remains a candidate."""
_TIE_RATIO = 0.98
"""Ratio to the best correlation above which two rank equally; also the correlation that needs no second search."""
_MIN_POWER = 1e-4
"""Power of a stretch over that of the loudest one, above which it is compared in full: the ringing after an impact has
less than a hundredth."""
_REACH, _WIDE_S = 3, 5e-3
"""Search range of one signal about the common lag [samples], and the wider range if nothing is similar there [s]."""
_MAX_LAGS = 12
"""Largest number of lags that are returned in addition to the most probable one."""
_MAX_SAMPLES = 1 << 17
"""Largest number of samples of a signal that are correlated."""
_PART_S = 30.0
"""Part of a session that is searched at a time [s]; parts overlap by a stretch."""
_MIN_MEDIAN_CORRELATION = 0.7
"""Median correlation of the signals above which no other stretch is tried."""
_GRID_S = 0.01
"""Grid of the search for the busiest stretch [s]."""
_STRETCHES_S = (2.0, 0.25)
"""Lengths of the searched stretches [s]; the second one if clocks differ, or rows are lost, in the first."""


@dataclass(frozen=True)
class Wire:
    """Connection of a recorded signal.

    Attributes:
        channel: Name of the rig's channel; empty if no channel is similar.
        polarity: 1 or -1.
        likeness: Correlation, 0 to 1.
        rivals: Other channels with an equal correlation.
        ambiguous: Whether the opposite polarity at another time has an equal correlation, as for a sine.
        offset_s: Time in the session less time in the recording, common to all signals [s].
        within_s: Stretch of the recording in which `offset_s` was found [s].
        others_s: Other possible values of `offset_s`, for nearly periodic signals [s].
        own_s: `offset_s` of this signal alone, which may differ slightly [s].
    """

    channel: str
    polarity: int
    likeness: float
    rivals: tuple[str, ...]
    ambiguous: bool
    offset_s: float
    within_s: tuple[float, float]
    others_s: tuple[float, ...]
    own_s: float


def find_wires(
    recorded: Mapping[str, tuple[np.ndarray, float]], sent: Mapping[str, tuple[np.ndarray, float]]
) -> dict[str, Wire]:
    """Connect recorded signals to those that were sent.

    Args:
        recorded: Values and rate [Hz] of each signal by name, from the beginning of the file.
        sent: Values and rate [Hz] of each channel of the rig, from the beginning of the session.

    Returns:
        A wire for each recorded signal.
    """
    long, short = _STRETCHES_S
    best: dict[str, Wire] = {}
    length_s = max(len(values) / each for values, each in sent.values())
    found_s, here = 0.0, (0.0, dict(sent))
    for from_s in dict.fromkeys([0.0, _busiest_s(recorded, 0.0, long)]):
        for part_s in np.arange(0.0, max(length_s - long, 1e-9), _PART_S - long):
            rows = {
                name: slice(round(part_s * each), round((part_s + _PART_S) * each)) for name, (_, each) in sent.items()
            }
            part = {
                name: (values[rows[name]], each)
                for name, (values, each) in sent.items()
                if rows[name].start < len(values)
            }
            wires = {name: _shift(wire, float(part_s)) for name, wire in _find(recorded, part, from_s, long).items()}
            if all(wire.likeness > _TIE_RATIO and not wire.others_s for wire in wires.values()):
                return wires
            if _sum_likeness(wires) > _sum_likeness(best):
                best, found_s, here = wires, from_s, (float(part_s), part)
            if np.median([wire.likeness for wire in wires.values()]) > _TIE_RATIO:
                break
        if np.median([wire.likeness for wire in best.values()]) > _MIN_MEDIAN_CORRELATION:
            break
    wires = best
    more = _find(recorded, here[1], _busiest_s(recorded, found_s, short), short)
    more = {name: _shift(wire, here[0]) for name, wire in more.items()}
    alike = [sum(wire.likeness for wire in merged.values()) for merged in (wires, more)]
    first, second = (more, wires) if alike[1] > alike[0] else (wires, more)
    merged = {}
    for name, wire in first.items():
        other = second[name]
        # Clocks that differ blur fast signals over the long stretch, and a slower channel then correlates better.
        of = max(wire, other, key=lambda each: each.likeness)
        merged[name] = replace(
            of, offset_s=wire.offset_s, own_s=wire.own_s, within_s=wire.within_s,
            others_s=(other.offset_s, *other.others_s, *wire.others_s),
        )  # fmt: skip
    return merged


def _sum_likeness(wires: Mapping[str, Wire]) -> float:
    return float(np.nansum([wire.likeness for wire in wires.values()])) if wires else -1.0


def _shift(wire: Wire, shift_s: float) -> Wire:
    """Convert the times of a wire, found in a part of the session that starts at `shift_s`, to those of the session."""
    others_s = tuple(each + shift_s for each in wire.others_s)
    return replace(wire, offset_s=wire.offset_s + shift_s, own_s=wire.own_s + shift_s, others_s=others_s)


def _busiest_s(recorded: Mapping[str, tuple[np.ndarray, float]], from_s: float, taken_s: float) -> float:
    """Return the start of the stretch in which most signals vary most [s]; a short one is searched in a long one."""
    long, short = _STRETCHES_S
    within_s = long if taken_s == short else math.inf
    total: np.ndarray | None = None
    for values, each in recorded.values():
        part = np.nan_to_num(values[round(from_s * each) : round(min(from_s + within_s, 1e9) * each)])
        if len(part) < 2:  # outlying stamps gave a rate of less than a row per stretch
            continue
        steps = np.add.reduceat(np.diff(part) ** 2, range(0, max(1, len(part) - 1), max(1, round(_GRID_S * each))))
        power = steps / max(float(steps.sum()), 1e-300)
        total = power if total is None else total[: len(power)] + power[: len(total)]
    if total is None:
        return from_s
    size = max(1, round(taken_s / _GRID_S))
    sums = np.cumsum(np.concatenate([[0.0], total]))
    begin = int(np.argmax(sums[size:] - sums[:-size])) if len(total) > size else 0
    return from_s + begin * _GRID_S


def _find(
    recorded: Mapping[str, tuple[np.ndarray, float]], sent: Mapping[str, tuple[np.ndarray, float]], from_s: float,
    taken_s: float,
) -> dict[str, Wire]:  # fmt: skip
    """Return wires found by a stretch of the recording."""
    recorded = {name: (values[round(from_s * each) :], each) for name, (values, each) in recorded.items()}
    rate = max(each for _, each in sent.values())
    length = max(len(values) / each for values, each in sent.values())
    taken_s = min(taken_s, max(len(values) / each for values, each in recorded.values()))
    rate = min(rate, _MAX_SAMPLES / taken_s, 8.0 * _MAX_SAMPLES / length)
    behind = math.ceil(taken_s * rate) // 2
    there, even = _find_spectra(sent, rate, length, math.ceil((length + taken_s) * rate))
    resampled = {name: _resample(values, each, rate, taken_s) for name, (values, each) in recorded.items()}
    lengths = {n: _stretch_norms(even, behind, n) for n in {len(here) for here in resampled.values()}}
    names, wires = list(sent), {}
    best: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    ends: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for name, here in resampled.items():
        length = lengths[len(here)] / math.sqrt(_upsampling_factor(recorded[name][1], rate))
        curve = _correlate(here, behind, there, length)
        alike = np.abs(curve).max(axis=0)
        own = np.abs(curve[names.index(name)]) if name in names else alike
        best[name] = alike, own, curve.max(axis=0) >= _TIE_RATIO * alike
        ends[name] = curve.min(axis=1), curve.max(axis=1)
    lags = _find_common_lags(list(best.values()), behind + round(from_s * rate))
    lag = lags[0]
    padded = np.pad(even, ((0, 0), (behind, max(map(len, resampled.values())) + round(_WIDE_S * rate) + _REACH)))
    for name, here in resampled.items():
        length = lengths[len(here)] / math.sqrt(_upsampling_factor(recorded[name][1], rate))
        for apart in (_REACH, round(_WIDE_S * rate)):
            first = max(0, min(lag, length.shape[1] - 1) - apart)  # nothing was found, late in the recording
            about = range(first, min(lag + apart + 1, length.shape[1]))
            still = here - here.mean()
            near = np.column_stack([padded[:, at : at + len(here)] @ still for at in about])
            near /= length[:, about] * max(float(np.linalg.norm(still)), 1e-150)
            amounts = np.abs(near).max(axis=1)
            if amounts.max() > 0.5:
                break
        k = int(np.argmax(amounts))
        rivals = tuple(names[j] for j in np.flatnonzero(amounts >= _CANDIDATE_RATIO * amounts[k]) if j != k)
        if name in rivals and name in names:  # the name decides between equals
            rivals = (*(each for each in rivals if each != name), names[k])
            k = names.index(name)
        at = int(np.argmax(np.abs(near[k])))
        peak = near[k][at]
        polarity = 1 if peak >= 0.0 else -1
        ambiguous = max(-polarity * end[k] for end in ends[name]) > 0.9 * amounts[k]
        clear = amounts[k] > max(_LIMIT, _CHANCE / math.sqrt(len(here) / _upsampling_factor(recorded[name][1], rate)))
        offset_s = (lag - behind) / rate - from_s
        wires[name] = Wire(
            names[k] if clear else "", polarity, float(amounts[k]), rivals if clear else (), bool(ambiguous),
            offset_s, (from_s, from_s + taken_s), tuple((each - behind) / rate - from_s for each in lags[1:]),
            offset_s if ambiguous else offset_s + (first + at - lag) / rate,
        )  # fmt: skip
    # Among equally similar channels, prefer one whose name no other signal has.
    resampled = {name for name, wire in wires.items() if wire.channel == name}
    for name, wire in wires.items():
        free = [each for each in (wire.channel, *wire.rivals) if each not in resampled]
        if wire.channel in resampled - {name} and free:
            rivals = (wire.channel, *(each for each in wire.rivals if each != free[0]))
            wires[name] = replace(wire, channel=free[0], rivals=rivals)
    return wires


def _resample(values: np.ndarray, rate: float, wanted: float, seconds: float) -> np.ndarray:
    values = np.asarray(values[: math.ceil(seconds * rate) + 2])
    held = np.nan_to_num(values, nan=float(np.nanmean(values)) if np.isfinite(values).any() else 0.0)
    rows = max(2, min(math.floor(seconds * wanted), math.floor((len(held) - 1) / rate * wanted) + 1))
    if (step := _upsampling_factor(rate, wanted)) > 1:
        even = np.zeros(rows)
        part = held[: -(-rows // step)]
        even[::step] = part - part.mean()
        return even
    return np.interp(np.arange(rows) * (rate / wanted), np.arange(len(held)), held)


def _upsampling_factor(rate: float, wanted: float) -> int:
    """Return how many samples at the wanted rate equal one at `rate`, if a whole number; otherwise 1."""
    step = round(wanted / rate)
    return step if step > 1 and abs(step * rate / wanted - 1.0) < 1e-9 else 1


def _find_spectra(
    sent: Mapping[str, tuple[np.ndarray, float]], rate: float, length: float, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the spectra and the resampled values of the sent signals, padded to one length."""
    from scipy.fft import next_fast_len

    size = 2 * (next_fast_len(-(-size // 2), real=True) or size)
    rows = []
    for values, each in sent.values():
        even = _resample(values, each, rate, length)
        rows.append(np.pad(even - even.mean(), (0, math.ceil(length * rate) - len(even))))
    return spectrum(np.array(rows, np.float32), size), np.array(rows)


def _stretch_norms(sent: np.ndarray, before: int, n: int) -> np.ndarray:
    """Return the norm of n samples of each channel (less their mean) by lag; lag 0 is `before` samples early."""
    padded = np.pad(sent, ((0, 0), (before + 1, n)))
    sums, squares = np.cumsum(padded, axis=1), np.cumsum(padded**2, axis=1)
    power = squares[:, n:] - squares[:, :-n] - (sums[:, n:] - sums[:, :-n]) ** 2 / n
    power = power[:, : before + sent.shape[1]]
    # A stretch in which almost nothing was sent is not similar to any signal.
    return np.sqrt(np.maximum(power, np.maximum(_MIN_POWER * power.max(axis=1, keepdims=True), 1e-300)))


def _correlate(here: np.ndarray, before: int, there: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the correlation with each channel by lag; lag 0 is `before` samples before the session."""
    size = 2 * (there.shape[1] - 1)
    here = (here - here.mean()).astype(np.float32)
    whole = correlation(here, there, size)
    curve = np.concatenate([whole[:, size - before :], whole[:, : lengths.shape[1] - before]], axis=1)
    return curve / (lengths * max(float(np.linalg.norm(here)), 1e-150))


def _find_common_lags(curves: list[tuple[np.ndarray, np.ndarray, np.ndarray]], zero: int) -> list[int]:
    """Return the lags at which all signals of a file may start together, the most probable first.

    A sine has equal peaks in every period, and sequences with different starts have several. Of peaks close to the
    best one, the first is that at which most signals match the channel of their name, then that at which most have
    the polarity of the most similar channel, then one within `_TIE_RATIO` of the best, then the nearest to zero lag.

    Args:
        curves: By lag, each signal's correlation with the most similar channel and with that of its name, and
            whether it has the polarity of the former.
        zero: Index of zero lag.
    """
    clear = [alike for alike, *_ in curves if alike.max() > _LIMIT]
    if not clear:
        return [zero]
    curve = np.mean(clear, axis=0)
    high = curve >= _CANDIDATE_RATIO * curve.max()
    peaks = [low + int(np.argmax(curve[low:up])) for low, up in find_true_runs(high)]

    def rank(at: int) -> tuple[int, int, bool, int]:
        named = sum(bool(own[at] >= _TIE_RATIO * alike[at]) for alike, own, _ in curves)
        upright = sum(bool(each[at]) for *_, each in curves)
        return named, upright, bool(curve[at] >= _TIE_RATIO * curve.max()), -abs(at - zero)

    first = max(peaks, key=rank)
    return [first, *sorted(set(peaks) - {first}, key=lambda at: -curve[at])[:_MAX_LAGS]]
