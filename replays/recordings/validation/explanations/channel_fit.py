"""A recorded channel with its expected signal, and a fitted law of the difference."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.estimate.least_squares import solve
from rig.channels.faults.defects import DEFECTS, size_text, unit_of
from rig.channels.table import Channel

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

MARGIN = 25.0
"""Difference of sums of squares that decides between candidates: five standard deviations of one number."""
MIN_ROWS = 16
"""Most rows that are too few for a delay."""
_MIN_SECOND_PART = 0.01
"""Part of the first change's residual that a second change must remove."""
_MIN_REDUCTION = 0.05
"""Reduction of the residual's logarithm per number, if all except for the channel is known to the bit."""
_BEGIN_ROWS = 4.5
"""Rows about the first different one in which the signal's value is searched."""
_MAX_LEVEL_PART = 0.5
"""Largest residual of a log's law with a level relative to that of the level alone."""
OUTLIER = 6.0
"""Deviation of a sample in floors that is not noise."""


@dataclass(frozen=True)
class Shown:
    """A channel in a window: recorded and expected signal, noise floor, and the signals of other channels.

    Attributes:
        channel: The channel.
        times_s: Times of its rows [s], shape (n,).
        values: Recorded values [its unit], shape (n,).
        expected: Expected values [its unit], shape (n,).
        floor: Noise combined with the spread of equally valid predictions [its unit], shape (n,).
        noise: Noise alone [its unit].
        bare: Function that returns the expected values without the low-pass [its unit], shape (n,), if known.
        neighbours: Function that returns times and expected values of the other, varying channels, by channel.
        counts: Recorded and expected counts, including noise, shape (n, 2); None if unknown. If known, `values` are
            without noise.
        lasted_s: Times of the first and the last difference [s], if known.
        around: Times and expected values from before its rows to after them, each shape (m,); None: those of its rows.
        turns: Angle of the shaft [revolutions], shape (n,), for a log; None otherwise.
    """

    channel: Channel
    times_s: np.ndarray
    values: np.ndarray
    expected: np.ndarray
    floor: np.ndarray
    noise: float
    bare: Callable[[], np.ndarray] | None = None
    neighbours: Callable[[], Mapping[Channel, tuple[np.ndarray, np.ndarray]]] = field(default=dict)
    counts: np.ndarray | None = None
    lasted_s: tuple[float, float] = (0.0, math.inf)
    around: tuple[np.ndarray, np.ndarray] | None = None
    turns: np.ndarray | None = None

    @property
    def name(self) -> str:
        """Name of the channel."""
        return self.channel.name

    @property
    def unit(self) -> str:
        """Unit of the channel."""
        return self.channel.unit

    @cached_property
    def expected_at(self) -> BSpline:
        """Expected signal as a function of time."""
        from scipy.interpolate import make_interp_spline

        return make_interp_spline(*(self.around or (self.times_s, self.expected)), k=5)

    @property
    def apart(self) -> np.ndarray:
        """Residuals over the floor, shape (n,)."""
        return (self.values - self.expected) / self.floor

    @cached_property
    def price(self) -> float:
        """Least sum of squares that an additional number must remove, above noise and a part of other errors."""
        residual = self.solve([np.ones(len(self.values))], self.values - self.expected)[1]
        return max(MARGIN, _MIN_SECOND_PART * float(residual @ residual))  # a level may exceed the motion by far

    @cached_property
    def without_level(self) -> np.ndarray:
        """Residual of a level alone, shape (n,)."""
        return self.solve([self.level], self.values - self.expected)[1]

    def exceeds_level(self, residual: np.ndarray) -> bool:
        """Return whether a law with a residual, shape (n,), explains most of what a level alone leaves, in a log."""
        n, alone = len(self.values), self.without_level
        return self.counts is not None or float(residual @ residual) - n <= max(
            0.0, _MAX_LEVEL_PART * (float(alone @ alone) - n)
        )

    def cost(self, residual: np.ndarray, count: int) -> float:
        """Return the cost of a law by its number of parameters and its residual over the floor, shape (n,) or fewer."""
        squares = float(residual @ residual)
        if self.counts is None:
            return squares + self.price * count
        # Nothing else is wrong: a number costs a part of the residual, however small.
        return len(self.values) * (math.log(max(1.0, squares / max(1, len(residual)))) + _MIN_REDUCTION * count)

    @cached_property
    def level(self) -> np.ndarray:
        """Response to a constant input, shape (n,), which fades if the channel is AC-coupled."""
        held = 2.0 * math.pi * self.channel.highpass_hz if self.counts is not None else 0.0
        return np.exp(-held * (self.times_s - self.lasted_s[0]))

    def at_begin(self, value: float) -> bool:
        """Return whether the expected signal has a value near the first difference."""
        times_s, expected = self.around or (self.times_s, self.expected)
        rows = np.abs(times_s - self.lasted_s[0]) < _BEGIN_ROWS / self.channel.rate_hz
        near = expected[rows] if rows.any() else expected[:1]
        slack = OUTLIER * self.noise + 1e-3 * float(np.ptp(self.expected))
        return bool(near.min() - slack < value < near.max() + slack)

    def coupled(self, times_s: np.ndarray, signal: np.ndarray) -> np.ndarray:
        """Return the response to a new input signal, shape (n,), without its mean if the channel is AC-coupled.

        Args:
            times_s: Times of the signal [s], shape (m,).
            signal: Signal, shape (m,).
        """
        held = 2.0 * math.pi * self.channel.highpass_hz if self.counts is not None else 0.0
        if held:
            from scipy.integrate import cumulative_trapezoid

            inside = (times_s >= self.lasted_s[0]) & (times_s <= self.times_s[-1])
            times_s, signal = times_s[inside], signal[inside]
            grown = np.exp(held * (times_s - self.lasted_s[0]))
            signal = signal - held * cumulative_trapezoid(grown * signal, times_s, initial=0.0) / grown
        return np.interp(self.times_s, times_s, signal)

    def at(self, times_s: np.ndarray) -> Shown:
        """Return the channel at some of its times."""
        rows = np.searchsorted(self.times_s, times_s)
        counts = None if self.counts is None else self.counts[rows]
        return replace(
            self, times_s=times_s, values=self.values[rows], expected=self.expected[rows], floor=self.floor[rows],
            counts=counts,
        )  # fmt: skip

    @property
    def moves(self) -> bool:
        """True if the expected signal varies by more than noise, or than rounding if its noise is known."""
        return float(self.expected.std()) > (self.noise if self.counts is None else OUTLIER * float(self.floor[0]))

    @property
    def even(self) -> bool:
        """True if there are enough rows, in ascending order, for delays and frequencies."""
        return len(self.values) > MIN_ROWS and bool((np.diff(self.times_s) > 0.0).all())

    @property
    def uniform(self) -> bool:
        """True if the rows are also equidistant."""
        steps = np.diff(self.times_s)
        return self.even and bool(steps.max() < 1.5 * steps.min())

    @property
    def period_s(self) -> float:
        """Sampling period [s]."""
        return float(np.diff(self.times_s).min())

    def solve(self, columns: list[np.ndarray], aim: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the least-squares factors of columns in the recorded signal, and the residuals over the floor."""
        weights = 1.0 / self.floor
        table = np.column_stack(columns) * weights[:, None]
        goal = (self.values if aim is None else aim) * weights
        factors = solve(table, goal)
        return factors, goal - table @ factors

    def fitted(
        self, law: Callable[[np.ndarray], np.ndarray], starts: list[list[float]], scale: list[float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of a law with the least residual, from the best of some initial values, and the latter."""
        from scipy.optimize import least_squares

        def errors(scaled: np.ndarray) -> np.ndarray:
            return np.nan_to_num((self.values - law(scaled * scale)) / self.floor, nan=1e9, posinf=1e9, neginf=-1e9)

        best = min((np.array(start) / scale for start in starts), key=lambda start: float(np.sum(errors(start) ** 2)))
        fit = least_squares(errors, best, method="lm", max_nfev=60)
        return fit.x * scale, fit.fun

    def law(
        self, name: str, value: float, residual: np.ndarray, count: int = 1, change: str = "", *,
        unit: str | None = None, numbers: Mapping[str, float] | None = None, sure: bool = True,
    ) -> Law:  # fmt: skip
        """Return a law of this channel, with the unit and, by default, the text of the table of defects."""
        unit = unit_of(name, self.unit) if unit is None else unit
        return Law(name, change or size_text(name, value, self.unit), value, residual, count, unit, numbers or {}, sure)


@dataclass(frozen=True)
class Law:
    """A fitted law of a defect.

    Attributes:
        name: Name in the table of defects, or several: "gain and delay", "open or short".
        change: Size as text.
        value: Size in `unit`.
        residual: Residual over the floor, shape (n,) or fewer.
        count: Number of fitted numbers.
        unit: Unit of the size, by the table of defects.
        numbers: Gain error and delay [s], if there are any; several channels may share one.
        sure: Whether the residual is negligible.
    """

    name: str
    change: str
    value: float
    residual: np.ndarray
    count: int = 1
    unit: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)
    sure: bool = True


def rms_of(residual: np.ndarray) -> float:
    """Return the root mean square, shape (n,)."""
    return math.sqrt(float(residual @ residual) / max(1, len(residual)))


def least_at(cost: Callable[[float], float], low: float, high: float) -> float:
    """Return the place of the least cost between two ends."""
    from scipy.optimize import minimize_scalar

    minimum: Any = minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 1e-9})
    return float(minimum.x)


def gain_words(gain: float) -> tuple[str, str]:
    """Return the name and the size of the defect for a factor, as text."""
    slip = next((text for factor, text in DEFECTS["gain"].slips if abs(gain / factor - 1.0) < 0.02), "")
    if abs(gain + 1.0) < 0.1:
        return "polarity", DEFECTS["polarity"].words
    if abs(gain) < 0.05 and not slip:
        return "signal", "missing"
    return "gain", size_text("gain", gain - 1.0) + (f" ({slip})" if slip else "")


def with_level(one: Shown, law: Law, level: float, bare: np.ndarray) -> Iterator[Law]:
    """Yield a law with its level stated; for a log, only if it explains most of what the level alone leaves.

    Args:
        one: The channel.
        law: A law that was fitted together with a level.
        level: The level.
        bare: Residual of the law without a level.
    """
    if one.counts is not None:
        yield law
        return
    alone, before, n = one.without_level, one.apart, len(one.values)
    if not one.exceeds_level(law.residual):
        return
    if float(bare @ bare) < float(law.residual @ law.residual) + one.price:
        yield law
        return
    texts, names = [law.change, size_text("offset", level, one.unit)], [law.name, "offset"]
    value, unit = law.value, law.unit
    if law.name != "drift" and before @ before + n > 2.0 * float(alone @ alone):
        texts, names, value, unit = texts[::-1], names[::-1], level, one.unit
    yield replace(law, name=" and ".join(names), change=", ".join(texts), value=value, unit=unit)
