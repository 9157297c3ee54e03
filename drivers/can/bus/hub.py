"""The hub of a virtual CAN bus: owns a bus model and lets it run by the wall clock, for endpoints in any process.

Endpoints offer frames at any time; the model decides which is on the wire when. A frame is handed to all endpoints
when the model says that its last bit has passed, at once where the bus is idle afterwards, else together with others
once a tick. An endpoint that is slow or dead loses messages of its own and holds up nobody.
"""

from __future__ import annotations

import contextlib
import ctypes
import threading
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from drivers.can.bus import codec
from drivers.can.bus.endpoints import WINDOW, Endpoints
from drivers.can.bus.frame import CLASSIC_WIDTH, FD_WIDTH, joined, packed, resized
from drivers.can.bus.model import BusModel, warm_up
from drivers.can.bus.results import OUTCOMES
from rig.base import wire
from rig.base.checks import check
from rig.base.closeable import Closing
from rig.base.errors import InputError
from rig.serve.health import Guard, Rising
from rig.serve.transport.limit import Bucket

if TYPE_CHECKING:
    from rig.serve.transport.zenoh import ZenohServer

_TICK_NS = 1_000_000
"""How long frames of a busy bus wait for others to travel with."""
_ALONE_TICK_NS = 10_000_000
"""The same where one endpoint alone is there, which learns nothing but that its frames were sent: 512 may wait."""
_MESSAGES_A_SECOND = 5000
_BURST = 50
"""Frames that may travel alone on a bus that is idle in between; beyond, they wait for the tick as well."""
_ERRORS_A_SECOND = 1000
_ERROR_BURST = 100
"""Error frames that reach the endpoints; a bus that nothing works on has ten times as many."""
_REPORT_NS = 100_000_000
_HASTE_NS = 10_000_000
"""How soon a report may follow another, and how often, where something has happened."""
_GAP_NS = 20_000
"""When to look again at a bus on which something waits for the end of an intermission or the like."""
_LARGEST = 8 + codec.MAX_RECORDS * codec.RECORDS[FD_WIDTH].itemsize
_FAILED_S = 0.05
"""How long the bus rests where its model has failed."""

_ON_WIRE = {
    "bit error": (codec.PROTOCOL | codec.BUS_ERROR, bytes((0, 0, 0x80, 0))),
    "collision of equal identifiers": (codec.PROTOCOL | codec.BUS_ERROR, bytes((0, 0, 0x80, 0))),
    "no acknowledge": (codec.PROTOCOL | codec.BUS_ERROR | codec.NO_ACKNOWLEDGE, bytes((0, 0, 0x80, 0x19))),
}
"""Error frames of what all nodes see: class and first bytes as SocketCAN has them (0x80: on transmission; 0x19: in the
acknowledge slot); other outcomes are the sender's affair."""
_CONTROLLER_STATES = (codec.ACTIVE_AGAIN, codec.TRANSMIT_PASSIVE)


class Hub(Closing):
    """The one owner of a channel's bus.

    Args:
        model: The bus; nobody else may use it from now on.
        channel: Name of the bus.
        server: Where endpoints of other processes come in; None has only those of this process.
        acknowledge: Let the hub's own node acknowledge, so that an only endpoint can send.
        clock: Monotonic clock [ns].

    Raises:
        InputError: The channel's name is none.
    """

    def __init__(
        self,
        model: BusModel,
        channel: str = "can0",
        server: ZenohServer | None = None,
        *,
        acknowledge: bool = True,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        if not codec.is_name(channel):
            raise InputError("channel", "letters, digits, - and _, such as can0", channel)
        self.channel = channel
        self._model = model
        self._server = server
        self._clock = clock
        self._start_ns = clock()
        self.epoch_ns = time.time_ns()
        """Wall time at bus time 0 since the Unix epoch [ns]."""
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._resting = False
        """A frame that is offered now changes nothing before the hub looks again."""
        self._stopping = False
        self._counts: Counter[str] = Counter()
        self.endpoints = Endpoints(model, self._counts, lambda: self._advance(self._now()))
        self._guard = Guard(f"CAN {channel}: the hub")
        self._forging = Rising(f"CAN {channel}: " + "{} times somebody spoke under the name of another endpoint")
        self._losing = Rising(f"CAN {channel}: " + "{} frames were not sent: more than the bus or a node takes")
        self._outbox: list[np.ndarray] = []
        self._report_due = False
        self._next_report_ns = 0
        self._last_report_ns = 0
        self._published_ns = -_TICK_NS
        self._errors = Bucket(_ERRORS_A_SECOND, _ERROR_BURST, 0.0)
        self._messages = Bucket(_MESSAGES_A_SECOND, _BURST, 0.0)
        self._thread = threading.Thread(target=self._run, name=f"can hub {channel}", daemon=True)
        model.attach("hub", listen_only=not acknowledge)

    # Life.

    def start(self) -> None:
        """Take endpoints, and let the bus run on a thread of its own."""
        warm_up()
        if self._server is not None:
            for name in codec.REQUESTS:
                self._server.answer(codec.request_key(self.channel, name), partial(self.reply, name))
            self._server.on_trouble(self._guard.tell)
            self._server.watch(codec.node_key(self.channel, "*"), self.watch)
            self._server.hear(
                codec.offer_key(self.channel, "*"), lambda key, payload: self.offer(key.rpartition("/")[2], payload)
            )
        self._thread.start()
        if self._server is not None:
            self._server.announce(codec.alive_key(self.channel))

    def close(self) -> None:
        """End the bus; the server stays open and is its owner's to close."""
        with self._lock:
            if self._stopping:
                return
            self._stopping = True
            locals_ = list(self.endpoints.locals.values())
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)
        for local in locals_:
            self._guard(local.lost)

    def __enter__(self) -> Self:
        self.start()
        return self

    # Endpoints.

    def connect(self, name: str, take: Callable[[codec.Said], None], lost: Callable[[], None]) -> str:
        """Make an endpoint of this process known, before it joins.

        Args:
            name: Its name.
            take: Called with what the bus says, on the hub's thread; must return at once.
            lost: Called when the hub ends.

        Returns:
            Its secret.
        """
        with self._lock:
            return self.endpoints.connect(name, take, lost)

    def disconnect(self, name: str) -> None:
        """Forget an endpoint of this process; what it has offered is still sent."""
        with self._lock:
            self.endpoints.disconnect(name)

    def offer(self, name: str, payload: bytes) -> None:
        """Take a message of frames from an endpoint: its secret, then the message."""
        records = None
        with contextlib.suppress(codec.CodecError):
            if len(payload) <= codec.SECRET_BYTES + _LARGEST:
                records = codec.decode(payload[codec.SECRET_BYTES :])
        self.offer_records(name, payload[: codec.SECRET_BYTES].hex(), records)

    def offer_records(
        self, name: str, secret: str, records: codec.Said | None, due_ns: np.ndarray | None = None
    ) -> None:
        """`offer` within this process.

        Args:
            name: Name of the endpoint.
            secret: Its secret.
            records: Array of one of the `RECORDS` layouts, which is not kept; anything else is malformed.
            due_ns: When the controller gets each frame by the hub's clock [ns], shape of `records`; None: now.
        """
        with self._lock:
            endpoint = self.endpoints.owner(name, secret)
            if endpoint is None:
                return
            if isinstance(records, np.ndarray):
                due_ns = None if due_ns is None else due_ns - self._start_ns
                self._report_due |= self.endpoints.offer(endpoint, records, self._now(), due_ns)
            else:
                self._counts["malformed"] += 1
            if self._report_due or not self._resting:
                self._wake.set()

    def answer(self, name: str, document: dict[str, Any] | bytes) -> dict[str, Any]:
        """Answer a request: `join`, `set`, `flush`, `status`.

        Args:
            name: Which.
            document: Its arguments, as in `drivers.can.bus.codec`, or what came.

        Raises:
            InputError: It is none, or not from the endpoint that it names.
        """
        request = check(codec.REQUESTS[name], document, field=name)
        if isinstance(request, codec.Joining):
            with self._lock:
                endpoint = self.endpoints.join(request)
                # Frames wait no longer than a listener may expect.
                self._wake.set()
                bus = {"window": WINDOW, **self._bus(), "epoch_ns": self.epoch_ns}
                return {"node": endpoint.number, "secret": endpoint.secret, **bus}
        if not isinstance(request, codec.Flushing):
            return self.status()
        with self._lock:
            # Both restart the controller, as real ones must be for the one and mostly are for the other.
            self.endpoints.restart(request)
            self._report_due = True
        self._wake.set()
        return {}

    def reply(self, name: str, payload: bytes) -> bytes:
        """`answer` as bytes; a refusal says why."""
        try:
            return wire.encode_document(self.answer(name, payload or b"{}"))
        except InputError as error:
            with self._lock:
                self._counts["refused"] += 1
            return wire.encode_document({"error": str(error), "field": error.field, "must": error.must})

    def watch(self, key: str, there: bool) -> None:
        """The token of an endpoint of another process has come or gone."""
        with self._lock:
            self.endpoints.watch(key.rpartition("/")[2], there)
        self._wake.set()

    def _bus(self) -> dict[str, Any]:
        speed = self._model.speed
        return {"fd": speed.fd, "nominal_bit_s": speed.nominal_bit_s, "data_bit_s": speed.data_bit_s}

    # The bus by the clock.

    def _now(self) -> int:
        return self._clock() - self._start_ns

    def _run(self) -> None:
        _sharpen_sleep()
        while not self._stopping:
            if self._guard(self._turn) is None:
                time.sleep(_FAILED_S)

    def _turn(self) -> bool:
        """One step of the bus, and the wait for the next."""
        with self._lock:
            self._wake.clear()
            now = self._now()
            said, wake_ns, self._resting = self._step(now)
        for each in said:
            self._publish(each)
        left_s = (wake_ns - self._now()) * 1e-9
        if left_s > 0:
            self._wake.wait(left_s)
        return True

    def _step(self, now: int) -> tuple[list[codec.Said], int, bool]:
        """Let the bus run until now.

        Returns:
            Messages to publish, time of the next look [ns], and whether frames that are offered meanwhile can wait.
        """
        self._advance(now)
        next_ns = self._model.next_ns()
        waiting, may_send = self.endpoints.waiting, self._messages.left(now * 1e-9) >= 1.0
        alone, idle = len(self.endpoints) < 2, self._model.idle
        tick_ns = _ALONE_TICK_NS if alone else _TICK_NS
        said: list[codec.Said] = []
        if self._outbox and (now >= self._published_ns + tick_ns or (may_send and (not waiting if alone else idle))):
            self._messages.take()
            self._published_ns = now
            said += self._empty_outbox()
        if now >= (self._last_report_ns + _HASTE_NS if self._report_due else self._next_report_ns):
            reports = self._reports(now)
            if reports:
                # They count what was sent before them.
                said += [*self._empty_outbox(), reports]
            self._report_due = False
            self._last_report_ns = now
            self._next_report_ns = now + _REPORT_NS
        wake_ns = self._last_report_ns + _HASTE_NS if self._report_due else self._next_report_ns
        tick_ns += self._published_ns
        if next_ns is not None:
            # A frame that comes later cannot end before that.
            next_ns = max(next_ns, now) + _GAP_NS if idle else max(next_ns, now + _GAP_NS)
            # More than this one: they travel together.
            wake_ns = max(next_ns, tick_ns) if waiting > 1 or self._messages.left(now * 1e-9) < 1.0 else next_ns
        if self._outbox:
            wake_ns = min(wake_ns, tick_ns)
        # Nothing that is offered can end before a frame that is on the wire, nor is missed by one that is alone.
        return said, wake_ns, not idle or bool(self._outbox) or (alone and next_ns is not None)

    def _advance(self, now: int) -> None:
        # One more: what was offered by now must have begun.
        results = self._model.advance_records(max(now + 1, self._model.now_ns))
        if len(results):
            self._take_results(results)

    def _take_results(self, results: np.ndarray) -> None:
        """Note what the model is done with, and keep what the endpoints must hear of."""
        self.endpoints.settle(results)
        records = results["frame"].view(codec.RECORDS[FD_WIDTH])
        records["time_ns"] += np.uint64(self.epoch_ns)
        records["node"] = self.endpoints.numbers[results["node"]]
        records["flags"] &= codec.FD | codec.BRS | codec.ESI
        if results["outcome"].any():
            records = self._with_errors(records, results)
        self._counts["frames"] += len(results) - int(np.count_nonzero(results["outcome"]))
        if len(records):
            self._outbox.append(records)

    def _with_errors(self, records: np.ndarray, results: np.ndarray) -> np.ndarray:
        """The same with error frames in place of those that failed on the wire, and without others that failed."""
        self._report_due = True
        kept = np.ones(len(records), bool)
        for row in np.flatnonzero(results["outcome"]).tolist():
            text = OUTCOMES[results["outcome"][row]]
            end_ns = int(results["end_ns"][row])
            kept[row] = text in _ON_WIRE and self._errors.left(end_ns * 1e-9) >= 1.0
            if kept[row]:
                self._errors.take()
            if text in _ON_WIRE:
                self._counts["errors"] += 1
                kind, data = _ON_WIRE[text]
                number = int(records["node"][row])
                error = codec.error_record(self.epoch_ns + end_ns, kind, data=data + bytes(4), node=number)
                records[row] = packed([error], FD_WIDTH)[0]
            else:
                self._counts["unsent"] += 1
        return records[kept]

    def _empty_outbox(self) -> list[np.ndarray]:
        if not self._outbox:
            return []
        records = self._outbox[0] if len(self._outbox) == 1 else joined(self._outbox)
        self._outbox.clear()
        if records["length"].max() <= CLASSIC_WIDTH:
            records = resized(records, CLASSIC_WIDTH)
        size = codec.MAX_RECORDS
        return [records[first : first + size] for first in range(0, len(records), size)]

    def _reports(self, now: int) -> list[codec.Report]:
        """What has changed at the endpoints; those that have gone are forgotten."""
        found = []
        self.endpoints.forget_gone()
        for endpoint in self.endpoints:
            report = self.endpoints.report(endpoint)
            before, endpoint.reported = endpoint.reported, report
            if report == before:
                continue
            found.append(report)
            # A recovery may be over before anybody has looked.
            bus_offs = self._model.node(endpoint.node).bus_offs
            if bus_offs > endpoint.bus_offs:
                self._tell(now, report, codec.BUS_OFF, 0)
            state = 2 if bus_offs > endpoint.bus_offs else 0 if before is None else before.state
            endpoint.bus_offs = bus_offs
            if state == 2 and report.state < 2:
                self._tell(now, report, codec.RESTARTED, 0)
            elif report.state != state:
                self._tell(now, report, codec.CONTROLLER, _CONTROLLER_STATES[report.state])
        return found

    def _tell(self, now: int, report: codec.Report, kind: int, detail: int) -> None:
        """An error frame about one node's controller."""
        counters = (min(report.transmit_errors, 255), min(report.receive_errors, 255))
        data = bytes((0, detail, 0, 0, 0, 0, *counters))
        change = codec.error_record(self.epoch_ns + now, kind | codec.COUNTERS, data=data, node=report.node)
        self._outbox.append(packed([change], FD_WIDTH))

    def _publish(self, said: codec.Said) -> None:
        if self._server is not None:
            payload = codec.encode(said) if isinstance(said, np.ndarray) else codec.encode_reports(said)
            self._guard(self._server.publish, codec.bus_key(self.channel), payload)
        for local in list(self.endpoints.locals.values()):
            self._guard(local.take, said)

    def status(self) -> dict[str, Any]:
        """What goes on: endpoints, counts."""
        with self._lock:
            return {
                "channel": self.channel,
                **self._bus(),
                "load": self._model.state().window_load,
                "time_s": self._now() * 1e-9,
                "counts": {name: self._counts[name] for name in _COUNTS},
                "nodes": [
                    {"name": row.name, "listen_only": row.listen_only, **self.endpoints.report(row)._asdict()}
                    for row in self.endpoints
                ],
                "warnings": self.warnings(),
            }

    def warnings(self) -> list[str]:
        """What a person should know of, while it is so."""
        return [
            *self._guard.warnings(),
            *self._forging.warnings(self._counts["forged"]),
            *self._losing.warnings(self._counts["unsent"] + self._counts["surplus"]),
        ]

    def figures(self) -> dict[str, int]:
        """Frames that were not sent, and what was tried under others' names."""
        return {"unsent": self._counts["unsent"] + self._counts["surplus"], "forged": self._counts["forged"]}


_COUNTS = (
    "frames", "errors", "unsent", "malformed", "invalid", "surplus", "strange", "refused", "forged", "evicted",
)  # fmt: skip


def _sharpen_sleep() -> None:
    """Let this thread's sleeps end within some microseconds, not 50 late (Linux)."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(29, 1, 0, 0, 0)  # PR_SET_TIMERSLACK [ns]
