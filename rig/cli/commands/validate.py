"""`rig validate`: a recording, or all recordings of a folder, compared with the model."""

from __future__ import annotations

import hashlib
import json
import math
import os
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.errors import InputError, SimulationError, Words
from rig.base.outcome import Outcome
from rig.cli.options import (
    Changes,
    Engine,
    Force,
    RecordingFiles,
    ReportFile,
    RunOut,
    SceneChanges,
    split_names,
    subtract_run_out,
)
from rig.cli.output.progress import reporting
from rig.cli.output.provenance import recording_origin
from rig.cli.output.tables import Form, Table, echo, echo_json, make_printable, new_table

if TYPE_CHECKING:
    from rich.console import Console

    from replays.recordings.validation import Validation
    from replays.recordings.validation.explanations.attribution import Explained, Explanation

_VERDICTS = {True: "pass", False: "FAIL", None: ""}
_MIN_EXPLAINED = 0.01
"""Least fraction of a difference that a listed candidate explains."""


def validate(
    files: RecordingFiles,
    *,
    criteria: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Your own criteria; see replays/recordings/validation/default.toml"),
    ] = None,
    changes: Changes = None,
    engine: Engine = None,
    floating: Annotated[
        str | None, typer.Option("--float", metavar="KEY,...", help="Fit these numbers first, and judge the rest")
    ] = None,
    declared: Annotated[
        bool, typer.Option("--declared", help="Apply the declared criteria even if every bit is equal")
    ] = False,
    blind: Annotated[bool, typer.Option("--blind", help="Ignore the faults that the recording declares")] = False,
    runout: RunOut = None,
    report: ReportFile = None,
    budget: Annotated[
        Path | None,
        typer.Option("--budget", metavar="FILE", help="Uncertainty budget of a log: .html, .pdf or .md"),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="Folder for the results of a folder")
    ] = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", metavar="N", min=1, help="Files of a folder at a time")] = 2,
    force: Force = False,
    form: Form,
) -> None:
    """Simulate a recording again and compare it with the model: bit by bit, then by declared criteria.

    For a failed criterion, the candidate that explains the difference is named: a sensor, the time or a parameter. A
    folder gives a table of its recordings, the worst first, and validations.json; the same command continues an
    interrupted one, and --force begins again.
    Exit status: 0 pass, 1 fail, 2 wrong input, 3 inconclusive.
    """
    from recorder.reader import join
    from replays.recordings.validation import load_criteria
    from replays.recordings.validation import validate as hold
    from replays.report import TEXT_SUFFIXES, check_report, write_report
    from rig.run.scenes import read_value

    if report is not None:
        check_report(report, force=force)
    if budget is not None:
        check_report(budget, force=force, field="--budget", suffixes=TEXT_SUFFIXES)
        if report is not None and budget.resolve() == report.resolve():
            raise InputError("--budget", "another file than --report", str(budget))
    rules = load_criteria(criteria)
    rules = rules.with_floating((*rules.floating, *split_names(floating, "--float")))
    texts = SceneChanges(changes=changes, engine=engine).overrides()
    overrides = {key: read_value(value) for key, value in texts.items()}
    options: dict[str, Any] = {"criteria": rules, "changes": overrides, "declared": declared, "blind": blind}
    if any(file.is_dir() for file in files):
        if len(files) > 1 or any(one is not None for one in (report, budget, runout)):
            must = "one folder, without --report, --budget and --run-out"
            raise InputError("FILE", must, Words(" ".join(map(str, files))))
        rows = _validate_folder(files[0], output or files[0], options, jobs=jobs, force=force)
        _show_folder(rows, output or files[0], form)
        return
    if output is not None:
        raise InputError("--output", "left out, except for a folder", str(output))
    (recording,) = subtract_run_out(runout, join(files), log=True, show=partial(echo, err=True))
    with reporting(compiles=True) as reporter:
        result = hold(recording, step=reporter.step, budget=budget is not None, **options)
        origin = recording_origin(result.title, recording)
        if report is not None:
            from replays.recordings.validation.report import make_report

            reporter.step("report")
            write_report(make_report(result, origin=origin), report)
        if budget is not None:
            from replays.recordings.validation.report import make_budget_report

            write_report(make_budget_report(result, rules, origin=origin), budget)
    if form.as_json:
        echo_json(result.document())
    else:
        _show(result, form.console())
        if report is not None:
            echo(f"report  {report}")
        if budget is not None:
            echo(f"budget  {budget}")
    if result.outcome.exit_status:
        raise typer.Exit(result.outcome.exit_status)


def _validate_folder(
    folder: Path, output: Path, options: dict[str, Any], *, jobs: int, force: bool
) -> list[dict[str, Any]]:
    """Return a row for each recording of a folder, the worst first, and write them to validations.json."""
    from replays.studies.common.journal import Journal
    from replays.studies.common.provenance import RIG, commit, versions
    from rig.base.files import lock_folder, write_file
    from rig.base.text import replace_nonfinite
    from rig.ensemble.ensemble import iterate_results, local_workers

    files = sorted(file for file in folder.glob("*.mcap") if not file.is_dir())
    if not files:
        raise InputError("FILE", "a recording, or a folder with recordings (.mcap)", str(folder))
    settings = [options["criteria"].model_dump_json(), *map(repr, options.values()), versions(RIG), commit()]
    lock = lock_folder(output, "rig validate")
    try:
        code = hashlib.sha256(repr(settings).encode()).hexdigest()[:16]
        journal = Journal(output, "validations.jsonl", code, fresh=force)
        # A file that was not readable is tried again: its permissions or its link may have changed.
        known = {(row["file"], row["stamp"]): row for row in journal.rows if row["outcome"] != _DAMAGED}
        keys = [(os.fsencode(file.name).decode(errors="backslashreplace"), _stamp(file)) for file in files]
        left = [k for k, key in enumerate(keys) if key not in known]
        with reporting(compiles=True) as reporter, local_workers(jobs) as workers:
            reporter.begin(len(files))
            reporter.done = len(files) - len(left)
            for k, row in iterate_results(workers, left, _validate_file, files, options):
                name, stamp = keys[k]
                known[keys[k]] = row = replace_nonfinite({"file": name, "stamp": stamp, **row, "code": code})
                journal.add(row)
                reporter.step(f"{row['file']}: {row['outcome']}")
        rows = [known[key] for key in keys]
        rows.sort(key=lambda row: (_RANKS.index(row["outcome"]), -row["failures"], row["file"]))
        write_file(output / "validations.json", json.dumps({"folder": str(folder), "rows": rows}, indent=2) + "\n")
    finally:
        os.close(lock)
    return rows


def _stamp(file: Path) -> str:
    """Return size and time of a file; empty for one that vanished, or a link to nothing."""
    with suppress(OSError):
        return f"{(status := file.stat()).st_size} {status.st_mtime_ns}"
    return ""


_DAMAGED = "not readable"
_RANKS = (Outcome.FAIL.value, _DAMAGED, Outcome.INCONCLUSIVE.value, Outcome.PASS.value)
"""Outcomes of a file, the worst first."""


def _validate_file(files: list[Path], options: dict[str, Any], number: int, stop: Event) -> dict[str, Any]:
    """Return the result for a file of a folder; a file that cannot be validated has a reason instead."""
    from recorder.reader import join
    from replays.recordings.validation import validate as hold

    def step(_text: str) -> None:
        if stop.is_set():
            raise KeyboardInterrupt

    try:
        result = hold(join([files[number]]), step=step, **options)
    except (InputError, SimulationError) as error:
        return {"outcome": _DAMAGED, "failures": 0, "judged": 0, "line": str(error), "cause": ""}
    return {
        "outcome": result.outcome.value, "failures": len(result.failures), "judged": result.judged,
        "line": result.verdict_line, "cause": result.explained.conclusion if result.explained is not None else "",
    }  # fmt: skip


def _show_folder(rows: list[dict[str, Any]], output: Path, form: Form) -> None:
    outcomes = [Outcome.INCONCLUSIVE if row["outcome"] == _DAMAGED else Outcome(row["outcome"]) for row in rows]
    if form.as_json:
        echo_json({"outcome": Outcome.worst(outcomes).value, "rows": rows})
    else:
        table = new_table("Validations, the worst first", "file", "outcome", ">failed", "result", wrapped=["result"])
        for row in rows:
            text = row["line"] + (f"; {row['cause']}" if row["cause"] else "")
            table.add_row(row["file"], row["outcome"], f"{row['failures']} of {row['judged']}", text)
        form.console().print(table)
        echo(f"results  {output / 'validations.json'}")
    if status := Outcome.worst(outcomes).exit_status:
        raise typer.Exit(status)


def _show(result: Validation, console: Console) -> None:
    changed = ", ".join(f"{key} = {value}" for key, value in result.changes.items())
    console.print(
        make_printable(f"{result.title}, scene {result.scene}") + (f", validated with {changed}" if changed else "")
    )
    console.print(result.verdict_line)
    for line in result.doubts[1:]:
        console.print(f"also: {line}")
    if result.explained is not None:
        console.print(f"first difference at {result.explained.from_s:.4f} s; {result.explained.conclusion}")
    for fault in result.faults:
        if result.explained is None or fault.line not in result.explained.conclusion:
            console.print(make_printable(f"signal: {fault.line}"))
    console.print(result.bits_line)
    for item in result.fitted:
        console.print(item.line)
    if result.calibration:
        console.print(f"calibration: {result.calibration_line}")
    if result.bit_exact and not result.declared:
        return
    if result.explained is not None and any(_counts(item, result.explained) for item in result.explained.ranked):
        console.print()
        console.print(_explanations(result.explained))
        console.print("residual: RMS of the remaining residual over the noise; 1 is noise alone")
    begin, end = result.window_s
    console.print(f"\ntrajectory from {begin:.4f} to {end:.4f} s: {result.window_reason}\n")
    console.print(_trajectory(result))
    console.print()
    if result.truth:
        console.print(_truth(result))
        console.print()
    if result.statistics:
        console.print(_statistics(result))
        console.print(result.legend(lambda unit, name: unit == "1" or name.startswith("ripple")))


def _trajectory(validation: Validation) -> Table:
    from replays.recordings.validation.trajectory import PULSES_ONLY

    headings = ("channel", ">noise", ">RMS", ">limit", ">largest", ">drift", ">first at", "verdict")
    table = new_table("Trajectory: residual over the channel's own noise", *headings)
    for item in validation.residuals:
        table.add_row(
            item.channel,
            f"{item.floor:.3g} {item.unit}".rstrip(),
            f"{item.rms:.3f}",
            "" if math.isinf(item.limit) else f"{item.limit:.3f}",
            f"{item.peak:.2f}",
            f"{item.drift:.2f}",
            "" if item.first_s is None else f"{item.first_s:.4f} s",
            _VERDICTS[item.good] + (PULSES_ONLY if item.pulses else ""),
        )
    return table


def _truth(validation: Validation) -> Table:
    headings = ("table", "column with largest error", ">error", ">limit", "verdict")
    table = new_table("Truth: largest difference as a part of the column's largest value", *headings)
    for item in validation.truth:
        table.add_row(item.table, item.column, f"{item.relative:.1e}", f"{item.limit:.1e}", _VERDICTS[item.good])
    return table


def _statistics(validation: Validation) -> Table:
    from replays.recordings.validation.statistics import NOT_JUDGED

    table = new_table("Phases", "phase", "quantity", ">recorded", ">predicted", ">limit", "verdict")
    for item in validation.statistics:
        limit = "" if item.limit is None else f"± {item.limit:.2g}"
        verdict = NOT_JUDGED if item.too_wide else _VERDICTS[item.good]
        table.add_row(item.phase, item.title, f"{item.recorded:.6g}", f"{item.foretold:.6g}", limit, verdict)
    return table


def _counts(item: Explanation, of: Explained) -> bool:
    return item.explained >= _MIN_EXPLAINED or item.name in of.best


def _explanations(explained: Explained) -> Table:
    headings = ("kind", "candidate", "change", ">explained", ">residual", ">fitted to", "verdict")
    title = "Candidate explanations of the difference, each alone"
    table = new_table(title, *headings, wrapped=["change"], spare=("kind", "fitted to"))
    for one in [one for one in explained.ranked if _counts(one, explained)][:12]:
        verdict = "named" if one.name in explained.best else ""
        row = (one.kind, one.name, one.change, one.part, f"{one.left:.3g}", f"{one.to_s:.3f} s", verdict)
        table.add_row(*row)
    return table
