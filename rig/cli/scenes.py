"""`rig scenes`: what can be run."""

from __future__ import annotations

from typing import Annotated

import typer


def scenes(
    name: Annotated[str | None, typer.Argument(metavar="[SCENE]", help="Show this one in full.")] = None,
) -> None:
    """List the scenes that come with the rig, or show one with every field. Your own is a TOML file of that form."""
    import json

    from rich.console import Console
    from rich.table import Table

    from rig.scenes import load_scene, scene_document, scene_names

    if name is not None:
        typer.echo(json.dumps(scene_document(load_scene(name)), indent=2))
        return
    table = Table(box=None, header_style="bold")
    for heading in ("scene", "seconds", "what happens"):
        table.add_column(heading)
    for each in scene_names():
        scene = load_scene(each)
        table.add_row(each, f"{scene.duration_s:g}", scene.title)
    Console().print(table)
