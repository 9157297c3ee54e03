"""Reads ahead of who paces, on a thread of its own: the disk and the unpacking must not make a payload late."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

_BYTES = 16 << 20
"""What may wait: about 5 s of the default streams."""
T = TypeVar("T")


class ReadAhead(Generic[T]):
    """Takes from an iterator what fits, until it is closed.

    Args:
        batches: What is read.
        size: How many bytes one of them takes.
    """

    def __init__(self, batches: Iterator[T], *, size: Callable[[T], int]) -> None:
        self._batches = batches
        self._size = size
        self._waiting: deque[T] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._done = False
        self._closed = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._read, name="read-ahead", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def ended(self) -> bool:
        """Nothing is left.

        Raises:
            BaseException: What ended the reading, once all that came before it was taken.
        """
        with self._changed:
            if not self._done or self._waiting:
                return False
        if self._error is not None:
            raise self._error
        return True

    def ready(self, timeout_s: float) -> bool:
        """Whether something can be taken, at the latest after the time."""
        with self._changed:
            if not self._waiting and not self._done:
                self._changed.wait(timeout_s)
            return bool(self._waiting)

    def take(self) -> T:
        """The next; only after `ready`."""
        with self._changed:
            batch = self._waiting.popleft()
            self._bytes -= self._size(batch)
            self._changed.notify_all()
            return batch

    def close(self) -> None:
        """Read no more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout=5.0)

    def _read(self) -> None:
        try:
            for batch in self._batches:
                with self._changed:
                    while self._bytes >= _BYTES and not self._closed:
                        self._changed.wait()
                    if self._closed:
                        return
                    self._waiting.append(batch)
                    self._bytes += self._size(batch)
                    self._changed.notify_all()
        except BaseException as error:  # raised where it is taken
            self._error = error
        finally:
            with self._changed:
                self._done = True
                self._changed.notify_all()
