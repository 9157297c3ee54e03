"""Model of a CAN bus: which node sends when, for how long, and what fails; without clock, connection or thread.

Time is an argument, an integer [ns]; a frame's length is rounded to it once. The same offers give the same results,
independent of the steps in which time is advanced.

Modelled (ISO 11898-1:2015): arbitration by identifier; serialisation of exact frames; acknowledge; error flags with
their superposition, delimiter, retransmission; error counters, error passive with suspended transmission, bus-off and
its recovery; bounded transmit queues. A frame takes part in an arbitration if it was offered by its first bit. A bit
error is one that the sender sees: the bit is inverted for all nodes.

Not modelled: errors that only some nodes see, errors in error frames, overload frames, the last bit of the end of
frame that receivers ignore, bit timing with its resynchronisation and line delays, and the error state indicator, which
is sent as in the frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drivers.can.bus import frame as frames
from drivers.can.bus import kernels
from drivers.can.bus.results import OUTCOMES, RESULT, STATES, BusState, Delivery, NodeState
from drivers.can.bus.timing import Speed, speed
from rig.base.errors import InputError, Words

if TYPE_CHECKING:
    import can

_COUNTERS = {
    "tec": kernels.TEC,
    "rec": kernels.REC,
    "queued": kernels.COUNT,
    **{name: getattr(kernels, name.upper()) for name in ("sent", "errors", "dropped", "refused", "bus_offs")},
}
"""Column of each of a node's counters."""
_WINDOW_NS = 100_000_000
"""Length of the windows of the load [ns]."""
_GROWTH = 1 << 10


def warm_up() -> None:
    """Compile the kernels, or load them from the cache: about 10 s once per computer, so before a bus is live."""
    model = BusModel("1M/5M")
    node, _ = model.attach(), model.attach()
    model.disturb(node)
    model.offer(node, frames.Frame(0, b"\0", fd=True, brs=True))
    model.advance(1_000_000)


class BusModel:
    """A bus with its nodes, for one thread at a time.

    Args:
        rate: Bit rates, as for `drivers.can.bus.timing.speed`.
        error_rate: Probability of an error per bit.
        seed: Seed of these errors.
    """

    def __init__(
        self,
        rate: str | float | Speed | can.BitTiming | can.BitTimingFd,
        *,
        error_rate: float = 0.0,
        seed: int = 0,
    ) -> None:
        """Start with an idle bus without nodes."""
        if not 0.0 <= error_rate <= 1.0:
            raise InputError("error_rate", "between 0 and 1", error_rate)
        self.speed = speed(rate)
        self._names: list[str] = []
        self._offers: list[np.ndarray] = []
        cells = np.zeros(kernels.CELLS, np.int64)
        cells[kernels.WINDOW_LENGTH] = _WINDOW_NS
        self._bus = kernels.Bus(
            cells=cells,
            nodes=np.zeros((0, kernels.NODE_COLUMNS), np.int64),
            queues=np.zeros((0, 1), np.int64),
            slots=np.zeros((0, kernels.SLOT_COLUMNS), np.int64),
            store=np.zeros(0, frames.RECORD),
            arrivals=np.zeros(0, np.int64),
            unused=np.zeros(0, np.int64),
            senders=np.zeros(0, np.int64),
            random=np.array([seed & 0xFFFFFFFFFFFFFFFF], np.uint64),
        )
        self._results = np.zeros((0, kernels.RESULT_COLUMNS), np.int64)
        self._error_rate = float(error_rate)
        kernels.draw_gap(self._bus, self._error_rate)

    @property
    def now_ns(self) -> int:
        """Time up to which the bus was advanced [ns]."""
        return int(self._bus.cells[kernels.NOW])

    def attach(
        self, name: str = "", *, queue: int = 64, listen_only: bool = False, in_order: bool = False
    ) -> int:  # fmt: skip
        """Add a node.

        Args:
            name: Name in messages.
            queue: Capacity of the transmit queue [frames], including the one on the wire; frames beyond it are dropped
                and counted.
            listen_only: Whether it sends nothing, not even acknowledges.
            in_order: Whether it sends its frames in the order of their offers, as an operating system's transmit queue
                does; otherwise the highest priority first, as a controller with buffers does.

        Returns:
            Its number.
        """
        if not 1 <= queue <= 1 << 16:
            raise InputError("queue", "between 1 and 65536 frames", queue)
        node = self._find_free_row()
        bus = self._bus
        rows = max(len(self._names), node + 1)
        if rows > len(bus.nodes) or queue > bus.queues.shape[1]:
            width = max(queue, bus.queues.shape[1])
            queues = np.zeros((rows, width), np.int64)
            queues[: len(bus.queues), : bus.queues.shape[1]] = bus.queues
            self._bus = bus = bus._replace(
                queues=queues, nodes=_extend(bus.nodes, rows), senders=_extend(bus.senders, rows)
            )
            # One step of the kernel ends at most one transmission, or empties each queue once.
            self._results = np.zeros((rows * (width + 2) + _GROWTH, kernels.RESULT_COLUMNS), np.int64)
        if node == len(self._names):
            self._names.append(name)
        self._names[node] = name or f"node {node}"
        row = bus.nodes[node]
        row[:] = 0
        row[kernels.ATTACHED] = 1
        row[kernels.LISTENING] = listen_only
        row[kernels.IN_ORDER] = in_order
        row[kernels.CAPACITY] = queue
        row[kernels.HEAD] = -1
        return node

    def detach(self, node: int) -> None:
        """Remove a node: waiting frames are lost; a frame on the wire is still sent."""
        row = self._row(node)
        bus = self._bus
        on_wire = set(bus.senders[: bus.cells[kernels.SENDERS]].tolist())
        waiting = bus.queues[node, : row[kernels.COUNT]].tolist()
        kept = [slot for slot in waiting if slot in on_wire]
        self._free([slot for slot in waiting if slot not in on_wire])
        bus.queues[node, : len(kept)] = kept
        row[kernels.COUNT] = len(kept)
        row[kernels.HEAD] = kept[0] if kept else -1
        row[kernels.RECOVERING] = 0
        row[kernels.ATTACHED] = 0

    def offer(self, node: int, frame: frames.Frame, at_ns: int | None = None) -> None:
        """Pass a frame to a node's controller.

        Args:
            node: Number of the node.
            frame: The frame.
            at_ns: Time of the offer [ns]; None or a time in the past means now.
        """
        if self._row(node)[kernels.LISTENING]:
            raise InputError("node", "one that may send", Words(f"{self._names[node]} (listen only)"))
        if frame.fd and not self.speed.fd:
            raise InputError("frame", f"classic on a bus of {self.speed}", frame)
        record = frames.make_record(frame, node=node, time_ns=self.now_ns if at_ns is None else max(at_ns, 0))
        self.take(frames.pack_records([record], frames.FD_WIDTH))

    def take(self, offers: np.ndarray) -> None:
        """Pass many frames to controllers; the caller has checked that their nodes can send them.

        Args:
            offers: Array of `drivers.can.bus.frame.RECORD`, which is kept, preferably in the order of its times; `node`
                is the sender, `time_ns` the time of the offer.
        """
        self._offers.append(offers.view(frames.RECORD))

    def advance(self, until_ns: int) -> list[Delivery]:
        """Advance the time.

        Args:
            until_ns: New time [ns]. A frame that could start exactly then waits, as one of higher priority may still be
                offered.

        Returns:
            Everything that ended by then, in the order of time. If several nodes sent the same frame at once, each has
            its delivery, with the same times.
        """
        results = self.advance_records(until_ns)
        if not len(results):
            return []
        names = ("node", "start_ns", "end_ns", "outcome", "offered_ns", "attempt", "final")
        rows = zip(frames.frames(results["frame"]), *(results[name].tolist() for name in names), strict=True)
        return [
            Delivery(frame, node, start, end, OUTCOMES[outcome], offered, attempt, final != 0)
            for frame, node, start, end, outcome, offered, attempt, final in rows
        ]

    def advance_records(self, until_ns: int) -> np.ndarray:
        """Advance the time as `advance`, and return an array of `RESULT`, shape (results,)."""
        if not self.now_ns <= until_ns < 1 << 61:
            raise InputError("until_ns", f"{self.now_ns} or later, and below 2 ** 61", until_ns)
        self._take_offers()
        parts = []
        while True:
            count = kernels.advance(
                self._bus, until_ns, self._results, self.speed.nominal_ps, self.speed.data_ps, self._error_rate
            )
            if count:
                parts.append(self._collect(self._results[:count]))
            if not self._bus.cells[kernels.MORE]:
                break
        if len(parts) == 1:
            return parts[0]
        return np.concatenate(parts) if parts else np.zeros(0, RESULT)

    def next_ns(self) -> int | None:
        """Return the earliest time at which something can end or start [ns]; None if nothing is left."""
        cells = self._bus.cells
        if cells[kernels.SENDERS]:
            return int(cells[kernels.END])
        if self._offers or self._bus.nodes[:, kernels.COUNT].any():
            return self.now_ns
        if cells[kernels.NEXT] < cells[kernels.ARRIVALS]:
            return int(self._bus.slots[self._bus.arrivals[cells[kernels.NEXT]], kernels.AT])
        return None

    @property
    def idle(self) -> bool:
        """Whether nothing is on the wire or queued; frames offered for a later time may still come."""
        bus = self._bus
        return not (bus.cells[kernels.SENDERS] or self._offers or bus.nodes[:, kernels.COUNT].any())

    def disturb(self, node: int, *, count: int = 1, bit: int = 24) -> None:
        """Insert one bit error into each of the next frames that a node sends.

        Args:
            node: Number of the node.
            count: Number of transmissions.
            bit: Number of the bit from the start of frame, with stuff bits; in a shorter frame the last one.
        """
        if count < 0 or bit < 0:
            raise InputError("count and bit", "not negative", (count, bit))
        row = self._row(node)
        row[kernels.DISTURBED] = count
        row[kernels.DISTURBED_BIT] = bit

    def node(self, node: int) -> NodeState:
        """Return a node's counters, also after it was removed."""
        row = self._row(node, gone=True)
        counters = {name: int(row[column]) for name, column in _COUNTERS.items()}
        return NodeState(state=STATES[row[kernels.STATE]], **counters)

    def state(self) -> BusState:
        """Return the state of the bus."""
        cells = self._bus.cells
        passed = max(self.now_ns, int(cells[kernels.FREE]), 1)
        return BusState(
            now_ns=self.now_ns,
            load=int(cells[kernels.BUSY]) / passed,
            window_load=int(cells[kernels.WINDOW_LAST]) / _WINDOW_NS,
            frames=int(cells[kernels.FRAMES]),
        )

    def _row(self, node: int, *, gone: bool = False) -> np.ndarray:
        if not 0 <= node < len(self._names) or not (gone or self._bus.nodes[node, kernels.ATTACHED]):
            raise InputError("node", "the number of a node of this bus", node)
        return self._bus.nodes[node]

    def _find_free_row(self) -> int:
        """Return a row that no node, no frame on the wire and no coming frame uses; otherwise a new one."""
        self._take_offers()
        bus = self._bus
        cells = bus.cells
        coming = set(bus.slots[bus.arrivals[cells[kernels.NEXT] : cells[kernels.ARRIVALS]], kernels.OWNER].tolist())
        for node in range(len(self._names)):
            if not bus.nodes[node, kernels.ATTACHED] and not bus.nodes[node, kernels.COUNT] and node not in coming:
                return node
        return len(self._names)

    def _take_offers(self) -> None:
        """Move the frames that were offered since the last step into slots."""
        if not self._offers:
            return
        batch = frames.join_records(self._offers)
        self._offers.clear()
        cells = self._bus.cells
        missing = len(batch) - int(cells[kernels.FREE_SLOTS])
        if missing > 0:
            self._grow(missing)
        kernels.enlist(self._bus, batch, len(batch), self.speed.nominal_ps, self.speed.data_ps)

    def _grow(self, missing: int) -> None:
        bus = self._bus
        before = len(bus.slots)
        after = max(2 * before, before + missing, _GROWTH)
        self._bus = bus._replace(
            slots=_extend(bus.slots, after),
            store=_extend(bus.store, after),
            arrivals=_extend(bus.arrivals, after),
            unused=_extend(bus.unused, after),
        )
        self._free(np.arange(before, after))

    def _collect(self, rows: np.ndarray) -> np.ndarray:
        slots = rows[:, kernels.R_SLOT]
        results = np.zeros(len(rows), RESULT)
        results["frame"] = self._bus.store[slots]
        results["frame"]["time_ns"] = rows[:, kernels.R_END]
        results["start_ns"] = rows[:, kernels.R_START]
        results["end_ns"] = rows[:, kernels.R_END]
        results["offered_ns"] = rows[:, kernels.R_AT]
        results["outcome"] = rows[:, kernels.R_OUTCOME]
        results["attempt"] = np.minimum(rows[:, kernels.R_ATTEMPT], 65535)
        results["node"] = rows[:, kernels.R_NODE]
        results["final"] = rows[:, kernels.R_FINAL]
        self._free(slots[rows[:, kernels.R_FINAL] != 0])
        return results

    def _free(self, slots: np.ndarray | list[int]) -> None:
        cells = self._bus.cells
        free = int(cells[kernels.FREE_SLOTS])
        self._bus.unused[free : free + len(slots)] = slots
        cells[kernels.FREE_SLOTS] = free + len(slots)


def _extend(array: np.ndarray, rows: int) -> np.ndarray:
    """Return the rows followed by rows of zeros."""
    extended = np.zeros((rows, *array.shape[1:]), array.dtype)
    extended[: len(array)] = array
    return extended
