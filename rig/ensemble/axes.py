"""Axes and designs: the values of each run of an ensemble, computed for any slice of runs.

The values of a run depend on its number, on the axes and on the seed only, so the order of the runs, the size of the
tasks and the number of workers do not matter. Random numbers are those of a counter-based generator (Philox).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from rig.base.checks import Written, check
from rig.base.errors import InputError, UnknownNameError, Words
from rig.ensemble.keys import Bounds, find_bounds, vary
from rig.physics.model import build_model
from rig.run.scenes import Scene

Sampling = Literal["grid", "random", "latin", "sobol", "halton"]
MAX_RUNS = 2**30
"""Most runs of a design: scipy's Sobol sequence has no more points."""
_NUMBERS = {
    "uniform": ("from", "to"),
    "normal": ("mean", "std"),
    "lognormal": ("mean", "std"),
    "triangular": ("from", "mode", "to"),
}
"""Required numbers of each distribution."""
_MAX_VALUES = 1_000_000
"""Most values of a list or grid."""
_CHECKED = 64
"""Longest list of which each value is checked; of a longer one, the ends."""
_SEEDS, _NUMBERS_OF_RUNS, _PERMUTATIONS = 1, 2, 3
"""Independent streams of random numbers."""
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]


class Axis(Written):
    """Values of one key: a list, a grid, or a distribution.

    A distribution is truncated at the limits of its key, and at `from` and `to` if they are given.

    Example:
        >>> Axis.read([0.1, 0.2]), Axis.read({"distribution": "normal", "mean": 0.2, "std": 0.05})
        (Axis(0.1, 0.2), Axis(normal: mean 0.2, std 0.05))
    """

    values: tuple[Any, ...] | None = None
    """Numbers or texts."""
    start: Number | None = Field(None, alias="from")
    """First value of a grid, or lower limit of a distribution."""
    stop: Number | None = Field(None, alias="to")
    """Last value of a grid, or upper limit of a distribution."""
    count: Annotated[int, Field(ge=2, le=_MAX_VALUES, strict=True)] | None = None
    """Number of values of a grid."""
    scale: Literal["linear", "log"] = "linear"
    """Spacing of a grid, or of the variable of a uniform distribution."""
    distribution: Any = None
    """Name of a distribution; in Python also a frozen distribution of scipy.stats."""
    mean: Number | None = None
    std: Annotated[Number, Field(gt=0.0)] | None = None
    """Standard deviation."""
    mode: Number | None = None
    """Most probable value of a triangular distribution."""

    @classmethod
    def read(cls, given: Any, field: str = "axis") -> Axis:
        """Return the axis of a list, an array, a table of fields, or a frozen distribution.

        Raises:
            InputError: A field is wrong.
        """
        if isinstance(given, Axis):
            return given
        if hasattr(given, "ppf"):
            given = {"distribution": given}
        elif not isinstance(given, Mapping):
            values = given.tolist() if isinstance(given, np.ndarray | np.generic) else given
            given = {"values": values if isinstance(values, list | tuple | range) else [values]}
        return check(cls, given, field=field)

    @field_validator("values", mode="before")
    @classmethod
    def _check_values(cls, values: Any) -> tuple[Any, ...]:
        values = values if isinstance(values, list | tuple | range) and len(values) <= _MAX_VALUES else ()
        if not values or not all(isinstance(each, str) or (isinstance(each, bool | int | float)
                                 and -1e300 < each < 1e300) for each in values):  # fmt: skip
            raise ValueError(f"a list of 1 to {_MAX_VALUES} numbers or texts")
        return tuple(values)

    @field_validator("distribution")
    @classmethod
    def _check_distribution(cls, distribution: Any) -> Any:
        if distribution is not None and distribution not in [*_NUMBERS] and not hasattr(distribution, "ppf"):
            raise UnknownNameError("distribution", f"one of {', '.join(_NUMBERS)}", distribution, _NUMBERS)
        if hasattr(distribution, "ppf") and not (np.ndim(half := distribution.ppf(0.5)) == 0 and math.isfinite(half)):
            raise ValueError("a distribution of one finite number")
        return distribution

    @model_validator(mode="after")
    def _check_form(self) -> Axis:
        forms = {"values": self.values, "count": self.count, "distribution": self.distribution}
        used = [name for name, value in forms.items() if value is not None]
        if len(used) != 1:
            must = "given alone: `values`, or `from`, `to` and `count`, or `distribution` with its numbers"
            raise InputError(" and ".join(used) or "values", must, Words("all" if used else "none of them"))
        numbers = {"from": self.start, "to": self.stop, "mean": self.mean, "std": self.std, "mode": self.mode}
        given = [name for name, value in numbers.items() if value is not None]
        if self.count is not None:
            needed, of, allowed = ("from", "to"), "count", ()
        else:
            named = isinstance(self.distribution, str)
            needed = _NUMBERS[self.distribution] if named else ()
            of, allowed = (self.distribution if named else used[0]), ("from", "to") if self.distribution else ()
        for name in needed:
            if name not in given:
                raise InputError(name, f"given with {of}", None)
        for name in given:
            if name not in (*needed, *allowed):
                raise InputError(name, f"left out with {of}", numbers[name])
        if self.scale == "log" and self.count is None and self.distribution != "uniform":
            raise InputError("scale", f"left out with {of}", "log")
        positive = ("from", "to") if self.scale == "log" else ("mean",) if self.distribution == "lognormal" else ()
        for name in positive:
            if (number := numbers[name]) is not None and number <= 0.0:
                must = f"greater than 0 with {'scale log' if self.scale == 'log' else of}"
                raise InputError(name, must, number)
        order = [each for each in (self.start, self.mode, self.stop) if each is not None]
        if order != sorted(order) or (len(order) > 1 and order[0] == order[-1]):
            must = f"greater than from{', with mode between them' * (self.mode is not None)}"
            raise InputError("to", must, self.stop)
        return self

    def __repr__(self) -> str:
        if self.values is not None:
            return f"Axis({', '.join(map(str, self.values[:5]))}{', ...' if len(self.values) > 5 else ''})"
        numbers = self.model_dump(by_alias=True, exclude_none=True, exclude_defaults=True, exclude={"distribution"})
        name = self.distribution if isinstance(self.distribution, str) else "scipy" if self.distribution else "grid"
        return f"Axis({name}: {', '.join(f'{key} {value}' for key, value in numbers.items())})"

    __str__ = __repr__

    @cached_property
    def points(self) -> np.ndarray | None:
        """Values of a list or a grid; None for a distribution."""
        if self.values is not None:
            kinds = {isinstance(each, bool | str) for each in self.values}
            return np.array(self.values, dtype=object if True in kinds else float)
        if self.count is None:
            return None
        space = np.geomspace if self.scale == "log" else np.linspace
        return space(float(self.start or 0.0), float(self.stop or 0.0), self.count)

    def quantiles(self, parts: np.ndarray, bounds: Bounds, field: str) -> np.ndarray:
        """Return the quantiles of the distribution, truncated at the limits of its key.

        Args:
            parts: Parts, each between 0 and 1.
            bounds: Limits of the key.
            field: The key, for errors.

        Raises:
            InputError: The distribution has no value within the limits.
        """
        low = bounds.low if self.start is None else max(self.start, bounds.low)
        high = bounds.high if self.stop is None else min(self.stop, bounds.high)
        law = self._law
        # Just below the limit: a discrete distribution may have a value there.
        first, last = law.cdf(np.nextafter(low, -math.inf)), law.cdf(high)
        if not last > first:
            raise InputError(field, f"a distribution with values from {low:g} to {high:g}", Words(str(self)))
        return np.clip(law.ppf(first + parts * (last - first)), low, high)

    @cached_property
    def _law(self) -> Any:
        from scipy import stats

        low, high = float(self.start or 0.0), float(self.stop or 0.0)
        mean, std = self.mean or 0.0, self.std or 0.0
        if self.distribution == "uniform":
            return stats.loguniform(low, high) if self.scale == "log" else stats.uniform(low, high - low)
        if self.distribution == "normal":
            return stats.norm(mean, std)
        if self.distribution == "lognormal":  # with this mean and standard deviation, not those of the logarithm
            width = math.sqrt(math.log1p((std / mean) ** 2))
            return stats.lognorm(width, scale=mean * math.exp(-0.5 * width**2))
        if self.distribution == "triangular":
            return stats.triang(((self.mode or 0.0) - low) / (high - low), low, high - low)
        return self.distribution

    def list_checked(self, bounds: Bounds, field: str) -> list[Any]:
        """Return values that show whether the key accepts all: each of a short list, else the ends and some between."""
        if self.points is None:
            ends = [] if self.start is None else [self.start]
            ends += [] if self.stop is None else [self.stop]
            return [*ends, *self.quantiles(np.array([1e-3, 0.37, 1.0 - 1e-3]), bounds, field).tolist()]
        points = self.points.tolist()
        if len(points) <= _CHECKED:
            return points
        numbers = [each for each in points if not isinstance(each, str)]
        return [*{each for each in points if isinstance(each, str)}, *(f(numbers) for f in (min, max) if numbers)]


@dataclass(frozen=True)
class Design:
    """Values and seed of each run.

    Attributes:
        axes: Axes by key.
        bounds: Limits and unit of each key.
        sampling: "grid" (each combination, the last key fastest), "random", "latin" (Latin hypercube), "sobol" or
            "halton" (scrambled).
        runs: Number of runs.
        seed: Seed of the random numbers.
    """

    axes: dict[str, Axis]
    bounds: dict[str, Bounds]
    sampling: Sampling
    runs: int
    seed: int

    @classmethod
    def create(
        cls, scene: Scene, over: Mapping[str, Any], *, runs: int | None, sampling: str | None, seed: int,
        checks: bool = True,
    ) -> Design:  # fmt: skip
        """Return a design after checking it.

        Args:
            scene: The scene whose keys are varied.
            over: Axes by key.
            runs: Number of runs; None for a grid.
            sampling: See the attribute; default: a grid if `runs` is not given and no axis is a distribution.
            seed: Seed.
            checks: Also check that the scene accepts the values.

        Raises:
            InputError: A key is unknown, a value is not accepted, or the number of runs is wrong.
        """
        if not isinstance(over, Mapping) or not over:
            raise InputError("over", "a table of axes by key, not empty", over)
        axes = {str(key): Axis.read(given, f"over.{key}") for key, given in over.items()}
        if {"hammer.direction", "hammer.angle_deg"} <= axes.keys():
            raise InputError("over.hammer.direction", "left out with hammer.angle_deg", Words("both"))
        sizes = [0 if axis.points is None else len(axis.points) for axis in axes.values()]
        if sampling is None:
            sampling = "grid" if all(sizes) and runs is None else "random"
        if sampling not in (known := Sampling.__args__):  # type: ignore[attr-defined]
            raise UnknownNameError("sampling", f"one of {', '.join(known)}", sampling, known)
        if sampling == "grid":
            for key, size in zip(axes, sizes, strict=True):
                if not size:
                    raise InputError(
                        f"over.{key}", "values, or a grid with count, with sampling grid", Words(axes[key])
                    )
            total = math.prod(sizes)
            if runs not in (None, total):
                raise InputError("runs", f"left out with sampling grid, which has {total} combinations", runs)
            runs = total
        if isinstance(runs, bool) or not isinstance(runs, int) or not 1 <= runs <= MAX_RUNS:
            raise InputError("runs", f"a whole number from 1 to {MAX_RUNS}", runs)
        if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
            raise InputError("seed", "a whole number from 0 to 2^63 - 1", seed)
        bounds = {key: find_bounds(scene, key) for key in axes}
        for key, axis in axes.items() if checks else ():
            for value in axis.list_checked(bounds[key], f"over.{key}"):
                try:
                    varied = vary(scene, {key: value})
                    build_model(varied.load_parameters(), varied.model)
                except InputError as error:
                    own = error.field.removeprefix("set.") == key
                    must = error.must if own else f"a value that the scene accepts ({error})"
                    raise InputError(f"over.{key}", must, value) from None
        return cls(axes, bounds, sampling, runs, seed)  # type: ignore[arg-type]

    def __len__(self) -> int:
        return self.runs

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the axes."""
        return tuple(self.axes)

    @property
    def shape(self) -> tuple[int, ...] | None:
        """Number of values of each axis of a grid; None for other designs."""
        points = (axis.points for axis in self.axes.values())
        return tuple(0 if each is None else len(each) for each in points) if self.sampling == "grid" else None

    def columns(self, first: int, last: int) -> list[np.ndarray]:
        """Return the values of the runs from `first` to before `last`, an array for each key."""
        if self.shape is not None:
            places: Iterable[np.ndarray] = np.unravel_index(np.arange(first, last), self.shape)
        else:
            places = self._parts(first, last).T
        return [self._place(key, place) for key, place in zip(self.axes, places, strict=True)]

    def values(self, first: int, last: int) -> np.ndarray:
        """Return the same, shape (last - first, keys): numbers, or objects if any value is a text."""
        return self.stack(self.columns(first, last))

    def stack(self, columns: list[np.ndarray]) -> np.ndarray:
        """Return columns as one table: numbers, or objects if any value is a text."""
        table = np.empty((len(columns[0]), len(columns)), np.result_type(*columns))
        for number, column in enumerate(columns):
            table[:, number] = column
        return table

    def seeds(self, first: int, last: int) -> np.ndarray:
        """Return the seed of each run, int64: it selects the noise of the sensors, if the run is simulated again."""
        return (self._random(_SEEDS, first, last, 1)[:, 0] >> np.uint64(1)).astype(np.int64)

    def _place(self, key: str, place: np.ndarray) -> np.ndarray:
        axis = self.axes[key]
        if axis.points is None:
            return axis.quantiles(place, self.bounds[key], key)
        return axis.points[place if self.shape is not None else (place * len(axis.points)).astype(np.int64)]

    def _random(self, stream: int, first: int, last: int, count: int) -> np.ndarray:
        """Return random words of each run, uint64, shape (last - first, count)."""
        blocks = -(-count // 4)  # the generator computes four words at once
        generator = np.random.Philox(key=np.array([self.seed, stream], np.uint64), counter=first * blocks)
        return generator.random_raw((last - first) * 4 * blocks).reshape(last - first, 4 * blocks)[:, :count]

    def _parts(self, first: int, last: int) -> np.ndarray:
        """Return numbers between 0 and 1, both excluded, shape (last - first, keys)."""
        count = len(self.axes)
        if self.sampling in ("sobol", "halton"):
            return self._sequence(first, last)
        words = self._random(_NUMBERS_OF_RUNS, first, last, count)
        parts = ((words >> np.uint64(11)).astype(float) + 0.5) * 2.0**-53
        if self.sampling == "latin":
            keys = self._random(_PERMUTATIONS, 0, count, 8)
            runs = np.arange(first, last, dtype=np.uint64)
            rows = np.column_stack([permute(runs, self.runs, key) for key in keys])
            parts = (rows + parts) / self.runs
        return np.minimum(parts, 1.0 - 2.0**-53)

    def _sequence(self, first: int, last: int) -> np.ndarray:
        from scipy.stats import qmc

        sequence = qmc.Sobol if self.sampling == "sobol" else qmc.Halton
        engine: Any = sequence(len(self.axes), scramble=True, seed=np.random.default_rng(self.seed))
        drawn = last - first
        if self.sampling == "halton":
            engine.num_generated = first  # `fast_forward` would compute all earlier points
        elif first:
            engine.fast_forward(first)
        else:
            drawn = 1 << (drawn - 1).bit_length()  # it warns of other numbers
        # Points of a Sobol sequence are multiples of 2^-30, 0 included.
        return np.clip(engine.random(drawn)[: last - first] + 2.0**-31, 2.0**-53, 1.0 - 2.0**-53)


def permute(indices: np.ndarray, size: int, keys: np.ndarray) -> np.ndarray:
    """Return the places of indices in a pseudo-random permutation of `size` numbers, without computing the others.

    A Feistel network permutes the next power of 4; results that are too large are permuted again.

    Args:
        indices: Numbers below `size`, uint64.
        size: Number of permuted numbers.
        keys: Random words, one for each round.
    """
    half = max(1, -(-(size - 1).bit_length() // 2))
    shift, mask = np.uint64(half), np.uint64(2**half - 1)
    places, waiting = indices.copy(), np.ones(len(indices), bool)
    while waiting.any():
        left, right = places[waiting] >> shift, places[waiting] & mask
        for key in keys:
            mixed = (right ^ key) * np.uint64(0x9E3779B97F4A7C15)
            mixed = (mixed ^ (mixed >> np.uint64(32))) * np.uint64(0xD6E8FEB86659FD93)
            left, right = right, left ^ ((mixed >> np.uint64(32)) & mask)
        places[waiting] = (left << shift) | right
        waiting = places >= size
    return places
