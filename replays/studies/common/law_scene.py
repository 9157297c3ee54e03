"""Hammer scene with a user's contact law, added to the twelve scenes of the method comparison."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from replays.studies.common.twelve_scenes import TWELVE_SCENES, StudyScene
from rig.physics.model import build_model
from rig.run.law_file import read_law


def add_law_scene(path: Path) -> str:
    """Add the scene of a law file to the scenes on which this process compares methods.

    The scene's name contains a digest of the law, so that points of different laws are never mixed in a table.

    Args:
        path: The file (`rig.run.law_file`).

    Returns:
        The scene's name.

    Raises:
        InputError: If the file is not a law, or the model does not accept it.
    """
    law = read_law(path)
    mark = hashlib.sha256(json.dumps(law.changes(), sort_keys=True).encode()).hexdigest()[:6]
    scene = StudyScene(
        f"law-{path.stem}-{mark}", f"law: {law.title}", "hammer", 0.5, f"the contact law {law.title}", law.changes()
    )
    build_model(scene.load().load_parameters())
    others = dict(TWELVE_SCENES)
    TWELVE_SCENES.clear()
    TWELVE_SCENES.update({scene.name: scene} | others)  # first, as there may not be time for all scenes
    return scene.name
