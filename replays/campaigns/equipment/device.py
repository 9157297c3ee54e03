"""Device under test: a program that receives the addresses of its bench on the command line."""

from __future__ import annotations

import contextlib
import hashlib
import re
import shlex
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from replays.campaigns.equipment.bench import Bench, BenchError
from replays.campaigns.equipment.process import Program
from replays.campaigns.measurement import split_quantity
from rig.base import units
from rig.base.errors import InputError, such_as
from rig.base.files import open_file
from rig.serve.waiting import Deadline

PLACEHOLDER = re.compile(r"\{\{|\}\}|\{(\w+)(?::([^{}]*))?\}|[{}]")
"""A placeholder, an escaped brace, or a single brace."""
_LINK_S = 10.0
"""Longest wait for a device's connection [s]."""
PLACES = ("url", "can", "socketcand", "slcan", "daqmx", "name", "folder")
"""Placeholders of a command line that are filled in at the start."""
CAN_PLACES = ("can", "socketcand", "slcan")
"""Placeholders that need a CAN bus."""


class Device:
    """A running device under test.

    Args:
        command: Command line. Placeholders: `{url}` (address of the rig), `{can}` (its address on the CAN bus),
            `{socketcand}` (HOST:PORT of its socketcand server), `{slcan}` (path of its SLCAN adapter), `{daqmx}` (port
            of its NI-DAQmx server), `{name}` (name of the device) and `{folder}` (folder for its files).
        name: Name of the device.
        may_end: Whether it may end before the run.
        bench: Bench that it is tested on.
        log: File for its output.
        where: Working directory.
        files: Folder for `{folder}`.

    Raises:
        InputError: If the program or a placeholder does not exist.
    """

    def __init__(
        self, command: str | Sequence[str], *, name: str, bench: Bench, log: Path, where: Path, files: Path,
        may_end: bool = False,
    ) -> None:  # fmt: skip
        words = shlex.split(command) if isinstance(command, str) else list(map(str, command))
        daqmx = bench.serve_daqmx() if any("{daqmx}" in word for word in words) else None
        given = (bench.url, bench.can_url, bench.socketcand_url, bench.slcan_path, daqmx, name, str(files))
        places = {place: text for place, text in zip(PLACES, given, strict=True) if text is not None}
        words = [fill_placeholders(word, places, "command") for word in words]
        check_program(words, where, field="command")
        self.name, self.log, self.folder, self.may_end, self.bench = name, log, files, may_end, bench
        program = shutil.which(words[0], path=str(Path(sys.executable).parent)) or shutil.which(words[0])
        script = next((where / word for word in words[1:3] if (where / word).is_file()), where / words[0])
        self._program_files = [file for file in (where / words[0], script, Path(program or words[0])) if file.is_file()]
        self.digests = hash_files(self._program_files)
        """SHA-256 of the program and the script of the command line before the start, by name."""
        self.changed_digests: dict[str, str] = {}
        """SHA-256 after the run, or "removed", of those that changed during it, by name."""
        self.joins = True
        """Whether the rig waits for it in lockstep."""
        self.is_ended_by_test = self.was_lost = self.has_ended_early = False
        """True if the test ended it, if it was lost before that, and if it ended before the run by itself."""
        self.rig_name = name
        """The rig's name for the device; a number on CAN."""
        self._others = bench.joined
        self.program = Program(words, log, folder=where, end_s=bench.settings.wait.end_s)
        self.program.before_end = self._note_loss

    def _note_loss(self) -> None:
        self.was_lost = self.rig_name in self.bench.lost
        self._note_changes()

    def _note_changes(self) -> None:
        now = hash_files(self._program_files)
        self.changed_digests = {
            name: now.get(name, "removed") for name, digest in self.digests.items() if now.get(name) != digest
        }

    def end(self) -> None:
        """End the program after the test, unless the test has ended it."""
        self.is_ended_by_test, self.program.is_ended = self.program.is_ended, True
        self.program.end()
        if not self.is_ended_by_test:
            self._note_changes()

    def wait_until_joined(self) -> None:
        """Wait until the device takes part in lockstep.

        Raises:
            BenchError: If it ends, or does not join in time.
        """
        self.rig_name = self.bench.wait_for_joined(
            lambda name: name not in self._others, self.name, look=self.check_running
        )

    def wait_until_linked(self, before: int) -> None:
        """Wait briefly until the rig has more connections than before, or until a task of NI-DAQmx runs.

        A device on a CAN bus never adds a connection.

        Args:
            before: Number of connections before the device was started.

        Raises:
            BenchError: If the device has ended.
        """
        for _ in Deadline(_LINK_S).polls():
            if self.bench.daqmx_runs or (self.bench.daqmx_runs is None and self.bench.links > before):
                return
            self.check_running()

    def check_running(self) -> None:
        """Raise an error if the device has ended.

        Raises:
            BenchError: If it has.
        """
        if (status := self.program.status) is not None:
            raise BenchError(f"device {self.name} ended with status {status}: {self.program.last_line}")


def hash_files(files: Iterable[Path]) -> dict[str, str]:
    """Return the SHA-256 digests of files by name, without those that cannot be read."""
    digests = {}
    for file in files:
        with contextlib.suppress(OSError), open_file(file) as opened:
            digests[file.name] = hashlib.file_digest(opened, "sha256").hexdigest()
    return digests


def fill_placeholders(text: str, places: Mapping[str, str], field: str, kept: Sequence[str] = ()) -> str:
    """Fill in the placeholders of a text: `{danger}`, or `{danger:um}` as a number in um without its unit.

    `{{` and `}}` are braces of the text. If placeholders are kept, so are these, and the result can be filled again.

    Raises:
        InputError: If a brace or a placeholder is invalid.
    """

    def fill(match: re.Match[str]) -> str:
        name, unit = match[1], match[2]
        if name is None:
            if len(match[0]) == 2:
                return match[0] if kept else match[0][0]
            must = f"a text with {', '.join(f'{{{place}}}' for place in (*places, *kept)) or 'no placeholder'}, "
            raise InputError(field, f"{must}and {{{{ or }}}} for a brace", text)
        if name in kept:
            return match[0]
        if name not in places:
            raise InputError(field, such_as("a text with known names in braces", name, [*places, *kept]), match[0])
        found = places[name] if unit is None else _convert(name, places[name], unit, match[0], field)
        return found.replace("{", "{{").replace("}", "}}") if kept else found

    return PLACEHOLDER.sub(fill, text)


def _convert(name: str, text: str, unit: str, placeholder: str, field: str) -> str:
    number, own = split_quantity(text, field=field)
    if units.get_quantity(own) != units.get_quantity(unit) or not units.get_quantity(unit):
        raise InputError(field, f"with {name} in a unit of {units.get_quantity(own) or own}", placeholder)
    return f"{number * units.size_si(own) / units.size_si(unit):.12g}"


def check_program(words: Sequence[str], where: Path, *, field: str) -> None:
    """Check that a command line names a program that can be run.

    Raises:
        InputError: If the program or its script does not exist.
    """
    if not words:
        raise InputError(field, "a command line", "")
    beside = str(Path(sys.executable).parent)
    program = shutil.which(words[0]) or shutil.which(words[0], path=beside) or (where / words[0]).is_file()
    if not program:
        raise InputError(field, f"a program in PATH, or a file relative to {where.absolute()}", words[0])
    scripts = [word for word in words[1:2] if word.endswith(".py")]
    if scripts and not (where / scripts[0]).is_file():
        raise InputError(field, f"a program with a script that exists in {where.absolute()}", scripts[0])
