"""Generated inputs for everything that takes something from outside; RIG_FUZZ_INPUTS says how many."""

import os


def inputs(default: int) -> int:
    """Number of generated inputs."""
    return int(os.environ.get("RIG_FUZZ_INPUTS", default))
