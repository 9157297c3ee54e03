"""Health check of a recording: calibration of each channel, timing, and the status reported by the rig.

The check needs only the recording and works window by window, to fit long recordings into memory. A finding is a
reason to look, not a proof: a rig whose housings ring at 50 Hz looks like one with mains hum.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from recorder.contents.samples import row_times_s
from recorder.reader import Recording
from rig.base.wire import EDGES, Block, get_schema, sensor_key
from rig.channels.table import Channel, Group

WINDOW_S = 2.0
"""Window length [s]; gives a spectral resolution of 0.5 Hz."""
_NOISE_ROWS = 2000
"""Rows per noise estimate; the quietest pieces are used, because a signal adds to the estimate."""
_NOISE_RATIO = (0.5, 2.0)
"""Accepted range of measured over calibrated noise."""
_MIN_STUCK_S = 0.05
"""Shortest time without any change that is reported [s]."""
_MAX_DC_RATIO = 0.02
"""Largest accepted mean of an AC-coupled channel, relative to its range."""
_MAINS_HZ = (50.0, 60.0)
_MIN_HUM_RATIO = 20.0
"""Smallest ratio of a mains line's power to its surroundings that is reported."""
_OUTLIER_RATIO = 30.0
"""Clock pairs that deviate by more than this multiple of the median deviation are excluded."""
_ACCURACY_PREFIX = "accuracy: "
"""Prefix of a warning about the accuracy of the run, in every version."""
_DIFFERENCE_ORDER = 6
_DIFFERENCE_GAIN = math.sqrt(math.comb(2 * _DIFFERENCE_ORDER, _DIFFERENCE_ORDER))
"""Standard deviation of the sixth difference of unit white noise: root of the sum of squared binomial coefficients."""


@dataclass
class ChannelHealth:
    """Health of one channel.

    Attributes:
        name: Channel.
        unit: Unit of the values below.
        rows: Number of rows.
        mean: Mean value.
        low: Smallest value.
        high: Largest value.
        noise: White noise, rms, 10th percentile over the recording; nan if there are too few rows.
        noise_calibrated: White noise by calibration, rms; nan if the recording has none.
        limited_rows: Number of rows at the limit of the conditioner or the converter.
        stuck_s: Longest time without any change [s].
        findings: Suspicious properties, one line each.
    """

    name: str
    unit: str
    rows: int = 0
    mean: float = math.nan
    low: float = math.nan
    high: float = math.nan
    noise: float = math.nan
    noise_calibrated: float = math.nan
    limited_rows: int = 0
    stuck_s: float = 0.0
    findings: list[str] = field(default_factory=list)


@dataclass
class Health:
    """Health of a recording.

    Attributes:
        channels: All recorded channels.
        pace: Simulated seconds per wall-clock second, fitted to the clock pairs; nan if there are too few.
        pace_ppm: Deviation of the pace from real time [1e-6].
        pace_error_ppm: Uncertainty of the pace due to jitter: rms jitter over the length of the recording [1e-6].
        jitter_ms: Deviation of the clock pairs from the fitted line, rms [ms].
        jitter_max_ms: Largest deviation [ms].
        strays: Fraction of the clock pairs excluded as outliers, caused by history or a pause.
        misplaced: Number of blocks whose time does not fit their row number, by key.
        status: Figures from the last status of the rig: lateness, overruns, real-time factor, queue.
        warnings: Warnings of the rig.
        findings: Suspicious properties other than those of channels, one line each.
    """

    channels: list[ChannelHealth]
    pace: float
    pace_ppm: float
    pace_error_ppm: float
    jitter_ms: float
    jitter_max_ms: float
    strays: float
    misplaced: dict[str, int]
    status: dict[str, Any]
    warnings: list[str]
    findings: list[str]


class _GroupStatistics:
    """Statistics of one channel group."""

    def __init__(self, group: Group, *, noisy: bool) -> None:
        self._group = group
        self._noisy = noisy
        self._rows: list[np.ndarray] = []
        self._buffered_rows = 0
        self._next: int | None = None
        self._window = round(WINDOW_S * group.rate_hz)
        count = len(group.channels)
        self._total = np.zeros(count)
        self._n = 0
        self._low = np.full(count, np.inf)
        self._high = np.full(count, -np.inf)
        self._limited = np.zeros(count, dtype=np.int64)
        self._levels: list[np.ndarray] = []
        self._power: np.ndarray | None = None
        self._windows = 0
        self._last: np.ndarray | None = None
        self._current_run = np.zeros(count, dtype=np.int64)
        self._longest = np.zeros(count, dtype=np.int64)

    def add(self, index: int, counts: np.ndarray) -> None:
        if self._next is not None and index != self._next:
            self.flush()
        self._next = index + len(counts)
        self._rows.append(counts)
        self._buffered_rows += len(counts)
        if self._buffered_rows >= self._window:
            self.flush()

    def flush(self) -> None:
        """Evaluate the buffered rows as one window."""
        if not self._buffered_rows:
            return
        counts = np.concatenate(self._rows)
        self._rows, self._buffered_rows = [], 0
        rows = len(counts)
        self._n += rows
        self._total += counts.sum(axis=0, dtype=np.float64)
        self._low = np.minimum(self._low, counts.min(axis=0))
        self._high = np.maximum(self._high, counts.max(axis=0))
        for column, channel in enumerate(self._group.channels):
            low, high = _count_limits(channel)
            values = counts[:, column]
            self._limited[column] += np.count_nonzero((values <= low) | (values >= high))
            self._follow_runs(column, values)
        self._last = counts[-1]
        pieces = rows // _NOISE_ROWS
        values = counts.astype(np.float64)
        if pieces:
            fast = np.diff(values, n=_DIFFERENCE_ORDER, axis=0)[: pieces * _NOISE_ROWS - _DIFFERENCE_ORDER]
            whole = len(fast) // pieces
            split = fast[: whole * pieces].reshape(pieces, whole, -1)
            # The median is robust against impacts; 0.6745 is the median of |x| for a standard normal x.
            self._levels.append(np.median(np.abs(split), axis=1) / 0.6745 / _DIFFERENCE_GAIN)
        if rows >= self._window:
            part = values[: self._window] - values[: self._window].mean(axis=0)
            spectrum = np.abs(np.fft.rfft(part * np.hanning(self._window)[:, None], axis=0)) ** 2
            reach = spectrum[: round(100.0 * WINDOW_S) + 1]
            self._power = reach if self._power is None else self._power + reach
            self._windows += 1

    def _follow_runs(self, column: int, values: np.ndarray) -> None:
        """Update the longest run of equal counts, across window boundaries."""
        changes = np.flatnonzero(np.diff(values)) + 1
        continues = self._last is not None and values[0] == self._last[column]
        head = int(self._current_run[column]) if continues else 0
        edges = np.concatenate(([0], changes, [len(values)]))
        lengths = np.diff(edges)
        lengths[0] += head
        self._longest[column] = max(self._longest[column], lengths.max())
        self._current_run[column] = lengths[-1]

    def results(self, spin_hz: float) -> list[ChannelHealth]:
        self.flush()
        levels = np.concatenate(self._levels) if self._levels else np.full((1, len(self._group.channels)), np.nan)
        quiet = np.percentile(levels, 10.0, axis=0)
        results = []
        for column, channel in enumerate(self._group.channels):
            scale, offset = channel.scale, channel.offset
            ends = sorted((self._low[column] * scale + offset, self._high[column] * scale + offset))
            health = ChannelHealth(
                name=channel.name,
                unit=channel.unit,
                rows=self._n,
                mean=self._total[column] / self._n * scale + offset if self._n else math.nan,
                low=float(ends[0]),
                high=float(ends[1]),
                noise=float(quiet[column] * abs(scale)),
                noise_calibrated=_calibrated_noise(channel) if self._noisy else math.nan,
                limited_rows=int(self._limited[column]),
                stuck_s=float(self._longest[column] - 1) / self._group.rate_hz,
            )
            self._add_findings(health, channel, column, spin_hz)
            results.append(health)
        return results

    def _add_findings(self, health: ChannelHealth, channel: Channel, column: int, spin_hz: float) -> None:
        report = health.findings.append
        if not health.rows:
            report("no rows that fit the catalogue")
            return
        if health.limited_rows:
            limited_s = health.limited_rows / self._group.rate_hz
            report(f"at its limit for {limited_s:.4g} s ({health.limited_rows} rows)")
        if self._noisy and channel.noise_v > channel.lsb_v:
            if health.stuck_s >= _MIN_STUCK_S:
                report(f"stuck for {health.stuck_s:.3g} s")
            ratio = health.noise / health.noise_calibrated
            if ratio > _NOISE_RATIO[1] or ratio < _NOISE_RATIO[0]:
                report(f"noise {ratio:.2g} times its calibration")
        if channel.highpass_hz > 0.0:
            volts = (health.mean - channel.offset) / channel.scale * channel.lsb_v - channel.bias_v
            if abs(volts) > _MAX_DC_RATIO * max(map(abs, channel.range_v)):
                report(f"a mean of {volts:.3g} V though it is AC-coupled: a bias fault?")
        for mains_hz in _MAINS_HZ:
            amplitude = self._line_amplitude(mains_hz, column, spin_hz) * abs(channel.scale)
            if amplitude:
                report(f"a line of {amplitude:.2g} {channel.unit} at {mains_hz:g} Hz: mains hum?")

    def _line_amplitude(self, mains_hz: float, column: int, spin_hz: float) -> float:
        """Return the amplitude of an isolated line [counts]; 0 without one, or near a multiple of the spin speed."""
        if self._power is None:
            return 0.0
        if spin_hz > 1.0 and abs(math.remainder(mains_hz, spin_hz)) < 1.0 / WINDOW_S:
            return 0.0
        power = self._power[:, column] / self._windows
        middle, reach = round(mains_hz * WINDOW_S), round(10.0 * WINDOW_S)
        if len(power) <= middle + reach:  # above the Nyquist frequency
            return 0.0
        band = power[middle - reach : middle + reach + 1]
        inliers = np.abs(np.arange(-reach, reach + 1)) <= 2
        if band.argmax() != reach or power[middle] < _MIN_HUM_RATIO * np.median(band[~inliers]):
            return 0.0
        # A second narrow line nearby means that the lines belong to the signal.
        if power[middle] < _MIN_HUM_RATIO * band[~inliers].max():
            return 0.0
        return 2.0 * math.sqrt(power[middle]) / (0.5 * self._window)


def _calibrated_noise(channel: Channel) -> float:
    """Return the calibrated white noise, including the quantisation noise of the converter [unit of the channel]."""
    return math.hypot(channel.noise_v, channel.lsb_v / math.sqrt(12.0)) / abs(channel.sensitivity_v)


def _count_limits(channel: Channel) -> tuple[float, float]:
    """Return the counts at and beyond which a channel is at its limit, with a margin for noise."""
    margin_v = 4.0 * channel.noise_v + 2.0 * channel.lsb_v
    full = 2 ** (channel.adc_bits - 1)
    low, high = channel.range_v
    return max((low + margin_v) / channel.lsb_v, -full), min((high - margin_v) / channel.lsb_v, full - 1)


def examine(recording: Recording, progress: Callable[[float], None] = lambda _: None) -> Health:
    """Check a recording in one pass over its samples.

    Args:
        recording: The recording.
        progress: Callback for the fraction of the blocks that was read, 0 to 1.
    """
    blocks, scanned = sum(count for key, count in recording.messages.items() if get_schema(key) is not None), 0
    noisy = _has_noise(recording.scene)
    watches = {
        sensor_key(name): _GroupStatistics(group, noisy=noisy)
        for name, group in recording.table.groups.items()
        if recording.messages.get(sensor_key(name))
    }
    edges: list[np.ndarray] = []

    def watch(key: str, block: Block) -> None:
        nonlocal scanned
        scanned += 1
        progress(min(scanned / max(blocks, 1), 1.0))
        if key == EDGES:
            edges.append(row_times_s(key, block))
            return
        if key in watches:
            watches[key].add(block.index, block.values)

    recording.scan(watch)
    times_s = np.unique(np.concatenate(edges)) if edges else np.empty(0)
    spin_hz = 1.0 / float(np.median(np.diff(times_s))) if len(times_s) > 2 else 0.0
    channels = [health for statistics in watches.values() for health in statistics.results(spin_hz)]
    return _build_health(recording, channels)


def _build_health(recording: Recording, channels: list[ChannelHealth]) -> Health:
    clock = recording.clock if _has_clock(recording) else np.empty((0, 2))
    span_s = float(np.ptp(clock[:, 1])) if len(clock) else 0.0
    pace, jitter_ms, jitter_max_ms, strays = pace_of(clock)
    last = recording.last_status or {}
    kept = ("pace", "real_time_factor", "lateness_ms", "overruns", "queue", "energy", "engine", "accuracy")
    warning_texts = [str(event.get("text", "")) for event in recording.events if event.get("event") == "warning"]
    warning_texts += [str(text) for text in last.get("warnings", [])]
    # The error estimate grows during a run, so only its last warning counts.
    latest = [text for text in warning_texts if text.startswith(_ACCURACY_PREFIX)][-1:]
    warnings = dict.fromkeys(text for text in warning_texts if not text.startswith(_ACCURACY_PREFIX) or text in latest)
    findings = list(recording.doubts)
    dropped = last.get("queue", {}).get("dropped", 0)
    if dropped:
        findings.append(f"the rig dropped {dropped} blocks before they were published")
    return Health(
        channels=channels,
        pace=pace,
        pace_ppm=(pace - 1.0) * 1e6,
        pace_error_ppm=1e3 * jitter_ms / span_s if span_s > 0.0 else math.nan,
        jitter_ms=jitter_ms,
        jitter_max_ms=jitter_max_ms,
        strays=strays,
        misplaced={key: stream.misplaced for key, stream in recording.streams.items() if stream.misplaced},
        status={name: last[name] for name in kept if name in last},
        warnings=list(warnings),
        findings=findings,
    )


def _has_noise(scene: dict[str, Any]) -> bool:
    """Return whether the sensors have their calibrated noise; an import, or a scene without noise, does not."""
    if "import" in scene:
        return False
    sensors = scene.get("scene", {}).get("sensors", {}) if isinstance(scene.get("scene"), dict) else {}
    return sensors.get("noise", True) is not False and sensors.get("chain", "full") != "ideal"


def _has_clock(recording: Recording) -> bool:
    """Return whether wall times come from a clock; an import and a simulation without pace derive them."""
    without = {("start", "none"), ("import", None)}
    return not any((event.get("event"), event.get("pace")) in without for event in recording.events)


def pace_of(clock: np.ndarray) -> tuple[float, float, float, float]:
    """Return pace, deviations from the fitted line (rms and largest [ms]) and fraction of excluded clock pairs.

    The line is fitted by medians, because blocks from the rig's cache arrive in one burst. A first fit to neighbouring
    pairs selects the consistent ones; a second fit to distant pairs gives the result.

    Args:
        clock: Simulated and wall time [s], shape (n, 2).
    """
    unknown = math.nan, math.nan, math.nan, math.nan
    simulated_s, wall_s = (clock - clock[:1]).T
    inliers = np.ones(len(clock), dtype=bool)
    slope, rest_ms = math.nan, np.zeros(len(clock))
    for neighbours in (True, False):
        apart = 1 if neighbours else int(inliers.sum()) // 2
        if inliers.sum() < 4:
            return unknown
        steps = (values[inliers][apart:] - values[inliers][:-apart] for values in (simulated_s, wall_s))
        slope = float(np.median(np.divide(next(steps), np.maximum(next(steps), 1e-9))))
        if not slope > 0.0:
            return unknown
        rest_ms = 1e3 * (simulated_s / slope - wall_s)
        rest_ms -= np.median(rest_ms[inliers])
        inliers = np.abs(rest_ms) <= max(_OUTLIER_RATIO * float(np.median(np.abs(rest_ms))), 50.0)
    kept_ms = rest_ms[inliers]
    return slope, float(np.sqrt(np.mean(kept_ms**2))), float(np.abs(kept_ms).max()), 1.0 - float(inliers.mean())
