"""From condition to trip in real time: `python -m tests.system.protection_latency [TRIPS [BLOCK_MS]]`.

A rig and the protection monitor run in separate processes; a third one moves a probe by 500 um by a fault, whose first
row is in the reply, and the monitor's set point is 300 um without delay. The latency is the simulated time from that
row to the tick at which the trip's speed command takes effect: it includes the block of the row, both transmissions and
the monitor's work. Nothing is asserted: it depends on the machine.
"""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np

import rig
from drivers.client import NotSeenError, Rig
from tests import processes
from tests.waiting import PATIENCE_S

OPTIONS = (
    "--alert-um", "300", "--danger-um", "300", "--alert-delay-s", "0", "--danger-delay-s", "0", "--window-s", "0.05",
    "--startup-s", "0.1", "--ok-recovery-s", "0.05",
)  # fmt: skip
PARTS = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "most": 100.0}


def measure_latencies_ms(trips: int, block_ms: str) -> tuple[np.ndarray, dict]:
    """Return the latency of each trip [ms], shape (trips,), infinite if missing; and the rig's status at the end."""
    endpoint, found = processes.free_endpoint(), []
    rng = np.random.default_rng(1)
    with (
        processes.start_rig(
            "run", "stable-run", "--listen", endpoint, "--block-ms", block_ms, "--duration-s", str(60 + 4 * trips),
            stdout=None, stderr=None,
        ) as child,
        rig.connect(url := f"zenoh:{endpoint}", wait_s=processes.COMPILE_S) as machine,
        # Nothing reads its output: a pipe would fill up and block it.
        processes.start_python("-m", "drivers.protection", url, *OPTIONS, stdout=subprocess.DEVNULL, stderr=None),
    ):  # fmt: skip
        machine.event(lambda event: "on" in event.get("tags", ()), timeout_s=PATIENCE_S)
        time.sleep(0.5)
        while len(found) < trips:
            fault = machine.fault("disk_x", "offset", value=0.5, for_s=0.02)
            tick = fault.first_row["probes"] * 50
            try:
                trip = machine.event(
                    lambda event, tick=tick: event["event"] == "speed" and event["tick"] > tick, timeout_s=2.0
                )
                found.append(1e-3 * (trip["tick"] - tick))
            except NotSeenError:
                # A monitor that lost rows restarts, and may be blind at that moment.
                found.append(np.inf)
            time.sleep(0.1 + rng.uniform(0.0, 0.01))
            again = any(_again(machine) for _ in range(20)) or not np.isfinite(found[-1])
            assert again, "it is reset once the step has left the window"
        status = machine.status()
        child.terminate()
    return np.array(found), status


def _again(machine: Rig) -> bool:
    machine.note("again", tags=["reset"])
    try:
        machine.event(
            lambda event: event["event"] == "note" and event["text"].endswith("reset  trip  0"), timeout_s=0.5
        )
    except NotSeenError:
        return False
    return True


def main(trips: str = "1000", block_ms: str = "1") -> None:
    """Print the latency's distribution."""
    found, status = measure_latencies_ms(int(trips), block_ms)
    quantiles = [f"p{part:g} {np.percentile(found, part):.2f} ms" for part in (0, 10, 50, 99, 99.9, 100)]
    missed = f"{np.isinf(found).sum()} missed, blocks of {block_ms} ms"
    print(f"{trips} trips, {missed}: {', '.join(quantiles)}; lateness of the rig [ms]: {status['lateness_ms']}")


if __name__ == "__main__":
    main(*sys.argv[1:])
