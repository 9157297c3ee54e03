"""Generated inputs against every door. `RIG_FUZZ_INPUTS=N` makes the runs long: about N inputs for each test."""

from __future__ import annotations

import os


def inputs(default: int) -> int:
    """How many inputs a test generates."""
    return int(os.environ.get("RIG_FUZZ_INPUTS", default))
