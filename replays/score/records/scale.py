"""Scale of a recorded channel: the relation of its values to the rig's counts, with the DAQ's number of bits."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from replays.estimate.clock import fit_line
from replays.score.records.rows import NO_COUNT
from rig.base import units
from rig.channels.table import Channel

_COUNT_TOLERANCE = 0.49
"""Largest deviation of a recorded count from a whole number, due to rounding in the file."""
_MAX_REFITTED = 8
"""Stretches on which a scale is fitted although a known one explains others."""
_PIECE_ROWS = 512
"""Most consecutive rows on which a scale is found, as rows before and after them may be lost."""
_MIN_EXPLAINED_PART = 0.99
"""Part of the rows of such a stretch that a scale must explain."""
_MIN_BITS = 8
"""Bits of the coarsest DAQ that is judged by its counts."""
COUNTS = ("count", "counts", "lsb", "LSB", "code", "codes", "raw", "FS")
"""Names of counts as a unit in files."""
_BITS_ROWS = 1 << 12
"""Values by which a DAQ's unused bits are found."""


@dataclass(frozen=True)
class Scale:
    """Relation of recorded values to counts: value = each * count + zero.

    Attributes:
        each, zero: Value per count, and value of count 0 [unit of the file].
        what: Counts, the channel's unit, volts, or fitted.
        gain_ppm, zero_counts: Errors of the two.
        inverted: Whether the sign is inverted.
        known: Whether some rows have confirmed it; if not, it follows from the file's unit.
        bits, lost_bits: Bits of the DAQ's converter, and number of the rig's lowest bits that it leaves out.
        rounding: Rounding of the left-out bits: down, nearest (halves up), nearest even, or full scale
            (2^(bits - 1) - 1 for 1); empty if it has all bits.
    """

    each: float
    zero: float
    what: str
    gain_ppm: float = 0.0
    zero_counts: float = 0.0
    inverted: bool = False
    known: bool = True
    bits: int = 0
    lost_bits: int = 0
    rounding: str = ""

    @property
    def clean(self) -> bool:
        """True if its gain and its zero are both correct."""
        return not self.gain_ppm and not self.zero_counts

    def sent(self, counts: np.ndarray) -> np.ndarray:
        """Return the counts of a DAQ with this converter for those of the rig, int64, shape (n,)."""
        top = (1 << max(0, self.bits - 1)) - 1
        if self.rounding == "full scale":
            return np.rint(counts * (top / 2.0 ** (self.bits + self.lost_bits - 1))).astype(np.int64)
        if self.rounding == "nearest even":
            return np.minimum(np.rint(counts / 2.0**self.lost_bits).astype(np.int64), top)
        half = 1 << self.lost_bits >> 1 if self.rounding == "nearest" else 0
        return np.minimum(counts + half >> self.lost_bits, top) if self.rounding else counts

    def counts(self, values: np.ndarray) -> np.ndarray:
        """Return the counts of values, int64, shape (n,); `NO_COUNT` if a value is not a count."""
        exact = (values - self.zero) / self.each
        whole = np.rint(exact)
        good = np.isfinite(exact) & (np.abs(exact - whole) <= _COUNT_TOLERANCE) & (np.abs(whole) < 2.0**53)
        return np.where(good, np.where(good, whole, 0.0).astype(np.int64), NO_COUNT)


def find_scale(values: np.ndarray, unit: str, counts: np.ndarray, channel: Channel) -> Scale | None:
    """Return the scale of a channel; None if its counts cannot be recovered from the file.

    Args:
        values: Recorded values [unit of the file], shape (n,).
        unit: That unit; empty if the file has none.
        counts: Counts of the same rows, provided that none is lost, shape (n,).
        channel: The channel.
    """
    options, fits = scales(unit, channel, values, counts), list[tuple[bool, float, Scale]]()
    for form in dict.fromkeys((scale.rounding, scale.lost_bits) for scale in options):
        alike = [scale for scale in options if (scale.rounding, scale.lost_bits) == form]
        if (scale := _fit_scale(values, alike[0].sent(counts), alike)) is not None:
            fits.append((scale.clean, float(np.mean(scale.counts(values) == scale.sent(counts))), scale))
            if fits[-1][0] and not scale.rounding:
                break
    return max(fits, key=lambda each: each[:2])[2] if fits else None


def _fit_scale(values: np.ndarray, counts: np.ndarray, candidates: list[Scale]) -> Scale | None:
    """Return the scale between values and the DAQ's counts, with candidates for these, or None."""
    size = min(_PIECE_ROWS, max(8, len(values) // 4))
    whole = len(values) // size * size
    pieces = [slice(n, n + size) for n in range(0, whole, size)]
    # Rows with the most frequent count show nothing of a scale.
    there = counts[:whole].reshape(-1, size)
    moving = there != np.median(there, axis=1, keepdims=True) if whole else np.zeros(there.shape, bool)
    movable = moving.sum(axis=1)

    def show(scale: Scale, some: slice) -> np.ndarray:
        """Return whether a scale explains each of some pieces, shape (pieces,)."""
        same = scale.counts(values[:whole].reshape(-1, size)[some]) == there[some]
        part = (same & moving[some]).sum(axis=1) / np.maximum(movable[some], 1)
        return np.minimum(same.mean(axis=1), part) >= _MIN_EXPLAINED_PART

    shown = [np.flatnonzero(show(scale, slice(None))).tolist() for scale in candidates]
    best = max(range(len(candidates)), key=lambda n: len(shown[n]))
    # A small gain error shows at large counts: the pieces with the largest counts come first.
    others = [n for n in range(len(pieces)) if n not in shown[best]]
    others.sort(key=lambda n: -int(np.abs(counts[pieces[n]]).max()))
    for n in others[: _MAX_REFITTED if shown[best] else None]:
        x, y = counts[pieces[n]].astype(float), values[pieces[n]]
        if not np.isfinite(y).all() or not np.ptp(x):
            continue
        # Least-squares line.
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
    """Return the scale of all rows that a first one explains, with the errors of its gain and zero.

    The errors are relative to the nearest candidate. A gain or a zero error is assumed alone if its residual is as
    small as with both: a channel with little variation about a large mean has its gain from the mean. Differences
    below the resolution of the file count as neither.
    """
    near = min(candidates, key=lambda one: abs(math.log(abs(fitted.each / one.each))))
    same = fitted.counts(values) == counts
    x, sign = counts[same].astype(float), 1.0 if fitted.each / near.each > 0.0 else -1.0
    off = (sign * values[same] - near.zero) / near.each - x
    x += near.zero / near.each  # a gain error acts on values, which are zero there
    mean = float(x.mean())
    slope = fit_line(x, off).slope
    alone = float(off @ x / (x @ x)) if x.any() else 0.0
    forms = ((0.0, 0.0), (alone, 0.0), (0.0, float(off.mean())), (slope, float(off.mean()) - slope * mean))
    errors = [float(np.sqrt(np.mean((off - gain * x - zero) ** 2))) for gain, zero in forms]
    # 64-bit rounding, and a tenth more than the least.
    enough = max(1.1 * errors[-1], 1e-14 * (float(np.abs(x).max()) + abs(near.zero / near.each)))
    gain, zero = next(form for form, each in zip(forms, errors, strict=True) if each <= enough)
    if (gain, zero) == (0.0, 0.0):
        return (
            near
            if sign > 0.0
            else replace(near, each=-near.each, zero=-near.zero, what=f"fitted, beside {near.what}", inverted=True)
        )
    each, at_zero = sign * near.each * (1.0 + gain), sign * ((1.0 + gain) * near.zero + zero * near.each)
    return replace(
        near, each=each, zero=at_zero, what=f"fitted, beside {near.what}", gain_ppm=1e6 * gain, zero_counts=zero,
        inverted=sign < 0.0,
    )  # fmt: skip


def scales(unit: str, channel: Channel, values: np.ndarray, counts: np.ndarray) -> list[Scale]:
    """Return the possible scales of a sound DAQ, those with all bits of the rig's converter first.

    Args:
        unit: Unit of the file; empty if it has none.
        channel: The channel.
        values: Some recorded values [unit of the file], shape (n,).
        counts: Some of the counts that were sent, shape (m,).
    """
    has_unit, kind, bits = units.canonical(unit) != "1", units.get_quantity(unit), channel.adc_bits
    options = [Scale(1.0, 0.0, "counts")] if kind == "" or not has_unit else []
    if not has_unit or kind == units.get_quantity(channel.unit):
        size = units.size_si(channel.unit) / units.size_si(unit) if has_unit else 1.0
        options.append(Scale(channel.scale * size, channel.offset * size, channel.unit))
    if not has_unit or kind == "voltage":
        options.append(Scale(channel.lsb_v / (units.size_si(unit) if has_unit else 1.0), 0.0, "V"))
    if not has_unit:
        options.append(Scale(2.0 ** (1 - bits), 0.0, "fractions of full scale"))
        options += [Scale(2.0 ** (32 - bits), 0.0, "counts at the upper end of 32 bits")] if bits < 32 else []
    options = options or [Scale(1.0, 0.0, "counts")]
    values = values[np.isfinite(values)]
    if not len(values) or not np.ptp(values) or not np.ptp(counts):
        return options
    moving = values[values != np.median(values)]
    moving = moving[:: 1 + len(moving) // _BITS_ROWS]
    for scale in options[:]:
        lost = _lost_bits((moving - scale.zero) / scale.each, bits - _MIN_BITS)
        coarse = {(lost, 2.0**lost)} if lost else set[tuple[int, float]]()
        if scale.what == "counts" and (moving == np.rint(moving)).all():
            near = round(math.log2(float(np.ptp(counts)) / float(np.ptp(values))))
            coarse |= {(n, 1.0) for n in (near, near + 1, near - 1) if 0 < n <= bits - _MIN_BITS}
        ways = [(way, *each) for way in ("down", "nearest", "nearest even") for each in sorted(coarse)]
        ways += [("full scale", lost, 2.0**lost)] if scale.what in ("V", "fractions of full scale") else []
        options += [
            replace(
                scale, each=scale.each * size, what=f"{scale.what}, {bits - n} bits, rounded {way}", bits=bits - n,
                lost_bits=n, rounding=way,
            ) for way, n, size in ways
        ]  # fmt: skip
    return options


def _lost_bits(numbers: np.ndarray, most: int) -> int:
    """Return the number of lowest bits that nearly all numbers leave out."""
    for lost in range(most, 0, -1):
        whole = np.rint(numbers / 2.0**lost)
        if np.ptp(whole) > 1.0 and np.mean(np.abs(numbers / 2.0**lost - whole) <= 0.1) >= _MIN_EXPLAINED_PART:
            return lost
    return 0
