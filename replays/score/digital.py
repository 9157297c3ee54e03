"""The digital path: the DAQ took the rig's counts, so every row has to be there once, in order, with every count.

Rows are followed among those sent (`rows`); counts are recovered by a scale that is found for each channel and must
then be exact. Time stamps are held against the times of the rows that they stand beside.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from replays.score.limits import Limits
from replays.score.rows import NO_COUNT, Followed, follow
from replays.score.scorecard import Bounds, Scorecard, judge_row
from replays.score.signals import Recorded, Session, in_parts
from replays.score.waveform import student
from replays.score.wiring import Wire
from rig import units
from rig.channels import Channel

_NEAR = 0.49
"""Part of a count by which a recovered one may be off a whole number: rounding of the file."""
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
    """

    each: float
    zero: float
    what: str
    gain_ppm: float = 0.0
    zero_counts: float = 0.0

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
    for scale in candidates:
        back = scale.counts(values)
        if any((back[p] == counts[p]).mean() >= _ENOUGH and np.ptp(counts[p]) for p in pieces):
            return scale
    for p in pieces:
        x, y = counts[p].astype(float), values[p]
        if not np.ptp(x) or not np.isfinite(y).all():
            continue
        each, zero = np.polyfit(x - x.mean(), y, 1)
        zero -= each * x.mean()
        if not each:
            continue
        scale = Scale(float(each), float(zero), "fitted")
        if (scale.counts(y) == counts[p]).mean() >= _ENOUGH:
            near = min(candidates, key=lambda one: abs(math.log(abs(each / one.each))))
            ratio = float(each / near.each)
            zero_counts = float((zero - ratio * near.zero) / each)  # beside that gain, about a value of zero
            return Scale(scale.each, scale.zero, f"fitted, beside {near.what}", 1e6 * (abs(ratio) - 1.0), zero_counts)
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


def scales_of(recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], session: Session) -> dict[str, Scale | None]:
    """The scale of each signal that is connected, by its name in the file."""
    found: dict[str, Scale | None] = {}
    held = {group: session.early(group) for group in session.groups}
    for name, wire in wires.items():
        if wire.channel:
            channel = session.channels[wire.channel]
            counts = held[channel.group][:, session.groups[channel.group].index(wire.channel)]
            late = round(wire.late_s * session.rate_hz(channel.group))
            values = recorded[name].values[max(0, -late) :][: len(counts) - max(0, late)]
            counts = counts[max(0, late) :][: len(values)]
            few = min(len(values), len(counts), 1 << 16)
            enough = few >= 2
            found[name] = find_scale(values[:few], recorded[name].unit, counts[:few], channel) if enough else None
    return found


def score_digital(
    card: Scorecard, recorded: Mapping[str, Recorded], wires: Mapping[str, Wire], scales: Mapping[str, Scale | None],
    session: Session, limits: Limits,
) -> None:  # fmt: skip
    """Put the rows of the digital path onto a scorecard."""
    for name, scale in scales.items():
        _score_scale(card, name, scale, session.channels[wires[name].channel], limits)
    for group, names in session.groups.items():
        members = [n for n, scale in scales.items() if scale is not None and wires[n].channel in names]
        for rows in sorted({recorded[name].rows for name in members}):
            alike = [name for name in members if recorded[name].rows == rows]
            columns = [names.index(wires[name].channel) for name in alike]
            _score_rows(card, group, alike, columns, recorded, scales, session, limits)
    for quantity in ("latency", "trigger row"):
        card.rows.append(judge_row("digital", quantity, "", None, limit=limits.bounds("digital", quantity)))


def _exact(count: float) -> tuple[float, float, float]:
    return float(count), float(count), float(count)


def _score_scale(card: Scorecard, name: str, scale: Scale | None, channel: Channel, limits: Limits) -> None:
    bounds = [limits.bounds("digital", each, channel) for each in ("scale", "offset")]
    if scale is None:
        note = "its counts cannot be told from the values: fewer digits, or an analogue path"
        card.rows += [
            judge_row("digital", each, name, None, limit=bound, note=note)
            for each, bound in zip(("scale", "offset"), bounds, strict=True)
        ]
        return
    note = f"{scale.what}: {scale.each:.9g} a count, {scale.zero:.9g} at zero"
    card.rows.append(judge_row("digital", "scale", name, _exact(scale.gain_ppm), limit=bounds[0], note=note))
    card.rows.append(judge_row("digital", "offset", name, _exact(scale.zero_counts), limit=bounds[1], note=note))


def _score_rows(
    card: Scorecard, group: str, names: Sequence[str], columns: Sequence[int], recorded: Mapping[str, Recorded],
    scales: Mapping[str, Scale | None], session: Session, limits: Limits,
) -> None:  # fmt: skip
    """Follow the rows of one group, and judge what became of them and of their stamps."""
    chosen = [(recorded[name].values, scales[name]) for name in names]

    def counts() -> Iterator[np.ndarray]:
        for part in in_parts([values for values, _ in chosen]):
            yield np.column_stack([s.counts(v) for v, (_, s) in zip(part, chosen, strict=True) if s is not None])

    sent = (chunk[:, columns] for chunk in session.counts(group))
    times_s = recorded[names[0]].times_s
    stamps = Stamps(times_s, session.first_s(group), session.rate_hz(group))
    found = Followed()
    for places, found in follow(sent, counts()):  # noqa: B007
        stamps.take(session.numbers(group, places) - session.numbers(group, np.zeros(1, np.int64)), places >= 0)

    def add(quantity: str, count: int, channel: str, places: np.ndarray) -> None:
        limit = limits.bounds("digital", quantity)
        note = ""
        if len(places):
            runs = _runs(session.numbers(group, places)) if quantity != "foreign rows" else _runs(places)
            card.runs[f"{quantity} {channel}"] = runs
            told = ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in runs[:_NAMED])
            note = f"rows {told}" + (f" and {len(runs) - _NAMED} more stretches" if len(runs) > _NAMED else "")
        card.rows.append(judge_row("digital", quantity, channel, _exact(count), limit=limit, note=note))

    missing = found.missing
    add("missing rows", len(missing), group, missing)
    add("doubled rows", len(found.doubled), group, np.unique(found.doubled[:, 0]))
    add("swapped rows", len(found.swapped), group, found.swapped[:, 0])
    add("foreign rows", len(found.foreign), group, found.foreign)
    for name, wrong in zip(names, found.wrong.tolist(), strict=True):
        add("altered values", wrong, name, np.unique(found.altered[:, 0]) if wrong else np.empty(0))
    add("rows before the first", max(0, found.first), group, np.empty(0))
    add("rows after the last", found.sent - 1 - found.last, group, np.empty(0))
    for quantity, estimate in stamps.judged().items():
        bound: Bounds | None = limits.bounds("digital", quantity)
        card.rows.append(judge_row("digital", quantity, group, estimate, limit=bound))
    card.pictures[f"stamps {group}"] = stamps.picture()


def _runs(places: np.ndarray) -> list[tuple[int, int]]:
    """Ascending stretches as pairs of first and last."""
    if not len(places):
        return []
    places = np.sort(places)
    cuts = np.flatnonzero(np.diff(places) != 1)
    firsts, lasts = np.concatenate([[0], cuts + 1]), np.concatenate([cuts, [len(places) - 1]])
    return list(zip(places[firsts].tolist(), places[lasts].tolist(), strict=True))


class Stamps:
    """Time stamps against the times of the rows that they stand beside: offset and rate are two questions."""

    def __init__(self, times_s: np.ndarray | None, first_s: float, rate_hz: float) -> None:
        """Take stamps [s], None where there are none, and when the first row was sent [s], and how often [Hz]."""
        self._times_s, self._first_s, self._rate_hz = times_s, first_s, rate_hz
        self._at, self._back, self._last_s = 0, 0, -math.inf
        self._means: list[np.ndarray] = []
        self._squares, self._freedom = 0.0, 0

    def take(self, numbers: np.ndarray, known: np.ndarray) -> None:
        """Take numbers of the next rows from the first one sent, and which of them are known, each shape (n,)."""
        part = slice(self._at, self._at + len(numbers))
        self._at = part.stop
        if self._times_s is None or not len(numbers):
            return
        times_s = self._times_s[part]
        self._back += int(np.count_nonzero(np.diff(times_s, prepend=self._last_s) <= 0.0))
        self._last_s = float(times_s[-1])
        true_s = self._first_s + numbers[known] / self._rate_hz
        apart = times_s[known] - true_s
        size = max(4, len(self._times_s) // _BATCHES)
        for begin in range(0, len(apart) - size + 1, size):
            late, true = apart[begin : begin + size], true_s[begin : begin + size]
            self._means.append(np.array([true.mean(), late.mean()]))
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

        true, late = np.array(self._means).T
        since = true - self._first_s
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
        """Time and lateness of each batch [s], shape (n, 2)."""
        return np.array(self._means).reshape(-1, 2)
