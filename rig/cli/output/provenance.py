"""What a report is made by and of: the command as it was given, version, date, and what its subject tells of itself."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from recorder.reader import Recording

given: list[str] = []
"""Arguments of the command under way, as `rig.cli.app` was given them."""


def origin(**subject: object) -> dict[str, str]:
    """Lines for the head of a report, each by name.

    Args:
        subject: What it is of, by name; what is None is left out.
    """
    from replays.studies.common import provenance

    commit = provenance.commit()
    version = provenance.versions(provenance.RIG)[provenance.RIG] + (f", commit {commit}" if commit else "")
    return {
        **{name.replace("_", " "): str(value) for name, value in subject.items() if value is not None},
        "command": f"`{shlex.join(['rig', *given])}`",
        "made": f"{provenance.today()} by rig {version}",
    }


def of_recording(name: str, recording: Recording) -> dict[str, str]:
    """The same of a recording: its file, scene, parameter set and seed, as far as it tells them."""
    scene, parameters = recording.scene, recording.parameters
    return origin(file=name, scene=scene.get("name"), parameter_set=parameters.get("set"), seed=scene.get("seed"))
