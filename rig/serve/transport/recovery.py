"""Received messages of a lossless subscription, and the recovery of missed ones."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

_BLOCKS_PER_SECOND = 100
CACHE = 30 * _BLOCKS_PER_SECOND
"""Number of messages that the rig keeps per key for recovery."""
_BATCH = 200
"""Messages requested at a time, below 1 MB: a publisher waits while its cache answers, and sockets hold that much."""
_ATTEMPTS = 4
_RETRY_S = 0.25

Publisher = tuple[str, int]
"""Session and number of a publisher: one per key, and new ones after a restart of the rig."""


class Recovery:
    """Received messages of a lossless subscription, and the recovery of missed ones.

    Publishers number their messages, keep the last ones, and send their last number several times per second; this is
    part of zenoh. The recovery is done here because zenoh's advanced subscriber (1.10.2) can report a gap as missed
    without requesting it, if the gap appears while the query of a heartbeat is open, and loses history in the same way.

    Args:
        query_cache: Returns selected messages from a publisher's cache: key, publisher, selection -> samples.
        on_message: Receives key and payload, in order, each once.
        on_miss: Receives key and number of messages that cannot be recovered.
        history: Begin with the content of the caches, not with the first message that arrives.
        cache: Number of messages that each publisher keeps.
        pause: Waits for a number of seconds.
    """

    def __init__(
        self,
        query_cache: Callable[[str, Publisher, str], list[Any]],
        on_message: Callable[[str, bytes], None],
        on_miss: Callable[[str, int], None] | None,
        *,
        history: bool,
        cache: int = CACHE,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        self._query_cache = query_cache
        self._on_message = on_message
        self._on_miss = on_miss
        self._history = history
        self._cache = cache
        self._pause = pause
        self._lock = threading.Lock()
        self._last: dict[Publisher, int] = {}
        """Number of the last message of each publisher that was delivered or given up."""
        self._floor: dict[Publisher, int] = {}
        """Without history: last number of a publisher when it was first seen; later messages must be delivered."""
        self._heartbeat_numbers: dict[Publisher, int | None] = {}
        """Our last number at a publisher's previous heartbeat, if it was lower."""
        self._delivered: dict[str, int] = {}
        self._delivery = threading.Condition()

    def wait_for(self, key: str, number: int, *, timeout_s: float) -> bool:
        """Wait until the message of a key with this number, or a later one, was delivered; return whether it was."""
        with self._delivery:
            return self._delivery.wait_for(lambda: self._delivered.get(key, -1) >= number, timeout_s)

    def take(self, sample: Any) -> None:
        """Deliver a message that arrived, after recovering those before it."""
        info = sample.source_info
        publisher, number = parse_publisher(info.source_id), info.source_sn
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
        """Recover the history of publishers without a received message, given the newest message of each cache."""
        for sample in heads:
            publisher = parse_publisher(sample.source_info.source_id)
            with self._lock:
                if publisher not in self._last:
                    self._recover(str(sample.key_expr), publisher, sample.source_info.source_sn)

    def heartbeat(self, sample: Any) -> None:
        """Detect missing last messages of a key, which no later message would show."""
        from zenoh import ext

        key, _, rest = str(sample.key_expr).partition("/@adv/pub/")
        try:
            zid, eid = rest.split("/")[:2]
            publisher, number = (zid, int(eid)), int(ext.z_deserialize(ext.UInt32, sample.payload))
        except (ValueError, ext.ZDeserializeError):
            return
        self.record_sent(publisher, key, number)

    def record_sent(self, publisher: Publisher, key: str, number: int) -> None:
        """Record that a publisher has sent a message of this number."""
        # While a message is delivered, others wait in the channel, so it is not known yet whether any is missing.
        if not self._lock.acquire(blocking=False):
            return
        try:
            last = self._last.get(publisher)
            if last is None and not self._history:
                last = self._floor.setdefault(publisher, number)
            if last is not None and number <= last:
                self._heartbeat_numbers.pop(publisher, None)
            elif publisher in self._heartbeat_numbers and self._heartbeat_numbers[publisher] == last:
                # Nothing arrived since the previous heartbeat, so the message is not just in flight.
                del self._heartbeat_numbers[publisher]
                if last is not None:
                    self._last[publisher] = last
                self._recover(key, publisher, number)
            else:
                self._heartbeat_numbers[publisher] = last
        finally:
            self._lock.release()

    def _recover(self, key: str, publisher: Publisher, last_number: int) -> None:
        """Deliver missing messages up to a number from the cache; report and give up those that it no longer has."""
        last = self._last.get(publisher)
        # Messages sent before the first known one are history; those no longer in the cache are not a loss.
        has_first = last is not None
        missing = 0
        first = 0 if last is None else last + 1
        oldest = max(first, last_number + 1 - self._cache)
        if has_first:
            missing += oldest - first
        first = oldest
        while first <= last_number:
            end = min(last_number, first + _BATCH - 1)
            samples = self._fetch(key, publisher, first, end)
            if samples is None:
                break
            for number in sorted(samples):
                if has_first:
                    missing += number - first
                has_first = True
                first = number + 1
                self._deliver(publisher, number, samples[number])
            if has_first:
                missing += end + 1 - first
            first = end + 1
        if has_first:
            missing += max(0, last_number + 1 - first)
        self._last[publisher] = last_number
        if missing and self._on_miss is not None:
            self._on_miss(key, missing)

    def _fetch(self, key: str, publisher: Publisher, first: int, end: int) -> dict[int, Any] | None:
        """Return the samples of a range that a cache has, by number; None if the cache does not answer."""
        samples: dict[int, Any] = {}
        for attempt in range(_ATTEMPTS):
            if attempt:
                # The link may have been lost, and return soon.
                self._pause(_RETRY_S)
            for reply in self._query_cache(key, publisher, f"_sn={first}..{end}"):
                if first <= (number := reply.source_info.source_sn) <= end:
                    samples[number] = reply
            if end in samples:
                # Replies come in order: those missing before this one are no longer in the cache.
                return samples
            # An empty reply may be a lost one. Only the newest number shows that these are no longer in the cache.
            newest = max(
                (reply.source_info.source_sn for reply in self._query_cache(key, publisher, "_max=1")), default=end
            )
            if newest - end >= self._cache:
                return samples
        return samples or None

    def _deliver(self, publisher: Publisher, number: int, sample: Any) -> None:
        self._last[publisher] = number
        key = str(sample.key_expr)
        self._on_message(key, sample.payload.to_bytes())
        with self._delivery:
            self._delivered[key] = number
            self._delivery.notify_all()


def parse_publisher(entity: Any) -> Publisher:
    """Return the publisher from zenoh's source of a message."""
    return str(entity.zid), entity.eid
