"""Arguments and options that several commands take, each worded once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

SceneName = Annotated[str, typer.Argument(metavar="SCENE", help="Name of a scene, or the path of a scene file.")]
SetName = Annotated[str, typer.Argument(metavar="[SET]", help="A parameter set, by name or path.")]
Changes = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change one value; may be repeated.")
]
Parameters = Annotated[str | None, typer.Option(metavar="SET", help="Parameter set, by name or path.")]
Engine = Annotated[str | None, typer.Option(help="Integration method.")]
DurationS = Annotated[float | None, typer.Option(help="Length of the run, in s.")]
Seed = Annotated[int | None, typer.Option(help="Seed of the sensors' noise.")]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="FILE", help="Draw them as well, to a .png or .svg file.")]
Json = Annotated[bool, typer.Option("--json", help="As a JSON document.")]
