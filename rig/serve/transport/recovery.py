"""What one lossless subscription has received, and the recovery of what it has not."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

_BLOCKS_A_SECOND = 100
CACHE = 30 * _BLOCKS_A_SECOND
"""Messages of each key that the rig keeps for those who missed them."""
_PORTION = 200
"""Messages asked for at a time, below 1 MB: while a cache answers its publisher waits, and sockets hold that much."""
_ATTEMPTS = 4
_RETRY_S = 0.25

Publisher = tuple[str, int]
"""Session and number of a publisher: one a key, and new ones when a rig is started again."""


class Recovery:
    """What one lossless subscription has received, and the recovery of what it has not.

    Publishers number their messages, keep the last ones, and tell their last number several times a second; all that is
    zenoh's. Asking for what is missing is done here: zenoh's advanced subscriber (1.10.2) can declare a gap missed
    without having asked for it, when the gap appears while the query of a heartbeat is open, and loses history alike.

    Args:
        ask: Selected messages of one publisher, from its cache: key, publisher, selection -> samples.
        on_message: Takes key and payload, in order, each once.
        on_miss: Takes key and number of messages that are nowhere to be had.
        history: Begin with what the caches hold, not with the first message that arrives.
        cache: Number of newest messages that each publisher keeps.
        pause: Waits for a number of seconds.
    """

    def __init__(
        self,
        ask: Callable[[str, Publisher, str], list[Any]],
        on_message: Callable[[str, bytes], None],
        on_miss: Callable[[str, int], None] | None,
        *,
        history: bool,
        cache: int = CACHE,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        self._ask = ask
        self._on_message = on_message
        self._on_miss = on_miss
        self._history = history
        self._cache = cache
        self._pause = pause
        self._lock = threading.Lock()
        self._last: dict[Publisher, int] = {}
        """Number of the last message of each publisher that was taken, or given up."""
        self._floor: dict[Publisher, int] = {}
        """Without history: last number of a publisher when it was first heard of; what came later belongs to us."""
        self._behind: dict[Publisher, int | None] = {}
        """Where we stood at a publisher's previous heartbeat, if that was behind it."""
        self._handed: dict[str, int] = {}
        self._news = threading.Condition()

    def wait_for(self, key: str, number: int, *, timeout_s: float) -> bool:
        """Wait until the message of a key that has this number, or a later one, was handed on; False if it was not."""
        with self._news:
            return self._news.wait_for(lambda: self._handed.get(key, -1) >= number, timeout_s)

    def take(self, sample: Any) -> None:
        """Take the next message that arrived, after all that should have come before it."""
        info = sample.source_info
        publisher, number = publisher_of(info.source_id), info.source_sn
        with self._lock:
            last = self._last.get(publisher)
            if last is None and number > self._floor.get(publisher, number):
                last = self._last[publisher] = self._floor[publisher]
            if last is not None and number <= last:
                return
            if number > 0 and (self._history if last is None else number > last + 1):
                self._recover(str(sample.key_expr), publisher, number - 1)
            self._deliver(publisher, number, sample)

    def begin(self, heads: list[Any]) -> None:
        """Take the history of publishers of which nothing has arrived, given the newest message that each cache has."""
        for sample in heads:
            publisher = publisher_of(sample.source_info.source_id)
            with self._lock:
                if publisher not in self._last:
                    self._recover(str(sample.key_expr), publisher, sample.source_info.source_sn)

    def heartbeat(self, sample: Any) -> None:
        """Notice that the last messages of a key are missing, which no later message would show."""
        from zenoh import ext

        key, _, rest = str(sample.key_expr).partition("/@adv/pub/")
        try:
            zid, eid = rest.split("/")[:2]
            publisher, number = (zid, int(eid)), int(ext.z_deserialize(ext.UInt32, sample.payload))
        except (ValueError, ext.ZDeserializeError):
            return
        self.at_least(publisher, key, number)

    def at_least(self, publisher: Publisher, key: str, number: int) -> None:
        """Take note that a publisher has sent a message of this number."""
        # While a message is being handed on, others wait in the channel, and nobody knows yet whether any is missing.
        if not self._lock.acquire(blocking=False):
            return
        try:
            last = self._last.get(publisher)
            if last is None and not self._history:
                last = self._floor.setdefault(publisher, number)
            if last is not None and number <= last:
                self._behind.pop(publisher, None)
            elif publisher in self._behind and self._behind[publisher] == last:
                # Nothing came since the previous heartbeat: it is not merely on its way.
                del self._behind[publisher]
                if last is not None:
                    self._last[publisher] = last
                self._recover(key, publisher, number)
            else:
                self._behind[publisher] = last
        finally:
            self._lock.release()

    def _recover(self, key: str, publisher: Publisher, until: int) -> None:
        """Take from the cache what is missing up to a number; what it no longer has is reported and given up."""
        last = self._last.get(publisher)
        # What a publisher sent before anything of it was known is history: what its cache no longer has is no loss.
        known = last is not None
        missing = 0
        first = 0 if last is None else last + 1
        oldest = max(first, until + 1 - self._cache)
        if known:
            missing += oldest - first
        first = oldest
        while first <= until:
            end = min(until, first + _PORTION - 1)
            found = self._fetch(key, publisher, first, end)
            if found is None:
                break
            for number in sorted(found):
                if known:
                    missing += number - first
                known = True
                first = number + 1
                self._deliver(publisher, number, found[number])
            if known:
                missing += end + 1 - first
            first = end + 1
        if known:
            missing += max(0, until + 1 - first)
        self._last[publisher] = until
        if missing and self._on_miss is not None:
            self._on_miss(key, missing)

    def _fetch(self, key: str, publisher: Publisher, first: int, end: int) -> dict[int, Any] | None:
        """Samples by number that a cache has of a range; None where the cache does not answer at all."""
        found: dict[int, Any] = {}
        for attempt in range(_ATTEMPTS):
            if attempt:
                # The link may have been lost, and be back in a moment.
                self._pause(_RETRY_S)
            for reply in self._ask(key, publisher, f"_sn={first}..{end}"):
                if first <= (number := reply.source_info.source_sn) <= end:
                    found[number] = reply
            if end in found:
                # Replies come in order: what is lacking before this one is no longer kept.
                return found
            # An empty reply can be a lost one. That these are no longer kept follows from the newest number alone.
            newest = max((reply.source_info.source_sn for reply in self._ask(key, publisher, "_max=1")), default=end)
            if newest - end >= self._cache:
                return found
        return found or None

    def _deliver(self, publisher: Publisher, number: int, sample: Any) -> None:
        self._last[publisher] = number
        key = str(sample.key_expr)
        self._on_message(key, sample.payload.to_bytes())
        with self._news:
            self._handed[key] = number
            self._news.notify_all()


def publisher_of(entity: Any) -> Publisher:
    """Whose message it is, of the source that zenoh names."""
    return str(entity.zid), entity.eid
