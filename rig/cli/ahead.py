"""Half of a first start's compiling, in a process of its own beside it: `python -m rig.cli.ahead`.

Most of it are the series of flight, rolling and sliding, one after the other. On a second core the last of them are
ready when their turn comes, and found in the cache.
"""

from __future__ import annotations

import atexit
import os
import subprocess
import sys
import time
from threading import Thread

SERIES = ("rig.engines.split", "rig.engines.taylor")
"""Engines that are made of series."""


def start_beside() -> None:
    """Start it where there is a core for it. It ends by itself, or with this process."""
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    if len(cores) > 1:
        quiet = subprocess.DEVNULL
        child = subprocess.Popen([sys.executable, "-m", __name__], stdin=quiet, stdout=quiet, stderr=quiet)
        atexit.register(_end, child)


def _end(child: subprocess.Popen[bytes]) -> None:
    child.kill()
    child.wait()


def compile_last() -> None:
    """Compile the series, the sensors and rolling by collocation, by calling them as a run does."""
    import numpy as np

    from rig.engines.split.layout import MEMORY, STEP_S, WAITS
    from rig.engines.split.rolling import roll
    from rig.engines.taylor.march import room_in
    from rig.engines.taylor.series import rolling, sliding
    from rig.kernels.constants import Inputs
    from rig.kernels.records import packed
    from rig.kernels.signals import N_ROW, N_VECTOR
    from rig.sensors.conditioning import Conditioner
    from rig.simulation import Simulation

    simulation = Simulation("hammer")
    quiet = Inputs(1e-6, 0.0, 1.0, 0.0, 0, 0, 0.0, 0.0, 0, ideal_drive=False, magnet_engaged=True)
    constants, inputs = packed(simulation.model.constants)[0], packed(quiet)[0]
    memory = np.zeros(MEMORY)
    room = room_in(memory)
    for series in (sliding, rolling):
        series(constants, inputs, memory, 0.0, 0.0, 0.0, 0.0, room.Y, room.A, room.B, room.D, room.acc)
    groups, rows = tuple(simulation.table.groups.values()), np.zeros((1000, N_ROW))
    Conditioner(groups, row_rate_hz=40_000, seed=1, noise=True, ideal=False).counts(rows)
    # With other inputs than the memory holds, it returns at once.
    memory[STEP_S], memory[WAITS] = 1e-3, 1.0
    roll(packed(simulation.model.constants), packed(quiet), np.zeros(N_VECTOR), memory, (0, 1, 1), 0, rows)


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.2)
    os._exit(1)


if __name__ == "__main__":
    Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    compile_last()
