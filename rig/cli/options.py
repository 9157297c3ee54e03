"""Arguments and options shared by several commands, and the parsing of their texts.

`--output`, `-o` is the file or folder that a command creates, `--report` an additional report. `--from` and `--to`
limit a recording, in s of simulated time. Names are separated by commas; KEY=VALUE options are repeated.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.errors import InputError, Words

if TYPE_CHECKING:
    from collections.abc import Callable

    from recorder.reader import Recording
    from rig.physics.parameters import ParameterSet

SceneName = Annotated[str, typer.Argument(metavar="SCENE", help="Name of a scene, or path of a scene file")]
SetName = Annotated[str, typer.Argument(metavar="[SET]", help="Parameter set, by name or path")]
Changes = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Set a value of scene or parameters; repeatable")
]
Law = Annotated[
    Path | None, typer.Option("--law", metavar="FILE.toml", help="Your own contact law: numbers or formulas")
]
Parameters = Annotated[str | None, typer.Option(metavar="SET", help="Parameter set, by name or path")]
Engine = Annotated[str | None, typer.Option(metavar="ENGINE", help="Integration method")]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="FILE", help="Also draw the comparison, .png or .svg")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON")]
Wide = Annotated[bool, typer.Option("--wide", help="Print all columns, and each row on one line")]
RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="Recording (.mcap), complete or cut off")]
_RECORDING_FILES = typer.Argument(metavar="FILE...", help="Recording (.mcap), complete or cut off, or its parts")
RecordingFiles = Annotated[list[Path], _RECORDING_FILES]
OptionalRecordingFiles = Annotated[list[Path] | None, _RECORDING_FILES]
FromS = Annotated[float | None, typer.Option("--from", metavar="S", help="Begin at this simulated time in s")]
ToS = Annotated[float | None, typer.Option("--to", metavar="S", help="End at this simulated time in s")]
Channels = Annotated[str | None, typer.Option("--channels", metavar="NAME,...", help="Use only these channels")]
ChannelFile = Annotated[Path | None, typer.Option("--channels", metavar="FILE.toml", help="Your own channel table")]
_RUN_OUT_HELP = "Subtract the run-out of this slow roll, between two times in s"
RunOut = Annotated[str | None, typer.Option("--run-out", metavar="FILE[:T0-T1]", help=_RUN_OUT_HELP)]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files")]
ReportFile = Annotated[
    Path | None, typer.Option("--report", metavar="FILE", help="Write a report with pictures, .html or .pdf")
]


_RUNOUT_ORDERS = 32
"""Components of the run-out waveform per revolution: dents of a twentieth of the circumference."""


@dataclass(frozen=True)
class SceneChanges:
    """Changes of a run against its scene."""

    parameters: Parameters = None
    channels: ChannelFile = None
    changes: Changes = None
    law: Law = None
    engine: Engine = None
    duration_s: Annotated[float | None, typer.Option(help="Length of the run in s")] = None
    seed: Annotated[int | None, typer.Option(help="Seed of the sensor noise")] = None

    def overrides(self) -> dict[str, str]:
        """Return the changes by dotted key.

        Raises:
            InputError: A change is not of the form KEY=VALUE, or the law file is invalid.
        """
        overrides = parse_pairs("--set", self.changes, "KEY=VALUE, such as drive.speed_hz=5.2")
        if self.law is not None:
            from rig.run.law_file import read_law

            overrides |= {key: str(value) for key, value in read_law(self.law).changes().items()}
        named = {
            "parameters": self.parameters,
            "channels": self.channels,
            "engine.name": self.engine,
            "duration_s": self.duration_s,
            "seed": self.seed,
        }
        return overrides | {key: str(value) for key, value in named.items() if value is not None}


def split_names(text: str | None, option: str) -> list[str]:
    """Return the names of a comma-separated list, the value of an option; empty for None.

    Raises:
        InputError: The list is empty.
    """
    names = [name.strip() for name in (text or "").split(",") if name.strip()]
    if text is not None and not names:
        raise InputError(option, "one or more names, separated by commas", text)
    return names


def subtract_run_out(
    text: str | None, *recordings: Recording, show: Callable[[str], None], log: bool = False
) -> list[Recording]:
    """Return recordings without the run-out of a slow roll, and show what is subtracted.

    Args:
        text: Value of `--run-out`; None for none.
        recordings: The recordings.
        show: Function that shows a line.
        log: Whether they must be logs, as the model contains the run-out of a recording of this rig.

    Raises:
        InputError: The slow roll is not one of these probes, or one of them has no keyphasor.
    """
    if text is None:
        return [*recordings]
    from recorder.reader import join
    from replays.plots.signals import subtract_runout

    if log and (own := [one for one in recordings if "import" not in one.scene]):
        raise InputError("--run-out", "used with a log of another system", Words(str(own[0].path)))
    match = re.fullmatch(r"(.+?)(?::(\d+\.?\d*)-(\d+\.?\d*))?", text)
    if match is None:
        raise InputError("--run-out", "a recording, with times such as SLOW.mcap:1.5-9", text)
    from_s, to_s = (None if time is None else float(time) for time in match.groups()[1:])
    if from_s is not None and to_s is not None and from_s >= to_s:
        raise InputError("--run-out", "a recording, with ascending times such as SLOW.mcap:1.5-9", text)
    slow = join([Path(match[1])])
    corrected = [subtract_runout(one, slow, orders=_RUNOUT_ORDERS, from_s=from_s, to_s=to_s) for one in recordings]
    show(corrected[0].correction[0])
    return corrected


def parse_pairs(option: str, texts: list[str] | None, form: str) -> dict[str, str]:
    """Return the left and right sides of texts such as KEY=VALUE.

    Args:
        option: Name of the option, for errors.
        texts: Values of the option.
        form: Form of a text, for errors.

    Raises:
        InputError: A text has another form, or a left side occurs twice.
    """
    pairs: dict[str, str] = {}
    for text in texts or []:
        left, equals, right = (side.strip() for side in text.partition("="))
        if not (left and equals and right):
            raise InputError(option, form, text)
        if left in pairs:
            raise InputError(option, f"given once for {left}", text)
        pairs[left] = right
    return pairs


def override_parameters(
    name: str, changes: list[str] | None, also: dict[str, Any] | None = None, law: Path | None = None
) -> ParameterSet:
    """Return a parameter set with changes from the command line.

    Args:
        name: Name or path of the set.
        changes: Values of `--set`, each KEY=VALUE.
        also: Values by key from other options; they override `changes`.
        law: File of a contact law.

    Raises:
        InputError: The set or a key does not exist, or a value is invalid.
    """
    from rig.physics.parameters import load_parameters
    from rig.run.scenes import read_value

    values = {key: read_value(text) for key, text in SceneChanges(changes=changes, law=law).overrides().items()}
    return load_parameters(name).override(values | (also or {}), source="--set")
