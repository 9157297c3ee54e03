"""Examples of the package nidaqmx against a live rig: the first table of docs/daqmx.md.

RIG_NIDAQMX_EXAMPLES names the folder `examples` of ni/nidaqmx-python. The examples are changed only in `grpc_options`
and run on a device of the name that they have.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest
from nidaqmx.error_codes import DAQmxErrors

from drivers.console import Console
from rig.base.errors import RefusedError
from tests import processes
from tests.waiting import PATIENCE_S, until

EXAMPLES = os.environ.get("RIG_NIDAQMX_EXAMPLES")
FOLDERS = ("analog_in", "counter_in", "digital_out")
LEAST_SHARE = 0.6
RUNNER = """
import runpy, sys
import grpc, nidaqmx
from nidaqmx.system import System

options = nidaqmx.GrpcSessionOptions(grpc.insecure_channel(sys.argv[1]), "")
create = nidaqmx.Task.__init__
nidaqmx.Task.__init__ = lambda task, name="": create(task, name, grpc_options=options)
System.local = staticmethod(lambda: System.remote(options))
runpy.run_path(sys.argv[2], run_name="__main__")
"""


@contextmanager
def hits(console: Console) -> Iterator[None]:
    """Send a hammer command every 0.3 s."""
    done = threading.Event()

    def hit() -> None:
        while not done.wait(0.3):
            with suppress(RefusedError):
                console.hammer()

    thread = threading.Thread(target=hit)
    thread.start()
    yield
    done.set()
    thread.join()


def run(example: Path, port: int, folder: Path) -> str:
    """Run an example until it has ended, or has reported samples and was ended as it asks for; return the result."""
    out, err = folder / "out.txt", folder / "err.txt"
    text = example.read_text(encoding="utf-8-sig")
    asks, counts = "input(" in text, "while True" in text or "Total" in text
    with ExitStack() as stack, out.open("w") as stdout, err.open("w") as stderr:
        command = [sys.executable, "-u", "-c", RUNNER, f"127.0.0.1:{port}", str(example)]
        environment = os.environ | {"MPLBACKEND": "Agg"}
        program = stack.enter_context(
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=stdout, stderr=stderr, cwd=folder, env=environment)
        )
        shows = re.compile("(Total|count:) [1-9]" if counts else "Press Enter" if asks else "(?!)")
        until(lambda: program.poll() is not None or shows.search(out.read_text()) is not None)
        if program.poll() is None and asks:
            time.sleep(0.5)  # some samples of the pattern
            program.communicate(b"\n", PATIENCE_S)
        elif program.poll() is None:
            program.send_signal(signal.SIGINT)
        status = program.wait(PATIENCE_S)
    error = err.read_text().strip()
    if status == 0 and (not counts or shows.search(out.read_text())):
        return "runs"
    code = re.findall(r"Status Code: (-\d+)", error)
    assert code, f"{example.name} ended with status {status}: {error}"
    return f"refused: {code[-1]} `{DAQmxErrors(int(code[-1])).name}`"


@pytest.mark.skipif(not EXAMPLES, reason="RIG_NIDAQMX_EXAMPLES names no folder of examples")
def test_the_examples_give_the_first_table_of_the_page(tmp_path: Path) -> None:
    root, rows = Path(EXAMPLES or ""), {}
    with ExitStack() as stack:
        _, endpoint = stack.enter_context(processes.running_rig("stable-run", "--set", "duration_s=600"))
        console = stack.enter_context(Console.open(f"zenoh:{endpoint}", wait_s=PATIENCE_S))
        ports: dict[str, int] = {}
        stack.enter_context(hits(console))
        for example in sorted(path for folder in FOLDERS for path in (root / folder).glob("*.py")):
            found = re.search(r'"/?(\w+)/(ai|ctr|port)\d', example.read_text(encoding="utf-8-sig"))
            assert found is not None
            if (name := found[1]) not in ports:
                arguments = ("--listen", "127.0.0.1:0", "--device", name, "--allow-commands")
                server = stack.enter_context(processes.start_rig("daqmx", "--connect", endpoint, *arguments))
                ports[name] = int(processes.read_line(server, "NI-DAQmx device").rpartition(":")[2].partition(";")[0])
            rows[example.relative_to(root).as_posix()] = run(example, ports[name], tmp_path)
            print(example.name, rows[example.relative_to(root).as_posix()])
        assert console.status()["state"] != "ended", "an example ended the run"
        console.stop()
    table = "\n".join(
        ["| example | result |", "|---|---|", *(f"| `{name}` | {result} |" for name, result in rows.items())]
    )
    (tmp_path / "table.md").write_text(table, encoding="utf-8")
    print(table)
    page = (processes.ROOT / "docs/daqmx.md").read_text(encoding="utf-8")
    assert list(rows.values()).count("runs") >= LEAST_SHARE * len(rows)
    assert re.findall(r"(?m)^\|.*(?:\n\|.*)*", page)[0] == table
