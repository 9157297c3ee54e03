"""Payloads, taken for what they say only where a recording can hold it.

What comes off a wire or out of a damaged file may be of the right form and still name a time in the far future or a
rate of zero. Such a payload is malformed like one that does not decode; it must not end a recording.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from rig.wire import EDGES, Block, decode_block, schema_of

_MOST = 1 << 53
"""Ticks up to here are exact in every number that they become: 285 years of microseconds."""
_PLACE = struct.Struct("<qq")


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


def place_of(payload: bytes) -> tuple[int, int] | None:
    """Tick and row number that a block says it begins at, without a look at the rest; None if it is too short."""
    return _PLACE.unpack_from(payload, 4) if len(payload) >= 4 + _PLACE.size else None
