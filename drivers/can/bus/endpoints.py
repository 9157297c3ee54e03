"""Who takes part in a virtual bus: the endpoints by name, what is theirs, and which controller of the model each has.

A name belongs to whoever has joined under it for as long as it is there: only with the secret of that join does anybody
offer, set, flush or join again. What goes over the network does so in clear, so this keeps apart those who cannot
read each other's messages, which access control sees to.
"""

from __future__ import annotations

import secrets
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from drivers.can.bus import codec
from drivers.can.bus.frame import resized, sendable
from drivers.can.bus.model import BusModel
from drivers.can.bus.results import STATES
from rig.base.errors import InputError, Words

WINDOW = 512
"""Frames that one endpoint may have waiting; what it offers beyond is dropped and counted."""
MAX_ENDPOINTS = 64
"""Of other processes; those of this one always get in."""
MAX_TOKENLESS = 16
"""Those of them that have shown no token; the oldest makes room for the next."""
MAX_TOKENS = 16 * MAX_ENDPOINTS
"""Tokens that are remembered, the newest."""

_PARTING_S = 1.0
"""How long frames of an endpoint that has gone may wait for the bus."""
_TOKENLESS_S = 10.0
"""How long an endpoint may be without a token; it comes before the request to join, but on another way."""


@dataclass(slots=True)
class Endpoint:
    """One that has joined.

    Attributes:
        name: What it calls itself.
        number: What it is called on the bus; given to another only after all other numbers.
        node: Its number in the model.
        joined_s: When it joined [s, monotonic].
        listen_only: Whether it takes no part.
        token: Whether its token has been seen, or it needs none.
        secret: What shows that its name is its own.
        offered: Frames that it has offered.
        done: Those of them that wait no longer.
        dropped: Those of these that were not sent.
        left_s: When it was found to have gone [s, monotonic].
        reported: What was last reported of it.
        bus_offs: How often it had been bus-off when last reported.
    """

    name: str
    number: int
    node: int
    joined_s: float
    listen_only: bool
    token: bool
    secret: str
    offered: int = 0
    done: int = 0
    dropped: int = 0
    left_s: float | None = None
    reported: codec.Report | None = None
    bus_offs: int = 0


@dataclass(frozen=True, slots=True)
class Local:
    """An endpoint of this process: what takes messages of the bus, and what is called when the hub ends."""

    take: Callable[[codec.Said], None]
    lost: Callable[[], None]
    secret: str


class Endpoints:
    """The endpoints of a bus; whoever uses it holds the hub's lock.

    Args:
        model: The bus.
        counts: Where what is refused is counted.
        advance: Lets the model run until now.
    """

    def __init__(self, model: BusModel, counts: Counter[str], advance: Callable[[], object]) -> None:
        self._model = model
        self._counts = counts
        self._advance = advance
        self._by_name: dict[str, Endpoint] = {}
        self._by_node: dict[int, Endpoint] = {}
        self.numbers = np.full(256, codec.NO_NODE, np.uint16)
        """Number on the bus by number in the model."""
        self.locals: dict[str, Local] = {}
        self.tokens: dict[str, None] = {}
        """The newest last."""
        self.waiting = 0
        """Frames that the model is not done with."""
        self._next_number = 1

    def __iter__(self) -> Iterator[Endpoint]:
        return iter(list(self._by_name.values()))

    def __len__(self) -> int:
        """Return how many endpoints have joined and are not forgotten."""
        return len(self._by_name)

    # Who is there.

    def connect(self, name: str, take: Callable[[codec.Said], None], lost: Callable[[], None]) -> str:
        """Make an endpoint of this process known, before it joins; returns its secret."""
        secret = _new_secret()
        self.locals[name] = Local(take, lost, secret)
        return secret

    def disconnect(self, name: str) -> None:
        """Forget an endpoint of this process; what it has offered is still sent."""
        self.locals.pop(name, None)
        self._leave(name)

    def join(self, request: codec.Joining) -> Endpoint:
        """Take in an endpoint, anew where it has been here before.

        Raises:
            InputError: The name is another's, or there is no room.
        """
        name = request.endpoint
        local, known = self.locals.get(name), self._by_name.get(name)
        if local is not None:
            self._check_owner(name, local.secret, request.secret)
        elif known is not None and known.left_s is None:
            self._check_owner(name, known.secret, request.secret)
        if known is not None:
            self._remove(known)
        token = local is not None or name in self.tokens or (known is not None and known.token)
        if local is None:
            self._make_room(token=token)
        secret = _new_secret() if local is None else local.secret
        endpoint = Endpoint(name, self._new_number(), -1, time.monotonic(), request.listen_only, token, secret)
        self._by_name[name] = endpoint
        self._attach(endpoint)
        return endpoint

    def restart(self, request: codec.Flushing) -> None:
        """Restart an endpoint's controller, with what it asks for; what waits there is lost.

        Raises:
            InputError: Whoever asks is none, or another.
        """
        endpoint = self._by_name.get(request.endpoint)
        if endpoint is None:
            raise InputError("endpoint", "one that has joined", request.endpoint)
        self._check_owner(endpoint.name, endpoint.secret, request.secret)
        if isinstance(request, codec.Setting):
            endpoint.listen_only = request.listen_only
        self._detach(endpoint)
        self._attach(endpoint)

    def _new_number(self) -> int:
        number = self._next_number
        # Numbers are used again only after all others: a late frame must not be taken for one's own.
        while True:
            self._next_number = self._next_number % (codec.NO_NODE - 1) + 1
            if all(self._next_number != endpoint.number for endpoint in self):
                return number

    def _make_room(self, *, token: bool) -> None:
        """Room for one more endpoint of another process, where need be that of one that has shown no token."""
        others = [endpoint for endpoint in self if endpoint.name not in self.locals]
        tokenless = [endpoint for endpoint in others if not endpoint.token]
        if len(others) < MAX_ENDPOINTS and (token or len(tokenless) < MAX_TOKENLESS):
            return
        if not tokenless:
            raise InputError(
                "endpoint", f"one of at most {MAX_ENDPOINTS}", Words(f"{len(others)} that are there already")
            )
        self._counts["evicted"] += 1
        self._remove(tokenless[0])

    def _check_owner(self, name: str, secret: str, given: str | None) -> None:
        if not secrets.compare_digest(secret, given or ""):
            self._counts["forged"] += 1
            raise InputError("endpoint", "one's own (another has joined under that name, and is there)", name)

    def watch(self, name: str, there: bool) -> None:
        """A token has come or gone."""
        self.tokens.pop(name, None)
        if there:
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

    def forget_gone(self) -> None:
        """Remove those that have gone and for whose frames it is not worth waiting any more."""
        now_s = time.monotonic()
        for endpoint in self:
            if not endpoint.token and endpoint.left_s is None and now_s - endpoint.joined_s > _TOKENLESS_S:
                endpoint.left_s = now_s
            if endpoint.left_s is not None and (
                endpoint.done == endpoint.offered or now_s - endpoint.left_s > _PARTING_S
            ):
                self._remove(endpoint)

    def _remove(self, endpoint: Endpoint) -> None:
        del self._by_name[endpoint.name]
        self._detach(endpoint)

    def _attach(self, endpoint: Endpoint) -> None:
        node = endpoint.node = self._model.attach(endpoint.name, queue=WINDOW, listen_only=endpoint.listen_only)
        self._by_node[node] = endpoint
        self.numbers[node] = endpoint.number

    def _detach(self, endpoint: Endpoint) -> None:
        """Take its controller off the bus: what waits there is lost; a frame on the wire is still sent."""
        # What was offered a moment ago waits there as well by then, and the controller's place is free for another.
        self._advance()
        waiting = self._model.node(endpoint.node).queued
        self._model.detach(endpoint.node)
        lost = waiting - self._model.node(endpoint.node).queued
        endpoint.done += lost
        endpoint.dropped += lost
        self.waiting -= lost
        endpoint.bus_offs = 0

    # What they offer, and what became of it.

    def owner(self, name: str, secret: str) -> Endpoint | None:
        """The endpoint of that name, where the secret shows that it is the one who speaks."""
        endpoint = self._by_name.get(name)
        if endpoint is None or endpoint.left_s is not None:
            self._counts["strange"] += 1
            return None
        if not secrets.compare_digest(endpoint.secret, secret):
            self._counts["forged"] += 1
            return None
        return endpoint

    def offer(self, endpoint: Endpoint, records: np.ndarray, now_ns: int, due_ns: np.ndarray | None = None) -> bool:
        """Hand frames to an endpoint's controller; returns whether some were dropped.

        Args:
            endpoint: Whose.
            records: Array of one of the `RECORDS` layouts.
            now_ns: Time of the bus [ns].
            due_ns: Time of the bus at which the controller gets each frame [ns], shape of `records`; None: now.
        """
        fit = sendable(records, fd=self._model.speed.fd)
        good = records[fit]
        room = 0 if endpoint.listen_only else max(0, WINDOW - (endpoint.offered - endpoint.done))
        taken = resized(good[:room])
        taken["node"], taken["time_ns"] = endpoint.node, now_ns
        if due_ns is not None:
            taken["time_ns"] = np.maximum(due_ns[fit][:room], now_ns)
        if len(taken):
            self._model.take(taken)
        endpoint.offered += len(records)
        self.waiting += len(taken)
        dropped = len(records) - len(taken)
        self._counts["invalid"] += len(records) - len(good)
        self._counts["surplus"] += len(good) - len(taken)
        endpoint.done += dropped
        endpoint.dropped += dropped
        return dropped > 0

    def settle(self, results: np.ndarray) -> None:
        """Note which frames the model is done with, from an array of `drivers.can.bus.results.RESULT`."""
        finals = results if results["final"].all() else results[results["final"] != 0]
        for node, outcome in zip(finals["node"].tolist(), finals["outcome"].tolist(), strict=True):
            endpoint = self._by_node.get(node)
            self.waiting -= 1
            if endpoint is not None:
                endpoint.done += 1
                endpoint.dropped += outcome != 0

    def report(self, endpoint: Endpoint) -> codec.Report:
        """How an endpoint is now."""
        node = self._model.node(endpoint.node)
        state = STATES.index(node.state)
        return codec.Report(endpoint.number, state, node.tec, node.rec, endpoint.done, endpoint.dropped)


def _new_secret() -> str:
    return secrets.token_hex(codec.SECRET_BYTES)
