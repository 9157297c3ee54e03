"""Limit of commands per second, for one sender and for all."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from rig.base.errors import InputError, Words

_MAX_SENDERS = 64
"""Number of senders with a separate limit. Senders name themselves; invented names share the common limit."""
_COMMON_FACTOR = 4
"""Common limit relative to that of one sender."""


class Bucket:
    """Token bucket: a burst, refilled at a constant rate."""

    def __init__(self, rate_hz: float, burst: float, now_s: float) -> None:
        self._rate_hz, self._burst = rate_hz, burst
        self._tokens, self._updated_s = burst, now_s

    def count_tokens(self, now_s: float) -> float:
        """Return the number of tokens now."""
        self._tokens = min(self._burst, self._tokens + self._rate_hz * (now_s - self._updated_s))
        self._updated_s = now_s
        return self._tokens

    def remove_token(self) -> None:
        """Remove a token."""
        self._tokens -= 1.0


class CommandLimit:
    """Refuses commands above a rate, immediately.

    Args:
        rate_hz: Rate of one sender [1/s]; the common rate is four times this.
        burst: Commands of one sender at once; the common burst is four times this.
        now_s: Clock [s], monotonic.
    """

    def __init__(
        self, rate_hz: float = 200.0, burst: int = 100, *, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._rate_hz, self._burst, self._now_s = rate_hz, burst, now_s
        self._lock = threading.Lock()
        self._common = Bucket(_COMMON_FACTOR * rate_hz, _COMMON_FACTOR * burst, now_s())
        self.senders: dict[str, Bucket] = {}
        """Senders with a separate limit, least recent first."""
        self.refused = 0
        """Number of refused commands."""

    def check(self, sender: str) -> None:
        """Count a command.

        Raises:
            InputError: The command exceeds the limit.
        """
        now_s = self._now_s()
        with self._lock:
            bucket = self.senders.pop(sender, None) or Bucket(self._rate_hz, self._burst, now_s)
            if len(self.senders) >= _MAX_SENDERS:
                del self.senders[next(iter(self.senders))]  # the least recent sender
            self.senders[sender] = bucket
            if bucket.count_tokens(now_s) >= 1.0 and self._common.count_tokens(now_s) >= 1.0:
                bucket.remove_token()
                self._common.remove_token()
                return
            self.refused += 1
        must = f"at most {self._rate_hz:g} per second from one sender, {_COMMON_FACTOR * self._rate_hz:g} from all"
        raise InputError("commands", must, Words(f"one too many from {sender}"))
