"""Payloads, read once, and believed only where a recording can hold what they say.

What comes off a wire or out of a damaged file may be of the right form and still name a time in the far future or a
rate of zero. Such a payload is malformed like one that does not decode; it must not end a recording.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rig.base.wire import EDGES, EVENTS, Block, decode_block, decode_document, schema_of
from rig.serve.intake import event_in

_MOST = 1 << 53
"""Ticks up to here are exact in every number that they become: 285 years of microseconds."""


@dataclass(frozen=True, slots=True)
class Payload:
    """What came on a key, and what it says.

    Attributes:
        key: The key.
        data: The bytes, as they came.
        wall_ns: When they came [unix ns].
        block: The block in them; None on a key of documents.
        document: The document in them; None on a key of blocks.
    """

    key: str
    data: bytes
    wall_ns: int
    block: Block | None = None
    document: dict[str, Any] | None = None

    @classmethod
    def read(cls, key: str, data: bytes, wall_ns: int) -> Payload:
        """Read a payload; one that is not what its key promises has neither block nor document."""
        block = document = None
        try:
            if schema_of(key) is None:
                document = event_in(data) if key == EVENTS else decode_document(data)
            else:
                block = block_in(key, data)
        except ValueError:
            pass
        return cls(key, data, wall_ns, block, document)

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
    if key == EDGES:
        sound = block.values.shape[1] == 1 and bool((np.abs(block.values) <= _MOST).all())
    else:
        sound = block.rate_hz > 0.0
    if not sound:
        raise ValueError(f"payload must have rows at a rate, or edges at times; instead received {key}: {block}")
    return block


def tick_in(document: dict[str, Any] | None) -> int | None:
    """The tick that a document names; None if it names none."""
    tick = document.get("tick") if document is not None else None
    return tick if isinstance(tick, int) and not isinstance(tick, bool) and abs(tick) <= _MOST else None
