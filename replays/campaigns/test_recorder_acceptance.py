"""Recorder acceptance: what survives of a recording after a kill and on a full disk.

Tests the recorder of this package; replace these commands by your own recorder's.
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

RECORD_COMMAND = "python -m rig record --connect {url} --history -o {folder}/daq.mcap"
RECOVER_COMMAND = "python -m rig recover {folder}/daq.mcap.part"
"""Command that makes the remaining file readable; empty if it can be read as it is."""
OUTPUT_FILE = "daq.mcap.part"
"""File that the recorder writes to; it exists once recording has begun."""
JUDGED_FILE = "daq.recovered.mcap"
"""File that is judged afterwards, in any format that `rig import` reads."""
REASONS = ("disk", "space", "too large")
"""Words, one of which must be in the line that reports the reason for the end."""

SCENE = "test-sine"
WRITE_S = 2.0
"""Longest delay between receiving samples and writing them to disk, in wall-clock time on a busy machine [s]."""
DISK_BYTES = 1 << 20
"""Largest file size on the simulated full disk [bytes]."""
_END_S = 60.0
"""Longest wait for a program to end [s]."""

Start = Callable[..., Device]
Measure = Callable[..., float]


def start(dut: Start, command: str | Sequence[str]) -> Device:
    """Start the recorder under test and return it once it records."""
    recorder = dut(command, name="recorder", joins=False)
    for _ in Deadline(_END_S).polls():
        if (recorder.folder / OUTPUT_FILE).exists():
            return recorder
        recorder.check_running()
    raise AssertionError(f"the recorder did not create {OUTPUT_FILE}")


def lost_s(recorder: Device, record: Record, measure: Measure, until_s: float) -> float:
    """Return the length missing at the end of the data sent before a time [s]; compare the rest with the data sent."""
    sent, folder = record.stop(), recorder.folder
    if RECOVER_COMMAND:
        program = Program([word.format(folder=folder) for word in shlex.split(RECOVER_COMMAND)], folder / "recover.log")
        status = program.wait(_END_S)
        program.end()
        assert status == 0, f"the file cannot be recovered: {program.last_line}"
    try:
        card = judge(folder / JUDGED_FILE, [part.path for part in sent.parts], path="digital")
    except InputError as error:
        pytest.fail(str(error), pytrace=False)
    bad = [row for row in card.rows if row.verdict == FAIL]
    measure("samples missing, doubled, swapped or altered in the file", len(bad), "1", "==", 0)
    behind = max(float(row.value) for row in card.rows if row.quantity == "rows after the last")
    last = sent.samples("disk_x")
    return round(behind / last.rate_hz - (float(last.times_s[-1]) + 1.0 / last.rate_hz - until_s), 9)


@pytest.mark.bench(scene=SCENE)
def test_a_kill_takes_nothing_that_was_sent_long_enough_before(
    bench: Bench, dut: Start, record: Record, measure: Measure
) -> None:
    """Test in lockstep: the rig waits while the recorder writes, so the comparison is exact."""
    recorder = start(dut, RECORD_COMMAND)
    bench.advance_to(1.0)
    time.sleep(WRITE_S)
    recorder.program.kill()
    bench.advance_to(1.5)
    lost = lost_s(recorder, record, measure, 1.0)
    measure("lost although two seconds were left to write it", lost, "s", "==", 0.0)


@pytest.mark.bench(scene=SCENE, pace="real-time")
def test_a_kill_in_the_middle_takes_the_last_rows_alone(
    bench: Bench, dut: Start, record: Record, measure: Measure
) -> None:
    """Test in real time: samples arrive until the recorder is killed."""
    recorder = start(dut, RECORD_COMMAND)
    begun_s = bench.status()["time_s"]
    bench.advance_to(begun_s + 3.3)
    recorder.program.kill()
    killed_s = bench.status()["time_s"]
    bench.advance_to(killed_s + 0.2)
    lost = lost_s(recorder, record, measure, killed_s)
    measure("lost before the kill", lost, "s", "<=", WRITE_S, source="assumed; `rig record` guarantees 0.5 s")


@pytest.mark.bench(scene=SCENE)
def test_a_full_disk_ends_it_with_a_reason_and_what_is_there_reads(
    bench: Bench, dut: Start, record: Record, measure: Measure
) -> None:
    """Simulate a full disk by a limit on file sizes; its signal is ignored, since a disk sends none."""
    limit = f"trap '' XFSZ; ulimit -f {DISK_BYTES // 512}; exec \"$@\""
    recorder = start(dut, ["sh", "-c", limit, "sh", *shlex.split(RECORD_COMMAND)])
    bench.advance_to(3.0)
    status = recorder.program.wait(_END_S)
    recorder.program.end()  # its exit status is judged here
    assert status is not None, "the recorder continues although the disk is full"
    measure("exit status", status, "1", "between", (1, 127), source="0 would mean a complete recording")
    lines = recorder.program.read_output().splitlines()
    measure("tracebacks", sum("Traceback" in line for line in lines), "1", "==", 0)
    measure("lines that report the reason", sum(any(word in line for word in REASONS) for line in lines), "1", ">=", 1)
    assert lost_s(recorder, record, measure, 3.0) > 0.0, "the disk was not full"
