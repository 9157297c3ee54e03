"""What stands in `@pytest.mark.bench(...)`, checked."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, FiniteFloat

from replays.campaigns.equipment.bench import BenchSettings, Pace
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


def settings_of(given: dict[str, Any]) -> BenchSettings:
    """Settings of a bench.

    Raises:
        InputError: The first that is wrong.
    """
    made = check(_Marker, given, field="bench")
    faults = [{"at_s": 0.0, **each, "command": "fault"} for each in made.faults]
    timed = tuple(
        check(TimedCommand, each, field=f"bench.{field}.{n}")
        for field, several in (("commands", list(made.commands)), ("faults", faults))
        for n, each in enumerate(several)
    )
    if made.scene is not None:
        load_scene(made.scene, dict(made.set))
    scene = None if made.scene is None else str(made.scene)
    return BenchSettings(
        scene, made.pace, made.block_ms, made.set, made.channels, timed, made.duration_s, made.table, made.can
    )
