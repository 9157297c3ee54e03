"""Read-ahead on a separate thread, so that disk access and decompression do not delay payloads."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

from rig.serve.waiting import BoundedQueue

_BUFFER_BYTES = 16 << 20
"""Buffer size, about 5 s of the default streams [bytes]."""
T = TypeVar("T")


class ReadAhead(Generic[T]):
    """Buffers items of an iterator up to a size, until it is closed.

    Args:
        batches: Iterator to read.
        size: Function that returns the size of an item [bytes].
    """

    def __init__(self, batches: Iterator[T], *, size: Callable[[T], int]) -> None:
        self._waiting: BoundedQueue[T] = BoundedQueue(_BUFFER_BYTES, size=lambda batch: min(size(batch), _BUFFER_BYTES))
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._read, args=(batches,), name="read-ahead", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def ended(self) -> bool:
        """True if all items have been taken.

        Raises:
            BaseException: The error that ended reading, after all items before it have been taken.
        """
        if self._waiting.ended and self._error is not None:
            raise self._error
        return self._waiting.ended

    def ready(self, timeout_s: float) -> bool:
        """Wait up to a time [s] and return whether an item is ready."""
        return self._waiting.wait_for_item(timeout_s)

    def take(self, timeout_s: float = 0.0) -> T | None:
        """Return the next item, or None if there is none within a time [s]."""
        return self._waiting.take(timeout_s)

    def close(self) -> None:
        """Stop reading."""
        self._waiting.close()
        self._thread.join(timeout=5.0)

    def _read(self, batches: Iterator[T]) -> None:
        try:
            for batch in batches:
                if not self._waiting.put(batch):
                    return
        except BaseException as error:  # raised by `ended`
            self._error = error
        finally:
            self._waiting.close()
