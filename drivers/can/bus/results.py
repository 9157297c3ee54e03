"""Results of a bus: the outcome of each frame, the state of its nodes, and its load."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drivers.can.bus import frame as frames
from drivers.can.bus import kernels

STATES = ("error active", "error passive", "bus-off")
OUTCOMES = kernels.OUTCOMES
"""Outcome of a frame, by its number in `RESULT`; the empty text means that it was sent."""

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
"""Results of a bus in an array. `end_ns` is the end of the frame's last bit, or of the error delimiter; `outcome` an
index of `OUTCOMES`; `final` 0 if the frame will be sent again; `frame` has the end as its time."""


class Delivery(NamedTuple):
    """Result of one attempt to send a frame; the fields are those of `RESULT`.

    Attributes:
        frame: The frame.
        node: Number of the node that offered it.
        start_ns: Start of its first bit [ns].
        end_ns: End of its last bit, before the intermission; after an error, end of the error delimiter [ns].
        error: Empty if it was sent, otherwise one of `OUTCOMES`.
        offered_ns: Time of the offer [ns].
        attempt: Number of this attempt, from 1; 0 without an attempt.
        final: Whether the model has finished the frame; False if it will be sent again.
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
    """Counters of a node.

    Attributes:
        state: One of `STATES`.
        tec: Transmit error counter.
        rec: Receive error counter.
        queued: Frames waiting.
        sent: Frames sent.
        errors: Attempts that ended in an error.
        dropped: Frames dropped because the queue was full.
        refused: Frames lost because the node was or became bus-off.
        bus_offs: Number of bus-off states.
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
    """State of the bus, from the start to now. A frame on the wire counts when it ends.

    Attributes:
        now_ns: Time [ns].
        load: Share of the time in which the bus was occupied, with intermissions and errors.
        window_load: The same in the last complete window.
        frames: Frames sent.
    """

    now_ns: int
    load: float
    window_load: float
    frames: int
