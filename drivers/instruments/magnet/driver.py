"""Driver of the magnet that holds the shaft until it is released."""

from __future__ import annotations

from drivers.instruments.common.aio import AsyncInstrument, awaited
from drivers.instruments.common.driver import Done, Instrument
from drivers.instruments.magnet.protocol import CODEC, Release


class Magnet(Instrument):
    """Releases the shaft."""

    CODEC = CODEC

    def release(self) -> Done:
        """Release the shaft.

        Raises:
            RefusedError: The rig refused, for the reason in the message.
            LinkError: No reply came; whether it was released is not known.
        """
        return self._act(Release())


class AsyncMagnet(AsyncInstrument[Magnet]):
    """Releases, for asyncio."""

    DRIVER = Magnet
    release = awaited(Magnet.release)
