"""The wall clock of the tests, in one place: a test waits for what must come, and asserts no time.

A machine that is busy with other work may hold any thread or process up for seconds. So a test names the condition that
it waits for, and what is waited for in vain is a failure only after a time that no machine needs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PATIENCE_S = 60.0
"""Nothing that comes at all takes this long; a test that passes never waits so long."""


def until(condition: Callable[[], object], *, timeout_s: float = PATIENCE_S, every_s: float = 0.002) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(every_s)


@contextmanager
def sooner_than(limit_s: float) -> Iterator[None]:
    """Fails where what is done inside lasted so long: a limit that was not to be waited for, never a speed."""
    begin = time.monotonic()
    yield
    assert time.monotonic() - begin < limit_s
