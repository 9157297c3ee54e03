"""`rig run`: simulate a scene and serve it."""

from __future__ import annotations

from contextlib import ExitStack
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.can_output import (
    CanBitrate,
    CanBus,
    CanClassic,
    CanFd,
    CanOverload,
    CanRate,
    CanSlcan,
    CanSocketcand,
    can_output,
)
from rig.cli.connection import exposure, tell_where
from rig.cli.display import all_lateness, end_with, lateness, showing
from rig.cli.options import (
    Changes,
    DurationS,
    Engine,
    Expose,
    Keys,
    Listen,
    Parameters,
    Plaintext,
    SceneName,
    Seed,
    pairs,
)
from rig.cli.signals import stopping_on_signals
from rig.cli.tables import echo
from rig.errors import InputError
from rig.transport import DEFAULT_ENDPOINT

if TYPE_CHECKING:
    from rig.pacing import Clock


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
    listen: Listen = DEFAULT_ENDPOINT,
    expose: Expose = None,
    tls: Keys = None,
    plaintext: Plaintext = False,
    parameters: Parameters = None,
    changes: Changes = None,
    engine: Engine = None,
    duration_s: DurationS = None,
    seed: Seed = None,
    can: CanBus = None,
    can_rate: CanRate = None,
    can_classic: CanClassic = False,
    can_fd: CanFd = False,
    can_bitrate: CanBitrate = None,
    can_overload: CanOverload = False,
    can_socketcand: CanSocketcand = None,
    can_slcan: CanSlcan = False,
) -> None:
    """Run a scene in real time and publish its sensors, until its end, `rig stop` or Ctrl-C."""
    exposed = exposure(expose, tls, plaintext=plaintext)
    overrides = scene_overrides(changes or [], parameters=parameters, engine=engine, duration_s=duration_s, seed=seed)

    from rig.pacing import rare_collections

    with rare_collections():
        from rig.kernels import COMPILE_NOTICE, compiled_before
        from rig.scenes import load_scene
        from rig.service import Service
        from rig.simulation import Simulation
        from rig.transport.endpoint import check_free, parse_endpoint, parse_loopback
        from rig.transport.zenoh import ZenohServer

        check_free(parse_loopback(listen, field="listen"), field="listen")
        if exposed is not None:
            check_free(parse_endpoint(exposed.endpoint, field="expose"), field="expose")
        loaded = load_scene(scene, overrides)
        bus = can_output(
            can,
            classic=can_classic,
            fd=can_fd,
            rate_hz=can_rate,
            bitrate=can_bitrate,
            overload=can_overload,
            socketcand=can_socketcand,
            slcan=can_slcan,
        )
        simulation = Simulation(loaded)
        block_ticks = _block_ticks(block_ms, simulation)
        notice = "preparing" if compiled_before() else COMPILE_NOTICE
        echo(f"rig: scene {scene}, {pace}; {notice}", err=True)
        # Before anybody can connect: whoever does is answered at once.
        simulation.warm_up()
    paced = pace is Pace.REAL_TIME
    with ZenohServer(listen, exposed=exposed, wait=not paced) as server, ExitStack() as stack:
        if bus is not None:
            stack.enter_context(bus)
        with rare_collections():
            everywhere = server if bus is None else bus.beside(server)
            service = Service(simulation, everywhere, _clock(pace), block_ticks=block_ticks)
            if loaded.fidelity_line:
                echo(f"rig: {loaded.fidelity_line}", err=True)
            service.prepare()
            if bus is not None:
                bus.start(paced=paced)
                echo(f"rig: {bus}", err=True)
        tell_where(server, exposed)
        with stopping_on_signals(service.stop), showing(service.status, _words):
            summary = service.run()
    _print_summary(summary)
    if bus is not None:
        echo(bus.summary())
    end_with(summary["troubles"])


def scene_overrides(
    changes: list[str],
    *,
    parameters: str | None = None,
    engine: str | None = None,
    duration_s: float | None = None,
    seed: int | None = None,
) -> dict[str, str]:
    """Changes to a scene from the command line, by dotted key.

    Raises:
        InputError: A change is not of the form KEY=VALUE.
    """
    overrides = pairs("--set", changes, "KEY=VALUE, such as drive.speed_hz=5.2")
    named = {"parameters": parameters, "engine.name": engine, "duration_s": duration_s, "seed": seed}
    return overrides | {key: str(value) for key, value in named.items() if value is not None}


def _block_ticks(block_ms: float, simulation: Any) -> int:
    ticks = block_ms * simulation.tick_rate_hz / 1000
    unit_ms = simulation.block_ticks * 1000 / simulation.tick_rate_hz
    # Blocks of more than a second would make commands wait that long.
    if not 0 < block_ms <= 1000 or ticks % simulation.block_ticks:
        raise InputError("--block-ms", f"a positive whole multiple of {unit_ms:g} ms, at most 1000 ms", block_ms)
    return round(ticks)


def _clock(pace: Pace) -> Clock:
    from rig.pacing import FreeRun, Lockstep, RealTime

    if pace is Pace.REAL_TIME:
        return RealTime()
    return Lockstep() if pace is Pace.LOCKSTEP else FreeRun()


def _words(status: dict[str, Any]) -> list[str]:
    spin_hz = status["spin_hz"]
    return [
        f"{status['time_s']:9.2f} s",
        *([] if spin_hz is None else [f"spin {spin_hz:.2f} Hz"]),
        f"x{status['real_time_factor']:.4f}",
        lateness(status),
        f"overruns {status['overruns']}",
        f"dropped {status['queue']['dropped']}",
    ]


def _print_summary(summary: dict[str, Any]) -> None:
    queue = summary["queue"]
    echo(f"scene {summary['scene']}: {summary['reason']} at {summary['time_s']:.3f} s after {summary['wall_s']:.2f} s")
    echo(f"real-time factor {summary['real_time_factor']:.6f}, {all_lateness(summary)}, overruns {summary['overruns']}")
    echo(
        f"{summary['samples_published']} samples a channel published, blocks dropped {queue['dropped']},"
        f" commands taken {summary['commands']}"
    )
