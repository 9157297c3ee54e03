"""Server and client over zenoh: TCP on the loopback, TLS beyond it, between two peers; no router, multicast or gossip.

The server publishes without waiting (a stalled subscriber must not delay it) and keeps the last messages of each key;
a lossless client notices from the numbers of the messages what it did not get, and fetches it from there.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import json
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple

from rig import wire
from rig.errors import InputError
from rig.transport import DEFAULT_ENDPOINT, NoReplyError
from rig.transport.access import Verb, allows, rules

if TYPE_CHECKING:
    from rig.transport.certificates import Holder

LOOPBACK_HOSTS = ("127.0.0.1", "localhost")

_BLOCKS_A_SECOND = 100
_CACHE = 30 * _BLOCKS_A_SECOND
"""Messages of each key that the rig keeps for those who missed them."""
_SLOW_PUT_S = 0.5e-3
_STALLED_BYTES = 256 * 1024
"""Unread bytes that make a link stalled: about 0.1 s of all streams; one that keeps up leaves none."""
_LEASE_S = 60.0
"""A stopped subscriber sends no keep-alives, and must keep its link for well over 10 s. A killed process is noticed
by its closed socket, not by the lease."""
_PATIENCE_S = 20.0
_HEARTBEAT_S = 0.25
"""How soon a subscriber learns that the last message of a key is missing."""
_FIFO = 20_000
"""Messages that wait for a callback: about 20 s of all streams. Beyond that the link backs up, the rig drops (or waits,
where it is not paced), and the rest is recovered."""
_HEARTBEATS = 500
"""Heartbeats that a subscriber holds: several of each key. A ring takes its memory as it first goes round, a long one
for hours."""
_PORTION = 200
"""Messages asked for at a time, below 1 MB: while a cache answers its publisher waits, and sockets hold that much."""
_ATTEMPTS = 4
_RETRY_S = 0.25
_RING = 2000
"""Messages that a subscriber which may lose some holds: about 2 s of all streams."""
_FROM_CLIENTS = {"transport/link/rx/max_message_size": 1 << 20}
"""The largest that a server takes: requests have at most 64 kB. What it sends is not bounded by this."""
_FROM_AFAR = {"transport/unicast/max_sessions": 32, "transport/unicast/accept_pending": 8}
"""Where it is exposed; a client that subscribes has two sessions."""
_OPENING_S, _OPENING_TLS_S = 0.5, 2.0
"""How long one attempt to connect may take: beyond the loopback it is several times there and back."""


def parse_endpoint(text: str, *, field: str = "endpoint") -> tuple[str, int]:
    """Split HOST:PORT.

    Raises:
        InputError: It is not of that form.
    """
    host, colon, port = text.rpartition(":")
    if not colon or not host or "/" in host or not port.isdecimal() or not 1 <= int(port) <= 65535:
        raise InputError(field, f"HOST:PORT with a port of 1 to 65535, such as {DEFAULT_ENDPOINT}", text)
    return host, int(port)


def check_free(place: tuple[str, int], *, field: str) -> None:
    """Find out early whether an address can be listened on; what takes it meanwhile is found when it is.

    Raises:
        InputError: It is in use, or none of this machine.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(place)
        except OSError as error:
            raise _not_free(field, "{}:{}".format(*place), in_use=error.errno == errno.EADDRINUSE) from None


def _not_free(field: str, endpoint: str, *, in_use: bool) -> InputError:
    must = "a free address (another rig runs there, or another program)"
    return InputError(field, must if in_use else "an address of this machine that can be listened on", endpoint)


def parse_loopback(text: str, *, field: str) -> tuple[str, int]:
    """Split HOST:PORT of a door that asks nobody who they are, and so is not open to other machines.

    Raises:
        InputError: It is not of that form, or not of this machine alone.
    """
    host, port = parse_endpoint(text, field=field)
    if host not in LOOPBACK_HOSTS:
        tunnel = f"ssh -L {port}:127.0.0.1:{port} USER@HOST"
        must = f"on 127.0.0.1, since there is no password; from another machine: {tunnel} (a rig also takes --expose)"
        raise InputError(field, must, text)
    return host, port


def _locator(host: str, port: int, *, tls: bool = False) -> str:
    # "localhost" may resolve to ::1 first, where nobody listens.
    return f"{'tls' if tls else 'tcp'}/{'127.0.0.1' if host == 'localhost' else host}:{port}"


def _config(**settings: Any) -> Any:
    """The settings that both sides share, and those given (`__` stands for `/`)."""
    import zenoh

    config = zenoh.Config()
    shared = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # Blocks are of a few kB: shared memory saves nothing and would leave segments behind when a process is killed.
        "transport/shared_memory/enabled": False,
        "transport/unicast/compression/enabled": False,
        "adminspace/enabled": False,
        "transport/link/tx/lease": round(_LEASE_S * 1000),
        "transport/link/tx/keep_alive": 30,
        # Recovered messages wait for room in their link, and while they do, the publisher of that key waits for its
        # cache. After this time the link is closed instead, which can cost that client messages. It must be below the
        # time that the service can queue [us].
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(_PATIENCE_S * 1e6),
    }
    for key, value in {**shared, **{name.replace("__", "/"): value for name, value in settings.items()}}.items():
        config.insert_json5(key, json.dumps(value))
    return config


_Publisher = tuple[str, int]
"""Session and number of a publisher: one a key, and new ones when a rig is started again."""


class _Session:
    """A zenoh session with its receiving threads, closed for certain.

    zenoh's own callback threads are not daemons: a script that forgets to close would hang on exit. So all receiving
    is by channels, drained by daemon threads, and an exit handler closes what was left open.
    """

    def __init__(self, config: Any) -> None:
        import zenoh

        # A receiving thread waits where it sends a recovery to a stalled link, or fills the channel of a slow callback.
        # The default of two would leave none for the rest. Read when the first session of a process opens.
        os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 16))")
        self.session = zenoh.open(config)
        self._threads: list[threading.Thread] = []
        self._closing = threading.Lock()
        self._closed = False
        self._printed: set[str] = set()
        self.on_trouble: Callable[[str, BaseException], None] = self._print_trouble
        """Told of what fails on a receiving thread, which goes on."""
        atexit.register(self._close_at_exit)

    def _print_trouble(self, where: str, error: BaseException) -> None:
        if where not in self._printed:  # it may fail with each message
            self._printed.add(where)
            thread = threading.current_thread()
            threading.excepthook(threading.ExceptHookArgs((type(error), error, error.__traceback__, thread)))

    def drain(
        self, channel: Any, take: Callable[[Any], None], name: str, *, first: Callable[[], None] | None = None
    ) -> None:
        """Give all that arrives in a channel to `take`, on a thread of its own, after calling `first` there.

        What fails there fails alone: a channel that nobody empties would in the end block the whole link.
        """
        import zenoh

        def guarded(work: Callable[..., None], *arguments: Any) -> None:
            try:
                work(*arguments)
            except BaseException as error:
                if not (self._closed and isinstance(error, zenoh.ZError)):
                    self.on_trouble(f"zenoh {name}", error)

        def loop() -> None:
            if first is not None:
                guarded(first)
            with contextlib.suppress(zenoh.ZError):  # the channel ends with the session
                for item in channel:
                    if not self._closed:
                        guarded(take, item)

        thread = threading.Thread(target=loop, name=f"zenoh {name}", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _close_at_exit(self) -> None:
        self.close(wait_s=None)

    def close(self, *, wait_s: float | None = 2.0) -> None:
        import zenoh

        with self._closing:
            if self._closed:
                return
            self._closed = True
        atexit.unregister(self._close_at_exit)

        def close() -> None:
            with contextlib.suppress(zenoh.ZError):
                self.session.close()

        # Takes 10 s and fails where a callback never returns. A daemon would be ended in the middle of it where the
        # process ends meanwhile, which aborts the process.
        closing = threading.Thread(target=close, name="zenoh closes")
        closing.start()
        closing.join(timeout=wait_s)
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout=1.0)


def _encoding(key: str, schema: str | None) -> str:
    if schema is not None:
        return f"application/cdr;{schema}"
    return "application/octet-stream" if key.startswith(f"{wire.ROOT}/can/") else "application/json"


def _fifo() -> Any:
    import zenoh

    return zenoh.handlers.FifoChannel(256)


class Exposure(NamedTuple):
    """Where a rig listens beyond the loopback.

    Args:
        endpoint: HOST:PORT.
        holder: The rig's own certificate and who may connect; None lets everybody in, unencrypted.
    """

    endpoint: str
    holder: Holder | None


class ZenohServer:
    """The rig's side: listens on the loopback, and elsewhere where it is told to.

    Whoever connects may do what `rig.transport.access` says.

    Args:
        endpoint: HOST:PORT to listen on, on the loopback.
        exposed: Where else.
        wait: Make `publish` wait for slow subscribers (at most 5 s, then their link is closed and they recover from
            the cache) instead of letting them recover later. For runs that are not paced by the wall clock: there the
            cache would hold a much shorter wall time.

    Raises:
        InputError: An endpoint is malformed, in use, or `endpoint` not on the loopback.
    """

    def __init__(
        self, endpoint: str = DEFAULT_ENDPOINT, *, exposed: Exposure | None = None, wait: bool = False
    ) -> None:
        import zenoh

        host, port = parse_loopback(endpoint, field="listen")
        self._ports = {port}
        locators = [_locator(host, port)]
        settings: dict[str, Any] = dict(_FROM_CLIENTS)
        if exposed is not None:
            host, port = parse_endpoint(exposed.endpoint, field="expose")
            self._ports.add(port)
            locators.append(_locator(host, port, tls=exposed.holder is not None))
            settings |= _FROM_AFAR
            if exposed.holder is not None:
                settings["transport/link/tls"] = exposed.holder.settings(listens=True)
        try:
            self._session = _Session(_config(listen__endpoints=locators, access_control=rules(), **settings))
        except zenoh.ZError as error:
            field, where = "listen", endpoint
            if exposed is not None and f"{host}:{port}" in str(error):
                field, where = "expose", exposed.endpoint
            raise _not_free(field, where, in_use="in use" in str(error)) from None
        self.endpoint = endpoint
        self._congestion_control = zenoh.CongestionControl.BLOCK if wait else zenoh.CongestionControl.DROP
        self._publishers: dict[str, Any] = {}
        self._declared: list[Any] = []
        self._slow_puts = 0
        self._longest_put_s = 0.0
        self._stalls = 0
        self._stalled: set[int] = set()
        self._replies: SimpleQueue[tuple[Any, str, bytes] | None] = SimpleQueue()
        self._session.drain(iter(self._replies.get, None), lambda late: _reply(*late), "replies")

    def publish(self, key: str, payload: bytes) -> None:
        """Send one payload to all subscribers, and keep it for those who miss it. One thread only."""
        publisher = self._publishers.get(key) or self._declare(key)
        start = time.perf_counter()
        publisher.put(payload)
        taken = time.perf_counter() - start
        if taken > _SLOW_PUT_S:
            self._slow_puts += 1
            self._longest_put_s = max(self._longest_put_s, taken)

    def _declare(self, key: str) -> Any:
        from zenoh import ext

        schema = wire.schema_of(key)
        publisher = ext.declare_advanced_publisher(
            self._session.session,
            key,
            encoding=_encoding(key, schema),
            congestion_control=self._congestion_control,
            cache=ext.CacheConfig(_CACHE),
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None),
        )
        self._publishers[key] = publisher
        return publisher

    def answer(self, key: str, handler: Callable[[bytes], bytes]) -> None:
        """Answer requests on a key, one after another, on a thread of that key."""
        self.answer_all(key, lambda _, payload: handler(payload))

    def answer_all(self, expression: str, handler: Callable[[str, bytes], bytes | Future[bytes]]) -> None:
        """Answer requests on all keys that match, on a thread of this expression; what comes later, on one for that."""
        queryable = self._session.session.declare_queryable(expression, _fifo())
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
                    # Completed on a thread that must not wait for a link.
                    answer.add_done_callback(lambda done: self._replies.put((query, key, done.result())))
                else:
                    _reply(query, key, answer)

        self._session.drain(queryable, take, f"answers {expression}")

    def on_trouble(self, tell: Callable[[str, BaseException], None]) -> None:
        """Tell where and why something failed on a receiving thread."""
        self._session.on_trouble = tell

    def hear(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Receive what clients report on matching keys."""
        subscriber = self._session.session.declare_subscriber(key, _fifo())
        self._declared.append(subscriber)
        self._session.drain(subscriber, lambda x: callback(str(x.key_expr), x.payload.to_bytes()), f"hears {key}")

    def announce(self, key: str = wire.ALIVE) -> None:
        """Show the rig's token, or another: it vanishes when this process ends, however it ends."""
        self._declared.append(self._session.session.liveliness().declare_token(key))

    def watch(self, key: str, callback: Callable[[str, bool], None]) -> None:
        """Call back with key and True / False when tokens of clients on keys that match appear / vanish."""
        import zenoh

        subscriber = self._session.session.liveliness().declare_subscriber(key, _fifo(), history=True)
        self._declared.append(subscriber)
        self._session.drain(
            subscriber, lambda x: callback(str(x.key_expr), x.kind == zenoh.SampleKind.PUT), f"watches {key}"
        )

    def congestion(self) -> dict[str, float]:
        """What a stalled subscriber looks like from here.

        A put waits once, for 1 ms, when a link's queue fills, and drops at once from then on: `slow_puts` counts
        the beginnings of long stalls, not their length. What shows a stall at once and as long as it lasts is the
        number of bytes that its link holds unread (`backlog_bytes`: the largest of all links, 0 where the operating
        system does not tell). `stalls` counts how often a link was found stalled that was not in the call before;
        `links_NAME` are those whose certificate has that name.
        """
        links = list(self._session.session.info.links())
        names = Counter(f"links_{link.auth_identifier}" for link in links if link.auth_identifier is not None)
        backlog = {other: size for port in self._ports for other, size in _backlog(port).items()}
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
        """Send the last replies, and close the session and with it all that was declared."""
        self._replies.put(None)
        # zenoh waits for some seconds until a stalled link takes the farewell.
        for port in self._ports:
            _hang_up(port, {other for other, size in _backlog(port).items() if size > _STALLED_BYTES})
        self._session.close()

    def __enter__(self) -> ZenohServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _reply(query: Any, key: str, payload: bytes) -> None:
    with query:
        query.reply(key, payload, encoding="application/json")


def _backlog(port: int) -> dict[int, int]:
    """Bytes on their way in each established link of a listening port, by the other side's port (Linux).

    Those that our socket has not sent, and, where the other side is a process of this machine, those it has not read.
    """
    found: dict[int, int] = {}
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        with contextlib.suppress(OSError):
            for row in Path(table).read_text().splitlines()[1:]:
                fields = row.split()
                if fields[3] != "01":  # established
                    continue
                local, remote = (int(fields[n].rpartition(":")[2], 16) for n in (1, 2))
                unsent, unread = (int(part, 16) for part in fields[4].split(":"))
                if local == port:
                    found[remote] = found.get(remote, 0) + unsent
                elif remote == port:
                    found[local] = found.get(local, 0) + unread
    return found


def _hang_up(port: int, peers: set[int]) -> None:
    """End the links of a listening port with some other sides' ports (Linux): what is on its way still arrives."""
    for file in Path("/proc/self/fd").iterdir() if peers else ():
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(int(file.name))) as link:
            ends = link.getsockname(), link.getpeername()
            if all(isinstance(end, tuple) for end in ends) and ends[0][1] == port and ends[1][1] in peers:
                link.shutdown(socket.SHUT_RDWR)


class _Stream:
    """What one lossless subscription has received, and the recovery of what it has not.

    Publishers number their messages, keep the last ones, and tell their last number several times a second; all that is
    zenoh's. Asking for what is missing is done here: zenoh's advanced subscriber (1.10.2) can declare a gap missed
    without having asked for it, when the gap appears while the query of a heartbeat is open, and loses history alike.

    Args:
        ask: Selected messages of one publisher, from its cache: key, publisher, selection -> samples.
        on_message: Takes key and payload, in order, each once.
        on_miss: Takes key and number of messages that are nowhere to be had.
        history: Begin with what the caches hold, not with the first message that arrives.
        cache: Number of newest messages that each publisher keeps.
        pause: Waits for a number of seconds.
    """

    def __init__(
        self,
        ask: Callable[[str, _Publisher, str], list[Any]],
        on_message: Callable[[str, bytes], None],
        on_miss: Callable[[str, int], None] | None,
        *,
        history: bool,
        cache: int = _CACHE,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        self._ask = ask
        self._on_message = on_message
        self._on_miss = on_miss
        self._history = history
        self._cache = cache
        self._pause = pause
        self._lock = threading.Lock()
        self._last: dict[_Publisher, int] = {}
        """Number of the last message of each publisher that was taken, or given up."""
        self._floor: dict[_Publisher, int] = {}
        """Without history: last number of a publisher when it was first heard of; what came later belongs to us."""
        self._behind: dict[_Publisher, int | None] = {}
        """Where we stood at a publisher's previous heartbeat, if that was behind it."""

    def take(self, sample: Any) -> None:
        """Take the next message that arrived, after all that should have come before it."""
        info = sample.source_info
        publisher, number = _publisher(info.source_id), info.source_sn
        with self._lock:
            last = self._last.get(publisher)
            if last is None and number > self._floor.get(publisher, number):
                last = self._last[publisher] = self._floor[publisher]
            if last is not None and number <= last:
                return
            if number > 0 and (self._history if last is None else number > last + 1):
                self._recover(str(sample.key_expr), publisher, number - 1)
            self._deliver(publisher, number, sample)

    def begin(self, heads: list[Any]) -> None:
        """Take the history of publishers of which nothing has arrived, given the newest message that each cache has."""
        for sample in heads:
            publisher = _publisher(sample.source_info.source_id)
            with self._lock:
                if publisher not in self._last:
                    self._recover(str(sample.key_expr), publisher, sample.source_info.source_sn)

    def heartbeat(self, sample: Any) -> None:
        """Notice that the last messages of a key are missing, which no later message would show."""
        from zenoh import ext

        key, _, rest = str(sample.key_expr).partition("/@adv/pub/")
        try:
            zid, eid = rest.split("/")[:2]
            publisher, number = (zid, int(eid)), int(ext.z_deserialize(ext.UInt32, sample.payload))
        except (ValueError, ext.ZDeserializeError):
            return
        self.at_least(publisher, key, number)

    def at_least(self, publisher: _Publisher, key: str, number: int) -> None:
        """Take note that a publisher has sent a message of this number."""
        # While a message is being handed on, others wait in the channel, and nobody knows yet whether any is missing.
        if not self._lock.acquire(blocking=False):
            return
        try:
            last = self._last.get(publisher)
            if last is None and not self._history:
                last = self._floor.setdefault(publisher, number)
            if last is not None and number <= last:
                self._behind.pop(publisher, None)
            elif publisher in self._behind and self._behind[publisher] == last:
                # Nothing came since the previous heartbeat: it is not merely on its way.
                del self._behind[publisher]
                if last is not None:
                    self._last[publisher] = last
                self._recover(key, publisher, number)
            else:
                self._behind[publisher] = last
        finally:
            self._lock.release()

    def _recover(self, key: str, publisher: _Publisher, until: int) -> None:
        """Take from the cache what is missing up to a number; what it no longer has is reported and given up."""
        last = self._last.get(publisher)
        # What a publisher sent before anything of it was known is history: what its cache no longer has is no loss.
        known = last is not None
        missing = 0
        first = 0 if last is None else last + 1
        oldest = max(first, until + 1 - self._cache)
        if known:
            missing += oldest - first
        first = oldest
        while first <= until:
            end = min(until, first + _PORTION - 1)
            found = self._fetch(key, publisher, first, end)
            if found is None:
                break
            for number in sorted(found):
                if known:
                    missing += number - first
                known = True
                first = number + 1
                self._deliver(publisher, number, found[number])
            if known:
                missing += end + 1 - first
            first = end + 1
        if known:
            missing += max(0, until + 1 - first)
        self._last[publisher] = until
        if missing and self._on_miss is not None:
            self._on_miss(key, missing)

    def _fetch(self, key: str, publisher: _Publisher, first: int, end: int) -> dict[int, Any] | None:
        """Samples by number that a cache has of a range; None where the cache does not answer at all."""
        found: dict[int, Any] = {}
        for attempt in range(_ATTEMPTS):
            if attempt:
                # The link may have been lost, and be back in a moment.
                self._pause(_RETRY_S)
            for reply in self._ask(key, publisher, f"_sn={first}..{end}"):
                if first <= (number := reply.source_info.source_sn) <= end:
                    found[number] = reply
            if end in found:
                # Replies come in order: what is lacking before this one is no longer kept.
                return found
            # An empty reply can be a lost one. That these are no longer kept follows from the newest number alone.
            newest = max((reply.source_info.source_sn for reply in self._ask(key, publisher, "_max=1")), default=end)
            if newest - end >= self._cache:
                return found
        return found or None

    def _deliver(self, publisher: _Publisher, number: int, sample: Any) -> None:
        self._last[publisher] = number
        self._on_message(str(sample.key_expr), sample.payload.to_bytes())


def _publisher(entity: Any) -> _Publisher:
    return str(entity.zid), entity.eid


class ZenohClient:
    """A client's side: connects to one rig and listens on nothing. Reconnects by itself when that rig is started again.

    Subscriptions have a link of their own. It backs up when a callback is slow, and then nothing on it is read, which
    must not hold up requests and the token, and least of all the recovery that this very subscription waits for.

    Args:
        endpoint: HOST:PORT of the rig.
        wait_s: How long to wait for a rig to be there [s]; may be infinite.
        tls: Folder with the keys of a role (`rig keys init`), for a rig that is exposed; None connects without.

    Raises:
        InputError: The endpoint is malformed, or the folder holds no keys.
        NoReplyError: No rig was there in time, or it does not let us in.
    """

    def __init__(self, endpoint: str = DEFAULT_ENDPOINT, *, wait_s: float = 1.0, tls: Path | str | None = None) -> None:
        self._host, self._port = parse_endpoint(endpoint, field="connect")
        self._holder: Holder | None = None
        if tls is not None:
            from rig.transport.certificates import holder_in

            self._holder = holder_in(tls, server=False)
        self.endpoint = endpoint
        self._declared: list[Any] = []
        self._rigs: set[str] = set()
        """Rigs that this client is or was linked to: what they sent may still be on its way."""
        self.foreign = 0
        self._streams: _Session | None = None
        self._session = self._open(wait_s)

    @property
    def rig(self) -> str | None:
        """Who the rig at the other end of the link is; None without a link."""
        return next(iter(self._linked()), None)

    def _linked(self) -> set[str]:
        # A client listens on nothing, so that whom it is linked to is whom it has asked for.
        found = set(map(str, self._session.session.info.peers_zid()))
        self._rigs |= found
        return found

    def _is_rigs(self, publisher: str | None) -> bool:
        """Whether a message is from the rig, by the publisher that it names; others are counted, and left out."""
        if publisher is not None and (publisher in self._rigs or publisher in self._linked()):
            return True
        self.foreign += 1
        return False

    def _from_rig(self, sample: Any) -> bool:
        info = sample.source_info
        return self._is_rigs(None if info is None else str(info.source_id.zid))

    def _open(self, wait_s: float) -> _Session:
        import zenoh

        deadline = time.monotonic() + wait_s
        longest_s, settings = _OPENING_S, {}
        if self._holder is not None:
            longest_s, settings = _OPENING_TLS_S, {"transport/link/tls": self._holder.settings(listens=False)}
        while True:
            left = deadline - time.monotonic()
            config = _config(
                listen__endpoints=[],
                connect__endpoints=[_locator(self._host, self._port, tls=self._holder is not None)],
                # Opening waits for the link, so that the first request cannot come too early; in slices, so that
                # Ctrl-C works meanwhile.
                connect__timeout_ms=round(1000 * min(longest_s, max(left, 0.05))),
                connect__exit_on_failure=True,
                connect__retry={"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
                **settings,
            )
            try:
                return _Session(config)
            except zenoh.ZError:
                if time.monotonic() >= deadline:
                    raise self._not_let_in() from None

    def _not_let_in(self) -> NoReplyError:
        """Whether nobody is there, or somebody who does not let us in."""
        try:
            if self._holder is None:
                socket.create_connection((self._host, self._port), timeout=1.0).close()
                why = "without a certificate: for a rig that is exposed give --tls FOLDER; else it is no rig, or hangs"
            elif (said := self._holder.turned_away(self._host, self._port)) is not None:
                why = f"as {self._holder.name}, by the keys in {self._holder.folder}: {said}"
            else:
                why = "though its certificates are right: it has too many links, or hangs"
        except OSError:
            return self._no_reply()
        return NoReplyError(f"{self.endpoint} listens, but does not let us in {why}")

    def _no_reply(self) -> NoReplyError:
        return NoReplyError(f"no rig answers at {self.endpoint}; start one with: rig run hammer (see rig run --help)")

    @property
    def connection(self) -> str | None:
        """By which certificates both ends know each other; None without TLS."""
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
        """Receive payloads on a thread of this subscription.

        The messages of each key arrive in order; messages of different keys may arrive in another order than they
        were sent in (after a stall each key is recovered for itself), so an `end` event can overtake blocks. A
        callback that blocks stops only this subscription; the rig goes on, and what was missed is recovered.
        `on_miss` and `on_message` are never called at the same time.
        """
        import zenoh

        if self._streams is None:
            self._streams = self._open(5.0)
        streams, session = self._streams, self._streams.session
        self._linked()
        if not lossless:
            subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(_RING))
            self._declared.append(subscriber)

            def take_any(sample: Any) -> None:
                if self._from_rig(sample):
                    on_message(str(sample.key_expr), sample.payload.to_bytes())

            streams.drain(subscriber, take_any, f"takes {key}")
            return

        def get(link: _Session, selector: str) -> list[Any]:
            replies = link.session.get(
                selector,
                timeout=_PATIENCE_S,
                consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
            )
            return [reply.ok for reply in replies if reply.ok is not None and self._from_rig(reply.ok)]

        def ask(name: str, publisher: _Publisher, selection: str) -> list[Any]:
            zid, eid = publisher
            return get(self._session, f"{name}/@adv/*/{zid}/{eid}/**?{selection}")

        def begin() -> None:
            if history:
                heads = get(streams, f"{key}/@adv/**?_max=1")
                # What came before these replies, over the same link, goes first: it may be older than all that the
                # caches still have, where this process was stopped meanwhile.
                while (sample := subscriber.try_recv()) is not None:
                    take(sample)
                stream.begin(heads)

        def take(sample: Any) -> None:
            if self._from_rig(sample):
                stream.take(sample)

        def heartbeat(sample: Any) -> None:
            if self._is_rigs(str(sample.key_expr).partition("/@adv/pub/")[2].partition("/")[0]):
                stream.heartbeat(sample)

        stream = _Stream(ask, on_message, on_miss, history=history)
        subscriber = session.declare_subscriber(key, zenoh.handlers.FifoChannel(_FIFO))
        heartbeats = session.declare_subscriber(f"{key}/@adv/pub/**", zenoh.handlers.RingChannel(_HEARTBEATS))
        self._declared += [subscriber, heartbeats]
        streams.drain(subscriber, take, f"takes {key}", first=begin)
        streams.drain(heartbeats, heartbeat, f"heartbeats {key}")

    def request(self, key: str, payload: bytes = b"", *, timeout_s: float = 2.0) -> bytes:
        """Ask the rig and return its reply.

        Raises:
            NoReplyError: Nobody answered in time, or the answer is that the rig failed to make one.
        """
        import zenoh

        deadline = time.monotonic() + timeout_s
        while True:
            replies: Iterator[Any] = self._session.session.get(
                key,
                payload=payload,
                timeout=max(deadline - time.monotonic(), 0.01),
                # Replies inherit both. One that waits for room in the queue of a stalled client would hold up all
                # others and close the link after 5 s; and replies need not queue behind recovered blocks.
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
            )
            for reply in replies:
                payload_back = reply.result.payload.to_bytes()
                if reply.ok is not None:
                    return payload_back
                if (text := payload_back.decode(errors="replace")) != "Timeout":
                    raise NoReplyError(f"the rig at {self.endpoint} could not answer {key}: {text}")
            # Without a rig the reply is empty at once: it may be about to start. So it is where the rig denies this.
            late = time.monotonic() + 0.05 >= deadline
            role = None if self._holder is None else self._holder.name
            denied = not allows(role, Verb.ASK, key)
            if (late or denied) and self.tokens(wire.ALIVE):
                what = f"denies {key} to {role or 'everybody'}" if denied else f"does not answer {key}"
                raise NoReplyError(f"the rig at {self.endpoint} {what}")
            if late:
                raise self._no_reply()
            time.sleep(0.05)

    def watch(self, key: str, callback: Callable[[bool], None]) -> None:
        """Call back with True / False when the rig's token appears / vanishes; True at once if it is there."""
        import zenoh

        subscriber = self._session.session.liveliness().declare_subscriber(key, _fifo(), history=True)
        self._declared.append(subscriber)
        self._session.drain(subscriber, lambda x: callback(x.kind == zenoh.SampleKind.PUT), f"watches {key}")

    def announce(self, key: str) -> None:
        """Show a token of this client: it vanishes when this process ends, however it ends."""
        self._declared.append(self._session.session.liveliness().declare_token(key))

    def tokens(self, key: str, *, timeout_s: float = 0.5) -> list[str]:
        """Keys of the tokens that are there now, of those that match."""
        replies = self._session.session.liveliness().get(key, timeout=timeout_s)
        return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})

    def report(self, key: str, payload: bytes) -> None:
        """Send one payload to the rig; it is dropped where the link is congested."""
        import zenoh

        self._session.session.put(
            key,
            payload,
            encoding=_encoding(key, None),
            congestion_control=zenoh.CongestionControl.DROP,
            # Not to the own subscriptions of this client.
            allowed_destination=zenoh.Locality.REMOTE,
        )

    def close(self) -> None:
        """Close both links and with them all that was declared."""
        if self._streams is not None:
            self._streams.close()
        self._session.close()

    def __enter__(self) -> ZenohClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
