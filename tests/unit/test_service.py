"""The service over the in-process transport, with clocks that do not wait."""

from __future__ import annotations

import json
import threading
import time
from typing import Any

import numpy as np
import pytest

from drivers.console import Accepted, Console
from rig.base import wire
from rig.base.errors import InputError, RefusedError
from rig.cli.output.display import accuracy_text
from rig.run.simulation import Frame
from rig.serve import served_run
from rig.serve.pacing import Clock, FreeRun, Lockstep, RealTime, StepTimeoutError
from rig.serve.service import Service
from rig.serve.transport import NoReplyError
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.unit.service_fake import GROUPS, TRUTH, FakeSimulation
from tests.waiting import PATIENCE_S, until

BLOCK = 10_000


class Listener:
    """Collects everything a rig publishes."""

    def __init__(self, server: MemoryServer) -> None:
        self.client = MemoryClient(server)
        self.blocks: dict[str, list[wire.Block]] = {}
        self.events: list[dict[str, Any]] = []
        self.statuses: list[dict[str, Any]] = []
        self.order: list[str] = []
        self.client.subscribe("rig/**", self._take)

    def _take(self, key: str, payload: bytes) -> None:
        self.order.append(key)
        schema = wire.get_schema(key)
        if schema is not None:
            self.blocks.setdefault(key, []).append(wire.decode_block(payload, schema))
        elif key == wire.EVENTS:
            self.events.append(wire.decode_document(payload))
        elif key == wire.STATUS:
            self.statuses.append(wire.decode_document(payload))

    def named(self, name: str) -> list[dict[str, Any]]:
        return [event for event in self.events if event["event"] == name]


class Running:
    """A service on a separate thread, joined at the end."""

    def __init__(self, simulation: FakeSimulation, clock: Clock, **options: Any) -> None:
        self.server = MemoryServer()
        self.listener = Listener(self.server)
        self.service = Service(simulation, self.server, clock, block_ticks=BLOCK, **options)
        self.summary: dict[str, Any] = {}
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        try:
            self.summary = self.service.run()
        except BaseException as error:
            self.error = error

    def __enter__(self) -> Running:
        self.service.prepare()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.service.stop()
        self.join()

    def join(self) -> None:
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()

    @property
    def console(self) -> Console:
        return Console(self.listener.client, name="a test")


def run(simulation: FakeSimulation, clock: Clock | None = None, **options: Any) -> tuple[dict[str, Any], Listener]:
    server = MemoryServer()
    listener = Listener(server)
    summary = Service(simulation, server, clock or FreeRun(), block_ticks=BLOCK, **options).run()
    return summary, listener


def test_every_row_is_published_once_and_in_order() -> None:
    summary, listener = run(FakeSimulation(duration_s=1.0))
    rows = {wire.sensor_key(name): 20_000 for name in GROUPS} | {wire.truth_key(name): 2_000 for name in TRUTH}
    assert summary["rows"] == rows | {wire.EDGES: 7}
    assert summary["reason"] == "completed"
    assert summary["samples_published"] == 20_000
    assert summary["queue"]["dropped"] == 0
    for key, count in summary["rows"].items():
        values = np.concatenate([block.values[:, 0] for block in listener.blocks[key]])
        np.testing.assert_array_equal(values, np.arange(count))


def test_the_stream_begins_with_start_and_ends_with_end_and_its_rows() -> None:
    summary, listener = run(FakeSimulation(duration_s=0.1))
    assert (
        listener.events[0].items() >= {"event": "start", "scene": "fake", "seed": 1, "pace": "free", "tick": 0}.items()
    )
    end = listener.events[-1]
    assert end.items() >= {"event": "end", "reason": "completed", "tick": 100_000, "time_s": 0.1}.items()
    assert end["rows"] == summary["rows"]
    assert all("wall_s" in event for event in listener.events)
    assert [event["event"] for event in listener.events] == ["start", "end"]
    assert listener.order.index(wire.EVENTS) < listener.order.index(wire.sensor_key("probes"))
    last_event = len(listener.order) - listener.order[::-1].index(wire.EVENTS)
    assert set(listener.order[last_event:]) == {wire.STATUS}
    assert listener.statuses[-1]["state"] == "ended"


def test_a_scene_with_a_partial_last_block_ends_on_time() -> None:
    summary, listener = run(FakeSimulation(duration_s=0.033))
    assert summary["tick"] == 33_000
    assert [len(block.values) for block in listener.blocks[wire.sensor_key("probes")]] == [200, 200, 200, 60]


def test_the_block_must_fit_the_simulation() -> None:
    for ticks in (0, -BLOCK, 1_500):
        with pytest.raises(InputError, match="block_ticks must be a whole multiple of 1000"):
            Service(FakeSimulation(), MemoryServer(), FreeRun(), block_ticks=ticks)


def test_documents_are_answered() -> None:
    with Running(FakeSimulation(duration_s=None), Lockstep()) as rig:
        client = rig.listener.client
        assert wire.decode_document(client.request(wire.CATALOGUE))["tick_rate_hz"] == 1_000_000
        assert wire.decode_document(client.request(wire.PARAMETERS))["set"] == "fake"
        assert wire.decode_document(client.request(wire.SCENE))["seed"] == 1
        status = wire.decode_document(client.request(wire.STATUS))
        assert status["state"] == "running"
        assert status["energy"]["residual_j"] is None, "a number that JSON cannot carry"


def test_the_last_status_has_the_error_estimate_energy_and_warnings_of_the_end() -> None:
    class Estimating(FakeSimulation):
        def health(self) -> dict[str, Any]:
            radius = {"label": "whirl radius", "unit": "um", "error": 1e-6 * self.tick, "tolerance": 0.28}
            return {**super().health(), "energy": {"residual_j": self.tick}, "accuracy": {"quantities": {"r": radius}}}

    simulation = Estimating(duration_s=0.1)
    simulation.warn_at_tick = 100_000
    _, listener = run(simulation, status_period_s=60.0)
    status = listener.statuses[-1]
    assert accuracy_text(status["accuracy"]) == "whirl radius 0.1 um (tolerance 0.28)"
    assert status["energy"]["residual_j"] == 100_000
    assert [event["text"] for event in listener.named("warning")] == status["warnings"] == ["energy does not close"]


def test_a_command_is_answered_with_its_tick_and_becomes_an_event() -> None:
    with Running(FakeSimulation(duration_s=None), Lockstep()) as rig:
        rig.console.step(20_000)
        reply = rig.console.hammer(force_n=50.0, duration_ms=2.0, direction="y")
        assert reply == Accepted(command="hammer", id=2, tick=20_000, time_s=0.02)
        rig.console.step(BLOCK)
        command = rig.listener.named("command")[1]
        request = {"force_n": 50.0, "duration_ms": 2.0, "direction": "y"}
        assert command.items() >= {"id": 2, "command": "hammer", "request": request, "from": "a test"}.items()
        assert command["tick"] == 20_000
        assert [event["tick"] for event in rig.listener.named("hammer")] == [20_000]


@pytest.mark.parametrize(
    ("name", "payload", "message"),
    [
        ("hammer", b"", "hammer must be a JSON object"),
        ("hammer", b"{", "hammer must be a JSON object"),
        ("hammer", b"[1]", "hammer must be a JSON object"),
        ("hammer", b"\xff\xfe", "hammer must be a JSON object"),
        ("hammer", b"[" * 9_999, "hammer must be nested at most 32 deep"),
        ("hammer", b'{"force_n": ' + b"[" * 980 + b"]" * 980 + b"}", "hammer must be nested at most 32 deep"),
        ("hammer", b'{"force_n": 1' + b"0" * 400 + b"}", "hammer must be without whole numbers beyond"),
        ("hammer", b'{"force_n": Infinity}', "hammer must be with finite numbers only"),
        ("hammer", b'{"force_n": 1e999}', "hammer must be with finite numbers only"),
        ("hammer", b'{"force_n": 1, "force_n": 2}', "hammer must be without duplicate keys"),
        ("hammer", '{"from": "a"}'.encode("utf-16"), "hammer must be a JSON object in UTF-8"),
        ("hammer", b'{"from": "\\ud800", "force_n": 1}', "hammer must be a JSON object in UTF-8"),
        ("note", b'{"text": ' + b"[" * 980 + b"]" * 980 + b"}", "note must be nested at most 32 deep"),
        ("note", b'{"text": [[[["a"]]]]}', "note.text must be a valid string"),
        ("note", b'{"text": "a\\u001b[2Jb"}', "note.text must be a line of 1 to 1000 printable characters"),
        ("note", b'{"text": "a", "tags": ["b c"]}', "note.tags.0 must be a word"),
        ("hammer", b" " * 10_001, "at most 10000 bytes"),
        ("hammer", b'{"force_n": 1e6}', "force_n must be above 0 and at most 1000; received 1000000.0"),
        ("hammer", b"{}", "hammer must be readable"),
        ("hammer", b'{"force_n": "much"}', "hammer must be readable"),
        ("hammer", b'{"from": 7, "force_n": 1}', "from must be a valid string"),
        ("hammer", b'{"from": "a\\nb", "force_n": 1}', "from must be a line of 1 to 100 printable characters"),
        ("stop", b'{"now": 1}', "stop.now must be left out"),
        ("step", b'{"ticks": 0}', "step.ticks must be greater than 0"),
        ("step", b'{"ticks": 1500}', "ticks must be a positive whole multiple of 1000"),
        ("step", b'{"ticks": true}', "step.ticks must be a valid integer"),
        ("step", b'{"ticks": 1000.0}', "step.ticks must be a valid integer"),
        ("step", b'{"ticks": "1000"}', "step.ticks must be a valid integer"),
        ("step", b'{"blocks": 1}', "step.blocks must be left out"),
        ("step", b'{"ticks": 1000000000000000}', "ticks must be a positive whole multiple of 1000"),
        ("step", b"{}", "ticks must be a positive whole multiple of 1000"),
        ("step", b'{"ticks": 1000, "x": 1}', "step.x must be a known field, such as ticks, blocks"),
        ("step", b'{"ticks": 2000000}', "at most 1000000, the rest of the scene"),
    ],
)
def test_a_malformed_command_is_refused_with_one_line(name: str, payload: bytes, message: str) -> None:
    with Running(FakeSimulation(duration_s=1.0), Lockstep()) as rig:
        reply = wire.decode_document(rig.listener.client.request(wire.command_key(name), payload))
        assert reply["accepted"] is False
        assert message in reply["error"]
        assert "\n" not in reply["error"]
        assert rig.console.step(BLOCK).tick == BLOCK, "the rig goes on"
    assert [event["command"] for event in rig.listener.named("command")] == ["step"]


def test_the_console_raises_the_rigs_own_line() -> None:
    with Running(FakeSimulation(duration_s=None), Lockstep()) as rig:
        with pytest.raises(RefusedError) as caught:
            rig.console.hammer(force_n=5000.0)
        assert str(caught.value) == "force_n must be above 0 and at most 1000; received 5000.0"
        with pytest.raises(InputError, match="speed_hz must be a finite number"):
            rig.console.speed(float("nan"))


def test_step_is_refused_outside_lockstep() -> None:
    with (
        Running(FakeSimulation(duration_s=None), RealTime()) as rig,
        pytest.raises(RefusedError, match="--pace lockstep; received --pace real-time"),
    ):
        rig.console.step(BLOCK)


def test_lockstep_runs_the_granted_steps_and_replies_after_publishing() -> None:
    simulation = FakeSimulation(duration_s=1.0)
    with Running(simulation, Lockstep()) as rig:
        key = wire.sensor_key("probes")
        assert rig.console.step(25_000).tick == 25_000
        assert sum(len(block.values) for block in rig.listener.blocks[key]) == 500
        assert simulation.tick == 25_000
        assert rig.console.step(1_000).tick == 26_000
        assert sum(len(block.values) for block in rig.listener.blocks[key]) == 520
        assert rig.console.step(974_000).time_s == 1.0
        rig.join()
        assert rig.summary["reason"] == "completed"
        with pytest.raises(RefusedError, match="sent while the rig runs"):
            rig.console.release()


def test_steps_of_several_clients_add_up() -> None:
    with Running(FakeSimulation(duration_s=None), Lockstep()) as rig:
        done: list[int] = []
        threads = [threading.Thread(target=lambda: done.append(rig.console.step(BLOCK).tick)) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(PATIENCE_S)
        assert sorted(done) == [n * BLOCK for n in range(1, 9)]


def test_lockstep_without_a_partner_ends_as_a_failure() -> None:
    server = MemoryServer()
    listener = Listener(server)
    service = Service(FakeSimulation(), server, Lockstep(timeout_s=0.01), block_ticks=BLOCK)
    with pytest.raises(StepTimeoutError):
        service.run()
    assert (
        listener.events[-1]["reason"] == "failed: no step was granted within 0.01 s, after which a rig in lockstep ends"
    )


def test_stop_ends_the_run_and_refuses_later_commands() -> None:
    with Running(FakeSimulation(duration_s=None), RealTime()) as rig:
        assert rig.console.stop().command == "stop"
        rig.join()
        assert rig.summary["reason"] == "stopped"
        assert [event["event"] for event in rig.listener.events] == ["start", "command", "end"]
        with pytest.raises(RefusedError, match="must be sent while the rig runs"):
            rig.console.stop()


def test_a_step_after_the_end_gets_a_reply() -> None:
    with Running(FakeSimulation(duration_s=None, fail_at_tick=50_000), Lockstep()) as rig:
        with pytest.raises(RefusedError, match="a run that ended: failed"):
            rig.console.step(100_000)
        rig.join()


def test_a_failing_simulation_ends_the_stream_and_raises() -> None:
    server = MemoryServer()
    listener = Listener(server)
    service = Service(FakeSimulation(fail_at_tick=30_000), server, FreeRun(), block_ticks=BLOCK)
    with pytest.raises(FloatingPointError):
        service.run()
    assert listener.events[-1]["event"] == "end"
    assert listener.events[-1]["reason"] == "failed: FloatingPointError: the shaft left the rig"
    assert listener.events[-1]["rows"][wire.sensor_key("probes")] == 600


def test_a_stream_that_cannot_be_published_does_not_end_the_run() -> None:
    class Broken(MemoryServer):
        def publish(self, key: str, payload: bytes) -> None:
            if key == wire.sensor_key("forces"):
                raise OSError("the link is gone")
            super().publish(key, payload)

    server = Broken()
    listener = Listener(server)
    summary = Service(FakeSimulation(duration_s=0.5), server, FreeRun(), block_ticks=BLOCK).run()
    line = "publishing rig/sensors/forces failed: OSError: the link is gone"
    assert summary["reason"] == "completed"
    assert summary["troubles"] == [line]
    assert [event["text"] for event in listener.named("warning")] == [line]
    assert line in listener.statuses[-1]["warnings"]
    assert sum(len(block.values) for block in listener.blocks[wire.sensor_key("probes")]) == 10_000
    (end,) = listener.named("end")
    assert end["rows"][wire.sensor_key("forces")] == 10_000, "whoever lacks them learns it"


def test_an_error_in_the_status_does_not_end_the_run() -> None:
    class Unwell(FakeSimulation):
        def health(self) -> dict[str, Any]:
            return {**super().health(), "engine": {"name": object()}}

    summary, listener = run(Unwell(duration_s=0.2), status_period_s=0.0)
    assert summary["reason"] == "completed"
    assert any("publishing the status failed: TypeError" in event["text"] for event in listener.named("warning"))


def test_an_unknown_command_is_refused_with_the_known_ones() -> None:
    with Running(FakeSimulation(duration_s=None), Lockstep()) as rig:
        for name in ("explode", "Hammer", "%s", "x" * 5000):
            reply = wire.decode_document(rig.listener.client.request(wire.command_key(name), b"{}"))
            assert reply["accepted"] is False
            assert reply["error"].startswith(
                "command must be one of hammer, speed, release, fault, clear, stop, step, note"
            )
            assert len(reply["error"]) < 1000


def test_a_refusal_names_field_and_limits_in_machine_readable_form() -> None:
    with Running(FakeSimulation(duration_s=1.0), Lockstep()) as rig:
        reply = wire.decode_document(rig.listener.client.request(wire.command_key("step"), b'{"ticks": 0}'))
        assert (reply["field"], reply["must"]) == ("step.ticks", "greater than 0")


def test_the_commands_in_the_scene_are_bounded_in_bytes() -> None:
    simulation = FakeSimulation(duration_s=None)
    with Running(simulation, Lockstep()) as rig:
        request = wire.encode_document({"force_n": 1.0, "padding": "x" * 9_900})
        for _ in range(60):
            assert b'"accepted":true' in rig.listener.client.request(wire.command_key("hammer"), request)
        payload = rig.listener.client.request(wire.SCENE)
        scene = wire.decode_document(payload)
        assert len(payload) < 600_000
        assert len(scene["taken"]) + scene["forgotten"] == 60
        assert scene["taken"][-1]["id"] == 60, "the newest are kept"


def test_each_kind_of_warning_becomes_one_event() -> None:
    class Doubtful(FakeSimulation):
        def health(self) -> dict[str, Any]:
            return {"spin_hz": 1.0, "energy": {}, "warnings": [f"residual {self.tick}.5e-06 J"] if self.tick else []}

    _, listener = run(Doubtful(duration_s=0.5), status_period_s=0.0)
    assert len(listener.named("warning")) == 1
    assert listener.statuses[-1]["warnings"] == ["residual 500000.5e-06 J"]


class Gate(MemoryServer):
    """Delays every publication until it is opened."""

    def __init__(self) -> None:
        super().__init__()
        self.open = threading.Event()

    def publish(self, key: str, payload: bytes) -> None:
        assert self.open.wait(PATIENCE_S)
        super().publish(key, payload)


def test_a_paced_run_drops_and_counts_blocks_but_keeps_events() -> None:
    server = Gate()
    listener = Listener(server)
    now = [0]

    def sleep(seconds: float) -> None:
        now[0] += round(seconds * 1e9)

    class Noted(FakeSimulation):
        def advance(self, ticks: int) -> Frame:
            frame = super().advance(ticks)
            frame.events.append({"event": "hammer", "tick": frame.tick, "time_s": 0.0})
            if self.tick >= 1_000_000:
                server.open.set()
            return frame

    clock = RealTime(now_ns=lambda: now[0], sleep=sleep)
    service = Service(Noted(duration_s=1.0), server, clock, block_ticks=BLOCK, queue_seconds=0.2)
    summary = service.run()
    assert summary["queue"]["high_water"] == summary["queue"]["capacity"] == 20
    # 100 blocks; at most one was being published, and 20 were in the queue.
    dropped = summary["queue"]["dropped"]
    assert dropped in (79, 80)
    blocks = listener.blocks[wire.sensor_key("probes")]
    assert len(blocks) == 100 - dropped
    follow = wire.Continuity()
    follow.follow("probes", 0, 0)
    for block in blocks:
        follow.follow("probes", block.index, len(block.values))
    assert follow.lost["probes"] == 200 * dropped, "the gap shows in the row numbers"
    assert [event["tick"] for event in listener.named("hammer")] == [BLOCK * n for n in range(100)]
    assert len(listener.named("warning")) == 1
    assert any("blocks dropped" in text for text in listener.statuses[-1]["warnings"])
    assert listener.events[-1]["event"] == "end"


def test_an_unpaced_run_waits_for_the_publisher() -> None:
    server = Gate()
    listener = Listener(server)
    simulation = FakeSimulation(duration_s=1.0)
    service = Service(simulation, server, FreeRun(), block_ticks=BLOCK, queue_seconds=0.2)
    thread = threading.Thread(target=service.run)
    thread.start()
    until(lambda: simulation.tick >= 200_000)
    time.sleep(0.05)
    assert simulation.tick <= 220_000, "one block in the queue's 20 places, one in the publisher's hands"
    server.open.set()
    thread.join(PATIENCE_S)
    assert len(listener.blocks[wire.sensor_key("probes")]) == 100
    assert listener.statuses[-1]["queue"]["dropped"] == 0


def test_reports_of_clients_are_in_the_status_with_their_lag() -> None:
    with Running(FakeSimulation(duration_s=None), Lockstep()) as rig:
        rig.console.step(100_000)
        client = rig.listener.client
        client.report(f"{wire.CLIENTS}/recorder", json.dumps({"received_index": 1_000, "lost": 3}).encode())
        for bad in (b"", b"{}", b"[]", b'{"received_index": "x"}', b'{"received_index": []}'):
            client.report(f"{wire.CLIENTS}/broken", bad)
        client.report(f"{wire.CLIENTS}/early", b'{"received_index": null}')
        status = rig.console.status()
        assert status["samples_published"] == 2_000
        assert status["clients"].keys() == {"recorder", "early"}
        assert status["clients"]["early"]["lag_s"] == 0.0, "a new client has no lag"
        row = status["clients"]["recorder"]
        assert (row["received_index"], row["lost"], row["lag_s"]) == (1_000, 3, 0.05)
        assert "5 client reports could not be read" in status["warnings"]


def test_a_client_that_leaves_is_not_a_lagging_one() -> None:
    with Running(FakeSimulation(duration_s=None), Lockstep()) as rig:
        client = rig.listener.client
        for document in ({"received_index": 5}, {"received_index": 5, "done": True}):
            client.report(f"{wire.CLIENTS}/recorder", json.dumps(document).encode())
            assert ("recorder" in rig.console.status()["clients"]) is ("done" not in document)


def test_a_run_as_fast_as_clients_read_waits_for_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(served_run, "_MAX_AHEAD_BLOCKS", 10)
    monkeypatch.setattr(served_run, "_MIN_WAIT_REPORTED_S", -1.0)
    running = Running(FakeSimulation(duration_s=None), FreeRun())
    running.service.prepare()
    running.listener.client.report(f"{wire.CLIENTS}/slow", b'{"received_index": 0, "room": 100000}')
    with running as rig:

        def waits() -> bool:
            status = rig.console.status()
            return any("for client slow" in text for text in status["warnings"]) and not status["queue"]["depth"]

        until(waits)
        published = rig.service.published
        assert rig.console.hammer(force_n=100.0).tick * 20_000 == published * 1_000_000, (
            "commands are answered in the meantime"
        )
        assert rig.service.published == published
        rig.listener.client.report(f"{wire.CLIENTS}/slow", b'{"received_index": 0, "done": true}')
        until(lambda: rig.service.published > published)


def test_the_number_of_clients_is_bounded() -> None:
    with Running(FakeSimulation(duration_s=None), Lockstep()) as rig:
        for n in range(200):
            rig.listener.client.report(f"{wire.CLIENTS}/{n}", b'{"received_index": 1}')
        assert len(rig.console.status()["clients"]) == 64


class Slow(MemoryServer):
    """Reports a stalled link until the clock of the test indicates otherwise."""

    def __init__(self, stalled_calls: int) -> None:
        super().__init__()
        self.stalled_calls = stalled_calls
        self.calls = 0

    def congestion(self) -> dict[str, float]:
        self.calls += 1
        return {"links": 1, "stalled_links": int(self.calls < self.stalled_calls)}


def test_at_the_end_the_wait_for_a_stalled_link_is_limited() -> None:
    server = Slow(stalled_calls=8)
    Service(FakeSimulation(duration_s=0.1), server, FreeRun(), block_ticks=BLOCK).run()
    assert server.calls >= 8
    forever = Slow(stalled_calls=10**9)
    Service(FakeSimulation(duration_s=0.1), forever, FreeRun(), block_ticks=BLOCK, linger_s=0.3).run()
    assert forever.calls >= 2


def test_commands_get_no_reply_before_the_rig_is_prepared() -> None:
    server = MemoryServer()
    Service(FakeSimulation(), server, FreeRun(), block_ticks=BLOCK)
    with pytest.raises(NoReplyError):
        Console(MemoryClient(server)).stop()
