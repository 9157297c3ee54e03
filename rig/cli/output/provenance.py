"""Provenance of a report: the command line, version and date, and the subject's own details."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from recorder.reader import Recording

arguments: list[str] = []
"""Arguments of the running command, set by `rig.cli.app`."""


def origin(**subject: object) -> dict[str, str]:
    """Return the lines for the head of a report, by name.

    Args:
        subject: Details by name; None is left out.
    """
    from replays.studies.common import provenance

    commit = provenance.commit()
    version = provenance.versions(provenance.RIG)[provenance.RIG] + (f", commit {commit}" if commit else "")
    return {
        **{name.replace("_", " "): str(value) for name, value in subject.items() if value is not None},
        "command": f"`{shlex.join(['rig', *arguments])}`",
        "made": f"{provenance.today()} by rig {version}",
    }


def recording_origin(name: str, recording: Recording) -> dict[str, str]:
    """Return the lines for a recording: file, scene, parameter set and seed, as far as known."""
    scene, parameters = recording.scene, recording.parameters
    known = {"scene": scene.get("name"), "parameter set": parameters.get("set"), "seed": scene.get("seed")}
    return origin(file=name, **known, correction=recording.correction[0])
