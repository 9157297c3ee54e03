"""Warnings about failures on threads that must continue, and about losses."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rig.base.text import printable

_WARNING_S = 5.0


class Guard:
    """Runs a function and turns its failure into a warning.

    Args:
        name: Name of the guarded work in the warning.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._last = ""
        self.failures = 0

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of the call; None if it fails, which is reported as a warning from then on."""
        try:
            return function(*arguments)
        except Exception as error:
            self.record_failure(getattr(function, "__name__", "it"), error)
            return None

    def record_failure(self, where: str, error: BaseException) -> None:
        """Record a failure."""
        self.failures += 1
        self._last = printable(f"{where.strip('_')}: {type(error).__name__}: {error}", 200)

    def warnings(self) -> list[str]:
        """Return the current warnings."""
        return [f"{self._name} failed {self.failures} times (last {self._last})"] if self.failures else []


class IncreaseWarning:
    """A count that causes a warning while it rises.

    Args:
        text: The warning, with the count as `{}`.
        clock: Monotonic clock [s].
    """

    def __init__(self, text: str, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._text = text
        self._clock = clock
        self._count = 0
        self._until_s = -1.0

    def warnings(self, count: int) -> list[str]:
        """Return the warning, until 5 s after the last rise of the count."""
        now = self._clock()
        if count > self._count:
            self._count, self._until_s = count, now + _WARNING_S
        return [self._text.format(count)] if now < self._until_s else []
