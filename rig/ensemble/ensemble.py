"""Ensembles: runs of a scene with varied values, simulated on this machine, as a table with units."""

from __future__ import annotations

import os
from _thread import start_new_thread  # noqa: PLC2701 public, and named so
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.base.errors import InputError, UnknownNameError, Words, require_package
from rig.base.files import whole_file
from rig.base.samples import find_column
from rig.base.text import build_html_table
from rig.ensemble.axes import Axis, Design
from rig.ensemble.batch import QUANTITIES, Batch
from rig.run.scenes import Scene, load_scene

if TYPE_CHECKING:
    import pandas
    import pyarrow
    import xarray

ALWAYS = ("outcome", "trusted", "engine")
"""Quantities that every table has."""
_TASK_RUNS = 500
_STEP_RUNS = 500
"""Runs between two looks at an interrupt."""


@dataclass(frozen=True, repr=False, eq=False)
class Ensemble:
    """Runs of an ensemble: `table["peak_force_n"]`, `table.unit("peak_force_n")`.

    Attributes:
        table: Arrow table of one row for each run: its number, the varied keys, its seed, and the quantities; the
            metadata of a field has its unit.
        axes: Axes by varied key.
        shape: Number of values of each axis of a grid; None for other designs.

    Example:
        >>> import rig
        >>> runs = rig.ensemble("hammer", {"contact.friction": [0.1, 0.2, 0.3]}, changes={"duration_s": 0.03})
        >>> runs.unit("peak_force_n"), runs["peak_force_n"].shape, runs.axes
        ('N', (3,), {'contact.friction': Axis(0.1, 0.2, 0.3)})
    """

    table: pyarrow.Table
    axes: Mapping[str, Axis]
    shape: tuple[int, ...] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(self.table.column_names)

    def __len__(self) -> int:
        return self.table.num_rows

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def keys(self) -> tuple[str, ...]:
        """Return the column names, as a dictionary does."""
        return self.names

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the values of a column [its unit], shape (runs,).

        Raises:
            UnknownNameError: The column does not exist; also a KeyError.
        """
        return self.table.column(find_column(name, self.names)).to_numpy()

    def unit(self, name: str) -> str:
        """Return the unit of a column; empty for texts, counts and ratios.

        Raises:
            UnknownNameError: The column does not exist.
        """
        return self.table.field(find_column(name, self.names)).metadata[b"unit"].decode()

    def to_arrow(self) -> pyarrow.Table:
        """Return the Arrow table, with the unit of each column in its field's metadata."""
        return self.table

    def to_pandas(self) -> pandas.DataFrame:
        """Return a DataFrame over the number of the run; `attrs` has the units.

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        require_package("pandas", "notebook")
        frame = self.table.to_pandas().set_index("run")
        frame.attrs["units"] = {name: self.unit(name) for name in self.names}
        return frame

    def to_xarray(self) -> xarray.Dataset:
        """Return a Dataset: over the axes for a complete grid, otherwise over `run`; each variable has its unit.

        Raises:
            ModuleNotFoundError: xarray is not installed.
        """
        xarray = require_package("xarray", "notebook")
        columns = {name: self[name] for name in self.names}
        dims, shape, coordinates = ("run",), (len(self),), {"run": columns.pop("run")}
        if self.shape is not None and len(self) == np.prod(self.shape):
            dims, shape = tuple(self.axes), self.shape
            coordinates = {key: axis.points for key, axis in self.axes.items()}
            columns = {name: column for name, column in columns.items() if name not in dims}
        units = {name: {"units": self.unit(name)} for name in (*columns, *coordinates)}
        return xarray.Dataset(
            {name: (dims, column.reshape(shape), units[name]) for name, column in columns.items()},
            {name: (name, values, units[name]) for name, values in coordinates.items()},
        )

    def to_parquet(self, path: str | Path) -> None:
        """Write a Parquet file, with the unit of each column in its field's metadata.

        Raises:
            DiskError: The disk refused.
        """
        from pyarrow import parquet

        with whole_file(Path(path)) as draft:
            parquet.write_table(self.table, draft)

    def plot_band(self, x: str, y: str, *, share: float = 0.95, groups: int = 20) -> Any:
        """Plot the median of a column over another, with the band that has a share of the runs.

        Args:
            x: Column on the horizontal axis, of numbers.
            y: Column on the vertical axis, of numbers; its NaN are left out.
            share: Share of the runs within the band.
            groups: Number of groups of equal size along x.

        Returns:
            The axes of a new matplotlib figure.

        Raises:
            UnknownNameError: A column does not exist.
            InputError: A column has texts, or fewer numbers than groups.
        """
        at, values = self[x], self[y]
        for name, column in ((x, at), (y, values)):
            if column.dtype == object or np.count_nonzero(np.isfinite(column)) < groups:
                raise InputError(name, f"a column with at least {groups} numbers", Words(column.dtype))
        from matplotlib import pyplot

        order = np.argsort(at, kind="stable")
        parts = np.array_split(order[np.isfinite(values[order])], groups)
        ends = 0.5 - 0.5 * share, 0.5, 0.5 + 0.5 * share
        low, middle, high = np.array([np.quantile(values[part], ends) for part in parts]).T
        places = [float(at[part].mean()) for part in parts]
        axes = pyplot.subplots(layout="constrained")[1]
        axes.fill_between(places, low, high, color="#0072B2", alpha=0.25, linewidth=0, label=f"{share:.0%} of the runs")
        axes.plot(places, middle, color="#0072B2", label="median")
        axes.set_xlabel(f"{x} [{self.unit(x) or 1}]")
        axes.set_ylabel(f"{QUANTITIES[y].label.partition(',')[0] if y in QUANTITIES else y} [{self.unit(y) or 1}]")
        axes.legend()
        return axes

    def count_outcomes(self) -> dict[str, int]:
        """Return the number of runs by outcome, the most frequent first."""
        return dict(Counter(self.table["outcome"].to_pylist()).most_common())

    def _describe(self) -> Iterator[tuple[str, ...]]:
        for name in self.names:
            column = self[name]
            if column.dtype == object:
                values, counts = np.unique(column.astype(str), return_counts=True)
                texts = (
                    ", ".join(f"{each} {count}" for each, count in zip(values[:5], counts[:5], strict=True)),
                    "",
                    "",
                )
            else:
                known = column[np.isfinite(column)]
                texts = tuple(f"{f(known):.4g}" for f in (np.min, np.mean, np.max)) if len(known) else ("", "", "")
            yield (name, self.unit(name), *texts)

    def _repr_html_(self) -> str:
        return build_html_table(repr(self), ("column", "unit", "minimum", "mean", "maximum"), self._describe())

    def __repr__(self) -> str:
        outcomes = ", ".join(f"{count} {name}" for name, count in self.count_outcomes().items())
        return f"Ensemble({len(self)} runs over {', '.join(self.axes)}; {outcomes})"


def check_quantities(names: Iterable[str] | None) -> tuple[str, ...]:
    """Return the names of the quantities to keep; None selects all. Outcome, trust and engine are always kept.

    Raises:
        InputError: A name is unknown.
    """
    if isinstance(names, str) or not (names is None or isinstance(names, Iterable)):
        raise InputError("quantities", "a list of names", names)
    chosen = [*QUANTITIES] if names is None else list(names)
    for name in chosen:
        if not isinstance(name, str) or name not in QUANTITIES:
            raise UnknownNameError("quantities", "names of quantities", name, QUANTITIES)
    return tuple(dict.fromkeys((*ALWAYS, *chosen)))


def simulate_runs(
    scene: Scene, design: Design, quantities: Sequence[str], first: int, last: int, stop: Event | None = None,
    *, early_end: bool = True,
) -> pyarrow.Table:  # fmt: skip
    """Return the table of the runs from `first` to before `last` (`Ensemble.table`).

    Args:
        scene: The scene.
        design: Values of the runs.
        quantities: Names of the quantities.
        first: Number of the first run.
        last: Number after the last run.
        stop: Set to give up.
        early_end: End a run as soon as its outcome is known.

    Raises:
        CancelledError: `stop` was set.
    """
    import pyarrow

    batch = Batch(scene, design.keys, early_end=early_end)
    inputs, parts = design.columns(first, last), []
    values = design.stack(inputs)
    for begin in range(0, last - first, _STEP_RUNS):
        if stop is not None and stop.is_set():
            raise CancelledError
        parts.append(batch.run(values[begin : begin + _STEP_RUNS]))
    columns: dict[str, tuple[str, Any]] = {"run": ("", np.arange(first, last))}
    for key, column in zip(design.keys, inputs, strict=True):
        is_text = any(isinstance(each, str) for each in design.axes[key].values or ())
        columns[key] = (design.bounds[key].unit, [str(each) for each in column] if is_text else column)
    columns.setdefault("seed", ("", design.seeds(first, last)))
    for name in quantities:
        column = np.concatenate([part[name] for part in parts])
        columns[name] = (QUANTITIES[name].unit, column.astype(object) if column.dtype.kind == "U" else column)
    arrays = {name: pyarrow.array(column) for name, (_, column) in columns.items()}
    fields = [pyarrow.field(name, array.type, metadata={"unit": columns[name][0]}) for name, array in arrays.items()]
    return pyarrow.Table.from_arrays([*arrays.values()], schema=pyarrow.schema(fields))


def count_cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


Workers = tuple[Callable[..., "Future[Any]"], Callable[[], int]]
"""Function that submits a call, and the number of calls to keep waiting."""


@contextmanager
def local_workers(count: int | None = None) -> Iterator[Workers]:
    """Yield threads of this process, which end with it however it ends; the kernels run without Python's lock.

    A call receives an event that is set at the end of the block, as its last argument.

    Args:
        count: Number of threads; default: the cores.

    Raises:
        InputError: The number is not positive.
    """
    count = count_cores() if count is None else count
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise InputError("workers", "a whole number of at least 1", count)
    stop, pool = Event(), ThreadPoolExecutor(count)
    try:
        yield lambda function, *arguments: pool.submit(function, *arguments, stop), lambda: 2 * count
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)


def iterate_results(
    workers: Workers, numbers: Iterable[int], function: Callable[..., Any], *arguments: Any
) -> Iterator[tuple[int, Any]]:
    """Yield each number and `function(*arguments, number)` as they finish; only a few calls wait at a time.

    An interrupt may stop this generator anywhere. So it touches only queues without a lock in Python; a thread submits.
    """
    submit, find_limit = workers
    wanted, finished = SimpleQueue[int | None](), SimpleQueue[tuple[int, Future[Any]]]()

    def submit_each() -> None:
        while (number := wanted.get()) is not None:
            try:
                future = submit(function, *arguments, number)
            except BaseException as error:
                future = Future[Any]()
                future.set_exception(error)
            future.add_done_callback(lambda future, number=number: finished.put((number, future)))

    rest, waiting = iter(numbers), 0
    try:
        start_new_thread(submit_each, ())  # `Thread.start` waits for a lock in Python
        while True:
            while waiting < max(find_limit(), 1) and (number := next(rest, None)) is not None:
                wanted.put(number)
                waiting += 1
            if not waiting:
                return
            number, future = finished.get()
            waiting -= 1
            yield number, future.result()
    finally:
        wanted.put(None)


def ensemble(
    scene: Scene | str | Path,
    over: Mapping[str, Any],
    quantities: Iterable[str] | None = None,
    *,
    runs: int | None = None,
    sampling: str | None = None,
    seed: int = 1,
    changes: dict[str, Any] | None = None,
    workers: int | None = None,
    progress: Callable[[float], None] | None = None,
    early_end: bool = True,
) -> Ensemble:
    """Simulate a scene many times with varied values.

    Args:
        scene: Name of a built-in scene, path of a .toml file, or a loaded scene.
        over: Values by key of `rig.load_scene`, or of a command, such as "hammer.force_n": a list, a grid
            `{"from": 5.0, "to": 7.0, "count": 9}`, a distribution such as
            `{"distribution": "normal", "mean": 0.2, "std": 0.05}`, or a frozen distribution of scipy.stats.
        quantities: Names of the quantities to keep; default: all.
        runs: Number of runs; left out for a grid.
        sampling: "grid", "random", "latin", "sobol" or "halton"; default: a grid of lists and grids without `runs`.
        seed: Seed of the random numbers.
        changes: Changed values of the scene, as for `rig.load_scene`.
        workers: Number of threads; default: the cores. The result does not depend on it.
        progress: Called with the finished fraction, 0 to 1.
        early_end: End a run as soon as its outcome is known.

    Raises:
        InputError: A key, value or quantity is wrong.

    Example:
        >>> import rig
        >>> over = {"contact.friction": [0.1, 0.2], "hammer.force_n": {"from": 50, "to": 150, "count": 2}}
        >>> runs = rig.ensemble("hammer", over, changes={"duration_s": 0.03})
        >>> len(runs), runs["contact.friction"], runs.unit("hammer.force_n"), runs.shape
        (4, array([0.1, 0.1, 0.2, 0.2]), 'N', (2, 2))
    """
    import pyarrow

    loaded = load_scene(scene, changes)
    loaded.check_physics()
    names = check_quantities(quantities)
    design = Design.create(loaded, over, runs=runs, sampling=sampling, seed=seed)
    simulate = partial(_simulate_part, loaded, design, names, early_end)
    parts: dict[int, pyarrow.Table] = {}
    begins = range(0, design.runs, _TASK_RUNS)
    with local_workers(workers) as pool:
        for begin, part in iterate_results(pool, begins, simulate):
            parts[begin] = part
            if progress is not None:
                progress(len(parts) / len(begins))
    return Ensemble(pyarrow.concat_tables([parts[begin] for begin in begins]), design.axes, design.shape)


def _simulate_part(
    scene: Scene, design: Design, quantities: Sequence[str], early_end: bool, begin: int, stop: Event
) -> pyarrow.Table:
    last = min(begin + _TASK_RUNS, design.runs)
    return simulate_runs(scene, design, quantities, begin, last, stop, early_end=early_end)
