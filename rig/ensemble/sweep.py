"""Sweeps: the tasks of a plan, simulated by workers, and one Parquet file for each finished task.

This process writes the files, so that the folder need not be shared with workers on other machines, and that a worker
that dies leaves nothing in it: a task's file of some hundred kB arrives as bytes. A file is complete or absent. A
killed sweep loses only the tasks that were being simulated.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event
from typing import Any

from rig.base.checks import describe_error, read_json
from rig.base.errors import InputError, Words
from rig.base.files import PART_SUFFIX, Closing, lock_folder, open_output, read_file, write_file
from rig.ensemble.ensemble import Ensemble, Workers, iterate_results, simulate_runs
from rig.ensemble.plan import Work, find_difference, load_work

_PLAN, _LOG = "plan.json", "tasks.jsonl"
_MAX_BYTES = 1 << 28
_PROBED = 16
"""Runs that are timed for the estimate."""


def simulate_task(text: str, task: int, stop: Event | None = None) -> tuple[bytes, dict[str, Any]]:
    """Return the Parquet file of a task, and its runs, seconds, outcomes and untrusted runs.

    Args:
        text: Document of the plan.
        task: Number of the task.
        stop: Set to give up.

    Raises:
        CancelledError: `stop` was set.
    """
    import pyarrow
    from pyarrow import parquet

    begin, work = time.perf_counter(), load_work(text)
    document, (first, last) = work.document, work.find_range(task)
    quantities, early_end = document["quantities"], document["early_end"]
    table = simulate_runs(work.scene, work.design, quantities, first, last, stop, early_end=early_end)
    out = pyarrow.BufferOutputStream()
    parquet.write_table(table, out, compression="zstd")
    summary = {
        "runs": last - first,
        "seconds": round(time.perf_counter() - begin, 3),
        "outcomes": Ensemble(table, {}).count_outcomes(),
        "untrusted": (last - first) - sum(table["trusted"].to_pylist()),
    }
    return out.getvalue().to_pybytes(), summary


def estimate(work: Work, runs: int, cores: int) -> tuple[float, float]:
    """Return the expected time [s] and disk space [bytes] of a plan, from some of its runs.

    Args:
        work: The plan.
        runs: Number of runs that are left.
        cores: Number of cores.
    """
    probed = min(_PROBED, work.design.runs)
    quantities, early_end = work.document["quantities"], work.document["early_end"]
    simulate_runs(work.scene, work.design, quantities, 0, 1, early_end=early_end)  # compiles
    begin = time.perf_counter()
    table = simulate_runs(work.scene, work.design, quantities, 0, probed, early_end=early_end)
    share = runs / probed
    return share * (time.perf_counter() - begin) / cores, share * table.nbytes


class Sweep(Closing):
    """A folder with the parts of a plan.

    Attributes:
        work: The plan.
        folder: The folder.
        missing: Numbers of the tasks without a part.
    """

    def __init__(self, work: Work, folder: Path, *, resume: bool = False) -> None:
        """Create the folder, or continue one.

        Args:
            work: The plan.
            folder: The folder; locked until `close`.
            resume: Continue with the tasks without a part.

        Raises:
            InputError: The folder has another plan, or parts by other versions, or is in use, or is not continued.
            DiskError: It cannot be written.
        """
        self._lock = lock_folder(folder, "sweep")
        self.work, self.folder = work, folder
        try:
            self._check(resume=resume)
        except InputError:
            self.close()
            raise
        for draft in folder.glob(f"*.*{PART_SUFFIX}"):  # of a killed sweep
            draft.unlink()
        finished = {path.name for path in list_parts(folder)}
        # A part that was damaged or replaced is simulated again.
        self.missing = [
            task for task in range(work.tasks)
            if (path := self.find_part(task)).name not in finished or not is_intact(path, work.find_range(task))
        ]  # fmt: skip

    def close(self) -> None:
        """Release the lock."""
        os.close(self._lock)

    def _check(self, *, resume: bool) -> None:
        folder, plan = self.folder, self.folder / _PLAN
        if not plan.exists():
            if any(folder.iterdir()):
                raise InputError("--output", "a new or empty folder, or one of a sweep", str(folder))
        elif not resume:
            raise InputError("--output", "a new folder (--resume continues a sweep)", str(folder))
        elif difference := find_difference(read_plan_text(folder), self.work.text):
            raise InputError("--resume", f"with the plan and the versions of {plan}", Words(difference))

    def find_part(self, task: int) -> Path:
        """Return the path of a task's part."""
        return self.folder / f"part-{task:0{max(5, len(str(self.work.tasks - 1)))}}.parquet"

    def run(self, workers: Workers, function: Any = simulate_task) -> Iterator[dict[str, Any]]:
        """Simulate the missing tasks, and yield a document about each finished one.

        Args:
            workers: Where to simulate (`local_workers`, `cluster_workers`).
            function: Called by the workers: `simulate_task`, or a function like it.

        Raises:
            DiskError: The disk refused; the finished parts are kept.
        """
        if not (plan := self.folder / _PLAN).exists():
            write_file(plan, self.work.text, sync=True)
        begin, total = time.monotonic(), self.work.tasks
        left = len(self.missing)
        for task, (data, summary) in iterate_results(workers, self.missing, function, self.work.text):
            write_file(self.find_part(task), data, sync=True)
            left -= 1
            elapsed = time.monotonic() - begin
            left_s = elapsed * left / (len(self.missing) - left)
            report = {"task": task, **summary, "done": total - left, "total": total, "left_s": round(left_s, 1)}
            with open_output(self.folder / _LOG, "a") as log:
                log.write(json.dumps(report) + "\n")
            yield report


def read_plan_text(folder: Path) -> str:
    """Return the document of a sweep's plan.

    Raises:
        InputError: The folder has none.
    """
    try:
        text = read_file(folder / _PLAN, _MAX_BYTES).decode()
        read_json(text.encode(), field=_PLAN)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("FOLDER", "a folder of `rig sweep`", Words(f"{folder} ({error})")) from None
    return text


def list_parts(folder: Path) -> list[Path]:
    """Return the finished parts of a sweep in the order of their runs."""
    return sorted(folder.glob("part-*.parquet"))


def is_intact(path: Path, runs: tuple[int, int]) -> bool:
    """Return whether a part is a Parquet file of some runs, given as the first number and that after the last."""
    from pyarrow import parquet

    try:
        found = parquet.read_metadata(path)
        numbers = found.row_group(0).column(0).statistics
        return (numbers.min, numbers.max, found.num_rows) == (runs[0], runs[1] - 1, runs[1] - runs[0])
    except (OSError, ValueError, RuntimeError, AttributeError):
        return False


@contextmanager
def _reading(folder: Path) -> Iterator[None]:
    """Report what is wrong in the files of a sweep as an error of its folder."""
    try:
        yield
    except InputError:
        raise
    except (LookupError, TypeError, ValueError, ArithmeticError, IsADirectoryError) as error:
        received = Words(f"{folder} ({describe_error(error)})")
        raise InputError(
            "FOLDER", "a folder of `rig sweep` with intact files (--resume mends parts)", received
        ) from None


def open_sweep(folder: str | Path, columns: Sequence[str] | None = None) -> Ensemble:
    """Return the finished runs of a sweep.

    Args:
        folder: Folder of `rig sweep`.
        columns: Names of columns to load; default: all.

    Raises:
        InputError: The folder is not of a sweep, or has no part yet.

    Example:
        >>> import rig
        >>> rig.open_sweep("docs")
        Traceback (most recent call last):
        rig.base.errors.InputError: FOLDER must be a folder of `rig sweep`; received docs (...)
    """
    from pyarrow import dataset

    path = Path(folder)
    with _reading(path):
        work = load_work(read_plan_text(path))
        if not (parts := _check_parts(path, work.document)):
            raise InputError("folder", "one with a finished part", str(folder))
        table = dataset.dataset(parts).to_table(columns=None if columns is None else list(columns))
    return Ensemble(table, work.design.axes, work.design.shape)


def _check_parts(folder: Path, document: dict[str, Any]) -> list[Path]:
    """Return the finished parts; raise a ValueError for one that is damaged."""
    parts, size, runs = list_parts(folder), document["task_runs"], document["runs"]
    for path in parts:
        first = int(path.stem.rpartition("-")[2]) * size
        if not is_intact(path, (first, min(first + size, runs))):
            raise ValueError(f"{path.name} is damaged")
    return parts


def summarise(folder: Path) -> dict[str, Any]:
    """Return the progress of a sweep: tasks, runs, outcomes, untrusted and failed runs, seconds of the workers.

    Raises:
        InputError: The folder is not of a sweep.
    """
    with _reading(folder):
        return _summarise(folder, read_json(read_plan_text(folder).encode(), field=_PLAN))


def _summarise(folder: Path, document: dict[str, Any]) -> dict[str, Any]:
    from pyarrow import dataset

    parts, outcomes, untrusted = _check_parts(folder, document), Counter[str](), 0
    for batch in dataset.dataset(parts).to_batches(columns=["outcome", "trusted"]) if parts else ():
        counts = batch["outcome"].value_counts().to_pylist()
        outcomes.update({each["values"]: each["counts"] for each in counts})
        untrusted += batch.num_rows - batch["trusted"].true_count
    seconds = {}
    if (folder / _LOG).exists():
        for line in read_file(folder / _LOG, _MAX_BYTES).decode().splitlines():
            with suppress(InputError, KeyError, TypeError):  # a line of a killed sweep
                report = read_json(line.encode())
                seconds[report["task"]] = report["seconds"]
    return {
        "title": document["title"], "scene": document["scene"]["name"], "over": [*document["over"]],
        "tasks_done": len(parts), "tasks": -(-document["runs"] // document["task_runs"]),
        "runs_done": outcomes.total(), "runs": document["runs"], "outcomes": dict(outcomes.most_common()),
        "untrusted": untrusted, "failed": outcomes["failed"], "worker_s": round(math.fsum(seconds.values()), 1),
        "versions": document["versions"],
    }  # fmt: skip
