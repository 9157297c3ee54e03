"""Devices under test that a run in lockstep waits for, block by block."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any, Protocol

from rig.base.errors import InputError

_MOST = 64
"""Devices that are told of; of those that are lost, the ones lost longest ago are forgotten first."""


class Said(Protocol):
    """What a client has said: a command, by the name that it gives itself."""

    command: str
    sender: str


@dataclass(slots=True)
class _Device:
    patience_s: float
    tick: int
    """End of the last block that it is done with."""
    lost: str | None = None
    since_s: float = 0.0
    """When it last had to wait for others, where that is behind the end of the block [s, monotonic]."""


class Devices:
    """Who has joined, and up to where each is done; of one thread, but for `rows`.

    A run waits for all that have joined after each block: the only block that a device can be done with is the last.
    """

    def __init__(self) -> None:
        self._devices: dict[str, _Device] = {}
        self.rows: tuple[Mapping[str, Any], ...] = ()
        """For the status, from any thread: name, state (joined, lost), tick, reason of each."""
        self.lost: dict[str, str] = {}
        """Devices that were put out and not yet told of, with the reason."""

    def __bool__(self) -> bool:
        """Whether any has joined and is there."""
        return any(device.lost is None for device in self._devices.values())

    def join(self, name: str, patience_s: float, tick: int) -> None:
        """Wait for a device from this tick on.

        Raises:
            InputError: One of that name has joined, or there are too many.
        """
        if name in self._devices and self._devices[name].lost is None:
            raise InputError("join.device", "a name under which no other device has joined", name)
        self._devices.pop(name, None)
        while len(self._devices) >= _MOST:
            gone = next((other for other, device in self._devices.items() if device.lost is not None), None)
            if gone is None:
                raise InputError("join.device", f"one of at most {_MOST} devices", name)
            del self._devices[gone]
        self._devices[name] = _Device(patience_s, tick)
        self._tell()

    def done(self, name: str, tick: int | None, end: int, said: str) -> str | None:
        """Take note that a device is done with a block.

        Args:
            name: The device.
            tick: End of the block, as the device says; None where there was no such block.
            end: End of the last block that was run.
            said: What the device said.

        Returns:
            Why the device was put out for that; None where it was not.

        Raises:
            InputError: It has not joined.
        """
        device = self._joined("done", name)
        if tick is None or tick not in (device.tick, end):
            return self._put_out(name, f"it was done with {said}; the block that it was given ends at tick {end}")
        device.tick = max(tick, device.tick)
        self._tell()
        return None

    def leave(self, name: str) -> None:
        """Wait for a device no longer.

        Raises:
            InputError: It has not joined.
        """
        self._joined("leave", name)
        del self._devices[name]
        self._tell()

    def behind(self, end: int) -> list[str]:
        """Those that are not yet done with the block that ends at a tick."""
        return [name for name, device in self._devices.items() if device.lost is None and device.tick < end]

    def first_due(self, waiting: Sequence[Said], end: int) -> int | None:
        """Place of the first that can be taken of what was said; None where all wait.

        Whose comes first of two devices must not be chance: what one commands is taken once those before it by name are
        done with the block that ends at a tick. That it is done itself is taken behind what it has commanded.
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
        """Put out who is not done in time with the block that ends at a tick.

        Args:
            end: That tick.
            since_s: When they were told that the block is over [s].
            now_s: Now [s].
            waiting: Devices that wait for others, so that their time has not begun.

        Returns:
            The reasons by name, and how long it is until the next one is late [s].
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
        """Rows for the status, with how long each that is joined has been behind [s]; from any thread.

        Args:
            over: End of the last block that they were told is over [ticks].
            since_s: When they were told [s].
            now_s: Now [s].
        """
        return [
            {**row, "behind_s": round(now_s - since_s, 3) if row["reason"] is None and row["tick"] < over else 0.0}
            for row in self.rows
        ]

    def _joined(self, command: str, name: str) -> _Device:
        device = self._devices.get(name)
        if device is None or device.lost is not None:
            why = "" if device is None else f" (it was put out: {device.lost})"
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
