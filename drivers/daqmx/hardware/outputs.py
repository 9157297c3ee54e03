"""Outputs of the device: digital lines and a set point that send commands to the rig."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from drivers.console import Console
from drivers.daqmx.hardware.device import OUTPUT_LINES
from drivers.daqmx.hardware.errors import Code, DaqmxError
from rig.base.errors import InputError, RefusedError
from rig.channels.table import Channel


class Outputs:
    """States of the outputs, shared by all tasks.

    Args:
        console: Console of the rig; None: the outputs are reserved, as commands are not allowed.
        speed: Row of the channel table of the speed, whose sensitivity scales the set point.
    """

    def __init__(self, console: Console | None, speed: Channel | None) -> None:
        self._console = console
        self._speed = speed
        self._lock = threading.Lock()
        self.lines = dict.fromkeys(OUTPUT_LINES, False)
        """State of each line."""

    def check(self) -> Console:
        """Return the console of the rig.

        Raises:
            DaqmxError: Commands are not allowed.
        """
        if self._console is None:
            raise DaqmxError(
                Code.RESOURCE_ALREADY_RESERVED, "outputs command the rig; start `rig daqmx` with --allow-commands"
            )
        return self._console

    def set_lines(self, *samples: dict[str, bool]) -> None:
        """Set lines, sample after sample; rising edges send the command of their line, once for all samples.

        Raises:
            DaqmxError: The rig refused a command; the others were sent.
        """
        self.check()
        commands: dict[Callable[[Console], Any], None] = {}
        failures: list[DaqmxError] = []
        with self._lock:
            for line, state in (item for states in samples for item in states.items()):
                if state and not self.lines[line] and (command := OUTPUT_LINES[line]) is not None:
                    commands[command] = None
                self.lines[line] = state
            for command in commands:
                try:
                    self._command(command)
                except DaqmxError as error:
                    failures.append(error)
        if failures:
            raise failures[0]

    def set_volts(self, volts: float) -> None:
        """Set the speed set point by its voltage, on the scale of the speed channel.

        Raises:
            DaqmxError: The rig refused it.
        """
        assert self._speed is not None
        hertz = (volts - self._speed.bias_v) / self._speed.sensitivity_v
        with self._lock:
            self._command(lambda console: console.speed(hertz))

    def _command(self, command: Callable[[Console], Any]) -> None:
        try:
            command(self.check())
        except (RefusedError, InputError) as error:
            raise DaqmxError(Code.INVALID_AO_DATA_WRITE, f"the rig refused the command: {error}") from None
