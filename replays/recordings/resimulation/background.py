"""Work on threads of its own, its results taken in order, a few calls behind at most."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

_AHEAD = 4


class Background:
    """Calls that go on while the caller does; an error of one is raised by a later `call`, or by `finish`."""

    def __init__(self, take: Callable[[Any], object] = lambda result: None, *, threads: int = 1) -> None:
        """Begin.

        Args:
            take: Given each result, in order, on the caller's thread.
            threads: How many work at a time.
        """
        self._take = take
        self._pool = ThreadPoolExecutor(max_workers=threads)
        self._due: deque[Future[Any]] = deque()

    def call(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Do this next."""
        self._due.append(self._pool.submit(function, *arguments))
        while len(self._due) > _AHEAD:
            self._take(self._due.popleft().result())

    def finish(self) -> None:
        """Wait for everything; what waits behind an error is not done."""
        try:
            while self._due:
                self._take(self._due.popleft().result())
        finally:
            self._pool.shutdown(cancel_futures=True)
