"""Comparison of recorded parameters with the rig's own sets. Does not import the model, so `rig info` stays light."""

from __future__ import annotations

from recorder.reader import Recording
from rig.physics.parameters import load_parameters, set_names


def parameter_doubts(recording: Recording) -> tuple[str, ...]:
    """Return the parameters that differ from the rig's own set, although source, unit and scene are the same.

    A set that was revised since has another source; a user's set may be another file today.
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
