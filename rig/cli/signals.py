"""Signals that end a command cleanly, from its start to its end."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""SIGHUP only if it is not ignored, as under nohup."""
_AGAIN_S = 0.02
"""Time until a swallowed interrupt is sent again [s]: the callback has returned."""
_STOPPING_S = 1.0
"""Longest time to wait for `stop` to return after the command has ended [s]."""
_received: list[int] = []
"""Signals received before a handler was set; the code that the exception interrupts may swallow it."""


def _interrupt(number: int, frame: FrameType | None) -> None:
    _received.append(number)
    raise KeyboardInterrupt


def is_interrupted() -> bool:
    """Return whether a signal interrupted the command; a library may have turned the exception into another."""
    return bool(_received)


def _deliver_again(unraisable: Any) -> None:
    """Send an interrupt again that a callback of a library swallowed, such as one of the compiler."""
    if not isinstance(unraisable.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return
    import threading

    again = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), signal.SIGINT))
    again.daemon = True
    again.start()


def listen() -> None:
    """Make the signals interrupt the command, until other handlers are set."""
    sys.unraisablehook = _deliver_again
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
    """Call `stop` on SIGINT, SIGTERM or SIGHUP, in a thread of its own; a second SIGINT interrupts at once."""
    import threading
    from queue import SimpleQueue

    ended: list[int] = []
    # Only a flag or this queue may be used in a handler: the code that it interrupts may hold the lock of an event.
    received = SimpleQueue[int | None]()

    def handle(number: int, _: object) -> None:
        ended.append(number)
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        received.put(number)

    def stop_once() -> None:
        if received.get() is not None:
            stop()

    stopper = threading.Thread(target=stop_once, name="signals", daemon=True)
    stopper.start()
    former = {number: signal.signal(number, handle) for number in _ENDING if signal.getsignal(number) != signal.SIG_IGN}
    for number in _received[:1]:
        received.put(number)
    try:
        yield
    finally:
        for number, handler in former.items():
            # While the command ends, only a second SIGINT has an effect.
            signal.signal(number, signal.SIG_IGN if ended and number != signal.SIGINT else handler)
        received.put(None)
        stopper.join(_STOPPING_S)
