"""Devices under test that a run in lockstep waits for, block by block."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any, Protocol

from rig.base.errors import InputError

_MAX_DEVICES = 64
"""Devices kept for the status. The devices lost first are removed first."""


class Said(Protocol):
    """A request of a client, with the name that the client gives itself."""

    command: str
    sender: str


@dataclass(slots=True)
class _Device:
    patience_s: float
    tick: int
    """End of the last block that it has finished."""
    lost: str | None = None
    since_s: float = 0.0
    """When it last had to wait for others, if after the end of the block [s, monotonic]."""


class Devices:
    """The devices that have joined a run, and the last block that each has finished; for one thread, except `rows`.

    After each block the run waits for all joined devices, so a device can only lack the last block.
    """

    def __init__(self) -> None:
        self._devices: dict[str, _Device] = {}
        self.rows: tuple[Mapping[str, Any], ...] = ()
        """Rows for the status, readable from any thread: name, state (joined, lost), tick and reason of each device."""
        self.lost: dict[str, str] = {}
        """Removed devices that were not yet reported, with the reasons."""

    def __bool__(self) -> bool:
        """Return whether any joined device is not lost."""
        return any(device.lost is None for device in self._devices.values())

    def join(self, name: str, patience_s: float, tick: int) -> None:
        """Add a device, which the run waits for from this tick.

        Raises:
            InputError: The name is in use, or there are too many devices.
        """
        if name in self._devices and self._devices[name].lost is None:
            raise InputError("join.device", "a name under which no other device has joined", name)
        self._devices.pop(name, None)
        while len(self._devices) >= _MAX_DEVICES:
            gone = next((other for other, device in self._devices.items() if device.lost is not None), None)
            if gone is None:
                raise InputError("join.device", f"one of at most {_MAX_DEVICES} devices", name)
            del self._devices[gone]
        self._devices[name] = _Device(patience_s, tick)
        self._tell()

    def done(self, name: str, tick: int | None, end: int, said: str) -> str | None:
        """Record that a device has finished a block.

        Args:
            name: The device.
            tick: End of the block according to the device; None if the block does not exist.
            end: End of the last block.
            said: The device's message, for the error.

        Returns:
            The reason if the device was removed for a wrong tick; otherwise None.

        Raises:
            InputError: The device has not joined.
        """
        device = self._joined("done", name)
        if tick is None or tick not in (device.tick, end):
            return self._put_out(name, f"it was done with {said}; the block that it was given ends at tick {end}")
        device.tick = max(tick, device.tick)
        self._tell()
        return None

    def leave(self, name: str) -> None:
        """Remove a device; the run no longer waits for it.

        Raises:
            InputError: The device has not joined.
        """
        self._joined("leave", name)
        del self._devices[name]
        self._tell()

    def behind(self, end: int) -> list[str]:
        """Return the devices that have not finished the block that ends at a tick."""
        return [name for name, device in self._devices.items() if device.lost is None and device.tick < end]

    def first_due(self, waiting: Sequence[Said], end: int) -> int | None:
        """Return the index of the first request that can be handled; None if all must wait.

        The order of two devices must not depend on chance: a device's command is handled once all devices before it by
        name have finished the block that ends at `end`. Its own `done` is handled after its commands.
        """
        behind = self.behind(end)
        for place, said in enumerate(waiting):
            own = self._devices.get(said.sender)
            if said.command == "done":
                waits = any(before.sender == said.sender for before in waiting[:place])
            else:
                waits = own is not None and own.lost is None and any(other < said.sender for other in behind)
            if not waits:
                return place
        return None

    def put_out_late(self, end: int, since_s: float, now_s: float, waiting: Set[str]) -> tuple[dict[str, str], float]:
        """Remove the devices that have not finished in time the block that ends at a tick.

        Args:
            end: That tick.
            since_s: When the devices were notified of the end of the block [s].
            now_s: Current time [s].
            waiting: Devices that wait for others; their time has not begun.

        Returns:
            The reasons by name, and the time until the next device is late [s].
        """
        late, left_s = dict[str, str](), math.inf
        for name in self.behind(end):
            device = self._devices[name]
            if name in waiting:
                device.since_s = now_s
            left = device.patience_s - (now_s - max(since_s, device.since_s))
            if left <= 0.0:
                within = f"within {device.patience_s:g} s"
                late[name] = self._put_out(name, f"it was not done with the block that ends at tick {end} {within}")
            else:
                left_s = min(left_s, left)
        return late, left_s

    def told(self, over: int, since_s: float, now_s: float) -> list[dict[str, Any]]:
        """Return the rows for the status, with the time that each joined device is late [s]; from any thread.

        Args:
            over: Last block end that the devices were notified of [ticks].
            since_s: When they were notified [s].
            now_s: Current time [s].
        """
        return [
            {**row, "behind_s": round(now_s - since_s, 3) if row["reason"] is None and row["tick"] < over else 0.0}
            for row in self.rows
        ]

    def _joined(self, command: str, name: str) -> _Device:
        device = self._devices.get(name)
        if device is None or device.lost is not None:
            why = "" if device is None else f" (it was removed: {device.lost})"
            raise InputError(f"{command}.device", f"one that has joined{why}", name)
        return device

    def _put_out(self, name: str, reason: str) -> str:
        self._devices[name].lost = self.lost[name] = reason
        self._tell()
        return reason

    def _tell(self) -> None:
        self.rows = tuple(
            {"name": name, "state": "joined" if one.lost is None else "lost", "tick": one.tick, "reason": one.lost}
            for name, one in self._devices.items()
        )
