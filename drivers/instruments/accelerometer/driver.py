"""Driver of an IEPE accelerometer conditioner (AC-coupled)."""

from __future__ import annotations

import numpy as np

from drivers.instruments.accelerometer.protocol import CODEC
from drivers.instruments.common.aio import AsyncSampler
from drivers.instruments.common.driver import Sampler
from drivers.sources.samples import Samples


class Accelerometer(Sampler):
    """Reads accelerations [m/s^2]."""

    CODEC = CODEC

    @staticmethod
    def rms(samples: Samples) -> dict[str, float]:
        """Return the effective value of each channel [m/s^2 rms]."""
        values = np.sqrt(np.mean(samples.values**2, axis=0))
        return dict(zip(samples.names, map(float, values), strict=True))


class AsyncAccelerometer(AsyncSampler[Accelerometer]):
    """Reads accelerations, for asyncio."""

    DRIVER = Accelerometer
