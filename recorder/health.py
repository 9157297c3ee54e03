"""How sound a recording is: each channel against its own calibration, time, and what the rig said of itself.

Read off the recording alone, window by window, so that long ones fit into memory. What is found is a reason to look,
not a proof: a rig whose houses ring at 50 Hz looks like one with mains hum.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from recorder.contents.samples import row_times_s
from recorder.reader import Recording
from rig.base.wire import EDGES, Block, schema_of, sensor_key
from rig.channels.table import Channel, Group

WINDOW_S = 2.0
"""Length of a window; its spectrum resolves 0.5 Hz."""
_PIECE_ROWS = 2000
"""Rows over which a noise level is taken; the quiet pieces count, as a signal adds to it."""
_NOISE_RATIO = (0.5, 2.0)
"""Measured noise against calibrated noise that raises no doubt."""
_STUCK_S = 0.05
_DC = 0.02
"""Part of the range that the mean of an AC-coupled channel may have."""
_MAINS_HZ = (50.0, 60.0)
_HUM = 20.0
"""Power of a line against its surroundings that raises doubt."""
_STRAY = 30.0
"""Multiple of the median deviation beyond which a clock pair is left out."""
_ACCURACY = "accuracy: "
"""Begin of a warning about the run's own error, in every version."""
_DIFFERENCES = 6
_GAIN = math.sqrt(math.comb(2 * _DIFFERENCES, _DIFFERENCES))
"""Standard deviation of the sixth difference of white noise of deviation 1: root of the sum of squared binomials."""


@dataclass
class ChannelHealth:
    """One channel.

    Attributes:
        name: Channel.
        unit: Unit of the values below.
        rows: Number of rows.
        mean: Mean value.
        low: Least value.
        high: Greatest value.
        noise: White noise, as it is in the quietest tenth of the recording, rms; nan where there are too few rows.
        noise_calibrated: The same in the channel's calibration; nan where the recording has none.
        limited_rows: Rows at the conditioner's or the converter's limit.
        stuck_s: Longest time without any change [s].
        findings: What raises doubt.
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
    """A recording.

    Attributes:
        channels: Each channel that was recorded.
        pace: Simulated seconds a wall-clock second, a line through the clock pairs; nan if there are too few.
        pace_ppm: The same as a deviation from real time [1e-6].
        pace_error_ppm: What the jitter lets it be known to: rms over the length of the recording [1e-6].
        jitter_ms: Deviation of the clock pairs from that line, rms [ms].
        jitter_max_ms: The largest one [ms].
        strays: Part of the clock pairs that lie far from the line, and are left out: history, or a pause.
        misplaced: Blocks whose time does not fit their row number, by key.
        status: The rig's own figures at the end: lateness, overruns, real-time factor, queue.
        warnings: The rig's warnings.
        findings: What raises doubt, apart from the channels.
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


class _Watch:
    """Follows one group."""

    def __init__(self, group: Group, *, noisy: bool) -> None:
        self._group = group
        self._noisy = noisy
        self._rows: list[np.ndarray] = []
        self._held = 0
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
        self._run = np.zeros(count, dtype=np.int64)
        self._longest = np.zeros(count, dtype=np.int64)

    def add(self, index: int, counts: np.ndarray) -> None:
        if self._next is not None and index != self._next:
            self.flush()
        self._next = index + len(counts)
        self._rows.append(counts)
        self._held += len(counts)
        if self._held >= self._window:
            self.flush()

    def flush(self) -> None:
        """Take what is held as one window."""
        if not self._held:
            return
        counts = np.concatenate(self._rows)
        self._rows, self._held = [], 0
        rows = len(counts)
        self._n += rows
        self._total += counts.sum(axis=0, dtype=np.float64)
        self._low = np.minimum(self._low, counts.min(axis=0))
        self._high = np.maximum(self._high, counts.max(axis=0))
        for column, channel in enumerate(self._group.channels):
            low, high = _limits(channel)
            values = counts[:, column]
            self._limited[column] += np.count_nonzero((values <= low) | (values >= high))
            self._follow_runs(column, values)
        self._last = counts[-1]
        pieces = rows // _PIECE_ROWS
        values = counts.astype(np.float64)
        if pieces:
            fast = np.diff(values, n=_DIFFERENCES, axis=0)[: pieces * _PIECE_ROWS - _DIFFERENCES]
            whole = len(fast) // pieces
            split = fast[: whole * pieces].reshape(pieces, whole, -1)
            # The median holds for white noise however rare the jolts are; 0.6745 is that of a standard normal.
            self._levels.append(np.median(np.abs(split), axis=1) / 0.6745 / _GAIN)
        if rows >= self._window:
            part = values[: self._window] - values[: self._window].mean(axis=0)
            spectrum = np.abs(np.fft.rfft(part * np.hanning(self._window)[:, None], axis=0)) ** 2
            reach = spectrum[: round(100.0 * WINDOW_S) + 1]
            self._power = reach if self._power is None else self._power + reach
            self._windows += 1

    def _follow_runs(self, column: int, values: np.ndarray) -> None:
        """Length of the longest run of one and the same count, over the windows' edges."""
        changes = np.flatnonzero(np.diff(values)) + 1
        goes_on = self._last is not None and values[0] == self._last[column]
        head = int(self._run[column]) if goes_on else 0
        edges = np.concatenate(([0], changes, [len(values)]))
        lengths = np.diff(edges)
        lengths[0] += head
        self._longest[column] = max(self._longest[column], lengths.max())
        self._run[column] = lengths[-1]

    def results(self, spin_hz: float) -> list[ChannelHealth]:
        self.flush()
        levels = np.concatenate(self._levels) if self._levels else np.full((1, len(self._group.channels)), np.nan)
        quiet = np.percentile(levels, 10.0, axis=0)
        found = []
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
                noise_calibrated=_noise_of(channel) if self._noisy else math.nan,
                limited_rows=int(self._limited[column]),
                stuck_s=float(self._longest[column] - 1) / self._group.rate_hz,
            )
            self._judge(health, channel, column, spin_hz)
            found.append(health)
        return found

    def _judge(self, health: ChannelHealth, channel: Channel, column: int, spin_hz: float) -> None:
        say = health.findings.append
        if not health.rows:
            say("no rows that fit the catalogue")
            return
        if health.limited_rows:
            limited_s = health.limited_rows / self._group.rate_hz
            say(f"at its limit for {limited_s:.4g} s ({health.limited_rows} rows)")
        if self._noisy and channel.noise_v > channel.lsb_v:
            if health.stuck_s >= _STUCK_S:
                say(f"stuck for {health.stuck_s:.3g} s")
            ratio = health.noise / health.noise_calibrated
            if ratio > _NOISE_RATIO[1] or ratio < _NOISE_RATIO[0]:
                say(f"noise {ratio:.2g} times its calibration")
        if channel.highpass_hz > 0.0:
            volts = (health.mean - channel.offset) / channel.scale * channel.lsb_v - channel.bias_v
            if abs(volts) > _DC * max(map(abs, channel.range_v)):
                say(f"a mean of {volts:.3g} V though it is AC-coupled: a bias fault?")
        for mains_hz in _MAINS_HZ:
            amplitude = self._line(mains_hz, column, spin_hz) * abs(channel.scale)
            if amplitude:
                say(f"a line of {amplitude:.2g} {channel.unit} at {mains_hz:g} Hz: mains hum?")

    def _line(self, mains_hz: float, column: int, spin_hz: float) -> float:
        """Amplitude of a line that stands out [counts]; 0 if none does, or it may be a multiple of the spin."""
        if self._power is None:
            return 0.0
        if spin_hz > 1.0 and abs(math.remainder(mains_hz, spin_hz)) < 1.0 / WINDOW_S:
            return 0.0
        power = self._power[:, column] / self._windows
        middle, reach = round(mains_hz * WINDOW_S), round(10.0 * WINDOW_S)
        if len(power) <= middle + reach:  # the rate is too low to show it
            return 0.0
        around = power[middle - reach : middle + reach + 1]
        near = np.abs(np.arange(-reach, reach + 1)) <= 2
        if around.argmax() != reach or power[middle] < _HUM * np.median(around[~near]):
            return 0.0
        # The next highest beside it may be another narrow line: then it is the signal that has lines.
        if power[middle] < _HUM * around[~near].max():
            return 0.0
        return 2.0 * math.sqrt(power[middle]) / (0.5 * self._window)


def _noise_of(channel: Channel) -> float:
    """White noise by calibration, that of the converter's steps included [unit of the channel]."""
    return math.hypot(channel.noise_v, channel.lsb_v / math.sqrt(12.0)) / abs(channel.sensitivity_v)


def _limits(channel: Channel) -> tuple[float, float]:
    """Counts at and beyond which a channel is at a limit, its noise allowed for."""
    margin_v = 4.0 * channel.noise_v + 2.0 * channel.lsb_v
    full = 2 ** (channel.adc_bits - 1)
    low, high = channel.range_v
    return max((low + margin_v) / channel.lsb_v, -full), min((high - margin_v) / channel.lsb_v, full - 1)


def examine(recording: Recording, progress: Callable[[float], None] = lambda _: None) -> Health:
    """Look at everything that a recording says of its own soundness, in one pass over its samples.

    Args:
        recording: The recording.
        progress: Told, block by block, which part of them was seen, 0 to 1.
    """
    blocks, seen = sum(count for key, count in recording.messages.items() if schema_of(key) is not None), 0
    noisy = _has_noise(recording.scene)
    watches = {
        sensor_key(name): _Watch(group, noisy=noisy)
        for name, group in recording.table.groups.items()
        if recording.messages.get(sensor_key(name))
    }
    edges: list[np.ndarray] = []

    def watch(key: str, block: Block) -> None:
        nonlocal seen
        seen += 1
        progress(min(seen / max(blocks, 1), 1.0))
        if key == EDGES:
            edges.append(row_times_s(key, block))
            return
        if key in watches:
            watches[key].add(block.index, block.values)

    recording.look_through(watch)
    times_s = np.unique(np.concatenate(edges)) if edges else np.empty(0)
    spin_hz = 1.0 / float(np.median(np.diff(times_s))) if len(times_s) > 2 else 0.0
    channels = [health for one in watches.values() for health in one.results(spin_hz)]
    return _with_findings(recording, channels)


def _with_findings(recording: Recording, channels: list[ChannelHealth]) -> Health:
    clock = recording.clock if _has_clock(recording) else np.empty((0, 2))
    span_s = float(np.ptp(clock[:, 1])) if len(clock) else 0.0
    pace, jitter_ms, jitter_max_ms, strays = pace_of(clock)
    last = recording.last_status or {}
    kept = ("pace", "real_time_factor", "lateness_ms", "overruns", "queue", "energy", "engine", "accuracy")
    told = [str(event.get("text", "")) for event in recording.events if event.get("event") == "warning"]
    told += [str(text) for text in last.get("warnings", [])]
    # The estimate grows during a run: of its warnings only the last one counts.
    latest = [text for text in told if text.startswith(_ACCURACY)][-1:]
    warnings = dict.fromkeys(text for text in told if not text.startswith(_ACCURACY) or text in latest)
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
        misplaced={key: one.misplaced for key, one in recording.streams.items() if one.misplaced},
        status={name: last[name] for name in kept if name in last},
        warnings=list(warnings),
        findings=findings,
    )


def _has_noise(scene: dict[str, Any]) -> bool:
    """Whether the sensors have the noise of their calibration: not where a scene turns it off, nor in an import."""
    if "import" in scene:
        return False
    sensors = scene.get("scene", {}).get("sensors", {}) if isinstance(scene.get("scene"), dict) else {}
    return sensors.get("noise", True) is not False and sensors.get("chain", "full") != "ideal"


def _has_clock(recording: Recording) -> bool:
    """Whether the wall times are those of a clock; a simulation without one, and an import, derive them."""
    without = {("start", "none"), ("import", None)}
    return not any((event.get("event"), event.get("pace")) in without for event in recording.events)


def pace_of(clock: np.ndarray) -> tuple[float, float, float, float]:
    """Slope of simulated over wall time, deviations from the line (rms and largest [ms]), part of strays.

    The line is through medians: what a recorder fetched from the rig's cache arrived in one burst. A first one, through
    neighbours, tells which pairs belong together; a second one, through those far apart, is the result.
    """
    unknown = math.nan, math.nan, math.nan, math.nan
    simulated_s, wall_s = (clock - clock[:1]).T
    near = np.ones(len(clock), dtype=bool)
    slope, rest_ms = math.nan, np.zeros(len(clock))
    for neighbours in (True, False):
        apart = 1 if neighbours else int(near.sum()) // 2
        if near.sum() < 4:
            return unknown
        steps = (values[near][apart:] - values[near][:-apart] for values in (simulated_s, wall_s))
        slope = float(np.median(np.divide(next(steps), np.maximum(next(steps), 1e-9))))
        if not slope > 0.0:
            return unknown
        rest_ms = 1e3 * (simulated_s / slope - wall_s)
        rest_ms -= np.median(rest_ms[near])
        near = np.abs(rest_ms) <= max(_STRAY * float(np.median(np.abs(rest_ms))), 50.0)
    kept_ms = rest_ms[near]
    return slope, float(np.sqrt(np.mean(kept_ms**2))), float(np.abs(kept_ms).max()), 1.0 - float(near.mean())
