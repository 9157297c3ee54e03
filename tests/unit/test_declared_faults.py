"""Rows removed by a fault of blocks are distinguished from lost rows, live and in the file."""

from __future__ import annotations

import json
import random
import threading
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recorder.session
from recorder.contents.summary import Summary
from recorder.output.disk_limits import DiskLimits
from recorder.output.trigger import Capture, Trigger
from recorder.reader import Recording, join
from recorder.rewrite import cut
from recorder.session import RecordingSession
from replays.recordings.export import write_run
from replays.recordings.validation import validate
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.faults.ledger import Declared
from rig.run.scenes import load_scene, parse_scene
from rig.run.simulation import Simulation
from tests.fault_cases import BLOCKS
from tests.unit.recorder_stream import ScriptedClient

PROBES = wire.sensor_key("probes")


@cache
def scene(kind: str) -> Any:
    fault = {"at_s": 0.1, "channel": "probes", "kind": kind, "for_s": 0.2, **BLOCKS[kind]}
    return parse_scene({"duration_s": 0.4, "sensors": {"groups": ["probes", "drive"]}, "faults": [fault]})


@cache
def simulate_messages(kind: str) -> list[tuple[str, bytes]]:
    """Return the messages that a rig publishes, in order."""
    simulation, rows = Simulation(scene(kind)), wire.Continuity()
    found = [(wire.EVENTS, {"event": "start", "tick": 0, "time_s": 0.0})]
    items = [(key, wire.encode_document(each)) for key, each in found]
    while simulation.tick < simulation.end_tick:
        frame = simulation.advance(10_000)
        items += [(wire.FAULTS, wire.encode_document(each)) for each in frame.documents]
        for message in frame.messages:
            rows.follow(message.key, message.row, len(message.block.values), late_rows=1e9)
            items.append((message.key, wire.encode_block(message.block)))
        items += [(wire.EVENTS, wire.encode_document(each)) for each in frame.events]
    end = {"event": "end", "tick": simulation.tick, "time_s": simulation.tick / 1e6, "reason": "completed"}
    return [*items, (wire.EVENTS, wire.encode_document(rows.add_row_counts(end)))]


def recorded(
    path: Path, kind: str, items: list[tuple[str, bytes]], *, late: tuple[tuple[str, bytes], ...] = (), **options: Any
) -> Summary:
    simulation, client = Simulation(scene(kind)), ScriptedClient()
    for key, document in (
        (wire.CATALOGUE, simulation.catalogue()),
        (wire.PARAMETERS, simulation.parameters_document()),
        (wire.SCENE, simulation.scene_document()),
    ):
        client.replies[key] = wire.encode_document(document)

    def publish() -> None:
        while wire.STATUS not in client.subscribed:
            time.sleep(0.002)
        for item in items:
            client.publish(*item)
        if late:
            time.sleep(0.1)
        for item in late:
            client.publish(*item)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        return RecordingSession(client, path, **options).run()
    finally:
        thread.join()


@pytest.fixture(autouse=True)
def _short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder.session, "QUIET_S", 0.05)
    monkeypatch.setattr(recorder.session, "RECOVERY_S", 0.2)


def rows(payloads: list[bytes]) -> list[int]:
    blocks = [wire.decode_block(payload, wire.SAMPLE_SCHEMA) for payload in payloads]
    return [block.index + n for block in blocks for n in range(len(block.values))]


@pytest.mark.parametrize("kind", BLOCKS)
def test_a_recorder_of_a_faulty_stream_ends_normally_with_all_blocks(kind: str, tmp_path: Path) -> None:
    items = simulate_messages(kind)
    summary = recorded(tmp_path / "live.mcap", kind, items)
    assert (summary.good, summary.losses, summary.refused) == (True, (), 0)
    write_run(Simulation(scene(kind)), tmp_path / "offline.mcap")
    sent = [payload for key, payload in items if key == PROBES]
    for name in ("live", "offline"):
        recording = Recording.open(tmp_path / f"{name}.mcap")
        assert recording.doubts == ()
        stream = recording.streams[PROBES]
        missing = 8000 - stream.rows
        assert (stream.lost - stream.declared, stream.due) == (0, 8000)
        assert rows([payload for _, payload in recording.payloads(PROBES)]) == rows(sent)
        assert missing == {"dropout": 4000, "lose-blocks": 200 * (40 - len(sent))}.get(kind, 0)
        assert recording.messages[wire.FAULTS] > 2


@pytest.mark.parametrize(
    ("kind", "behind"),
    [("duplicate-blocks", 5), ("reorder-blocks", 5), ("stale-stamps", 5), ("restart", 0), ("restart", 5)],
)
def test_late_fault_events_are_used(kind: str, behind: int, tmp_path: Path) -> None:
    """Blocks and fault events come on separate threads; the events are late by a number of blocks."""
    items = simulate_messages(kind)
    fault_events, held = [item for item in items if item[0] == wire.FAULTS], list[tuple[str, bytes]]()
    blocks = 0
    for item in items:
        held += [item] if item[0] != wire.FAULTS else []
        blocks += item[0] == PROBES
        if item[0] == PROBES and blocks > 10 + behind:
            held += fault_events[:2]
            fault_events = [each for each in fault_events if each not in held]
    held += fault_events
    summary = recorded(tmp_path / "late.mcap", kind, held)
    assert (summary.good, summary.losses) == (True, ())
    assert summary.rows[PROBES] == 8000


@pytest.mark.parametrize("seed", [25, 34, 40, 57])
def test_fault_events_may_arrive_in_bursts(seed: int, tmp_path: Path) -> None:
    """Renumbered blocks and the events that report it, each in order, one randomly ahead of the other."""
    rng, items = random.Random(seed), list(simulate_messages("restart"))
    end, held = items.pop(), list[tuple[str, bytes]]()
    streams = [[item for item in items if (item[0] == wire.FAULTS) == is_fault] for is_fault in (True, False)]
    while any(streams):
        most = rng.randint(1, rng.choice((3, 15, 60)))
        stream = streams[0 if rng.random() < 0.5 else 1]
        held += stream[:most]
        del stream[:most]
    assert recorded(tmp_path / "bursts.mcap", "restart", [*held, end]).good


def test_fault_events_may_arrive_after_the_end(tmp_path: Path) -> None:
    items = simulate_messages("restart")
    last = max(n for n, (key, payload) in enumerate(items) if key == wire.FAULTS and json.loads(payload).get("blocks"))
    summary = recorded(tmp_path / "late.mcap", "restart", items[:last] + items[last + 1 :], late=(items[last],))
    assert (summary.losses, summary.refused) == ((), 0)


@pytest.mark.parametrize("kind", ["lose-blocks", "reorder-blocks"])
def test_lost_rows_are_counted_exactly_in_addition_to_faults(kind: str, tmp_path: Path) -> None:
    items = simulate_messages(kind)
    places = [n for n, (key, _) in enumerate(items) if key == PROBES]
    lost_places = {places[n] for n in (3, 14, 17)}
    summary = recorded(tmp_path / "gone.mcap", kind, [item for n, item in enumerate(items) if n not in lost_places])
    assert summary.lost == {PROBES: 3 * 200}
    assert not summary.good


def test_a_client_without_fault_events_reports_losses(tmp_path: Path) -> None:
    items = [item for item in simulate_messages("dropout") if item[0] != wire.FAULTS]
    summary = recorded(tmp_path / "untold.mcap", "dropout", items)
    assert summary.lost == {PROBES: 4000}


@pytest.mark.parametrize("kind", ["dropout", "reorder-blocks", "stale-stamps", "restart"])
def test_fault_events_work_across_files_and_triggers(kind: str, tmp_path: Path) -> None:
    items = simulate_messages(kind)
    summary = recorded(tmp_path / "parts.mcap", kind, items, limits=DiskLimits(rotate_s=0.13))
    assert summary.good
    parts = join(list(summary.files))
    assert len(summary.files) == 4
    assert (parts.doubts, parts.streams[PROBES].lost - parts.streams[PROBES].declared) == ((), 0)
    capture = Capture((Trigger.parse("fault"),), pre_s=0.03, post_s=0.1)
    summary = recorded(tmp_path / "around.mcap", kind, items, capture=capture)
    assert summary.good
    assert Recording.open(summary.files[0]).doubts == ()


def test_a_table_of_rows_has_no_blocks_and_refuses_their_faults(tmp_path: Path) -> None:
    for suffix in ("csv", "wav"):
        with pytest.raises(InputError, match=r"output must be an \.mcap file for a scene with faults of blocks"):
            write_run(Simulation(scene("dropout")), tmp_path / f"x.{suffix}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", BLOCKS)
def test_a_cut_keeps_fault_events_and_uses_true_times(kind: str, tmp_path: Path) -> None:
    write_run(Simulation(scene(kind)), tmp_path / "whole.mcap")
    cut(Recording.open(tmp_path / "whole.mcap"), tmp_path / "part.mcap", from_s=0.15, to_s=0.35)
    part = Recording.open(tmp_path / "part.mcap")
    stream = part.streams[PROBES]
    assert (part.doubts, stream.lost - stream.declared) == ((), 0)
    if kind not in ("dropout", "lose-blocks"):
        assert (stream.rows, stream.first_time_s) == (4000, 0.15)


def test_forged_fault_events_neither_stop_nor_grow_a_receiver() -> None:
    rng, rows = np.random.default_rng(7), Declared()
    odd: list[Any] = [None, True, -1, 1.5, 1e300, 2**62, "", "x", [], {}, [[]], {"a": []}, "9" * 400]
    for n in range(3000):
        sent = [{"index": 0, "tick": 0, "doors": ["zenoh"]}] * int(rng.integers(3))
        block: dict[str, Any] = {"key": f"rig/sensors/x{n}", "row": int(rng.integers(9000)), "rows": 200, "sent": sent}
        document: dict[str, Any] = {"event": "blocks", "blocks": [block]}
        for spoiled in (document, block, *sent[:1]) if n % 2 else ():
            spoiled[str(rng.choice(list(spoiled)))] = odd[int(rng.integers(len(odd)))]
        rows.declare(document)
        rows.take("rig/sensors/x0", wire.Block(0, n, 2e4, 1e6, np.zeros((1, 4), np.int32)))
    assert (rows.received, rows.lost) == ({"rig/sensors/x0": 3000}, {"rig/sensors/x0": 0})
    assert len(rows.faulty) <= 1000


@pytest.mark.parametrize("kind", BLOCKS)
def test_a_validation_uses_the_fault_events_of_blocks(kind: str, tmp_path: Path) -> None:
    """Bit by bit with the events; without them the contradictions are reported, except for delayed blocks."""
    write_run(Simulation(scene(kind)), tmp_path / "a.mcap")
    recording = Recording.open(tmp_path / "a.mcap")
    known = validate(recording)
    assert known.bit_exact
    assert known.good
    removes_blocks = kind in ("dropout", "lose-blocks")
    assert (known.skipped > 0) == removes_blocks
    blind = validate(recording, blind=True)
    assert bool(blind.doubts) == (kind != "late-blocks")
    assert blind.good == (not blind.doubts)
    if removes_blocks:
        assert blind.skipped == known.skipped
        assert f"{known.skipped} of 8000 rows of {PROBES} are missing" in blind.verdict_line


@pytest.mark.parametrize(("from_s", "rows"), [(0.0, 8000), (0.1, 6000), (0.38, 400)])
def test_missing_rows_at_the_end_are_counted(from_s: float, rows: int, tmp_path: Path) -> None:
    """A stream that never begins, or ends before the others: a blind validation has no other evidence."""
    fault = {"at_s": from_s, "channel": "probes", "kind": "dropout"}
    whole = parse_scene({"duration_s": 0.4, "sensors": {"groups": ["probes", "drive"]}, "faults": [fault]})
    write_run(Simulation(whole), tmp_path / "a.mcap")
    found = validate(Recording.open(tmp_path / "a.mcap"), blind=True)
    if rows < _EDGE_ROWS:  # within the loss of a recorder that ends inside a block
        assert found.good
    else:
        assert (found.good, found.skipped) == (False, rows)
        assert f"{rows} of 8000 rows of {PROBES} are missing" in found.verdict_line


_EDGE_ROWS = 1000


@pytest.mark.parametrize("kind", ["stale-stamps", "duplicate-blocks"])
def test_instants_out_of_order_end_in_a_verdict(kind: str, tmp_path: Path) -> None:
    """Spectra need ascending instants: without whirl, only the contradictions are judged."""
    pulse = {"at_s": 0.02, "command": "hammer", "force_n": 120.0}
    fault = {"at_s": 0.5, "command": "fault", "channel": "probes", "for_s": 0.05, "kind": kind, **BLOCKS[kind]}
    whirl = load_scene("hammer", {"duration_s": 0.8, "sensors.groups": ["probes", "drive"], "commands": [pulse, fault]})
    write_run(Simulation(whirl), tmp_path / "a.mcap")
    found = validate(Recording.open(tmp_path / "a.mcap"), blind=True)
    assert not found.good
    assert found.verdict_line.startswith("fail, the recording is inconsistent")
    assert "times of probes do not ascend: no quantity of its motion is judged" in found.doubts
