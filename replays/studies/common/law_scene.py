"""The hammer scene with a user's contact law, in addition to the twelve scenes that methods are compared on."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from replays.studies.common.twelve_scenes import TWELVE_SCENES, StudyScene
from rig.physics.law_file import read_law
from rig.physics.model import build_model


def add_law_scene(path: Path) -> str:
    """Add the scene of a law's file to those that this process compares methods on.

    Its name has a digest of the law, so that a table never takes points of one law for those of another.

    Args:
        path: The file (`rig.physics.law_file`).

    Returns:
        The scene's name.

    Raises:
        InputError: The file is no law, or the model does not take it.
    """
    law = read_law(path)
    mark = hashlib.sha256(json.dumps(law.changes(), sort_keys=True).encode()).hexdigest()[:6]
    scene = StudyScene(
        f"law-{path.stem}-{mark}", f"law: {law.title}", "hammer", 0.5, f"the contact law {law.title}", law.changes()
    )
    build_model(scene.load().load_parameters())
    others = dict(TWELVE_SCENES)
    TWELVE_SCENES.clear()
    TWELVE_SCENES.update({scene.name: scene} | others)  # the first, as there may not be time for all
    return scene.name
