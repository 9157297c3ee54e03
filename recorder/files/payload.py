"""Payloads, decoded once, and believed only where a recording can hold what they say.

What comes off a wire or out of a damaged file may be of the right form and still name a time in the far future or a
rate of zero. Such a payload is malformed like one that does not decode; it must not end a recording.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from rig.base.wire import EDGES, EVENTS, Block, decode_block, decode_document, schema_of
from rig.serve.stream_check import Taken, event_in

_MOST = 1 << 53
"""Ticks up to here are exact in every number that they become: 285 years of microseconds."""


@dataclass(frozen=True, eq=False)
class Payload:
    """Message of a stream, as bytes and decoded.

    Attributes:
        key: Key of the stream.
        data: Bytes, as they came.
        wall_ns: Time of arrival [unix ns].
        block: Decoded block; None on a key of documents, and where it is malformed.
    """

    key: str
    data: bytes
    wall_ns: int
    block: Block | None = None

    @classmethod
    def read(cls, key: str, data: bytes, wall_ns: int) -> Self:
        """Decode a payload; one that is not what its key promises has neither block nor document."""
        block = None
        with contextlib.suppress(ValueError):
            block = None if schema_of(key) is None else block_in(key, data)
        return cls(key, data, wall_ns, block)

    @classmethod
    def of(cls, taken: Taken) -> Self:
        """Return the payload of a block that the intake has decoded; an unsound block makes it malformed."""
        block = taken.block if _is_sound(taken.key, taken.block) else None
        return cls(taken.key, taken.payload, taken.wall_ns, block)

    @cached_property
    def document(self) -> dict[str, Any] | None:
        """Document, decoded when it is first asked for; None on a key of blocks, and where it is malformed."""
        if schema_of(self.key) is None:
            with contextlib.suppress(ValueError):
                return event_in(self.data) if self.key == EVENTS else decode_document(self.data)
        return None

    @property
    def malformed(self) -> bool:
        """Whether it is not what its key promises."""
        return self.block is None and self.document is None

    @property
    def tick(self) -> int | None:
        """The tick that it names; None if it names none."""
        return tick_in(self.document) if self.block is None else self.block.tick

    def event(self, name: str) -> bool:
        """Whether it is an event of that name."""
        return self.key == EVENTS and self.document is not None and self.document.get("event") == name


def block_in(key: str, payload: bytes) -> Block:
    """The block in a payload.

    Args:
        key: Key of blocks that it came on.
        payload: Its bytes.

    Raises:
        ValueError: It is not what the key promises.
    """
    block = decode_block(payload, schema_of(key) or "")
    if not _is_sound(key, block):
        raise ValueError(f"payload must have rows at a rate, or edges at times; instead received {key}: {block}")
    return block


def _is_sound(key: str, block: Block) -> bool:
    """Return whether a block has rows at a rate or, on the key of edges, one column of times that a clock can have."""
    if key == EDGES:
        return block.values.shape[1] == 1 and bool((np.abs(block.values) <= _MOST).all())
    return block.rate_hz > 0.0


def tick_in(document: dict[str, Any] | None) -> int | None:
    """The tick that a document names; None if it names none."""
    tick = document.get("tick") if document is not None else None
    return tick if isinstance(tick, int) and not isinstance(tick, bool) and abs(tick) <= _MOST else None
