"""Payloads, taken for what they say only where a recording can hold it.

What comes off a wire or out of a damaged file may be of the right form and still name a time in the far future or a
rate of zero. Such a payload is malformed like one that does not decode; it must not end a recording.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rig.intake import event_in
from rig.wire import EDGES, EVENTS, Block, decode_block, decode_document, schema_of

_MOST = 1 << 53
"""Ticks up to here are exact in every number that they become: 285 years of microseconds."""


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


def document_in(key: str, payload: bytes) -> dict[str, Any]:
    """The document in a payload; one on the key of events is an event.

    Raises:
        ValueError: It is not what the key promises.
    """
    return event_in(payload) if key == EVENTS else decode_document(payload)


def tick_in(document: dict[str, Any] | None) -> int | None:
    """The tick that a document names; None if it names none."""
    tick = document.get("tick") if document is not None else None
    return tick if isinstance(tick, int) and not isinstance(tick, bool) and abs(tick) <= _MOST else None
