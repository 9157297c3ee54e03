"""Scale of a recorded channel: how its values come from the rig's counts, with as many bits as the DAQ has."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from replays.estimate.clock import fit_line
from replays.score.records.rows import NO_COUNT
from rig.base import units
from rig.channels.table import Channel

_NEAR = 0.49
"""Part of a count by which a recorded one may be off a whole number: rounding of the file."""
_REFITTED = 8
"""Stretches on which a scale is fitted although a known one explains others."""
_PIECE = 512
"""Most consecutive rows on which a scale is found: a row may be lost before and behind them."""
_ENOUGH = 0.99
"""Part of the rows of such a stretch that a scale must explain."""
_MIN_BITS = 8
"""Bits of the coarsest DAQ that is judged by its counts."""
COUNTS = ("count", "counts", "lsb", "LSB", "code", "codes", "raw", "FS")
"""Units by which files name counts."""
_BITS_ROWS = 1 << 12
"""Values by which the bits that a DAQ leaves out are found."""


@dataclass(frozen=True)
class Scale:
    """How recorded values come from counts: value = each * count + zero.

    Attributes:
        each, zero: The two, in the unit of the file.
        what: Counts, the channel's unit, volts, or fitted.
        gain_ppm, zero_counts: How far off that they are.
        turned: Whether it has the other sign.
        known: Whether some rows have shown it; otherwise it is what the file's unit says.
        bits, lost_bits: Of the DAQ's converter, and how many lowest ones of the rig's it leaves out.
        rounding: How it leaves them out: down, nearest (halves up), nearest even, or full scale (2^(bits - 1) - 1 for
            1); empty where it has all.
    """

    each: float
    zero: float
    what: str
    gain_ppm: float = 0.0
    zero_counts: float = 0.0
    turned: bool = False
    known: bool = True
    bits: int = 0
    lost_bits: int = 0
    rounding: str = ""

    @property
    def clean(self) -> bool:
        """Whether neither its gain nor its zero is off."""
        return not self.gain_ppm and not self.zero_counts

    def sent(self, counts: np.ndarray) -> np.ndarray:
        """Return the counts that a DAQ of this converter makes of those of the rig, int64, shape (n,)."""
        top = (1 << max(0, self.bits - 1)) - 1
        if self.rounding == "full scale":
            return np.rint(counts * (top / 2.0 ** (self.bits + self.lost_bits - 1))).astype(np.int64)
        if self.rounding == "nearest even":
            return np.minimum(np.rint(counts / 2.0**self.lost_bits).astype(np.int64), top)
        half = 1 << self.lost_bits >> 1 if self.rounding == "nearest" else 0
        return np.minimum(counts + half >> self.lost_bits, top) if self.rounding else counts

    def counts(self, values: np.ndarray) -> np.ndarray:
        """The counts of values, int64, shape (n,); `NO_COUNT` where a value is none."""
        found = (values - self.zero) / self.each
        whole = np.rint(found)
        good = np.isfinite(found) & (np.abs(found - whole) <= _NEAR) & (np.abs(whole) < 2.0**53)
        return np.where(good, np.where(good, whole, 0.0).astype(np.int64), NO_COUNT)


def find_scale(values: np.ndarray, unit: str, counts: np.ndarray, channel: Channel) -> Scale | None:
    """The scale of a channel; None where its counts cannot be told from what the file has.

    Args:
        values: Recorded [unit of the file], shape (n,).
        unit: That unit; empty where the file tells none.
        counts: Of the same rows as far as none is lost, shape (n,).
        channel: The channel.
    """
    known, found = scales(unit, channel, values, counts), list[tuple[bool, float, Scale]]()
    for form in dict.fromkeys((scale.rounding, scale.lost_bits) for scale in known):
        alike = [scale for scale in known if (scale.rounding, scale.lost_bits) == form]
        if (scale := _fit_scale(values, alike[0].sent(counts), alike)) is not None:
            found.append((scale.clean, float(np.mean(scale.counts(values) == scale.sent(counts))), scale))
            if found[-1][0] and not scale.rounding:
                break
    return max(found, key=lambda each: each[:2])[2] if found else None


def _fit_scale(values: np.ndarray, counts: np.ndarray, candidates: list[Scale]) -> Scale | None:
    """Return the scale by which values come from the DAQ's counts, of candidates for these; None if there is none."""
    size = min(_PIECE, max(8, len(values) // 4))
    whole = len(values) // size * size
    pieces = [slice(n, n + size) for n in range(0, whole, size)]
    # Rows that are as most are show nothing of a scale.
    there = counts[:whole].reshape(-1, size)
    moving = there != np.median(there, axis=1, keepdims=True) if whole else np.zeros(there.shape, bool)
    movable = moving.sum(axis=1)

    def show(scale: Scale, some: slice) -> np.ndarray:
        """Return which of some pieces a scale explains, shape (pieces,)."""
        same = scale.counts(values[:whole].reshape(-1, size)[some]) == there[some]
        part = (same & moving[some]).sum(axis=1) / np.maximum(movable[some], 1)
        return np.minimum(same.mean(axis=1), part) >= _ENOUGH

    shown = [np.flatnonzero(show(scale, slice(None))).tolist() for scale in candidates]
    best = max(range(len(candidates)), key=lambda n: len(shown[n]))
    # A small gain shows where counts are large: the pieces with the largest counts come first.
    others = [n for n in range(len(pieces)) if n not in shown[best]]
    others.sort(key=lambda n: -int(np.abs(counts[pieces[n]]).max()))
    for n in others[: _REFITTED if shown[best] else None]:
        x, y = counts[pieces[n]].astype(float), values[pieces[n]]
        if not np.isfinite(y).all() or not np.ptp(x):
            continue
        # The line of least squares.
        off, mean = x - x.mean(), float(y.mean())
        each = float(off @ (y - mean) / (off @ off))
        fitted = Scale(each, mean - each * float(x.mean()), "fitted")
        if each and show(fitted, slice(n, n + 1)).all():
            return _judge_fit(fitted, values, counts, candidates)
    if not shown[best]:
        return None
    fitted = _judge_fit(candidates[best], values, counts, candidates)
    ends = np.array([counts.min(), counts.max()])
    changed = np.abs((fitted.each * ends + fitted.zero - candidates[best].zero) / candidates[best].each - ends)
    return fitted if changed.max() >= 0.5 else candidates[best]


def _judge_fit(fitted: Scale, values: np.ndarray, counts: np.ndarray, candidates: list[Scale]) -> Scale:
    """Return the scale of all rows that a first one explains, and how far its gain and zero are off the nearest known.

    Either a gain or a zero is taken where it alone leaves as little as both: a channel with little spread about a large
    mean has its gain from the mean. What the digits of the file leave open is neither.
    """
    near = min(candidates, key=lambda one: abs(math.log(abs(fitted.each / one.each))))
    same = fitted.counts(values) == counts
    x, sign = counts[same].astype(float), 1.0 if fitted.each / near.each > 0.0 else -1.0
    off = (sign * values[same] - near.zero) / near.each - x
    x += near.zero / near.each  # a gain acts on values, which are zero there
    mean = float(x.mean())
    slope = fit_line(x, off).slope
    alone = float(off @ x / (x @ x)) if x.any() else 0.0
    forms = ((0.0, 0.0), (alone, 0.0), (0.0, float(off.mean())), (slope, float(off.mean()) - slope * mean))
    left = [float(np.sqrt(np.mean((off - gain * x - zero) ** 2))) for gain, zero in forms]
    # Rounding of 64-bit numbers, and a tenth more than the least.
    enough = max(1.1 * left[-1], 1e-14 * (float(np.abs(x).max()) + abs(near.zero / near.each)))
    gain, zero = next(form for form, each in zip(forms, left, strict=True) if each <= enough)
    if (gain, zero) == (0.0, 0.0):
        return (
            near
            if sign > 0.0
            else replace(near, each=-near.each, zero=-near.zero, what=f"fitted, beside {near.what}", turned=True)
        )
    each, at_zero = sign * near.each * (1.0 + gain), sign * ((1.0 + gain) * near.zero + zero * near.each)
    return replace(
        near, each=each, zero=at_zero, what=f"fitted, beside {near.what}", gain_ppm=1e6 * gain, zero_counts=zero,
        turned=sign < 0.0,
    )  # fmt: skip


def scales(unit: str, channel: Channel, values: np.ndarray, counts: np.ndarray) -> list[Scale]:
    """Return the scales that a sound DAQ may have, those with all bits of the rig's converter first.

    Args:
        unit: Of the file; empty where it tells none.
        channel: The channel.
        values: Some recorded ones [unit of the file], shape (n,).
        counts: Some of those sent, shape (m,).
    """
    told, kind, bits = units.canonical(unit) != "1", units.kind(unit), channel.adc_bits
    found = [Scale(1.0, 0.0, "counts")] if kind == "" or not told else []
    if not told or kind == units.kind(channel.unit):
        size = units.size_si(channel.unit) / units.size_si(unit) if told else 1.0
        found.append(Scale(channel.scale * size, channel.offset * size, channel.unit))
    if not told or kind == "voltage":
        found.append(Scale(channel.lsb_v / (units.size_si(unit) if told else 1.0), 0.0, "V"))
    if not told:
        found.append(Scale(2.0 ** (1 - bits), 0.0, "fractions of full scale"))
        found += [Scale(2.0 ** (32 - bits), 0.0, "counts at the upper end of 32 bits")] if bits < 32 else []
    found = found or [Scale(1.0, 0.0, "counts")]
    values = values[np.isfinite(values)]
    if not len(values) or not np.ptp(values) or not np.ptp(counts):
        return found
    moving = values[values != np.median(values)]
    moving = moving[:: 1 + len(moving) // _BITS_ROWS]
    for scale in found[:]:
        lost = _lost_bits((moving - scale.zero) / scale.each, bits - _MIN_BITS)
        coarse = {(lost, 2.0**lost)} if lost else set[tuple[int, float]]()
        if scale.what == "counts" and (moving == np.rint(moving)).all():
            near = round(math.log2(float(np.ptp(counts)) / float(np.ptp(values))))
            coarse |= {(n, 1.0) for n in (near, near + 1, near - 1) if 0 < n <= bits - _MIN_BITS}
        ways = [(way, *each) for way in ("down", "nearest", "nearest even") for each in sorted(coarse)]
        ways += [("full scale", lost, 2.0**lost)] if scale.what in ("V", "fractions of full scale") else []
        found += [
            replace(
                scale, each=scale.each * size, what=f"{scale.what}, {bits - n} bits, rounded {way}", bits=bits - n,
                lost_bits=n, rounding=way,
            ) for way, n, size in ways
        ]  # fmt: skip
    return found


def _lost_bits(numbers: np.ndarray, most: int) -> int:
    """Return how many of their lowest bits nearly all numbers leave out."""
    for lost in range(most, 0, -1):
        whole = np.rint(numbers / 2.0**lost)
        if np.ptp(whole) > 1.0 and np.mean(np.abs(numbers / 2.0**lost - whole) <= 0.1) >= _ENOUGH:
            return lost
    return 0
