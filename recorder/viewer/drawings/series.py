"""Time series: selection of the curves, and thinning of their points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import rerun as rr

from recorder.viewer.canvas import Canvas
from rig.channels.table import ChannelTable, Group

ROOT = "/sensors"
REACTION = "/derived/reaction"
REACTIONS = {"P_N", "P_S", "P_E", "P_W"}
"""Channels required for the reaction."""
_HIDDEN_CHANNELS = {"keyphasor"}
"""Channels without a curve: a pulse of a fraction of a millisecond per revolution is meaningless at a viewing rate."""

_COLORS = {
    "N": (86, 180, 233),
    "S": (32, 120, 190),
    "E": (240, 190, 70),
    "W": (205, 125, 40),
    "x": (86, 180, 233),
    "y": (240, 190, 70),
}
_DEFAULT_RGB = (200, 205, 215)
_SHADES = {"outer": 0.6}
"""Brightness of the outer housing's curves, which share the plot of the inner housing."""

Span = tuple[float, float]
Points = tuple[np.ndarray, np.ndarray]
"""Times [s] and values, shapes (n,) and (n, curves)."""


@dataclass(frozen=True, slots=True)
class Curves:
    """Curves that share a plot: one entity with one value per curve.

    Attributes:
        path: Entity path in the viewer.
        labels: Legend of each curve, with its unit.
        colors: RGB of each curve.
        select: Maps engineering values of the group, shape (n, channels), to curves, shape (n, curves).
    """

    path: str
    labels: tuple[str, ...]
    colors: tuple[tuple[int, int, int], ...]
    select: Callable[[np.ndarray], np.ndarray]


def build_curves(group: Group) -> list[Curves]:
    """Return the curves of a sensor group; channels with the same first part of the name share a plot."""
    planes: dict[str, list[int]] = {}
    for column, channel in enumerate(group.channels):
        if channel.name not in _HIDDEN_CHANNELS:
            planes.setdefault(channel.name.split("_")[0], []).append(column)
    curves = [
        Curves(
            path=f"{ROOT}/{group.name}/{plane}",
            labels=tuple(f"{group.channels[column].name} [{group.channels[column].unit}]" for column in columns),
            colors=tuple(_get_color(group.channels[column].name) for column in columns),
            select=lambda values, columns=columns: values[:, columns],
        )
        for plane, columns in planes.items()
    ]
    if set(group.names) >= REACTIONS:
        curves.append(
            Curves(
                path=REACTION,
                labels=("x: P_E - P_W [N]", "y: P_N - P_S [N]"),
                colors=(_get_color("x"), _get_color("y")),
                select=find_reaction(group),
            )
        )
    return curves


def _get_color(name: str) -> tuple[int, int, int]:
    """Return the colour of a channel's direction, the same in all plots."""
    red, green, blue = _COLORS.get(name.split("_")[-1], _DEFAULT_RGB)
    shade = _SHADES.get(name.split("_")[0], 1.0)
    return round(shade * red), round(shade * green), round(shade * blue)


def get_paths(table: ChannelTable) -> list[str]:
    """Return the entity paths of all curves, in table order."""
    return [series.path for group in table.groups.values() for series in build_curves(group)]


def find_reaction(group: Group) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that maps rows of the force group to the reaction [N], shape (n, 2).

    Each component is the difference of opposite transducers.
    """
    east, west, north, south = (group.names.index(name) for name in ("P_E", "P_W", "P_N", "P_S"))
    return lambda values: np.stack((values[:, east] - values[:, west], values[:, north] - values[:, south]), axis=1)


class Envelope:
    """Min-max envelope of buckets of rows, with all rows in given windows.

    A bucket of `bucket` rows becomes two points: its first extreme at the start of the bucket and the other one at its
    middle, separately for each curve. Peaks keep their height, and their time within half a bucket.
    """

    def __init__(self, *, bucket: int) -> None:
        self._bucket = max(1, bucket)
        self._coarse = 1
        self._times: list[np.ndarray] = []
        self._values: list[np.ndarray] = []
        self._points: list[Points] = []

    def add(self, times_s: np.ndarray, values: np.ndarray) -> None:
        """Add rows, shapes (n,) and (n, curves)."""
        self._times.append(times_s)
        self._values.append(values)

    def fold(self, *, until_s: float, windows: list[Span], rest: bool = False, most: int | None = None) -> None:
        """Reduce rows to points, to limit the pending data.

        Args:
            until_s: Reduce the buckets that end before this time [s].
            windows: Time spans in which all rows are kept.
            rest: Also reduce the incomplete last bucket.
            most: Largest number of pending points outside the windows; beyond it, buckets grow.
        """
        if self._times:
            times_s, values = np.concatenate(self._times), np.concatenate(self._values)
            bucket = self._bucket * self._coarse
            rows = int(np.searchsorted(times_s, until_s)) // bucket * bucket
            self._points.append(_reduce(times_s[:rows], values[:rows], bucket, windows))
            if rest and rows < len(times_s):
                self._points.append(_reduce(times_s[rows:], values[rows:], len(times_s) - rows, windows))
                rows = len(times_s)
            self._times, self._values = [times_s[rows:]], [values[rows:]]
        outside = sum(_count_outside(at, windows) for at, _ in self._points)
        while most is not None and outside > most:
            self._points = [_reduce(*_merge(self._points), 4, windows)]
            before, outside = outside, _count_outside(self._points[0][0], windows)
            if outside > 0.75 * before:  # little can be thinned between close windows
                break
            self._coarse *= 2

    def take(self, *, until_s: float, windows: list[Span], rest: bool = False, most: int | None = None) -> Points:
        """Return and remove the points of the buckets that end before `until_s`; arguments as in `fold`."""
        self.fold(until_s=until_s, windows=windows, rest=rest, most=most)
        points, self._points, self._coarse = self._points, [], 1
        return _merge(points) if points else (np.empty(0), np.empty((0, 0)))


def _merge(points: list[Points]) -> Points:
    return np.concatenate([at for at, _ in points]), np.concatenate([values for _, values in points])


def _count_outside(times_s: np.ndarray, windows: list[Span]) -> int:
    """Return the number of times outside all windows."""
    return len(times_s) - int(np.any([(times_s >= start) & (times_s <= end) for start, end in windows], axis=0).sum())


def _reduce(times_s: np.ndarray, values: np.ndarray, bucket: int, windows: list[Span]) -> Points:
    """Return the extremes of each bucket, all rows of buckets that overlap a window, and the remaining rows."""
    whole = len(times_s) // bucket
    rows = whole * bucket
    points = [(times_s[rows:], values[rows:])]
    if whole:
        bucket_times = times_s[:rows].reshape(whole, bucket)
        bucket_values = values[:rows].reshape(whole, bucket, -1)
        full = np.zeros(whole, dtype=bool)
        for start, end in windows:
            full |= (bucket_times[:, -1] >= start) & (bucket_times[:, 0] <= end)
        parts = np.split(np.arange(whole), np.flatnonzero(np.diff(full)) + 1)
        reduces = [_keep_rows if full[part[0]] or bucket <= 2 else _keep_extremes for part in parts]
        points = [reduce(bucket_times[part], bucket_values[part]) for part, reduce in zip(parts, reduces, strict=True)]
        points.append((times_s[rows:], values[rows:]))
    return _merge(points)


def _keep_rows(times: np.ndarray, values: np.ndarray) -> Points:
    return times.reshape(-1), values.reshape(times.size, -1)


def _keep_extremes(times: np.ndarray, values: np.ndarray) -> Points:
    low, high = values.min(axis=1), values.max(axis=1)
    low_first = values.argmin(axis=1) <= values.argmax(axis=1)
    first, second = np.where(low_first, low, high), np.where(low_first, high, low)
    at = np.stack((times[:, 0], times[:, times.shape[1] // 2]), axis=1).reshape(-1)
    return at, np.stack((first, second), axis=1).reshape(at.size, -1)


class SeriesPlot:
    """Curves of one sensor group."""

    def __init__(self, canvas: Canvas, group: Group, *, rows_per_s: float) -> None:
        self._canvas = canvas
        self._rate_hz = group.rate_hz
        self._series = build_curves(group)
        self._bucket = max(1, round(2 * group.rate_hz / rows_per_s))
        self._envelopes = [Envelope(bucket=self._bucket) for _ in self._series]
        self.points = 0
        for series in self._series:
            canvas.fix(
                series.path,
                rr.SeriesLines(
                    names=series.labels,
                    colors=series.colors,
                    widths=[1.2] * len(series.labels),
                    aggregation_policy="MinMax",
                ),
            )

    def add(self, times_s: np.ndarray, values: np.ndarray) -> None:
        """Add consecutive engineering values of the whole group, shape (n, channels)."""
        for series, envelope in zip(self._series, self._envelopes, strict=True):
            envelope.add(times_s, series.select(values))

    def flush(self, *, until_s: float, windows: list[Span], rest: bool = False, most: int | None = None) -> None:
        """Draw the points before `until_s`: at most `most` per curve, and all in the windows."""
        for series, envelope in zip(self._series, self._envelopes, strict=True):
            times, values = envelope.take(until_s=until_s, windows=windows, rest=rest, most=most)
            if len(times):
                self._canvas.plot(series.path, times, rr.Scalars.columns(scalars=values))
                self.points += values.size

    def fold(self, *, until_s: float, windows: list[Span], most: int) -> None:
        """Reduce the pending points before `until_s`."""
        for envelope in self._envelopes:
            envelope.fold(until_s=until_s, windows=windows, most=most)

    def lift(self, *, at_s: float, windows: list[Span]) -> None:
        """Draw all pending points and break the curves at a time [s], because rows are missing."""
        self.flush(until_s=np.inf, windows=windows, rest=True)
        for series in self._series:
            hole = np.full((1, len(series.labels)), np.nan)
            self._canvas.plot(series.path, np.array([at_s]), rr.Scalars.columns(scalars=hole))
