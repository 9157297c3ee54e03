"""The client of a rig: the same program on a rig in lockstep receives the same rows, and follows the shaft's
rotation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

import rig
from drivers.client import NotSeenError, Rig
from drivers.sources.samples import StreamEndedError
from rig.base.errors import InputError, UnknownNameError
from tests import processes
from tests.waiting import PATIENCE_S

CHANNELS = ("disk_x", "disk_y", "keyphasor")


@contextmanager
def running(pace: str = "lockstep") -> Iterator[str]:
    changes = ("--pace", pace, "--set", "drive.speed_hz=12", "--set", "commands=[]")
    with processes.running_rig("hammer", *changes) as (_, endpoint):
        yield f"zenoh:{endpoint}"


@contextmanager
def connected(pace: str = "lockstep", **settings: Any) -> Iterator[Rig]:
    with running(pace) as url, rig.connect(url, wait_s=PATIENCE_S, **settings) as machine:
        yield machine


@pytest.fixture(scope="module")
def unstepped() -> Iterator[str]:
    """URL of a rig that no test steps."""
    with running() as url:
        yield url


def test_a_program_reads_the_rows_of_the_model() -> None:
    with connected(channels=CHANNELS, truth=["contact"]) as machine:
        before = machine.advance(0.3)
        assert (before.index, len(before), before.gap) == (0, 6000, 0)
        pulse = machine.hammer(force_n=150.0)
        assert pulse.tick == 300_000  # at the row after the last one read, whatever had been sent
        hit = machine.until(lambda rows: np.hypot(rows["disk_x"], rows["disk_y"]) > 1.2, within_s=0.5)
        assert machine.event("hammer")["tick"] == pulse.tick
        assert 0 <= machine.note("1.2 mm").tick - hit.tick <= 10_000, "a command takes effect at the end of the block"
        behind = machine.advance(0.01)
        assert behind.index == hit.index + 1
        contact = machine.truth("contact", to_s=0.4)
        with pytest.raises(NotSeenError, match=r"no sample met the condition from 0\.\d+ to 0\.\d+ s"):
            machine.until(lambda rows: rows["disk_x"] > 99.0, within_s=0.1)
        with pytest.raises(NotSeenError, match="no such event in 0 s; received instead: "):
            machine.event("nothing", timeout_s=0.0)
        with pytest.raises(InputError, match="condition must be one boolean per sample"):
            machine.until(lambda rows: True, within_s=0.1)
        machine.stop()
        with pytest.raises(StreamEndedError, match="stopped"):
            machine.advance(1.0)
    command = {"at_s": 0.3, "command": "hammer", "force_n": 150.0, "duration_ms": 5.0, "direction": "x"}
    run = rig.simulate("hammer", {"drive.speed_hz": 12.0, "commands": [command], "duration_s": 0.5})
    np.testing.assert_array_equal(before["disk_x"], run.samples["disk_x"][:6000])
    np.testing.assert_array_equal(behind["disk_y"], run.samples["disk_y"][behind.index :][:200])
    deflection = np.hypot(run.samples["disk_x"], run.samples["disk_y"])
    assert hit.index == int(np.argmax(deflection > 1.2))
    assert hit.time_s == hit.index / 20_000.0
    assert contact["normal_force"].max() > 0.0


def test_turns_are_those_of_the_shaft() -> None:
    with connected(channels=CHANNELS) as machine:
        turns = []
        for turn in machine.turns():
            turns.append(turn)
            if len(turns) == 4:
                break
        next_row = machine.advance(1e-3).index
        assert not any(machine.daq.lost.values())
    assert next_row == turns[-1].samples.index + len(turns[-1].samples)
    for turn in turns:
        assert turn.speed_hz == pytest.approx(12.0, rel=2e-3)
        x, times_s = turn.samples["disk_x"], turn.samples.times_s
        assert turn.peak_to_peak["disk_x"] == np.ptp(x)
        assert turn.gap["disk_x"] == pytest.approx(x.mean())
        # The same by the closed form of a Fourier coefficient over the turn.
        angle = 2.0 * math.pi * (times_s - turn.begin_s) * turn.speed_hz
        one_x = 2.0 * np.mean(x * np.exp(-1j * angle))
        assert abs(turn.synchronous["disk_x"] - one_x) < 0.02 * abs(one_x) + 1e-4
    with pytest.warns(DeprecationWarning, match=r"^Turn\.once is Turn\.synchronous now$"):
        assert turns[0].once == turns[0].synchronous


def test_rows_read_between_turns_belong_to_no_turn() -> None:
    with connected(channels=CHANNELS, buffer_s=0.5) as machine:
        speeds = []
        for turn in machine.turns():
            speeds.append(turn.speed_hz)
            assert len(machine.advance(0.7)) == 14_000  # more than one buffer
            if len(speeds) == 2:
                break
        assert speeds == pytest.approx([12.0, 12.0], rel=2e-3)
        with pytest.raises(InputError, match="condition must be one boolean per sample"):
            machine.until(lambda rows: rows["disk_x"], within_s=0.1)


def test_rows_removed_by_a_fault_end_a_piece_and_the_next_reports_the_gap() -> None:
    with connected(channels=["disk_x"]) as machine:
        machine.advance(0.1)
        machine.fault("probes", "dropout", for_s=0.2)
        rest = machine.advance(0.5)
        assert rest.gap == 4000
        assert rest.times_s[0] == pytest.approx(0.3)
        assert machine.until(lambda rows: rows["disk_x"] < 99.0, within_s=0.1).index == rest.index + len(rest)


@pytest.mark.parametrize(("settings", "says"), [
    ({"channels": "disk_x"}, "channels must be a list of names"),
    ({"channels": ["disk_x"], "buffer_s": -1.0}, "buffer_s must be greater than 0"),
    ({"channels": ["disk_z"]}, "channel must be one of the source's"),
    ({"channels": ["disk_x"], "truth": ["contacts"]}, "truth must be one of the rig's tables, such as contact"),
    ({"channels": ["disk_x"], "rate_hz": 3000.0}, "rate_hz must be 20000 divided by a whole number"),
])  # fmt: skip
def test_impossible_client_settings_are_refused(settings: dict[str, Any], says: str, unstepped: str) -> None:
    with (
        pytest.raises((InputError, UnknownNameError)) as caught,
        rig.connect(unstepped, wait_s=PATIENCE_S, **settings),
    ):
        pass
    assert says in str(caught.value)


def test_reading_without_channels_is_refused(unstepped: str) -> None:
    with rig.connect(unstepped, wait_s=PATIENCE_S) as machine:
        with pytest.raises(InputError, match=r"channels must be given to rig\.connect"):
            machine.advance(0.1)
        with pytest.raises(UnknownNameError, match="table must be a table named in `truth`"):
            machine.truth("contact")


def test_blocks_of_a_rig_in_real_time_are_read_until_it_ends() -> None:
    with connected("real-time", channels=["disk_x", "P_E"]) as machine:
        rows, first = 0, None
        for samples in machine.blocks():
            first = samples.index if first is None else first
            assert (samples.index, samples.gap) == (first + rows, 0)
            rows += len(samples)
            if rows == 4000:
                machine.stop()
        assert rows >= 4000
        assert machine.status()["devices"] == []
