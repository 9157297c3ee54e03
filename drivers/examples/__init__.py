"""Programs of about ten lines that use drivers and DAQ client; each runs as `python -m drivers.examples.NAME`."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable
from typing import Any

from rig.base.errors import InputError


def run(main: Callable[..., Any], most: int = 1) -> None:
    """Run an example with the URLs of the command line; a rig or an instrument that is not there is told in one line.

    Args:
        main: The example.
        most: URLs that it takes.
    """
    try:
        if len(sys.argv) > most + 1:
            raise InputError("arguments", f"at most {most}: the URLs of rig and instruments", sys.argv[1:])
        done = main(*sys.argv[1:])
        if asyncio.iscoroutine(done):
            asyncio.run(done)
    except (ConnectionError, EOFError, InputError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
