"""Signals that end a command cleanly, from its start to its end."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""SIGHUP only if it is not ignored, as under nohup."""
_received: list[int] = []
"""Signals received before a handler was set; the code that the exception interrupts may swallow it."""


def _interrupt(number: int, frame: FrameType | None) -> None:
    _received.append(number)
    raise KeyboardInterrupt


def listen() -> None:
    """Make the signals interrupt the command, until other handlers are set."""
    for number in _ENDING:
        # A shell starts background jobs with SIGINT ignored; a SIGINT sent to one is deliberate.
        if number == signal.SIGINT or signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _interrupt)


def ignore() -> None:
    """Ignore the signals: the command has finished and its exit status is fixed."""
    for number in _ENDING:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def stop_on_signals(stop: Callable[[], object]) -> Iterator[None]:
    """Call `stop` on SIGINT, SIGTERM and SIGHUP; a second SIGINT interrupts at once."""
    ended: list[int] = []

    def handle(number: int, _: object) -> None:
        ended.append(number)
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        stop()

    former = {number: signal.signal(number, handle) for number in _ENDING if signal.getsignal(number) != signal.SIG_IGN}
    if _received:
        stop()
    try:
        yield
    finally:
        for number, handler in former.items():
            # While the command ends, only a second SIGINT has an effect.
            signal.signal(number, signal.SIG_IGN if ended and number != signal.SIGINT else handler)
