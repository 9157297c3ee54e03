"""Reports of clients: all are checked, and none delays a run for long."""

from __future__ import annotations

import json
from typing import Any

import pytest

from rig.serve.transport.clients import MAX_CLIENTS, MAX_STATUS_CLIENTS, Clients, Reporter


class Time:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def time_() -> Time:
    return Time()


@pytest.fixture
def clients(time_: Time) -> Clients:
    return Clients(now_s=time_)


def report(clients: Clients, name: str, **document: Any) -> None:
    clients.take(f"rig/clients/{name}", json.dumps(document).encode())


@pytest.mark.parametrize(
    "payload",
    [
        b'{"received_index":-1' + b"0" * 400 + b"}",
        b'{"received_index":1' + b"0" * 400 + b"}",
        b'{"received_index": Infinity}',
        b'{"received_index": 1e999}',
        b'{"received_index": NaN}',
        b'{"received_index": -1}',
        b'{"received_index": 4611686018427387904}',
        b'{"received_index": "100"}',
        b'{"received_index": 1.0}',
        b'{"received_index": true}',
        b'{"received_index": 1, "received_index": 2}',
        b'{"received_index": 1, "lost": -1}',
        b'{"received_index": 1, "room": -5}',
        b'{"received_index": 1, "done": 1}',
        b'{"received_index": 1, "x": 1}',
        b'{"received_index": ' + b"[" * 980 + b"]" * 980 + b"}",
        b'{"received_index": 1, "name": "\\u001b[2J"}',
        b'{"received_index": 1}' + b" " * 10_000,
        '{"received_index": 1}'.encode("utf-16"),
        b"{}",
        b"[]",
        b"null",
        b"",
        b"\xff",
    ],
)
def test_a_report_out_of_bounds_is_counted_and_not_believed(clients: Clients, payload: bytes) -> None:
    clients.take("rig/clients/x", payload)
    assert clients.malformed == 1
    assert clients.rows(1000, 20_000.0) == {}


@pytest.mark.parametrize("name", ["", "x" * 101, "a\x1b[2Jb", "a\nb", "\u202eexe"])
def test_a_name_with_control_characters_is_refused(clients: Clients, name: str) -> None:
    report(clients, name, received_index=1)
    assert clients.malformed == 1
    assert clients.active_count == 0


def test_false_names_do_not_hide_an_active_client(clients: Clients, time_: Time) -> None:
    made_up = 0
    for second in range(60):
        time_.now_s = float(second)
        report(clients, "recorder", received_index=20_000 * second, lost=0)
        for _ in range(200):
            report(clients, f"made up {made_up}", received_index=0)
            made_up += 1
        rows = clients.rows(20_000 * second, 20_000.0)
        assert "recorder" in rows or second < 2
        assert len(rows) <= MAX_STATUS_CLIENTS
    assert len(rows) + clients.hidden_count <= MAX_CLIENTS
    assert clients.hidden_count > 0


def test_a_recorder_is_shown_after_thousands_of_false_names(clients: Clients, time_: Time) -> None:
    for number in range(3 * MAX_CLIENTS):
        report(clients, f"made up {number}", received_index=5)
    for half_second in range(4):
        time_.now_s = 0.5 * half_second
        report(clients, "recorder", received_index=10_000 * half_second)
    assert "recorder" in clients.rows(30_000, 20_000.0)


def test_the_wait_for_a_client_without_progress_is_limited(clients: Clients, time_: Time) -> None:
    for second in range(70):
        time_.now_s = float(second)
        report(clients, "stuck", received_index=0, room=0)
        if second in (2, 40):
            assert clients.max_lag_rows(1000) == 1000
            assert clients.find_lagging(1000, 500)
    assert clients.max_lag_rows(1000) == 0
    assert not clients.find_lagging(1000, 500)
    report(clients, "stuck", received_index=10)
    assert clients.max_lag_rows(1000) == 990, "it goes on"


def test_a_report_under_the_name_of_another_client_is_ignored(clients: Clients, time_: Time) -> None:
    class Rig:
        def report(self, key: str, payload: bytes) -> None:
            clients.take(key, payload)

    recorder = Reporter(Rig(), "recorder")
    recorder.send(500, lost=0)
    time_.now_s = 3.5
    for forged in ({"received_index": 2**62 - 1, "lost": 7}, {"received_index": 1, "done": True}):
        report(clients, "recorder", **forged)
        report(clients, "recorder", **forged, secret="0" * 32)
    rows = clients.rows(1000, 20_000.0)
    assert [row["lost"] for row in rows.values() if row["received_index"] == 500] == [0]
    assert clients.max_lag_rows(1000, silent=True) == 500, "the end still waits for it"
    recorder.send(1000, lost=0, done=True)
    assert clients.max_lag_rows(1000, silent=True) == 0


def test_a_client_whose_count_oscillates_makes_no_progress(clients: Clients, time_: Time) -> None:
    for tick in range(100):
        time_.now_s = 0.1 * tick
        for number in range(80):
            report(clients, f"made up {number}", received_index=tick % 2)
        if tick > 40 and tick % 5 == 0:
            report(clients, "recorder", received_index=2000 * tick)
    assert next(iter(clients.rows(200_000, 20_000.0))) == "recorder"


class Links:
    """A server of which only the links are used."""

    def __init__(self, clients: Clients, time_: Time, **counts: float) -> None:
        self.clients, self.time_, self.counts = clients, time_, counts

    def congestion(self) -> dict[str, float]:
        return self.counts


def measure_delay_s(
    monkeypatch: pytest.MonkeyPatch, clients: Clients, time_: Time, beat: Any = None, **counts: float
) -> float:
    """Return the delay of a run's end in simulated wall time [s]."""

    def sleep(seconds: float) -> None:
        time_.now_s += seconds
        if beat is not None:
            beat()

    monkeypatch.setattr("rig.serve.transport.clients.time.sleep", sleep)
    monkeypatch.setattr("rig.serve.transport.clients.time.monotonic", time_)
    begin = time_.now_s
    clients.settle(Links(clients, time_, **counts), 1000, patience_s=10.0)
    return time_.now_s - begin


def test_the_end_waits_only_for_a_recorder_with_progress(
    monkeypatch: pytest.MonkeyPatch, clients: Clients, time_: Time
) -> None:
    has = iter(range(0, 10_000, 20))
    held = measure_delay_s(monkeypatch, clients, time_, lambda: report(clients, "r", received_index=next(has)), links=1)
    assert 5.0 < held < 7.0
    clients = Clients(now_s=time_)
    held = measure_delay_s(monkeypatch, clients, time_, lambda: report(clients, "r", received_index=0), links=1)
    assert 3.0 < held < 5.0


def test_the_end_waits_longer_for_a_recorder_than_for_other_clients(
    monkeypatch: pytest.MonkeyPatch, clients: Clients, time_: Time
) -> None:
    assert measure_delay_s(monkeypatch, clients, time_, links=1, stalled_links=1) < 1.5
    report(clients, "stopped", received_index=10)
    assert measure_delay_s(monkeypatch, clients, time_, links=1, stalled_links=1) > 9.5
    assert measure_delay_s(monkeypatch, clients, time_, links=0) == 0.0
