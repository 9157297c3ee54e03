"""`rig scenes`: the scenes that can be run."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.output.tables import Form, echo_document, echo_json, new_table


def scenes(
    name: Annotated[str | None, typer.Argument(metavar="[SCENE]", help="Show the file of this scene")] = None,
    *,
    form: Form,
) -> None:
    """List the built-in scenes, or show one. Your own scene is a TOML file of the same form."""
    from rig.run.scenes import load_scene, scene_document, scene_names, scene_path

    if name is not None:
        scene = load_scene(name)
        if form.as_json:
            echo_json(scene_document(scene))
        else:
            echo_document(scene_path(name).read_text("utf-8").rstrip() + "\n")
        return
    scenes = {each: load_scene(each) for each in scene_names()}
    if form.as_json:
        echo_json({each: scene_document(scene) for each, scene in scenes.items()})
        return
    table = new_table("", "scene", ">seconds", "what happens", wrapped=["what happens"])
    for each, scene in scenes.items():
        table.add_row(each, f"{scene.duration_s:g}", scene.title)
    form.console().print(table)
