"""What a bus tells of itself: what happened to each frame, how its nodes are, and its load."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drivers.can.bus import frame as frames
from drivers.can.bus import kernels

STATES = ("error active", "error passive", "bus-off")
OUTCOMES = kernels.OUTCOMES
"""What happened to a frame, by the number in `RESULT`; the empty text: it was sent."""

RESULT = np.dtype(
    [
        ("start_ns", "<i8"),
        ("end_ns", "<i8"),
        ("offered_ns", "<i8"),
        ("outcome", "u1"),
        ("final", "u1"),
        ("attempt", "<u2"),
        ("node", "<u4"),
        ("frame", frames.RECORD),
    ]
)
"""What happened on the bus, in an array. `end_ns` is the end of frame's last bit, after an error the delimiter's last;
`outcome` an index of `OUTCOMES`; `final` 0 where the frame will be tried again; `frame` has the end as its time."""


class Delivery(NamedTuple):
    """What happened to a frame; the fields are those of `RESULT`.

    Attributes:
        frame: The frame.
        node: Who offered it.
        start_ns: Its first bit [ns].
        end_ns: End of its last bit, before the intermission; after an error, end of the error delimiter [ns].
        error: Empty where it was sent, else one of `OUTCOMES`.
        offered_ns: When it was offered [ns].
        attempt: Number of this attempt, from 1; 0 where it never came to one.
        final: Whether the model is done with it; false where it will be sent again.
    """

    frame: frames.Frame
    node: int
    start_ns: int
    end_ns: int
    error: str
    offered_ns: int
    attempt: int
    final: bool


@dataclass(frozen=True, slots=True)
class NodeState:
    """A node's counters.

    Attributes:
        state: One of `STATES`.
        tec: Transmit error counter.
        rec: Receive error counter.
        queued: Frames waiting.
        sent: Frames sent.
        errors: Attempts that ended in an error.
        dropped: Frames that found the queue full.
        refused: Frames lost because the node was or went bus-off.
        bus_offs: How often it went bus-off.
    """

    state: str
    tec: int
    rec: int
    queued: int
    sent: int
    errors: int
    dropped: int
    refused: int
    bus_offs: int


@dataclass(frozen=True, slots=True)
class BusState:
    """The bus as a whole, from the start to now. What is on the wire now counts when it ends.

    Attributes:
        now_ns: Time [ns].
        load: Share of the time that it was taken, intermissions and errors with it.
        window_load: The same in the last window that has ended.
        frames: Frames sent.
    """

    now_ns: int
    load: float
    window_load: float
    frames: int
