"""The wall clock of the tests, in one place: a test waits for a condition, and asserts no time.

A busy machine may delay any thread or process by seconds. So a test names the condition that it waits for, and fails
only after a time that no machine needs.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PATIENCE_S = 120.0
"""Longer than any wait that succeeds; only a failing test waits this long."""


def until(
    condition: Callable[[], object],
    *,
    of: subprocess.Popen[str] | None = None,
    timeout_s: float = PATIENCE_S,
    every_s: float = 0.01,
) -> None:
    """Wait until a condition holds.

    Args:
        condition: The condition to wait for.
        of: The process that must run for the condition to become true; fail as soon as it has ended.
        timeout_s: Longest wait [s].
        every_s: Period of the checks [s].

    Raises:
        AssertionError: Timeout, or the process has ended; the message has its output.
    """
    deadline = time.monotonic() + timeout_s
    while not condition():
        if of is not None and of.poll() is not None:
            assert condition(), f"the process ended with status {of.returncode} before that:\n{_output_of(of)}"
            return
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(every_s)


def _output_of(ended: subprocess.Popen[str]) -> str:
    """Return the unread output of an ended process."""
    try:
        return "".join(part or "" for part in ended.communicate(timeout=5.0))
    except subprocess.TimeoutExpired:
        return "(a child of it still holds its output)"


@contextmanager
def time_limit(limit_s: float) -> Iterator[None]:
    """Fail if the body takes longer: a limit on a wait that must not occur, never a speed."""
    begin = time.monotonic()
    yield
    assert time.monotonic() - begin < limit_s
