"""A device under test: a program that is started with the addresses of its bench."""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from replays.campaigns.equipment.bench import Bench, BenchError
from replays.campaigns.equipment.process import Program
from rig.base.errors import InputError
from rig.serve.waiting import Deadline

_LINK_S = 10.0
"""Longest that is waited for a device's link [s]."""
PLACES = ("url", "can", "name", "folder")
"""What stands between braces in a command, and is filled in when it is started."""


class Device:
    """A device under test that runs.

    Args:
        command: Its command line, with places as `{url}`: where the rig is, `{can}`: the same on its CAN bus, `{name}`:
            what it calls itself, `{folder}`: where it may leave files.
        name: What it is called.
        bench: What it is tested on.
        log: File for its output.
        where: Folder that it works in.
        files: Folder for `{folder}`.

    Raises:
        InputError: There is no such program or place.
    """

    def __init__(
        self, command: str | Sequence[str], *, name: str, bench: Bench, log: Path, where: Path, files: Path
    ) -> None:
        places = {"url": bench.url, "can": bench.can_url or "", "name": name, "folder": str(files)}
        words = shlex.split(command) if isinstance(command, str) else list(map(str, command))
        for place in places:
            words = [word.replace(f"{{{place}}}", places[place]) for word in words]
        check_program(words, where, field="command")
        self.name, self.log, self._bench = name, log, bench
        self.joined_as = name
        """What the rig calls it, which over CAN is a number."""
        self._others = bench.joined
        self.program = Program(words, log, folder=where)

    def wait_until_joined(self) -> None:
        """Wait until it takes part in lockstep.

        Raises:
            BenchError: It ended, or does not in time.
        """
        self.joined_as = self._bench.first_joined(
            lambda name: name not in self._others, self.name, look=self.check_running
        )

    def wait_until_linked(self, before: int) -> None:
        """Wait until there is one link more to the rig than before; not for long, as on a CAN bus it has none.

        Raises:
            BenchError: It has ended.
        """
        for _ in Deadline(_LINK_S).polls():
            if self._bench.links > before:
                return
            self.check_running()

    def check_running(self) -> None:
        """Refuse one that has ended.

        Raises:
            BenchError: It has.
        """
        if (status := self.program.status) is not None:
            raise BenchError(f"device {self.name} ended with status {status}: {self.program.last_line}")


def check_program(words: Sequence[str], where: Path, *, field: str) -> None:
    """Refuse a command line without a program that can be run.

    Raises:
        InputError: It has none, or its script is not there.
    """
    if not words:
        raise InputError(field, "a command line", "")
    beside = str(Path(sys.executable).parent)
    found = shutil.which(words[0]) or shutil.which(words[0], path=beside) or (where / words[0]).is_file()
    if not found:
        raise InputError(field, "a program that there is", words[0])
    scripts = [word for word in words[1:2] if word.endswith(".py")]
    if scripts and not (where / scripts[0]).is_file():
        raise InputError(field, "a program whose script is there", scripts[0])
