"""Driver of a pendulum hammer: hit, and read the force of the hit."""

from __future__ import annotations

from drivers.instruments.common.aio import AsyncSampler, awaited
from drivers.instruments.common.driver import Done, Sampler
from drivers.instruments.hammer.protocol import CODEC, Hit


class Hammer(Sampler):
    """Hits the shaft at the disk, and reads the hammer's force [N]."""

    CODEC = CODEC

    def trigger(self, *, force_n: float = 100.0, duration_ms: float = 5.0, direction: str | float = "x") -> Done:
        """Hit.

        Args:
            force_n: Peak force [N].
            duration_ms: Length of the half sine [ms].
            direction: "x", "y", "-x", "-y" or an angle from x towards y [degrees].

        Raises:
            RefusedError: The rig refused, for the reason in the message.
            LinkError: No reply came; whether it hit is not known.
        """
        return self._act(Hit(force_n=float(force_n), duration_ms=float(duration_ms), direction=str(direction)))


class AsyncHammer(AsyncSampler[Hammer]):
    """Hits and reads, for asyncio."""

    DRIVER = Hammer
    trigger = awaited(Hammer.trigger)
