"""Endpoints of a virtual bus: their names, their counts, and the controller of the model that each one has.

A name belongs to the endpoint that has joined under it, as long as that is present: to offer, set, flush or join again,
a request needs the secret of that join. The secret is sent unencrypted, so it protects only from clients that cannot
read the messages of others. Keeping them apart is the task of access control.
"""

from __future__ import annotations

import secrets
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from drivers.can.bus import codec
from drivers.can.bus.frame import are_sendable, resize_records
from drivers.can.bus.model import BusModel
from drivers.can.bus.results import STATES
from rig.base.errors import InputError, Words

QUEUE_FRAMES = 512
"""Transmit queue of one endpoint [frames]; frames beyond it are dropped and counted."""
MAX_ENDPOINTS = 64
"""Largest number of endpoints of other processes; those of this process are always admitted."""
MAX_TOKENLESS = 16
"""Largest number of endpoints of other processes without a token; the oldest is removed for the next."""
MAX_TOKENS = 16 * MAX_ENDPOINTS
"""Number of tokens that are remembered, the newest."""

_DEPARTED_TIMEOUT_S = 1.0
"""Longest time for which frames of a departed endpoint wait for the bus [s]."""
_TOKEN_TIMEOUT_S = 10.0
"""Longest time without a token [s]; the token is sent before the request to join, but by another path."""


@dataclass(slots=True)
class Endpoint:
    """An endpoint that has joined.

    Attributes:
        name: Its name.
        number: Its number on the bus, reused only after all other numbers.
        node: Its number in the model.
        joined_s: Time at which it joined [s, monotonic].
        listen_only: Whether it only listens.
        in_order: Whether it sends its frames in the order of their offers.
        token: Whether its token has been seen, or it needs none.
        secret: Secret that proves that its name is its own.
        offered: Number of frames that it has offered.
        done: Number of these that are finished, sent or not.
        dropped: Number of finished frames that were not sent.
        left_s: Time at which it was found to have left [s, monotonic].
        reported: Its last report.
        bus_offs: Number of bus-off states until the last report.
    """

    name: str
    number: int
    node: int
    joined_s: float
    listen_only: bool
    in_order: bool
    token: bool
    secret: str
    offered: int = 0
    done: int = 0
    dropped: int = 0
    left_s: float | None = None
    reported: codec.NodeReport | None = None
    bus_offs: int = 0


@dataclass(frozen=True, slots=True)
class LocalEndpoint:
    """An endpoint of this process: callbacks for messages of the bus and for the end of the hub."""

    on_message: Callable[[codec.HubMessage], None]
    on_close: Callable[[], None]
    secret: str


class Endpoints:
    """Registry of a bus's endpoints; the caller holds the hub's lock.

    Args:
        model: The bus.
        counts: Counts of refusals.
        advance: Runs the model until now.
    """

    def __init__(self, model: BusModel, counts: Counter[str], advance: Callable[[], object]) -> None:
        self._model = model
        self._counts = counts
        self._advance = advance
        self._by_name: dict[str, Endpoint] = {}
        self._by_node: dict[int, Endpoint] = {}
        self.numbers = np.full(256, codec.NO_NODE, np.uint16)
        """Number on the bus by number in the model."""
        self.locals: dict[str, LocalEndpoint] = {}
        self.tokens: dict[str, None] = {}
        """Tokens, the newest last."""
        self.waiting = 0
        """Number of frames that the model has not finished."""
        self._next_number = 1

    def __iter__(self) -> Iterator[Endpoint]:
        return iter(list(self._by_name.values()))

    def __len__(self) -> int:
        """Return the number of endpoints that have joined and are not removed."""
        return len(self._by_name)

    # ---- joining and leaving ----

    def connect(self, name: str, on_message: Callable[[codec.HubMessage], None], on_close: Callable[[], None]) -> str:
        """Register an endpoint of this process before it joins, and return its secret."""
        secret = _new_secret()
        self.locals[name] = LocalEndpoint(on_message, on_close, secret)
        return secret

    def disconnect(self, name: str) -> None:
        """Remove an endpoint of this process; the frames that it has offered are still sent."""
        self.locals.pop(name, None)
        self._leave(name)

    def join(self, request: codec.JoinRequest) -> Endpoint:
        """Register an endpoint; one that joins again gets a new number and controller.

        Raises:
            InputError: The name belongs to another endpoint, or all places are taken.
        """
        name = request.endpoint
        local, previous = self.locals.get(name), self._by_name.get(name)
        if local is not None:
            self._check_owner(name, local.secret, request.secret)
        elif previous is not None and previous.left_s is None:
            self._check_owner(name, previous.secret, request.secret)
        if previous is not None:
            self._remove(previous)
        token = local is not None or name in self.tokens or (previous is not None and previous.token)
        if local is None:
            self._make_room(token=token)
        secret = _new_secret() if local is None else local.secret
        settings = (request.listen_only, request.in_order)
        endpoint = Endpoint(name, self._new_number(), -1, time.monotonic(), *settings, token, secret)
        self._by_name[name] = endpoint
        self._attach(endpoint)
        return endpoint

    def restart(self, request: codec.FlushRequest) -> None:
        """Restart an endpoint's controller with the requested settings; waiting frames are lost.

        Raises:
            InputError: The endpoint has not joined, or the secret is wrong.
        """
        endpoint = self._by_name.get(request.endpoint)
        if endpoint is None:
            raise InputError("endpoint", "one that has joined", request.endpoint)
        self._check_owner(endpoint.name, endpoint.secret, request.secret)
        if isinstance(request, codec.SetRequest):
            endpoint.listen_only = request.listen_only
        self._detach(endpoint)
        self._attach(endpoint)

    def _new_number(self) -> int:
        number = self._next_number
        # A number is reused only after all others, so that a late frame is not mistaken for one's own.
        while True:
            self._next_number = self._next_number % (codec.NO_NODE - 1) + 1
            if all(self._next_number != endpoint.number for endpoint in self):
                return number

    def _make_room(self, *, token: bool) -> None:
        """Make room for an endpoint of another process; if necessary, remove the oldest one without a token."""
        others = [endpoint for endpoint in self if endpoint.name not in self.locals]
        tokenless = [endpoint for endpoint in others if not endpoint.token]
        if len(others) < MAX_ENDPOINTS and (token or len(tokenless) < MAX_TOKENLESS):
            return
        if not tokenless:
            raise InputError("endpoint", f"one of at most {MAX_ENDPOINTS}", Words(f"one more than {len(others)}"))
        self._counts["evicted"] += 1
        self._remove(tokenless[0])

    def _check_owner(self, name: str, secret: str, received: str | None) -> None:
        if not secrets.compare_digest(secret, received or ""):
            self._counts["forged"] += 1
            raise InputError(
                "endpoint", "unused, or accompanied by its secret (an endpoint of that name has joined)", name
            )

    def record_token(self, name: str, present: bool) -> None:
        """Record that a token has appeared or disappeared."""
        self.tokens.pop(name, None)
        if present:
            self.tokens[name] = None
            while len(self.tokens) > MAX_TOKENS:
                del self.tokens[next(iter(self.tokens))]
            if (endpoint := self._by_name.get(name)) is not None:
                endpoint.token = True
        elif name not in self.locals:
            self._leave(name)

    def _leave(self, name: str) -> None:
        if (endpoint := self._by_name.get(name)) is not None and endpoint.left_s is None:
            endpoint.left_s = time.monotonic()
            endpoint.token = False

    def remove_departed(self) -> None:
        """Remove endpoints that have left and whose frames are finished, or have waited too long."""
        now_s = time.monotonic()
        for endpoint in self:
            if not endpoint.token and endpoint.left_s is None and now_s - endpoint.joined_s > _TOKEN_TIMEOUT_S:
                endpoint.left_s = now_s
            if endpoint.left_s is not None and (
                endpoint.done == endpoint.offered or now_s - endpoint.left_s > _DEPARTED_TIMEOUT_S
            ):
                self._remove(endpoint)

    def _remove(self, endpoint: Endpoint) -> None:
        del self._by_name[endpoint.name]
        self._detach(endpoint)

    def _attach(self, endpoint: Endpoint) -> None:
        settings = {"listen_only": endpoint.listen_only, "in_order": endpoint.in_order}
        node = endpoint.node = self._model.attach(endpoint.name, queue=QUEUE_FRAMES, **settings)
        self._by_node[node] = endpoint
        self.numbers[node] = endpoint.number

    def _detach(self, endpoint: Endpoint) -> None:
        """Take its controller off the bus: waiting frames are lost; a frame on the wire is still sent."""
        # Run the model first, so that frames just offered are in the queue and the controller can be reused.
        self._advance()
        waiting = self._model.node(endpoint.node).queued
        self._model.detach(endpoint.node)
        lost = waiting - self._model.node(endpoint.node).queued
        endpoint.done += lost
        endpoint.dropped += lost
        self.waiting -= lost
        endpoint.bus_offs = 0

    # ---- offers and results ----

    def owner(self, name: str, secret: str) -> Endpoint | None:
        """Return the endpoint of a name if the secret is right, otherwise None."""
        endpoint = self._by_name.get(name)
        if endpoint is None or endpoint.left_s is not None:
            self._counts["strange"] += 1
            return None
        if not secrets.compare_digest(endpoint.secret, secret):
            self._counts["forged"] += 1
            return None
        return endpoint

    def offer(self, endpoint: Endpoint, records: np.ndarray, now_ns: int, due_ns: np.ndarray | None = None) -> bool:
        """Pass frames to an endpoint's controller; return whether some were dropped.

        Args:
            endpoint: Sender of the frames.
            records: Array of one of the `RECORDS` layouts.
            now_ns: Time of the bus [ns].
            due_ns: Time of the bus at which the controller receives each frame [ns], shape of `records`; None for now.
        """
        is_sendable = are_sendable(records, fd=self._model.speed.fd)
        good = records[is_sendable]
        room = 0 if endpoint.listen_only else max(0, QUEUE_FRAMES - (endpoint.offered - endpoint.done))
        accepted = resize_records(good[:room])
        accepted["node"], accepted["time_ns"] = endpoint.node, now_ns
        if due_ns is not None:
            accepted["time_ns"] = np.maximum(due_ns[is_sendable][:room], now_ns)
        if len(accepted):
            self._model.take(accepted)
        endpoint.offered += len(records)
        self.waiting += len(accepted)
        dropped = len(records) - len(accepted)
        self._counts["invalid"] += len(records) - len(good)
        self._counts["surplus"] += len(good) - len(accepted)
        endpoint.done += dropped
        endpoint.dropped += dropped
        return dropped > 0

    def count_results(self, results: np.ndarray) -> None:
        """Count the frames that the model has finished, from an array of `drivers.can.bus.results.RESULT`."""
        finals = results if results["final"].all() else results[results["final"] != 0]
        for node, outcome in zip(finals["node"].tolist(), finals["outcome"].tolist(), strict=True):
            endpoint = self._by_node.get(node)
            self.waiting -= 1
            if endpoint is not None:
                endpoint.done += 1
                endpoint.dropped += outcome != 0

    def report(self, endpoint: Endpoint) -> codec.NodeReport:
        """Return the state of an endpoint."""
        node = self._model.node(endpoint.node)
        state = STATES.index(node.state)
        return codec.NodeReport(endpoint.number, state, node.tec, node.rec, endpoint.done, endpoint.dropped)


def _new_secret() -> str:
    return secrets.token_hex(codec.SECRET_BYTES)
