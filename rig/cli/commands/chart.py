"""`rig chart`: work-precision charts of the rig's engines and of other solvers, measured on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import Law
from rig.cli.output.progress import reporting
from rig.cli.output.tables import echo


def chart(
    *,
    quick: Annotated[
        bool, typer.Option("--quick", help="Stop after 2 min of measurement; repeat for the rest (default)")
    ] = False,
    full: Annotated[bool, typer.Option("--full", help="Measure all points, up to 1 h")] = False,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FOLDER", help="Folder for pictures and data")
    ] = Path("chart"),
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="NAME", help="Chart one phase, or one scene of --panel scenes"),
    ] = None,
    panel: Annotated[
        list[str] | None,
        typer.Option("--panel", metavar="PANEL", help="exact, smoothed, memory, rub, profile or scenes; repeatable"),
    ] = None,
    no_peers: Annotated[bool, typer.Option("--no-peers", help="Chart only the rig's engines")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Start over instead of continuing the last run")] = False,
    law: Law = None,
    add: Annotated[
        list[Path] | None,
        typer.Option("--add", metavar="FILE.csv", help="Add a solver's results to the chart; repeatable"),
    ] = None,
    problem: Annotated[
        str | None, typer.Option("--problem", metavar="PHASE", help="Write the problem of a phase for your own solver")
    ] = None,
    draw: Annotated[bool, typer.Option("--draw", help="Redraw chart.csv of the folder without measuring")] = False,
) -> None:
    """Chart speed against error of the rig's engines and other solvers, by phase of the motion and contact law.

    A quick chart stops after two minutes of measurement; compiling and reference solutions take several more. Run it
    again until no points are left. --law acts on --panel scenes only; its name for --only is "law".
    """
    from replays.studies.chart.session import ChartProgress, add_solvers, draw_again, make_chart
    from replays.studies.chart.submission import write_problem
    from replays.studies.common.law_scene import add_law_scene
    from rig.base.errors import InputError, Words

    if quick and full:
        raise InputError("--quick, --full", "one of the two", Words("both"))
    if sum((bool(add), problem is not None, any((quick, full, only, panel, no_peers, fresh, draw)))) > 1:
        raise InputError("--add or --problem", "the only option except --output", Words("more options"))
    if law is not None:
        if add or problem is not None or "scenes" not in (panel or ["scenes"]):
            raise InputError("--law", "given with --panel scenes, on which alone it acts", Words("other options"))
        name = add_law_scene(law)
        if only == "law":
            only, panel = name, ["scenes"]
        elif only is not None and panel != ["scenes"]:
            raise InputError("--law", "given with --panel scenes, on which alone it acts", Words(f"--only {only}"))
    if problem is not None:
        with reporting(compiles=True):
            path = write_problem(problem, output)
        echo(str(path))
        return
    if draw:
        for path in draw_again(output, only=only, panels=panel).files:
            echo(str(path))
        return
    mode = "full" if full else "quick"
    with reporting(compiles=True) as reporter:
        reporter.show("references")
        progress = ChartProgress(begin=reporter.begin, step=reporter.step)
        if add:
            outcome = add_solvers(output, add, progress=progress)
        else:
            outcome = make_chart(
                output, mode=mode, only=only, panels=panel, peers=not no_peers, fresh=fresh,
                command="rig chart --full" if full else "rig chart", progress=progress,
            )  # fmt: skip
    if outcome.missing:
        missing = ", ".join(outcome.missing)
        echo(f"not installed: {missing} (pip install 'rotor-stator-rig[peers]'); left out of the chart", err=True)
    if outcome.outdated:
        echo(f"{outcome.outdated} points from an older version were measured again", err=True)
    unmeasured = f", {outcome.left} not measured within the time limit: run again to add them" if outcome.left else ""
    what = "added" if add else "measured"
    counts = f"{outcome.measured} points {what}, {outcome.resumed} kept, {outcome.failures} failures in the table"
    echo(counts + unmeasured, err=True)
    for line in outcome.added:
        echo(line)
    for path in outcome.files:
        echo(str(path))
    if outcome.interrupted:
        echo("stopped; run the same command again to continue", err=True)
        raise typer.Exit(130)
