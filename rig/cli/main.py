"""Entry of the `rig` command: listens to signals before anything else is loaded."""

from __future__ import annotations

import signal
import sys
from types import FrameType

ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that end a command in good order; SIGHUP only where it is not ignored, as under nohup."""


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def main(arguments: list[str] | None = None) -> None:
    """Run the command: exit status 2 and one line for wrong input, 1 for a failed run or verdict, 130 for signals."""
    for number in ENDING:
        # A shell starts what runs in its background with SIGINT ignored; whoever sends it all the same means it.
        if number == signal.SIGINT or signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _interrupt)
    try:
        from rig.cli.app import start
    except KeyboardInterrupt:
        print("rig: interrupted", file=sys.stderr)
        sys.exit(130)
    start(arguments)


if __name__ == "__main__":
    main()
