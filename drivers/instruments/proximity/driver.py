"""Driver of an eddy-current proximity probe conditioner; closest approach is the positive peak."""

from __future__ import annotations

from drivers.instruments.common.aio import AsyncSampler, awaited
from drivers.instruments.common.driver import Sampler
from drivers.instruments.proximity.protocol import CODEC
from drivers.sources.samples import Samples


class Proximity(Sampler):
    """Reads probes [mm]."""

    CODEC = CODEC

    def gap_volts(self, samples: Samples) -> dict[str, float]:
        """Mean output of each probe [V], as a voltmeter on the conditioner would show it when the probes are set up."""
        channels = self.datasheet.group(samples.names).channels
        return {row.name: row.bias_v + row.sensitivity_v * float(samples[row.name].mean()) for row in channels}

    def in_range(self, samples: Samples) -> dict[str, bool]:
        """Whether each probe stayed inside its linear range in all rows."""
        channels = self.datasheet.group(samples.names).channels
        inside = {}
        for row in channels:
            volts = row.bias_v + row.sensitivity_v * samples[row.name]
            # The conditioner's output stops at its limits: a value there is not to be believed.
            low, high = row.range_v[0] + row.lsb_v, row.range_v[1] - row.lsb_v
            inside[row.name] = bool(volts.min() > low and volts.max() < high)
        return inside


class AsyncProximity(AsyncSampler[Proximity]):
    """Reads probes, for asyncio."""

    DRIVER = Proximity
    gap_volts = awaited(Proximity.gap_volts)
    in_range = awaited(Proximity.in_range)
