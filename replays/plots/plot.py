"""Plot: axes and the table of their numbers; and the options and panels that all kinds of plots share."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from replays.plots.signals import Pair, Signals, check_options, read_signals
from replays.report.canvas import house_style, new_figure, png, save
from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.files import whole_file, write_file
from rig.base.samples import Columns

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TABLE_SUFFIXES = (".csv", ".parquet")
_COMMON = {
    name: each.replace(kind=inspect.Parameter.KEYWORD_ONLY)
    for name, each in inspect.signature(read_signals).parameters.items()
    if name != "source"
}
"""Options of every kind, which choose and correct the signals."""


@dataclass(frozen=True, repr=False, eq=False)
class Table(Columns):
    """Numbers of a plot, in named columns with units.

    Attributes:
        names: Column names.
        units: Column units.
        values: Shape (rows, columns); nan where there is no value.
        note: Conventions of the numbers, as in the picture.
    """

    names: tuple[str, ...]  # pyrefly: ignore[bad-override]
    units: tuple[str, ...]  # pyrefly: ignore[bad-override]
    values: np.ndarray  # pyrefly: ignore[bad-override]
    note: str = ""

    @classmethod
    def from_columns(cls, note: str, **columns: tuple[str, Any]) -> Table:
        """Return a table of columns of equal length, each given as unit and values."""
        values = np.column_stack([np.asarray(each, dtype=float) for _, each in columns.values()])
        return cls(tuple(columns), tuple(unit for unit, _ in columns.values()), values, note)

    def __repr__(self) -> str:
        columns = ", ".join(f"{name} [{unit}]" for name, unit in zip(self.names, self.units, strict=True))
        return f"Table({columns}; {len(self)} rows)"

    def write(self, path: Path | str) -> Path:
        """Write the table as .csv or .parquet, with headings such as `disk_x [mm]`.

        Raises:
            InputError: The file is neither.
            DiskError: The file cannot be written.
        """
        path = Path(path)
        if path.suffix not in TABLE_SUFFIXES:
            raise InputError("table", "a .csv or .parquet file", str(path))
        headings = [f"{name} [{unit}]" for name, unit in zip(self.names, self.units, strict=True)]
        if path.suffix == ".csv":
            quoted = [f'"{each}"' if "," in each else each for each in headings]
            lines = [
                ",".join("" if value != value else f"{value:.9g}" for value in row) for row in self.values.tolist()
            ]
            write_file(path, "\n".join([",".join(quoted), *lines, ""]))
            return path
        import pyarrow
        from pyarrow import parquet

        arrays = {
            name: pyarrow.array(column, from_pandas=True) for name, column in zip(headings, self.values.T, strict=True)
        }
        table = pyarrow.table(arrays).replace_schema_metadata({"note": self.note})
        with whole_file(path) as draft:
            parquet.write_table(table, draft)
        return path


class Plot(NamedTuple):
    """A drawn picture: `axes, table = run.plot.bode()`.

    Attributes:
        axes: Its panels, row by row.
        table: Its numbers.
    """

    axes: tuple[Axes, ...]
    table: Table

    def save(self, path: Path | str, *, table: str = ".csv", source: str = "") -> list[Path]:
        """Write the picture as .png or .svg, and its table to a file of the same name.

        Args:
            path: File of the picture.
            table: Suffix of the table, .csv or .parquet.
            source: Source of the data, for the metadata of the picture.

        Raises:
            InputError: A suffix is unknown.
            DiskError: A file cannot be written.
        """
        path = Path(path)
        return [*save(cast(Any, self.axes[0].figure), path, source=source), self.table.write(path.with_suffix(table))]

    def _repr_png_(self) -> bytes:
        return png(cast(Any, self.axes[0].figure))


def kind(*, last_s: float | None = None) -> Callable[[Callable[..., Plot]], Callable[..., Plot]]:
    """Return a decorator for a kind of plot, a function of signals with keyword options.

    The decorated function accepts a run, a recording or samples, and the options of `read_signals`. An unknown option
    is an error that names the nearest.

    Args:
        last_s: Length of the end of the data that is drawn by default [s]; None for all.
    """

    def decorate(function: Callable[..., Plot]) -> Callable[..., Plot]:
        own = inspect.signature(function)
        common = _COMMON | {"last_s": _COMMON["last_s"].replace(default=last_s)}
        known = [*list(own.parameters)[1:], *common]

        @wraps(function)
        def draw(source: Any, /, **options: Any) -> Plot:
            for name in options:
                if name not in known:
                    raise UnknownNameError(f"option of {function.__name__}", "one that it has", name, known)
            check_options(**options)
            chosen = {name: options.pop(name) for name in common if name in options}
            if "last_s" not in chosen and not {"from_s", "to_s"} & chosen.keys():
                chosen["last_s"] = last_s
            signals = read_signals(source, **chosen)
            with house_style():
                return function(signals, **options)

        first, *rest = own.parameters.values()
        draw.__signature__ = own.replace(parameters=[first, *rest, *common.values()])  # type: ignore[attr-defined]
        return draw

    return decorate


def make_axes(
    given: Any,
    rows: int,
    columns: int,
    *,
    height: float,
    title: str,
    note: str,
    **settings: Any,
) -> list[Any]:
    """Return the axes to draw on, row by row: those that the caller gave, or those of a new figure.

    Args:
        given: Axes, a sequence of them, or None.
        rows: Rows of panels.
        columns: Columns of panels.
        height: Height of a new figure [inch].
        title: Title above a new figure.
        note: Conventions, one line below a new figure.
        settings: Of `Figure.subplots`.

    Raises:
        InputError: The number of axes differs.
    """
    if given is not None:
        axes = list(np.ravel(np.asarray(given, dtype=object)))
        if len(axes) != rows * columns:
            raise InputError("axes", f"{rows * columns} axes", Words(f"{len(axes)}"))
        if not all(hasattr(each, "plot") for each in axes):
            raise InputError("axes", "matplotlib axes", Words(type(axes[0]).__name__))
        return axes
    figure = new_figure(height, title)
    figure.supxlabel(note, x=0.01, ha="left", fontsize=8, color="0.35")
    return list(figure.subplots(rows, columns, squeeze=False, **settings).flat)


def describe_frame(signals: Signals) -> str:
    """Return the conventions of directions, one line for a picture."""
    x, y = signals.probe_angles_deg
    return f"x right, y up; forward: counter-clockwise, with the spin; probes at {x:g}° and {y:g}° from the right"


def describe_phase() -> str:
    """Return the conventions of phases, one line for a picture."""
    return "phase: lag of the positive peak after the keyphasor notch passes (API 670)"


def describe_title(signals: Signals, text: str) -> str:
    """Return the title of a picture: what it shows, of which data."""
    return f"{text}: {signals.title}" if signals.title else text


def describe_span(pair: Pair) -> str:
    """Return the interval of the data in words."""
    return f"{pair.samples.times_s[0]:.3f} to {pair.samples.times_s[-1]:.3f} s"
