"""The digital path: the DAQ took the rig's counts, so every row has to be there once, in order, with every count.

Rows are followed among those sent (`rows`); counts are recovered by a scale that is found for each channel and must
then be exact. Time stamps are held against the times of the rows that they stand beside.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from replays.score.limits import Limits
from replays.score.rows import NO_COUNT, Followed, follow, stretches
from replays.score.scorecard import Scorecard, judge_row
from replays.score.signals import Recorded, Sent, Session, in_parts
from replays.score.waveform import student
from replays.score.wiring import Wire
from rig import units
from rig.channels import Channel

_NEAR = 0.49
"""Part of a count by which a recovered one may be off a whole number: rounding of the file."""
_NOTHING = 0.01
"""Counts that are none."""
_PIECE = 512
"""Consecutive rows on which a scale is found."""
_ENOUGH = 0.99
_BATCHES = 256
_NAMED = 5
"""Rows that are named in a line; all stand in the document."""


@dataclass(frozen=True)
class Scale:
    """How recorded values come from counts: value = each * count + zero.

    Attributes:
        each, zero: The two, in the unit of the file.
        what: Counts, the channel's unit, volts, or fitted.
        gain_ppm, zero_counts: How far off that they are.
        turned: Whether it has the other sign.
        known: Whether some rows have shown it; otherwise it is what the file's unit says.
    """

    each: float
    zero: float
    what: str
    gain_ppm: float = 0.0
    zero_counts: float = 0.0
    turned: bool = False
    known: bool = True

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
    pieces = [slice(n, n + _PIECE) for n in range(0, len(values) - _PIECE + 1, _PIECE)] or [slice(None)]
    candidates = _candidates(unit, channel)
    # Rows that are as most are show nothing of a scale.
    telling = [moving for p in pieces if (moving := counts[p] != np.median(counts[p])).any()]
    pieces = [p for p in pieces if (counts[p] != np.median(counts[p])).any()]
    for scale in candidates:
        same = scale.counts(values) == counts
        if any(
            same[p].mean() >= _ENOUGH and same[p][t].mean() >= _ENOUGH for p, t in zip(pieces, telling, strict=True)
        ):
            return scale
    for p, moving in zip(pieces, telling, strict=True):
        x, y = counts[p].astype(float), values[p]
        if not np.isfinite(y).all():
            continue
        each, zero = map(float, np.polyfit(x - x.mean(), y, 1))
        zero -= each * float(x.mean())
        if not each:
            continue
        scale = Scale(each, zero, "fitted")
        same = scale.counts(y) == counts[p]
        if same.mean() >= _ENOUGH and same[moving].mean() >= _ENOUGH:
            near = min(candidates, key=lambda one: abs(math.log(abs(each / one.each))))
            ratio = each / near.each
            # Digits that the file leaves out, and those of numbers, are no gain and no zero.
            unsure = 5.0 * float(np.std((y - zero) / each - x)) / math.sqrt(len(x))
            gain, shift = abs(ratio) - 1.0, (zero - ratio * near.zero) / each  # beside that gain, about a value of zero
            gain = gain if abs(gain) * np.std(x) > unsure + _NOTHING else 0.0
            shift = shift if abs(shift) > unsure * math.hypot(1.0, x.mean() / np.std(x)) + _NOTHING else 0.0
            return Scale(each, zero, f"fitted, beside {near.what}", 1e6 * gain, shift, ratio < 0.0)
    return None


def _candidates(unit: str, channel: Channel) -> list[Scale]:
    found = [Scale(1.0, 0.0, "counts")] if units.kind(unit) == "" or unit == channel.unit == "1" else []
    if not unit or units.kind(unit) == units.kind(channel.unit):
        size = units.size_si(channel.unit) / units.size_si(unit) if unit else 1.0
        found.append(Scale(channel.scale * size, channel.offset * size, channel.unit))
    if not unit or units.kind(unit) == "voltage":
        size = 1.0 / units.size_si(unit) if unit else 1.0
        found.append(Scale(channel.lsb_v * size, 0.0, "V"))
    return found or [Scale(1.0, 0.0, "counts")]


def settle(
    recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], session: Session
) -> tuple[dict[str, Wire], dict[str, Scale]]:
    """Which channel each signal has the counts of, and its scale, by its name in the file.

    Where most signals show counts, one that does not is looked for in all channels; if it is in none, it is the channel
    that it is named by, or alone is like, with what its unit says of its scale.
    """
    held = {group: session.early(group) for group in session.groups}

    def tried(name: str, of: str) -> tuple[np.ndarray, str, np.ndarray, Channel]:
        channel, signal, wire = session.channels[of], recorded[name], wires[name]
        counts = held[channel.group][:, session.groups[channel.group].index(of)]
        late = round(wire.late_s * session.rate_hz(channel.group))
        values, counts = signal.values[max(0, -late) :], counts[max(0, late) :]
        few = min(len(values), len(counts), 1 << 16)
        return values[:few], signal.unit, counts[:few], channel

    found, settled = dict(wires), {}
    for name, wire in wires.items():
        scale = find_scale(*tried(name, wire.channel)) if wire.channel else None
        if scale is not None:
            settled[name] = scale
    if 2 * len(settled) <= len(wires):
        return found, settled
    for name, wire in wires.items():
        for other in () if name in settled else sorted(session.channels, key=lambda each: each != name):
            if (scale := find_scale(*tried(name, other))) is not None:
                found[name], settled[name] = replace(wire, channel=other, rivals=()), scale
                break
        named = name if name in session.channels else "" if wire.rivals else wire.channel
        if name not in settled and named:
            values, unit, counts, channel = tried(name, named)
            apart = [
                float(np.nanmedian(np.abs(scale.each * counts + scale.zero - values) / scale.each))
                for scale in _candidates(unit, channel)
            ]
            found[name] = replace(wire, channel=named)
            settled[name] = replace(_candidates(unit, channel)[int(np.argmin(apart))], known=False)
    return found, settled


def score_digital(
    card: Scorecard, recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], scales: Mapping[str, Scale],
    session: Session, limits: Limits,
) -> None:  # fmt: skip
    """Put the rows of the digital path onto a scorecard."""
    for name, scale in scales.items():
        _score_scale(card, name, scale, session.channels[wires[name].channel], limits)
    tables: dict[tuple[int, float], list[str]] = {}
    for name in sorted(scales, key=lambda each: not scales[each].known):
        rate_hz = session.rate_hz(session.channels[wires[name].channel].group)
        tables.setdefault((recorded[name].rows, rate_hz), []).append(name)
    for names in tables.values():
        _score_rows(card, names, wires, recorded, scales, session, limits)
    for quantity in ("latency", "trigger row"):
        card.rows.append(judge_row("digital", quantity, "", None, limit=limits.bounds("digital", quantity)))


def _exact(count: float) -> tuple[float, float, float]:
    return float(count), float(count), float(count)


def _score_scale(card: Scorecard, name: str, scale: Scale, channel: Channel, limits: Limits) -> None:
    note = f"{scale.what}: {scale.each:.9g} a count, {scale.zero:.9g} at zero"
    note += "" if scale.known else ", as no stretch of rows shows another: its values are not what was sent"
    for quantity, off in (("scale", scale.gain_ppm), ("offset", scale.zero_counts)):
        limit = limits.bounds("digital", quantity, channel)
        card.rows.append(
            judge_row("digital", quantity, name, _exact(off) if scale.known else None, limit=limit, note=note)
        )


def _score_rows(
    card: Scorecard, names: Sequence[str], wires: Mapping[str, Wire], recorded: Mapping[str, Recorded],
    scales: Mapping[str, Scale], session: Session, limits: Limits,
) -> None:  # fmt: skip
    """Follow the rows of signals that are as long as each other, and judge what became of them and of their stamps."""
    groups = list(dict.fromkeys(session.channels[wires[name].channel].group for name in names))
    table = "all groups" if len(groups) == len(session.groups) > 1 else ", ".join(groups)
    sound = sum(scales[name].known for name in names)
    if not sound:
        for name in names:
            limit = limits.bounds("digital", "altered values")
            note = "none of its signals shows which row is which"
            card.rows.append(judge_row("digital", "altered values", name, None, limit=limit, note=note))
        return
    sent = Sent(session, groups)
    columns = [sent.names.index(wires[name].channel) for name in names]

    def counts() -> Iterator[np.ndarray]:
        for part in in_parts([recorded[name].values for name in names]):
            yield np.column_stack([scales[name].counts(values) for name, values in zip(names, part, strict=True)])

    rate_hz = session.rate_hz(groups[0])
    stamps = Stamps(recorded[names[0]].times_s)
    found = Followed()
    for places, found in follow((chunk[:, columns] for chunk in sent), counts(), sound):  # noqa: B007
        known = places >= 0
        first = sent.numbers(np.zeros(1, np.int64))
        stamps.take(sent.first_s, (sent.numbers(places[known]) - first) / rate_hz, known)

    def add(quantity: str, channel: str, rows: int, runs: np.ndarray, *, numbered: bool = True) -> None:
        note = ""
        if len(runs):
            told = [(a, b) for a, b in (sent.numbers(runs) if numbered else runs).tolist()]
            card.runs[f"{quantity} {channel}"] = told
            note = "rows " + ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in told[:_NAMED])
            note += f" and {len(told) - _NAMED} more stretches" if len(told) > _NAMED else ""
        limit = limits.bounds("digital", quantity)
        card.rows.append(judge_row("digital", quantity, channel, _exact(rows), limit=limit, note=note))

    add("missing rows", table, len(found.missing), stretches(found.missing))
    for quantity, pairs in (("doubled rows", found.doubled), ("swapped rows", found.swapped)):
        add(quantity, table, len(pairs), stretches(np.unique(pairs[:, 0])))
    add("foreign rows", table, len(found.foreign), stretches(found.foreign), numbered=False)
    for name, altered in zip(names, found.altered, strict=True):
        add("altered values", name, altered.rows, altered.pairs())
    none = stretches(np.empty(0, dtype=np.int64))
    add("rows before the first", table, max(0, found.first), none)
    add("rows after the last", table, found.sent - 1 - found.last, none)
    for quantity, estimate in stamps.judged().items():
        limit = limits.bounds("digital", quantity)
        card.rows.append(judge_row("digital", quantity, table, estimate, limit=limit))
    card.pictures[f"stamps {table}"] = stamps.picture()


class Stamps:
    """Time stamps against the times of the rows that they stand beside: offset and rate are two questions."""

    def __init__(self, times_s: np.ndarray | None) -> None:
        """Take stamps [s]; None where there are none."""
        self._times_s = times_s
        self._at, self._back, self._last_s = 0, 0, -math.inf
        self._means: list[np.ndarray] = []
        self._squares, self._freedom = 0.0, 0

    def take(self, first_s: float, since_s: np.ndarray, known: np.ndarray) -> None:
        """Take when the first row was sent, how long after it those of the next that are known [s], and which are."""
        part = slice(self._at, self._at + len(known))
        self._at = part.stop
        if self._times_s is None or not len(known):
            return
        times_s = self._times_s[part]
        self._back += int(np.count_nonzero(np.diff(times_s, prepend=self._last_s) <= 0.0))
        self._last_s = float(times_s[-1])
        apart = times_s[known] - first_s - since_s
        size = max(4, len(self._times_s) // _BATCHES)
        for begin in range(0, len(apart) - size + 1, size):
            late = apart[begin : begin + size]
            self._means.append(np.array([since_s[begin : begin + size].mean(), late.mean()]))
            self._squares += float(np.sum((late - late.mean()) ** 2))
            self._freedom += size - 1

    def judged(self) -> dict[str, tuple[float, float, float] | None]:
        """Offset at the first row [s], rate [ppm], jitter [s] and steps back: value, low, high; None: not told."""
        names = ("stamp offset", "stamp rate", "stamp jitter", "stamps that go back")
        if self._times_s is None:
            return dict.fromkeys(names)
        found: dict[str, tuple[float, float, float] | None] = dict.fromkeys(names)
        found["stamps that go back"] = _exact(self._back)
        if len(self._means) < 8:
            return found
        from scipy.stats import chi2

        since, late = np.array(self._means).T
        matrix = np.column_stack([np.ones(len(since)), since])
        parts = np.linalg.lstsq(matrix, late, rcond=None)[0]
        left = late - matrix @ parts
        freedom = len(left) - 2
        covariance = np.linalg.inv(matrix.T @ matrix) * float(left @ left) / freedom
        half = student(freedom) * np.sqrt(np.diag(covariance))
        for name, n, size in (("stamp offset", 0, 1.0), ("stamp rate", 1, 1e6)):
            found[name] = size * parts[n], size * (parts[n] - half[n]), size * (parts[n] + half[n])
        ends = [math.sqrt(self._squares / chi2.ppf(p, self._freedom)) for p in (0.975, 0.025)]
        found["stamp jitter"] = math.sqrt(self._squares / self._freedom), ends[0], ends[1]
        return found

    def picture(self) -> np.ndarray:
        """Time since the first row, and lateness, of each batch [s], shape (n, 2)."""
        return np.array(self._means).reshape(-1, 2)
