"""`rig scenes`: what can be run."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.tables import echo, new_table, table_console


def scenes(
    name: Annotated[str | None, typer.Argument(metavar="[SCENE]", help="Show the file of this one.")] = None,
    *,
    json_output: Annotated[bool, typer.Option("--json", help="With every field, as a JSON document.")] = False,
) -> None:
    """List the scenes that come with the rig, or show one. Your own is a TOML file of the same form."""
    import json

    from rig.scenes import load_scene, scene_document, scene_names, scene_path

    if name is not None:
        scene = load_scene(name)
        text = json.dumps(scene_document(scene), indent=2) if json_output else scene_path(name).read_text("utf-8")
        echo(text.rstrip())
        return
    table = new_table("", "scene", "seconds", "what happens")
    for each in scene_names():
        scene = load_scene(each)
        table.add_row(each, f"{scene.duration_s:g}", scene.title)
    table_console().print(table)
