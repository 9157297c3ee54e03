"""How many commands a second are taken: of one sender, and of all together."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from rig.base.errors import InputError, Words

_MOST = 64
"""Senders that are told apart. A sender is the name that it gives itself: who makes up names meets the common bound."""
_TOGETHER = 4


class Bucket:
    """Room for so many at once, refilled steadily."""

    def __init__(self, rate_hz: float, burst: float, now_s: float) -> None:
        self._rate_hz, self._burst = rate_hz, burst
        self._left, self._at_s = burst, now_s

    def left(self, now_s: float) -> float:
        """How many there is room for now."""
        self._left = min(self._burst, self._left + self._rate_hz * (now_s - self._at_s))
        self._at_s = now_s
        return self._left

    def take(self) -> None:
        """One of them comes."""
        self._left -= 1.0


class CommandLimit:
    """Refuses commands beyond a rate, at once.

    Args:
        rate_hz: Of one sender [1/s]; of all together four times that.
        burst: How many may come at once; likewise.
        now_s: Clock [s], monotonic.
    """

    def __init__(
        self, rate_hz: float = 200.0, burst: int = 100, *, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._rate_hz, self._burst, self._now_s = rate_hz, burst, now_s
        self._lock = threading.Lock()
        self._all = Bucket(_TOGETHER * rate_hz, _TOGETHER * burst, now_s())
        self.senders: dict[str, Bucket] = {}
        """Those that are told apart, the one heard longest ago first."""
        self.refused = 0
        """Commands that were not let through."""

    def check(self, sender: str) -> None:
        """Let a command through.

        Raises:
            InputError: It is one too many.
        """
        now_s = self._now_s()
        with self._lock:
            bucket = self.senders.pop(sender, None) or Bucket(self._rate_hz, self._burst, now_s)
            if len(self.senders) >= _MOST:
                del self.senders[next(iter(self.senders))]  # the one that was heard longest ago
            self.senders[sender] = bucket
            if bucket.left(now_s) >= 1.0 and self._all.left(now_s) >= 1.0:
                bucket.take()
                self._all.take()
                return
            self.refused += 1
        must = f"at most {self._rate_hz:g} a second from one sender, {_TOGETHER * self._rate_hz:g} from all"
        raise InputError("commands", must, Words(f"one too many from {sender}"))
