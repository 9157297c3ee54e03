"""Waiting of threads: for a deadline, and for items in a bounded queue.

Every wait with a deadline uses `Deadline` or `wait_until`; tests/house/test_one_deadline.py finds others. On a full
queue, `offer` refuses an item, `push` drops the oldest, and `put` waits.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")
POLL_S = 0.02
"""Default period of checking a condition that no thread notifies [s]."""


class Deadline:
    """A deadline on the monotonic clock.

    Args:
        timeout_s: Time from now to the deadline [s]; None: never.
    """

    def __init__(self, timeout_s: float | None) -> None:
        self._end_s = math.inf if timeout_s is None else time.monotonic() + timeout_s

    @property
    def left_s(self) -> float:
        """Remaining time [s]: 0 after the deadline, infinite without one."""
        return max(0.0, self._end_s - time.monotonic())

    @property
    def passed(self) -> bool:
        """Whether the deadline has passed."""
        return time.monotonic() >= self._end_s

    def wait(self, changed: threading.Condition) -> bool:
        """Wait until a condition is notified, at most until the deadline.

        Args:
            changed: The condition, whose lock is held.

        Returns:
            True: check the state again. False, without a wait: the deadline has passed.
        """
        left_s = self.left_s
        if left_s > 0.0:
            changed.wait(None if math.isinf(left_s) else left_s)
        return left_s > 0.0

    def polls(self, every_s: float = POLL_S) -> Iterator[None]:
        """Yield at once, then after each pause, the last time when the deadline has passed.

        Args:
            every_s: Length of a pause [s].
        """
        while True:
            passed = self.passed
            yield
            if passed:
                return
            time.sleep(min(every_s, self.left_s))


def wait_until(condition: Callable[[], object], timeout_s: float, *, every_s: float = POLL_S) -> bool:
    """Check a condition repeatedly until it holds or the time is over.

    Args:
        condition: Returns whether it holds.
        timeout_s: Longest wait [s].
        every_s: Time between two checks [s].

    Returns:
        Whether it holds.
    """
    return any(condition() for _ in Deadline(timeout_s).polls(every_s))


class BoundedQueue(Generic[T]):
    """A first-in first-out queue for any threads.

    Args:
        room: Capacity, in the unit of `size`.
        size: Returns the size of an item.
        holds: Count the item taken last until the next one is taken: it is in memory while it is processed.
        inherit: Called with a dropped item and the following one, before that can be taken. Without it, items of size 0
            are never dropped.
        changed: Condition shared with other queues, to wait for all of them (`take_first`).

    Attributes:
        used: Size of the waiting items and, with `holds`, of the item taken last.
        high_water: Largest value of `used`.
        dropped: Number of items refused or dropped because the queue was full, except those of size 0.
        closed: Whether `offer` and `put` add no more items; waiting items can still be taken.
    """

    def __init__(
        self,
        room: int,
        *,
        size: Callable[[T], int] = lambda _: 1,
        holds: bool = False,
        inherit: Callable[[T, T], None] | None = None,
        changed: threading.Condition | None = None,
    ) -> None:
        self.room = room
        self.used = self.high_water = self.dropped = 0
        self.closed = False
        self._size = size
        self._holds = holds
        self._held = 0
        self._inherit = inherit
        self._changed = changed or threading.Condition()
        self._items: deque[T] = deque()

    def __len__(self) -> int:
        return len(self._items)

    @property
    def ended(self) -> bool:
        """Whether it is closed and empty."""
        return self.closed and not self._items

    def offer(self, item: T, *, room: int | None = None) -> bool:
        """Add an item if it fits, in `room` if given; return whether it was added."""
        size = self._size(item)
        with self._changed:
            if self.closed:
                return False
            if self.used + size > (self.room if room is None else room):
                self.dropped += 1
                return False
            self._add(item, size)
            return True

    def push(self, item: T) -> int:
        """Add an item and drop the oldest ones until it fits; return how many were dropped, except those of size 0.

        A closed queue accepts it too, for as long as its items are still taken.
        """
        size, dropped = self._size(item), 0
        with self._changed:
            while self._items and size and self.used + size > self.room:
                sizes = enumerate(map(self._size, self._items))
                place = 0 if self._inherit else next((n for n, each in sizes if each), 0)
                oldest = self._items[place]
                del self._items[place]
                if self._inherit is not None:
                    self._inherit(oldest, self._items[0] if self._items else item)
                self.used -= self._size(oldest)
                dropped += self._size(oldest) > 0
            self.dropped += dropped
            self._add(item, size)
        return dropped

    def put(self, item: T, timeout_s: float | None = None) -> bool:
        """Add an item as soon as it fits; return False if the queue is closed, or stays full until the timeout."""
        size = self._size(item)
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self.used + size <= self.room, timeout_s)
            if self.closed or self.used + size > self.room:
                return False
            self._add(item, size)
            return True

    def wait_for_room(self, timeout_s: float) -> bool:
        """Return whether the queue has room, waiting at most this long [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self.used < self.room, timeout_s)

    def wait_for_item(self, timeout_s: float) -> bool:
        """Return whether an item can be taken, waiting at most this long [s]."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self.closed, timeout_s)
            return bool(self._items)

    def take(self, timeout_s: float | None = None) -> T | None:
        """Return the oldest item; None after the timeout [s], or if the queue is closed and empty."""
        return next(iter(self.take_many(1, timeout_s)), None)

    def take_many(self, most: int, timeout_s: float | None = None) -> list[T]:
        """Return the oldest items, as soon as there are any; none after the timeout [s], or if closed and empty."""
        with self._changed:
            if self._held:
                self.used, self._held = self.used - self._held, 0
                self._changed.notify_all()
            if not self._items:
                self._changed.wait_for(lambda: self._items or self.closed, timeout_s)
            items = [self._items.popleft() for _ in range(min(most, len(self._items)))]
            size = sum(map(self._size, items))
            if self._holds:
                self._held = size
            else:
                self.used -= size
            self._changed.notify_all()
            return items

    def clear(self) -> None:
        """Remove all waiting items."""
        with self._changed:
            self._items.clear()
            self.used = self._held
            self._changed.notify_all()

    def close(self) -> None:
        """Close the queue and wake all waiting threads."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def _add(self, item: T, size: int) -> None:
        self._items.append(item)
        self.used += size
        self.high_water = max(self.high_water, self.used)
        self._changed.notify_all()


def take_first(
    changed: threading.Condition, queues: tuple[BoundedQueue[T], ...], timeout_s: float | None = None
) -> T | None:
    """Return the oldest item of the first queue that has one; None after the timeout, or if one is closed and empty.

    Args:
        changed: Condition shared by the queues.
        queues: The queues, in order of priority.
        timeout_s: Longest wait [s]; None: without limit.
    """
    with changed:
        changed.wait_for(lambda: any(len(queue) or queue.closed for queue in queues), timeout_s)
        waiting = next((queue for queue in queues if len(queue)), None)
        return None if waiting is None else waiting.take()
