"""The blocks of one rig for any number of listeners in this process: what twins and the DAQ client read from.

Only the keys that are listened to, the catalogue, the events and the rig's token are asked for: whoever listens to
sensors cannot see the truth.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import ChannelTable, Group
from rig.serve.stream_check import Catalogue, Intake, Taken, event_in
from rig.serve.transport import Client, NoReplyError

GRACE_S = 2.0
"""After an end that does not tell the number of rows, and after the last block: silence that ends the stream; and how
long a rig that is gone may take to be there again [s]."""
RIG_GONE = "the rig has gone"


def whole_step(native_hz: float, rate_hz: float) -> int:
    """Every so many rows make a rate.

    Raises:
        InputError: The rate is not a whole fraction of the native one.
    """
    ratio = native_hz / rate_hz if rate_hz > 0.0 else 0.0
    step = round(ratio) if ratio < 1e9 else 0
    if step < 1 or abs(ratio - step) > 1e-9 * step:
        raise InputError("rate_hz", f"{native_hz:g} divided by a whole number", rate_hz)
    return step


def thin(block: wire.Block, step: int) -> wire.Block:
    """Every so many rows of a block: those whose number is a multiple of `step`; they are numbered anew."""
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
    """Hands each block of a stream to whoever listens to its key.

    Args:
        client: Transport to the rig; stays open, and is closed by its owner.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._lock = threading.Lock()
        self._order = threading.RLock()
        """Held from taking rows until they are handed on: blocks and events come on threads of their own, and an end
        must not overtake the rows before it."""
        self._listeners: dict[str, list[_Listener]] = {}
        self._subscribed: set[str] = set()
        self._intake: Intake | None = None
        self._rig: str | None = None
        self._gone = False
        self._ends: dict[str, tuple[int, str]] = {}
        """Keys of which the run's end was announced: number of rows in all, and the reason."""
        self._heard_s = 0.0
        """When the last block came [s, monotonic]."""
        self.malformed = 0
        """Payloads that were not what their key and the rig's catalogue promise."""
        self.missed = 0
        """Messages that the transport could not bring back; the rows show the gaps too."""

    def table(self) -> ChannelTable:
        """The channel table as the rig runs it.

        Raises:
            NoReplyError: No rig answers.
            InputError: What answers is no rig of this version.
        """
        return self._catalogue().table

    def _catalogue(self) -> Catalogue:
        return Catalogue.read(wire.decode_document(self._client.request(wire.CATALOGUE)))

    def group(self, name: str) -> Group:
        """One group of the table.

        Raises:
            NoReplyError: No rig answers.
            InputError: This rig does not publish that group.
        """
        groups = self.table().groups
        if name not in groups:
            raise InputError("group", f"one that this rig publishes ({', '.join(groups)})", name)
        return groups[name]

    def listen(
        self, key: str, on_block: Callable[[wire.Block], None], on_end: Callable[[str], None]
    ) -> Callable[[], None]:
        """Take all blocks of a stream from now on; returns what ends that.

        Args:
            key: Of a sensor group, or of a table of the truth.
            on_block: Takes blocks in order, on a thread of the transport; must not wait.
            on_end: Takes the reason for which nothing more comes: the run has ended, or the rig has gone. Where another
                run begins, its blocks come, numbered from 0.
        """
        listener = _Listener(on_block, on_end)
        intake = self._intake or Intake(self._catalogue())
        with self._lock:
            self._listeners.setdefault(key, []).append(listener)
            new, watch = key not in self._subscribed, self._intake is None
            self._subscribed.add(key)
            self._rig = self._client.rig if watch else self._rig
            self._intake = self._intake or intake
        # Not under the lock: a transport may deliver at once.
        if watch:
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
            self._take(key, payload)

    def _take(self, key: str, payload: bytes) -> None:
        with self._lock:
            intake = self._intake
            assert intake is not None
            due, refused = intake.next.get(key, 0), intake.refused
            try:
                taken = intake.take(key, payload)
            except ValueError:
                self.malformed += 1
                return
            self.malformed += intake.refused - refused
            if taken:
                self._heard_s = time.monotonic()
            if intake.next.get(key, 0) < due:
                # Another run.
                self._ends.pop(key, None)
            ending = self._ends.get(key)
            if ending is not None:
                taken += intake.rest({key: ending[0]}, key)
            done = ending is not None and intake.next.get(key, 0) >= ending[0]
            if done:
                del self._ends[key]
        self._hand_on(key, taken, ending[1] if done and ending else None)

    def _hand_on(self, key: str, taken: list[Taken], reason: str | None) -> None:
        with self._lock:
            listeners = list(self._listeners.get(key, ()))
        for listener in listeners:
            for each in taken:
                listener.on_block(each.block)
            if reason is not None:
                listener.on_end(reason)

    def _on_event(self, _: str, payload: bytes) -> None:
        try:
            event = event_in(payload)
        except ValueError:
            self.malformed += 1
            return
        if event["event"] != "end":
            return
        rows, reason = event.get("rows"), f"the rig's run has ended: {event.get('reason') or 'without a reason'}"
        if rows is None:
            # A recording that does not tell what there was: whatever may still come has its time.
            self._heard_s = time.monotonic()
            self._end_in_silence(GRACE_S, reason)
            return
        for key in list(self._subscribed):
            with self._order:
                with self._lock:
                    assert self._intake is not None
                    # Blocks and events travel apart: the last blocks may be still to come.
                    taken, total = self._intake.rest(rows, key), rows.get(key, 0)
                    done = self._intake.next.get(key, 0) >= total
                    if not done:
                        self._ends[key] = (total, reason)
                self._hand_on(key, taken, reason if done else None)

    def _end_in_silence(self, wait_s: float, reason: str) -> None:
        """End all streams once no block has come for so long; look again at the earliest time at which that can be."""

        def look() -> None:
            rest_s = GRACE_S - (time.monotonic() - self._heard_s)
            if rest_s > 0.0:
                self._end_in_silence(rest_s, reason)
            else:
                self._end(reason)

        timer = threading.Timer(wait_s, look)
        timer.daemon = True
        timer.start()

    def _on_alive(self, alive: bool) -> None:
        self._gone = not alive
        if not alive:
            # A process that was stopped for longer than its link lives is linked again at once.
            timer = threading.Timer(GRACE_S, self._give_up)
            timer.daemon = True
            timer.start()
        elif self._client.rig != self._rig:
            self._give_up(replaced=True)
            self._rig = self._client.rig
            with contextlib.suppress(NoReplyError, ValueError):
                self._intake = Intake(self._catalogue())

    def _give_up(self, *, replaced: bool = False) -> None:
        if (self._gone or replaced) and self._rig is not None:
            self._rig = None
            self._end(RIG_GONE)

    def _end(self, reason: str) -> None:
        for key in list(self._subscribed):
            with self._order:
                with self._lock:
                    self._ends.pop(key, None)
                    taken = self._intake.rest(None, key) if self._intake is not None else []
                self._hand_on(key, taken, reason)
