"""Blocks of one rig for any number of listeners in this process, such as instrument twins and the DAQ client.

It subscribes only to the keys that have listeners, to events and to the rig's token: a listener to sensors cannot see
the truth.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drivers.sources.samples import RIG_LOST
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import ChannelTable, Group
from rig.serve.stream_check import AcceptedBlock, BlockValidator, Catalogue, parse_event
from rig.serve.transport import Client, NoReplyError

GRACE_S = 2.0
"""Silence that ends a stream after an end event without row counts, and longest absence of the rig [s]."""


def decimation_factor(native_hz: float, rate_hz: float) -> int:
    """Return the whole number by which a rate must be divided to give another.

    Args:
        native_hz: Rate of the stream [Hz].
        rate_hz: Requested rate [Hz].

    Raises:
        InputError: The native rate is not a multiple of the requested one.
    """
    ratio = native_hz / rate_hz if rate_hz > 0.0 else 0.0
    step = round(ratio) if ratio < 1e9 else 0
    if step < 1 or abs(ratio - step) > 1e-9 * step:
        raise InputError("rate_hz", f"{native_hz:g} divided by a whole number", rate_hz)
    return step


def decimate(block: wire.Block, step: int) -> wire.Block:
    """Return the rows of a block whose number is a multiple of `step`, renumbered."""
    if step == 1:
        return block
    first = -block.index % step
    return wire.Block(
        tick=wire.row_tick(block.tick, block.rate_hz, block.tick_rate_hz, first),
        index=(block.index + first) // step,
        rate_hz=block.rate_hz / step,
        tick_rate_hz=block.tick_rate_hz,
        values=block.values[first::step],
    )


@dataclass(slots=True, eq=False)
class _Listener:
    on_block: Callable[[wire.Block], None]
    on_end: Callable[[str], None]


class RigStream:
    """Passes each block of a stream to the listeners of its key.

    Args:
        client: Transport to the rig; its owner closes it.
        on_event: Called with each event from now on, on a thread of the transport.
    """

    def __init__(self, client: Client, *, on_event: Callable[[dict[str, Any]], None] | None = None) -> None:
        self._client = client
        self._event_listener = on_event
        self._lock = threading.Lock()
        self._order = threading.RLock()
        """Held while rows are passed on: blocks and events arrive on separate threads, and an end must not overtake the
        rows before it."""
        self._listeners: dict[str, list[_Listener]] = {}
        self._subscribed: set[str] = set()
        self._validator: BlockValidator | None = None
        self._rig: str | None = None
        self._gone = False
        self._ends: dict[str, tuple[int, str]] = {}
        """Announced end of the run by key: total number of rows, and the reason."""
        self._last_block_s = 0.0
        """Time of arrival of the last block [s, monotonic]."""
        self.malformed = 0
        """Payloads that do not match their key and the rig's channel table."""
        self.missed = 0
        """Messages that the transport could not recover; the row numbers show the gaps too."""
        if on_event is not None:
            client.subscribe(wire.EVENTS, self._on_event, on_miss=self._on_miss)

    def table(self) -> ChannelTable:
        """Return the channel table of the rig.

        Raises:
            NoReplyError: No rig replies.
            InputError: The reply is not from a rig of this version.
        """
        return self._catalogue().table

    def _catalogue(self) -> Catalogue:
        return Catalogue.read(wire.decode_document(self._client.request(wire.CATALOGUE)))

    def group(self, name: str) -> Group:
        """Return one channel group of the table.

        Raises:
            NoReplyError: No rig replies.
            InputError: This rig does not publish that group.
        """
        groups = self.table().groups
        if name not in groups:
            raise InputError("group", f"a group of this rig ({', '.join(groups)})", name)
        return groups[name]

    def listen(
        self, key: str, on_block: Callable[[wire.Block], None], on_end: Callable[[str], None]
    ) -> Callable[[], None]:
        """Subscribe to a stream from now on.

        Args:
            key: Key of a channel group or of a truth table.
            on_block: Called with each block in order, on a thread of the transport; must not block.
            on_end: Called with the reason when the run has ended or the rig has stopped. A further run follows,
                numbered from 0.

        Returns:
            A function that ends the subscription.
        """
        listener = _Listener(on_block, on_end)
        validator = self._validator or BlockValidator(self._catalogue())
        with self._lock:
            self._listeners.setdefault(key, []).append(listener)
            new, watch = key not in self._subscribed, self._validator is None
            self._subscribed.add(key)
            self._rig = self._client.rig if watch else self._rig
            self._validator = self._validator or validator
        # Not under the lock: a transport may deliver at once.
        if watch:
            if self._event_listener is None:
                self._client.subscribe(wire.EVENTS, self._on_event, on_miss=self._on_miss)
            self._client.watch(wire.ALIVE, self._on_alive)
        if new:
            self._client.subscribe(key, self._on_block, on_miss=self._on_miss)

        def leave() -> None:
            with self._lock:
                if listener in self._listeners[key]:
                    self._listeners[key].remove(listener)

        return leave

    def _on_miss(self, _: str, count: int) -> None:
        self.missed += count

    def _on_block(self, key: str, payload: bytes) -> None:
        with self._order:
            self._take_block(key, payload)

    def _take_block(self, key: str, payload: bytes) -> None:
        with self._lock:
            validator = self._validator
            assert validator is not None
            due, refused = validator.next.get(key, 0), validator.refused
            try:
                accepted = validator.take(key, payload)
            except ValueError:
                self.malformed += 1
                return
            self.malformed += validator.refused - refused
            if accepted:
                self._last_block_s = time.monotonic()
            if validator.next.get(key, 0) < due:
                # The run has been replaced by another.
                self._ends.pop(key, None)
            ending = self._ends.get(key)
            if ending is not None:
                accepted += validator.take_waiting({key: ending[0]}, key)
            done = ending is not None and validator.next.get(key, 0) >= ending[0]
            if done:
                del self._ends[key]
        self._deliver(key, accepted, ending[1] if done and ending else None)

    def _deliver(self, key: str, accepted: list[AcceptedBlock], reason: str | None) -> None:
        with self._lock:
            listeners = list(self._listeners.get(key, ()))
        for listener in listeners:
            for each in accepted:
                listener.on_block(each.block)
            if reason is not None:
                listener.on_end(reason)

    def _on_event(self, _: str, payload: bytes) -> None:
        try:
            event = parse_event(payload)
        except ValueError:
            self.malformed += 1
            return
        if self._event_listener is not None:
            self._event_listener(event)
        if event["event"] != "end":
            return
        rows, reason = event.get("rows"), f"the rig's run has ended: {event.get('reason') or 'without a reason'}"
        if rows is None:
            # A recording without row counts: later blocks are accepted until the stream is silent.
            self._last_block_s = time.monotonic()
            self._end_in_silence(GRACE_S, reason)
            return
        for key in list(self._subscribed):
            with self._order:
                with self._lock:
                    assert self._validator is not None
                    # Blocks and events arrive separately: the last blocks may still be in transit.
                    accepted, total = self._validator.take_waiting(rows, key), rows.get(key, 0)
                    done = self._validator.next.get(key, 0) >= total
                    if not done:
                        self._ends[key] = (total, reason)
                self._deliver(key, accepted, reason if done else None)

    def _end_in_silence(self, wait_s: float, reason: str) -> None:
        """End all streams after a silence of GRACE_S; check first after `wait_s`."""

        def check_silence() -> None:
            left_s = GRACE_S - (time.monotonic() - self._last_block_s)
            if left_s > 0.0:
                self._end_in_silence(left_s, reason)
            else:
                self._end(reason)

        timer = threading.Timer(wait_s, check_silence)
        timer.daemon = True
        timer.start()

    def _on_alive(self, alive: bool) -> None:
        self._gone = not alive
        if not alive:
            # A process that was stopped for longer than its connection lasts reconnects at once.
            timer = threading.Timer(GRACE_S, self._give_up)
            timer.daemon = True
            timer.start()
        elif self._client.rig != self._rig:
            self._give_up(replaced=True)
            self._rig = self._client.rig
            with contextlib.suppress(NoReplyError, ValueError):
                self._validator = BlockValidator(self._catalogue())

    def _give_up(self, *, replaced: bool = False) -> None:
        if (self._gone or replaced) and self._rig is not None:
            self._rig = None
            self._end(RIG_LOST)

    def _end(self, reason: str) -> None:
        for key in list(self._subscribed):
            with self._order:
                with self._lock:
                    self._ends.pop(key, None)
                    accepted = self._validator.take_waiting(None, key) if self._validator is not None else []
                self._deliver(key, accepted, reason)
