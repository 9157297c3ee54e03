"""Signals: the one input of all plots, built from a run, a recording, or samples.

Values are engineering values with their times; rows that are missing stay missing. Groups of a recording are read when
they are used, only within the requested times. What was read and computed last is kept, up to a size.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from replays.estimate.intervals import format_with_half_width, student_quantile
from replays.estimate.runs import split_at_breaks
from rig.base import units
from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.samples import Columns, Samples, merge_samples
from rig.base.wire import sensor_key, truth_key
from rig.channels.orbit import PULSE_LEVEL, find_edges, fit_turns
from rig.channels.table import ChannelTable
from rig.physics.parameters import SI

if TYPE_CHECKING:
    from rig.physics.model import Model

_AXIS = re.compile(r"(.*?)[ _.-]?([xy])", re.IGNORECASE)
"""Name of a probe of a pair: a common part, and its direction."""
_CLEARANCES = {"ring": (), "disk": ("shaft.arm_disk", "shaft.arm_ring")}
"""Planes of the rig with a clearance circle, by the signal of their probes; the clearance of the ring is multiplied by
the ratio of the arms."""
TRUTH = "truth."
"""Prefix of quantities of the model: `truth.normal_force`."""

Load = Callable[[str, float, float], Samples]
"""Function of a group and the times of its first and last row [s] that returns at least these rows."""


_SPAN_ANGLES = 721
"""Angles of a revolution at which a peak-to-peak value is read."""
_MIN_SLOW_TURNS = 2
"""Fewest revolutions of slow roll, so that their scatter shows an uncertainty."""
_MAX_SLOW_PART = 0.25
"""Largest speed of slow roll relative to that of the recording, so that at most a sixteenth of its 1X is unbalance."""
_CACHE_BYTES = 100_000_000
"""Size up to which earlier results of one kind are kept in addition to the latest: all groups of some seconds."""


class Cache:
    """The latest results of one source, such as groups; large ones are dropped before the next one is computed."""

    def __init__(self) -> None:
        self._results: dict[tuple[Hashable, ...], Any] = {}

    def recall(self, key: tuple[Hashable, ...], compute: Callable[[], Any]) -> Any:
        """Return samples or a tuple of arrays, computed unless they are kept.

        Args:
            key: Kind of the result, and what it depends on; a group (`load`) replaces results of all kinds.
            compute: Function without arguments that computes it.
        """
        result = self._results.pop(key, None)
        if result is None:
            kept = {each: value for each, value in self._results.items() if key[0] in ("load", each[0])}
            while sum(map(_count_bytes, kept.values())) > _CACHE_BYTES:
                oldest = next(iter(kept))
                del kept[oldest], self._results[oldest]
            kept.clear()
            result = compute()
        self._results[key] = result
        return result


def _count_bytes(result: Any) -> int:
    """Return the size of samples, or of a tuple of arrays."""
    arrays = (result.times_s, result.index, result.values) if isinstance(result, Samples) else result
    return sum(each.nbytes for each in arrays if isinstance(each, np.ndarray))


class Pair(NamedTuple):
    """Signals of two perpendicular probes, x to the right and y up.

    Attributes:
        name: Common part of the names.
        names: Names of the two channels.
        x, y: Displacements, without gaps in the values; rows may be missing, shape (n,).
        samples: The same rows with times, numbers and unit.
        clearance: Radius of the clearance circle, in the unit; None if it is not known.
    """

    name: str
    names: tuple[str, str]
    x: np.ndarray
    y: np.ndarray
    samples: Samples
    clearance: float | None

    @property
    def xy(self) -> np.ndarray:
        """Displacements, shape (n, 2)."""
        values = self.samples.values
        return values if np.may_share_memory(self.x, values) else np.stack([self.x, self.y], axis=1)

    @property
    def unit(self) -> str:
        """Unit of the displacements."""
        return self.samples.units[0]


@dataclass(frozen=True, eq=False)
class Runout:
    """Run-out of probes: the waveform per revolution that remains at slow roll, as its Fourier components.

    Attributes:
        vectors: Components by channel: 1X, 2X, ..., relative to the keyphasor, in the channel's unit.
        halves: Half of the 95 % interval of the waveform by channel, from the scatter of the revolutions.
        turns: Fewest revolutions of a channel.
    """

    vectors: Mapping[str, np.ndarray]
    halves: Mapping[str, float] = field(default_factory=dict)
    turns: int = 0

    def compute(self, channel: str, angle: np.ndarray) -> np.ndarray:
        """Return the run-out of a channel at angles from the keyphasor's passage [rad], shape (n,)."""
        waves = [np.real(vector * np.exp(1j * k * angle)) for k, vector in enumerate(self.vectors[channel], 1)]
        return np.sum(waves, axis=0)

    def measure_span(self, channel: str) -> float:
        """Return the peak-to-peak value of the run-out of a channel, in its unit."""
        return float(np.ptp(self.compute(channel, np.linspace(0.0, 2.0 * math.pi, _SPAN_ANGLES))))


def _is_number(value: Any, low: float = -math.inf) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and bool(value >= low)


def _is_whole(value: Any, low: int, high: float) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(low <= value <= high)


def _is_list(value: Any, valid: Callable[[Any], bool]) -> bool:
    return isinstance(value, Iterable) and all(map(valid, value))


_RULES: Mapping[str, tuple[str, Callable[[Any], bool]]] = {
    **dict.fromkeys(("from_s", "to_s"), ("a number", _is_number)),
    **dict.fromkeys(
        ("last_s", "max_hz", "window_s", "max_order", "max_speed_hz"),
        ("a number greater than 0", lambda value: _is_number(value, 1e-300)),
    ),
    "clearance": ("a number of at least 0", lambda value: _is_number(value, 0.0)),
    "turns": ("a whole number of at least 1", lambda value: _is_whole(value, 1, math.inf)),
    "orders": (
        "a list of whole numbers from 1 to 100",
        lambda value: _is_list(value, lambda one: _is_whole(one, 1, 100)) and len(value) > 0,
    ),
    **dict.fromkeys(
        ("channels", "components"),
        ("a name or a list", lambda value: _is_list(value, lambda one: isinstance(one, str))),
    ),
    "pair": ("a name", lambda value: isinstance(value, str)),
    "runout": ("a run-out, of measure_runout", lambda value: isinstance(value, Runout)),
    "probe_angles_deg": (
        "two directions in degrees",
        lambda value: _is_list(value, lambda one: _is_number(one, -1e6)) and len(value) == 2,
    ),
}
"""Requirement of each option in words, and a function that returns whether a value meets it."""
_REQUIRED = ("orders", "turns", "probe_angles_deg")
"""Options that cannot be None."""


def check_options(**options: Any) -> None:
    """Check the types and ranges of options of plots.

    Raises:
        InputError: A value is invalid.
    """
    for name, value in options.items():
        must, valid = _RULES.get(name, ("", lambda _: True))
        if not valid(value) and (value is not None or name in _REQUIRED):
            raise InputError(name, must, " ".join(f"{value}".split()) if isinstance(value, np.ndarray) else value)


@dataclass(frozen=True)
class Signals:
    """Channels of one run, with keyphasor and clearance.

    Attributes:
        title: Name for the picture.
        channels: Group and unit by channel, in the order of the table; truth last.
        span_s: Times of the first and the last row [s].
        load: Reads a group.
        load_edges: Reads the keyphasor's passages between two times [s].
        clearances: Clearance by channel, in its unit.
        events: Reads the events.
        model: Builds the model of the rig; None for data without one.
        runout: Run-out to subtract.
        probe_angles_deg: Directions of the x and the y probe, counter-clockwise from the right [degrees].
        cache: Results that several plots use.
    """

    title: str
    channels: Mapping[str, tuple[str, str]]
    span_s: tuple[float, float]
    load: Load
    load_edges: Callable[[float, float], np.ndarray]
    clearances: Mapping[str, float]
    events: Callable[[], Sequence[Mapping[str, Any]]] = list
    model: Callable[[], Model] | None = None
    runout: Runout | None = None
    probe_angles_deg: tuple[float, float] = (0.0, 90.0)
    cache: Cache = field(default_factory=Cache)

    def recall(self, what: str, compute: Callable[[], Any], *options: Hashable) -> Any:
        """Return a result of these signals that several plots use, computed unless the cache has it.

        Args:
            what: Name of the result.
            compute: Computes it: samples, or a tuple of arrays.
            options: What it depends on, apart from the signals.
        """
        return self.cache.recall((what, *self.span_s, *self.probe_angles_deg, self.runout, *options), compute)

    @property
    def names(self) -> tuple[str, ...]:
        """Measured channels, without the truth."""
        return tuple(name for name in self.channels if not name.startswith(TRUTH))

    @property
    def edges_s(self) -> np.ndarray:
        """Times of the keyphasor's passages [s], ascending, shape (n,)."""
        edges_s = np.unique(self.load_edges(*self.span_s))
        return edges_s[(edges_s >= self.span_s[0]) & (edges_s <= self.span_s[1])]

    def require_edges(self, what: str) -> np.ndarray:
        """Return the keyphasor's passages.

        Raises:
            InputError: There are fewer than two.
        """
        if len(edges_s := self.edges_s) < 2:
            raise InputError(what, "drawn with at least two keyphasor passages", Words(f"{len(edges_s)}"))
        return edges_s

    def require_model(self, what: str) -> Model:
        """Return the model of the rig.

        Raises:
            InputError: The data are without one, or this version does not know its parameters.
        """
        if self.model is None:
            raise InputError(what, "drawn of a run or a recording of the rig, which has its model", Words("none"))
        return self.model()

    def read(self, *names: str) -> Samples:
        """Return channels, with the rows that all of them have, in order of time.

        Raises:
            UnknownNameError: A channel does not exist.
            InputError: Channels have different rates.
        """
        for name in names:
            if name not in self.channels:
                raise UnknownNameError("channels", "channels of the data", name, self.channels)
        return self.recall("read", lambda: self._read(names), *names) if len(names) > 1 else self._read(names)

    def _read(self, names: Sequence[str]) -> Samples:
        groups: dict[str, list[str]] = {}
        for name in names:
            groups.setdefault(self.channels[name][0], []).append(name)
        parts = [self.load(group, *self.span_s).select(*each) for group, each in groups.items()]
        whole = parts[0] if len(parts) == 1 else merge_samples(parts).select(*names)
        first, last = self.span_s
        kept = (whole.times_s >= first) & (whole.times_s <= last) & np.isfinite(whole.values).all(axis=1)
        if not (np.diff(whole.times_s) > 0.0).all():  # rows arrived late or twice
            order = np.unique(whole.times_s, return_index=True)[1]
            rows: Any = order[kept[order]]
        else:
            rows = slice(None) if kept.all() else kept
        times_s, values = whole.times_s[rows], whole.values[rows]
        if self.runout is not None and (known := [name for name in names if name in self.runout.vectors]):
            angle = 2.0 * math.pi * compute_revolutions(times_s, self.require_edges("run-out"))
            values = values.copy()
            for name in known:
                values[:, names.index(name)] -= self.runout.compute(name, angle)
        return replace(whole, times_s=times_s, index=whole.index[rows], values=values)

    @property
    def pairs(self) -> dict[str, tuple[str, str]]:
        """Names of perpendicular probes by the common part of their names, lengths first."""
        found: dict[tuple[str, str], dict[str, str]] = {}
        for name in self.names:
            if match := _AXIS.fullmatch(name):
                found.setdefault((match[1], self.channels[name][1]), {})[match[2].lower()] = name
        pairs = {stem or "x, y": (each["x"], each["y"]) for (stem, _), each in found.items() if len(each) == 2}
        return dict(sorted(pairs.items(), key=lambda pair: not self.is_length(pair[1][0])))

    def require_pairs(self) -> dict[str, tuple[str, str]]:
        """Return the pairs of probes.

        Raises:
            InputError: There is none.
        """
        if not (pairs := self.pairs):
            raise InputError("channels", "with a pair of probes, such as disk_x and disk_y", ", ".join(self.names))
        return pairs

    def list_channels(self, names: Sequence[str] | str = ()) -> list[str]:
        """Return channels by their names or those of pairs; without names, the first pair.

        Raises:
            InputError: There are no names and no pair.
        """
        if isinstance(names, str):
            names = [names]
        pairs = self.pairs if names else self.require_pairs()
        return [each for name in names or list(pairs)[:1] for each in pairs.get(name, (name,))]

    def get_direction_deg(self, name: str) -> float:
        """Return the direction of a probe, counter-clockwise from the right [degrees]."""
        return self.probe_angles_deg[any(name == y for _, y in self.pairs.values())]

    def is_length(self, name: str) -> bool:
        """Return whether a channel measures a length."""
        return units.get_quantity(self.channels[name][1]) == "length"

    def read_pair(self, name: str | None = None) -> Pair:
        """Return the signals of two perpendicular probes, by default the first pair.

        Raises:
            InputError: There is no pair, or no row of it.
            UnknownNameError: There is no pair of this name.
        """
        pairs = self.require_pairs()
        if name is None:
            name = next(iter(pairs))
        if name not in pairs:
            raise UnknownNameError("pair", "a pair of probes", name, pairs)
        names = pairs[name]
        samples = self.read(*names)
        if len(samples) < 2:
            raise InputError("times", f"with samples of {name}", Words("{:g} to {:g} s".format(*self.span_s)))
        directions = np.radians(self.probe_angles_deg)
        readings = np.stack([np.cos(directions), np.sin(directions)], axis=1)
        if abs(np.linalg.det(readings)) < 0.1:
            raise InputError("probe_angles_deg", "two directions that differ", self.probe_angles_deg)
        x, y = samples.values.T
        if self.probe_angles_deg != (0.0, 90.0):
            x, y = np.linalg.solve(readings, samples.values.T)
        return Pair(name, names, x, y, samples, self.clearances.get(names[0]))


def compute_revolutions(times_s: np.ndarray, edges_s: np.ndarray) -> np.ndarray:
    """Return the angle of the shaft from the first keyphasor passage [revolutions], shape (n,).

    Monotone cubic between passages, so that the speed may change within a revolution; before the first and after the
    last one, the mean speed of the nearest revolution.

    Args:
        times_s: Times [s], shape (n,).
        edges_s: At least two passages [s], ascending.
    """
    from scipy.interpolate import PchipInterpolator

    revolutions = PchipInterpolator(edges_s, np.arange(len(edges_s)))(np.clip(times_s, edges_s[0], edges_s[-1]))
    for rows, at, nearest in ((times_s < edges_s[0], 0, 1), (times_s > edges_s[-1], -1, -2)):
        revolutions[rows] += (times_s[rows] - edges_s[at]) / abs(edges_s[at] - edges_s[nearest])
    return revolutions


def fit_orders(
    samples: Samples, values: np.ndarray, edges_s: np.ndarray, orders: tuple[int, ...] = (1,)
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and synchronous components of each revolution, as of `rig.channels.orbit.fit_turns`.

    Args:
        samples: Times of the values.
        values: Signals, shape (n, signals).
        edges_s: Keyphasor passages [s].
        orders: Multiples of the speed.
    """
    if len(edges_s) < 2:
        return fit_turns(values, samples.times_s, edges_s, orders)
    revolutions = compute_revolutions(samples.times_s, edges_s)
    return fit_turns(values, samples.times_s, edges_s, orders, revolutions=revolutions)


def check_speeds(speed_hz: np.ndarray) -> None:
    """Raise an error unless the speed changes by a tenth.

    Raises:
        InputError: It does not.
    """
    if speed_hz.max(initial=0.0) < 1.1 * speed_hz.min(initial=np.inf):
        received = Words(f"{speed_hz.min():.2f} to {speed_hz.max():.2f} Hz" if len(speed_hz) else "none")
        raise InputError("speed", "that of a run-up or a coast-down, which changes by a tenth", received)


def find_pieces(samples: Samples) -> list[slice]:
    """Return the rows between gaps, in order."""
    return [slice(*piece) for piece in split_at_breaks(np.diff(samples.index) != 1)] if len(samples) else []


def break_lines(breaks: np.ndarray, *columns: np.ndarray) -> Iterator[np.ndarray]:
    """Yield columns with a nan at each break, where a line is interrupted.

    Args:
        breaks: Whether a row does not continue the previous one, from the second row on, shape (n - 1,).
        columns: Each of shape (n,).
    """
    at = np.flatnonzero(breaks) + 1
    for column in columns:
        yield np.insert(column.astype(float), at, np.nan)


def measure_runout(source: Any, *, orders: int = 1, max_hz: float | None = None, **options: Any) -> Runout:
    """Measure the run-out of all probes at slow roll, by averaging over revolutions.

    Args:
        source: A run, a recording or samples that contains slow roll.
        orders: Number of components: 1 for the slow-roll vector (1X), 2 for 1X and 2X; 32 for the waveform.
        max_hz: Largest speed of the revolutions used [Hz]; None for all.
        options: Options of `read_signals`, such as `from_s` and `to_s`.

    Raises:
        InputError: There is no such revolution, or no probe.
    """
    if not _is_whole(orders, 1, math.inf):
        raise InputError("orders", "a whole number of at least 1", orders)
    check_options(max_hz=max_hz)
    signals = read_signals(source, **options)
    edges_s, vectors, halves = signals.require_edges("run-out"), dict[str, np.ndarray](), dict[str, float]()
    counts = list[int]()
    probes = [name for pair in signals.require_pairs().values() for name in pair]
    for name in [name for name in probes if signals.is_length(name)] or probes:
        samples = signals.read(name)
        turns, fitted = fit_orders(samples, samples.values, edges_s, tuple(range(1, orders + 1)))
        slow = np.diff(edges_s)[turns] >= (0.0 if max_hz is None else 1.0 / max_hz)
        if not slow.any():
            raise InputError("max_hz", f"above the speed of a whole revolution of {name}", max_hz)
        vectors[name], count = fitted[slow, 1:, 0].mean(axis=0), int(slow.sum())
        spread = math.sqrt(0.5 * float(fitted[slow, 1:, 0].var(axis=0).sum()) / max(1, count - 1))
        halves[name] = spread * float(student_quantile(0.975, count - 1)) if count > 1 else math.inf
        counts.append(count)
    return Runout(vectors, halves, min(counts))


def subtract_runout(recording: Any, slow: Any, *, orders: int, from_s: float | None, to_s: float | None) -> Any:
    """Return a recording whose samples are read without the run-out of a slow roll, by the angle of the shaft.

    Args:
        recording: The recording.
        slow: Recording with slow roll, of the same probes.
        orders: Number of components of the waveform.
        from_s: Begin of the slow roll [s]; None for the first row.
        to_s: End of the slow roll [s]; None for the last row.

    Raises:
        InputError: One of them has no keyphasor, the slow roll is too fast or too short, or the probes differ.
    """
    field, edges_s = "--run-out", list[np.ndarray]()
    for one, span in ((recording, (None, None)), (slow, (from_s, to_s))):
        edges_s.append(read_signals(one, from_s=span[0], to_s=span[1]).edges_s)
        if len(edges_s[-1]) < 2:
            must = "used with recordings that have a keyphasor, and at least two of its passages"
            raise InputError(field, must, Words(f"{len(edges_s[-1])} in {one.path.name}"))
    speed_hz = 1.0 / float(np.median(np.diff(edges_s[0])))
    if len(edges_s[1]) <= _MIN_SLOW_TURNS:
        must = f"a slow roll of at least {_MIN_SLOW_TURNS} whole revolutions"
        raise InputError(field, must, Words(f"{len(edges_s[1]) - 1} in {slow.path.name}"))
    slow_hz = 1.0 / float(np.diff(edges_s[1]).min())
    if slow_hz > _MAX_SLOW_PART * speed_hz:
        must = f"a slow roll of at most {_MAX_SLOW_PART * speed_hz:.3g} Hz, a quarter of the recording's speed"
        raise InputError(field, must, Words(f"{slow_hz:.3g} Hz in {slow.path.name}"))
    runout = measure_runout(slow, orders=orders, from_s=from_s, to_s=to_s)
    units_of, slow_units = ({name: one.unit for name, one in each.table.channels.items()} for each in (recording, slow))
    if not (known := [name for name in runout.vectors if units_of.get(name) == slow_units[name]]):
        must = "a slow roll of probes of the recording, with the same names and units"
        raise InputError(field, must, Words(f"{', '.join(runout.vectors)} in {slow.path.name}"))

    def correct(samples: Samples) -> None:
        angle = 2.0 * math.pi * compute_revolutions(samples.times_s, edges_s[0])
        for name in set(known).intersection(samples.names):
            samples.values[:, samples.names.index(name)] -= runout.compute(name, angle)

    spans = [
        f"{name} {format_with_half_width(runout.measure_span(name), 2.0 * runout.halves[name])} {slow_units[name]}"
        for name in known
    ]
    text = (
        f"run-out subtracted: {', '.join(spans)} peak to peak, from {runout.turns} revolutions at {slow_hz:.3g} Hz of "
    )
    text += f"{slow.path.name}; up to {(slow_hz / speed_hz) ** 2:.1%} of the 1X of unbalance is subtracted with it"
    return recording.with_correction(text, correct)


def read_signals(
    source: Any,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    last_s: float | None = None,
    runout: Runout | None = None,
    probe_angles_deg: tuple[float, float] = (0.0, 90.0),
) -> Signals:
    """Return the signals of a run, a recording or samples.

    Args:
        source: A run, a recording, samples (of a run, a recording or a client), or signals.
        from_s: Time of the first row [s]; None for the first.
        to_s: Time of the last row [s]; None for the last.
        last_s: Use only the end, of this length [s].
        runout: Run-out to subtract, of `measure_runout`.
        probe_angles_deg: Directions of the x and the y probe, counter-clockwise from the right [degrees]; (45, 135) for
            probes 45 degrees right and left of the top.

    Raises:
        InputError: The source is of another kind, or has no rows in this interval.
    """
    check_options(from_s=from_s, to_s=to_s, last_s=last_s, runout=runout, probe_angles_deg=probe_angles_deg)
    if isinstance(source, Signals):
        signals = source
    elif isinstance(source, Columns):
        signals = _read_samples(source)
    elif hasattr(source, "sampled"):
        signals = _read_run(source)
    elif hasattr(source, "span_s") and hasattr(source, "edges"):
        signals = _read_recording(source)
    else:
        raise InputError("source", "a run, a recording or samples", Words(type(source).__name__))
    begin, end = signals.span_s
    first, last = begin if from_s is None else max(begin, from_s), end if to_s is None else min(end, to_s)
    if not last > first:
        raise InputError("from_s and to_s", f"within {begin:g} to {end:g} s", Words(f"{from_s} to {to_s}"))
    if last_s is not None:
        first = max(first, last - last_s)
    return replace(
        signals,
        span_s=(first, last),
        runout=signals.runout if runout is None else runout,
        probe_angles_deg=(float(probe_angles_deg[0]), float(probe_angles_deg[1])),
    )


def _read_samples(source: Any) -> Signals:
    """Return the signals of samples, with the pulses of a channel `keyphasor`."""
    if not len(source):
        raise InputError("samples", "with rows", Words("none"))
    times_s, index = source.times_s, np.atleast_1d(source.index)
    if len(index) < len(times_s):  # a client counts the first row only
        index = index[0] + np.arange(len(times_s))
    samples = Samples("", times_s, index, source.values, source.names, source.units, source.rate_hz)
    pulses = _find_pulses(samples) if "keyphasor" in samples.names else np.empty(0)
    return Signals(
        title="",
        channels={name: ("", unit) for name, unit in zip(samples.names, samples.units, strict=True)},
        span_s=(float(times_s[0]), float(times_s[-1])),
        load=lambda *_: samples,
        load_edges=lambda *_: pulses,
        clearances={},
    )


def _read_run(run: Any) -> Signals:
    """Return the signals of an offline run; its truth is in SI."""
    truth = {TRUTH + name: run.unit(name) for name in run.names}
    groups = run.groups

    def load(group: str, *_: float) -> Samples:
        if group != TRUTH:
            return groups[group]
        rate_hz = (len(run.times_s) - 1) / max(run.times_s[-1] - run.times_s[0], 1e-12)
        index = np.arange(len(run.times_s))
        return Samples("truth", run.times_s, index, run.signals, tuple(truth), tuple(truth.values()), rate_hz)

    times_s = [table.times_s for table in run.sampled]
    return Signals(
        title=f"scene {run.simulation.scene.name}",
        channels=_list_channels(run.table) | {name: (TRUTH, unit) for name, unit in truth.items()},
        span_s=(float(min(each[0] for each in times_s)), float(max(each[-1] for each in times_s))),
        load=load,
        load_edges=lambda *_: run.edges_s,
        clearances=_compute_clearances(run.table, run.simulation.parameters_document()["values"]),
        events=lambda: run.events,
        model=lambda: run.simulation.model,
    )


def _read_recording(recording: Any) -> Signals:
    """Return the signals of a recording, which are read when they are used."""
    tables = recording.catalogue.get("truth", {})
    truth = {
        f"{TRUTH}{column['name']}": (TRUTH + table, column["unit"])
        for table in reversed(tables)
        if truth_key(table) in recording.messages
        for column in tables[table]["columns"]
    }
    if (span_s := recording.span_s) is None:
        raise InputError("recording", "with rows", Words("none"))

    cache = Cache()

    def load(group: str, first_s: float, last_s: float) -> Samples:
        return cache.recall(("load", group, first_s, last_s), lambda: read_group(group, first_s, last_s))

    def read_group(group: str, first_s: float, last_s: float) -> Samples:
        part = recording.between(first_s, last_s)
        if not group.startswith(TRUTH):
            return part.samples(group)
        samples = part.truth(group.removeprefix(TRUTH))
        return replace(samples, names=tuple(TRUTH + name for name in samples.names))

    @lru_cache(maxsize=4)
    def load_edges(first_s: float, last_s: float) -> np.ndarray:
        edges_s = recording.between(first_s, last_s).edges()
        if not len(edges_s) and "keyphasor" in recording.table.channels:
            edges_s = _find_pulses(recording.between(first_s, last_s).samples("keyphasor"))
        return edges_s

    listed = _list_channels(recording.table)
    return Signals(
        title=f"{recording.path.name}, scene {recording.scene.get('name')}",
        channels={name: one for name, one in listed.items() if sensor_key(one[0]) in recording.messages} | truth,
        span_s=span_s,
        load=load,
        load_edges=load_edges,
        clearances=_compute_clearances(recording.table, recording.parameters.get("values", {})),
        events=lambda: recording.events,
        model=lru_cache(partial(_build_model, recording)) if isinstance(recording.scene.get("scene"), dict) else None,
        cache=cache,
    )


def _build_model(recording: Any) -> Model:
    """Return the model of a recording, from its parameters.

    Raises:
        InputError: This version does not know one of them.
    """
    from rig.physics.levels import ModelLevels
    from rig.physics.model import build_model
    from rig.physics.parameters import load_parameters

    values = {key: entry["value"] for key, entry in recording.parameters.get("values", {}).items()}
    try:
        levels = ModelLevels(**recording.scene["scene"].get("model", {}))
        return build_model(load_parameters().override(values), levels)
    except (TypeError, ValueError) as error:
        raise InputError("recording", "of a model that this version knows", str(recording.path)) from error


def _find_pulses(samples: Samples) -> np.ndarray:
    """Return the times of the pulses of a channel `keyphasor` [s]; none at standstill, even with noise at the level."""
    signal = samples["keyphasor"]
    return find_edges(signal, samples.times_s) if len(signal) and np.ptp(signal) > PULSE_LEVEL else np.empty(0)


def _list_channels(table: ChannelTable) -> dict[str, tuple[str, str]]:
    return {name: (channel.group, channel.unit) for name, channel in table.channels.items()}


def _compute_clearances(table: ChannelTable, values: Mapping[str, Any]) -> dict[str, float]:
    """Return the clearance of each probe in a plane with a clearance, in its unit."""
    found: dict[str, float] = {}
    for name, channel in table.channels.items():
        plane = _CLEARANCES.get(channel.signal.rpartition("_")[0])
        if plane is None or any(key not in values for key in ("ring.clearance", *plane)):
            continue
        sizes = [
            float(entry.get("resolved", entry["value"])) * SI[entry["unit"]]
            for entry in (values[key] for key in ("ring.clearance", *plane))
        ]
        found[name] = sizes[0] / channel.si * (sizes[1] / sizes[2] if plane else 1.0)
    return found
