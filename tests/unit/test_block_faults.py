"""Faults of blocks in transit: each by its definition, on its stream and rows, and no effect elsewhere."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from rig.base.errors import InputError
from rig.base.wire import Block, sensor_key
from rig.channels.faults import KINDS, Draws, list_refusals
from rig.channels.faults.blocks import DuplicateBlocks, LoseBlocks, ReorderBlocks
from rig.channels.faults.delivery import Active, Frame, Sending
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation
from tests.fault_cases import BLOCKS, EXAMPLES

SCENE = load_scene("hammer", {"duration_s": 0.4, "sensors.groups": ["probes", "forces"]})
PROBES, FORCES = sensor_key("probes"), sensor_key("forces")
FROM, TO = 0.1, 0.3
Sent = list[tuple[int, int, np.ndarray]]


def run(
    *faults: dict[str, Any], cut: int = 10_000, door: str = "zenoh"
) -> tuple[dict[str, Sent], list[dict[str, Any]]]:
    """Return index, tick and counts of the messages of every stream, and the fault events."""
    simulation, found, fault_events = Simulation(SCENE), dict[str, Sent](), list[Any]()
    while simulation.tick < simulation.end_tick:
        if simulation.tick == FROM * 1e6:
            for fault in faults:
                simulation.submit("fault", {"channel": "probes", "for_s": TO - FROM, **fault})
        frame = simulation.advance(cut)
        for message in frame.messages:
            if door in message.transports:
                block = message.block
                found.setdefault(message.key, []).append((block.index, block.tick, block.values.copy()))
        fault_events += frame.documents
    return found, fault_events


def rows(sent: Sent) -> list[tuple[int, int]]:
    return [(index, len(values)) for index, _, values in sent]


@pytest.fixture(scope="module")
def sound() -> dict[str, Sent]:
    return run()[0]


@pytest.mark.parametrize("kind", BLOCKS)
def test_a_fault_affects_only_its_stream_and_rows_and_is_reported(kind: str, sound: dict[str, Sent]) -> None:
    there, fault_events = run({"kind": kind, **BLOCKS[kind]})
    assert {
        key for key in sound if rows(there[key]) != rows(sound[key]) or kind in ("stale-stamps", "late-blocks")
    } >= {PROBES}
    for key in set(sound) - {PROBES}:
        for (index, tick, values), other in zip(there[key], sound[key], strict=True):
            assert (index, tick) == other[:2]
            np.testing.assert_array_equal(values, other[2])
    # The events restore, row by row, the original counts.
    first, last = round(FROM * 20_000), round(TO * 20_000)
    entries = [entry for each in fault_events if each["event"] == "blocks" for entry in each["blocks"]]
    assert [(entry["row"], entry["rows"]) for entry in entries] == [(row, 200) for row in range(first, last, 200)]
    counts = np.concatenate([values for _, _, values in sound[PROBES]])
    others = (*range(0, first, 200), *range(last, 8000, 200))
    expected = [(row, row, row * 50, row * 50 + 10_000, False) for row in others]
    for entry in entries:
        late = [(one["due"] > entry["row"] * 50 + 10_000) for one in entry["sent"]]
        expected += [
            (entry["row"], one["index"], one["tick"], min(one["due"], round(TO * 1e6)), behind)
            for one, behind in zip(entry["sent"], late, strict=True)
        ]
    expected.sort(key=lambda each: (each[3], each[4] and kind == "reorder-blocks", each[0]))
    assert [(index, tick) for index, tick, _ in there[PROBES]] == [each[1:3] for each in expected]
    for (_, _, values), (row, *_) in zip(there[PROBES], expected, strict=True):
        np.testing.assert_array_equal(values, counts[row : row + 200])
    assert [each["event"] for each in fault_events if each["event"] != "blocks"] == ["fault", "clear"]


@pytest.mark.parametrize("kind", BLOCKS)
def test_the_division_of_a_run_does_not_change_a_fault(kind: str) -> None:
    fault = {"kind": kind, **BLOCKS[kind], "for_s": 0.1234}
    several = ({"kind": "duplicate-blocks", "part": 0.3, "block_s": 0.007}, {"kind": "lose-blocks", "part": 0.3})

    def inside(cut: int) -> Sent:
        return [each for each in run(fault, *several, cut=cut)[0][PROBES] if each[1] < TO * 1e6]

    def joined(sent: Sent) -> list[tuple[int, int, int]]:
        # Unaffected rows before and after are sent in blocks of the run.
        return [(index + n, tick, int(value)) for index, tick, values in sent for n, value in enumerate(values[:, 0])]

    one, other = (joined(inside(cut)) for cut in (10_000, 2_500))
    assert [each[::2] for each in one] == [each[::2] for each in other]


def test_each_by_its_definition(sound: dict[str, Sent]) -> None:
    first = round(FROM * 20_000)
    assert rows(run({"kind": "dropout"})[0][PROBES]) == [
        each for each in rows(sound[PROBES]) if not 2000 <= each[0] < 6000
    ]
    stale = run({"kind": "stale-stamps"})[0][PROBES]
    assert {tick for index, tick, _ in stale if 2000 <= index < 6000} == {100_000}
    assert [index for index, _, _ in stale] == [index for index, _ in rows(sound[PROBES])]
    again = run({"kind": "restart"})[0][PROBES]
    assert [index for index, _, _ in again] == [*range(0, first, 200), *range(0, 4000, 200), *range(6000, 8000, 200)]
    assert all(tick == index * 50 for index, tick, _ in again)
    simulation, counts = Simulation(SCENE), list[int]()
    for n in range(40):
        if n == 10:
            simulation.submit("fault", {"channel": "probes", "for_s": 0.2, "kind": "late-blocks", "delay_s": 0.033})
        counts.append(sum(message.key == PROBES for message in simulation.advance(10_000).messages))
    # 33 ms have passed in the block that ends at 40 ms.
    assert counts == [*[1] * 10, 0, 0, 0, 0, *[1] * 16, 5, *[1] * 9]


def test_a_fault_on_one_transport_does_not_affect_the_other(sound: dict[str, Sent]) -> None:
    fault = {"kind": "dropout", "door": "can"}
    assert rows(run(fault)[0][PROBES]) == rows(sound[PROBES])
    assert len(run(fault, door="can")[0][PROBES]) == len(sound[PROBES]) - 20


def send_through(what: Any, blocks: int, seed: int = 5) -> list[int]:
    """Return the numbers of the received blocks, in their order."""
    sending, found = Sending(), list[int]()
    sending.active.append(Active(1, what, (), 0, {"": Draws(seed, 1, 0)}, PROBES))
    for n in range(blocks):
        block = Block(n * 10_000, n * 10, 1000.0, 1e6, np.zeros((10, 1), np.int32))
        frame = Frame(n * 10_000, 10_000, {"probes": block}, None, {}, [], np.empty(0))
        frame = sending.pass_on(frame, last=n == blocks - 1)
        found += [message.block.index // 10 for message in frame.messages]
    return found


@pytest.mark.parametrize("part", [0.1, 0.6])
def test_random_faults_have_their_rate_and_are_independent(part: float) -> None:
    n = 2000
    sent = np.isin(np.arange(n), send_through(LoseBlocks(part=part), n))
    sigma = math.sqrt(part * (1.0 - part) / n)
    assert abs(1.0 - sent.mean() - part) < 4.0 * sigma
    x = sent - sent.mean()
    assert abs(float(x[1:] @ x[:-1]) / float(x @ x)) < 4.0 / math.sqrt(n)
    assert send_through(LoseBlocks(part=part), 300) != send_through(LoseBlocks(part=part), 300, seed=6)
    twice = send_through(DuplicateBlocks(part=part), n)
    assert sorted(set(twice)) == list(range(n))
    assert abs(len(twice) / n - 1.0 - part) < 4.0 * sigma
    order = send_through(ReorderBlocks(part=part), n)
    assert sorted(order) == list(range(n))
    # A delayed block never overtakes another delayed one: every change of order is a delayed block before another.
    swapped = sum(one > other for one, other in pairwise(order))
    assert abs(swapped / n - part * (1.0 - part)) < 4.0 * math.sqrt(part * (1.0 - part) / n)


@pytest.mark.parametrize(("request_", "says"), [
    ({"channel": "disk_x", "kind": "dropout"}, "a group for dropout, as a block has all its"),
    ({"channel": "prbes", "kind": "dropout"}, "one of the groups for dropout, such as probes"),
    ({"channel": "probes", "kind": "dropout", "door": "tcp"}, "door must be"),
    ({"channel": "forces", "kind": "stale-stamps", "door": "can"}, "probes, whose time is in Sync"),
    ({"channel": "probes", "kind": "restart"}, "one that shows from the first row on, such as dropout"),
    ({"channel": "probes", "kind": "late-blocks", "delay_s": 11.0}, "delay_s must be"),
])  # fmt: skip
def test_impossible_faults_are_refused_with_the_possible_ones(request_: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError) as caught:
        Simulation(SCENE).submit("fault", request_)
    assert says in str(caught.value)


def test_an_unknown_transport_is_refused() -> None:
    simulation = Simulation(SCENE)
    simulation.set_transports(("zenoh",))
    with pytest.raises(InputError, match=r"door must be one that this rig has: zenoh \(a CAN bus: rig run --can\)"):
        simulation.submit("fault", {"channel": "probes", "kind": "dropout", "door": "can"})


@pytest.mark.parametrize("scene", ["hammer", "test-sine"])
def test_listed_combinations_are_accepted_and_others_refused(scene: str) -> None:
    """Every kind on every channel and group is accepted if listed, otherwise refused."""
    simulation = Simulation(load_scene(scene))
    simulation.advance(10_000)
    table, setting = simulation.table, simulation.scene.setting
    for kind, cls in KINDS.items():
        listed = list_refusals(cls, table, setting)
        for target in (*table.channels, *table.groups):
            number = {"swap": {"other": "P_N"}, "crosstalk": {"source": "P_N"}}.get(kind, (EXAMPLES | BLOCKS)[kind])
            if kind in ("swap", "crosstalk") and target in ("P_N", "forces"):
                number = dict.fromkeys(number, "disk_x")
            if kind == "swap" and target in table.groups:
                continue
            inside = table.groups[target].names if target in table.groups else (target,)
            names = (target,) if cls.of_blocks else inside
            fits = any if cls.channel_only else all
            try:
                simulation.submit("fault", {"channel": target, "kind": kind, **number})
                legal = True
                simulation.submit("clear", {})
            except InputError:
                legal = False
            assert legal == fits(listed.get(name, "not there") == "" for name in names), (kind, target)
