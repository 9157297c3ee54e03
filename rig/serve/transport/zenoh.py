"""Server and client over zenoh: TCP on the loopback, TLS beyond it, peer to peer; no router, multicast or gossip.

The server publishes without waiting (a stalled subscriber must not delay it) and keeps the last messages of each key. A
lossless client detects missed messages by their numbers, and fetches them from there.
"""

from __future__ import annotations

import socket
import ssl
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from datetime import UTC, datetime
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple

from rig.base import wire
from rig.base.errors import InputError
from rig.base.files import Closing
from rig.serve.transport import DEFAULT_ENDPOINT, NoReplyError
from rig.serve.transport.endpoint import (
    build_address_error,
    choose_listen_address,
    close_links,
    parse_endpoint,
    read_backlogs,
)
from rig.serve.transport.exposure.access import Action, bind_key, is_allowed, rules
from rig.serve.transport.names import parse_url, resolve_endpoint
from rig.serve.transport.recovery import CACHE, Publisher, Recovery
from rig.serve.transport.session import PATIENCE_S, Session, build_config, fifo, get_encoding, locator
from rig.serve.waiting import Deadline

if TYPE_CHECKING:
    from rig.serve.transport.exposure.certificates import Holder

_SLOW_PUT_S = 0.5e-3
_STALLED_BYTES = 256 * 1024
"""Unread bytes that indicate a stalled link: about 0.1 s of all streams; a fast subscriber leaves none."""
_HEARTBEAT_S = 0.25
"""Time until a subscriber detects that the last message of a key is missing [s]."""
_FIFO = 20_000
"""Messages that wait for a callback: about 20 s of all streams. With more, the link fills, the rig drops messages (or
waits, if it is not paced), and they are recovered."""
_HEARTBEATS = 500
"""Heartbeats that a subscriber holds: several per key. A ring allocates its memory in its first round, a long ring for
hours."""
_RING = 2000
"""Messages held by a subscriber that may lose some: about 2 s of all streams."""
_FROM_CLIENTS = {
    "transport/link/rx/max_message_size": 1 << 20,
    "transport/unicast/accept_timeout": 3000,
    "transport/unicast/accept_pending": 1000,
}
"""Limits for data from clients: message size (requests have at most 64 kB; messages to clients are not limited), and
number and time [ms] of connections in progress, so that silent ones do not shut out others."""
_REMOTE_LIMITS = {"transport/unicast/max_sessions": 32, "transport/unicast/accept_pending": 32}
"""Limits of an exposed rig; a client that subscribes has two sessions."""
_OPENING_S, _OPENING_TLS_S, _RESTART_S = 0.5, 2.0, 5.0
"""Time limits: one attempt to connect, on the loopback and beyond it (several round trips), and the wait of a request
without a link for a restarted rig [s]."""
_RETRY_S = 0.05
"""Pause before an unanswered request is repeated [s]."""


class Exposure(NamedTuple):
    """Address of a rig for other computers.

    Args:
        endpoint: HOST:PORT.
        holder: The rig's certificate and authority; None accepts all clients, unencrypted.
    """

    endpoint: str
    holder: Holder | None


class ZenohServer(Closing):
    """The rig's side: listens on the loopback, and elsewhere if exposed.

    Clients have the permissions in `rig.serve.transport.exposure.access`.

    Args:
        endpoint: HOST:PORT to listen on, on the loopback; port 0: a free one.
        exposed: Additional address.
        wait: Make `publish` wait for slow subscribers (at most 2 s, then their link is closed and they recover from the
            cache) instead of letting them recover later. For unpaced runs, whose cache would cover a much shorter wall
            time.

    Raises:
        InputError: An endpoint is malformed or in use, or `endpoint` is not on the loopback.
    """

    def __init__(
        self, endpoint: str = DEFAULT_ENDPOINT, *, exposed: Exposure | None = None, wait: bool = False
    ) -> None:
        import zenoh

        host, port = choose_listen_address(endpoint, field="listen")
        self.endpoint = f"{host}:{port}"
        self._ports = {port}
        locators, settings = [locator(host, port)], dict[str, Any](_FROM_CLIENTS)
        allowed = () if exposed is None or exposed.holder is None else exposed.holder.allowed
        if exposed is not None:
            host, port = parse_endpoint(exposed.endpoint, field="expose")
            self._ports.add(port)
            locators.append(locator(host, port, tls=exposed.holder is not None))
            settings |= _REMOTE_LIMITS
            if exposed.holder is not None:
                settings["transport/link/tls"] = exposed.holder.settings(listens=True)
        try:
            self._session = Session(build_config(listen__endpoints=locators, access_control=rules(allowed), **settings))
        except zenoh.ZError as error:
            field, where = "listen", self.endpoint
            if exposed is not None and f"{host}:{port}" in str(error):
                field, where = "expose", exposed.endpoint
            raise build_address_error(field, where, in_use="in use" in str(error)) from None
        self._congestion_control = zenoh.CongestionControl.BLOCK if wait else zenoh.CongestionControl.DROP
        self._publishers: dict[str, Any] = {}
        self._declared: list[Any] = []
        self._slow_puts = 0
        self._longest_put_s = 0.0
        self._stalls = 0
        self._stalled: set[int] = set()
        self._replies: SimpleQueue[tuple[Any, str, bytes] | None] = SimpleQueue()
        self._session.drain(iter(self._replies.get, None), lambda late: _reply(*late), "replies")

    @property
    def identities(self) -> frozenset[str]:
        """Identity of this rig's session."""
        return frozenset({str(self._session.session.info.zid())})

    def publish(self, key: str, payload: bytes) -> None:
        """Send one payload to all subscribers, and keep it for recovery; on one thread only."""
        publisher = self._publishers.get(key) or self._declare(key)
        start = time.perf_counter()
        publisher.put(payload)
        elapsed_s = time.perf_counter() - start
        if elapsed_s > _SLOW_PUT_S:
            self._slow_puts += 1
            self._longest_put_s = max(self._longest_put_s, elapsed_s)

    def _declare(self, key: str) -> Any:
        from zenoh import ext

        schema = wire.get_schema(key)
        publisher = ext.declare_advanced_publisher(
            self._session.session,
            key,
            encoding=get_encoding(key, schema),
            congestion_control=self._congestion_control,
            cache=ext.CacheConfig(CACHE),
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None),
        )
        self._publishers[key] = publisher
        return publisher

    def answer(self, key: str, handler: Callable[[bytes], bytes]) -> None:
        """Answer requests on a key, one after another, on that key's thread."""
        self.answer_all(key, lambda _, payload: handler(payload))

    def answer_all(self, expression: str, handler: Callable[[str, bytes], bytes | Future[bytes]]) -> None:
        """Answer requests on all matching keys, on this expression's thread; later answers on another thread."""
        queryable = self._session.session.declare_queryable(expression, fifo())
        self._declared.append(queryable)
        own = None if "*" in expression else expression

        def take(query: Any) -> None:
            key = own or str(query.key_expr)
            try:
                if "*" in key:
                    raise InputError("key", "one key, without *", key)
                answer = handler(key, b"" if query.payload is None else query.payload.to_bytes())
            except Exception as error:
                with query:
                    query.reply_err(f"{type(error).__name__}: {error}".encode())
                if not isinstance(error, InputError):
                    raise
            else:
                if isinstance(answer, Future):
                    # The future completes on a thread that must not wait for a link.
                    answer.add_done_callback(lambda done: self._replies.put((query, key, done.result())))
                else:
                    _reply(query, key, answer)

        self._session.drain(queryable, take, f"answers {expression}")

    def on_failure(self, callback: Callable[[str, BaseException], None]) -> None:
        """Set the function that receives place and error of failures on receiving threads."""
        self._session.on_failure = callback

    def subscribe_reports(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Receive the clients' reports on matching keys."""
        subscriber = self._session.session.declare_subscriber(key, fifo())
        self._declared.append(subscriber)
        self._session.drain(
            subscriber, lambda x: callback(str(x.key_expr), x.payload.to_bytes()), f"subscriber of {key}"
        )

    def announce(self, key: str = wire.ALIVE) -> None:
        """Publish the rig's token, or another; it disappears when this process ends for any reason."""
        self._declared.append(self._session.session.liveliness().declare_token(key))

    def watch(self, key: str, callback: Callable[[str, bool], None]) -> None:
        """Call back with key and True / False when matching tokens of clients appear / disappear."""
        import zenoh

        subscriber = self._session.session.liveliness().declare_subscriber(key, fifo(), history=True)
        self._declared.append(subscriber)
        self._session.drain(
            subscriber, lambda x: callback(str(x.key_expr), x.kind == zenoh.SampleKind.PUT), f"watches {key}"
        )

    def congestion(self) -> dict[str, float]:
        """Return counters that show stalled subscribers.

        A put waits once, for 1 ms, when a link's queue fills, and drops at once from then on: `slow_puts` counts the
        starts of long stalls, not their length. The unread bytes of a link show a stall at once and for its whole
        duration (`backlog_bytes`: the largest of all links, 0 if the operating system does not report it). `stalls`
        counts links found stalled that were not stalled at the previous call; `links_NAME` counts links whose
        certificate has that name.
        """
        links = list(self._session.session.info.links())
        names = Counter(f"links_{link.auth_identifier}" for link in links if link.auth_identifier is not None)
        backlog = {other: size for port in self._ports for other, size in read_backlogs(port).items()}
        stalled = {port for port, size in backlog.items() if size > _STALLED_BYTES}
        self._stalls += len(stalled - self._stalled)
        self._stalled = stalled
        return {
            "links": len(links),
            **names,
            "stalled_links": len(stalled),
            "stalls": self._stalls,
            "backlog_bytes": max(backlog.values(), default=0),
            "slow_puts": self._slow_puts,
            "longest_put_ms": round(self._longest_put_s * 1e3, 3),
        }

    def close(self) -> None:
        """Send the last replies, then close the session with all its declarations."""
        self._replies.put(None)
        # zenoh waits some seconds for a stalled link to accept the closing message.
        for port in self._ports:
            close_links(port, {other for other, size in read_backlogs(port).items() if size > _STALLED_BYTES})
        self._session.close()


def _explain_silence(link: socket.socket) -> str:
    """Return why a server refuses a client without certificates: it answers TLS, nothing, or something else."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        context.wrap_socket(link).close()
    except TimeoutError:
        return "does not answer: it is stopped (Ctrl-Z, a debugger), or the computer is overloaded"
    except (ssl.SSLEOFError, ConnectionError):
        return "refuses this client: it has too many links, or is not a rig"
    except ssl.SSLError:
        pass  # a server with certificates refuses this one
    return "refuses this client without a certificate: an exposed rig needs --tls FOLDER"


def _reply(query: Any, key: str, payload: bytes) -> None:
    with query:
        query.reply(key, payload, encoding="application/json")


class ZenohClient(Closing):
    """A client's side: connects to one rig and does not listen. Reconnects after a restart of the rig.

    Subscriptions have a separate link. A slow callback fills it, and then nothing on it is read, which must not
    delay requests, the token, or the recovery that this subscription waits for.

    Args:
        endpoint: HOST:PORT of the rig, or its name.
        wait_s: Longest wait for a rig [s]; may be infinite.
        tls: Folder with the keys of a role (`rig keys init`), for an exposed rig; None connects without TLS.

    Raises:
        InputError: The endpoint is malformed, no rig has that name, or the folder holds no keys.
        NoReplyError: No rig answered in time, or it refused the client.
    """

    def __init__(self, endpoint: str = DEFAULT_ENDPOINT, *, wait_s: float = 1.0, tls: Path | str | None = None) -> None:
        self._opening = Deadline(wait_s)
        self._host, self._port = resolve_endpoint(endpoint, field="connect", wait_s=wait_s)
        self._holder: Holder | None = None
        if tls is not None:
            from rig.serve.transport.exposure.certificates import read_holder

            self._holder = read_holder(tls, server=False)
        self._role = None if self._holder is None else self._holder.name
        self.endpoint = f"{self._host}:{self._port}"
        self._declared: list[Any] = []
        self._rigs: set[str] = set()
        """Rigs that this client is or was linked to: their messages may still be in flight."""
        self.foreign = 0
        self._streams: Session | None = None
        self._lossless: list[tuple[str, Recovery]] = []
        self._session = self._open(self._opening)

    @property
    def rig(self) -> str | None:
        """Identity of the linked rig; None without a link."""
        return next(iter(self._linked_rigs()), None)

    def _linked_rigs(self) -> set[str]:
        # A client does not listen, so its only peer is the rig that it connected to.
        rigs = set(map(str, self._session.session.info.peers_zid()))
        self._rigs |= rigs
        return rigs

    def _is_linked_rig(self, publisher: str | None) -> bool:
        """Return whether a message is from the rig, by its publisher; others are counted and ignored."""
        if publisher is not None and (publisher in self._rigs or publisher in self._linked_rigs()):
            return True
        self.foreign += 1
        return False

    def _is_from_rig(self, sample: Any) -> bool:
        return self._is_linked_rig(None if (info := sample.source_info) is None else str(info.source_id.zid))

    def _open(self, deadline: Deadline) -> Session:
        import zenoh

        longest_s, settings = _OPENING_S, {}
        if self._holder is not None:
            longest_s, settings = _OPENING_TLS_S, {"transport/link/tls": self._holder.settings(listens=False)}
        while True:
            config = build_config(
                listen__endpoints=[],
                connect__endpoints=[locator(self._host, self._port, tls=self._holder is not None)],
                # Opening waits for the link, so that the first request is not too early; in slices, so that Ctrl-C
                # works meanwhile.
                connect__timeout_ms=round(1000 * min(longest_s, max(deadline.left_s, 0.05))),
                connect__exit_on_failure=True,
                connect__retry={"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
                **settings,
            )
            try:
                return Session(config)
            except zenoh.ZError:
                if deadline.passed:
                    raise self._build_rejection_error() from None

    def _build_rejection_error(self) -> NoReplyError:
        """Return the error for a failed connection: no rig listens, or it refuses this client."""
        try:
            if self._holder is None:
                with socket.create_connection((self._host, self._port), timeout=1.0) as link:
                    explanation = _explain_silence(link)
            elif (rejection := self._holder.find_rejection(self._host, self._port)) is not None:
                explanation = (
                    f"refuses this client as {self._holder.name}, by the keys in {self._holder.folder}: {rejection}"
                )
            else:
                explanation = "refuses this client although the certificates are valid: it has too many links, or hangs"
        except OSError:
            return self._no_reply_error()
        return NoReplyError(f"{self.endpoint} listens, but {explanation}")

    def _expiry_error(self) -> NoReplyError | None:
        if self._holder is None or self._holder.expires > datetime.now(UTC):
            return None
        return NoReplyError(f"the rig at {self.endpoint} refuses the certificate in {self._holder.describe_expiry()}")

    def _no_reply_error(self) -> NoReplyError:
        start = "start one with: rig run stable-run (--wait-s 60 waits for one that still compiles)"
        return self._expiry_error() or NoReplyError(f"no rig answers at {self.endpoint}; {start}")

    @property
    def connection(self) -> str | None:
        """Certificates of both ends in words; None without TLS."""
        if self._holder is None:
            return None
        rig = next((link.auth_identifier for link in self._session.session.info.links()), None)
        return f"TLS as {self._holder.name}, valid until {self._holder.expires:%Y-%m-%d}; the rig is {rig}"

    def subscribe(
        self,
        key: str,
        on_message: Callable[[str, bytes], None],
        *,
        on_miss: Callable[[str, int], None] | None = None,
        history: bool = False,
        lossless: bool = True,
    ) -> None:
        """Receive payloads on this subscription's thread.

        The messages of each key arrive in order; messages of different keys may change their order (after a stall each
        key is recovered separately), so an `end` event can overtake blocks. A callback that blocks stops only this
        subscription; the rig continues, and missed messages are recovered. `on_miss` and `on_message` are never called
        at the same time.
        """
        import zenoh

        if self._streams is None:
            self._streams = self._open(Deadline(5.0))
        streams, session = self._streams, self._streams.session
        self._linked_rigs()
        if not lossless:
            subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(_RING))
            self._declared.append(subscriber)

            def deliver(sample: Any) -> None:
                if self._is_from_rig(sample):
                    on_message(str(sample.key_expr), sample.payload.to_bytes())

            streams.drain(subscriber, deliver, f"takes {key}")
            return

        def get(link: Session, selector: str) -> list[Any]:
            replies = link.session.get(
                selector,
                timeout=PATIENCE_S,
                consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
            )
            return [reply.ok for reply in replies if reply.ok is not None and self._is_from_rig(reply.ok)]

        def query_cache(name: str, publisher: Publisher, selection: str) -> list[Any]:
            zid, eid = publisher
            return get(self._session, f"{name}/@adv/*/{zid}/{eid}/**?{selection}")

        def begin() -> None:
            if history:
                heads = get(streams, f"{key}/@adv/**?_max=1")
                # Messages that arrived before these replies on the same link come first: they may be older than
                # everything in the caches if this process was suspended meanwhile.
                while (sample := subscriber.try_recv()) is not None:
                    take(sample)
                stream.begin(heads)

        def take(sample: Any) -> None:
            if self._is_from_rig(sample):
                stream.take(sample)

        def heartbeat(sample: Any) -> None:
            if self._is_linked_rig(str(sample.key_expr).partition("/@adv/pub/")[2].partition("/")[0]):
                stream.heartbeat(sample)

        stream = Recovery(query_cache, on_message, on_miss, history=history)
        self._lossless.append((key, stream))
        subscriber = session.declare_subscriber(key, zenoh.handlers.FifoChannel(_FIFO))
        heartbeats = session.declare_subscriber(f"{key}/@adv/pub/**", zenoh.handlers.RingChannel(_HEARTBEATS))
        self._declared += [subscriber, heartbeats]
        streams.drain(subscriber, take, f"takes {key}", first=begin)
        streams.drain(heartbeats, heartbeat, f"heartbeats {key}")

    def settle(self) -> None:
        """Wait until all subscriptions are in effect: a reply on their link arrives after them."""
        if self._streams is not None:
            list(self._streams.session.get(wire.STATUS, timeout=PATIENCE_S))

    def wait_for(self, key: str, number: int, *, timeout_s: float) -> bool:
        """Wait for the delivery of a message, by its number; True at once for a key without subscription."""
        deadline = Deadline(timeout_s)
        streams = [stream for subscribed, stream in self._lossless if subscribed == key]
        return all(each.wait_for(key, number, timeout_s=deadline.left_s) for each in streams)

    def request(self, key: str, payload: bytes = b"", *, timeout_s: float = 2.0) -> bytes:
        """Send a request to the rig and return its reply.

        Raises:
            NoReplyError: There was no reply in time, or the rig failed or ended; it may have executed the request.
        """
        import zenoh

        role, key = self._role, bind_key(self._role, key)
        deadline, restart_deadline, linked = (
            Deadline(timeout_s),
            Deadline(min(timeout_s, _RESTART_S)),
            self._linked_rigs(),
        )
        while True:
            replies: Iterator[Any] = self._session.session.get(
                key,
                payload=payload,
                timeout=max(deadline.left_s, 0.01),
                # Replies inherit both: one waiting for a stalled client would delay all others and close its link after
                # 5 s, and replies need not queue after recovered blocks.
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
            )
            for reply in replies:
                payload_back = reply.result.payload.to_bytes()
                if reply.ok is not None:
                    return payload_back
                if (text := payload_back.decode(errors="replace")) != "Timeout":
                    raise NoReplyError(f"the rig at {self.endpoint} could not answer {key}: {text}")
            if linked and not linked & self._linked_rigs():
                raise self._expiry_error() or NoReplyError(
                    f"the link to the rig at {self.endpoint} was lost before the reply to {key}"
                )
            # Without a rig the reply is empty at once; the rig may be about to start. A denied request looks the same.
            late = (deadline if self._linked_rigs() else restart_deadline).left_s <= _RETRY_S
            denied = not is_allowed(role, Action.ASK, key)
            if (late or denied) and self.tokens(wire.ALIVE):
                reason = f"denies {key} to {role or 'everybody'}" if denied else f"does not answer {key}"
                raise NoReplyError(f"the rig at {self.endpoint} {reason}")
            if late and role is not None and self._linked_rigs():
                reason = "its certificate was withdrawn, or the rig is still starting"
                raise NoReplyError(f"the rig at {self.endpoint} allows nothing to {role}: {reason}")
            if late:
                raise self._no_reply_error()
            time.sleep(_RETRY_S)

    def watch(self, key: str, callback: Callable[[bool], None]) -> None:
        """Call back with True / False when the rig's token appears / disappears; True at once if it is there."""
        import zenoh

        subscriber = self._session.session.liveliness().declare_subscriber(key, fifo(), history=True)
        self._declared.append(subscriber)
        self._session.drain(subscriber, lambda x: callback(x.kind == zenoh.SampleKind.PUT), f"watches {key}")

    def announce(self, key: str) -> None:
        """Publish a token of this client; it disappears when this process ends for any reason."""
        self._declared.append(self._session.session.liveliness().declare_token(key))

    def await_token(self, key: str) -> None:
        """Wait until a token exists, at most until the end of `wait_s`: a rig listens before it can reply."""
        any(self.tokens(key) for _ in self._opening.polls(0.1))

    def tokens(self, key: str, *, timeout_s: float = 0.5) -> list[str]:
        """Return the keys of matching tokens that exist now."""
        replies = self._session.session.liveliness().get(key, timeout=timeout_s)
        return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})

    def report(self, key: str, payload: bytes) -> None:
        """Send one payload to the rig; it is dropped if the link is congested."""
        import zenoh

        self._session.session.put(
            bind_key(self._role, key),
            payload,
            encoding=get_encoding(key, None),
            congestion_control=zenoh.CongestionControl.DROP,
            allowed_destination=zenoh.Locality.REMOTE,  # not to the own subscriptions of this client
        )

    def close(self) -> None:
        """Close both links with all their declarations."""
        if self._streams is not None:
            self._streams.close()
        self._session.close()


def connect_url(url: str, *, wait_s: float) -> ZenohClient:
    """Return a client of the rig at a URL (see `names.parse_url`), with the keys of a role in ?tls=DIR.

    Raises:
        InputError: The URL is malformed.
        NoReplyError: No rig listens there after `wait_s`; one that listens may still be starting then.
    """
    endpoint, query, folder = parse_url(url).partition("?tls=")
    client = ZenohClient(endpoint, wait_s=wait_s, tls=folder if query else None)
    try:
        client.await_token(wire.ALIVE)
    except BaseException:
        client.close()
        raise
    return client
