"""Calls on background threads, with results taken in order and a bounded queue."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

_MAX_PENDING = 4


class Background:
    """Background calls; an error of one is raised by a later `call`, or by `finish`."""

    def __init__(self, take: Callable[[Any], object] = lambda result: None, *, threads: int = 1) -> None:
        """Start the threads.

        Args:
            take: Callback for each result, in order, on the caller's thread.
            threads: Number of threads.
        """
        self._take = take
        self._pool = ThreadPoolExecutor(max_workers=threads)
        self._due: deque[Future[Any]] = deque()

    def call(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Queue a call; wait while too many are pending."""
        self._due.append(self._pool.submit(function, *arguments))
        while len(self._due) > _MAX_PENDING:
            self._take(self._due.popleft().result())

    def finish(self) -> None:
        """Wait for all calls; those after an error are cancelled."""
        try:
            while self._due:
                self._take(self._due.popleft().result())
        finally:
            self._pool.shutdown(cancel_futures=True)
