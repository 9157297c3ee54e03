"""Driver of the motor controller: set the speed, read tachometer and keyphasor."""

from __future__ import annotations

from drivers.instruments.common.aio import AsyncSampler, make_async
from drivers.instruments.common.driver import CommandDone, Sampler
from drivers.instruments.drive.protocol import CODEC, SetSpeed


class Drive(Sampler):
    """Sets the speed set point of the drive, and reads the speed [Hz]."""

    CODEC = CODEC

    def set_speed(self, hz: float) -> CommandDone:
        """Set the speed set point of the drive.

        Args:
            hz: Shaft speed [Hz].

        Raises:
            RefusedError: The rig refused the command, for the reason in the message.
            LinkError: No reply came; the speed may or may not be set.
        """
        return self._send_command(SetSpeed(speed_hz=float(hz)))


class AsyncDrive(AsyncSampler[Drive]):
    """Sets and reads the speed, for asyncio."""

    DRIVER = Drive
    set_speed = make_async(Drive.set_speed)
