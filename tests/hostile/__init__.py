"""Generated hostile input: each interface must accept it, refuse it in one line, or report what is wrong with it."""

from __future__ import annotations

import contextlib
import os
import re
import resource
import signal
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rig.base.errors import DiskError, InputError

MAX_INPUT_S = 120.0
"""Longest wall time of an input [s], long enough for a loaded computer."""
MAX_CPU_S = 2.0
"""Longest processor time of an input [s], by which a loaded computer is not a hang."""
MAX_GROWTH_MB = 500.0
"""Largest growth of the memory by an input [MB]."""


class HangError(BaseException):
    """An input takes too long; not an Exception, as those of libraries are translated."""


@contextlib.contextmanager
def limit_processor_time(limit_s: float) -> Iterator[None]:
    """Raise HangError in the main thread after some processor time of the process [s]."""

    def end(*_: object) -> None:
        raise HangError(f"more than {limit_s:g} s of processor time")

    before = signal.signal(signal.SIGPROF, end)
    signal.setitimer(signal.ITIMER_PROF, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def memory_mb(name: str) -> float:
    """Return a size of this process's memory, such as VmRSS or its peak VmHWM [MB]; 0 if the system does not tell."""
    with contextlib.suppress(OSError):
        if found := re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text()):
            return int(found[1]) / 1024
    return 0.0


def reset_peak() -> None:
    """Set the peak of the memory to its present size, where the system can."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def input_count(default: int) -> int:
    """Return the number of inputs of a test: `default` in the suite, RIG_FUZZ_INPUTS in a long run."""
    return int(os.environ.get("RIG_FUZZ_INPUTS", default))


class InputTally:
    """Counts of inputs by result: accepted, refused in one line, or a fault. Each fault is kept once with its place."""

    def __init__(self) -> None:
        self.accepted = self.refused = 0
        self.fresh, self.peak_mb = False, 0.0
        self.faults: dict[str, Any] = {}

    @contextlib.contextmanager
    def attempt_within_limits(self, what: object) -> Iterator[None]:
        """Try one input as `attempt`, also with limits of its processor time and memory."""
        reset_peak()
        start_mb, begin_s = memory_mb("VmHWM"), time.process_time()
        try:
            with limit_processor_time(MAX_CPU_S), self.attempt(what):
                yield
        except HangError as error:
            frames = traceback.extract_tb(error.__traceback__)
            places = [f"{frame.filename.rsplit('/', 1)[-1]}:{frame.lineno}" for frame in frames[:-6:-1]]
            self.faults.setdefault(f"hang at {' < '.join(places)}", what)
        else:
            if time.process_time() - begin_s > MAX_CPU_S:
                self.faults.setdefault("hang", what)
        peak_mb = memory_mb("VmHWM")
        self.peak_mb = max(self.peak_mb, peak_mb)
        if peak_mb - start_mb > MAX_GROWTH_MB:
            self.faults.setdefault(
                f"memory grows by more than {MAX_GROWTH_MB:.0f} MB", (round(peak_mb - start_mb), what)
            )

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
