"""Arguments and options that several commands take, each worded once, and how their texts are read.

`--output`, `-o` is what a command makes, `--report` a report beside it. Parts of a recording are `--from` and `--to` in
s of simulated time; names are joined by commas; what is KEY=VALUE is repeated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.errors import InputError

if TYPE_CHECKING:
    from rig.physics.parameters import ParameterSet

SceneName = Annotated[str, typer.Argument(metavar="SCENE", help="Name of a scene, or the path of a scene file.")]
SetName = Annotated[str, typer.Argument(metavar="[SET]", help="A parameter set, by name or path.")]
Changes = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change one value; may be repeated.")
]
Law = Annotated[
    Path | None, typer.Option("--law", metavar="FILE.toml", help="A contact law of your own: numbers or formulas.")
]
Parameters = Annotated[str | None, typer.Option(metavar="SET", help="Parameter set, by name or path.")]
Engine = Annotated[str | None, typer.Option(metavar="ENGINE", help="Integration method.")]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="FILE", help="Draw them as well, to a .png or .svg file.")]
Json = Annotated[bool, typer.Option("--json", help="As a JSON document.")]
Wide = Annotated[bool, typer.Option("--wide", help="Every column, and a row on one line, as into a pipe.")]
RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="A recording (.mcap), finished or cut off.")]
_RECORDING_FILES = typer.Argument(
    metavar="FILE...", help="A recording (.mcap), finished or cut off, or its parts in any order."
)
RecordingFiles = Annotated[list[Path], _RECORDING_FILES]
OptionalRecordingFiles = Annotated[list[Path] | None, _RECORDING_FILES]
FromS = Annotated[float | None, typer.Option("--from", metavar="S", help="Where to begin, in s of simulated time.")]
ToS = Annotated[float | None, typer.Option("--to", metavar="S", help="Where to end, in s of simulated time.")]
Channels = Annotated[str | None, typer.Option("--channels", metavar="NAME,...", help="Only these channels.")]
ChannelFile = Annotated[
    Path | None, typer.Option("--channels", metavar="FILE.toml", help="The sensors, from a channel table of your own.")
]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there already.")]
ReportFile = Annotated[
    Path | None, typer.Option("--report", metavar="FILE", help="Write a report with pictures, .html or .pdf.")
]


@dataclass(frozen=True)
class SceneChanges:
    """What a run has in another way than its scene."""

    parameters: Parameters = None
    channels: ChannelFile = None
    changes: Changes = None
    law: Law = None
    engine: Engine = None
    duration_s: Annotated[float | None, typer.Option(help="Length of the run, in s.")] = None
    seed: Annotated[int | None, typer.Option(help="Seed of the sensors' noise.")] = None

    def overrides(self) -> dict[str, str]:
        """The changes by dotted key.

        Raises:
            InputError: One is not of the form KEY=VALUE, or the law's file is wrong.
        """
        overrides = pairs("--set", self.changes, "KEY=VALUE, such as drive.speed_hz=5.2")
        if self.law is not None:
            from rig.physics.law_file import read_law

            overrides |= {key: str(value) for key, value in read_law(self.law).changes().items()}
        named = {
            "parameters": self.parameters,
            "channels": self.channels,
            "engine.name": self.engine,
            "duration_s": self.duration_s,
            "seed": self.seed,
        }
        return overrides | {key: str(value) for key, value in named.items() if value is not None}


def names_of(text: str | None) -> list[str]:
    """The names in a list that is joined by commas; none where it was not given."""
    return [name.strip() for name in (text or "").split(",") if name.strip()]


def pairs(option: str, texts: list[str] | None, form: str) -> dict[str, str]:
    """The two sides of texts such as KEY=VALUE.

    Args:
        option: Its name, for errors.
        texts: What was given.
        form: What each text should look like, for errors.

    Raises:
        InputError: A text has no such form, or a left side comes twice.
    """
    found: dict[str, str] = {}
    for text in texts or []:
        left, equals, right = (side.strip() for side in text.partition("="))
        if not (left and equals and right):
            raise InputError(option, form, text)
        if left in found:
            raise InputError(option, f"given once for {left}", text)
        found[left] = right
    return found


def changed_parameters(
    name: str, changes: list[str] | None, also: dict[str, Any] | None = None, law: Path | None = None
) -> ParameterSet:
    """A parameter set with changes from the command line.

    Args:
        name: Name or path of the set.
        changes: Values of `--set`, each KEY=VALUE.
        also: Values by key from options of their own; they come last.
        law: File of a contact law.

    Raises:
        InputError: No such set or key, or a value that the model does not take.
    """
    from rig.physics.parameters import load_parameters
    from rig.run.scenes import read_value

    values = {key: read_value(text) for key, text in SceneChanges(changes=changes, law=law).overrides().items()}
    return load_parameters(name).override(values | (also or {}), source="--set")
