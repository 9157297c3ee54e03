"""Hub of a virtual CAN bus: owns a bus model and runs it by the wall clock, for endpoints in any process.

Endpoints offer frames at any time; the model decides which is on the wire when. A frame is sent to all endpoints after
its last bit: at once if the bus is idle then, otherwise in a batch once per tick. An endpoint that is slow or hangs
loses messages and delays no other endpoint.
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
from drivers.can.bus.endpoints import QUEUE_FRAMES, Endpoints
from drivers.can.bus.frame import CLASSIC_WIDTH, FD_WIDTH, join_records, pack_records, resize_records
from drivers.can.bus.model import BusModel, warm_up
from drivers.can.bus.results import OUTCOMES
from rig.base import wire
from rig.base.checks import check
from rig.base.errors import InputError
from rig.base.files import Closing
from rig.serve.health import Guard, IncreaseWarning
from rig.serve.transport.limit import Bucket

if TYPE_CHECKING:
    from rig.serve.transport.zenoh import ZenohServer

_TICK_NS = 1_000_000
"""Batch period of a busy bus [ns]."""
_SINGLE_TICK_NS = 10_000_000
"""Batch period with a single endpoint [ns], which only needs to know that its frames were sent: 512 may wait."""
_MAX_MESSAGES_PER_S = 5000
_MESSAGE_BURST = 50
"""Largest burst of frames that are sent singly on a bus that is idle in between; further ones wait for the tick."""
_MAX_ERRORS_PER_S = 1000
_ERROR_BURST = 100
"""Largest burst of error frames sent to the endpoints; a bus without acknowledgement produces ten times as many."""
_REPORT_NS = 100_000_000
_MIN_REPORT_NS = 10_000_000
"""Shortest time between two reports after a change [ns]; without a change the period is `_REPORT_NS`."""
_RETRY_NS = 20_000
"""Delay of the next step if frames wait for the end of an intermission or the like [ns]."""
_MAX_MESSAGE_BYTES = 8 + codec.MAX_RECORDS * codec.RECORDS[FD_WIDTH].itemsize
_FAILURE_PAUSE_S = 0.05
"""Pause of the bus after a failure of its model [s]."""

_WIRE_ERRORS = {
    "bit error": (codec.PROTOCOL | codec.BUS_ERROR, bytes((0, 0, 0x80, 0))),
    "collision of equal identifiers": (codec.PROTOCOL | codec.BUS_ERROR, bytes((0, 0, 0x80, 0))),
    "no acknowledge": (codec.PROTOCOL | codec.BUS_ERROR | codec.NO_ACKNOWLEDGE, bytes((0, 0, 0x80, 0x19))),
}
"""Error frames of failures that all nodes see: class and first bytes as in SocketCAN (0x80: on transmission; 0x19: in
the acknowledge slot). Other outcomes concern only the sender."""
_CONTROLLER_STATES = (codec.ACTIVE_AGAIN, codec.TRANSMIT_PASSIVE)


class Hub(Closing):
    """Owner of a channel's bus.

    Args:
        model: The bus; for the exclusive use of the hub.
        channel: Name of the bus.
        server: Transport for endpoints of other processes; None for endpoints of this process only.
        acknowledge: Let the hub's own node acknowledge, so that a single endpoint can send.
        clock: Monotonic clock [ns].

    Raises:
        InputError: The channel's name is invalid.
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
        self._can_wait = False
        """Whether a frame offered now changes nothing before the next step."""
        self._stopping = False
        self._counts: Counter[str] = Counter()
        self.endpoints = Endpoints(model, self._counts, lambda: self._advance(self._now()))
        self._guard = Guard(f"CAN {channel}: the hub")
        self._forging = IncreaseWarning(f"CAN {channel}: " + "{} times a client used the name of another endpoint")
        self._losing = IncreaseWarning(
            f"CAN {channel}: " + "{} frames were not sent: more than the bus or a node accepts"
        )
        self._outbox: list[np.ndarray] = []
        self._report_due = False
        self._next_report_ns = 0
        self._last_report_ns = 0
        self._published_ns = -_TICK_NS
        self._errors = Bucket(_MAX_ERRORS_PER_S, _ERROR_BURST, 0.0)
        self._messages = Bucket(_MAX_MESSAGES_PER_S, _MESSAGE_BURST, 0.0)
        self._thread = threading.Thread(target=self._run, name=f"can hub {channel}", daemon=True)
        model.attach("hub", listen_only=not acknowledge)

    # ---- start and end ----

    def start(self) -> None:
        """Accept endpoints, and run the bus on a separate thread."""
        warm_up()
        if self._server is not None:
            for name in codec.REQUESTS:
                self._server.answer(codec.request_key(self.channel, name), partial(self.reply, name))
            self._server.on_failure(self._guard.record_failure)
            self._server.watch(codec.node_key(self.channel, "*"), self.record_token)
            self._server.subscribe_reports(
                codec.offer_key(self.channel, "*"), lambda key, payload: self.offer(key.rpartition("/")[2], payload)
            )
        self._thread.start()
        if self._server is not None:
            self._server.announce(codec.alive_key(self.channel))

    def close(self) -> None:
        """Stop the bus; the server stays open."""
        with self._lock:
            if self._stopping:
                return
            self._stopping = True
            locals_ = list(self.endpoints.locals.values())
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)
        for local in locals_:
            self._guard(local.on_close)

    def __enter__(self) -> Self:
        self.start()
        return self

    # ---- endpoints ----

    def connect(self, name: str, on_message: Callable[[codec.HubMessage], None], on_close: Callable[[], None]) -> str:
        """Register an endpoint of this process before it joins.

        Args:
            name: Name of the endpoint.
            on_message: Called with the messages of the bus, on the hub's thread; must not block.
            on_close: Called when the hub ends.

        Returns:
            The endpoint's secret.
        """
        with self._lock:
            return self.endpoints.connect(name, on_message, on_close)

    def disconnect(self, name: str) -> None:
        """Remove an endpoint of this process; the frames that it has offered are still sent."""
        with self._lock:
            self.endpoints.disconnect(name)

    def offer(self, name: str, payload: bytes) -> None:
        """Accept frames from an endpoint: its secret, followed by a message."""
        records = None
        with contextlib.suppress(codec.CodecError):
            if len(payload) <= codec.SECRET_BYTES + _MAX_MESSAGE_BYTES:
                records = codec.decode(payload[codec.SECRET_BYTES :])
        self.offer_records(name, payload[: codec.SECRET_BYTES].hex(), records)

    def offer_records(
        self, name: str, secret: str, records: codec.HubMessage | None, due_ns: np.ndarray | None = None
    ) -> None:
        """Accept frames from an endpoint of this process.

        Args:
            name: Name of the endpoint.
            secret: Its secret.
            records: Array of one of the `RECORDS` layouts, which is not kept; anything else counts as malformed.
            due_ns: Time at which the controller receives each frame [ns of the hub's clock], shape of `records`; None
                for now.
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
            if self._report_due or not self._can_wait:
                self._wake.set()

    def answer(self, name: str, document: dict[str, Any] | bytes) -> dict[str, Any]:
        """Execute a request, and return the reply.

        Args:
            name: `join`, `set`, `flush` or `status`.
            document: Its arguments, as in `drivers.can.bus.codec`, decoded or as received.

        Raises:
            InputError: The request is malformed, or not from the endpoint that it names.
        """
        request = check(codec.REQUESTS[name], document, field=name)
        if isinstance(request, codec.JoinRequest):
            with self._lock:
                endpoint = self.endpoints.join(request)
                # A new listener may not wait longer than for a tick.
                self._wake.set()
                bus = {"window": QUEUE_FRAMES, **self._bus(), "epoch_ns": self.epoch_ns}
                return {"node": endpoint.number, "secret": endpoint.secret, **bus}
        if not isinstance(request, codec.FlushRequest):
            return self.status()
        with self._lock:
            # Both restart the controller: real controllers must for one of them, and mostly do for the other.
            self.endpoints.restart(request)
            self._report_due = True
        self._wake.set()
        return {}

    def reply(self, name: str, payload: bytes) -> bytes:
        """Execute a request, and return the reply or refusal as bytes."""
        try:
            return wire.encode_document(self.answer(name, payload or b"{}"))
        except InputError as error:
            with self._lock:
                self._counts["refused"] += 1
            return wire.encode_document({"error": str(error), "field": error.field, "must": error.must})

    def record_token(self, key: str, present: bool) -> None:
        """Record that the token of an endpoint of another process has appeared or disappeared."""
        with self._lock:
            self.endpoints.record_token(key.rpartition("/")[2], present)
        self._wake.set()

    def _bus(self) -> dict[str, Any]:
        speed = self._model.speed
        return {"fd": speed.fd, "nominal_bit_s": speed.nominal_bit_s, "data_bit_s": speed.data_bit_s}

    # ---- running the bus ----

    def _now(self) -> int:
        return self._clock() - self._start_ns

    def _run(self) -> None:
        _reduce_timer_slack()
        while not self._stopping:
            if self._guard(self._run_once) is None:
                time.sleep(_FAILURE_PAUSE_S)

    def _run_once(self) -> bool:
        """Run the bus until now, publish, and wait for the next step."""
        with self._lock:
            self._wake.clear()
            now = self._now()
            messages, wake_ns, self._can_wait = self._step(now)
        for each in messages:
            self._publish(each)
        left_s = (wake_ns - self._now()) * 1e-9
        if left_s > 0:
            self._wake.wait(left_s)
        return True

    def _step(self, now: int) -> tuple[list[codec.HubMessage], int, bool]:
        """Run the bus until now.

        Returns:
            Messages to publish, time of the next step [ns], and whether frames that are offered meanwhile can wait.
        """
        self._advance(now)
        next_ns = self._model.next_ns()
        waiting, may_send = self.endpoints.waiting, self._messages.count_tokens(now * 1e-9) >= 1.0
        single, idle = len(self.endpoints) < 2, self._model.idle
        tick_ns = _SINGLE_TICK_NS if single else _TICK_NS
        messages: list[codec.HubMessage] = []
        if self._outbox and (now >= self._published_ns + tick_ns or (may_send and (not waiting if single else idle))):
            self._messages.remove_token()
            self._published_ns = now
            messages += self._empty_outbox()
        if now >= (self._last_report_ns + _MIN_REPORT_NS if self._report_due else self._next_report_ns):
            reports = self._reports(now)
            if reports:
                # A report counts the frames before it.
                messages += [*self._empty_outbox(), reports]
            self._report_due = False
            self._last_report_ns = now
            self._next_report_ns = now + _REPORT_NS
        wake_ns = self._last_report_ns + _MIN_REPORT_NS if self._report_due else self._next_report_ns
        tick_ns += self._published_ns
        if next_ns is not None:
            # A frame that is offered later cannot end before that.
            next_ns = max(next_ns, now) + _RETRY_NS if idle else max(next_ns, now + _RETRY_NS)
            # More than this frame waits: send them in one batch.
            wake_ns = max(next_ns, tick_ns) if waiting > 1 or self._messages.count_tokens(now * 1e-9) < 1.0 else next_ns
        if self._outbox:
            wake_ns = min(wake_ns, tick_ns)
        # No offer can end before a frame on the wire, nor is it missed by a single endpoint.
        return messages, wake_ns, not idle or bool(self._outbox) or (single and next_ns is not None)

    def _advance(self, now: int) -> None:
        # One more, so that frames offered until now have started.
        results = self._model.advance_records(max(now + 1, self._model.now_ns))
        if len(results):
            self._take_results(results)

    def _take_results(self, results: np.ndarray) -> None:
        """Count finished frames, and queue those that the endpoints receive."""
        self.endpoints.count_results(results)
        records = results["frame"].view(codec.RECORDS[FD_WIDTH])
        records["time_ns"] += np.uint64(self.epoch_ns)
        records["node"] = self.endpoints.numbers[results["node"]]
        records["flags"] &= codec.FD | codec.BRS | codec.ESI
        if results["outcome"].any():
            records = self._replace_failed(records, results)
        self._counts["frames"] += len(results) - int(np.count_nonzero(results["outcome"]))
        if len(records):
            self._outbox.append(records)

    def _replace_failed(self, records: np.ndarray, results: np.ndarray) -> np.ndarray:
        """Replace frames that failed on the wire by error frames, and remove others that failed."""
        self._report_due = True
        kept = np.ones(len(records), bool)
        for row in np.flatnonzero(results["outcome"]).tolist():
            text = OUTCOMES[results["outcome"][row]]
            end_ns = int(results["end_ns"][row])
            kept[row] = text in _WIRE_ERRORS and self._errors.count_tokens(end_ns * 1e-9) >= 1.0
            if kept[row]:
                self._errors.remove_token()
            if text in _WIRE_ERRORS:
                self._counts["errors"] += 1
                kind, data = _WIRE_ERRORS[text]
                number = int(records["node"][row])
                error = codec.error_record(self.epoch_ns + end_ns, kind, data=data + bytes(4), node=number)
                records[row] = pack_records([error], FD_WIDTH)[0]
            else:
                self._counts["unsent"] += 1
        return records[kept]

    def _empty_outbox(self) -> list[np.ndarray]:
        if not self._outbox:
            return []
        records = self._outbox[0] if len(self._outbox) == 1 else join_records(self._outbox)
        self._outbox.clear()
        if records["length"].max() <= CLASSIC_WIDTH:
            records = resize_records(records, CLASSIC_WIDTH)
        size = codec.MAX_RECORDS
        return [records[first : first + size] for first in range(0, len(records), size)]

    def _reports(self, now: int) -> list[codec.NodeReport]:
        """Return the reports that have changed, after removing endpoints that have left."""
        changed = []
        self.endpoints.remove_departed()
        for endpoint in self.endpoints:
            report = self.endpoints.report(endpoint)
            before, endpoint.reported = endpoint.reported, report
            if report == before:
                continue
            changed.append(report)
            # The node may have recovered since the last report.
            bus_offs = self._model.node(endpoint.node).bus_offs
            if bus_offs > endpoint.bus_offs:
                self._queue_state_change(now, report, codec.BUS_OFF, 0)
            state = 2 if bus_offs > endpoint.bus_offs else 0 if before is None else before.state
            endpoint.bus_offs = bus_offs
            if state == 2 and report.state < 2:
                self._queue_state_change(now, report, codec.RESTARTED, 0)
            elif report.state != state:
                self._queue_state_change(now, report, codec.CONTROLLER, _CONTROLLER_STATES[report.state])
        return changed

    def _queue_state_change(self, now: int, report: codec.NodeReport, kind: int, detail: int) -> None:
        """Queue an error frame about one node's controller."""
        counters = (min(report.transmit_errors, 255), min(report.receive_errors, 255))
        data = bytes((0, detail, 0, 0, 0, 0, *counters))
        change = codec.error_record(self.epoch_ns + now, kind | codec.COUNTERS, data=data, node=report.node)
        self._outbox.append(pack_records([change], FD_WIDTH))

    def _publish(self, messages: codec.HubMessage) -> None:
        if self._server is not None:
            payload = codec.encode(messages) if isinstance(messages, np.ndarray) else codec.encode_reports(messages)
            self._guard(self._server.publish, codec.bus_key(self.channel), payload)
        for local in list(self.endpoints.locals.values()):
            self._guard(local.on_message, messages)

    def status(self) -> dict[str, Any]:
        """Return the state of the bus: load, counts, endpoints, warnings."""
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
        """Return the current warnings for the operator."""
        return [
            *self._guard.warnings(),
            *self._forging.warnings(self._counts["forged"]),
            *self._losing.warnings(self._counts["unsent"] + self._counts["surplus"]),
        ]

    def figures(self) -> dict[str, int]:
        """Return the number of frames not sent, and of attempts under another endpoint's name."""
        return {"unsent": self._counts["unsent"] + self._counts["surplus"], "forged": self._counts["forged"]}


_COUNTS = (
    "frames", "errors", "unsent", "malformed", "invalid", "surplus", "strange", "refused", "forged", "evicted",
)  # fmt: skip


def _reduce_timer_slack() -> None:
    """Reduce the delay after this thread's sleeps from 50 to a few microseconds (Linux)."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(29, 1, 0, 0, 0)  # PR_SET_TIMERSLACK [ns]
