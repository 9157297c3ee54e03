"""Named columns of numbers with units, as returned by runs, recordings and the DAQ client."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import groupby
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from rig.base import units
from rig.base.errors import InputError, UnknownNameError, require_package
from rig.base.text import build_html_table

if TYPE_CHECKING:
    import pandas
    import pyarrow
    import xarray

_SAME_INSTANT_S = 1e-6
"""Instants closer than this are equal [s]."""


def find_column(name: str, names: Sequence[str], *, must: str = "one of the existing names") -> int:
    """Return the position of a name.

    Raises:
        UnknownNameError: The name does not occur.
    """
    if name not in names:
        raise UnknownNameError("name", must, name, names)
    return names.index(name)


class Plottable:
    """Data with the pictures of `replays.plots` as methods: `run.plot.orbit(last_s=0.3)`."""

    __slots__ = ()

    @property
    def plot(self) -> Any:
        """Pictures of these data, each a method that returns matplotlib axes and a table; `dir(run.plot)` lists them.

        They are `replays.plots.methods.Plots`, which must not be imported from here.
        """
        from importlib import import_module

        return import_module("replays.plots.methods").Plots(self)


class Columns(Plottable):
    """Rows of named columns: `rows["disk_x"]`, `rows.unit("disk_x")`, and `rows.to_si()` for all columns in SI.

    Attributes:
        names: Column names.
        units: Column units.
        values: Shape (rows, columns).
    """

    __slots__ = ()
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray

    def __len__(self) -> int:
        return len(self.values)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def keys(self) -> tuple[str, ...]:
        """Return the column names, as a dictionary does: `dict(rows)` has an array per column."""
        return self.names

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the values of a column [its unit], shape (rows,).

        Raises:
            UnknownNameError: The column does not exist; also a KeyError.
        """
        return self.values[:, find_column(name, self.names)]

    def unit(self, name: str) -> str:
        """Return the unit of a column.

        Raises:
            UnknownNameError: The column does not exist.
        """
        return self.units[find_column(name, self.names)]

    def select(self, *names: str) -> Self:
        """Return some of the columns, in this order.

        Raises:
            UnknownNameError: The column does not exist.
        """
        positions = [find_column(name, self.names) for name in names]
        chosen = tuple(self.units[each] for each in positions)
        return cast(Self, replace(cast(Any, self), names=names, units=chosen, values=self.values[:, positions]))

    def to_si(self) -> Self:
        """Return the rows in SI: mm to m, Hz of a speed to rad/s. Unknown units are unchanged."""
        names, sizes, zeros = zip(*map(units.get_si_unit, self.units), strict=True) if self.units else ((), (), ())
        return cast(Self, replace(cast(Any, self), units=names, values=self.values * np.array(sizes) + np.array(zeros)))

    def _find_times_s(self) -> np.ndarray | None:
        """Return the time of each row [s]; None for rows without times, as of a spectrum."""
        return getattr(self, "times_s", None)

    def to_pandas(self) -> pandas.DataFrame:
        """Return the rows as a DataFrame with a column per name over the simulated time; `attrs` has the units.

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        pandas = require_package("pandas", "notebook")
        times_s = self._find_times_s()
        index = None if times_s is None else pandas.Index(times_s, name="time_s")
        frame = pandas.DataFrame(self.values, index=index, columns=list(self.names))
        frame.attrs["units"] = dict(zip(self.names, self.units, strict=True))
        return frame

    def to_xarray(self) -> xarray.Dataset:
        """Return the rows as a Dataset with a variable per name over `time_s`, each with its unit in `attrs`.

        Raises:
            ModuleNotFoundError: xarray is not installed.
        """
        xarray = require_package("xarray", "notebook")
        times_s = self._find_times_s()
        dimension = "row" if times_s is None else "time_s"
        columns = {
            name: (dimension, column, {"units": unit})
            for name, column, unit in zip(self.names, self.values.T, self.units, strict=True)
        }
        coordinates = {} if times_s is None else {"time_s": ("time_s", times_s, {"units": "s"})}
        return xarray.Dataset(columns, coordinates)

    def to_arrow(self) -> pyarrow.Table:
        """Return the rows as an Arrow table with a column per name, and the unit of each in its field's metadata.

        Raises:
            ModuleNotFoundError: pyarrow is not installed.
        """
        pyarrow = require_package("pyarrow", "notebook")
        times_s = self._find_times_s()
        columns = [*zip(self.names, self.units, self.values.T, strict=True)]
        if times_s is not None:
            columns.insert(0, ("time_s", "s", times_s))
        schema = pyarrow.schema(
            [
                pyarrow.field(name, pyarrow.from_numpy_dtype(column.dtype), metadata={"unit": unit})
                for name, unit, column in columns
            ]
        )
        return pyarrow.Table.from_arrays([pyarrow.array(column) for _, _, column in columns], schema=schema)

    def describe(self) -> list[tuple[str, ...]]:
        """Return name, unit, minimum, mean and maximum of each column, as text."""
        known = [column[np.isfinite(column)] for column in self.values.T]
        statistics = [(column.min(), column.mean(), column.max()) if len(column) else () for column in known]
        texts = [tuple(f"{number:.4g}" for number in each) or ("", "", "") for each in statistics]
        return [(name, unit, *each) for name, unit, each in zip(self.names, self.units, texts, strict=True)]

    def _repr_html_(self) -> str:
        return build_html_table(repr(self), ("column", "unit", "minimum", "mean", "maximum"), self.describe())

    def __repr__(self) -> str:
        pairs = zip(self.units, self.names, strict=True)
        labels = [(", ".join(name for _, name in group), unit) for unit, group in groupby(pairs, lambda pair: pair[0])]
        table = cast(Any, self)
        span = f", {table.times_s[0]:.6g} to {table.times_s[-1]:.6g} s" if len(self) else ""
        columns = ", ".join(f"{names} [{unit}]" for names, unit in labels)
        return f"{type(self).__name__}({columns}; {len(self)} rows at {table.rate_hz:g} Hz{span})"


@dataclass(frozen=True, repr=False, eq=False)
class Samples(Columns):
    """Samples of sensors or truth, each column in its own unit.

    Attributes:
        name: Name of the sensor group or truth table; empty for several.
        times_s: Simulated time of each row [s], shape (n,).
        index: Number of each row since the start of the stream, int64, shape (n,); a step other than 1 is a gap.
        values: Engineering values, shape (n, columns).
        names: Column names.
        units: Column units.
        rate_hz: Rows per simulated second [Hz].

    Example:
        >>> import rig
        >>> samples = rig.simulate("hammer", duration_s=0.05).samples
        >>> samples["disk_x"].shape, samples.unit("disk_x"), samples.to_si().unit("disk_x")
        ((1000,), 'mm', 'm')
        >>> samples["disk_z"]
        Traceback (most recent call last):
        rig.base.errors.UnknownNameError: name must be one of the existing names, such as disk_y, ...
    """

    name: str
    times_s: np.ndarray
    index: np.ndarray
    values: np.ndarray  # pyrefly: ignore[bad-override]
    names: tuple[str, ...]  # pyrefly: ignore[bad-override]
    units: tuple[str, ...]  # pyrefly: ignore[bad-override]
    rate_hz: float


def merge_samples(parts: Sequence[Samples]) -> Samples:
    """Return the columns of several tables as one table, with the rows common to all.

    Raises:
        InputError: `parts` is empty, or the instants differ.
    """
    if len(parts) == 1:
        return parts[0]
    index = parts[0].index if parts else np.empty(0)
    rows: list[Any] = [slice(None)] * len(parts)
    if not (np.diff(index) > 0).all() or any(not np.array_equal(part.index, index) for part in parts):
        index = reduce(np.intersect1d, [part.index for part in parts])
        rows = [np.intersect1d(part.index, index, return_indices=True)[1] for part in parts]
    times = [part.times_s[chosen] for part, chosen in zip(parts, rows, strict=True)]
    same_rate = len({part.rate_hz for part in parts}) == 1  # with different rates, a part may have no row in common
    if not same_rate or any(np.abs(each - times[0]).max(initial=0.0) > _SAME_INSTANT_S for each in times):
        rates = ", ".join(f"{part.name} at {part.rate_hz:g} Hz" for part in parts)
        raise InputError("groups", "sampled at the same instants", rates or None)
    return Samples(
        name="",
        times_s=times[0],
        index=index,
        values=np.hstack([part.values[chosen] for part, chosen in zip(parts, rows, strict=True)]),
        names=tuple(name for part in parts for name in part.names),
        units=tuple(unit for part in parts for unit in part.units),
        rate_hz=parts[0].rate_hz,
    )
