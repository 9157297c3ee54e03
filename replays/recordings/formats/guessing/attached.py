"""What a file of `rig export` says of the rig and of what was done, for a mapping to start from."""

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

_OTHERWISE = "stable-run"
"""The scene whose differences are told of one that does not come with the rig."""
_BY_IMPORT = {"duration_s", "fidelity", "pick", "set", "commands", "channels", "sensors.groups", "sensors.rate_hz"}
"""Fields that an import finds out, and those that are told otherwise."""


class Attached(NamedTuple):
    """What the rig's own documents in a file say for a mapping.

    Attributes:
        channels: The rig's channels by name.
        experiment: The table [experiment] in TOML, without its heading; empty where it is not told.
        doubt: Why it is not, where there are documents.
    """

    channels: Mapping[str, Channel] = {}
    experiment: tuple[str, ...] = ()
    doubt: str = ""


def attached(source: Source) -> Attached:
    """What `rig export` has attached to a file."""
    if set(source.documents) != set(DOCUMENTS):
        return Attached()
    try:
        read = {
            kind: documents.read(model, source.documents[f"{kind}.json"].encode(), field=f"{kind}.json")
            for kind, model in documents.ATTACHED.items()
        }
        experiment = _experiment(read["scene"][0], read["parameters"][0], source)
    except (ValueError, TypeError) as error:  # a time of another kind among them
        return Attached(doubt=printable(str(error)))
    catalogue = read["catalogue"][1]
    assert isinstance(catalogue, documents.Catalogue)
    # Of what the rig has imported, filters were assumed.
    return Attached({} if "import" in read["scene"][0] else catalogue.table.channels, tuple(experiment))


def _experiment(told: dict[str, Any], recorded: dict[str, Any], source: Source) -> list[str]:
    if (document := told.get("scene")) is None:
        return []
    scene = parse_scene(recorded_scene(recorded, document))
    name = scene.name if scene.name in scene_names() else _OTHERWISE
    base = load_scene(name)
    lines = [f"scene = {_toml(name)}"]
    if changes := _changes(scene, base):
        lines.append(f"set = {_table(changes)}")
    sent = [
        {"at_s": one["tick"] / TICK_RATE_HZ, **check_command(one["command"], one["request"]).model_dump()}
        for one in told.get("taken", ())
        if one["command"] in COMMANDS
    ]
    if sent or scene.commands != base.commands:
        own = [{"at_s": timed.at_s, **timed.request.model_dump()} for timed in scene.commands]
        commands = sorted([*own, *sent], key=lambda command: command["at_s"])
        lines += ["commands = [", *(f"    {_table(command)}," for command in commands), "]"]
    if lead_s := _first_s(source):
        lines.append(f"lead_s = {lead_s!r}    # its first sample lies so long behind the beginning of the scene")
    return lines


def _changes(scene: Scene, base: Scene) -> dict[str, Any]:
    """What a scene has otherwise than another, by dotted key."""
    ours, theirs = scene.model_dump(), base.model_dump()
    found: dict[str, Any] = {}
    for key, value in ours.items():
        if key in _BY_IMPORT:
            continue
        if isinstance(value, dict):
            other = {} if key == "engine" and value != theirs[key] else theirs[key]  # an engine brings its own step
            found |= {f"{key}.{name}": each for name, each in value.items() if other.get(name) != each}
        elif value != theirs[key]:
            found[key] = value
    before = load_scene(base, {"parameters": scene.parameters}).load_parameters().entries
    now = {key: entry.value for key, entry in scene.load_parameters().entries.items()}
    found |= {key: value for key, value in now.items() if before[key].value != value}
    return {key: value for key, value in found.items() if key not in _BY_IMPORT}


def _first_s(source: Source) -> float:
    """Simulated time of the first sample [s]."""
    signal = source.read(source.entries[0])
    first_s = signal.first_s if signal.times_s is None else float(signal.times_s[0])
    if source.start is not None and (zero := source.about.get("start")) is not None:  # TDMS begins at its first sample
        first_s += (source.start - datetime.fromisoformat(zero)).total_seconds()
    return round(max(0.0, first_s), 9)


def _table(values: dict[str, Any]) -> str:
    return f"{{ {', '.join(f'{_toml(key)} = {_toml(value)}' for key, value in values.items())} }}"


def _toml(value: Any) -> str:
    # JSON's texts, numbers, booleans and lists are TOML's too.
    return _table(value) if isinstance(value, dict) else json.dumps(value, ensure_ascii=False)
