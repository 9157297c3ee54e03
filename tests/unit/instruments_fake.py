"""A fake rig: a channel table, blocks of known counts and replies to commands, on any transport."""

from __future__ import annotations

from typing import Any

import numpy as np

from rig.base import wire
from rig.channels.table import default_table
from rig.serve.transport import Server

RATE_HZ = 20_000
BLOCK = 200


def make_counts(group: str, index: int, rows: int) -> np.ndarray:
    """Return 24-bit counts that identify their group, row and column, zeros and negative ones included."""
    columns = len(default_table().groups[group].channels)
    number = np.arange(index, index + rows, dtype=np.int64)[:, None]
    mixed = (number * 7919 + np.arange(columns) * 104_729 + len(group) * 1_299_709) % (1 << 24)
    return np.where(number % 50 == 0, 0, mixed - (1 << 23)).astype(np.int32)


def expected_values(group: str, index: int, rows: int, step: int = 1) -> np.ndarray:
    """Return the values that an instrument must show for these rows, from the definition of a channel's scale."""
    channels = default_table().groups[group].channels
    counts = make_counts(group, index, rows)[::step]
    columns = [
        (counts[:, n] * (2.0 * channel.adc_v / 2.0**channel.adc_bits) - channel.bias_v) / channel.sensitivity_v
        for n, channel in enumerate(channels)
    ]
    return np.stack(columns, axis=1)


class FakeRig:
    """Replies to the catalogue and to commands; publishes on request.

    Args:
        server: Transport; closed by its owner.
        refusal: Reason to refuse commands, or None to accept them.
    """

    def __init__(self, server: Server, *, refusal: str | None = None) -> None:
        self.server = server
        self.refusal = refusal
        self.commands: list[tuple[str, dict[str, Any]]] = []
        self.index: dict[str, int] = {}
        document = {"table": default_table().model_dump(mode="json"), "tick_rate_hz": 1_000_000}
        server.answer(wire.CATALOGUE, lambda _: wire.encode_document(document))
        for name in ("hammer", "speed", "release"):
            server.answer(wire.command_key(name), lambda payload, name=name: self._command(name, payload))
        server.announce()

    def _command(self, name: str, payload: bytes) -> bytes:
        request = wire.decode_document(payload)
        request.pop("from")
        self.commands.append((name, request))
        if self.refusal is not None:
            return wire.encode_document({"accepted": False, "error": self.refusal})
        number = len(self.commands)
        reply = {"accepted": True, "id": number, "command": name, "tick": 1000 * number, "time_s": 1e-3 * number}
        return wire.encode_document(reply)

    def publish(self, *groups: str, blocks: int = 1, skip: int = 0) -> None:
        """Publish blocks of some groups, after skipping some."""
        for _ in range(blocks):
            for group in groups:
                index = self.index.get(group, 0) + skip * BLOCK
                block = wire.Block(index * 50, index, float(RATE_HZ), 1e6, make_counts(group, index, BLOCK))
                self.server.publish(wire.sensor_key(group), wire.encode_block(block))
                self.index[group] = index + BLOCK
            skip = 0

    def end(self) -> None:
        """Publish the event that ends a run."""
        rows = {wire.sensor_key(group): index for group, index in self.index.items()}
        event = {"event": "end", "tick": 0, "time_s": 0.0, "reason": "completed", "rows": rows}
        self.server.publish(wire.EVENTS, wire.encode_document(event))
