"""`rig run`: simulate a scene and publish it."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.errors import InputError
from rig.cli.connections.can_output import CanOptions
from rig.cli.connections.connection import Serving, serve
from rig.cli.options import SceneChanges, SceneName
from rig.cli.output.display import lateness_summary, lateness_text, motion_text
from rig.cli.output.progress import reporting
from rig.cli.output.tables import echo

if TYPE_CHECKING:
    from rig.serve.pacing import Clock
    from rig.serve.service import Service
    from rig.serve.transport import Server


class Pace(StrEnum):
    """Timing of the blocks."""

    REAL_TIME = "real-time"
    LOCKSTEP = "lockstep"
    FREE = "free"


def run(
    scene: SceneName,
    *,
    pace: Annotated[
        Pace, typer.Option(help="Timing: wall clock, `rig step`, or as fast as clients read")
    ] = Pace.REAL_TIME,
    block_ms: Annotated[float, typer.Option(help="Length of a block in ms; the last 3000 blocks are cached")] = 10.0,
    serving: Serving,
    scene_changes: SceneChanges,
    can: CanOptions,
) -> None:
    """Run a scene in real time and publish its sensors, until its end, `rig stop` or Ctrl-C."""
    serving.exposure()  # checks these options first
    overrides = scene_changes.overrides()

    from rig.serve.pacing import reduce_garbage_collections

    with reduce_garbage_collections():
        from rig.run.scenes import load_scene
        from rig.run.simulation import Simulation
        from rig.serve.service import Service

        loaded = load_scene(scene, overrides)
        bus = can.output(loaded.table)
        simulation = Simulation(loaded)
        block_ticks = _block_ticks(block_ms, simulation)
        # Last, so that a wrong option is reported even while another rig runs.
        serving.check()
        echo(f"rig: scene {scene}, {pace}; preparing", err=True)
        # Before clients can connect, so that they are answered at once.
        with reporting(compiles=True):
            simulation.warm_up()

    def make(server: Server) -> Service:
        service = Service(simulation, server, _clock(pace), block_ticks=block_ticks)
        if loaded.fidelity_line:
            echo(f"rig: {loaded.fidelity_line}", err=True)
        return service

    paced = pace is Pace.REAL_TIME
    serve(make, status_parts, _print_summary, serving=serving, bus=bus, paced=paced, wait=not paced)


def _block_ticks(block_ms: float, simulation: Any) -> int:
    ticks = block_ms * simulation.tick_rate_hz / 1000
    unit_ms = simulation.block_ticks * 1000 / simulation.tick_rate_hz
    # A command waits up to one block, so blocks are limited to one second.
    if not 0 < block_ms <= 1000 or ticks % simulation.block_ticks:
        raise InputError("--block-ms", f"a positive whole multiple of {unit_ms:g} ms, at most 1000 ms", block_ms)
    return round(ticks)


def _clock(pace: Pace) -> Clock:
    from rig.serve.pacing import FreeRun, Lockstep, RealTime

    if pace is Pace.REAL_TIME:
        return RealTime()
    return Lockstep() if pace is Pace.LOCKSTEP else FreeRun()


def status_parts(status: dict[str, Any]) -> list[str]:
    """Return the parts of a progress line."""
    from rig.serve.devices import describe_waits

    end_s, spin_hz = status["end_s"], status["spin_hz"]
    end = "" if end_s is None else f" of {end_s:g}"
    spin = [] if spin_hz is None else [f"spin {spin_hz:.2f} Hz"]
    waits = [text] if (text := describe_waits(status["devices"])) else []
    pace = f"x{status['real_time_factor']:.4f} real time"
    motion = [motion_text(status["motion"])] if status.get("motion") else []
    return [f"{status['time_s']:7.2f}{end} s", *waits, *spin, *motion, pace, lateness_text(status)]


def _print_summary(summary: dict[str, Any]) -> None:
    queue = summary["queue"]
    echo(f"scene {summary['scene']}: {summary['reason']} at {summary['time_s']:.3f} s after {summary['wall_s']:.2f} s")
    late = lateness_summary(summary)
    if summary.get("motion"):
        echo(f"motion at the end: {motion_text(summary['motion'])}")
    echo(f"real-time factor {summary['real_time_factor']:.6f}, {late}, overruns {summary['overruns']}")
    echo(
        f"{summary['samples_published']} samples per channel published, blocks dropped {queue['dropped']},"
        f" commands accepted {summary['commands']}"
    )
