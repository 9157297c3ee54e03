"""A zenoh session with its receiving threads, and the settings shared by both sides."""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import threading
from collections.abc import Callable
from typing import Any

from rig.base import wire

_LEASE_S = 60.0
"""Lease of a link [s]. A suspended subscriber sends no keep-alives, and must keep its link for well over 10 s. A
killed process is noticed by its closed socket, not by the lease."""
PATIENCE_S = 20.0
"""Longest wait of a receiver for recovered messages [s]."""
_BLOCKED_S = 2.0
"""Longest wait of recovered messages for a link whose other side does not read [s]. Then the link is closed: our own
client reconnects and requests them again, and a malicious one blocks no longer."""
_THREADS = 24
"""Threads that a session of zenoh starts, at most."""


def locator(host: str, port: int, *, tls: bool = False) -> str:
    """Return an address in zenoh's form."""
    # "localhost" may resolve to ::1 first, where the rig does not listen.
    return f"{'tls' if tls else 'tcp'}/{'127.0.0.1' if host == 'localhost' else host}:{port}"


def build_config(**settings: Any) -> Any:
    """Return a configuration with the shared settings and the given ones (`__` means `/`)."""
    import zenoh

    config = zenoh.Config()
    shared = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # Blocks are a few kB: shared memory saves nothing and would leave segments after a process is killed.
        "transport/shared_memory/enabled": False,
        "transport/unicast/compression/enabled": False,
        "adminspace/enabled": False,
        "transport/link/tx/lease": round(_LEASE_S * 1000),
        "transport/link/tx/keep_alive": 30,
        # Recovered messages wait for a full link, and meanwhile the publisher of that key waits for its cache. After
        # this time the link is closed, which can cost that client messages. It must be below the time that the
        # service can queue [us].
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(_BLOCKED_S * 1e6),
    }
    for key, value in {**shared, **{name.replace("__", "/"): value for name, value in settings.items()}}.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _check_threads() -> None:
    """Raise a RuntimeError if zenoh could not start its threads; it would abort the process.

    Raises:
        RuntimeError: The system does not grant the threads.
    """
    end, threads = threading.Event(), list[threading.Thread]()
    try:
        for _ in range(_THREADS):
            threads.append(threading.Thread(target=end.wait, daemon=True))
            threads[-1].start()
    finally:
        end.set()


class Session:
    """A zenoh session with its receiving threads, which is always closed.

    zenoh's own callback threads are not daemons: a script that does not close its session would hang at exit. So all
    data is received by channels that daemon threads read, and an exit handler closes open sessions.
    """

    def __init__(self, config: Any) -> None:
        import zenoh

        # A receiving thread blocks while it sends a recovery to a stalled link, or fills the channel of a slow
        # callback; the default of two threads would leave none for the rest. Read at the first session of a process.
        os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 16))")
        _check_threads()
        self.session = zenoh.open(config)
        self._threads: list[threading.Thread] = []
        self._closing = threading.Lock()
        self._closed = False
        self._printed: set[str] = set()
        self.on_failure: Callable[[str, BaseException], None] = self._print_failure
        """Receives failures on receiving threads, which continue."""
        atexit.register(self._close_at_exit)

    def _print_failure(self, place: str, error: BaseException) -> None:
        if place not in self._printed:  # each message may fail
            self._printed.add(place)
            thread = threading.current_thread()
            threading.excepthook(threading.ExceptHookArgs((type(error), error, error.__traceback__, thread)))

    def drain(
        self, channel: Any, take: Callable[[Any], None], name: str, *, first: Callable[[], None] | None = None
    ) -> None:
        """Pass all messages of a channel to `take`, on its own thread, after calling `first` there.

        Failures do not end the thread: an unread channel would finally block the whole link.
        """
        import zenoh

        def run_guarded(work: Callable[..., None], *arguments: Any) -> None:
            try:
                work(*arguments)
            except BaseException as error:
                if not (self._closed and isinstance(error, zenoh.ZError)):
                    self.on_failure(f"zenoh {name}", error)

        def loop() -> None:
            if first is not None:
                run_guarded(first)
            with contextlib.suppress(zenoh.ZError):  # the channel ends with the session
                for item in channel:
                    if not self._closed:
                        run_guarded(take, item)

        thread = threading.Thread(target=loop, name=f"zenoh {name}", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _close_at_exit(self) -> None:
        self.close(wait_s=None)

    def close(self, *, wait_s: float | None = 2.0) -> None:
        """Close, and wait for this long [s]; None: until it is closed."""
        import zenoh

        with self._closing:
            if self._closed:
                return
            self._closed = True
        atexit.unregister(self._close_at_exit)

        def close() -> None:
            with contextlib.suppress(zenoh.ZError):
                self.session.close()

        # Takes 10 s and fails if a callback never returns. A daemon thread would be killed at the end of the process,
        # which aborts the process.
        closing = threading.Thread(target=close, name="zenoh closes")
        closing.start()
        closing.join(timeout=wait_s)
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout=1.0)


def get_encoding(key: str, schema: str | None) -> str:
    """Return zenoh's encoding for the payloads of a key."""
    if schema is not None:
        return f"application/cdr;{schema}"
    return "application/octet-stream" if key.startswith(f"{wire.ROOT}/can/") else "application/json"


def fifo() -> Any:
    """Return a channel for requests, reports or tokens."""
    import zenoh

    return zenoh.handlers.FifoChannel(256)
