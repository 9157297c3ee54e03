"""The blocks of a rig in lockstep, one by one, as a device under test is given them."""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Iterator

from drivers.daq import Daq
from drivers.link import LinkTimeoutError
from drivers.sources.samples import Samples, StreamEndedError
from drivers.sources.turns import joined
from rig.base import wire
from rig.base.errors import RefusedError
from rig.serve.intake import BlockEnd, block_end_in, event_in
from rig.serve.transport import Client
from rig.serve.waiting import Deadline

LOST_S = 2.0
"""Rows of a block that is over are there, or lost [s]."""
_ENDED_S = 0.2
"""How often whoever waits for a block looks whether the run is over, where no event has told so [s]."""


class Blocks:
    """Follows the blocks of a rig from now on, while a device has joined.

    Args:
        client: Transport to the rig.
        daq: What reads the channels; its rows are taken here.
        device: Name under which the device joins.
    """

    def __init__(self, client: Client, daq: Daq, device: str) -> None:
        self._client, self._daq, self._device = client, daq, device
        self._ends: queue.SimpleQueue[BlockEnd | None] = queue.SimpleQueue()
        self._lost = ""
        client.subscribe(wire.BLOCK, self._on_end)
        client.subscribe(wire.EVENTS, self._on_event)
        client.settle()

    def _on_end(self, _: str, payload: bytes) -> None:
        with contextlib.suppress(ValueError):
            self._ends.put(block_end_in(payload))

    def _on_event(self, _: str, payload: bytes) -> None:
        with contextlib.suppress(ValueError):
            event = event_in(payload)
            if event["event"] == "device" and event.get("device") == self._device:
                lost = event.get("state") == "lost"
                self._lost = str(event.get("reason", "not done in time, or with another block")) if lost else ""
                if lost:
                    self._ends.put(None)
            elif event["event"] == "end":
                self._ends.put(None)

    def next(self) -> BlockEnd | None:
        """The end of the next block; None at that of the run.

        Raises:
            RefusedError: The device was put out.
        """
        while True:
            end = None
            with contextlib.suppress(queue.Empty):
                end = self._ends.get(timeout=_ENDED_S)
            if end is not None:
                return end
            if self._lost:
                raise RefusedError(f"the rig waits for {self._device} no longer: {self._lost}")
            if self._daq.ended is not None:
                return None

    def rows(self, end: BlockEnd) -> Iterator[Samples]:
        """All rows that have come up to the end of a block, parted where rows are missing."""
        deadline = Deadline(LOST_S)
        for key, number in end.messages.items():
            self._client.wait_for(key, number, timeout_s=deadline.left_s)
        rows: Samples | None = None
        with contextlib.suppress(LinkTimeoutError, StreamEndedError):
            while True:
                fresh = self._daq.read(timeout_s=0.0)
                if rows is not None and fresh.gap == 0 and fresh.index == rows.index + len(rows):
                    rows = joined(rows, fresh)
                    continue
                if rows is not None:
                    yield rows
                rows = fresh
        if rows is not None:
            yield rows
