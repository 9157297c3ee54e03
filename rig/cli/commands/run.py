"""`rig run`: simulate a scene and serve it."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.errors import InputError
from rig.cli.connections.can_output import CanOptions
from rig.cli.connections.connection import Serving, serve
from rig.cli.options import SceneChanges, SceneName
from rig.cli.output.display import all_lateness, lateness
from rig.cli.output.progress import reporting
from rig.cli.output.tables import echo

if TYPE_CHECKING:
    from rig.serve.pacing import Clock
    from rig.serve.service import Service
    from rig.serve.transport import Server


class Pace(StrEnum):
    """What decides when the next block runs."""

    REAL_TIME = "real-time"
    LOCKSTEP = "lockstep"
    FREE = "free"


def run(
    scene: SceneName,
    *,
    pace: Annotated[
        Pace, typer.Option(help="By the wall clock, by `rig step`, or as fast as everything attached keeps up.")
    ] = Pace.REAL_TIME,
    block_ms: Annotated[
        float, typer.Option(help="Length of a published block, in ms; the last 3000 are kept for clients that stall.")
    ] = 10.0,
    serving: Serving,
    scene_changes: SceneChanges,
    can: CanOptions,
) -> None:
    """Run a scene in real time and publish its sensors, until its end, `rig stop` or Ctrl-C."""
    serving.exposure()  # what is wrong with that is said first
    overrides = scene_changes.overrides()

    from rig.serve.pacing import rare_collections

    with rare_collections():
        from rig.run.scenes import load_scene
        from rig.run.simulation import Simulation
        from rig.serve.service import Service

        loaded = load_scene(scene, overrides)
        bus = can.output(loaded.table)
        simulation = Simulation(loaded)
        block_ticks = _block_ticks(block_ms, simulation)
        # Last: a wrong line is told as such also where another rig runs.
        serving.check()
        echo(f"rig: scene {scene}, {pace}; preparing", err=True)
        # Before anybody can connect: whoever does is answered at once.
        with reporting(compiles=True):
            simulation.warm_up()

    def make(server: Server) -> Service:
        service = Service(simulation, server, _clock(pace), block_ticks=block_ticks)
        if loaded.fidelity_line:
            echo(f"rig: {loaded.fidelity_line}", err=True)
        return service

    paced = pace is Pace.REAL_TIME
    serve(make, _words, _print_summary, serving=serving, bus=bus, paced=paced, wait=not paced)


def _block_ticks(block_ms: float, simulation: Any) -> int:
    ticks = block_ms * simulation.tick_rate_hz / 1000
    unit_ms = simulation.block_ticks * 1000 / simulation.tick_rate_hz
    # Blocks of more than a second would make commands wait that long.
    if not 0 < block_ms <= 1000 or ticks % simulation.block_ticks:
        raise InputError("--block-ms", f"a positive whole multiple of {unit_ms:g} ms, at most 1000 ms", block_ms)
    return round(ticks)


def _clock(pace: Pace) -> Clock:
    from rig.serve.pacing import FreeRun, Lockstep, RealTime

    if pace is Pace.REAL_TIME:
        return RealTime()
    return Lockstep() if pace is Pace.LOCKSTEP else FreeRun()


def _words(status: dict[str, Any]) -> list[str]:
    end_s, spin_hz = status["end_s"], status["spin_hz"]
    end = "" if end_s is None else f" of {end_s:g}"
    spin = [] if spin_hz is None else [f"spin {spin_hz:.2f} Hz"]
    return [f"{status['time_s']:7.2f}{end} s", *spin, f"x{status['real_time_factor']:.4f}", lateness(status)]


def _print_summary(summary: dict[str, Any]) -> None:
    queue = summary["queue"]
    echo(f"scene {summary['scene']}: {summary['reason']} at {summary['time_s']:.3f} s after {summary['wall_s']:.2f} s")
    echo(f"real-time factor {summary['real_time_factor']:.6f}, {all_lateness(summary)}, overruns {summary['overruns']}")
    echo(
        f"{summary['samples_published']} samples a channel published, blocks dropped {queue['dropped']},"
        f" commands taken {summary['commands']}"
    )
