"""Driver of a pendulum hammer: trigger an impact, and read the force of the hammer."""

from __future__ import annotations

from drivers.instruments.common.aio import AsyncSampler, make_async
from drivers.instruments.common.driver import CommandDone, Sampler
from drivers.instruments.hammer.protocol import CODEC, Hit


class Hammer(Sampler):
    """Strikes the shaft at the disk, and reads the hammer force [N]."""

    CODEC = CODEC

    def trigger(self, *, force_n: float = 100.0, duration_ms: float = 5.0, direction: str | float = "x") -> CommandDone:
        """Trigger an impact.

        Args:
            force_n: Peak force [N], above 0.
            duration_ms: Length of the half-sine pulse [ms], above 0.
            direction: "x", "y", "-x", "-y", or the angle from x towards y [degrees].

        Raises:
            RefusedError: The rig refused the command, for the reason in the message.
            LinkError: No reply came; there may or may not be an impact.
        """
        return self._send_command(Hit(force_n=float(force_n), duration_ms=float(duration_ms), direction=str(direction)))


class AsyncHammer(AsyncSampler[Hammer]):
    """Triggers impacts and reads the force, for asyncio."""

    DRIVER = Hammer
    trigger = make_async(Hammer.trigger)
