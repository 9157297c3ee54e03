"""Read the force and the DAQ client at the same time with asyncio."""

import asyncio

from drivers.daq import Daq
from drivers.examples import run_example
from drivers.instruments.force.driver import AsyncForce


async def main(rig: str = "zenoh:127.0.0.1:7460", instruments: str = "zenoh:127.0.0.1:7462") -> float:
    """Compare the same samples, as received by an instrument driver and by the DAQ client."""
    with Daq.open(rig, channels=["P_N"]) as daq:
        async with await AsyncForce.open(instruments) as force:
            await force.configure(channels=["P_N"])
            await force.start()
            one, other = await asyncio.gather(force.read(1000), daq.aread(1000))
            while abs(shift := one.index - other.index) > 500:  # one of the streams began long before the other
                one, other = (one, await daq.aread(1000)) if shift > 0 else (await force.read(1000), other)
    difference = abs(one.values[max(-shift, 0) :][:500] - other.values[max(shift, 0) :][:500]).max()
    print(f"largest difference {difference} {one.units[0]}")
    return difference


if __name__ == "__main__":
    run_example(main, 2)
