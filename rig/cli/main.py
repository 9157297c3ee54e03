"""Entry of the `rig` command: listens to signals before anything else is loaded."""

from __future__ import annotations

import gc
import io
import os
import sys

from rig.cli import signals


def main(arguments: list[str] | None = None) -> None:
    """Run the command: exit status 2 and one line for wrong input, 1 for a failed run or verdict, 130 for signals."""
    try:
        from rig.cli.app import start
    except KeyboardInterrupt:
        print("rig: interrupted", file=sys.stderr)
        sys.exit(130)
    start(arguments)


def entry() -> None:
    """Run the command as a process of its own."""
    # Matrices here are thin: threads of BLAS that wait for each other take half of the processor's time and give
    # nothing back, and what they sum depends on how many there are.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    signals.listen()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # what a terminal's encoding lacks is no reason to fail
    try:
        main()
    finally:
        signals.ignore()
        gc.freeze()  # looking for garbage in a process that ends took a quarter of a short run's processor time
