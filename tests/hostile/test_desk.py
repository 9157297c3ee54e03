"""Commands and reports of hostile clients to a served run: it continues, and accepts nothing that is wrong."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import pytest

from rig.base import wire
from rig.run.commands.table import COMMANDS as DONE_TO_THE_RIG
from rig.run.commands.table import check_command
from rig.serve.pacing import Lockstep
from rig.serve.request_handler import REQUESTS
from rig.serve.service import COMMANDS, Service
from rig.serve.transport.limit import CommandLimit
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.hostile import input_count
from tests.hostile.documents import generate_documents
from tests.unit.service_fake import FakeSimulation
from tests.waiting import PATIENCE_S

EXAMPLES: dict[str, list[dict[str, Any]]] = {
    "hammer": [{"force_n": 100.0, "duration_ms": 5.0, "direction": "x", "from": "a"}, {"direction": 30.0}, {}],
    "speed": [{"speed_hz": 6.2, "from": "a"}],
    "release": [{"from": "a"}],
    "stop": [{"from": "a", "now": 1}],
    "step": [{"ticks": 1000, "from": "a"}, {"blocks": 1}],
    "note": [{"text": "warm", "tags": ["a", "b"], "from": "a"}],
    "explode": [{"force_n": 1.0}],
}
REPORTS = [
    {"name": "x", "received_index": 100, "lost": 0, "room": 20, "done": False, "wall_s": 1.0},
    {"received_index": None},
]


class Checked(FakeSimulation):
    """Accepts what the rig's own check accepts, and stores it."""

    def __init__(self) -> None:
        super().__init__(duration_s=None)
        self.taken: list[Any] = []

    def submit(self, command: str, request: dict[str, Any]) -> int:
        self.taken.append(check_command(command, request))
        return self.tick


@pytest.fixture
def served() -> Any:
    """A run in lockstep, served on a thread: simulation, client, and exceptions of its service."""
    server, simulation, unbound = MemoryServer(cache=0), Checked(), CommandLimit(1e9, 10**9)
    service = Service(
        simulation, server, Lockstep(), block_ticks=10_000, status_period_s=0.05, linger_s=0.0, limit=unbound
    )
    service.prepare()
    summary: dict[str, Any] = {}
    thread = threading.Thread(target=lambda: summary.update(service.run()))
    thread.start()
    yield simulation, server, MemoryClient(server)
    service.stop()
    thread.join(PATIENCE_S)
    assert summary["reason"] == "stopped", "the run went on to the end that was asked for"
    assert summary["troubles"] == [], "nothing fell through the checks"


def asked(client: MemoryClient, name: str, payload: bytes) -> dict[str, Any]:
    return wire.decode_document(client.request(wire.command_key(name), payload))


def test_every_command_gets_a_reply_and_only_valid_ones_are_accepted(served: Any) -> None:
    simulation, _, client = served
    random = np.random.default_rng(11)
    accepted = 0
    for name, examples in EXAMPLES.items():
        for payload in generate_documents(random, input_count(4200) // len(EXAMPLES), examples):
            if name == "stop":
                continue
            reply = asked(client, name, payload)
            assert isinstance(reply["accepted"], bool)
            assert len(str(reply)) < 3000
            assert str(reply).isprintable()
            accepted += reply["accepted"]
    assert accepted > 20, "the generator must also make good ones"
    for command in simulation.taken:
        assert type(command) in DONE_TO_THE_RIG.values()
        for value in command.model_dump().values():
            assert isinstance(value, str) or (math.isfinite(value) and not isinstance(value, bool))
    assert wire.decode_document(client.request(wire.STATUS))["state"] == "running"
    assert len(client.request(wire.SCENE)) < 1_000_000


def test_hostile_reports_do_not_stop_the_status(served: Any) -> None:
    _, _, client = served
    statuses: list[bytes] = []
    client.subscribe(wire.STATUS, lambda _, payload: statuses.append(payload))
    random = np.random.default_rng(12)
    for number, payload in enumerate(generate_documents(random, input_count(4000), REPORTS)):
        name = ("x", f"made up {number}", "\x1b[2J", "")[random.integers(4)]
        client.report(f"{wire.CLIENTS}/{name}", payload)
        if number % 50 == 0:
            status = wire.decode_document(client.request(wire.STATUS))
            assert len(status["clients"]) <= 64
            assert all(row["lag_s"] >= 0.0 and row["lost"] >= 0 for row in status["clients"].values())
    before = len(statuses)
    asked(client, "note", b'{"text": "still here"}')
    for _ in range(200):
        if len(statuses) > before:
            break
        threading.Event().wait(0.05)
    assert len(statuses) > before, "the status is still published"


def test_every_command_has_a_model() -> None:
    assert set(COMMANDS) == set(DONE_TO_THE_RIG) | {"stop", "step", "note", "join", "done", "leave"}
    assert set(COMMANDS) - set(DONE_TO_THE_RIG) <= set(REQUESTS)
