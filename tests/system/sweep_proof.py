"""Long proof of sweeps: the same bytes after kills, for 1, 2 and 4 Dask workers, with one killed and one stopped.

Not part of the suite, as it takes some minutes: `python -m tests.system.sweep_proof [FOLDER] [--runs N]`. It prints
a line for each check, with processor time per run for one and two workers, and exits with status 1 if one fails.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import rig
from tests.processes import free_port, read_line, start_python, start_rig

_TASKS, _KILLS, _STOPPED_S = 40, 20, 20.0
_PLAN = """
scene = "hammer"
runs = {runs}
task_runs = {task_runs}
sampling = "sobol"
[set]
duration_s = 0.25
[over."contact.friction"]
distribution = "uniform"
from = 0.05
to = 0.4
[over."hammer.force_n"]
distribution = "uniform"
from = 20.0
to = 200.0
"""


def read_parts(folder: Path) -> dict[str, bytes]:
    """Return the content of the finished parts by name."""
    return {path.name: path.read_bytes() for path in sorted(folder.glob("part-*.parquet"))}


def processor_s(pid: int) -> float:
    """Return the processor time of a process [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def sweep(plan: Path, folder: Path, *options: str) -> Any:
    """Start a sweep, or continue it."""
    return start_rig("sweep", str(plan), "-o", str(folder), "--resume", "--json", *options)


def finish(child: subprocess.Popen[str], seen: Any = None) -> None:
    """Wait for a sweep; call `seen` with the number of finished tasks at each."""
    assert child.stdout is not None
    for line in child.stdout:
        if seen is not None:
            seen(json.loads(line)["done"])
    if child.wait() != 0:
        assert child.stderr is not None
        sys.exit(f"status {child.returncode}: {child.stderr.read()}")


def kill_and_resume(plan: Path, folder: Path) -> int:
    """Run a sweep, kill it at random moments, and return the number of kills before it had finished."""
    chance, kills = random.Random(1), 0
    for _ in range(_KILLS):
        with sweep(plan, folder) as child:
            if chance.random() < 0.7:  # else also while it starts
                child.stdout.readline()
            time.sleep(chance.uniform(0.0, 2.0))
            kills += child.poll() is None
            child.kill()
            child.wait()
        if folder.exists() and read_parts(folder):
            assert set(rig.open_sweep(folder, ["outcome"])["outcome"])  # it can be opened after each kill
    with sweep(plan, folder) as child:
        finish(child)
    return kills


def run_on_cluster(plan: Path, folder: Path, count: int, *, harm: bool = False) -> float:
    """Run a sweep on a Dask cluster of one-thread workers, and return their processor time [s].

    With `harm`, the first worker is stopped for some time, and the second one is killed, after some tasks.
    """
    with ExitStack() as stack:
        local, address = Path(stack.enter_context(tempfile.TemporaryDirectory())), f"tcp://127.0.0.1:{free_port()}"
        host = ["--host", "127.0.0.1", "--no-dashboard"]
        port = address.rpartition(":")[2]
        head = stack.enter_context(start_python("-m", "distributed.cli.dask_scheduler", *host, "--port", port))
        read_line(head, "Scheduler at")
        options = [*host, "--no-nanny", "--nthreads", "1", "--local-directory"]
        workers = [
            stack.enter_context(
                start_python("-m", "distributed.cli.dask_worker", address, *options, str(local / str(i)))
            )
            for i in range(count)
        ]
        for child in workers:
            read_line(child, "Registered to")
        begin = sum(processor_s(child.pid) for child in workers)

        def harm_workers(done: int) -> None:
            if done == 5:
                workers[0].send_signal(signal.SIGSTOP)
                threading.Timer(_STOPPED_S, workers[0].send_signal, [signal.SIGCONT]).start()
            if done == 10:
                workers[1].kill()

        with sweep(plan, folder, "--scheduler", address) as child:
            finish(child, harm_workers if harm else None)
        return sum(processor_s(child.pid) for child in workers if child.poll() is None) - begin


def main() -> None:
    """Run all checks."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("folder", nargs="?", type=Path, help="new folder; default: a temporary one")
    options.add_argument("--runs", type=int, default=500, help="runs of each of the 40 tasks")
    given = options.parse_args()
    base = given.folder or Path(tempfile.mkdtemp())
    base.mkdir(exist_ok=True)
    plan, runs = base / "plan.toml", _TASKS * given.runs
    plan.write_text(_PLAN.format(runs=runs, task_runs=given.runs), encoding="utf-8")
    begin = time.monotonic()
    with sweep(plan, base / "whole") as child:
        finish(child)
    whole, failed = read_parts(base / "whole"), False
    print(f"whole: {len(whole)} parts, {runs} runs in {time.monotonic() - begin:.0f} s", flush=True)

    def compare(name: str, text: str) -> None:
        nonlocal failed
        same = read_parts(base / name) == whole and len(whole) == _TASKS
        failed |= not same
        print(f"{name}: {'same' if same else 'OTHER'} bytes; {text}", flush=True)

    compare("killed", f"{kill_and_resume(plan, base / 'killed')} kills by SIGKILL")
    per_run: dict[int, float] = {}
    for count in (1, 2, 4):
        per_run[count] = run_on_cluster(plan, base / f"workers-{count}", count) / runs * 1e3
        compare(f"workers-{count}", f"{per_run[count]:.3f} ms of processor time per run")
    print(f"two workers over one: {per_run[2] / per_run[1]:.3f} processor time per run", flush=True)
    run_on_cluster(plan, base / "harmed", 3, harm=True)
    compare("harmed", f"of three workers one was killed, and one stopped for {_STOPPED_S:g} s")
    sys.exit(failed)


if __name__ == "__main__":
    main()
