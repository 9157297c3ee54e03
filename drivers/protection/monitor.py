"""The monitor: rows in, what it does out, without a clock, a wire or a thread.

Its level is the peak-to-peak of each probe, or Smax of the orbit, over the last `window_s`, above `corner_hz`. A level
above a set point for the delay is an alarm; its cause is over where the level falls below the set point by the
hysteresis. Dangers, by the vote, are a trip. A probe whose output leaves the OK limits is NOT OK from that row on,
until it was within them for `ok_recovery_s`; meanwhile it raises no alarm, and `not_ok` says how it votes.

Rows that are missing, up to a window of them, are taken as the last that came, and those that come late or twice are
left out; where more are missing, or the numbers of rows begin anew, all begins anew with both probes NOT OK. Every
state is that of a row: how rows are cut into blocks changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from drivers.protection.settings import Settings
from drivers.sources.samples import Samples, follow
from rig.base.errors import InputError
from rig.base.units import factor
from rig.base.wire import Continuity, row_tick, row_times_s

Alarm = tuple[str, str]
"""Its kind, and its channel."""
TRIP: Alarm = ("trip", "")
_PULSE = (0.6, 0.4)
"""A pulse of the keyphasor, 0 to 1, begins above the first, and the next one can where it was below the second."""


@dataclass(frozen=True, slots=True)
class Action:
    """What the monitor says or does at a row.

    Attributes:
        kind: alert, danger, overspeed, speed-lost, not-ok or trip, where it comes; clear, where an alarm goes by
            itself; reset; rows-lost.
        name: Its channel; of a trip, the alarm that was first; of a clear and a reset, the alarm.
        row: Number of the row since the start of the stream.
        tick: Its simulated time, to the nearest [ticks].
        time_s: The same, exact [s].
        value: The level [um], the speed [Hz], a probe's output [V], or the number of rows.
    """

    kind: str
    name: str
    row: int
    tick: int
    time_s: float
    value: float

    def __str__(self) -> str:
        return f"{self.time_s:.6f} s  {self.kind}  {self.name}  {self.value:.6g}"


class Protection:
    """A monitor of one pair of probes.

    Attributes:
        settings: What it is set to.
        multiply: Factor of the set points (a trip multiply), from the next row on.
        bypassed: Channels without alarms, from the next row on.
        active: Alarms that stand, and the trip, with what they came with.
        first_out: Alarms in the order in which they came, since they were reset.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings, self.multiply, self.bypassed = settings, 1.0, set(settings.bypass)
        self.active: dict[Alarm, Action] = {}
        self.first_out: list[Alarm] = []
        self._latching = {"trip"}
        self._latching |= {"danger", "overspeed"} if settings.latch_danger else set()
        self._latching |= {"alert", "speed-lost"} if settings.latch_alert else set()
        self._came = Continuity()
        self._next: int | None = None
        self._to_reset = False

    @property
    def tripped(self) -> bool:
        """Whether it tripped, and was not reset."""
        return TRIP in self.active

    def reset(self) -> None:
        """Acknowledge at the next row: alarms whose cause is over go, and the trip if no danger stays."""
        self._to_reset = True

    def feed(self, samples: Samples) -> list[Action]:
        """What comes of the next rows, in their order.

        Raises:
            InputError: A channel is missing, its unit is no length, or the rate changes.
        """
        fresh = follow(self._came, samples) if len(samples) else None
        if fresh is None:
            return []
        samples = fresh
        signals, missing = self._continued(samples)
        first = samples.index + len(samples) - signals.shape[1]

        def action(kind: str, name: str, row: int, value: float) -> Action:
            tick = row_tick(samples.tick, samples.rate_hz, samples.tick_rate_hz, row - samples.index)
            time_s = float(row_times_s(tick, samples.rate_hz, samples.tick_rate_hz, 1)[0])
            return Action(kind, name, row, tick, time_s, float(value))

        told = [action("rows-lost", "", samples.index, missing)] if missing else []
        told += [action("reset", " ".join(alarm).strip(), first, 0.0) for alarm in self._acknowledged()]
        states = self._states(signals, first)
        changes = [
            (int(row), place, alarm)
            for place, (alarm, (on, _)) in enumerate(states.items())
            for row in _changes(on, alarm in self.active)
        ]
        for row, _, alarm in sorted(changes):
            on, values = states[alarm]
            kind, name = alarm
            if not on[row]:
                del self.active[alarm]
                told.append(action("clear", " ".join(alarm), first + row, values[row]))
                continue
            if alarm == TRIP:
                name = next((" ".join(each) for each in self.first_out if each[0] != "alert"), "")
            elif alarm not in self.first_out:
                self.first_out.append(alarm)
            told.append(action(kind, name, first + row, values[row]))
            self.active[alarm] = told[-1]
        return told

    def _continued(self, samples: Samples) -> tuple[np.ndarray, int]:
        """Probes [um] and keyphasor, shape (signals, rows), with the rows that are missing; and how many those are."""
        known = self._next is not None
        if known and samples.rate_hz != self._rate_hz:
            raise InputError("rate_hz", f"{self._rate_hz:g} Hz as before", samples.rate_hz)
        probes = [self.settings.x, self.settings.y]
        scale = [factor(samples.unit(name), "um", field=f"unit of {name}") for name in probes] + [1.0]
        signals = np.vstack([samples[name] * by for name, by in zip(self.settings.channels, scale, strict=False)])
        missing = samples.index - self._next if self._next is not None else 0
        if not known or not 0 <= missing <= self._window:
            self._begin(samples.index, samples.rate_hz)
        elif missing:
            signals = np.hstack([np.repeat(self._last, missing, axis=1), signals])
        self._next, self._last = samples.index + len(samples), signals[:, -1:]
        return signals, missing

    def _begin(self, first: int, rate_hz: float) -> None:
        """Forget all rows; probes are OK at power-up, and not where rows are lost."""
        settings, self._rate_hz = self.settings, rate_hz
        known, probes = self._next is not None, (settings.x, settings.y)
        self._armed = self._armed if known else first + self._rows(settings.startup_s)
        self._runs = {("ok", name): 0 if known else self._rows(settings.ok_recovery_s) for name in probes}
        self._window = max(2, self._rows(settings.window_s))
        self._part = 1.0 - math.exp(-2.0 * math.pi * settings.corner_hz / rate_hz)
        self._means: list[float] = []
        self._tail = np.full((2, self._window - 1), math.nan)
        self._over: dict[Alarm, bool] = {("pulse", ""): True}
        self._pulse, self._turning, self._speed_hz, self._fast = first, False, 0.0, 0

    def _rows(self, duration_s: float) -> int:
        return math.ceil(duration_s * self._rate_hz - 1e-6)

    def _acknowledged(self) -> list[Alarm]:
        """Alarms that a reset takes away."""
        if not self._to_reset:
            return []
        self._to_reset = False
        gone = [alarm for alarm in self.active if alarm != TRIP and not self._causes[alarm]]
        if self.tripped and not any(kind in ("danger", "overspeed") for kind, _ in self.active.keys() - set(gone)):
            gone.append(TRIP)
        self.active = {alarm: action for alarm, action in self.active.items() if alarm not in gone}
        self.first_out = [alarm for alarm in self.first_out if alarm in self.active]
        return gone

    def _states(self, signals: np.ndarray, first: int) -> dict[Alarm, tuple[np.ndarray, np.ndarray]]:
        """Of each alarm, whether it is on at each row, and its value there; in the order of their ranks at one row."""
        settings, index = self.settings, np.arange(first, first + signals.shape[1])
        probes, armed = (settings.x, settings.y), index >= self._armed
        levels, volts = self._levels(signals[:2]), settings.bias_v + 1e-3 * settings.scale_v_per_mm * signals[:2]
        inside = (volts >= settings.ok_low_v) & (volts <= settings.ok_high_v)
        recovery = self._rows(settings.ok_recovery_s)
        good = np.array([self._run(("ok", name), each) > recovery for name, each in zip(probes, inside, strict=True)])
        causes = {("not-ok", name): (~good[place], volts[place]) for place, name in enumerate(probes)}
        if settings.measure == "smax":
            good[:] = good.all(axis=0)  # an orbit takes both
        for kind, set_um, delay_s in (
            ("alert", settings.alert_um, settings.alert_delay_s),
            ("danger", settings.danger_um, settings.danger_delay_s),
        ):
            for name, level, okay in zip(probes, levels, good, strict=True):
                high = self.multiply * set_um
                enabled = np.where(okay & armed & (name not in self.bypassed), level, -1.0)
                above = self._above((kind, name), enabled, high, high * (1.0 - settings.hysteresis))
                causes[kind, name] = self._run((kind, name), above) > self._rows(delay_s), level
        if settings.timed:
            causes |= self._speed(signals[2], index, armed & (settings.keyphasor not in self.bypassed))
        self._causes = {alarm: bool(on[-1]) for alarm, (on, _) in causes.items()}
        states = {
            alarm: (np.logical_or.accumulate(on) | (alarm in self.active) if alarm[0] in self._latching else on, value)
            for alarm, (on, value) in causes.items()
        }
        trip = self._vote([states["danger", name][0] for name in probes], ~good) & armed
        if settings.timed:
            trip |= states["overspeed", settings.keyphasor][0]
        states[TRIP] = np.logical_or.accumulate(trip) | self.tripped, levels.max(axis=0)
        return states

    def _levels(self, probes: np.ndarray) -> np.ndarray:
        """Measure of each probe over the window that ends at each row [um], shape (2, rows)."""
        part = self._part
        means = [
            list(accumulate(probe.tolist(), lambda mean, value: mean + part * (value - mean), initial=mean))
            for probe, mean in zip(probes, self._means or probes[:, 0].tolist(), strict=True)
        ]
        self._means = [each[-1] for each in means]
        rows = np.hstack([self._tail, probes - np.array(means)[:, 1:]])
        self._tail = rows[:, rows.shape[1] - self._window + 1 :]
        if self.settings.measure == "smax":
            return np.tile(_sliding(np.fmax, np.hypot(*rows), self._window), (2, 1))
        return _sliding(np.fmax, rows, self._window) - _sliding(np.fmin, rows, self._window)

    def _speed(self, keyphasor: np.ndarray, index: np.ndarray, enabled: np.ndarray) -> dict[Alarm, tuple]:
        settings, before = self.settings, self._over["pulse", ""]
        high = self._above(("pulse", ""), keyphasor, *_PULSE)
        begins = [row for row in _changes(high, before) if high[row]]
        speed_hz, fast, pulse = (np.full(len(index), state) for state in (self._speed_hz, self._fast, self._pulse))
        for row in begins:
            self._speed_hz = self._rate_hz / (index[row] - self._pulse) if self._turning else 0.0
            self._fast = self._fast + 1 if self._speed_hz > settings.overspeed_hz else 0
            self._pulse, self._turning = int(index[row]), True
            speed_hz[row:], fast[row:], pulse[row:] = self._speed_hz, self._fast, self._pulse
        # A turn that lasts already longer than one at the limit is not too fast: a shaft that stands has no pulse.
        over = (fast >= settings.overspeed_turns) & ((index - pulse) * settings.overspeed_hz < self._rate_hz)
        lost = index - np.maximum(pulse, self._armed) >= self._rows(settings.speed_lost_s)
        return {
            ("overspeed", settings.keyphasor): (over & enabled & (settings.overspeed_hz > 0.0), speed_hz),
            ("speed-lost", settings.keyphasor): (lost & enabled & (settings.speed_lost_s > 0.0), speed_hz),
        }

    def _vote(self, dangers: list[np.ndarray], bad: np.ndarray) -> np.ndarray:
        """Whether dangers of the two probes, of which some are NOT OK, trip at each row."""
        off = np.array([[name in self.bypassed] for name in (self.settings.x, self.settings.y)])
        votes, out = np.array(dangers), off | bad
        if self.settings.not_ok == "for":
            votes, out = votes | (bad & ~off), off
        if self.settings.vote == "1oo2":
            return np.logical_or(*votes)
        if self.settings.not_ok == "against":
            return np.logical_and(*votes)
        return np.logical_and(*(votes | out)) & ~np.logical_and(*out)

    def _run(self, what: Alarm, truth: np.ndarray) -> np.ndarray:
        """How many rows in a row, up to each, a thing has been true."""
        rows = np.arange(len(truth))
        run = rows - np.maximum.accumulate(np.where(truth, -1 - self._runs.get(what, 0), rows))
        self._runs[what] = int(run[-1])
        return run

    def _above(self, what: Alarm, values: np.ndarray, high: float, low: float) -> np.ndarray:
        """Whether values were last above `high`, not below `low`, at each row."""
        outside = (values > high) | (values < low)
        last = np.maximum.accumulate(np.where(outside, np.arange(len(values)), -1))
        above = np.where(last >= 0, values[last] > high, self._over.get(what, False))
        self._over[what] = bool(above[-1])
        return above


def _changes(on: np.ndarray, before: bool) -> np.ndarray:
    """Rows at which a truth is another one than at the row before, shape (changes,)."""
    return np.flatnonzero(np.diff(on, prepend=before))


def _sliding(extreme: Callable[..., np.ndarray], values: np.ndarray, window: int) -> np.ndarray:
    """The extreme of each so many values in a row: of twice as many by each pass, shape (..., values - window + 1)."""
    span = 1
    while 2 * span <= window:
        values, span = extreme(values[..., :-span], values[..., span:]), 2 * span
    rest = window - span
    return extreme(values[..., :-rest], values[..., rest:]) if rest else values
