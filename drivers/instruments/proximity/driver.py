"""Driver of an eddy-current proximity probe conditioner; closest approach is the positive peak."""

from __future__ import annotations

from drivers.instruments.common.aio import AsyncSampler, make_async
from drivers.instruments.common.driver import Sampler
from drivers.instruments.proximity.protocol import CODEC
from drivers.sources.samples import Samples


class Proximity(Sampler):
    """Reads displacements at the probes [mm]."""

    CODEC = CODEC

    def gap_volts(self, samples: Samples) -> dict[str, float]:
        """Return the DC gap voltage of each probe [V]: the mean output, as a voltmeter at the conditioner shows it."""
        channels = self.datasheet.group(samples.names).channels
        return {row.name: row.bias_v + row.sensitivity_v * float(samples[row.name].mean()) for row in channels}

    def in_range(self, samples: Samples) -> dict[str, bool]:
        """Return for each probe whether it stayed inside its linear range in all samples."""
        channels = self.datasheet.group(samples.names).channels
        inside = {}
        for row in channels:
            volts = row.bias_v + row.sensitivity_v * samples[row.name]
            # The conditioner's output is clipped at its limits, so a value there is invalid.
            low, high = row.range_v[0] + row.lsb_v, row.range_v[1] - row.lsb_v
            inside[row.name] = bool(volts.min() > low and volts.max() < high)
        return inside


class AsyncProximity(AsyncSampler[Proximity]):
    """Reads probes, for asyncio."""

    DRIVER = Proximity
    gap_volts = make_async(Proximity.gap_volts)
    in_range = make_async(Proximity.in_range)
