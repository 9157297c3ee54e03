from __future__ import annotations

import pytest

from rig.serve.transport import NoReplyError
from rig.serve.transport.memory import MemoryClient, MemoryServer, key_matches


@pytest.mark.parametrize(
    ("expression", "key", "matches"),
    [
        ("rig/status", "rig/status", True),
        ("rig/status", "rig/events", False),
        ("rig/sensors/*", "rig/sensors/probes", True),
        ("rig/sensors/*", "rig/sensors", False),
        ("rig/*", "rig/sensors/probes", False),
        ("rig/**", "rig/sensors/probes", True),
        ("rig/**", "rig", True),
        ("**/probes", "rig/sensors/probes", True),
        ("rig/**/probes", "rig/probes", True),
        ("rig/**/probes", "rig/sensors/forces", False),
    ],
)
def test_key_expressions(expression: str, key: str, matches: bool) -> None:
    assert key_matches(expression, key) is matches


def test_messages_arrive_in_order_with_history_on_request() -> None:
    server = MemoryServer()
    early, late, without = [], [], []
    MemoryClient(server).subscribe("rig/**", lambda key, payload: early.append((key, payload)))
    server.publish("rig/events", b"1")
    server.publish("rig/status", b"2")
    MemoryClient(server).subscribe("rig/events", lambda *message: late.append(message), history=True)
    MemoryClient(server).subscribe("rig/**", lambda *message: without.append(message))
    server.publish("rig/events", b"3")
    assert early == [("rig/events", b"1"), ("rig/status", b"2"), ("rig/events", b"3")]
    assert late == [("rig/events", b"1"), ("rig/events", b"3")]
    assert without == [("rig/events", b"3")]


def test_a_closed_client_receives_nothing_more() -> None:
    server, got = MemoryServer(), []
    client = MemoryClient(server)
    client.subscribe("rig/**", lambda *message: got.append(message))
    client.close()
    server.publish("rig/events", b"1")
    assert got == []


def test_requests_reports_and_the_token() -> None:
    server, received, tokens = MemoryServer(), [], []
    client = MemoryClient(server)
    with pytest.raises(NoReplyError, match="rig/status"):
        client.request("rig/status")
    server.answer("rig/status", lambda payload: payload + b"!")
    server.subscribe_reports("rig/clients/*", lambda *report: received.append(report))
    client.watch("rig/alive", tokens.append)
    assert tokens == []
    server.announce()
    MemoryClient(server).watch("rig/alive", tokens.append)
    assert client.request("rig/status", b"well") == b"well!"
    client.report("rig/clients/me", b"1")
    client.report("rig/others/me", b"2")
    assert received == [("rig/clients/me", b"1")]
    server.close()
    server.close()
    assert tokens == [True, True, False, False]
    with pytest.raises(NoReplyError):
        client.request("rig/status")
