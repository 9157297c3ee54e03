"""One service on two transports."""

from __future__ import annotations

from rig.base import wire
from rig.serve.transport.fanout import Fanout
from rig.serve.transport.memory import MemoryClient, MemoryServer


class Counting(MemoryServer):
    def __init__(self, **counts: float) -> None:
        super().__init__()
        self.counts = counts

    def congestion(self) -> dict[str, float]:
        return self.counts


def test_clients_of_all_transports_subscribe_request_and_report() -> None:
    servers = [MemoryServer(), MemoryServer()]
    both = Fanout(servers)
    received: list[tuple[int, str, bytes]] = []
    reports: list[bytes] = []
    tokens: list[tuple[int, bool]] = []
    both.subscribe_reports("rig/clients/*", lambda _, payload: reports.append(payload))
    both.answer(wire.STATUS, lambda payload: payload + b"!")
    for number, server in enumerate(servers):
        client = MemoryClient(server)
        client.subscribe("rig/**", lambda key, payload, number=number: received.append((number, key, payload)))
        client.watch(wire.ALIVE, lambda there, number=number: tokens.append((number, there)))
    both.publish(wire.EVENTS, b"1")
    assert received == [(0, wire.EVENTS, b"1"), (1, wire.EVENTS, b"1")]
    for server in servers:
        assert MemoryClient(server).request(wire.STATUS, b"?") == b"?!"
        MemoryClient(server).report("rig/clients/a", b"here")
    assert reports == [b"here", b"here"]
    both.announce()
    both.close()
    assert tokens == [(0, True), (1, True), (0, False), (1, False)]


def test_the_status_has_the_counts_of_all_transports() -> None:
    both = Fanout([Counting(links=1), Counting(other=2)], figures=lambda: {"can_frames": 3})
    assert both.congestion() == {"links": 1, "other": 2, "can_frames": 3}
    assert Fanout([Counting(links=1)]).congestion() == {"links": 1}
