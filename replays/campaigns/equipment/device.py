"""Device under test: a program that receives the addresses of its bench on the command line."""

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
"""Longest wait for a device's connection [s]."""
PLACES = ("url", "can", "name", "folder")
"""Placeholders of a command line that are filled in at the start."""


class Device:
    """A running device under test.

    Args:
        command: Command line. Placeholders: `{url}` (address of the rig), `{can}` (its address on the CAN bus),
            `{name}` (name of the device) and `{folder}` (folder for its files).
        name: Name of the device.
        bench: Bench that it is tested on.
        log: File for its output.
        where: Working directory.
        files: Folder for `{folder}`.

    Raises:
        InputError: If the program or a placeholder does not exist.
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
        self.rig_name = name
        """The rig's name for the device; a number on CAN."""
        self._others = bench.joined
        self.program = Program(words, log, folder=where)

    def wait_until_joined(self) -> None:
        """Wait until the device takes part in lockstep.

        Raises:
            BenchError: If it ends, or does not join in time.
        """
        self.rig_name = self._bench.wait_for_joined(
            lambda name: name not in self._others, self.name, look=self.check_running
        )

    def wait_until_linked(self, before: int) -> None:
        """Wait briefly until the rig has more connections than before; a device on a CAN bus never adds one.

        Args:
            before: Number of connections before the device was started.

        Raises:
            BenchError: If the device has ended.
        """
        for _ in Deadline(_LINK_S).polls():
            if self._bench.links > before:
                return
            self.check_running()

    def check_running(self) -> None:
        """Raise an error if the device has ended.

        Raises:
            BenchError: If it has.
        """
        if (status := self.program.status) is not None:
            raise BenchError(f"device {self.name} ended with status {status}: {self.program.last_line}")


def check_program(words: Sequence[str], where: Path, *, field: str) -> None:
    """Check that a command line names a program that can be run.

    Raises:
        InputError: If the program or its script does not exist.
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
