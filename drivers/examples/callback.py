"""Process each block in a callback while the program does something else."""

import time

from drivers.daq import Daq
from drivers.examples import run_example


def main(url: str = "zenoh:127.0.0.1:7460", seconds: float = 1.0) -> int:
    """Count the samples of a period."""
    rows: list[int] = []
    with Daq.open(url, channels=["P_N", "P_E"], rate_hz=1000) as daq:
        daq.call(lambda samples: rows.append(len(samples)))
        time.sleep(seconds)
    print(f"{sum(rows)} rows in {len(rows)} blocks; lost {daq.lost}, dropped {daq.dropped}")
    return sum(rows)


if __name__ == "__main__":
    run_example(main)
