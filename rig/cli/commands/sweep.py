"""`rig sweep`: the runs of a plan, simulated on this machine or on a Dask cluster, and the state of a sweep."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.errors import InputError, Words
from rig.cli.options import Json
from rig.cli.output.folder import check_folder
from rig.cli.output.progress import reporting
from rig.cli.output.tables import echo, echo_json, fact_table, table_console

if TYPE_CHECKING:
    from rig.ensemble.sweep import Sweep

_MAX_RUNS, _MAX_S = 10_000_000, 86_400.0
"""Runs, and expected time [s], from which a sweep must be confirmed."""


def sweep(
    plan: Annotated[Path, typer.Argument(metavar="PLAN", help="Plan (.toml); or `info`, then FOLDER")],
    folder: Annotated[Path | None, typer.Argument(metavar="[FOLDER]", help="Folder of a sweep, after `info`")] = None,
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="Folder for the parts (.parquet)")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a sweep that was ended or killed")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Number of threads; default: the cores")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="Simulate on an existing Dask cluster")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Begin a sweep that takes days, or much of the disk")] = False,
    as_json: Json = False,
) -> None:
    """Simulate a scene many times with varied values; each finished task is a Parquet file in FOLDER.

    `rig sweep info FOLDER` shows the state of a sweep. The result does not depend on the number of workers. With
    --json, a line is printed for each finished task.
    """
    from rig.ensemble.plan import read_plan
    from rig.ensemble.sweep import Sweep, summarise

    if str(plan) == "info":
        if folder is None:
            raise InputError("FOLDER", "given: the folder of a sweep", None)
        _show(summarise(folder), as_json=as_json)
        return
    if folder is not None:
        raise InputError("FOLDER", "left out, except after `info`", str(folder))
    if output is None:
        raise InputError("--output", "given: a folder for the parts", None)
    if scheduler is not None and workers is not None:
        raise InputError("--workers", "left out with --scheduler", workers)
    check_folder(output, field="--output")
    with Sweep(read_plan(plan), output, resume=resume) as found:
        _run(found, workers, scheduler, yes=yes, as_json=as_json)
    if not as_json:
        _show(summarise(output), as_json=False)


def _run(found: Sweep, workers: int | None, scheduler: str | None, *, yes: bool, as_json: bool) -> None:
    import shutil

    from rig.ensemble.ensemble import count_cores, local_workers
    from rig.ensemble.sweep import estimate, simulate_task

    work, tasks = found.work, len(found.missing)
    if not (runs := min(tasks * work.document["task_runs"], work.design.runs)):
        return
    cores = workers or count_cores()
    with reporting(compiles=True) as reporter:
        reporter.show("timing some runs")
        expected_s, size = estimate(work, runs, cores)
    where = f"on {cores} {'core' if cores == 1 else 'cores'} of this machine"
    text = f"{runs} runs in {tasks} tasks: about {_format_time(expected_s)} {where}, {size / 1e6:.3g} MB"
    if not yes and (runs > _MAX_RUNS or expected_s > _MAX_S or size > shutil.disk_usage(found.folder).free):
        raise InputError("--yes", "given for so long a sweep", Words(text))
    echo(text, err=True)
    if scheduler is None:
        context, function = local_workers(workers), simulate_task
    else:
        from rig.ensemble.cluster import cluster_workers, simulate_remotely

        context, function = cluster_workers(scheduler), simulate_remotely
    with context as pool, reporting() as reporter:
        reporter.begin(work.tasks)
        reporter.done = work.tasks - tasks
        for report in found.run(pool, function):
            reporter.step(f"tasks, about {_format_time(report['left_s'])} left")
            if as_json:
                echo_json(report, indent=None)


def _format_time(seconds: float) -> str:
    for unit, size in (("days", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds > 2.0 * size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds:.0f} s"


def _show(state: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        echo_json(state)
        return
    rows = [
        ("scene", state["scene"]),
        ("varied", ", ".join(state["over"])),
        ("tasks", f"{state['tasks_done']} of {state['tasks']}"),
        ("runs", f"{state['runs_done']} of {state['runs']}"),
        ("outcomes", ", ".join(f"{name} {count}" for name, count in state["outcomes"].items()) or "none"),
        ("untrusted", str(state["untrusted"])),
        ("failed", str(state["failed"])),
        ("time", f"{_format_time(state['worker_s'])} of all workers"),
    ]
    table_console().print(fact_table(state["title"], rows))
