"""`rig validate`: a recording compared with the model."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.options import Changes, Engine, Force, RecordingFiles, ReportFile, SceneChanges
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
    declared: Annotated[
        bool, typer.Option("--declared", help="Apply the declared criteria even if every bit is equal")
    ] = False,
    blind: Annotated[bool, typer.Option("--blind", help="Ignore the faults that the recording declares")] = False,
    report: ReportFile = None,
    force: Force = False,
    form: Form,
) -> None:
    """Simulate a recording again and compare it with the model: bit by bit, then by declared criteria.

    For a failed criterion, the candidate that explains the difference is named: a sensor, the time or a parameter.
    Exit status: 0 pass, 1 fail, 2 wrong input, 3 inconclusive.
    """
    from recorder.reader import join
    from replays.recordings.validation import load_criteria
    from replays.recordings.validation import validate as hold
    from replays.report import check_report, write_report
    from rig.run.scenes import read_value

    if report is not None:
        check_report(report, force=force)
    rules = load_criteria(criteria)
    texts = SceneChanges(changes=changes, engine=engine).overrides()
    overrides = {key: read_value(value) for key, value in texts.items()}
    recording = join(files)
    with reporting(compiles=True) as reporter:
        result = hold(recording, criteria=rules, changes=overrides, declared=declared, blind=blind, step=reporter.step)
        if report is not None:
            from replays.recordings.validation.report import make_report

            reporter.step("report")
            write_report(make_report(result, origin=recording_origin(result.title, recording)), report)
    if form.as_json:
        echo_json(result.document())
    else:
        _show(result, form.console())
        if report is not None:
            echo(f"report  {report}")
    if result.outcome.exit_status:
        raise typer.Exit(result.outcome.exit_status)


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
