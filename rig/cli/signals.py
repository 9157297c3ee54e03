"""Signals that end a command in good order, from its first moment to its last."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""SIGHUP only where it is not ignored, as under nohup."""
_came: list[int] = []
"""What came before anybody else listened: an exception may be swallowed by whatever it interrupts."""


def _interrupt(number: int, frame: FrameType | None) -> None:
    _came.append(number)
    raise KeyboardInterrupt


def listen() -> None:
    """From now on signals interrupt, until somebody else takes them."""
    for number in _ENDING:
        # A shell starts what runs in its background with SIGINT ignored; whoever sends it all the same means it.
        if number == signal.SIGINT or signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _interrupt)


def ignore() -> None:
    """The command is over, and its exit status known: nothing is left to be interrupted."""
    for number in _ENDING:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def stopping_on_signals(stop: Callable[[], object]) -> Iterator[None]:
    """SIGINT, SIGTERM and SIGHUP end the work in good order; a second SIGINT interrupts at once."""
    ended: list[int] = []

    def handle(number: int, _: object) -> None:
        ended.append(number)
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        stop()

    former = {number: signal.signal(number, handle) for number in _ENDING if signal.getsignal(number) != signal.SIG_IGN}
    if _came:
        stop()
    try:
        yield
    finally:
        for number, handler in former.items():
            # Once it is ending, only a second SIGINT asks for more.
            signal.signal(number, signal.SIG_IGN if ended and number != signal.SIGINT else handler)
