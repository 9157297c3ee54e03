"""Both ends in one process over loopback TCP."""

from __future__ import annotations

import random
import socket
import threading
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig.base.errors import InputError
from rig.base.wire import ALIVE
from rig.cli.connections.connection import Connection
from rig.serve.transport import NoReplyError
from rig.serve.transport.endpoint import parse_endpoint, read_backlogs
from rig.serve.transport.recovery import Recovery
from rig.serve.transport.zenoh import ZenohClient, ZenohServer, connect_url
from tests.processes import free_endpoint
from tests.waiting import PATIENCE_S, time_limit, until

pytestmark = pytest.mark.wallclock


@pytest.fixture
def server() -> Iterator[ZenohServer]:
    with ZenohServer(free_endpoint()) as server:
        yield server


@pytest.mark.parametrize(
    "text", ["", "7460", "127.0.0.1", "127.0.0.1:", ":7460", "127.0.0.1:0", "h:70000", "h:x", "tcp/h:1"]
)
def test_malformed_endpoints_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"^connect must be HOST:PORT"):
        parse_endpoint(text, field="connect")


def test_a_host_other_than_loopback_must_be_allowed_by_name() -> None:
    with pytest.raises(InputError, match=r"listen must be on 127\.0\.0\.1, .*ssh -L 7999:127\.0\.0\.1:7999.* --expose"):
        ZenohServer("0.0.0.0:7999")


def test_a_port_in_use_is_refused_in_one_line(server: ZenohServer) -> None:
    with pytest.raises(InputError, match=r"listen must be a free address .*received '127\.0\.0\.1") as caught:
        ZenohServer(server.endpoint)
    assert "\n" not in str(caught.value)


def test_the_port_is_free_again_after_close() -> None:
    endpoint = free_endpoint()
    for _ in range(2):
        with ZenohServer(endpoint) as server, ZenohClient(endpoint) as client:
            server.answer("rig/status", lambda _: b"yes")
            assert client.request("rig/status", timeout_s=PATIENCE_S) == b"yes"
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", int(endpoint.rpartition(":")[2])))


def test_only_the_named_loopback_address_is_listened_on(server: ZenohServer) -> None:
    import os

    import psutil

    with ZenohClient(server.endpoint):
        this = psutil.Process(os.getpid())
        listening = [row.laddr for row in this.net_connections() if row.status == psutil.CONN_LISTEN]
        datagrams = this.net_connections(kind="udp")
    assert [f"{address.ip}:{address.port}" for address in listening] == [server.endpoint]
    assert datagrams == []


def test_without_a_rig_the_error_names_the_endpoint_and_the_remedy() -> None:
    endpoint = free_endpoint()
    with pytest.raises(NoReplyError, match=rf"no rig answers at {endpoint}; start one with: rig run"):
        ZenohClient(endpoint, wait_s=0.1)


def test_a_command_waits_until_a_listening_rig_is_ready(server: ZenohServer) -> None:
    announced = threading.Timer(0.5, server.announce)
    announced.start()
    with Connection(server.endpoint, wait_s=PATIENCE_S).client() as client:
        assert client.tokens(ALIVE)
        assert announced.finished.is_set()


def test_a_missing_key_folder_is_refused_with_its_source(server: ZenohServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RIG_TLS", "nowhere")
    for folder, name in (("nowhere", "RIG_TLS"), ("other", "--tls")):
        with (
            pytest.raises(InputError, match=f"^{name} must be a folder"),
            Connection(server.endpoint, tls=Path(folder)).client(),
        ):
            pass


def test_a_client_waits_for_a_rig_that_starts_later() -> None:
    endpoint = free_endpoint()
    servers: list[ZenohServer] = []
    starts = threading.Event()

    def start() -> None:
        starts.set()
        servers.append(ZenohServer(endpoint))  # a client may be linked before it returns

    timer = threading.Timer(0.7, start)
    timer.start()
    try:
        with ZenohClient(endpoint, wait_s=PATIENCE_S):
            assert starts.is_set()
            timer.join()
            assert len(servers) == 1
    finally:
        timer.join()
        for server in servers:
            server.close()


def test_a_request_ends_when_its_rig_ends(server: ZenohServer) -> None:
    requested = threading.Event()

    def never(_: str, __: bytes) -> Future[bytes]:
        requested.set()
        return Future()

    server.answer_all("rig/command/*", never)
    with ZenohClient(server.endpoint) as client:
        goes = threading.Thread(target=lambda: (requested.wait(PATIENCE_S), server.close()))
        goes.start()
        with pytest.raises(NoReplyError, match=f"^the link to the rig at {server.endpoint} was lost before"):
            client.request("rig/command/step", timeout_s=600.0)
        goes.join()


def test_a_failing_handler_still_handles_the_next_request(server: ZenohServer) -> None:
    def handler(payload: bytes) -> bytes:
        if payload == b"bad":
            raise RuntimeError("no reply for this")
        return payload[::-1]

    failures: list[tuple[str, str]] = []
    server.on_failure(lambda where, error: failures.append((where, str(error))))
    server.answer("rig/status", handler)
    with ZenohClient(server.endpoint) as client:
        assert client.request("rig/status", b"abc") == b"cba"
        with pytest.raises(NoReplyError, match="no reply for this"):
            client.request("rig/status", b"bad")
        assert client.request("rig/status") == b""
        assert failures == [("zenoh answers rig/status", "no reply for this")]
        with pytest.raises(NoReplyError, match=server.endpoint):
            client.request("rig/nothing", timeout_s=0.1)


def test_a_delayed_reply_does_not_delay_others(server: ZenohServer) -> None:
    later: list[Future[bytes]] = []

    def handler(key: str, _: bytes) -> bytes | Future[bytes]:
        if key.endswith("/slow"):
            later.append(Future())
            return later[-1]
        return key.encode()

    server.answer_all("rig/command/*", handler)
    with ZenohClient(server.endpoint) as client, ThreadPoolExecutor(20) as pool:
        slow = [pool.submit(client.request, "rig/command/slow", timeout_s=PATIENCE_S) for _ in range(20)]
        until(lambda: len(later) == 20)
        assert client.request("rig/command/quick") == b"rig/command/quick"
        assert not any(reply.done() for reply in slow)
        for number, reply in enumerate(later):
            reply.set_result(str(number).encode())
        assert sorted(int(reply.result(PATIENCE_S)) for reply in slow) == list(range(20))
        with pytest.raises(NoReplyError, match="one key, without"):
            client.request("rig/command/*")


def test_every_first_request_is_answered(server: ZenohServer) -> None:
    server.answer("rig/status", lambda _: b"yes")
    for _ in range(20):
        with ZenohClient(server.endpoint) as client:
            assert client.request("rig/status", timeout_s=PATIENCE_S) == b"yes"


def test_a_client_of_a_url_waits_until_a_listening_rig_is_ready_and_then_no_longer(server: ZenohServer) -> None:
    def start() -> None:
        server.answer("rig/status", lambda _: b"yes")
        server.announce()

    starts = threading.Timer(0.5, start)
    starts.start()
    with connect_url(server.endpoint, wait_s=PATIENCE_S) as client:
        assert client.request("rig/status", timeout_s=0.1) == b"yes"
        with time_limit(PATIENCE_S / 2), pytest.raises(NoReplyError):
            client.request("rig/nothing", timeout_s=0.1)


def test_reports_reach_the_rig_and_not_the_own_subscriptions(server: ZenohServer) -> None:
    reports: list[tuple[str, bytes]] = []
    own: list[tuple[str, bytes]] = []
    server.subscribe_reports("rig/clients/*", lambda key, payload: reports.append((key, payload)))
    with ZenohClient(server.endpoint) as client:
        client.subscribe("rig/**", lambda key, payload: own.append((key, payload)))
        client.report("rig/clients/a", b"1")
        until(lambda: bool(reports))
        server.publish("rig/events", b"x")
        until(lambda: bool(own))
    assert reports == [("rig/clients/a", b"1")]
    assert own == [("rig/events", b"x")]


def test_the_token_appears_when_announced_and_vanishes_on_close() -> None:
    states: list[bool] = []
    with ZenohServer(free_endpoint()) as server, ZenohClient(server.endpoint) as client:
        client.watch("rig/alive", states.append)
        server.announce()
        until(lambda: states == [True])
        with ZenohClient(server.endpoint) as second:
            late: list[bool] = []
            second.watch("rig/alive", late.append)
            until(lambda: late == [True])
        server.close()
        until(lambda: len(states) == 2)
        assert states == [True, False]


def test_a_subscriber_with_history_misses_nothing_at_any_start(server: ZenohServer) -> None:
    """Several keys at a time, with heartbeats: zenoh's own history lost messages here."""
    keys = [f"rig/sensors/g{n}" for n in range(6)]
    stop = threading.Event()
    published = 0

    def publish() -> None:
        nonlocal published
        while not stop.wait(0.002):
            for key in keys:
                server.publish(key, published.to_bytes(8, "little") + bytes(2000))
            published += 1

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        for _ in range(8):
            got: dict[str, list[int]] = {key: [] for key in keys}
            until(lambda: published > 200)
            with ZenohClient(server.endpoint) as client:

                def take(key: str, payload: bytes, got: dict[str, list[int]] = got) -> None:
                    got[key].append(int.from_bytes(payload[:8], "little"))

                goal = published + 50
                client.subscribe("rig/**", take, history=True)
                until(lambda got=got, goal=goal: all(len(numbers) > goal for numbers in got.values()))
            for numbers in got.values():
                assert numbers == list(range(len(numbers)))
    finally:
        stop.set()
        thread.join()


class Publisher:
    """One key with its cache, as a subscription uses it."""

    def __init__(self, cache: int = 3000) -> None:
        self.cache = cache
        self.kept: deque[int] = deque(maxlen=cache)
        self.sent = 0
        self.silent = 0
        self.cut: int | None = None
        self.asked: list[str] = []

    def send(self) -> Any:
        self.kept.append(self.sent)
        self.sent += 1
        return self.sample(self.sent - 1)

    def sample(self, number: int) -> Any:
        info = SimpleNamespace(source_id=SimpleNamespace(zid="a", eid=1), source_sn=number)
        return SimpleNamespace(
            key_expr="rig/x", payload=SimpleNamespace(to_bytes=lambda: b"%d" % number), source_info=info
        )

    def ask(self, key: str, publisher: tuple[str, int], selection: str) -> list[Any]:
        assert (key, publisher) == ("rig/x", ("a", 1))
        self.asked.append(selection)
        if self.silent:
            self.silent -= 1
            return []
        if selection == "_max=1":
            return [self.sample(self.kept[-1])]
        first, last = map(int, selection.removeprefix("_sn=").split(".."))
        replies = [self.sample(number) for number in self.kept if first <= number <= last]
        if self.cut is not None:  # the link is lost within the reply
            replies, self.cut = replies[: self.cut], None
        return replies


class Subscription:
    """A stream under test, and its output."""

    def __init__(self, publisher: Publisher, *, history: bool) -> None:
        self.got: list[int] = []
        self.missed = 0
        self.pauses = 0
        self.publisher = publisher
        self.history = history
        self.stream = Recovery(
            publisher.ask,
            lambda _, payload: self.got.append(int(payload)),
            self._miss,
            history=history,
            cache=publisher.cache,
            pause=self._pause,
        )

    def _miss(self, key: str, count: int) -> None:
        assert key == "rig/x"
        self.missed += count

    def _pause(self, _: float) -> None:
        self.pauses += 1

    def heartbeat(self) -> None:
        self.stream.record_sent(("a", 1), "rig/x", self.publisher.sent - 1)


@pytest.mark.parametrize("seed", range(60))
def test_dropped_messages_are_recovered_in_order_or_reported(seed: int) -> None:
    """Random drops, silences and heartbeats; caches that contain all, or too little."""
    draw = random.Random(seed)
    publisher = Publisher(cache=draw.choice((3000, 3000, 40)))
    rows = Subscription(publisher, history=seed % 2 == 0)
    waiting: deque[Any] = deque()
    begin = draw.choice((0, 0, 500))
    for _ in range(begin):
        publisher.send()
    for _ in range(2000):
        if draw.random() < 0.01:  # a stall: the channel fills, then the link drops
            for n in range(draw.randrange(400)):
                sample = publisher.send()
                if n < 50:
                    waiting.append(sample)
        sample = publisher.send()
        if draw.random() < 0.9:
            waiting.append(sample)
        if draw.random() < 0.02:
            publisher.silent = draw.randrange(3)
        if draw.random() < 0.02:
            publisher.cut = draw.randrange(5)
        while waiting and draw.random() < 0.7:
            rows.stream.take(waiting.popleft())
        if draw.random() < 0.1:
            rows.heartbeat()
    for sample in waiting:
        rows.stream.take(sample)
    publisher.silent, publisher.cut = 0, None
    for _ in range(3):
        rows.heartbeat()
    assert all(b > a for a, b in zip(rows.got, rows.got[1:], strict=False)), "in order, each once"
    assert rows.got[-1] == publisher.sent - 1, "heartbeats tell of the last one"
    assert rows.missed == publisher.sent - rows.got[0] - len(rows.got), "what is not delivered is reported, exactly"
    if publisher.cache == 3000:
        # Never further back than the cache reaches, despite losses and silences of the cache.
        assert rows.missed == 0
        if rows.history:
            assert rows.got == list(range(publisher.sent))


def test_a_gap_is_requested_even_just_after_a_heartbeat() -> None:
    publisher = Publisher()
    rows = Subscription(publisher, history=False)
    rows.stream.take(publisher.send())
    for _ in range(3):
        publisher.send()
    rows.heartbeat()
    for _ in range(500):
        publisher.send()
    rows.stream.take(publisher.send())
    assert rows.got == list(range(505))
    assert rows.missed == 0


def test_messages_queued_during_a_stop_are_not_duplicates() -> None:
    """The messages in the channel are older than all that the cache still contains."""
    publisher = Publisher(cache=30)
    rows = Subscription(publisher, history=True)
    waiting = [publisher.send() for _ in range(20)]
    for _ in range(100):
        publisher.send()
    for sample in [*waiting, publisher.send()]:
        rows.stream.take(sample)
    assert rows.got == [*range(20), *range(91, 121)]
    assert rows.missed == 71


def test_recovery_is_split_and_lost_messages_are_not_requested() -> None:
    publisher = Publisher()
    rows = Subscription(publisher, history=False)
    rows.stream.take(publisher.send())
    for _ in range(100_000):
        publisher.send()
    rows.stream.take(publisher.send())
    assert len(publisher.asked) <= 4 * 15
    assert (len(rows.got), rows.missed) == (3001, 97_001)
    assert rows.pauses == 0


def test_a_silent_cache_is_queried_again() -> None:
    publisher = Publisher()
    rows = Subscription(publisher, history=False)
    rows.stream.take(publisher.send())
    for _ in range(10):
        publisher.send()
    publisher.silent = 3
    rows.stream.take(publisher.send())
    assert rows.got == list(range(12))
    assert rows.pauses > 0


def test_the_gap_is_reported_when_the_rig_has_ended() -> None:
    publisher = Publisher()
    rows = Subscription(publisher, history=False)
    rows.stream.take(publisher.send())
    for _ in range(2000):
        publisher.send()
    publisher.silent = 10**9
    rows.stream.take(publisher.send())
    assert rows.got == [0, 2001]
    assert rows.missed == 2000
    assert rows.pauses <= 3


def test_without_history_only_later_messages_are_received() -> None:
    publisher = Publisher()
    rows = Subscription(publisher, history=False)
    for _ in range(10):
        publisher.send()
    rows.heartbeat()
    publisher.send()  # lost
    publisher.send()  # lost
    rows.heartbeat()
    rows.heartbeat()
    assert rows.got == [10, 11]
    overtaken = Subscription(publisher, history=False)
    overtaken.heartbeat()
    overtaken.stream.take(publisher.sample(11))
    assert overtaken.got == [11]


def test_the_history_of_a_restarted_rig_is_fetched_too() -> None:
    endpoint, got = free_endpoint(), []
    with ZenohServer(endpoint) as first, ZenohClient(endpoint) as client:
        first.publish("rig/events", b"first 0")
        client.subscribe("rig/**", lambda _, payload: got.append(payload), history=True)
        until(lambda: got == [b"first 0"])
        first.close()
        with ZenohServer(endpoint) as second:
            # Before the client can be back.
            second.publish("rig/events", b"second 0")
            second.publish("rig/sensors/a", b"second 1")
            until(lambda: second.congestion()["links"] == 2)
            second.publish("rig/status", b"second 2")
            until(lambda: len(got) == 4)
    assert sorted(got[1:]) == [b"second 0", b"second 1", b"second 2"]


def test_a_blocking_callback_delays_neither_requests_nor_recovery(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Small channel, fast heartbeats: with one link for everything, this never ended."""
    monkeypatch.setattr("rig.serve.transport.zenoh._FIFO", 50)
    monkeypatch.setattr("rig.serve.transport.zenoh._HEARTBEAT_S", 0.01)
    keys, messages = [f"rig/sensors/g{n}" for n in range(6)], 2500
    got: dict[str, list[int]] = {key: [] for key in keys}
    states: list[bool] = []
    missed: list[int] = []
    go = threading.Event()

    def take(key: str, payload: bytes) -> None:
        assert go.wait(PATIENCE_S)
        got[key].append(int.from_bytes(payload[:8], "little"))

    with ZenohServer(free_endpoint()) as server, ZenohClient(server.endpoint) as client:
        server.answer("rig/scene", lambda _: b"pong")
        client.watch("rig/alive", states.append)
        client.subscribe("rig/sensors/*", take, on_miss=lambda _, count: missed.append(count), history=True)
        for number in range(messages):
            for key in keys:
                server.publish(key, number.to_bytes(8, "little") + bytes(2000))
        assert client.request("rig/scene", timeout_s=PATIENCE_S) == b"pong"
        server.announce()
        until(lambda: states == [True])
        go.set()
        until(lambda: all(len(numbers) == messages for numbers in got.values()))
    assert all(numbers == list(range(messages)) for numbers in got.values())
    assert missed == []


def test_close_works_even_if_a_callback_never_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.serve.transport.zenoh._FIFO", 10)
    never = threading.Event()

    entered: list[str] = []

    def block(key: str, __: bytes) -> None:
        entered.append(key)
        never.wait(120.0)

    try:
        with ZenohServer(free_endpoint()) as server, ZenohClient(server.endpoint) as client:
            client.subscribe("rig/**", block)
            # The server may receive the subscription later than the client's call returns.
            until(lambda: server.publish("rig/status", bytes(1000)) or entered)
            for _ in range(500):
                server.publish("rig/status", bytes(1000))
        assert not never.is_set(), "closed while it waited"
        assert len(entered) == 1
    finally:
        never.set()


def test_a_lossy_subscriber_that_stalls_keeps_the_newest() -> None:
    got: list[int] = []
    entered, go = threading.Event(), threading.Event()

    def take(_: str, payload: bytes) -> None:
        entered.set()
        go.wait(PATIENCE_S)
        got.append(int(payload))

    # A server that does not wait may drop the newest message itself, where the machine is busy.
    with ZenohServer(free_endpoint(), wait=True) as server:
        server.answer("rig/status", lambda _: b"")
        with ZenohClient(server.endpoint) as client:
            client.subscribe("rig/**", take, lossless=False)
            # The server may receive the subscription later than the client's call returns.
            until(lambda: server.publish("rig/status", b"0") or entered.is_set())
            for n in range(1, 5000):
                server.publish("rig/status", str(n).encode())
            client.settle()  # a reply on the same link: everything before it has arrived
            go.set()
            until(lambda: bool(got) and got[-1] == 4999)
    assert got == sorted(got)
    assert len(got) <= 2001  # the first, and a full ring


def test_a_callback_that_raises_is_reported_and_does_not_block_the_link(
    server: ZenohServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[type] = []
    monkeypatch.setattr(threading, "excepthook", lambda args: reported.append(args.exc_type))
    server.answer("rig/scene", lambda _: b"pong")

    def take(_: str, __: bytes) -> None:
        raise ZeroDivisionError

    with ZenohClient(server.endpoint) as client:
        client.subscribe("rig/**", take)
        for _ in range(25_000):
            server.publish("rig/status", b"x")
        assert client.request("rig/scene", timeout_s=PATIENCE_S) == b"pong"
    assert reported == [ZeroDivisionError]


def test_congestion_counts_links_without_a_false_stall(server: ZenohServer) -> None:
    with ZenohClient(server.endpoint) as client:
        client.subscribe("rig/**", lambda *_: None)
        server.publish("rig/status", b"x")
        until(lambda: server.congestion()["links"] == 2)
        assert server.congestion()["stalls"] == 0


def test_backlog_counts_unread_messages() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as idle, listener.accept()[0] as sender:
            if not read_backlogs(port):
                pytest.skip("this system does not tell")
            sender.sendall(bytes(100_000))
            peer = idle.getsockname()[1]
            until(lambda: sum(read_backlogs(port).values()) == 100_000)
            assert read_backlogs(port) == {peer: 100_000}


def test_a_plain_subscriber_recovers_from_the_cache_as_documented(
    server: ZenohServer,
) -> None:
    import json
    import re

    import zenoh

    from rig.base.wire import sensor_key
    from rig.serve.interface import page

    key = sensor_key("probes")
    (code,) = re.findall(r"```python\n(.*?)```", page(), re.DOTALL)
    config = zenoh.Config()
    for name, value in (
        ("mode", "peer"), ("listen/endpoints", []), ("connect/endpoints", [f"tcp/{server.endpoint}"]),
        ("scouting/multicast/enabled", False),
    ):  # fmt: skip
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config) as session:
        slow = session.declare_subscriber(key, zenoh.handlers.RingChannel(10))
        until(lambda: bool(list(session.info.peers_zid())))
        time.sleep(0.3)
        for number in range(1400):
            server.publish(key, b"%d" % number)
        time.sleep(0.5)
        got = {}
        while (sample := slow.try_recv()) is not None:
            got[sample.source_info.source_sn] = sample.payload.to_bytes()
            assert str(sample.source_info.source_id.zid) in map(str, session.info.peers_zid())
        assert len(got) <= 10, "it has lost the rest"
        found: dict[str, Any] = {"session": session, "zenoh": zenoh}
        exec(code, found)
        assert found["blocks"] == {number: b"%d" % number for number in range(1200, 1300)}
