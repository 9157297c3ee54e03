"""Arguments of `@pytest.mark.bench(...)` and their validation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, FiniteFloat

from replays.campaigns.equipment.bench import BenchSettings, Pace, Waits
from rig.base.checks import Written, check
from rig.run.commands.table import TimedCommand
from rig.run.scenes import load_scene


class _Marker(Written):
    scene: str | Path | None = None
    pace: Pace = "lockstep"
    block_ms: Annotated[FiniteFloat, Field(ge=1.0, le=1000.0)] = 10.0
    set: dict[str, Any] = Field(default={})
    channels: tuple[str, ...] = ()
    faults: tuple[dict[str, Any], ...] = ()
    commands: tuple[dict[str, Any], ...] = ()
    duration_s: Annotated[FiniteFloat, Field(gt=0.0, le=86_400.0)] | None = None
    table: Path | None = None
    can: bool = False
    wait: Waits = Waits()


def read_settings(arguments: dict[str, Any]) -> BenchSettings:
    """Return bench settings from the arguments of the marker.

    Raises:
        InputError: If an argument is invalid; the message names the first one.
    """
    args = check(_Marker, arguments, field="bench")
    faults = [{"at_s": 0.0, **each, "command": "fault"} for each in args.faults]
    timed = tuple(
        check(TimedCommand, each, field=f"bench.{field}.{n}")
        for field, several in (("commands", list(args.commands)), ("faults", faults))
        for n, each in enumerate(several)
    )
    if args.scene is not None:
        load_scene(args.scene, dict(args.set))
    scene = None if args.scene is None else str(args.scene)
    return BenchSettings(
        scene,
        args.pace,
        args.block_ms,
        args.set,
        args.channels,
        timed,
        args.duration_s,
        args.table,
        args.can,
        args.wait,
    )
