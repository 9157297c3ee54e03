"""Samples from the rig's own keys: one stream a sensor group."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from itertools import count

from drivers.sources.samples import Samples
from drivers.sources.stream import RigStream, thin, whole_step
from rig.base import wire
from rig.channels.table import Group
from rig.serve.transport import Client
from rig.serve.transport.clients import Reporter

_REPORT_S = 0.4
_numbers = count(1)


class RigSource:
    """Sensor groups of a running rig, which is told how far they have been read.

    Args:
        client: Transport to the rig.
        close: Called when the source is closed; closes the client where it belongs to the source.
    """

    def __init__(self, client: Client, *, close: Callable[[], None] | None = None) -> None:
        self._stream = RigStream(client)
        self._client = client
        self._close = close
        self._leave: list[Callable[[], None]] = []
        self._told_by = Reporter(client, f"daq-{os.getpid()}-{next(_numbers)}")
        self._scale = 1.0
        """Rows of the stream that clients report on, for one of ours."""
        self._read: tuple[int | None, int, int] | None = None
        self._told: int | None = None
        self._due = threading.Event()
        self._closed = False
        self._reporter = threading.Thread(target=self._report_all, name="daq reports", daemon=True)

    def streams(self) -> dict[str, tuple[str, ...]]:
        """The groups of this rig's channel table."""
        return {name: group.names for name, group in self._stream.table().groups.items()}

    def start(
        self,
        streams: Sequence[str],
        rate_hz: float | None,
        on_samples: Callable[[str, Samples], None],
        on_end: Callable[[str, str], None],
    ) -> float:
        """Begin; every n-th row is taken where a group is faster than the rate."""
        groups = [self._stream.group(name) for name in streams]
        rate = float(rate_hz or min(group.rate_hz for group in groups))
        for group in groups:
            whole_step(group.rate_hz, rate)
        all_groups = self._stream.table().groups
        self._scale = all_groups.get("probes", next(iter(all_groups.values()))).rate_hz / rate
        self._reporter.start()
        for group in groups:
            self._listen(group, rate, on_samples, on_end)
        return rate

    def _listen(
        self,
        group: Group,
        rate_hz: float,
        on_samples: Callable[[str, Samples], None],
        on_end: Callable[[str, str], None],
    ) -> None:
        units = tuple(channel.unit for channel in group.channels)
        step = whole_step(group.rate_hz, rate_hz)

        def take(block: wire.Block) -> None:
            if block.values.shape[1] != len(units) or round(block.rate_hz / step) != round(rate_hz):
                on_end(group.name, "the rig's channels or rates have changed")
                return
            block = thin(block, step)
            if len(block.values):
                on_samples(group.name, Samples.of(block, group.names, units, group.engineering(block.values)))

        self._leave.append(
            self._stream.listen(wire.sensor_key(group.name), take, lambda reason: on_end(group.name, reason))
        )

    def taken(self, index: int | None, *, room: int, lost: int) -> None:
        """Tell the rig twice a second, and at once where much of the room has been used: a replay waits for it."""
        self._read = (index, room, lost)
        if index is None or self._told is None or abs(index - self._told) > room // 8:
            self._due.set()

    def _report_all(self) -> None:
        while not self._closed:
            self._due.wait(_REPORT_S)
            self._due.clear()
            if self._read is not None:
                self._report()

    def _report(self, *, done: bool = False) -> None:
        self._told, room, lost = self._read or (None, 0, 0)
        index = None if self._told is None else int(self._told * self._scale)
        self._told_by.tell(index, lost=lost, room=int(room * self._scale), done=done)

    def close(self) -> None:
        """Listen no more."""
        while self._leave:
            self._leave.pop()()
        self._closed = True
        self._due.set()
        if self._reporter.is_alive() and self._reporter is not threading.current_thread():
            self._reporter.join(timeout=2.0)
        if self._read is not None:
            self._report(done=True)
            self._read = None
        close, self._close = self._close, None
        if close is not None:
            close()
