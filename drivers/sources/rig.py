"""Samples from the rig's own keys: one stream for each channel group."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from itertools import count

from drivers.sources.samples import RIG_LOST, Samples
from drivers.sources.stream import RigStream, decimate, decimation_factor
from rig.base import wire
from rig.channels.table import Group
from rig.serve.transport import Client
from rig.serve.transport.clients import Reporter

_REPORT_S = 0.4
_source_numbers = count(1)


class RigSource:
    """Channel groups of a running rig; reports the reader's position to the rig.

    Args:
        client: Transport to the rig.
        close: Called when the source is closed, for example to close the client.
        stream: Stream of that rig; a new one unless given.
        counts: Pass on counts of the converters instead of engineering values.
    """

    def __init__(
        self,
        client: Client,
        *,
        close: Callable[[], None] | None = None,
        stream: RigStream | None = None,
        counts: bool = False,
    ) -> None:
        self._counts = counts
        self._stream = stream or RigStream(client)
        self._client = client
        self._close = close
        self._leave: list[Callable[[], None]] = []
        self._position_report = Reporter(client, f"daq-{os.getpid()}-{next(_source_numbers)}")
        self._scale = 1.0
        """Rows of the reporting stream per row of this source."""
        self._position: tuple[int | None, int, int] | None = None
        self._reported_index: int | None = None
        self._due = threading.Event()
        self._closed = False
        self._reporter = threading.Thread(target=self._report_all, name="daq reports", daemon=True)

    def streams(self) -> dict[str, tuple[str, ...]]:
        """Return the channels of each group."""
        return {name: group.names for name, group in self._stream.table().groups.items()}

    def start(
        self,
        streams: Sequence[str],
        rate_hz: float | None,
        on_samples: Callable[[str, Samples], None],
        on_end: Callable[[str, str], None],
    ) -> float:
        """Start the groups; those with a higher rate are decimated."""
        groups = [self._stream.group(name) for name in streams]
        rate = float(rate_hz or min(group.rate_hz for group in groups))
        for group in groups:
            decimation_factor(group.rate_hz, rate)
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
        step = decimation_factor(group.rate_hz, rate_hz)

        def take(block: wire.Block) -> None:
            if block.values.shape[1] != len(units) or round(block.rate_hz / step) != round(rate_hz):
                on_end(group.name, f"{RIG_LOST}: its channels or rates have changed")
                return
            block = decimate(block, step)
            if len(block.values):
                values = block.values if self._counts else group.engineering(block.values)
                on_samples(group.name, Samples.from_block(block, group.names, units, values))

        self._leave.append(
            self._stream.listen(wire.sensor_key(group.name), take, lambda reason: on_end(group.name, reason))
        )

    def report_position(self, index: int | None, *, room: int, lost: int) -> None:
        """Report the reader's position twice a second, and at once after an eighth of the buffer."""
        self._position = (index, room, lost)
        if index is None or self._reported_index is None or abs(index - self._reported_index) > room // 8:
            self._due.set()

    def _report_all(self) -> None:
        while not self._closed:
            self._due.wait(_REPORT_S)
            self._due.clear()
            if self._position is not None:
                self._report()

    def _report(self, *, done: bool = False) -> None:
        self._reported_index, room, lost = self._position or (None, 0, 0)
        index = None if self._reported_index is None else int(self._reported_index * self._scale)
        self._position_report.send(index, lost=lost, room=int(room * self._scale), done=done)

    def close(self) -> None:
        """Stop listening, and report that this reader has finished."""
        while self._leave:
            self._leave.pop()()
        self._closed = True
        self._due.set()
        if self._reporter.is_alive() and self._reporter is not threading.current_thread():
            self._reporter.join(timeout=2.0)
        if self._position is not None:
            self._report(done=True)
            self._position = None
        close, self._close = self._close, None
        if close is not None:
            close()
