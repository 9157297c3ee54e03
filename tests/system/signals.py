"""Signals to a rig, a recorder, a campaign and a device: `python -m tests.system.signals [ROLE ...]`, ten minutes.

Each gets 20 SIGKILLs, and SIGSTOP five times for 10 s and once for 60 s, at random times. Prints the outcomes with
their counts; docs/lockstep.md has the table.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import rig
from recorder.reader import Recording
from tests import processes
from tests.waiting import PATIENCE_S, until

KILLS, STOPS_S = 20, (60.0, *[10.0] * 5)
READS = """
import sys, threading
import rig

def read(name, loop):
    try:
        for n, samples in enumerate(loop):
            n or print("reads", flush=True)
        print(name, "end", flush=True)
    except Exception as error:
        kinds = (TimeoutError, ConnectionError, type(error))
        print(name, next(kind.__name__ for kind in kinds if isinstance(error, kind)), flush=True)

with rig.connect(sys.argv[1], channels=["disk_x"]) as one, rig.connect(sys.argv[1], channels=["P_E"]) as two:
    loops = [threading.Thread(target=read, args=("blocks", one.blocks())),
             threading.Thread(target=read, args=("daq", two.daq.blocks(timeout_s=8.0)))]
    [each.start() for each in loops]
    [each.join() for each in loops]
"""
DEVICE = """
import sys
import rig

with rig.connect(sys.argv[1], channels=["disk_x"], name="guard") as machine:
    try:
        for n, _ in enumerate(machine.blocks(patience_s=1.0)):
            n or print("joined", flush=True)
    except Exception as error:
        print(type(error).__name__, flush=True)
"""


class Trial:
    """One signal to one program.

    Args:
        stop_s: Length of a SIGSTOP [s]; None for a SIGKILL.
        stack: Ends the programs of the trial.
        url: URL of the rig that the trials of a role share.
    """

    def __init__(self, stop_s: float | None, stack: ExitStack, url: str) -> None:
        self.stop_s, self.stack, self.url = stop_s, stack, url
        self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))

    def start(self, *arguments: str, **settings: object) -> subprocess.Popen[str]:
        """Start a Python program."""
        return self.stack.enter_context(processes.start_python(*arguments, **settings))

    def record(self, url: str) -> tuple[subprocess.Popen[str], Path]:
        """Start a recorder; return its process and its file."""
        path = self.folder / "session.mcap"
        child = self.start("-m", "rig", "record", "-o", str(path), "--connect", url.removeprefix("zenoh:"))
        processes.read_line(child, "recording")
        return child, path

    def signal(self, child: subprocess.Popen[str]) -> None:
        """Send the signal at a random time."""
        time.sleep(random.uniform(0.5, 1.5))
        if self.stop_s is None:
            child.kill()
            return
        child.send_signal(signal.SIGSTOP)
        time.sleep(self.stop_s)
        child.send_signal(signal.SIGCONT)


def start_rig(stack: ExitStack, scene: str, *arguments: str) -> tuple[subprocess.Popen[str], str]:
    """Start a rig; return its process and its URL."""
    endpoint = processes.free_endpoint()
    settings = ("--listen", endpoint, "--duration-s", "86400", *arguments)
    child = stack.enter_context(processes.start_rig("run", scene, *settings, stdout=subprocess.DEVNULL))
    processes.read_line(child, "listening on")
    return child, f"zenoh:{endpoint}"


def describe_recording(recorder: subprocess.Popen[str], path: Path) -> str:
    """Return exit status of a recorder, the reason in its file, and whether rows were lost."""
    output, _ = recorder.communicate(timeout=PATIENCE_S)
    lost = "no row lost" if "lost: nothing" in output else "rows lost, counted"
    return f"status {recorder.returncode}, {Recording.open(path).end_reason}, {lost}"


def signal_rig(trial: Trial) -> str:
    """Send the signal to a rig in real time with two clients and a recorder."""
    child, url = start_rig(trial.stack, "stable-run")
    client = trial.start("-c", READS, url)
    recorder, path = trial.record(url)
    assert client.stdout is not None
    client.stdout.readline()
    trial.signal(child)
    if trial.stop_s is not None:
        time.sleep(3.0)
        child.send_signal(signal.SIGTERM)
    said = [line.strip() for line in client.communicate(timeout=PATIENCE_S)[0].splitlines() if line != "reads"]
    return f"{', '.join(sorted(said))}; recorder: {describe_recording(recorder, path)}"


def signal_recorder(trial: Trial) -> str:
    """Send the signal to a recorder of a rig in real time."""
    recorder, path = trial.record(trial.url)
    trial.signal(recorder)
    if trial.stop_s is not None:
        time.sleep(8.0)
        recorder.send_signal(signal.SIGTERM)
        return f"recorder: {describe_recording(recorder, path)}"
    with rig.connect(trial.url) as machine:
        killed_s = machine.status()["time_s"]
    recorder.wait()
    recovered = trial.folder / "recovered.mcap"
    status = trial.start("-m", "rig", "recover", f"{path}.part", "-o", str(recovered)).wait()
    missing_s = killed_s - float(Recording.open(recovered).samples("probes").times_s[-1])
    missing = "less than 1 s missing" if missing_s < 1.0 else f"{missing_s:.1f} s missing"
    return f"rig recover: status {status}, {missing}"


def signal_device(trial: Trial) -> str:
    """Send the signal to a device in lockstep while the rig is stepped."""
    with rig.connect(trial.url, name="bench") as machine:
        device = trial.start("-c", DEVICE, trial.url)
        machine.event(lambda event: event["event"] == "device" and event["state"] == "joined", timeout_s=PATIENCE_S)
        machine.step(100_000)
        with ThreadPoolExecutor(1) as sender:
            sending = sender.submit(trial.signal, device)
            lost: dict[str, str] = {}
            while not lost:
                lost = dict(machine.step(10_000).lost)
                time.sleep(0.01)
            machine.step(100_000)
            sending.result()
        said = device.communicate(timeout=PATIENCE_S)[0].split()[1:] if trial.stop_s else []
        reason = lost["guard"].partition(" that ends")[0]
        return f"rig continues; lost: {reason}; device: {' '.join(said) or 'killed'}"


def signal_campaign(trial: Trial) -> str:
    """Send the signal to a campaign while its device runs."""
    mark = f"RIG_TRIAL={trial.folder.name}"
    environment = {**os.environ, "RIG_TRIAL": trial.folder.name, "PYTHONPATH": str(processes.ROOT)}
    campaign = trial.start(
        "-m", "rig", "campaign", "protection-trip", "-o", str(trial.folder / "out"), env=environment,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    until(lambda: any(b"drivers.protection" in command for command in marked(mark)), of=campaign, timeout_s=300.0)
    trial.signal(campaign)
    campaign.wait(timeout=300.0)
    if trial.stop_s is not None:
        return f"status {campaign.returncode}"
    until(lambda: not marked(mark), timeout_s=PATIENCE_S)
    return "no process left"


def marked(mark: str) -> list[bytes]:
    """Return the command lines of the processes with this text in their environment, except ended ones."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (process / "environ").read_bytes().split(b"\0"):
                found.append((process / "cmdline").read_bytes())
        except OSError:  # it has ended
            continue
    return found


ROLES: dict[str, Callable[[Trial], str]] = {
    "rig": signal_rig, "recorder": signal_recorder, "device": signal_device, "campaign": signal_campaign,
}  # fmt: skip
SCENES = {"recorder": ("stable-run",), "device": ("hammer", "--pace", "lockstep")}
"""Rigs that all trials of a role share."""


def run_role(role: str) -> Counter[tuple[str, str, str]]:
    """Run the trials of a role, one after another; return the number of each outcome."""
    counts: Counter[tuple[str, str, str]] = Counter()
    with ExitStack() as shared:
        url = start_rig(shared, *SCENES[role])[1] if role in SCENES else ""
        for stop_s in (*STOPS_S, *[None] * KILLS):
            with ExitStack() as stack:
                try:
                    outcome = ROLES[role](Trial(stop_s, stack, url))
                except Exception as error:
                    outcome = f"FAILED {type(error).__name__}: {' '.join(str(error).split())}"
            sent = "SIGKILL" if stop_s is None else f"SIGSTOP {stop_s:g} s"
            counts[role, sent, outcome] += 1
            print(role, sent, outcome, file=sys.stderr, flush=True)
    return counts


def main(roles: list[str]) -> None:
    """Run the roles at the same time, and print the outcomes as a table."""
    with ThreadPoolExecutor(len(ROLES)) as pool:
        for counts in pool.map(run_role, roles or list(ROLES)):
            for (role, sent, outcome), count in sorted(counts.items()):
                print(f"| {role} | {sent} | {count} | {outcome} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
