"""The client of a rig whose streams a test defines: rows of the truth are checked like those of sensors."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from drivers.client import NotSeenError, Rig
from drivers.link import LinkTimeoutError
from drivers.sources.samples import ALL_AVAILABLE, RowReader, Samples
from rig.base.wire import STATUS, encode_block, encode_document, truth_key
from tests.waiting import PATIENCE_S

from .recorder_stream import ScriptedClient, make_block

CONTACT = truth_key("contact")
ROWS = 20


class SettledClient(ScriptedClient):
    """A client whose subscriptions are active at once."""

    def __init__(self) -> None:
        super().__init__()
        status = {"pace": "real-time", "block_ms": 10.0, "tick": 0, "time_s": 0.0, "state": "running"}
        self.replies[STATUS] = encode_document(status)

    def settle(self) -> None:
        """Return at once: nothing is in transit."""

    def close(self) -> None:
        """Do nothing: there are no resources."""


@pytest.fixture
def client() -> SettledClient:
    return SettledClient()


@pytest.fixture
def machine(client: SettledClient) -> Rig:
    return Rig(client, truth=["contact"])


def send(client: SettledClient, *numbers: int) -> None:
    for number in numbers:
        client.publish(CONTACT, encode_block(make_block(CONTACT, number)))


def values_of(*numbers: int) -> np.ndarray:
    return np.concatenate([make_block(CONTACT, number).values for number in numbers])


def test_received_truth_is_read_once(client: SettledClient, machine: Rig) -> None:
    send(client, 0, 1)
    rows = machine.truth("contact", timeout_s=0.0)
    assert (rows.index, rows.gap, rows.names[0], rows.unit("contact_0")) == (0, 0, "contact_0", "m")
    np.testing.assert_array_equal(rows.values, values_of(0, 1))
    with pytest.raises(NotSeenError, match="no rows of the truth table contact came in 0 s"):
        machine.truth("contact", timeout_s=0.0)


def test_forged_truth_is_skipped(client: SettledClient, machine: Rig) -> None:
    forged = make_block(CONTACT, 1)
    send(client, 0)
    for payload in (
        b"",
        b"{}",
        encode_block(forged)[:-1],
        encode_block(replace(forged, values=forged.values[:, :2])),
        encode_block(replace(forged, rate_hz=1.0)),
        encode_block(replace(forged, tick=10**15)),
    ):
        client.publish(CONTACT, payload)
    send(client, 1)
    np.testing.assert_array_equal(machine.truth("contact", timeout_s=0.0).values, values_of(0, 1))


def test_repeated_truth_is_read_once(client: SettledClient, machine: Rig) -> None:
    send(client, 0, 1, 1, 2)
    np.testing.assert_array_equal(machine.truth("contact", timeout_s=0.0).values, values_of(0, 1, 2))


@pytest.mark.parametrize("to_s", [None, 0.05])
def test_missing_truth_parts_the_rows_and_is_counted(client: SettledClient, machine: Rig, to_s: float | None) -> None:
    send(client, 0, 3, 4)
    first = machine.truth("contact", to_s=to_s, timeout_s=0.0)
    second = machine.truth("contact", to_s=to_s, timeout_s=0.0)
    assert [(rows.index, len(rows), rows.gap) for rows in (first, second)] == [(0, ROWS, 0), (3 * ROWS, 2 * ROWS, 40)]
    assert second.times_s[0] == pytest.approx(0.03)


# Rows, as any of the clients reads them.


def part(index: int, rows: int, *, gap: int = 0) -> Samples:
    values = np.arange(index, index + rows, dtype=float)[:, None]
    return Samples(index, 1000 * index, 1000.0, 1e6, ("a",), ("V",), values, gap=gap)


def test_returned_rows_are_read_next() -> None:
    reader = RowReader("a reader")
    for samples in (part(0, 10), part(10, 10)):
        reader.add(samples)
    rows = reader.read(15)
    reader.put_back(rows.rows(5, 15))
    assert [(each.index, len(each)) for each in (reader.read(10), reader.read())] == [(5, 10), (15, 5)]


def test_received_rows_are_read_in_pieces_without_a_gap() -> None:
    reader = RowReader("a reader")
    for samples in (part(0, 10), part(10, 10), part(30, 10, gap=10), part(40, 5)):
        reader.add(samples)
    assert [(each.index, len(each), each.gap) for each in reader.ready()] == [(0, 20, 0), (30, 15, 10)]
    assert not list(reader.ready())
    with pytest.raises(LinkTimeoutError, match="a reader: 0 of any rows came in 0 s"):
        reader.read(ALL_AVAILABLE, timeout_s=0.0, whole=False)


def test_a_read_waits_for_rows_of_another_thread() -> None:
    reader = RowReader("a reader")
    adds = threading.Thread(target=lambda: [reader.add(part(10 * n, 10)) for n in range(3)])
    adds.start()
    assert len(reader.read(30, timeout_s=PATIENCE_S)) == 30
    adds.join()
