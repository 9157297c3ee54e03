"""Recorder acceptance: what a kill and a full disk leave of a recording.

The recorder that ships: put your own commands in the place of these.
"""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Sequence

import pytest

from replays.campaigns.equipment.bench import Bench
from replays.campaigns.equipment.device import Device
from replays.campaigns.equipment.process import Program
from replays.campaigns.equipment.record import Record
from replays.score.card.scorecard import FAIL
from replays.score.judgement import judge
from rig.base.errors import InputError
from rig.serve.waiting import Deadline

RECORDER = "python -m rig record --connect {url} --history -o {folder}/daq.mcap"
RECOVER = "python -m rig recover {folder}/daq.mcap.part"
"""What makes a file that reads of what is left; empty where it reads as it is."""
WRITTEN = "daq.mcap.part"
"""What it writes to: once that is there, it records."""
LEFT = "daq.recovered.mcap"
"""The file that is judged then, of any format that `rig import` reads."""
TOLD = ("disk", "space", "too large")
"""Words of which one stands in the line that says why it ended."""

SCENE = "test-sine"
WRITE_S = 2.0
"""What a recorder may take to bring rows to the disk, of the wall clock, on a machine that is busy [s]."""
DISK_BYTES = 1 << 20
"""Largest size of a file on the disk that is full [bytes]."""
_END_S = 60.0
"""Longest that is waited for what has to end by itself [s]."""

Start = Callable[..., Device]
Measure = Callable[..., float]


def start(dut: Start, record: Record, command: str | Sequence[str]) -> Device:
    """The recorder under test, once it records."""
    recorder = dut(command, name="recorder", joins=False)
    for _ in Deadline(_END_S).polls():
        if (record.path.parent / WRITTEN).exists():
            return recorder
        recorder.check_running()
    raise AssertionError(f"it has not begun {WRITTEN}")


def lost_s(record: Record, measure: Measure, until_s: float) -> float:
    """What is missing at the end of what was sent before a time [s]; what is there is held against what was sent."""
    sent, folder = record.stop(), record.path.parent
    if RECOVER:
        program = Program([word.format(folder=folder) for word in shlex.split(RECOVER)], folder / "recover.log")
        status = program.wait(_END_S)
        program.end()
        assert status == 0, f"it cannot be read: {program.last_line}"
    try:
        card = judge(folder / LEFT, [part.path for part in sent.parts], path="digital")
    except InputError as error:
        pytest.fail(str(error), pytrace=False)
    bad = [row for row in card.rows if row.verdict == FAIL]
    measure("rows missing, doubled, swapped or altered in what is there", len(bad), "1", "==", 0)
    behind = max(float(row.value) for row in card.rows if row.quantity == "rows after the last")
    last = sent.samples("disk_x")
    return round(behind / last.rate_hz - (float(last.times_s[-1]) + 1.0 / last.rate_hz - until_s), 9)


@pytest.mark.bench(scene=SCENE)
def test_a_kill_takes_nothing_that_was_sent_long_enough_before(
    bench: Bench, dut: Start, record: Record, measure: Measure
) -> None:
    """In lockstep: the rig stands still for as long as the recorder may take, so that it is exact."""
    recorder = start(dut, record, RECORDER)
    bench.advance_to(1.0)
    time.sleep(WRITE_S)
    recorder.program.kill()
    bench.advance_to(1.5)
    lost = lost_s(record, measure, 1.0)
    measure("lost of what it had two seconds to write", lost, "s", "==", 0.0)


@pytest.mark.bench(scene=SCENE, pace="real-time")
def test_a_kill_in_the_middle_takes_the_last_rows_alone(
    bench: Bench, dut: Start, record: Record, measure: Measure
) -> None:
    """In real time, where rows go on coming until it is killed."""
    recorder = start(dut, record, RECORDER)
    begun_s = bench.status()["time_s"]
    bench.advance_to(begun_s + 3.3)
    recorder.program.kill()
    killed_s = bench.status()["time_s"]
    bench.advance_to(killed_s + 0.2)
    lost = lost_s(record, measure, killed_s)
    measure("lost before the kill", lost, "s", "<=", WRITE_S, source="assumed; `rig record` promises 0.5 s")


@pytest.mark.bench(scene=SCENE)
def test_a_full_disk_ends_it_with_a_reason_and_what_is_there_reads(
    bench: Bench, dut: Start, record: Record, measure: Measure
) -> None:
    """A limit on the size of files stands for the disk; the signal that would tell of it is ignored, as on a disk."""
    limit = f"trap '' XFSZ; ulimit -f {DISK_BYTES // 512}; exec \"$@\""
    recorder = start(dut, record, ["sh", "-c", limit, "sh", *shlex.split(RECORDER)])
    bench.advance_to(3.0)
    status = recorder.program.wait(_END_S)
    assert status is not None, "it goes on, with a disk that is full"
    measure("exit status", status, "1", "between", (1, 127), source="0 would be all that was to be recorded")
    said = recorder.program.said().splitlines()
    measure("tracebacks", sum("Traceback" in line for line in said), "1", "==", 0)
    measure("lines that say why", sum(any(word in line for word in TOLD) for line in said), "1", ">=", 1)
    assert lost_s(record, measure, 3.0) > 0.0, "the disk was not full"
