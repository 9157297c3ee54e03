"""`rig bench`: how fast the rig is on this machine."""

from __future__ import annotations

from typing import Annotated

import typer


def bench(
    *,
    json_output: Annotated[bool, typer.Option("--json", help="As a JSON document.")] = False,
    runs: Annotated[int, typer.Option(min=1, max=100, help="Runs of each case.")] = 5,
    simulated_s: Annotated[float, typer.Option(min=0.1, max=100.0, help="Simulated time of a run, in s.")] = 1.0,
) -> None:
    """Measure simulated over wall time: engines, sensors, scenes; medians of several runs, compile time apart."""
    import json
    import sys

    from rich.console import Console
    from rich.table import Table

    from replays.bench import measure

    def progress(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    report = measure(runs=runs, simulated_s=simulated_s, progress=progress)
    if json_output:
        typer.echo(json.dumps(report, indent=2))
        return
    table = Table(
        title=f"times real time, {runs} runs of {simulated_s:g} s", box=None, header_style="bold", title_justify="left"
    )
    table.add_column("case")
    for heading in ("median", "min", "max", "of rk4 in the same run"):
        table.add_column(heading, justify="right")
    for case in report["cases"]:
        table.add_row(
            case["name"], f"{case['median']:.1f}", f"{case['min']:.1f}", f"{case['max']:.1f}", f"{case['ratio']:.2f}"
        )
    console = Console()
    console.print(table)
    console.print(
        f"kernels ready after {report['ready_s']:.1f} s ({'from the cache' if report['cached'] else 'compiled'})"
    )
