"""Waiting of one thread for others: until a deadline, and for items in a bounded queue.

Every wait with a deadline goes through `Deadline` or `wait_until`; tests/house/test_one_deadline.py finds another.
Whoever adds an item to a queue chooses what happens where there is no room: `offer` refuses it, `push` drops the
oldest, and `put` waits.
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
"""Usual time between two looks at a condition of which no thread notifies [s]."""


class Deadline:
    """An end of waiting, on the monotonic clock.

    Args:
        timeout_s: Time from now to the deadline [s]; None: never.
    """

    def __init__(self, timeout_s: float | None) -> None:
        self._end_s = math.inf if timeout_s is None else time.monotonic() + timeout_s

    @property
    def left_s(self) -> float:
        """Time that is left [s]: 0 once the deadline has passed, infinite without one."""
        return max(0.0, self._end_s - time.monotonic())

    @property
    def passed(self) -> bool:
        """Whether the deadline has passed."""
        return time.monotonic() >= self._end_s

    def wait(self, changed: threading.Condition) -> bool:
        """Wait until a condition is notified, at the latest until the deadline.

        Args:
            changed: The condition, whose lock is held.

        Returns:
            True: check again what is waited for. False, without a wait: the deadline has passed.
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
    """Look at a condition again and again until it holds or the time is over.

    Args:
        condition: Returns whether it holds.
        timeout_s: Longest wait [s].
        every_s: Time between two looks [s].

    Returns:
        Whether it holds.
    """
    return any(condition() for _ in Deadline(timeout_s).polls(every_s))


class BoundedQueue(Generic[T]):
    """First in, first out; from any thread.

    Args:
        room: What may wait, in the unit of `size`.
        size: What an item takes of it.
        holds: Whether what was taken counts until something else is taken: it is in memory while it is dealt with.
        inherit: Called with an item that is dropped and the one after it, before anybody can take that. Without it,
            items that take no room are never dropped.
        changed: Condition that is shared with other queues, to wait for all of them (`take_first`).

    Attributes:
        used: What waits takes of the room, and with `holds` what was taken last.
        high_water: Most that was ever used.
        dropped: Items that were refused or dropped for want of room, without those that take none.
        closed: Whether `offer` and `put` add no more items; those that wait can still be taken.
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
        """Whether it is closed, and all was taken."""
        return self.closed and not self._items

    def offer(self, item: T, *, room: int | None = None) -> bool:
        """Add an item if it fits, into another room where one is given; returns whether it did."""
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
        """Add an item and drop the oldest ones until it fits; returns how many that take room were dropped.

        A closed queue takes it too: it goes out where somebody still takes what waits.
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
        """Add an item as soon as it fits; returns False where it is closed, or there was no room in time."""
        size = self._size(item)
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self.used + size <= self.room, timeout_s)
            if self.closed or self.used + size > self.room:
                return False
            self._add(item, size)
            return True

    def wait_for_room(self, timeout_s: float) -> bool:
        """Whether there is any room, at the latest after the time [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self.used < self.room, timeout_s)

    def wait_for_item(self, timeout_s: float) -> bool:
        """Whether something can be taken, at the latest after the time [s]."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self.closed, timeout_s)
            return bool(self._items)

    def take(self, timeout_s: float | None = None) -> T | None:
        """The oldest item; None after the time [s], or where it is closed and empty."""
        return next(iter(self.take_many(1, timeout_s)), None)

    def take_many(self, most: int, timeout_s: float | None = None) -> list[T]:
        """The oldest items, as soon as there are any; none after the time [s], or where it is closed and empty."""
        with self._changed:
            if self._held:
                self.used, self._held = self.used - self._held, 0
                self._changed.notify_all()
            if not self._items:
                self._changed.wait_for(lambda: self._items or self.closed, timeout_s)
            items = [self._items.popleft() for _ in range(min(most, len(self._items)))]
            taken = sum(map(self._size, items))
            if self._holds:
                self._held = taken
            else:
                self.used -= taken
            self._changed.notify_all()
            return items

    def clear(self) -> None:
        """Forget what waits."""
        with self._changed:
            self._items.clear()
            self.used = self._held
            self._changed.notify_all()

    def close(self) -> None:
        """Nobody is to wait for it any more; whoever waits goes on."""
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
    """The oldest item of the first queue that has one; None after the time [s], or as soon as one is closed and empty.

    Args:
        changed: Condition that they share.
        queues: The first goes before the others.
        timeout_s: How long to wait; None: until there is one.
    """
    with changed:
        changed.wait_for(lambda: any(len(queue) or queue.closed for queue in queues), timeout_s)
        waiting = next((queue for queue in queues if len(queue)), None)
        return None if waiting is None else waiting.take()
