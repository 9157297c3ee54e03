"""Pick in a scene file: the table [pick] is replaced or added, and the rest of the file stays unchanged."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

from rig.base.checks import TOML_BYTES
from rig.base.errors import InputError, Words
from rig.base.files import read_file, write_file
from rig.run.model_choice import Pick
from rig.run.scenes import Scene, load_scene, pick_digests, scene_path

_HEADER = re.compile(r"^\s*\[{1,2}\s*(?P<name>[^\]\[]+?)\s*\]{1,2}\s*(#.*)?$")
_COMMENT = '# Written by `rig ladder`: what it measured. In force where the scene says fidelity = "auto".'


def check_target(path: Path, scene_name: str, scene: Scene) -> None:
    """Check, before a long search, that a pick can be written to a file.

    Raises:
        InputError: If it is not a .toml file, or holds another scene than the one of the search.
    """
    if path.suffix != ".toml":
        raise InputError("--write", "a .toml file", str(path))
    source = path if path.is_file() else scene_path(scene_name)
    if pick_digests(_load_scene(source)) != pick_digests(scene):
        must = "the file of the same scene (it must contain the changes by --set)"
        raise InputError("--write", must, str(path))


def write_pick(path: Path, scene_name: str, pick: Pick) -> None:
    """Write a pick to a scene file; a file that does not exist becomes a copy of the scene's file.

    Raises:
        InputError: If the file cannot be edited safely.
    """
    source = path if path.is_file() else scene_path(scene_name)
    old = read_file(source, TOML_BYTES).decode()  # with its line endings
    new = with_pick(old, pick)
    write_file(path.resolve(), new)  # a link to the scene is kept


def with_pick(text: str, pick: Pick) -> str:
    """Return a scene's text with the pick.

    Raises:
        InputError: If anything outside the table would change.
    """
    tables: list[tuple[str, list[str]]] = [("", [])]
    for line in text.splitlines():
        if header := _HEADER.match(line):
            name = header["name"].split(".")[0].strip().strip("\"'")
            tables += [(name, [])] if name != tables[-1][0] else []
        tables[-1][1].append(line)
    before: list[str] = []
    after: list[str] = []
    kept = before
    for name, lines in tables:
        if name == "pick":
            # Comments and blank lines after the last entry belong to the next table.
            last = max(n for n, line in enumerate(lines) if not _is_loose(line))
            kept, lines = after, lines[last + 1 :]
        kept += lines
    parts = ["\n".join(before).rstrip("\n"), pick_table(pick).rstrip("\n"), "\n".join(after).lstrip("\n")]
    if tables[-1][0] == "pick":
        parts[-1] = parts[-1].rstrip("\n")
    new = ("\n\n".join(part for part in parts if part) + "\n").replace("\n", "\r\n" if "\r\n" in text else "\n")
    old_data = tomllib.loads(text)
    old_data.pop("pick", None)
    try:
        new_data = tomllib.loads(new)
    except tomllib.TOMLDecodeError:
        new_data = {}
    if new_data.pop("pick", None) is None or old_data != new_data:
        raise InputError("--write", "a file with [pick] as a table of its own", Words("another form of the table"))
    return new


def _is_loose(line: str) -> bool:
    return not line.strip() or (line.lstrip().startswith("#") and line.strip() != _COMMENT)


def pick_table(pick: Pick) -> str:
    """Return the pick as TOML, with a table for each quantity."""
    data = pick.model_dump(mode="json")
    quantities = data.pop("quantities")
    lines = ["[pick]", _COMMENT, *_entries(data)]
    for entry in quantities:
        lines += ["", "[[pick.quantities]]", *_entries(entry)]
    return "\n".join(lines) + "\n"


def _entries(data: dict[str, str | float | bool]) -> list[str]:
    # JSON and TOML write strings, numbers and booleans in the same way.
    return [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in data.items()]


def _load_scene(path: Path) -> Scene:
    return load_scene(path, {"fidelity": "given"})
