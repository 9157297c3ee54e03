"""`rig completion`: shell completion of commands, options, scenes, engines, keys of --set, and files.

The shell calls `rig __complete` with the line up to the cursor and receives one line per candidate: the word, a tab and
its meaning. A line that begins with a tab requests file names: with the listed suffixes if there are any, or folders
for a slash. The line is not parsed by the command itself; only the command's own module is imported.
"""

from __future__ import annotations

import inspect
import os
import re
import shlex
import tomllib
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from rig.base.errors import InputError, Words
from rig.base.text import printable
from rig.cli.command import Group
from rig.cli.output.tables import echo, echo_document

_SHELLS = ("bash", "zsh", "fish")
"""Shells that have a completion script next to this module."""
_RIG = Path(__file__).parents[2]
_ENDING = re.compile(r"(?<![\w.])\.[a-z][a-z0-9]+\b")
SCENE_KEYS = (
    *("duration_s", "seed", "parameters", "channels", "fidelity"),
    *("initial.position", "initial.x_mm", "initial.y_mm", "initial.magnets"),
    *("drive.mode", "drive.speed_hz", "drive.profile"),
    *("engine.name", "engine.step_us", "engine.tolerance", "engine.companion", "engine.rolling"),
    *("engine.limits.radius_um", "engine.limits.force_n", "engine.limits.frequency_hz"),
    *("engine.limits.angle_deg", "engine.limits.spin_angle_deg"),
    *("model.magnet", "model.shaft", "model.stator", "model.contact", "model.friction"),
    *("sensors.groups", "sensors.rate_hz", "sensors.truth_rate_hz", "sensors.noise", "sensors.chain"),
    *("generator.kind", "generator.amplitude", "generator.amplitude_v", "generator.offset", "generator.offset_v"),
    *("generator.phase_deg", "generator.delay_us", "generator.frequency_hz", "generator.frequencies"),
    *("generator.period_s", "generator.order", "generator.seed", "generator.crest", "generator.apart"),
    *("generator.file", "generator.channels"),
)
"""Fields of a scene that `--set` accepts, listed here because importing `rig.run.scenes` takes 0.5 s."""

Choices = Iterable[tuple[str, str]]


def completion(
    shell: Annotated[str | None, typer.Argument(metavar="[bash|zsh|fish]", help="Shell; default: $SHELL")] = None,
    *,
    install: Annotated[bool, typer.Option("--install", help="Install for every new shell of this user")] = False,
    remove: Annotated[bool, typer.Option("--remove", help="Remove what --install wrote")] = False,
) -> None:
    """Complete commands, options and names in a shell by Tab: `rig completion --install`, then open a new shell.

    Without --install it prints the script, for `source <(rig completion bash)` or another file.
    """
    shell = shell or Path(os.environ.get("SHELL", "")).name
    if shell not in _SHELLS:
        raise InputError("shell", "bash, zsh or fish", shell)
    if install and remove:
        raise InputError("--remove", "given without --install", Words("both"))
    script = Path(__file__).with_suffix(f".{shell}").read_text(encoding="utf-8")
    if not install and not remove:
        echo_document(script)
        return
    paths = _remove(shell) if remove else _install(shell, script)
    for path in paths:
        echo(f"{path} {'cleared' if remove else 'written'}")
    if install or not paths:
        echo(f"in a new {shell}, Tab completes rig commands" if install else f"nothing is installed for {shell}")


def _locate(shell: str) -> tuple[Path, Path | None, str]:
    """Return the path of the installed script, the shell's start file, and the line there that loads the script."""
    home = Path.home()
    if shell == "fish":
        return Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config") / "fish/completions/rig.fish", None, ""
    file = Path(os.environ.get("XDG_DATA_HOME") or home / ".local/share") / f"rig/completion.{shell}"
    begin = home / ".bashrc" if shell == "bash" else Path(os.environ.get("ZDOTDIR") or home) / ".zshrc"
    return file, begin, f"[ -r {shlex.quote(str(file))} ] && . {shlex.quote(str(file))}  # rig completion --install\n"


def _install(shell: str, script: str) -> list[Path]:
    """Write the script, and add a line to the shell's start file that loads it; return the files written."""
    file, begin, line = _locate(shell)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(script, encoding="utf-8")
    if begin is None or (begin.exists() and line in begin.read_text("utf-8", errors="replace")):
        return [file]
    line = f"\n{line}" if begin.exists() else line
    with begin.open("a", encoding="utf-8") as out:
        out.write(line)
    return [file, begin]


def _remove(shell: str) -> list[Path]:
    """Remove the script, and the line from the start file; return the files that were changed or removed."""
    file, begin, line = _locate(shell)
    changed = [file] if file.exists() and f"__complete {shell}" in file.read_text("utf-8", errors="replace") else []
    for script in changed:
        script.unlink()
    with suppress(OSError):
        file.parent.rmdir()  # if it is empty
    found = begin.read_bytes() if begin is not None and begin.exists() else b""
    left = found.removesuffix(b"\n" + line.encode()).replace(line.encode() or b"\0", b"")
    if begin is None or left == found:
        return changed
    if found == line.encode():  # the installation has created it
        begin.unlink()
    else:
        with begin.open("r+b") as out:  # not replaced: keeps its mode and links, and needs no room on the disk
            out.write(left)
            out.truncate()
    return [*changed, begin]


def complete(root: Group, shell: str, line: str) -> list[str]:
    """Return the candidates for the end of a line, in the format of the shell scripts.

    Args:
        root: The command line.
        shell: Name of the shell.
        line: The line up to the cursor, beginning with the program's name.
    """
    *before, start = _words(line)
    command, option, place = _reached(root, before[1:])
    if command is None:
        return []
    name, equals, value = start.partition("=")
    head = ""
    if option is None and start.startswith("--") and equals:
        option, start, head = _options(command).get(name), value, name + "="
    if option is None and start.startswith("-"):
        candidates = [(name, param.help or "") for name, param in _options(command).items() if name.startswith("--")]
    elif option is None and isinstance(command, Group):
        candidates = [each for commands in command.sections.values() for each in commands.items()]
    else:
        arguments = [param for param in command.params if param.param_type_name == "argument"]
        if arguments and arguments[-1].nargs == -1:
            place = min(place, len(arguments) - 1)
        param = option or next(iter(arguments[place:]), None)
        candidates = [] if param is None else list(_values(command, param, start))
    # In a word with = or :, bash replaces only the part after the last one.
    cut = max(start.rfind("="), start.rfind(":")) + 1 if shell == "bash" else 0
    head = "" if shell == "bash" else head
    fit = [each for each in candidates if not each[0] or each[0].startswith(start)]
    fit = [] if [word for word, _ in fit] == [start] != [""] else fit  # the word is complete
    return [f"{word and head + word[cut:]}\t{printable(says)}" for word, says in fit]


def _reached(root: Group, words: list[str]) -> tuple[Any, Any, int]:
    """Return the command that the words lead to, its option that waits for a value, and the number of arguments."""
    command, option, place = root, None, 0
    for word in words:
        if option is not None:
            option = None
        elif word.startswith("-") and word != "-":
            named = _options(command).get(word.partition("=")[0])
            option = None if named is None or named.is_flag or "=" in word else named
        elif not isinstance(command, Group):
            place += 1
        elif word in command.list_commands(None):
            command = command.get_command(None, word)
        else:
            return None, None, 0
    return command, option, place


def _words(line: str) -> list[str]:
    """Return the words of a line that may end inside a word; the last one is to be completed."""
    reader = shlex.shlex(line, posix=True)
    reader.whitespace_split, reader.commenters = True, ""
    words: list[str] = []
    try:
        words += reader
    except ValueError:  # the line ends inside quotes
        return [*words, reader.token]
    return words if line[-1:].strip() else [*words, ""]


def _options(command: Any) -> dict[str, Any]:
    params = [*command.params, command.get_help_option(typer.Context(command, help_option_names=["--help", "-h"]))]
    return {name: param for param in params for name in (*param.opts, *param.secondary_opts) if name.startswith("-")}


def _values(command: Any, param: Any, start: str) -> Choices:
    """Yield the values that a parameter accepts, with their meanings; for files, an empty value and the suffixes."""
    metavar = param.metavar or ""
    kind = metavar.strip("[]").rstrip(".")
    if "|" in kind:
        return [(word, "") for word in kind.split("|") if not word.isupper()]
    if kind in _NAMES:
        names = list(_NAMES[kind](start))
        own_file = kind in ("SCENE", "SET") and not any(name.startswith(start) for name, _ in names)
        return [("", ".toml")] if own_file else names
    hint = str(get_args(inspect.signature(command.callback).parameters[param.name].annotation)[0])
    if "pathlib.Path" in hint:
        return [("", "/" if kind in ("DIR", "FOLDER") else " ".join(_ENDING.findall(f"{metavar} {param.help}")))]
    return [(item.value, "") for item in param.shell_complete(typer.Context(command), "")]


def _titled(folder: str) -> Callable[[str], Choices]:
    def names(start: str) -> Choices:
        for path in sorted((_RIG / folder).glob("*.toml")):
            yield path.stem, tomllib.loads(path.read_text("utf-8"))["title"]

    return names


def _engines(start: str) -> Choices:
    from rig.physics.engines import ENGINES

    return [(name, method.title) for name, method in ENGINES.items()]


def _keys(start: str) -> Choices:
    document = tomllib.loads((_RIG / "physics/sets/corrected.toml").read_text("utf-8"))
    parameters = {
        f"{part}.{name}": entry
        for part, entries in document.items()
        if isinstance(entries, dict)
        for name, entry in entries.items()
    }
    key = start.partition("=")[0]
    if key == "engine.name":
        return [(f"{key}={name}", says) for name, says in _engines(start)]
    if key in parameters:
        return [(f"{key}={rule}", "") for rule in parameters[key].get("rules", ())]
    return [
        *((f"{name}=", f"{entry['unit']}, {entry['source']}") for name, entry in parameters.items()),
        *((f"{name}=", "scene field") for name in SCENE_KEYS),
    ]


def _channels(start: str) -> Choices:
    document = tomllib.loads((_RIG / "channels/channels.toml").read_text("utf-8"))
    return [(each["name"], each["label"]) for group in document["groups"].values() for each in group["channels"]]


def _list_of(names: Callable[[str], Choices]) -> Callable[[str], Choices]:
    """Return a completer of comma-separated names."""

    def joined(start: str) -> Choices:
        head = start[: start.rfind(",") + 1]
        given_names = head.split(",")
        return [(head + name, says) for name, says in names(start) if name not in given_names]

    return joined


_NAMES: dict[str, Callable[[str], Choices]] = {
    "SCENE": _titled("run/scenes"),
    "SET": _titled("physics/sets"),
    "ENGINE": _engines,
    "ENGINE,": _list_of(_engines),
    "KEY=VALUE": _keys,
    "KEY,": _list_of(lambda start: [(name.rstrip("="), says) for name, says in _keys("")]),
    "NAME,": _list_of(_channels),
}
"""Completers by the metavar of the help."""
