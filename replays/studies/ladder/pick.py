"""A pick in a scene's file: only the table [pick] is replaced or added, all else stays as its author wrote it."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

from rig.base.errors import InputError, Words
from rig.run.model_choice import Pick
from rig.run.scenes import Scene, load_scene, pick_digests, scene_path

_HEADER = re.compile(r"^\s*\[{1,2}\s*(?P<name>[^\]\[]+?)\s*\]{1,2}\s*(#.*)?$")
_COMMENT = '# Written by `rig ladder`: what it measured. In force where the scene says fidelity = "auto".'


def check_target(path: Path, scene_name: str, scene: Scene) -> None:
    """Check, before a long search, that a pick can be written into a file.

    Raises:
        InputError: It is no .toml file, or holds another scene than the one that is searched.
    """
    if path.suffix != ".toml":
        raise InputError("--write", "a .toml file", str(path))
    source = path if path.is_file() else scene_path(scene_name)
    if pick_digests(_as_given(source)) != pick_digests(scene):
        must = "the file of this very scene (changes by --set have to be in it)"
        raise InputError("--write", must, str(path))


def write_pick(path: Path, scene_name: str, pick: Pick) -> None:
    """Put a pick into a scene's file; a file that is not there yet becomes a copy of the scene's.

    Raises:
        InputError: The file cannot be edited safely.
    """
    source = path if path.is_file() else scene_path(scene_name)
    # newline="": line ends stay as they are.
    with source.open(encoding="utf-8", newline="") as file:
        old = file.read()
    new = with_pick(old, pick)
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(new)


def with_pick(text: str, pick: Pick) -> str:
    """A scene's text with the pick in it.

    Raises:
        InputError: Something else than the table would change.
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
            # Comments and blank lines behind its last entry are the next table's.
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
        raise InputError("--write", "a file whose [pick] stands in a table of its own", Words("text that hides it"))
    return new


def _is_loose(line: str) -> bool:
    return not line.strip() or (line.lstrip().startswith("#") and line.strip() != _COMMENT)


def pick_table(pick: Pick) -> str:
    """The pick as TOML, with a table for each quantity."""
    data = pick.model_dump(mode="json")
    quantities = data.pop("quantities")
    lines = ["[pick]", _COMMENT, *_entries(data)]
    for entry in quantities:
        lines += ["", "[[pick.quantities]]", *_entries(entry)]
    return "\n".join(lines) + "\n"


def _entries(data: dict[str, str | float | bool]) -> list[str]:
    # Words, numbers and truth are written alike in both languages.
    return [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in data.items()]


def _as_given(path: Path) -> Scene:
    return load_scene(path, {"fidelity": "given"})
