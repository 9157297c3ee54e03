"""Driver of the force transducers' charge amplifier; compression is positive."""

from __future__ import annotations

from drivers.instruments.common.aio import AsyncSampler
from drivers.instruments.common.driver import Sampler
from drivers.instruments.force.protocol import CODEC
from drivers.sources.samples import Samples


class Force(Sampler):
    """Reads forces [N]."""

    CODEC = CODEC

    @staticmethod
    def peaks(samples: Samples) -> dict[str, tuple[float, float]]:
        """Return the largest compression of each transducer [N], and its simulated time [s]."""
        rows = samples.values.argmax(axis=0)
        times = samples.times_s
        return {
            name: (float(samples.values[row, column]), float(times[row]))
            for column, (name, row) in enumerate(zip(samples.names, rows, strict=True))
        }


class AsyncForce(AsyncSampler[Force]):
    """Reads forces, for asyncio."""

    DRIVER = Force
