"""`rig bench`: speed and accuracy of the engines on this machine."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from rig.cli.output.progress import reporting
from rig.cli.output.tables import Form, Table, echo_json, new_table


def bench(
    *,
    form: Form,
    runs: Annotated[int, typer.Option(min=1, max=100, help="Timed runs of each case")] = 5,
    peers: Annotated[bool, typer.Option(help="Also time CVODE and heyoka, if installed")] = True,
    frames: Annotated[int, typer.Option(min=0, max=1_000_000, help="Number of 1 ms frames to time")] = 10_000,
    ensemble: Annotated[
        int, typer.Option(min=0, max=1_000_000, help="Hammer runs at once: time only these, 1024 say")
    ] = 0,
) -> None:
    """Measure speed and error of the engines on this machine: medians of several runs, without compile time."""
    from replays.studies.bench.engines import measure

    if ensemble:
        _measure_ensembles(form, count=ensemble, rounds=runs, peers=peers)
        return
    with reporting(compiles=True, live=False) as reporter:  # a live line would disturb the timing
        report = measure(runs=runs, peers=peers, frames=frames, progress=reporter.show_activity)
    if form.as_json:
        echo_json(report)
        return
    console = form.console()
    console.print(cases_table(report, runs=runs))
    if report["missing_peers"]:
        console.print(f"not timed: {', '.join(report['missing_peers'])} (pip install 'rotor-stator-rig[peers]')")
    console.print("goals: times real time, at an error, for an idle machine; a loaded one may miss them")
    reference = report["reference"]
    doubt = "" if reference["error"] is None else f", which agree to {reference['error']:.0e}"
    console.print(f"error: RMS of 7 scaled states over 1 s against exact Coulomb by {reference['of']}{doubt}")
    for name, frame in (report["frame"] or {}).items():
        console.print(
            f"frame of 1 ms, {name}: median {frame['median_us']:.0f} us, 99.9 % {frame['p999_us']:.0f} us, "
            f"worst of {frame['frames']}: {frame['worst_us']:.0f} us; "
            f"goal: 99.9 % within {frame['goal_us']:.0f} us, {'reached' if frame['reached'] else 'NOT reached'}"
        )
    console.print(
        f"kernels ready after {report['ready_s']:.1f} s ({'from the cache' if report['cached'] else 'compiled'})"
    )


def _measure_ensembles(form: Form, *, count: int, rounds: int, peers: bool) -> None:
    from replays.studies.bench.ensembles import measure_ensembles

    with reporting(compiles=True, live=False) as reporter:
        report = measure_ensembles(count=count, rounds=rounds, peers=peers, progress=reporter.show_activity)
    if form.as_json:
        echo_json(report)
        return
    console, goals, gain = form.console(), report["goals"], report["two_threads"]
    console.print(ensembles_table(report))
    if report["missing_peers"]:
        console.print(f"not timed: {', '.join(report['missing_peers'])} (pip install 'rotor-stator-rig[peers]')")
    console.print(f"goal of the batch kernel: {goals['speed']:g} at an error of {goals['error']:g}")
    console.print(
        f"two threads: {gain['wall_time']:.2f} times one by wall time (best {gain['best_wall_time']:.2f}), "
        f"{gain['processor_time']:.2f} by the processor time of the longer thread; goal {goals['threads']:g}"
    )
    console.print(f"load before: {report['machine']['load'][0]:.1f} of {report['machine']['cores']} cores")
    console.print(f"the two references differ by {report['reference_difference']:.0e} (median)")


def ensembles_table(report: dict[str, Any]) -> Table:
    """Return a table of the methods for many runs."""
    table = new_table(
        f"hammer runs of {report['duration_s']:g} s: simulated over processor time, {report['rounds']} rounds",
        *("method", ">runs", ">tolerance", ">median", ">min", ">max", ">library alone", ">error", ">error to taylor"),
        wrapped=["method"],
        spare=("min", "max"),
    )
    for each in report["methods"]:
        table.add_row(
            each["name"], str(each["runs"]), f"{each['tolerance']:.0e}",
            *(f"{each[name]:.1f}" for name in ("median", "min", "max")),
            "" if each["library_alone"] is None else f"{each['library_alone']:.1f}",
            f"{each['error']:.1e}", f"{each['error_taylor']:.1e}",
        )  # fmt: skip
    return table


def cases_table(report: dict[str, Any], *, runs: int) -> Table:
    """Return a table of the timed cases with error and goal."""
    table = new_table(
        f"times real time, {runs} runs",
        *("case", ">median", ">min", ">max", ">of the first", ">error", ">energy residual", ">goal", "reached"),
        wrapped=["case"],
        spare=("min", "max", "of the first"),
    )
    for case in report["cases"]:
        goal = "" if case["goal"] is None else f"{case['goal']:g}"
        if case["error_goal"] is not None:
            goal = f"{goal} at {case['error_goal']:.1e}" if goal else f"error {case['error_goal']:.1e}"
        verdict = {True: "yes", False: "NO", None: ""}[case["reached"]]
        table.add_row(
            case["name"], f"{case['median']:.1f}", f"{case['min']:.1f}", f"{case['max']:.1f}", f"{case['ratio']:.2f}",
            "" if case["error"] is None else f"{case['error']:.1e}", f"{case['residual_share']:.0e}",
            goal.strip(), verdict,
        )  # fmt: skip
    for peer in report["peers"]:
        table.add_row(
            peer["name"], f"{peer['median']:.1f}", f"{peer['min']:.1f}", f"{peer['max']:.1f}", f"{peer['ratio']:.2f}",
            f"{peer['error']:.1e}", "", "", "",
        )  # fmt: skip
    return table
