"""Both ends in one process over loopback TCP."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from rig.errors import InputError
from rig.transport import NoReplyError
from rig.transport.zenoh import ZenohClient, ZenohServer, _backlog, _Stream, parse_endpoint

pytestmark = pytest.mark.wallclock


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


def until(condition: Callable[[], bool], *, timeout_s: float = 20.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.002)


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
    with pytest.raises(InputError, match="--expose"):
        ZenohServer("0.0.0.0:7999")


def test_a_port_in_use_is_one_clear_line(server: ZenohServer) -> None:
    with pytest.raises(InputError, match=r"listen must be a free address .*instead received '127\.0\.0\.1") as caught:
        ZenohServer(server.endpoint)
    assert "\n" not in str(caught.value)


def test_the_port_is_free_again_after_close() -> None:
    endpoint = free_endpoint()
    for _ in range(2):
        with ZenohServer(endpoint), ZenohClient(endpoint):
            pass


def test_only_the_named_loopback_address_is_listened_on(server: ZenohServer) -> None:
    import os

    import psutil

    with ZenohClient(server.endpoint):
        this = psutil.Process(os.getpid())
        listening = [row.laddr for row in this.net_connections() if row.status == psutil.CONN_LISTEN]
        datagrams = this.net_connections(kind="udp")
    assert [f"{address.ip}:{address.port}" for address in listening] == [server.endpoint]
    assert datagrams == []


def test_without_a_rig_the_error_names_the_endpoint_and_the_way_out() -> None:
    endpoint = free_endpoint()
    with pytest.raises(NoReplyError, match=rf"no rig answers at {endpoint}; start one with: rig run"):
        ZenohClient(endpoint, wait_s=0.1)


def test_a_client_waits_for_a_rig_that_comes_later() -> None:
    endpoint = free_endpoint()
    servers: list[ZenohServer] = []
    timer = threading.Timer(0.7, lambda: servers.append(ZenohServer(endpoint)))
    timer.start()
    try:
        with ZenohClient(endpoint, wait_s=20.0):
            assert len(servers) == 1
    finally:
        timer.join()
        for server in servers:
            server.close()


def test_requests_are_answered_and_a_failing_handler_answers_the_next_one(server: ZenohServer) -> None:
    def handler(payload: bytes) -> bytes:
        if payload == b"bad":
            raise RuntimeError("no reply for this")
        return payload[::-1]

    server.answer("rig/status", handler)
    with ZenohClient(server.endpoint) as client:
        assert client.request("rig/status", b"abc") == b"cba"
        with pytest.raises(NoReplyError, match="no reply for this"):
            client.request("rig/status", b"bad")
        assert client.request("rig/status") == b""
        with pytest.raises(NoReplyError, match=server.endpoint):
            client.request("rig/nothing", timeout_s=0.1)


def test_every_first_request_is_answered(server: ZenohServer) -> None:
    server.answer("rig/status", lambda _: b"yes")
    for _ in range(20):
        with ZenohClient(server.endpoint) as client:
            assert client.request("rig/status", timeout_s=10.0) == b"yes"


def test_reports_reach_the_rig_and_not_the_own_subscriptions(server: ZenohServer) -> None:
    heard: list[tuple[str, bytes]] = []
    own: list[tuple[str, bytes]] = []
    server.hear("rig/clients/*", lambda key, payload: heard.append((key, payload)))
    with ZenohClient(server.endpoint) as client:
        client.subscribe("rig/**", lambda key, payload: own.append((key, payload)))
        client.report("rig/clients/a", b"1")
        until(lambda: bool(heard))
        server.publish("rig/events", b"x")
        until(lambda: bool(own))
    assert heard == [("rig/clients/a", b"1")]
    assert own == [("rig/events", b"x")]


def test_the_token_appears_when_announced_and_vanishes_on_close() -> None:
    seen: list[bool] = []
    with ZenohServer(free_endpoint()) as server, ZenohClient(server.endpoint) as client:
        client.watch("rig/alive", seen.append)
        server.announce()
        until(lambda: seen == [True])
        with ZenohClient(server.endpoint) as second:
            late: list[bool] = []
            second.watch("rig/alive", late.append)
            until(lambda: late == [True])
        server.close()
        until(lambda: seen == [True, False])


def test_a_subscriber_with_history_misses_nothing_whenever_it_comes(server: ZenohServer) -> None:
    """Several keys at a time, heartbeats between: where zenoh's own history lost messages."""
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


def sample(number: int, *, publisher: int = 1) -> Any:
    info = SimpleNamespace(source_id=SimpleNamespace(zid="a", eid=publisher), source_sn=number)
    return SimpleNamespace(
        key_expr=f"rig/{publisher}", payload=SimpleNamespace(to_bytes=lambda: b"%d" % number), source_info=info
    )


class Channel:
    """What waits while the history is fetched, and what comes later."""

    def __init__(self, waiting: list[Any], later: list[Any]) -> None:
        self.waiting = waiting
        self.later = later

    def try_recv(self) -> Any:
        return self.waiting.pop(0) if self.waiting else None

    def __iter__(self) -> Iterator[Any]:
        return iter(self.later)


@pytest.mark.parametrize(
    ("waiting", "cached", "later", "expected"),
    [
        ([], [0, 1, 2], [3, 4], [0, 1, 2, 3, 4]),
        ([2, 3], [0, 1, 2], [4], [0, 1, 2, 3, 4]),
        # The process was stopped for longer than the cache holds: what waits is older, and nobody else has it.
        ([1, 2], [7, 8, 9], [10], [1, 2, 7, 8, 9, 10]),
        # Recovered meanwhile: the same again.
        ([1, 2], [7, 8], [7, 8, 9], [1, 2, 7, 8, 9]),
        ([], [], [0, 1], [0, 1]),
    ],
)
def test_history_and_what_arrives_meanwhile_are_joined_in_order_without_loss(
    waiting: list[int], cached: list[int], later: list[int], expected: list[int]
) -> None:
    got: list[int] = []
    session = SimpleNamespace(get=lambda *_, **__: [SimpleNamespace(ok=sample(number)) for number in cached])
    stream = _Stream(session, "rig/**", lambda _, payload: got.append(int(payload)), None)
    stream.follow_with_history(Channel([sample(n) for n in waiting], [sample(n) for n in later]))
    assert got == expected


def test_the_history_of_a_restarted_rig_is_fetched_too() -> None:
    endpoint, got = free_endpoint(), []
    with ZenohServer(endpoint) as first, ZenohClient(endpoint) as client:
        first.publish("rig/events", b"first 0")
        client.subscribe("rig/**", lambda _, payload: got.append(payload), history=True)
        until(lambda: got == [b"first 0"])
        first.close()
        with ZenohServer(endpoint) as second:
            # Before the client can have come back.
            second.publish("rig/events", b"second 0")
            second.publish("rig/sensors/a", b"second 1")
            until(lambda: second.congestion()["links"] == 1)
            second.publish("rig/status", b"second 2")
            until(lambda: len(got) == 4)
    assert sorted(got[1:]) == [b"second 0", b"second 1", b"second 2"]


def test_a_lossy_subscriber_that_stalls_keeps_the_newest(server: ZenohServer) -> None:
    got: list[int] = []
    go = threading.Event()

    def take(_: str, payload: bytes) -> None:
        go.wait(20.0)
        got.append(int(payload))

    with ZenohClient(server.endpoint) as client:
        client.subscribe("rig/**", take, lossless=False)
        for n in range(5000):
            server.publish("rig/status", str(n).encode())
        server.answer("rig/ping", lambda _: b"")
        # The reply comes on the same link: everything before it has arrived.
        client.request("rig/ping", timeout_s=10.0)
        time.sleep(0.2)
        go.set()
        until(lambda: bool(got) and got[-1] == 4999)
    assert got == sorted(got)
    assert len(got) < 5000


def test_a_callback_that_raises_is_reported_and_does_not_block_the_link(
    server: ZenohServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[type] = []
    monkeypatch.setattr(threading, "excepthook", lambda args: reported.append(args.exc_type))
    server.answer("rig/ping", lambda _: b"pong")

    def take(_: str, __: bytes) -> None:
        raise ZeroDivisionError

    with ZenohClient(server.endpoint) as client:
        client.subscribe("rig/**", take)
        for _ in range(25_000):
            server.publish("rig/status", b"x")
        assert client.request("rig/ping", timeout_s=20.0) == b"pong"
    assert reported == [ZeroDivisionError]


def test_congestion_counts_links_and_sees_no_stall_where_there_is_none(server: ZenohServer) -> None:
    with ZenohClient(server.endpoint) as client:
        client.subscribe("rig/**", lambda *_: None)
        server.publish("rig/status", b"x")
        until(lambda: server.congestion()["links"] == 1)
        assert server.congestion()["stalls"] == 0


def test_backlog_counts_what_the_other_side_has_not_read() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as idle, listener.accept()[0] as sender:
            if not _backlog(port):
                pytest.skip("this system does not tell")
            sender.sendall(bytes(100_000))
            peer = idle.getsockname()[1]
            until(lambda: _backlog(port) == {peer: 100_000})
