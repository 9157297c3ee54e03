"""The rig's own documents in a file of `rig export`, used for the mapping of a later import."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from typing import Any, NamedTuple

from recorder.contents import documents
from replays.recordings.formats.source import DOCUMENTS, Source
from replays.recordings.resimulation.experiment import recorded_scene
from rig.base.text import printable
from rig.channels.table import Channel
from rig.run.commands.table import COMMANDS, check_command
from rig.run.scenes import Scene, load_scene, parse_scene, scene_names
from rig.run.simulation import TICK_RATE_HZ

_BASE_SCENE = "stable-run"
"""Scene that serves as the base if the recorded scene is not one of the rig's."""
_EXCLUDED = {"duration_s", "fidelity", "pick", "set", "commands", "channels", "sensors.groups", "sensors.rate_hz"}
"""Fields that an import determines, or that are handled separately."""


class Attachments(NamedTuple):
    """Content for a mapping from the rig's documents in a file.

    Attributes:
        channels: The rig's channels by name.
        experiment: Lines of the TOML table [experiment], without its heading; empty if unknown.
        doubt: Reason for a missing experiment although there are documents.
    """

    channels: Mapping[str, Channel] = {}
    experiment: tuple[str, ...] = ()
    doubt: str = ""


def read_attachments(source: Source) -> Attachments:
    """Return the documents that `rig export` attached to a file."""
    if set(source.documents) != set(DOCUMENTS):
        return Attachments()
    try:
        read = {
            kind: documents.read(model, source.documents[f"{kind}.json"].encode(), field=f"{kind}.json")
            for kind, model in documents.ATTACHED.items()
        }
        experiment = _experiment(read["scene"][0], read["parameters"][0], source)
    except (ValueError, TypeError) as error:  # including times of another type
        return Attachments(doubt=printable(str(error)))
    catalogue = read["catalogue"][1]
    assert isinstance(catalogue, documents.Catalogue)
    # The filters of imported recordings were only assumed.
    return Attachments({} if "import" in read["scene"][0] else catalogue.table.channels, tuple(experiment))


def _experiment(scene_document: dict[str, Any], recorded: dict[str, Any], source: Source) -> list[str]:
    if (document := scene_document.get("scene")) is None:
        return []
    scene = parse_scene(recorded_scene(recorded, document))
    name = scene.name if scene.name in scene_names() else _BASE_SCENE
    base = load_scene(name)
    lines = [f"scene = {_toml(name)}"]
    if changes := _changes(scene, base):
        lines.append(f"set = {_table(changes)}")
    sent = [
        {"at_s": one["tick"] / TICK_RATE_HZ, **check_command(one["command"], one["request"]).model_dump()}
        for one in scene_document.get("taken", ())
        if one["command"] in COMMANDS
    ]
    if sent or scene.commands != base.commands:
        own = [{"at_s": timed.at_s, **timed.request.model_dump()} for timed in scene.commands]
        commands = sorted([*own, *sent], key=lambda command: command["at_s"])
        lines += ["commands = [", *(f"    {_table(command)}," for command in commands), "]"]
    if lead_s := _first_s(source):
        lines.append(f"lead_s = {lead_s!r}    # time from the start of the scene to the first sample")
    return lines


def _changes(scene: Scene, base: Scene) -> dict[str, Any]:
    """Return the fields in which a scene differs from another, by dotted key."""
    ours, theirs = scene.model_dump(), base.model_dump()
    changes: dict[str, Any] = {}
    for key, value in ours.items():
        if key in _EXCLUDED:
            continue
        if isinstance(value, dict):
            other = {} if key == "engine" and value != theirs[key] else theirs[key]  # engines differ in step
            changes |= {f"{key}.{name}": each for name, each in value.items() if other.get(name) != each}
        elif value != theirs[key]:
            changes[key] = value
    before = load_scene(base, {"parameters": scene.parameters}).load_parameters().entries
    now = {key: entry.value for key, entry in scene.load_parameters().entries.items()}
    changes |= {key: value for key, value in now.items() if before[key].value != value}
    return {key: value for key, value in changes.items() if key not in _EXCLUDED}


def _first_s(source: Source) -> float:
    """Return the simulated time of the first sample [s]."""
    signal = source.read(source.entries[0])
    first_s = signal.first_s if signal.times_s is None else float(signal.times_s[0])
    if source.start is not None and (zero := source.about.get("start")) is not None:  # TDMS starts at its first sample
        first_s += (source.start - datetime.fromisoformat(zero)).total_seconds()
    return round(max(0.0, first_s), 9)


def _table(values: dict[str, Any]) -> str:
    return f"{{ {', '.join(f'{_toml(key)} = {_toml(value)}' for key, value in values.items())} }}"


def _toml(value: Any) -> str:
    # JSON texts, numbers, booleans and lists are valid TOML.
    return _table(value) if isinstance(value, dict) else json.dumps(value, ensure_ascii=False)
