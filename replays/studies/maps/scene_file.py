"""Scene files in TOML, from scenes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rig.base.files import write_file
from rig.run.scenes import Scene, scene_document


def write_scene(scene: Scene, path: Path) -> None:
    """Write a scene's fields that differ from their defaults.

    Raises:
        DiskError: The file cannot be written.
    """
    document = scene_document(scene)
    fields = {name: document[name] for name in scene.model_dump(exclude_defaults=True)}
    write_file(path, "".join(f"{key} = {_write(value)}\n" for key, value in fields.items()))


def _write(value: Any) -> str:
    if isinstance(value, dict):
        items = (f"{json.dumps(key)} = {_write(each)}" for key, each in value.items() if each is not None)
        return f"{{ {', '.join(items)} }}"
    if isinstance(value, list):
        return f"[{', '.join(_write(each) for each in value)}]"
    return json.dumps(value)
