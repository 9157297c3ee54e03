"""Progress reports of clients: for the status, for the end of a run, and for an unpaced run."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

from rig.base import wire
from rig.base.checks import Count, Name, StrictModel, a_line, check
from rig.serve.transport import Client, Server
from rig.serve.waiting import Deadline

MAX_STATUS_CLIENTS = 64
"""Number of clients in the status."""
MAX_CLIENTS = 4096
"""Largest number of client names remembered; large, so that invented names do not displace active clients."""
_RETENTION_S = 600.0
_SILENCE_LIMIT_S = 3.0
"""Time without a report after which a client is no longer waited for [s]; clients report twice a second."""
_SETTLING_S = 0.6
"""Time for which no client may lag at the end of a run before the cache is dropped [s]: two heartbeats."""
_PROGRESS_LIMIT_S = 60.0
"""Time without progress after which a reporting client is no longer waited for, during a run [s]."""
_PROGRESS_LIMIT_AT_END_S = 3.0
_STALLED_LINK_WAIT_S = 0.4
"""Extra wait for a stalled link at the end of a run, when all reporting clients have everything [s]."""


class Sender(StrictModel):
    """Sender of a report: the last part of the key."""

    name: Name


class ClientReport(StrictModel):
    """Report that a client sends twice a second on `rig/clients/NAME`."""

    name: Name | None = None
    received_index: Count | None
    """Index of the row that it receives next; None: it is subscribed and has received nothing."""
    lost: Count = 0
    """Number of rows that it knows to be lost."""
    room: Count | None = None
    """Number of rows that it can hold."""
    done: bool = False
    """The client leaves."""
    wall_s: float | None = None
    secret: Annotated[str, a_line(64)] | None = None
    """Secret of this client; a report under its name without it is from another client."""


class Reporter:
    """Client side: reports the client's progress to the rig.

    Args:
        client: Transport to the rig.
        name: Name of the client in the status.
    """

    def __init__(self, client: Client, name: str) -> None:
        self._client = client
        self._name = name
        self._secret = secrets.token_hex(16)

    def send(self, received_index: int | None, *, lost: int, room: int | None = None, done: bool = False) -> None:
        """Send a report; arguments as of `ClientReport`."""
        report = ClientReport(
            name=self._name, received_index=received_index, lost=lost, room=room, done=done, secret=self._secret
        )
        self._client.report(f"{wire.CLIENTS}/{self._name}", report.model_dump_json().encode())


@dataclass(frozen=True, slots=True)
class _LastReport:
    received_index: int | None
    """None: subscribed, and nothing received."""
    lost: int
    report_s: float
    room: int | None
    progress_s: float
    """When it last made progress."""
    start_index: int
    start_s: float
    """Its position at the first report, or after the last step back."""

    @property
    def pace(self) -> float:
        """Its progress [rows/s]."""
        return ((self.received_index or 0) - self.start_index) / max(self.report_s - self.start_s, 1.0)


_ClientKey = tuple[str, str | None]
"""Name and secret."""


class Clients:
    """The clients of one rig, by the names that they give themselves.

    Args:
        now_s: Clock [s], monotonic.
    """

    def __init__(self, *, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._lock = threading.Lock()
        self._reports: dict[_ClientKey, _LastReport] = {}
        self._first_rows: dict[_ClientKey, int] = {}
        """Next row to be published when a client without data was first seen; its lag counts from this row."""
        self._swept_s = now_s()
        self.malformed = 0
        """Number of invalid reports."""

    def take(self, key: str, payload: bytes) -> None:
        """Store a report; on a thread of the transport."""
        try:
            name = Sender(name=key.rpartition("/")[2]).name
            report = check(ClientReport, payload, field="report")
        except ValueError:
            self.malformed += 1
            return
        now_s, client, index = self._now_s(), (name, report.secret), report.received_index
        with self._lock:
            if report.done:
                self._forget(client)
                return
            previous = self._reports.get(client)
            if previous is None:
                self._make_room(now_s)
                origin, progress_s = (index or 0, now_s), now_s
            else:
                step = (index or 0) - (previous.received_index or 0)
                begins = step < 0 or previous.received_index is None
                origin = (index or 0, now_s) if begins else (previous.start_index, previous.start_s)
                progress_s = now_s if step > 0 else previous.progress_s
            self._reports[client] = _LastReport(index, report.lost, now_s, report.room, progress_s, *origin)

    def _make_room(self, now_s: float) -> None:
        """Remove silent clients, otherwise the slowest quarter."""
        if len(self._reports) < MAX_CLIENTS and now_s - self._swept_s < _RETENTION_S:
            return
        self._swept_s = now_s
        for client in [client for client, row in self._reports.items() if now_s - row.report_s > _RETENTION_S]:
            self._forget(client)
        if len(self._reports) >= MAX_CLIENTS:
            for client in sorted(self._reports, key=lambda client: self._reports[client].pace)[: MAX_CLIENTS // 4]:
                self._forget(client)

    def _forget(self, client: _ClientKey) -> None:
        self._reports.pop(client, None)
        self._first_rows.pop(client, None)

    @property
    def active_count(self) -> int:
        """Number of clients that reported recently."""
        return len(self._active_clients())

    def rows(self, published: int, rate_hz: float) -> dict[str, dict[str, Any]]:
        """Return the clients for the status.

        Args:
            published: Index after the last published row of the stream that clients report on.
            rate_hz: Rate of that stream [Hz]; 0 before the first block.
        """
        now_s = self._now_s()
        with self._lock:
            # The most active clients first: names can be invented in large numbers.
            first = sorted(self._reports.items(), key=lambda row: -row[1].pace)
        rows: dict[str, dict[str, Any]] = {}
        for client, report in first[:MAX_STATUS_CLIENTS]:
            name = client[0]
            while name in rows:
                name += " (another)"
            rows[name] = {
                "received_index": report.received_index,
                "lag_s": round(self._lag_rows(client, report, published) / rate_hz, 4) if rate_hz else 0.0,
                "last_heard_s": round(now_s - report.report_s, 3),
                "lost": report.lost,
            }
        return rows

    @property
    def hidden_count(self) -> int:
        """Number of clients that the status does not show."""
        return max(0, len(self._reports) - MAX_STATUS_CLIENTS)

    def max_lag_rows(self, published: int, *, silent: bool = False, progress_limit_s: float = _PROGRESS_LIMIT_S) -> int:
        """Return the lag of the slowest present client [rows]; 0 without clients.

        Args:
            published: Index after the last published row.
            silent: Include clients that no longer report.
            progress_limit_s: Exclude clients without progress for this long [s].
        """
        active = self._active_clients(silent=silent, progress_limit_s=progress_limit_s)
        return max((self._lag_rows(client, report, published) for client, report in active.items()), default=0)

    def find_lagging(self, published: int, max_rows: int) -> str | None:
        """Return the name of a present client that lags by more than `max_rows` rows, or than half of its room."""
        for client, report in self._active_clients().items():
            if self._lag_rows(client, report, published) > (
                max_rows if report.room is None else min(max_rows, report.room // 2)
            ):
                return client[0]
        return None

    def _lag_rows(self, client: _ClientKey, report: _LastReport, published: int) -> int:
        """Return the number of rows that a client has not received."""
        next_row = report.received_index
        return max(0, published - (self._first_rows.setdefault(client, published) if next_row is None else next_row))

    def _active_clients(
        self, *, silent: bool = False, progress_limit_s: float = _PROGRESS_LIMIT_S
    ) -> dict[_ClientKey, _LastReport]:
        now_s = self._now_s()
        with self._lock:
            return {
                client: row
                for client, row in self._reports.items()
                # A silent client is suspended, not stuck, and may continue.
                if (row.report_s - row.progress_s < progress_limit_s and now_s - row.report_s < _SILENCE_LIMIT_S)
                or (silent and now_s - row.report_s >= _SILENCE_LIMIT_S)
            }

    def settle(self, server: Server, published: int, *, patience_s: float) -> None:
        """Wait until all connected clients have received everything, so that the cache may be dropped.

        Args:
            server: Transport whose links are checked.
            published: Index after the last published row.
            patience_s: Longest wait [s].
        """
        caught_up_since = stalled_since = time.monotonic()
        for _ in Deadline(patience_s).polls(0.1):
            counts, now = server.congestion(), time.monotonic()
            if not counts.get("links", 0) or now - caught_up_since >= _SETTLING_S:
                return
            stalled = counts.get("stalled_links", 0) > 0
            if self.max_lag_rows(published, silent=stalled, progress_limit_s=_PROGRESS_LIMIT_AT_END_S):
                caught_up_since = stalled_since = now
            elif stalled and now - stalled_since < _STALLED_LINK_WAIT_S:
                caught_up_since = now
