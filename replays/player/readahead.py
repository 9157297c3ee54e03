"""Reads ahead of who paces, on a thread of its own: the disk and the unpacking must not make a payload late."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

from rig.serve.waiting import BoundedQueue

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
        self._waiting: BoundedQueue[T] = BoundedQueue(_BYTES, size=lambda batch: min(size(batch), _BYTES))
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._read, args=(batches,), name="read-ahead", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def ended(self) -> bool:
        """Nothing is left.

        Raises:
            BaseException: What ended the reading, once all that came before it was taken.
        """
        if self._waiting.ended and self._error is not None:
            raise self._error
        return self._waiting.ended

    def ready(self, timeout_s: float) -> bool:
        """Whether something can be taken, at the latest after the time [s]."""
        return self._waiting.wait_for_item(timeout_s)

    def take(self, timeout_s: float = 0.0) -> T | None:
        """The next, or None where there is none in time [s]."""
        return self._waiting.take(timeout_s)

    def close(self) -> None:
        """Read no more."""
        self._waiting.close()
        self._thread.join(timeout=5.0)

    def _read(self, batches: Iterator[T]) -> None:
        try:
            for batch in batches:
                if not self._waiting.put(batch):
                    return
        except BaseException as error:  # raised where it is taken
            self._error = error
        finally:
            self._waiting.close()
