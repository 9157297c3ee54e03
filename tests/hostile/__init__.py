"""What comes from outside, generated: each door takes it, refuses it in one line, or tells what is wrong with it."""

from __future__ import annotations

import os


def inputs(default: int) -> int:
    """Number of inputs of a test: short in the suite, as many as RIG_FUZZ_INPUTS says in a long run."""
    return int(os.environ.get("RIG_FUZZ_INPUTS", default))
