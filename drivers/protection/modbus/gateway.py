"""Gateway between one rig after another at an address and the Modbus server."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event, Lock

import numpy as np

from drivers.client import Rig
from drivers.link import LinkTimeoutError
from drivers.protection.modbus.registers import Contents, RegisterMap
from drivers.sources.stream import RigStream
from rig.base.errors import RefusedError
from rig.serve.transport import Client, NoReplyError

_STALE_S = 1.0
"""Silence of a rig in real time after which its values are not live [s]."""


class Gateway:
    """Reads a rig, and executes the commands of the coils.

    Args:
        registers: Register map.
        settings: Set points, as of `Contents`.
    """

    def __init__(self, registers: RegisterMap, settings: dict[str, float]) -> None:
        self._map, self._settings = registers, settings
        self._contents = Contents(registers, settings)
        self._rig: Rig | None = None
        self._in_command = Lock()

    def command(self, name: str) -> None:
        """Execute a command: trip (speed 0), stop (end the run), reset (alarms).

        Raises:
            RefusedError: The rig refuses it.
            ConnectionError: There is no rig.
        """
        with self._in_command:
            if self._rig is None:
                raise NoReplyError("no rig")
            if name == "trip":
                self._rig.speed(0.0)
            elif name == "stop":
                self._rig.stop()
            else:
                for monitor in self._contents.monitors:
                    monitor.reset()

    def follow(
        self,
        client: Client,
        publish: Callable[[np.ndarray, list[bool]], object],
        stopped: Event,
        on_start: Callable[[], object],
    ) -> None:
        """Publish the contents of the registers from a rig's samples, to the end of its run.

        Args:
            client: Transport to the rig.
            publish: Receives values and bits.
            stopped: Ends it early.
            on_start: Called once all further samples will be received.

        Raises:
            RefusedError: The rig has another channel table than the map.
            EOFError: The run has ended.
            ConnectionError: The rig was lost.
        """
        if RigStream(client).table() != self._map.table:
            raise RefusedError("the rig has another channel table than at the start: restart `rig modbus`")
        contents = self._contents = Contents(self._map, self._settings)
        names = list(self._map.table.channels)
        with Rig(client, channels=names, name=f"modbus {id(client)}") as rig:
            self._rig = rig
            on_start()
            try:
                while not stopped.is_set():
                    try:
                        contents.feed(rig.daq.read(contents.rows_needed(rig.daq.rate_hz), timeout_s=_STALE_S))
                    except LinkTimeoutError:
                        if rig.pace != "lockstep":  # one that is not stepped is not lost
                            contents.invalidate()
                    publish(contents.values, contents.bits)
            finally:
                contents.invalidate()
                publish(contents.values, contents.bits)
                with self._in_command:
                    self._rig = None
