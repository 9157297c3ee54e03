"""Devices under test that a run in lockstep waits for, block by block."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any, Protocol

from rig.base.errors import InputError, Words

_MAX_DEVICES = 64
"""Devices kept for the status. The devices lost first are removed first."""
MAX_PATIENCE_S = 3600.0
"""Largest sum of the patience of all joined devices [s]: a block waits for one device after the other."""


def describe_waits(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the devices of a status that the rig waits for, and for how long; empty if it waits for none."""
    behind = [f"{row['name']} ({row['behind_s']:.0f} s)" for row in rows if row.get("behind_s")]
    return f"the rig waits for {', '.join(behind)}" if behind else ""


class DeviceRequest(Protocol):
    """A request of a client, with the name that the client gives itself."""

    command: str
    sender: str


@dataclass(slots=True)
class _Device:
    patience_s: float
    secret: str | None
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

    def join(self, name: str, patience_s: float, tick: int, secret: str | None = None) -> None:
        """Add a device, which the run waits for from this tick.

        Args:
            name: The device.
            patience_s: Longest wait for it per block [s].
            tick: Current tick.
            secret: Required in its further messages; None: all clients may send them.

        Raises:
            InputError: The name is in use, there are too many devices, or their patience is too long.
        """
        if name in self._devices and self._devices[name].lost is None:
            raise InputError("join.device", "a name under which no other device has joined", name)
        left_s = MAX_PATIENCE_S - sum(device.patience_s for device in self._devices.values() if device.lost is None)
        if patience_s > left_s:
            must = f"at most {left_s:g} s, what the joined devices leave of {MAX_PATIENCE_S:g} s"
            raise InputError("join.patience_s", must, patience_s)
        self._devices.pop(name, None)
        while len(self._devices) >= _MAX_DEVICES:
            removable = next((other for other, device in self._devices.items() if device.lost is not None), None)
            if removable is None:
                raise InputError("join.device", f"one of at most {_MAX_DEVICES} devices", name)
            del self._devices[removable]
        self._devices[name] = _Device(patience_s, secret, tick)
        self._update_rows()

    def done(self, name: str, tick: int | None, end: int, reported: str, secret: str | None = None) -> str | None:
        """Record that a device has finished a block.

        Args:
            name: The device.
            tick: End of the block according to the device; None if the block does not exist.
            end: End of the last block.
            reported: The block that the device named, for the error.
            secret: That of the message.

        Returns:
            The reason if the device was removed for a wrong tick; otherwise None.

        Raises:
            InputError: The device has not joined, or with another secret.
        """
        device = self._get_joined("done", name, secret)
        if tick is None or tick not in (device.tick, end):
            return self._remove(name, f"it reported the end of {reported}; the current block ends at tick {end}")
        device.tick = max(tick, device.tick)
        self._update_rows()
        return None

    def leave(self, name: str, secret: str | None = None) -> None:
        """Remove a device; the run no longer waits for it.

        Raises:
            InputError: The device has not joined, or with another secret.
        """
        self._get_joined("leave", name, secret)
        del self._devices[name]
        self._update_rows()

    def find_unfinished(self, end: int) -> list[str]:
        """Return the devices that have not finished the block that ends at a tick."""
        return [name for name, device in self._devices.items() if device.lost is None and device.tick < end]

    def find_first_due(self, waiting: Sequence[DeviceRequest], end: int) -> int | None:
        """Return the index of the first request that can be handled; None if all must wait.

        The order of two devices must not depend on chance: a device's command is handled once all devices before it by
        name have finished the block that ends at `end`. Its own `done` is handled after its commands.
        """
        unfinished = self.find_unfinished(end)
        for index, request in enumerate(waiting):
            sender = self._devices.get(request.sender)
            if request.command == "done":
                waits = any(earlier.sender == request.sender for earlier in waiting[:index])
            else:
                waits = (
                    sender is not None and sender.lost is None and any(other < request.sender for other in unfinished)
                )
            if not waits:
                return index
        return None

    def remove_late(self, end: int, since_s: float, now_s: float, waiting: Set[str]) -> tuple[dict[str, str], float]:
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
        for name in self.find_unfinished(end):
            device = self._devices[name]
            if name in waiting:
                device.since_s = now_s
            remaining_s = device.patience_s - (now_s - max(since_s, device.since_s))
            if remaining_s <= 0.0:
                within = f"within {device.patience_s:g} s"
                late[name] = self._remove(name, f"it did not finish the block that ends at tick {end} {within}")
            else:
                left_s = min(left_s, remaining_s)
        return late, left_s

    def status_rows(self, notified_tick: int, since_s: float, now_s: float) -> list[dict[str, Any]]:
        """Return the rows for the status, with the time that each joined device is late [s]; from any thread.

        Args:
            notified_tick: Last block end that the devices were notified of [ticks].
            since_s: When they were notified [s].
            now_s: Current time [s].
        """
        return [
            {
                **row,
                "behind_s": round(now_s - since_s, 3) if row["reason"] is None and row["tick"] < notified_tick else 0.0,
            }
            for row in self.rows
        ]

    def _get_joined(self, command: str, name: str, secret: str | None) -> _Device:
        device = self._devices.get(name)
        if device is None or device.lost is not None:
            detail = "" if device is None else f" (it was removed: {device.lost})"
            raise InputError(f"{command}.device", f"one that has joined{detail}", name)
        if secret != device.secret:
            received = Words("none" if secret is None else "another one")
            raise InputError(f"{command}.secret", f"that with which {name} has joined", received)
        return device

    def _remove(self, name: str, reason: str) -> str:
        self._devices[name].lost = self.lost[name] = reason
        self._update_rows()
        return reason

    def _update_rows(self) -> None:
        self.rows = tuple(
            {
                "name": name,
                "state": "joined" if device.lost is None else "lost",
                "tick": device.tick,
                "reason": device.lost,
            }
            for name, device in self._devices.items()
        )
