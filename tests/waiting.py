"""The wall clock of the tests, in one place: a test waits for what must come, and asserts no time.

A machine that is busy with other work may hold any thread or process up for seconds. So a test names the condition that
it waits for, and what is waited for in vain is a failure only after a time that no machine needs.
"""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 60.0
"""Nothing that comes at all takes this long; a test that passes never waits so long."""


def until(condition: Callable[[], object], *, timeout_s: float = PATIENCE_S, every_s: float = 0.002) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(every_s)


def ever(condition: Callable[[], object], *, within_s: float) -> bool:
    """True as soon as a condition holds, False where it never did: for what must *not* come, and what may."""
    deadline = time.monotonic() + within_s
    while not condition():
        if time.monotonic() >= deadline:
            return False
        time.sleep(0.002)
    return True
