"""Twelve scenes for comparisons of speed and accuracy, so that no engine is tuned to one scene.

Each is a scene of the rig with changes, and a window from its start with a pointwise reference: in chaotic motion, the
window ends before neighbouring runs diverge. A test checks the motion described in each row. This module runs no
engine.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from rig.run.scenes import Scene, load_scene

_HAMMER_300_N = {"at_s": 0.02, "command": "hammer", "force_n": 300.0, "duration_ms": 5.0, "direction": "x"}


class StudyScene(NamedTuple):
    """Scene and its window."""

    name: str
    """Name in tables."""
    title: str
    """Name in a figure."""
    scene: str
    """Built-in scene that is changed."""
    window_s: float
    """End of the window [s]."""
    shows: str
    """Motion in the window."""
    changes: dict[str, Any]
    """Changes by dotted key, as `rig.run.scenes.load_scene` takes them."""

    def load(self) -> Scene:
        """Return the scene with its changes."""
        return load_scene(self.scene, self.changes)


_WHIRL = "impacts, then contact that rolls in backward whirl"
_ALL = (
    StudyScene("hammer-3.2", "hammer at 3.2 Hz", "hammer", 0.5, _WHIRL, {"drive.speed_hz": 3.2}),
    StudyScene("hammer-6.2", "hammer at 6.2 Hz", "hammer", 0.5, _WHIRL, {}),
    StudyScene("hammer-300-n", "hammer of 300 N", "hammer", 0.5, f"hard {_WHIRL}", {"commands": [_HAMMER_300_N]}),
    StudyScene("drop", "drop", "drop", 0.2, "impacts at the bottom of the ring, then contact that lasts", {}),
    StudyScene("run-up", "run-up", "run-up", 9.0, "no contact up to 9.6 Hz, then impacts", {}),
    StudyScene("partial-rub", "partial rub", "partial-rub", 0.3, "impacts; neighbouring runs part later", {}),
    StudyScene("stable-run", "stable run", "stable-run", 10.0, "no contact", {}),
    StudyScene(
        "low-preload",
        "preload of 300 N",
        "hammer",
        0.5,
        f"{_WHIRL}; transducers lose preload",
        {"house.preload": 300.0},
    ),
    StudyScene("ring-offset", "ring off by 0.4 mm", "hammer", 0.5, _WHIRL, {"ring.offset_x": 0.4}),
    StudyScene("smoothed", "smoothed friction", "hammer", 0.5, f"{_WHIRL}, and creeps", {"model.friction": "smoothed"}),
    StudyScene("restitution-0.3", "restitution 0.3", "hammer", 0.5, _WHIRL, {"contact.restitution": 0.3}),
    StudyScene("as-printed", "as-printed set", "hammer", 0.5, _WHIRL, {"parameters": "as-printed"}),
)
TWELVE_SCENES = {scene.name: scene for scene in _ALL}
"""The scenes by name."""
