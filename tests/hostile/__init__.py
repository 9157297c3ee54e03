"""Generated hostile input: each interface must accept it, refuse it in one line, or report what is wrong with it."""

from __future__ import annotations

import contextlib
import os
import resource
import time
import traceback
from collections.abc import Iterator
from typing import Any

from rig.base.errors import DiskError, InputError

MAX_INPUT_S = 20.0


def input_count(default: int) -> int:
    """Return the number of inputs of a test: `default` in the suite, RIG_FUZZ_INPUTS in a long run."""
    return int(os.environ.get("RIG_FUZZ_INPUTS", default))


class InputTally:
    """Counts of inputs by result: accepted, refused in one line, or a fault. Each fault is kept once with its place."""

    def __init__(self) -> None:
        self.accepted = self.refused = 0
        self.faults: dict[str, Any] = {}

    @contextlib.contextmanager
    def attempt(self, what: object, *also: type[Exception]) -> Iterator[None]:
        """Try one input; `what` identifies it in the report of a fault."""
        begin = time.monotonic()
        try:
            yield
            self.accepted += 1
        except (InputError, DiskError, *also) as error:
            self.refused += 1
            line = str(error)
            if not line.isprintable() or len(line) > 6000:
                self.faults[f"a line of {len(line)} characters"] = line[:300]
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            place = " < ".join(f"{frame.filename.rsplit('/', 1)[-1]}:{frame.lineno}" for frame in frames[:-4:-1])
            self.faults.setdefault(f"{type(error).__name__} at {place}", (str(error)[:200], what))
        if time.monotonic() - begin > MAX_INPUT_S:
            self.faults["too long"] = what


def check_tallies(tallies: dict[str, InputTally]) -> None:
    """Print the counts, and fail if there is a fault."""
    for name, tally in tallies.items():
        print(f"{name}: {tally.accepted} accepted, {tally.refused} refused, {len(tally.faults)} kinds of faults")
    print(f"largest memory of the process {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
    found = [f"{name}: {place}: {what}" for name, tally in tallies.items() for place, what in tally.faults.items()]
    assert not found, "\n".join(found)
