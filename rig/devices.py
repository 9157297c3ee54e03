"""Devices under test that a run in lockstep waits for, block by block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rig.errors import InputError

_MOST = 64
"""Devices that are told of; of those that are lost, the ones lost longest ago are forgotten first."""


@dataclass(slots=True)
class _Device:
    patience_s: float
    tick: int
    """End of the last block that it is done with."""
    lost: str | None = None


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

    def behind(self, end: int) -> bool:
        """Whether any is not yet done with the block that ends at a tick."""
        return any(device.lost is None and device.tick < end for device in self._devices.values())

    def put_out_late(self, end: int, waited_s: float) -> dict[str, str]:
        """Put out who was not done in time with the block that ends at a tick; returns the reasons by name."""
        late = [
            name
            for name, device in self._devices.items()
            if device.lost is None and device.tick < end and waited_s >= device.patience_s
        ]
        return {
            name: self._put_out(
                name,
                f"it was not done with the block that ends at tick {end} within {self._devices[name].patience_s:g} s",
            )
            for name in late
        }

    def patience_s(self, end: int) -> float:
        """The shortest patience with those who are not yet done [s]."""
        return min(
            (device.patience_s for device in self._devices.values() if device.lost is None and device.tick < end),
            default=0.0,
        )

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
