"""Driver of the magnet that holds the shaft until it is released."""

from __future__ import annotations

from drivers.instruments.common.aio import AsyncInstrument, make_async
from drivers.instruments.common.driver import CommandDone, Instrument
from drivers.instruments.magnet.protocol import CODEC, Release


class Magnet(Instrument):
    """Releases the shaft."""

    CODEC = CODEC

    def release(self) -> CommandDone:
        """Release the shaft.

        Raises:
            RefusedError: The rig refused the command, for the reason in the message.
            LinkError: No reply came; the shaft may or may not be released.
        """
        return self._send_command(Release())


class AsyncMagnet(AsyncInstrument[Magnet]):
    """Releases the shaft, for asyncio."""

    DRIVER = Magnet
    release = make_async(Magnet.release)
