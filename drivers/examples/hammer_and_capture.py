"""Strike the shaft and capture from 50 ms before to 200 ms after the impact."""

import numpy as np

from drivers.daq import Daq
from drivers.examples import run_example
from drivers.instruments.hammer.driver import Hammer
from drivers.sources.samples import Samples


def main(rig: str = "zenoh:127.0.0.1:7460", instruments: str = "zenoh:127.0.0.1:7462") -> list[Samples]:
    """Trigger on the simulated time of the impact that the hammer controller reports."""
    with Daq.open(rig, channels=["hammer", "disk_x", "disk_y"]) as daq, Hammer.open(instruments) as hammer:
        captured = [daq.read(round(0.05 * daq.rate_hz))]
        done = hammer.trigger(force_n=200.0, direction="y")
        while captured[-1].times_s[-1] < done.time_s + 0.2:
            captured.append(daq.read())
    peak = np.concatenate([samples["hammer"] for samples in captured]).max()
    print(f"impact {done.id} at {done.time_s:.4f} s, {peak:.1f} N, {sum(map(len, captured))} rows captured")
    return captured


if __name__ == "__main__":
    run_example(main, 2)
