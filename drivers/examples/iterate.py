"""Print the shaft's largest displacement in each tenth of a second."""

from drivers.daq import Daq
from drivers.examples import run_example


def main(url: str = "zenoh:127.0.0.1:7460", blocks: int = 10) -> None:
    """Read blocks from a rig."""
    with Daq.open(url, channels=["ring_x", "ring_y"]) as daq:
        for _, samples in zip(range(blocks), daq.blocks(round(daq.rate_hz / 10)), strict=False):
            furthest = abs(samples["ring_x"] + 1j * samples["ring_y"]).max()
            print(f"{samples.times_s[0]:8.3f} s  {furthest:.3f} {samples.units[0]}  missing before: {samples.gap}")


if __name__ == "__main__":
    run_example(main)
