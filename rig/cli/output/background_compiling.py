"""Parallel compiling at the first start, in a second process: `python -m rig.cli.output.background_compiling`.

The main process compiles the march of the engine with the series of flight and rolling; this process compiles those of
sliding, rolling by collocation and the sensors, which the other then loads from the cache. Both take about equal time.
"""

from __future__ import annotations

import atexit
import os
import subprocess
import sys
import time
from threading import Thread

SERIES = ("rig.physics.engines.split", "rig.physics.engines.taylor")
"""Engines that use Taylor series."""
MARCH = "rig.physics.engines.split.method"
"""Module compiled last before rolling by collocation."""


def start_second_process() -> subprocess.Popen[bytes] | None:
    """Start the process if there is a second core. It ends when it is done, or with this process."""
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    if len(cores) < 2:
        return None
    # -P: load the same files as this process, independent of the working directory.
    command, quiet = [sys.executable, "-P", "-m", __name__], subprocess.DEVNULL
    child = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)
    atexit.register(_end, child)
    return child


def _end(child: subprocess.Popen[bytes]) -> None:
    child.kill()
    child.wait()


def compile_last() -> None:
    """Compile the series of sliding, the sensors and rolling by collocation, by calling them as a run does."""
    import numpy as np

    from rig.channels.sensors.conditioning import Conditioner
    from rig.physics.engines.split import method
    from rig.physics.engines.taylor.march import room_in
    from rig.physics.engines.taylor.series import sliding
    from rig.physics.kernels.constants import Inputs
    from rig.physics.kernels.records import pack_record
    from rig.physics.kernels.signals import N_ROW
    from rig.run.simulation import Simulation

    simulation = Simulation("hammer")
    quiet = Inputs(1e-6, 0.0, 1.0, 0.0, 0, 0, 0.0, 0.0, 0, ideal_drive=False, magnet_engaged=True)
    constants, inputs = pack_record(simulation.model.constants), pack_record(quiet)
    memory = np.zeros(method.MEMORY)
    room = room_in(memory)
    sliding(constants[0], inputs[0], memory, 0.0, 0.0, 0.0, 0.0, room.Y, room.A, room.B, room.D, room.acc)
    method.warm_up(constants, inputs)
    groups, rows = tuple(simulation.table.groups.values()), np.zeros((1000, N_ROW))
    Conditioner(groups, row_rate_hz=40_000, seed=1, noise=True, ideal=False).counts(rows)


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.2)
    os._exit(1)


if __name__ == "__main__":
    Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    compile_last()
