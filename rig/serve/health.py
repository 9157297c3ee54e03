"""What goes wrong on threads that must not end, and what is lost, as warnings while it happens."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rig.base.text import printable

_LATELY_S = 5.0


class Guard:
    """Does one thing after another, of which each may fail alone.

    Args:
        name: What the warning calls it.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._last = ""
        self.failures = 0

    def __call__(self, do: Callable[..., Any], *arguments: Any) -> Any:
        """What it returns; None where it fails, which the warning tells from now on."""
        try:
            return do(*arguments)
        except Exception as error:
            self.tell(getattr(do, "__name__", "it"), error)
            return None

    def tell(self, where: str, error: BaseException) -> None:
        """Something failed, and goes on."""
        self.failures += 1
        self._last = printable(f"{where.strip('_')}: {type(error).__name__}: {error}", 200)

    def warnings(self) -> list[str]:
        """What a person should know of."""
        return [f"{self._name} failed {self.failures} times (last {self._last})"] if self.failures else []


class Rising:
    """A count of which a person should know while it rises.

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
        """The warning, up to 5 s after the count was last found to be higher than before."""
        now = self._clock()
        if count > self._count:
            self._count, self._until_s = count, now + _LATELY_S
        return [self._text.format(count)] if now < self._until_s else []
