"""Entry point of the `rig` command; handles signals before anything else is imported."""

from __future__ import annotations

import gc
import io
import logging
import os
import sys
import warnings

from rig.cli import signals


def main(arguments: list[str] | None = None) -> None:
    """Run the command. Exit status: 2 for wrong input (one line), 1 for a failed run or verdict, 130 after a signal."""
    try:
        from rig.cli.app import start
    except KeyboardInterrupt:
        print("rig: interrupted", file=sys.stderr)
        sys.exit(130)
    start(arguments)


def _open_closed_streams() -> None:
    """Open the null device for a standard stream that is closed; the next opened file would take its number."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115 until the process ends


def entry() -> None:
    """Run the command as a separate process."""
    # The matrices are small: threads of BLAS waiting for each other take half of the processor time without any gain,
    # and the rounding of sums depends on the number of threads.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    signals.listen()
    _open_closed_streams()
    # Libraries log and warn with texts of the input, which may control a terminal; the command reports what is wrong.
    logging.getLogger().addHandler(logging.NullHandler())
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a character missing from the encoding is escaped
    try:
        main()
    finally:
        signals.ignore()
        gc.freeze()  # a final collection would take 25 % of a short run's processor time
