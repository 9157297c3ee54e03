"""`rig simulate`: a scene simulated at full speed to a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from rig.cli.options import Force, SceneChanges, SceneName
from rig.cli.output.progress import reporting
from rig.cli.output.tables import echo


def simulate(
    scene: SceneName,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="File: .mcap, .parquet, .csv or .wav (sensors in V)")],
    scene_changes: SceneChanges,
    check: Annotated[
        bool,
        typer.Option("--check", help="Compare the run with another engine; status 1: suspect, 3: unknown"),
    ] = False,
    force: Force = False,
) -> None:
    """Simulate a scene at full speed and write it to a file: every state, force and sensor, with units."""
    import time

    from rig.serve.pacing import reduce_garbage_collections

    with reduce_garbage_collections():
        from replays.recordings.export import check_run_output, write_run
        from replays.studies.check import check as check_run
        from replays.studies.check import choose_reference, sample_rows
        from rig.run.scenes import load_scene

        check_run_output(output, force=force)
        loaded = load_scene(scene, scene_changes.overrides())
        if check:
            choose_reference(loaded)  # raises its errors before a long run

        from rig.run.simulation import Simulation

        simulation = Simulation(loaded)
        if loaded.fidelity_line:
            echo(loaded.fidelity_line, err=True)
        with reporting(compiles=True):
            simulation.warm_up()
    with reporting() as reporter:
        begin = time.perf_counter()
        rows: list[Any] = []
        observe = (lambda frame: rows.append(sample_rows(simulation, frame))) if check else (lambda _frame: None)
        write_run(simulation, output, force=force, progress=lambda part: reporter.part(part, scene), observe=observe)
    seconds = simulation.tick / simulation.tick_rate_hz
    factor = seconds / (time.perf_counter() - begin)
    health = simulation.health()
    echo(
        f"{output}: {seconds:g} s simulated, {factor:.1f} times real time with the file, "
        f"{output.stat().st_size / 1e6:.1f} MB{_moved(health)}"
    )
    for warning in health["warnings"]:
        echo(f"warning: {warning}", err=True)
    for remark in health.get("remarks", []):
        echo(f"note: {remark}", err=True)
    if check:
        with reporting(compiles=True) as reporter:
            reporter.show_activity("reference run")
            checked = check_run(simulation, rows)
        if checked.informs and not checked.wrong_branch:
            echo(f"checked {checked.line()}")
            return
        echo(f"warning: {checked.line()}", err=True)
        raise typer.Exit(1 if checked.informs else 3)


def _moved(health: dict[str, Any]) -> str:
    """Return the contacts and the energy residual in words; empty for test signals."""
    energy = health.get("energy")
    if energy is None:
        return ""
    return (
        f"; {health['contacts']} contacts, "
        f"energy residual {energy['residual_j']:.1e} J of {energy['dissipated_j']:.3g} J dissipated"
    )
