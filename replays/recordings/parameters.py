"""Recorded parameters against the rig's own sets; imports no model, for `rig info` in the install without it."""

from __future__ import annotations

from recorder.reader import Recording
from rig.physics.parameters import load_parameters, set_names


def parameter_doubts(recording: Recording) -> tuple[str, ...]:
    """Return the parameters that differ from a set of the rig's own, of the same source, and that no scene changes.

    A set that was revised since tells another source; a user's set may be another file by now.
    """
    document, name = recording.scene.get("scene"), recording.parameters.get("set")
    if not isinstance(document, dict) or name not in set_names():
        return ()
    now, changes = load_parameters(name).entries, document.get("set", {})
    return tuple(
        f"{key}: {entry['value']} in parameters.json but {now[key].value} in the set {name}, of the same source"
        for key, entry in recording.parameters["values"].items()
        if key in now
        and key not in changes
        and entry["value"] != now[key].value
        and (entry.get("source"), entry.get("unit")) == (now[key].source, now[key].unit)
    )
