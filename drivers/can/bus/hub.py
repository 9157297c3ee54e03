"""The hub of a virtual CAN bus: owns a bus model and lets it run by the wall clock, for endpoints in any process.

Endpoints offer frames at any time; the model decides which is on the wire when. A frame is handed to all endpoints
when the model says that its last bit has passed, at once where the bus is idle afterwards, else together with others
once a tick. An endpoint that is slow or dead loses messages of its own and holds up nobody.

A name belongs to whoever has joined under it for as long as it is there: only with the secret of that join does anybody
offer, set, flush or join again. What goes over the network does so in clear, so this keeps apart those who cannot
read each other's messages, which access control sees to.
"""

from __future__ import annotations

import contextlib
import ctypes
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from drivers.can.bus import codec
from drivers.can.bus.frame import CLASSIC_WIDTH, FD_WIDTH, Record, fault_of, pack, resized, sendable
from drivers.can.bus.model import OUTCOMES, STATES, BusModel, warm_up
from drivers.health import Guard, Rising
from rig import wire
from rig.errors import InputError
from rig.outside import check

if TYPE_CHECKING:
    from rig.transport.zenoh import ZenohServer

WINDOW = 512
"""Frames that one endpoint may have waiting; what it offers beyond is dropped and counted."""
MAX_ENDPOINTS = 64
"""Of other processes; those of this one always get in."""
MAX_TOKENLESS = 16
"""Those of them that have shown no token; the oldest makes room for the next."""

_TICK_NS = 1_000_000
"""How long frames of a busy bus wait for others to travel with."""
_MESSAGES_A_SECOND = 5000
_BURST = 50
"""Frames that may travel alone on a bus that is idle in between; beyond, they wait for the tick as well."""
_ERRORS_A_SECOND = 1000
_ERROR_BURST = 100
"""Error frames that endpoints are told of; a bus that nothing works on has ten times as many."""
_REPORT_NS = 100_000_000
_HASTE_NS = 10_000_000
"""How soon a report may follow another, and how often, where something has happened."""
_GAP_NS = 20_000
"""When to look again at a bus on which something waits for the end of an intermission or the like."""
_PARTING_S = 1.0
"""How long frames of an endpoint that has gone may wait for the bus."""
_TOKENLESS_S = 10.0
"""How long an endpoint may be without a token; it comes before the request to join, but on another way."""
_MOST_TOKENS = 16 * MAX_ENDPOINTS
_LARGEST = 8 + codec.MAX_RECORDS * codec.RECORDS[FD_WIDTH].itemsize
_FAILED_S = 0.05
"""How long the bus rests where its model has failed."""
_FEW = 8
"""Frames that are offered one by one; arrays would cost more than they save."""

_ON_WIRE = {
    "bit error": (codec.PROTOCOL | codec.BUS_ERROR, bytes((0, 0, 0x80, 0))),
    "collision of equal identifiers": (codec.PROTOCOL | codec.BUS_ERROR, bytes((0, 0, 0x80, 0))),
    "no acknowledge": (codec.PROTOCOL | codec.BUS_ERROR | codec.NO_ACKNOWLEDGE, bytes((0, 0, 0x80, 0x19))),
}
"""Error frames of what all nodes see: class and first bytes as SocketCAN has them (0x80: on transmission; 0x19: in the
acknowledge slot); other outcomes are the sender's affair."""
_CONTROLLER_STATES = (codec.ACTIVE_AGAIN, codec.TRANSMIT_PASSIVE)


@dataclass(slots=True)
class _Endpoint:
    name: str
    number: int
    """What it is called on the medium; given to another only after all other numbers."""
    node: int
    """Its number in the model."""
    joined_s: float
    listen_only: bool
    token: bool
    """Whether its token has been seen, or it needs none."""
    secret: str
    offered: int = 0
    done: int = 0
    dropped: int = 0
    left_s: float | None = None
    """When it was found to have gone."""
    reported: codec.Report | None = None
    bus_offs: int = 0
    """How often it had been bus-off when last reported."""


@dataclass(frozen=True, slots=True)
class _Local:
    """An endpoint of this process."""

    take: Callable[[bytes], None]
    lost: Callable[[], None]
    secret: str


class Hub:
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
        self._stopping = False
        self._endpoints: dict[str, _Endpoint] = {}
        self._by_node: dict[int, _Endpoint] = {}
        self._numbers = np.full(256, codec.NO_NODE, np.uint16)
        """Number on the medium by number in the model."""
        self._locals: dict[str, _Local] = {}
        self._tokens: dict[str, None] = {}
        """The newest last."""
        self._guard = Guard(f"CAN {channel}: the hub")
        self._forging = Rising(f"CAN {channel}: " + "{} times somebody spoke under the name of another endpoint")
        self._losing = Rising(f"CAN {channel}: " + "{} frames were not sent: more than the bus or a node takes")
        self._outbox: list[np.ndarray] = []
        self._waiting = 0
        """Frames that the model is not done with."""
        self._report_due = False
        self._next_report_ns = 0
        self._last_report_ns = 0
        self._errors_left = float(_ERROR_BURST)
        self._errors_ns = 0
        self._published_ns = -_TICK_NS
        self._credit = float(_BURST)
        self._credit_ns = 0
        self._next_number = 1
        self._counts: Counter[str] = Counter()
        self._thread = threading.Thread(target=self._run, name=f"can hub {channel}", daemon=True)
        model.attach("hub", listen_only=not acknowledge)

    # Life.

    def start(self) -> None:
        """Take endpoints, and let the bus run on a thread of its own."""
        warm_up()
        if self._server is not None:
            for name in codec.REQUESTS:
                self._server.answer(codec.request_key(self.channel, name), partial(self._reply, name))
            self._server.on_trouble(self._guard.tell)
            self._server.watch(codec.node_key(self.channel, "*"), self._watch)
            self._server.hear(codec.offer_key(self.channel, "*"), self._hear)
        self._thread.start()
        if self._server is not None:
            self._server.announce(codec.alive_key(self.channel))

    def close(self) -> None:
        """End the bus; the server stays open and is its owner's to close."""
        with self._lock:
            if self._stopping:
                return
            self._stopping = True
            locals_ = list(self._locals.values())
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)
        for local in locals_:
            self._guard(local.lost)

    def __enter__(self) -> Hub:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Endpoints.

    def connect(self, name: str, take: Callable[[bytes], None], lost: Callable[[], None]) -> str:
        """Make an endpoint of this process known, before it joins.

        Args:
            name: Its name.
            take: Called with each message of the bus, on the hub's thread; must return at once.
            lost: Called when the hub ends.

        Returns:
            Its secret.
        """
        secret = _new_secret()
        with self._lock:
            self._locals[name] = _Local(take, lost, secret)
        return secret

    def disconnect(self, name: str) -> None:
        """Forget an endpoint of this process; what it has offered is still sent."""
        with self._lock:
            self._locals.pop(name, None)
            self._leave(name)

    def offer(self, name: str, payload: bytes) -> None:
        """Take a message of frames from an endpoint: its secret, then the message."""
        with self._lock:
            endpoint = self._endpoints.get(name)
            if endpoint is None or endpoint.left_s is not None:
                self._counts["strange"] += 1
                return
            if not _same(endpoint.secret, payload[: codec.SECRET_BYTES].hex()):
                self._counts["forged"] += 1
                return
            try:
                if len(payload) > codec.SECRET_BYTES + _LARGEST:
                    raise codec.CodecError("too long")
                self._offer(endpoint, payload[codec.SECRET_BYTES :])
            except codec.CodecError:
                self._counts["malformed"] += 1
        self._wake.set()

    def _offer(self, endpoint: _Endpoint, payload: bytes) -> None:
        records = codec.decode_array(payload)
        fd, node, now = self._model.speed.fd, endpoint.node, self._now()
        room = 0 if endpoint.listen_only else max(0, WINDOW - (endpoint.offered - endpoint.done))
        if len(records) > _FEW:
            good = records[sendable(records, fd=fd)]
            invalid, count = len(records) - len(good), min(room, len(good))
            taken = resized(good[:count])
            taken["node"], taken["time_ns"] = node, now
            self._model.take(taken.tobytes())
        else:
            rows = [row for row in codec.decode(payload) if fault_of(row, fd=fd) is None]
            invalid, count = len(records) - len(rows), min(room, len(rows))
            for row in rows[:count]:
                self._model.take(pack(row._replace(node=node, time_ns=now)))
        endpoint.offered += len(records)
        self._waiting += count
        if count < len(records):
            self._counts["invalid"] += invalid
            self._counts["surplus"] += len(records) - invalid - count
            endpoint.done += len(records) - count
            endpoint.dropped += len(records) - count
            self._report_due = True

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
                return self._join(request)
        if not isinstance(request, codec.Flushing):
            return self.status()
        with self._lock:
            endpoint = self._endpoints.get(request.endpoint)
            if endpoint is None:
                raise InputError("endpoint", "one that has joined", request.endpoint)
            self._check_owner(endpoint.name, endpoint.secret, request.secret)
            if isinstance(request, codec.Setting):
                endpoint.listen_only = request.listen_only
            # Both restart the controller, as real ones must be for the one and mostly are for the other.
            self._detach(endpoint)
            self._attach(endpoint)
            self._report_due = True
        self._wake.set()
        return {}

    def _reply(self, name: str, payload: bytes) -> bytes:
        try:
            return wire.encode_document(self.answer(name, payload or b"{}"))
        except InputError as error:
            with self._lock:
                self._counts["refused"] += 1
            return wire.encode_document({"error": str(error), "field": error.field, "must": error.must})

    def _join(self, request: codec.Joining) -> dict[str, Any]:
        name = request.endpoint
        local, known = self._locals.get(name), self._endpoints.get(name)
        if local is not None:
            self._check_owner(name, local.secret, request.secret)
        elif known is not None and known.left_s is None:
            self._check_owner(name, known.secret, request.secret)
        if known is not None:
            self._remove(known)
        token = local is not None or name in self._tokens or (known is not None and known.token)
        if local is None:
            self._make_room(token=token)
        number = self._next_number
        # Numbers are used again only after all others: a late frame must not be taken for one's own.
        while True:
            self._next_number = self._next_number % (codec.NO_NODE - 1) + 1
            if all(self._next_number != endpoint.number for endpoint in self._endpoints.values()):
                break
        secret = _new_secret() if local is None else local.secret
        endpoint = _Endpoint(name, number, -1, time.monotonic(), request.listen_only, token, secret)
        self._endpoints[name] = endpoint
        self._attach(endpoint)
        return {"node": number, "secret": secret, "window": WINDOW, **self._bus(), "epoch_ns": self.epoch_ns}

    def _make_room(self, *, token: bool) -> None:
        """Room for one more endpoint of another process, where need be that of one that has shown no token."""
        others = [endpoint for endpoint in self._endpoints.values() if endpoint.name not in self._locals]
        tokenless = [endpoint for endpoint in others if not endpoint.token]
        if len(others) < MAX_ENDPOINTS and (token or len(tokenless) < MAX_TOKENLESS):
            return
        if not tokenless:
            raise InputError("endpoint", f"one of at most {MAX_ENDPOINTS}", f"{len(others)} that are there already")
        self._counts["evicted"] += 1
        self._remove(tokenless[0])

    def _check_owner(self, name: str, secret: str, given: str | None) -> None:
        if not _same(secret, given or ""):
            self._counts["forged"] += 1
            raise InputError("endpoint", "one's own (another has joined under that name, and is there)", name)

    def _hear(self, key: str, payload: bytes) -> None:
        self.offer(key.rpartition("/")[2], payload)

    def _watch(self, key: str, there: bool) -> None:
        name = key.rpartition("/")[2]
        with self._lock:
            self._tokens.pop(name, None)
            if there:
                self._tokens[name] = None
                while len(self._tokens) > _MOST_TOKENS:
                    del self._tokens[next(iter(self._tokens))]
                if (endpoint := self._endpoints.get(name)) is not None:
                    endpoint.token = True
            elif name not in self._locals:
                self._leave(name)
        self._wake.set()

    def _leave(self, name: str) -> None:
        if (endpoint := self._endpoints.get(name)) is not None and endpoint.left_s is None:
            endpoint.left_s = time.monotonic()
            endpoint.token = False

    def _remove(self, endpoint: _Endpoint) -> None:
        del self._endpoints[endpoint.name]
        self._detach(endpoint)

    def _attach(self, endpoint: _Endpoint) -> None:
        node = endpoint.node = self._model.attach(endpoint.name, queue=WINDOW, listen_only=endpoint.listen_only)
        self._by_node[node] = endpoint
        self._numbers[node] = endpoint.number

    def _detach(self, endpoint: _Endpoint) -> None:
        """Take its controller off the bus: what waits there is lost; a frame on the wire is still sent."""
        # What was offered a moment ago waits there as well by then, and the controller's place is free for another.
        self._advance(self._now())
        waiting = self._model.node(endpoint.node).queued
        self._model.detach(endpoint.node)
        lost = waiting - self._model.node(endpoint.node).queued
        endpoint.done += lost
        endpoint.dropped += lost
        self._waiting -= lost
        endpoint.bus_offs = 0

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
        self._wake.clear()
        with self._lock:
            now = self._now()
            payloads, wake_ns, busy = self._step(now)
        for payload in payloads:
            self._publish(payload)
        left_s = (wake_ns - self._now()) * 1e-9
        if left_s > 0:
            if busy:
                # Nothing that is offered meanwhile can end earlier.
                time.sleep(left_s)
            else:
                self._wake.wait(left_s)
        return True

    def _step(self, now: int) -> tuple[list[bytes], int, bool]:
        """Let the bus run until now: messages to send, when to come back, and whether only then."""
        self._advance(now)
        next_ns = self._model.next_ns()
        self._credit = min(_BURST, self._credit + (now - self._credit_ns) * 1e-9 * _MESSAGES_A_SECOND)
        self._credit_ns = now
        payloads = []
        if self._outbox and (
            now >= self._published_ns + _TICK_NS or (next_ns is None and self._credit >= 1 and not self._waiting)
        ):
            self._credit -= 1
            self._published_ns = now
            payloads = self._empty_outbox()
        if now >= (self._last_report_ns + _HASTE_NS if self._report_due else self._next_report_ns):
            reports = self._reports(now)
            if reports:
                # They count what was sent before them.
                payloads += [*self._empty_outbox(), codec.encode_reports(reports)]
            self._report_due = False
            self._last_report_ns = now
            self._next_report_ns = now + _REPORT_NS
        wake_ns = self._last_report_ns + _HASTE_NS if self._report_due else self._next_report_ns
        tick_ns = self._published_ns + _TICK_NS
        if next_ns is not None:
            next_ns = max(next_ns, now + _GAP_NS)
            # More than this one: they travel together.
            wake_ns = max(next_ns, tick_ns) if self._waiting > 1 or self._credit < 1 else next_ns
        if self._outbox:
            wake_ns = min(wake_ns, tick_ns)
        return payloads, wake_ns, next_ns is not None or bool(self._outbox)

    def _advance(self, now: int) -> None:
        # One more: what was offered by now must have begun.
        results = self._model.advance_records(max(now + 1, self._model.now_ns))
        if len(results):
            self._take_results(results)

    def _take_results(self, results: np.ndarray) -> None:
        """Note what the model is done with, and keep what the endpoints must hear of."""
        finals = results if results["final"].all() else results[results["final"] != 0]
        for node, outcome in zip(finals["node"].tolist(), finals["outcome"].tolist(), strict=True):
            endpoint = self._by_node.get(node)
            self._waiting -= 1
            if endpoint is not None:
                endpoint.done += 1
                endpoint.dropped += outcome != 0
        records = results["frame"].view(codec.RECORDS[FD_WIDTH])
        records["time_ns"] += np.uint64(self.epoch_ns)
        records["node"] = self._numbers[results["node"]]
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
            kept[row] = text in _ON_WIRE and self._may_tell(end_ns)
            if text in _ON_WIRE:
                self._counts["errors"] += 1
                kind, data = _ON_WIRE[text]
                number = int(records["node"][row])
                error = codec.error_record(self.epoch_ns + end_ns, kind, data=data + bytes(4), node=number)
                records[row] = _array(error)[0]
            else:
                self._counts["unsent"] += 1
        return records[kept]

    def _may_tell(self, at_ns: int) -> bool:
        refilled = (at_ns - self._errors_ns) * 1e-9 * _ERRORS_A_SECOND
        self._errors_left = min(_ERROR_BURST, self._errors_left + refilled)
        self._errors_ns = at_ns
        if self._errors_left < 1:
            return False
        self._errors_left -= 1
        return True

    def _empty_outbox(self) -> list[bytes]:
        if not self._outbox:
            return []
        records = self._outbox[0] if len(self._outbox) == 1 else np.concatenate(self._outbox)
        self._outbox.clear()
        if records["length"].max() <= CLASSIC_WIDTH:
            records = resized(records, CLASSIC_WIDTH)
        size = codec.MAX_RECORDS
        return [codec.encode_array(records[first : first + size]) for first in range(0, len(records), size)]

    def _reports(self, now: int) -> list[codec.Report]:
        """What has changed at the endpoints; those that have gone are forgotten."""
        found = []
        seconds = time.monotonic()
        for endpoint in list(self._endpoints.values()):
            if not endpoint.token and endpoint.left_s is None and seconds - endpoint.joined_s > _TOKENLESS_S:
                endpoint.left_s = seconds
            if endpoint.left_s is not None and (
                endpoint.done == endpoint.offered or seconds - endpoint.left_s > _PARTING_S
            ):
                self._remove(endpoint)
                continue
            report = self._report(endpoint)
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
        self._outbox.append(_array(change))

    def _report(self, endpoint: _Endpoint) -> codec.Report:
        node = self._model.node(endpoint.node)
        state = STATES.index(node.state)
        return codec.Report(endpoint.number, state, node.tec, node.rec, endpoint.done, endpoint.dropped)

    def _publish(self, payload: bytes) -> None:
        if self._server is not None:
            self._guard(self._server.publish, codec.bus_key(self.channel), payload)
        for local in list(self._locals.values()):
            self._guard(local.take, payload)

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
                    {"name": endpoint.name, "listen_only": endpoint.listen_only, **self._report(endpoint)._asdict()}
                    for endpoint in self._endpoints.values()
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


def _array(record: Record) -> np.ndarray:
    return np.frombuffer(bytearray(pack(record)), codec.RECORDS[FD_WIDTH])


def _new_secret() -> str:
    return secrets.token_hex(codec.SECRET_BYTES)


def _same(secret: str, given: str) -> bool:
    return secrets.compare_digest(secret, given)


_COUNTS = (
    "frames", "errors", "unsent", "malformed", "invalid", "surplus", "strange", "refused", "forged", "evicted",
)  # fmt: skip


def _sharpen_sleep() -> None:
    """Let this thread's sleeps end within some microseconds, not 50 late (Linux)."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(29, 1, 0, 0, 0)  # PR_SET_TIMERSLACK [ns]
