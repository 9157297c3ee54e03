"""Output of a replay: changes, counts and publishes payloads, and holds the recorded end until the replay ends."""

from __future__ import annotations

from typing import Any

from replays.player.edit import Edit, Stamp
from replays.player.timeline import Item
from rig.base import wire
from rig.base.text import replace_nonfinite
from rig.serve.transport import Server


class Outlet:
    """Publishes payloads that are due.

    Args:
        server: Transport.
        edit: Changes to the payloads.
        tick_rate_hz: Ticks per simulated second [Hz].
        renumber: Whether to renumber ticks and rows.
    """

    def __init__(self, server: Server, edit: Edit, tick_rate_hz: int, *, renumber: bool) -> None:
        self._server = server
        self._edit = edit
        self._tick_rate_hz = tick_rate_hz
        self._stamp = Stamp() if renumber else None
        self._pass = 0
        self._rows = wire.Continuity()
        self._held: dict[str, list[bytes]] = {wire.EVENTS: [], wire.STATUS: []}
        """Payloads that mark the end of the recorded run, held until the replay ends."""
        groups = list(edit.catalogue["table"]["groups"])
        counted = wire.sensor_key("probes" if "probes" in groups else groups[0])
        self._counted = edit.key(counted) or counted
        self.rate_hz = 0.0
        """Rate of the stream that clients acknowledge [Hz]; 0 before its first block."""
        self.block_rows = 0
        """Samples in the last block of that stream."""
        self.recorded_status: dict[str, Any] = {}
        """Last published status of the recording."""
        self.payloads = self.blocks = self.rows = self.left_out = 0

    @property
    def published(self) -> int:
        """Number of published rows of the stream that clients acknowledge."""
        return self._rows.next.get(self._counted, 0)

    def begin(self, number: int, tick: int) -> None:
        """Start a pass, or continue after a seek, at this tick of the recording."""
        self._pass = number
        self.left_out += sum(map(len, self._held.values()))
        for waiting in self._held.values():
            waiting.clear()
        if self._stamp is not None:
            self._stamp.jump(tick)

    def send(self, item: Item) -> None:
        """Publish a payload that is due."""
        key = self._edit.key(item.key)
        if key is None:
            self.left_out += 1
        elif item.block is not None:
            self._send_block(key, item, item.block)
        elif item.key in self._held:
            self._send_document(key, item)
        else:
            self._publish(key, item.payload)

    def publish_event(self, event: dict[str, Any]) -> None:
        """Publish an event that is not in the recording."""
        if self._stamp is not None:
            event = self._stamp.document(event, self._tick_rate_hz)
        if (key := self._edit.key(wire.EVENTS)) is not None:
            self._publish(key, wire.encode_document(replace_nonfinite(self._rows.add_row_counts(event))))

    def end(self, *, as_recorded: bool) -> bool:
        """Publish the recorded end and return whether there was one.

        Args:
            as_recorded: Whether the recording was published unchanged, so that the row numbers in its end are valid.
        """
        for payload in self._held[wire.EVENTS]:
            if not as_recorded:
                payload = wire.encode_document(self._rows.add_row_counts(wire.decode_document(payload)))
            self._publish(self._edit.key(wire.EVENTS) or wire.EVENTS, payload)
        return bool(self._held[wire.EVENTS])

    def end_status(self) -> None:
        """Publish the recorded status of the ended run, if there is one."""
        for payload in self._held[wire.STATUS]:
            self._publish(self._edit.key(wire.STATUS) or wire.STATUS, payload)

    def _send_block(self, key: str, item: Item, recorded: wire.Block) -> None:
        block = self._edit.block(item.key, recorded)
        if self._stamp is not None:
            block = self._stamp.block(item.key, block)
        self._publish(key, item.payload if block is recorded else wire.encode_block(block))
        self._rows.follow(key, block.index, len(block.values))
        self.blocks += 1
        self.rows += len(block.values)
        if key == self._counted:
            self.rate_hz, self.block_rows = block.rate_hz, len(block.values)

    def _send_document(self, key: str, item: Item) -> None:
        """Publish an event or status; hold one that ends the run until the replay ends."""
        payload = item.payload
        try:
            document = wire.decode_document(payload)
        except ValueError:
            self._publish(key, payload)
            return
        if self._stamp is not None:
            if document.get("event") == "start" and self._pass > 1:
                self.left_out += 1
                return
            stamped = self._stamp.document(document, self._tick_rate_hz)
            payload = payload if stamped is document else wire.encode_document(stamped)
        waiting = self._held[item.key]
        if document.get("event") == "end" or document.get("state") == "ended":
            waiting.append(payload)
            return
        while waiting:  # The run continued, so the held payloads did not end it.
            self._publish(key, waiting.pop(0))
        if item.key == wire.STATUS:
            self.recorded_status = document
        self._publish(key, payload)

    def _publish(self, key: str, payload: bytes) -> None:
        self._server.publish(key, payload)
        self.payloads += 1
