"""One channel beside what it should show, and one law of what is between the two."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from replays.estimate.least_squares import solve
from rig.channels.faults.defects import DEFECTS, size_text, unit_of
from rig.channels.table import Channel

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

DECIDES = 25.0
"""A sum of squares that is smaller by this (five standard deviations of one number) decides between two candidates."""
FEW = 16
"""Rows that tell no delay."""
_SLIGHT = 0.01
"""A second change of a channel that takes away no more than this part of the first is none."""
_PART = 0.05
"""Of what is left, by which another number makes it smaller where all but the channel is known to the bit."""
_ABOUT = 4.5
"""Rows about the one that differs first."""
OFF = 6.0
"""A sample so many floors off is no noise."""


@dataclass(frozen=True)
class Shown:
    """One channel in a window, over its floor: what it shows, what it should, and that of the others.

    Attributes:
        channel: The channel.
        times_s: Of its rows [s], shape (n,).
        values: What it shows [its unit], shape (n,).
        foretold: What it should show [its unit], shape (n,).
        floor: Noise, and how far an equally right prediction may be off [its unit], shape (n,).
        noise: Noise alone [its unit].
        bare: What it should show without a low-pass [its unit], shape (n,), where that is known.
        beside: Of other channels that move, times and what they should show [their units], by channel.
        counts: What its converter said and should have said, noise and all, shape (n, 2); none where that is not known.
            Then `values` are those that it would show without its noise.
        lasted_s: When it began to differ, and when it last did [s], where that is known.
        around: Times and what it should show, from before its rows to behind them, each shape (m,); none: its rows.
    """

    channel: Channel
    times_s: np.ndarray
    values: np.ndarray
    foretold: np.ndarray
    floor: np.ndarray
    noise: float
    bare: Callable[[], np.ndarray] | None = None
    beside: Callable[[], Mapping[Channel, tuple[np.ndarray, np.ndarray]]] = field(default=dict)
    counts: np.ndarray | None = None
    lasted_s: tuple[float, float] = (0.0, math.inf)
    around: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def name(self) -> str:
        """Its name."""
        return self.channel.name

    @property
    def unit(self) -> str:
        """Its unit."""
        return self.channel.unit

    @cached_property
    def foretold_at(self) -> BSpline:
        """What it should show at other times."""
        from scipy.interpolate import make_interp_spline

        return make_interp_spline(*(self.around or (self.times_s, self.foretold)), k=5)

    @property
    def apart(self) -> np.ndarray:
        """Residuals over the floor, shape (n,)."""
        return (self.values - self.foretold) / self.floor

    @cached_property
    def price(self) -> float:
        """What another number must take away: more than noise makes, and than what is wrong elsewhere brings along."""
        level = np.ones(len(self.values))  # may be off by far more than anything moves
        left = self.left([level], self.values - self.foretold)[1]
        return max(DECIDES, _SLIGHT * float(left @ left))

    def cost(self, left: np.ndarray, count: int) -> float:
        """Of a law with so many numbers that leaves so much over the floor, shape (n,) or fewer."""
        if self.counts is None:
            return float(left @ left) + self.price * count
        # Nothing else is wrong: a number pays by a part of what is left, however little that is.
        return len(self.values) * (math.log(max(1.0, float(left @ left) / max(1, len(left)))) + _PART * count)

    @cached_property
    def level(self) -> np.ndarray:
        """What it shows of something constant, shape (n,): where it is AC-coupled, that goes away."""
        held = 2.0 * math.pi * self.channel.highpass_hz if self.counts is not None else 0.0
        return np.exp(-held * (self.times_s - self.lasted_s[0]))

    def at_begin(self, value: float) -> bool:
        """Whether it should have shown this about when it began to differ."""
        times_s, foretold = self.around or (self.times_s, self.foretold)
        rows = np.abs(times_s - self.lasted_s[0]) < _ABOUT / self.channel.rate_hz
        near = foretold[rows] if rows.any() else foretold[:1]
        slack = OFF * self.noise + 1e-3 * float(np.ptp(self.foretold))
        return bool(near.min() - slack < value < near.max() + slack)

    def coupled(self, times_s: np.ndarray, signal: np.ndarray) -> np.ndarray:
        """What it shows, shape (n,), of a signal that it did not see before: where it is AC-coupled, not its mean.

        Args:
            times_s: Of the signal [s], shape (m,).
            signal: Shape (m,).
        """
        held = 2.0 * math.pi * self.channel.highpass_hz if self.counts is not None else 0.0
        if held:
            from scipy.integrate import cumulative_trapezoid

            seen = (times_s >= self.lasted_s[0]) & (times_s <= self.times_s[-1])
            times_s, signal = times_s[seen], signal[seen]
            grown = np.exp(held * (times_s - self.lasted_s[0]))
            signal = signal - held * cumulative_trapezoid(grown * signal, times_s, initial=0.0) / grown
        return np.interp(self.times_s, times_s, signal)

    def at(self, times_s: np.ndarray) -> Shown:
        """The same at some of its times."""
        rows = np.searchsorted(self.times_s, times_s)
        counts = None if self.counts is None else self.counts[rows]
        return replace(
            self, times_s=times_s, values=self.values[rows], foretold=self.foretold[rows], floor=self.floor[rows],
            counts=counts,
        )  # fmt: skip

    @property
    def moves(self) -> bool:
        """Whether it should show more than noise, or than rounding where its noise is known."""
        return float(self.foretold.std()) > (self.noise if self.counts is None else OFF * float(self.floor[0]))

    @property
    def even(self) -> bool:
        """Whether its rows tell delays and frequencies: enough of them, one behind the other."""
        return len(self.values) > FEW and bool((np.diff(self.times_s) > 0.0).all())

    @property
    def uniform(self) -> bool:
        """Whether they are equally far apart, too."""
        steps = np.diff(self.times_s)
        return self.even and bool(steps.max() < 1.5 * steps.min())

    @property
    def period_s(self) -> float:
        """Between its rows [s]."""
        return float(np.diff(self.times_s).min())

    def left(self, columns: list[np.ndarray], aim: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Least squares of what it shows by some columns: their factors, and the residuals over the floor, (n,)."""
        weights = 1.0 / self.floor
        table = np.column_stack(columns) * weights[:, None]
        goal = (self.values if aim is None else aim) * weights
        found = solve(table, goal)
        return found, goal - table @ found

    def fitted(
        self, law: Callable[[np.ndarray], np.ndarray], starts: list[list[float]], scale: list[float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """The numbers of a law of what it shows that leave least, from the best of some starts, and what they leave."""
        from scipy.optimize import least_squares

        def left(scaled: np.ndarray) -> np.ndarray:
            return np.nan_to_num((self.values - law(scaled * scale)) / self.floor, nan=1e9, posinf=1e9, neginf=-1e9)

        best = min((np.array(start) / scale for start in starts), key=lambda start: float(np.sum(left(start) ** 2)))
        found = least_squares(left, best, method="lm", max_nfev=60)
        return found.x * scale, found.fun

    def law(
        self, name: str, value: float, left: np.ndarray, count: int = 1, change: str = "", *, unit: str | None = None,
        numbers: Mapping[str, float] | None = None, sure: bool = True,
    ) -> Law:  # fmt: skip
        """Return a law of this channel, with the unit and, unless it is given, the text of the table of defects."""
        unit = unit_of(name, self.unit) if unit is None else unit
        return Law(name, change or size_text(name, value, self.unit), value, left, count, unit, numbers or {}, sure)


@dataclass(frozen=True)
class Law:
    """One law, as it fits best.

    Attributes:
        name: Name in the table of defects, or several: "gain and delay", "open or short".
        change: Size as text.
        value: Size in `unit`.
        left: What it leaves, over the floor, shape (n,) or fewer.
        count: Numbers that it has.
        unit: Unit of the size, by the table of defects.
        numbers: A gain less 1 and a delay [s], where it has one: several channels may share it.
        sure: Whether what it leaves is as good as nothing.
    """

    name: str
    change: str
    value: float
    left: np.ndarray
    count: int = 1
    unit: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)
    sure: bool = True


def rms_of(left: np.ndarray) -> float:
    """Root mean square, shape (n,)."""
    return math.sqrt(float(left @ left) / max(1, len(left)))


def least_at(cost: Callable[[float], float], low: float, high: float) -> float:
    """Where a cost is least between two ends."""
    from scipy.optimize import minimize_scalar

    found: Any = minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 1e-9})
    return float(found.x)


def gain_words(gain: float) -> tuple[str, str]:
    """What a factor is called, and how large it is, in words."""
    known = next((text for factor, text in DEFECTS["gain"].slips if abs(gain / factor - 1.0) < 0.02), "")
    if abs(gain + 1.0) < 0.1:
        return "polarity", DEFECTS["polarity"].words
    if abs(gain) < 0.05 and not known:
        return "signal", "missing"
    return "gain", size_text("gain", gain - 1.0) + (f" ({known})" if known else "")
