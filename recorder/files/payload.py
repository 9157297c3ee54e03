"""Decoded payloads, checked for values that a recording can hold.

Data from a network or a damaged file can be well-formed and still contain a time in the far future or a rate of zero.
Such a payload counts as malformed, like one that cannot be decoded; it must not end a recording.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from rig.base.wire import EDGES, EVENTS, Block, decode_block, decode_document, get_schema
from rig.serve.stream_check import AcceptedBlock, parse_event

_MAX_EXACT_TICK = 1 << 53
"""Largest tick that is exact as int64 and as float64; 285 years at one microsecond per tick."""


@dataclass(frozen=True, eq=False)
class Payload:
    """Message of a stream, as bytes and decoded.

    Attributes:
        key: Key of the stream.
        data: Bytes as received.
        wall_ns: Arrival time [unix ns].
        block: Decoded block; None on a document key, and for a malformed payload.
    """

    key: str
    data: bytes
    wall_ns: int
    block: Block | None = None

    @classmethod
    def read(cls, key: str, data: bytes, wall_ns: int) -> Self:
        """Decode a payload; a malformed one has neither block nor document."""
        block = None
        with contextlib.suppress(ValueError):
            block = None if get_schema(key) is None else parse_block(key, data)
        return cls(key, data, wall_ns, block)

    @classmethod
    def from_block(cls, accepted: AcceptedBlock) -> Self:
        """Return the payload of a block decoded by the validator; an invalid block makes it malformed."""
        block = accepted.block if _is_sound(accepted.key, accepted.block) else None
        return cls(accepted.key, accepted.payload, accepted.wall_ns, block)

    @cached_property
    def document(self) -> dict[str, Any] | None:
        """Document, decoded on first access; None on a block key, and for a malformed payload."""
        if get_schema(self.key) is None:
            with contextlib.suppress(ValueError):
                return parse_event(self.data) if self.key == EVENTS else decode_document(self.data)
        return None

    @property
    def malformed(self) -> bool:
        """True if the payload does not fit the format of its key."""
        return self.block is None and self.document is None

    @property
    def tick(self) -> int | None:
        """Tick in the payload; None if it has none."""
        return get_tick(self.document) if self.block is None else self.block.tick

    def event(self, name: str) -> bool:
        """Return whether the payload is an event of a name."""
        return self.key == EVENTS and self.document is not None and self.document.get("event") == name


def parse_block(key: str, payload: bytes) -> Block:
    """Return the block in a payload.

    Args:
        key: Block key on which the payload was received.
        payload: Its bytes.

    Raises:
        ValueError: The payload does not fit the format of the key.
    """
    block = decode_block(payload, get_schema(key) or "")
    if not _is_sound(key, block):
        raise ValueError(f"payload must have rows at a rate, or edges at times; received {key}: {block}")
    return block


def _is_sound(key: str, block: Block) -> bool:
    """Return whether a block has a positive rate or, on the edge key, one column of valid times."""
    if key == EDGES:
        return block.values.shape[1] == 1 and bool((np.abs(block.values) <= _MAX_EXACT_TICK).all())
    return block.rate_hz > 0.0


def get_tick(document: dict[str, Any] | None) -> int | None:
    """Return the tick in a document; None if it has none."""
    tick = document.get("tick") if document is not None else None
    return tick if isinstance(tick, int) and not isinstance(tick, bool) and abs(tick) <= _MAX_EXACT_TICK else None
