"""Memory, descriptors and losses of a long run: `python -m tests.system.resources [--minutes 10]`.

Runs a rig with a CAN hub, in real time, with three clients: a CAN client, a recorder and a live view that writes a file
(together 90 MB a minute in a temporary folder). After `--warm-up` minutes, each minute's mean of the resident memory is
a point of a straight line. Shown are its slope with its standard error, and the duration at which two standard errors
are half of the goal. Status 1 if a slope plus two standard errors exceeds the goal, the median number of descriptors
of a minute changed, rows were lost, blocks or CAN frames dropped, or a process ended early.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from rig.base import wire
from rig.serve.transport.zenoh import ZenohClient
from tests.processes import COMPILE_S, free_endpoint, start_python
from tests.waiting import PATIENCE_S

GOAL = 0.5
"""Largest growth [MB/min]."""
CAN_CLIENT = """
import can, sys
with can.Bus(interface="zenoh", channel="can0", endpoint=sys.argv[1]) as bus:
    while True:
        bus.recv()
"""


def main() -> int:
    """Run, sample and print; return the exit status."""
    import psutil

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=int, default=10, help="duration [min]")
    parser.add_argument("--warm-up", type=int, default=2, help="time before the first point [min]")
    options = parser.parse_args()
    if options.minutes < options.warm_up + 4:  # a line with a standard error
        parser.error(f"--minutes must be at least --warm-up + 4; received {options.minutes}")
    at, bus = free_endpoint(), free_endpoint()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        children = {}

        def start(name: str, *arguments: str) -> None:
            output = stack.enter_context((folder / name).open("w"))
            child = start_python(*arguments, stdout=output, stderr=subprocess.STDOUT)
            children[name] = stack.enter_context(child)

        run = ("run", "stable-run", "--listen", at, "--duration-s", "86400", "--can", f"zenoh:can0?endpoint={bus}")
        start("rig", "-m", "rig", *run)
        client = stack.enter_context(ZenohClient(at, wait_s=COMPILE_S))
        start("CAN client", "-c", CAN_CLIENT, bus)
        start("recorder", "-m", "rig", "record", "--connect", at, "-o", str(folder / "a.mcap"))
        start("viewer", "-m", "rig", "view", "--live", "--connect", at, "--save", str(folder / "a.rrd"))
        begin_s, samples = time.monotonic(), {name: [] for name in children}
        while (now_min := (time.monotonic() - begin_s) / 60.0) < options.minutes:
            for name, child in children.items():
                if child.poll() is not None:
                    print(f"{name} ended: {(folder / name).read_text()[-2000:]}")
                    return 1
                process = psutil.Process(child.pid)
                samples[name].append((now_min, process.memory_info().rss / 1e6, process.num_fds()))
            time.sleep(1.0)
        status = wire.decode_document(client.request(wire.STATUS, timeout_s=PATIENCE_S))
        for child in reversed(children.values()):
            child.send_signal(signal.SIGINT)
            child.wait(PATIENCE_S)
    good = True
    print(f"{'process':12}{'MB':>6}{'MB/min':>9}{'+-':>7}{'min needed':>12}  descriptors")
    for name, rows in samples.items():
        minute, rss, descriptors = np.array([row for row in rows if row[0] >= options.warm_up]).T
        means = [rss[minute.astype(int) == each].mean() for each in range(options.warm_up, options.minutes)]
        fit, covariance = np.polyfit(np.arange(len(means)), means, 1, cov=True)
        error = np.sqrt(covariance[0, 0])
        needed = options.warm_up + len(means) * (4.0 * error / GOAL) ** (2 / 3)  # the error falls with the power 1.5
        # Single values may include a file that is open for a moment.
        first, last = (
            np.median(descriptors[minute.astype(int) == at]) for at in (options.warm_up, options.minutes - 1)
        )
        print(f"{name:12}{rss[-1]:6.0f}{fit[0]:9.3f}{error:7.3f}{np.ceil(needed):12.0f}  {first:g} to {last:g}")
        good &= bool(fit[0] + 2.0 * error < GOAL and first == last)
    lost = {name: client["lost"] for name, client in status["clients"].items()}
    dropped = {"blocks": status["queue"]["dropped"], "CAN frames": status["congestion"]["can_dropped"]}
    print(f"rows lost {lost}, dropped {dropped}")
    good &= len(lost) == 2 and not any((*lost.values(), *dropped.values()))
    print("goals met" if good else "a goal is missed, or the run was too short to show it")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
