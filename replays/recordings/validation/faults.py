"""Faults that no number of the model makes: a channel's gain, offset, polarity or noise, and the recorder's clock."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from replays.recordings.least_squares import fit
from replays.recordings.prediction import Measured, Prediction
from replays.recordings.validation.explanation import (
    DECIDES,
    Explanation,
    excess,
    is_noise,
    smooth_columns,
    vector,
)

_SEARCH = 400
"""Samples by which the time may be off in the first search, either way."""


def sensor_faults(parts: dict[str, Measured], nominal: Prediction, end_s: float) -> list[Explanation]:
    """What each channel that differs may have, by itself."""
    columns = {}
    total = 0.0
    for name, part in parts.items():
        n = part.rows_until(end_s)
        for c in smooth_columns(part):
            floor = float(part.floor[c])
            r, e = part.values[:n, c] / floor, nominal.values[name][:n, c] / floor
            columns[part.channels[c].name] = (r, e, part.channels[c].unit, floor)
            total += excess(r - e)
    off = {name: entry for name, entry in columns.items() if len(entry[0]) > 2 and not is_noise(entry[0] - entry[1])}
    found = []
    swapped = set()
    for a, b in combinations(off, 2):
        if off[a][2] == off[b][2] and len(off[a][0]) == len(off[b][0]):
            (ra, ea, _, fa), (rb, eb, _, fb) = off[a], off[b]
            crossed = np.concatenate([ra - eb * (fb / fa), rb - ea * (fa / fb)])
            if is_noise(crossed):
                share = (excess(ra - ea) + excess(rb - eb) - excess(crossed)) / total
                found.append(_fault(f"{a} and {b}", "swapped", 0.0, crossed, explained=share, to_s=end_s))
                swapped |= {a, b}
    for name, (r, e, unit, floor) in off.items():
        if name not in swapped:
            found.append(_one_sensor(name, r, e, unit=unit, floor=floor, total=total, to_s=end_s))
    return found


def _one_sensor(
    name: str, r: np.ndarray, e: np.ndarray, *, unit: str, floor: float, total: float, to_s: float
) -> Explanation:
    """The simplest change of a channel that leaves noise, else the one that leaves least."""
    before = excess(r - e)

    def told(what: str, change: str, value: float, left: np.ndarray, of: str = "") -> Explanation:
        explained = (before - excess(left)) / total
        return _fault(f"{name} {what}", change, value, left, unit=of, explained=explained, to_s=to_s)

    shift = float((r - e).mean())
    options = [told("offset", f"{shift * floor:+.4g} {unit}", shift * floor, r - e - shift, unit)]
    if e @ e > 0.0:
        gain = float(r @ e) / float(e @ e)
        what, change = _gain_words(gain)
        options.append(told(what, change, gain - 1.0, r - gain * e))
    if e.std() > 1.0:
        slope, base = (float(number) for number in np.polyfit(e, r, 1))
        what, change = _gain_words(slope)
        left = r - slope * e - base
        options.append(told(f"{what} and offset", f"{change}, {base * floor:+.4g} {unit}", slope - 1.0, left))
    # Another number must earn its place.
    best = min(enumerate(options), key=lambda pair: pair[1].squares + DECIDES * (pair[0] == 2))[1]
    if best.at_floor:
        return best
    rest = r - e - shift
    white = abs(float(rest[1:] @ rest[:-1]) / float(rest @ rest)) < 0.1
    tied = e.std() > 1.0 and abs(float(np.corrcoef(rest, e)[0, 1])) > 0.1
    if white and not tied:
        ratio = float(rest.std())
        share = before / total
        return _fault(f"{name} noise", f"x {ratio:.2f}", ratio, rest / ratio, explained=share, to_s=to_s)
    return best


def _fault(
    name: str, change: str, value: float, left: np.ndarray, *, unit: str = "", explained: float, to_s: float
) -> Explanation:
    return Explanation.of(
        left, kind="sensor", name=name, change=change, value=value, unit=unit, explained=explained, to_s=to_s
    )


def _gain_words(gain: float) -> tuple[str, str]:
    if abs(gain + 1.0) < 0.1:
        return "polarity", "turned round"
    if abs(gain) < 0.02:
        return "signal", "missing"
    return "gain", f"{100.0 * (gain - 1.0):+.3g} %"


class Clock:
    """Residuals where the recording's clock is off by a shift and a rate; what is left out is not smooth in time."""

    def __init__(self, parts: dict[str, Measured], nominal: Prediction, end_s: float) -> None:
        """Prepare.

        Args:
            parts: What was recorded.
            nominal: What was predicted.
            end_s: End of the window [s].
        """
        from scipy.interpolate import CubicSpline

        self._splines = {
            name: CubicSpline(part.times_s, nominal.values[name])
            for name, part in parts.items()
            if part.rows_until(end_s) > 16 and (np.diff(part.times_s) > 0.0).all()
        }
        self._kept = {name: parts[name].until(end_s) for name in self._splines}
        self._end_s = end_s
        if self._kept:
            self._first_s = min(float(part.times_s[0]) for part in self._kept.values())
            self._period_s = min(float(np.diff(part.times_s).min()) for part in self._kept.values())

    def residuals(self, change: np.ndarray) -> np.ndarray:
        """Over the noise, at a shift [s], or a shift and a rate [1], shape (n,)."""
        shift, rate = float(change[0]), float(change[1]) if len(change) > 1 else 0.0
        # Beyond the window the prediction is known as well: a shift does not run out of it.
        values = {
            name: self._splines[name](part.times_s - shift - rate * (part.times_s - self._first_s))
            for name, part in self._kept.items()
        }
        return vector(self._kept, values)

    def coarse_shift(self) -> float:
        """The shift in time that fits best, to a sample or so [s]; 0 where there are too few rows to tell."""
        if not self._kept:
            return 0.0
        # Few places are enough to find the one from which the slope leads on.
        rows = np.unique(np.rint(np.concatenate([np.arange(-16, 17), np.linspace(-_SEARCH, _SEARCH, 101)])))
        shifts = rows * self._period_s
        return float(min(shifts, key=lambda shift: float(np.sum(self.residuals(np.array([shift])) ** 2))))

    def faults(self, start_s: float) -> list[Explanation]:
        """A shift, and a shift with a rate where that says more; none that takes nothing away.

        Args:
            start_s: Where the search for the shift begins [s].
        """
        before = excess(self.residuals(np.zeros(1))) if self._kept else 0.0
        found: list[Explanation] = []
        if before == 0.0:
            return found
        for rates in (False, True):
            done = fit(self.residuals, self._slopes, np.array([start_s, 0.0][: 1 + rates]), rounds=8, gain=1e-5)
            assert done is not None
            shift, rate = [*done.values.tolist(), 0.0][:2]
            change, value, unit = f"{shift * 1e6:+.1f} µs", shift, "s"
            if rates:
                change, value, unit = f"{change} and {rate * 1e6:+.1f} ppm", rate * 1e6, "ppm"
            explained = 1.0 - excess(done.residuals) / before
            if explained > 0.0 and (not found or done.squares < found[0].squares - DECIDES):
                found.append(
                    Explanation.of(
                        done.residuals, kind="time", name="clock" if rates else "time offset", change=change,
                        value=value, unit=unit, explained=explained, to_s=self._end_s,
                    )
                )  # fmt: skip
        return found

    def _slopes(self, change: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        length_s = self._end_s - self._first_s
        step_s = 0.02 * self._period_s
        steps = np.diag([step_s, step_s / max(length_s, self._period_s)][: len(change)])
        return np.column_stack([(self.residuals(change + step) - residuals) / step.sum() for step in steps])
