"""The wall clock of the tests, in one place: a test waits for what must come, and asserts no time.

A machine that is busy with other work may hold any thread or process up for seconds. So a test names the condition that
it waits for, and what is waited for in vain is a failure only after a time that no machine needs.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PATIENCE_S = 60.0
"""Nothing that comes at all takes this long; a test that passes never waits so long."""


def until(
    condition: Callable[[], object],
    *,
    of: subprocess.Popen[str] | None = None,
    timeout_s: float = PATIENCE_S,
    every_s: float = 0.01,
) -> None:
    """Wait until a condition holds.

    Args:
        condition: What to wait for.
        of: The process that has to run for the condition to come true; fail as soon as it has ended.
        timeout_s: Longest wait [s].
        every_s: Time between two looks at the condition [s].

    Raises:
        AssertionError: The time is over, or the process has ended; the message has its output.
    """
    deadline = time.monotonic() + timeout_s
    while not condition():
        if of is not None and of.poll() is not None:
            assert condition(), f"the process ended with status {of.returncode} before that:\n{_output_of(of)}"
            return
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(every_s)


def _output_of(ended: subprocess.Popen[str]) -> str:
    """Return what an ended process printed and nobody has read."""
    try:
        return "".join(part or "" for part in ended.communicate(timeout=5.0))
    except subprocess.TimeoutExpired:
        return "(a child of it still holds its output)"


@contextmanager
def sooner_than(limit_s: float) -> Iterator[None]:
    """Fails where what is done inside lasted so long: a limit that was not to be waited for, never a speed."""
    begin = time.monotonic()
    yield
    assert time.monotonic() - begin < limit_s
