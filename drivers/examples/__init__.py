"""Examples of about ten lines for the instrument drivers and the DAQ client: `python -m drivers.examples.NAME`."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable
from typing import Any

from rig.base.errors import InputError


def run_example(main: Callable[..., Any], max_urls: int = 1) -> None:
    """Run an example with the URLs of the command line, and print a missing rig or instrument as one line.

    Args:
        main: The example.
        max_urls: Largest number of URLs.
    """
    try:
        if len(sys.argv) > max_urls + 1:
            raise InputError("arguments", f"at most {max_urls}: the URLs of rig and instruments", sys.argv[1:])
        result = main(*sys.argv[1:])
        if asyncio.iscoroutine(result):
            asyncio.run(result)
    except (ConnectionError, EOFError, InputError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
