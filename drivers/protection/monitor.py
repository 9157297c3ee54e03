"""Protection monitor: rows in, actions out, without clock, connection or thread.

The level is the peak-to-peak value of each probe, or Smax of the orbit, in the last `window_s`, above `corner_hz`. An
alarm begins when a level has exceeded its set point for the delay, and its cause ends when the level falls below the
set point by the hysteresis. Dangers trip the rig according to the vote. A probe whose output leaves the OK limits is
NOT OK from that row, until it has been within the limits for `ok_recovery_s`. Meanwhile it raises no alarm, and
`not_ok` determines its vote.

Missing rows, up to one window, are filled with the last row; late and duplicate rows are dropped. After a larger gap,
or when the row numbers restart, the monitor restarts with both probes NOT OK. Each state belongs to a row: the result
does not depend on how the rows are divided into blocks.
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
"""Kind and channel of an alarm."""
TRIP: Alarm = ("trip", "")
_PULSE = (0.6, 0.4)
"""Keyphasor levels, 0 to 1: a pulse begins above the first, after the signal was below the second."""
_MIN_ORBIT = 0.1
"""Diameter of the smallest orbit whose direction counts, a multiple of the alert set point."""


@dataclass(frozen=True, slots=True)
class Action:
    """An alarm, the end of one, or another action at one row.

    Attributes:
        kind: alert, danger, overspeed, speed-lost, reverse, not-ok or trip at its beginning; clear when an alarm ends
            without a reset; reset; rows-lost.
        name: Channel; for a trip the first alarm, for clear and reset the alarm.
        row: Number of the row since the start of the stream.
        tick: Simulated time, rounded [ticks].
        time_s: Simulated time, exact [s].
        value: Level [um], speed [Hz], output of a probe [V], or number of turns or rows.
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
    """Protection monitor for one pair of probes.

    Attributes:
        settings: Its settings.
        multiply: Factor of the set points (trip multiply), from the next row on.
        bypassed: Channels without alarms, from the next row on.
        active: Active alarms, and the trip, with the actions at their beginning.
        first_out: Alarms since their last reset, in the order of their beginning.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings, self.multiply, self.bypassed = settings, 1.0, set(settings.bypass)
        self.active: dict[Alarm, Action] = {}
        self.first_out: list[Alarm] = []
        self._latching = {"trip"}
        self._latching |= {"danger", "overspeed"} if settings.latch_danger else set()
        self._latching |= {"alert", "speed-lost", "reverse"} if settings.latch_alert else set()
        self._received = Continuity()
        self._next: int | None = None
        self._to_reset = False

    @property
    def tripped(self) -> bool:
        """Whether the monitor has tripped, and was not reset since."""
        return TRIP in self.active

    def reset(self) -> None:
        """Reset at the next row: alarms without a cause end, and the trip ends if no danger remains."""
        self._to_reset = True

    def feed(self, samples: Samples) -> list[Action]:
        """Process the next rows, and return the actions in order.

        Raises:
            InputError: A channel is missing, its unit is not a length, or the rate changes.
        """
        fresh = follow(self._received, samples) if len(samples) else None
        if fresh is None:
            return []
        samples = fresh
        signals, missing = self._fill_missing(samples)
        first = samples.index + len(samples) - signals.shape[1]

        def action(kind: str, name: str, row: int, value: float) -> Action:
            tick = row_tick(samples.tick, samples.rate_hz, samples.tick_rate_hz, row - samples.index)
            time_s = float(row_times_s(tick, samples.rate_hz, samples.tick_rate_hz, 1)[0])
            return Action(kind, name, row, tick, time_s, float(value))

        actions = [action("rows-lost", "", samples.index, missing)] if missing else []
        actions += [action("reset", " ".join(alarm).strip(), first, 0.0) for alarm in self._end_acknowledged()]
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
                actions.append(action("clear", " ".join(alarm), first + row, values[row]))
                continue
            if alarm == TRIP:
                name = next((" ".join(each) for each in self.first_out if each[0] != "alert"), "")
            elif alarm not in self.first_out:
                self.first_out.append(alarm)
            actions.append(action(kind, name, first + row, values[row]))
            self.active[alarm] = actions[-1]
        return actions

    def _fill_missing(self, samples: Samples) -> tuple[np.ndarray, int]:
        """Return probes [um] and keyphasor, shape (signals, rows), and the number of rows filled."""
        started = self._next is not None
        if started and samples.rate_hz != self._rate_hz:
            raise InputError("rate_hz", f"{self._rate_hz:g} Hz as before", samples.rate_hz)
        probes = [self.settings.x, self.settings.y]
        scale = [factor(samples.unit(name), "um", field=f"unit of {name}") for name in probes] + [1.0]
        signals = np.vstack([samples[name] * by for name, by in zip(self.settings.channels, scale, strict=False)])
        missing = samples.index - self._next if self._next is not None else 0
        if not started or not 0 <= missing <= self._window:
            self._begin(samples.index, samples.rate_hz)
        elif missing:
            signals = np.hstack([np.repeat(self._last, missing, axis=1), signals])
        self._next, self._last = samples.index + len(samples), signals[:, -1:]
        return signals, missing

    def _begin(self, first: int, rate_hz: float) -> None:
        """Forget all rows. Probes are OK at the first start, and NOT OK after a loss of rows."""
        settings, self._rate_hz = self.settings, rate_hz
        started, probes = self._next is not None, (settings.x, settings.y)
        self._armed = self._armed if started else first + self._rows(settings.startup_s)
        self._runs = {("ok", name): 0 if started else self._rows(settings.ok_recovery_s) for name in probes}
        self._window = max(2, self._rows(settings.window_s))
        self._part = 1.0 - math.exp(-2.0 * math.pi * settings.corner_hz / rate_hz)
        self._means: list[float] = []
        self._tail = np.full((2, self._window - 1), math.nan)
        self._over: dict[Alarm, bool] = {("pulse", ""): True}
        self._pulse, self._turning, self._speed_hz, self._fast, self._reverse = first, False, 0.0, 0, 0
        self._last_motion, self._area, self._turn_area = np.zeros((2, 1)), 0.0, 0.0

    def _rows(self, duration_s: float) -> int:
        return math.ceil(duration_s * self._rate_hz - 1e-6)

    def _end_acknowledged(self) -> list[Alarm]:
        """Remove and return the alarms that a requested reset ends."""
        if not self._to_reset:
            return []
        self._to_reset = False
        cleared = [alarm for alarm in self.active if alarm != TRIP and not self._causes[alarm]]
        if self.tripped and not any(kind in ("danger", "overspeed") for kind, _ in self.active.keys() - set(cleared)):
            cleared.append(TRIP)
        self.active = {alarm: action for alarm, action in self.active.items() if alarm not in cleared}
        self.first_out = [alarm for alarm in self.first_out if alarm in self.active]
        return cleared

    def _states(self, signals: np.ndarray, first: int) -> dict[Alarm, tuple[np.ndarray, np.ndarray]]:
        """Return for each alarm whether it is on at each row, and its value there; in order of rank for one row."""
        settings, index = self.settings, np.arange(first, first + signals.shape[1])
        probes, armed = (settings.x, settings.y), index >= self._armed
        motion = self._remove_gap(signals[:2])
        levels, volts = self._levels(motion), settings.bias_v + 1e-3 * settings.scale_v_per_mm * signals[:2]
        inside = (volts >= settings.ok_low_v) & (volts <= settings.ok_high_v)
        recovery = self._rows(settings.ok_recovery_s)
        good = np.array([self._run(("ok", name), each) > recovery for name, each in zip(probes, inside, strict=True)])
        causes = {("not-ok", name): (~good[place], volts[place]) for place, name in enumerate(probes)}
        if settings.measure == "smax":
            good[:] = good.all(axis=0)  # an orbit needs both probes
        for kind, set_um, delay_s in (
            ("alert", settings.alert_um, settings.alert_delay_s),
            ("danger", settings.danger_um, settings.danger_delay_s),
        ):
            for name, level, okay in zip(probes, levels, good, strict=True):
                high = self.multiply * set_um
                enabled = np.where(okay & armed & (name not in self.bypassed), level, -1.0)
                above = self._apply_hysteresis((kind, name), enabled, high, high * (1.0 - settings.hysteresis))
                causes[kind, name] = self._run((kind, name), above) > self._rows(delay_s), level
        if settings.uses_keyphasor:
            causes |= self._speed(signals[2], motion, index, armed & (settings.keyphasor not in self.bypassed))
        self._causes = {alarm: bool(on[-1]) for alarm, (on, _) in causes.items()}
        states = {
            alarm: (np.logical_or.accumulate(on) | (alarm in self.active) if alarm[0] in self._latching else on, value)
            for alarm, (on, value) in causes.items()
        }
        trip = self._vote([states["danger", name][0] for name in probes], ~good) & armed
        if settings.uses_keyphasor:
            trip |= states["overspeed", settings.keyphasor][0]
        states[TRIP] = np.logical_or.accumulate(trip) | self.tripped, levels.max(axis=0)
        return states

    def _remove_gap(self, probes: np.ndarray) -> np.ndarray:
        """Return the probes without their DC gap [um], shape (2, rows)."""
        part = self._part
        means = [
            list(accumulate(probe.tolist(), lambda mean, value: mean + part * (value - mean), initial=mean))
            for probe, mean in zip(probes, self._means or probes[:, 0].tolist(), strict=True)
        ]
        self._means = [each[-1] for each in means]
        return probes - np.array(means)[:, 1:]

    def _levels(self, motion: np.ndarray) -> np.ndarray:
        """Return the measure of each probe over the window that ends at each row [um], shape (2, rows)."""
        rows = np.hstack([self._tail, motion])
        self._tail = rows[:, rows.shape[1] - self._window + 1 :]
        if self.settings.measure == "smax":
            return np.tile(_sliding_extreme(np.fmax, np.hypot(*rows), self._window), (2, 1))
        return _sliding_extreme(np.fmax, rows, self._window) - _sliding_extreme(np.fmin, rows, self._window)

    def _speed(
        self, keyphasor: np.ndarray, motion: np.ndarray, index: np.ndarray, enabled: np.ndarray
    ) -> dict[Alarm, tuple[np.ndarray, np.ndarray]]:
        settings, before = self.settings, self._over["pulse", ""]
        x, y = np.hstack([self._last_motion, motion])
        area, self._last_motion = self._area + 0.5 * np.cumsum(x[:-1] * y[1:] - x[1:] * y[:-1]), motion[:, -1:]
        high = self._apply_hysteresis(("pulse", ""), keyphasor, *_PULSE)
        begins = [row for row in _changes(high, before) if high[row]]
        states = (self._speed_hz, self._fast, self._pulse, self._reverse)
        speed_hz, fast, pulse, reverse = (np.full(len(index), state) for state in states)
        for row in begins:
            self._speed_hz = self._rate_hz / (index[row] - self._pulse) if self._turning else 0.0
            self._fast = self._fast + 1 if self._speed_hz > settings.overspeed_hz else 0
            # The orbit of a turn encloses a negative area if it runs against the rotation.
            against = self._turning and area[row] - self._turn_area < -_circle_area(_MIN_ORBIT * settings.alert_um)
            self._reverse, self._turn_area = self._reverse + 1 if against else 0, float(area[row])
            self._pulse, self._turning = int(index[row]), True
            speed_hz[row:], fast[row:], pulse[row:] = self._speed_hz, self._fast, self._pulse
            reverse[row:] = self._reverse
        self._area = float(area[-1])
        # The current turn already lasts longer than one at the limit: a shaft at rest has no pulses.
        over = (fast >= settings.overspeed_turns) & ((index - pulse) * settings.overspeed_hz < self._rate_hz)
        lost = index - np.maximum(pulse, self._armed) >= self._rows(settings.speed_lost_s)
        backward = (reverse >= settings.reverse_turns) & enabled & (settings.reverse_turns > 0)
        return {
            ("overspeed", settings.keyphasor): (over & enabled & (settings.overspeed_hz > 0.0), speed_hz),
            ("speed-lost", settings.keyphasor): (lost & enabled & (settings.speed_lost_s > 0.0), speed_hz),
            ("reverse", settings.keyphasor): (backward, reverse),
        }

    def _vote(self, dangers: list[np.ndarray], bad: np.ndarray) -> np.ndarray:
        """Return at which rows the dangers of the two probes, some of which may be NOT OK, trip."""
        off = np.array([[name in self.bypassed] for name in (self.settings.x, self.settings.y)])
        votes, out = np.array(dangers), off | bad
        if self.settings.not_ok == "for":
            votes, out = votes | (bad & ~off), off
        if self.settings.vote == "1oo2":
            return np.logical_or(*votes)
        if self.settings.not_ok == "against":
            return np.logical_and(*votes)
        return np.logical_and(*(votes | out)) & ~np.logical_and(*out)

    def _run(self, alarm: Alarm, truth: np.ndarray) -> np.ndarray:
        """Return the number of consecutive true rows that end at each row; continues from the previous call."""
        rows = np.arange(len(truth))
        run = rows - np.maximum.accumulate(np.where(truth, -1 - self._runs.get(alarm, 0), rows))
        self._runs[alarm] = int(run[-1])
        return run

    def _apply_hysteresis(self, alarm: Alarm, values: np.ndarray, high: float, low: float) -> np.ndarray:
        """Return for each row whether the value is above `high`, or was and has not fallen below `low` since."""
        outside = (values > high) | (values < low)
        last = np.maximum.accumulate(np.where(outside, np.arange(len(values)), -1))
        above = np.where(last >= 0, values[last] > high, self._over.get(alarm, False))
        self._over[alarm] = bool(above[-1])
        return above


def _circle_area(diameter: float) -> float:
    return 0.25 * math.pi * diameter**2


def _changes(on: np.ndarray, before: bool) -> np.ndarray:
    """Return the rows at which a state differs from that of the row before, shape (changes,)."""
    return np.flatnonzero(np.diff(on, prepend=before))


def _sliding_extreme(extreme: Callable[..., np.ndarray], values: np.ndarray, window: int) -> np.ndarray:
    """Return the extreme over a sliding window, shape (..., values - window + 1). Each pass doubles the span."""
    span = 1
    while 2 * span <= window:
        values, span = extreme(values[..., :-span], values[..., span:]), 2 * span
    rest = window - span
    return extreme(values[..., :-rest], values[..., rest:]) if rest else values
