"""Driver of the motor controller: set the speed, read tachometer and keyphasor."""

from __future__ import annotations

from drivers.instruments.common.aio import AsyncSampler, awaited
from drivers.instruments.common.driver import Done, Sampler
from drivers.instruments.drive.protocol import CODEC, SetSpeed


class Drive(Sampler):
    """Sets the speed that the drive holds, and reads it [Hz]."""

    CODEC = CODEC

    def set_speed(self, hz: float) -> Done:
        """Set the speed that the drive holds [Hz].

        Raises:
            RefusedError: The rig refused, for the reason in the message.
            LinkError: No reply came; whether it was set is not known.
        """
        return self._act(SetSpeed(speed_hz=float(hz)))


class AsyncDrive(AsyncSampler[Drive]):
    """Sets and reads the speed, for asyncio."""

    DRIVER = Drive
    set_speed = awaited(Drive.set_speed)
