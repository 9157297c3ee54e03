"""Kind of the shaft's motion in the status: free, impacts, resting or whirl."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import rig
from rig.cli.commands.run import status_parts
from rig.cli.output.display import motion_text
from rig.physics.kernels.signals import COLUMN, N_ROW
from rig.run.motion import WATCHED_S, MotionWatch
from rig.run.offline import frames


def watch(penetration: np.ndarray, angle: np.ndarray, rate_hz: float) -> Any:
    """Return the motion of rows in blocks of 10 ms, with this penetration and angle of the shaft in the ring."""
    rows = np.zeros((len(angle), N_ROW))
    rows[:, COLUMN["penetration"]] = penetration
    rows[:, COLUMN["ring_x"]], rows[:, COLUMN["ring_y"]] = np.cos(angle), np.sin(angle)
    watched = MotionWatch(rate_hz)
    for block in np.array_split(rows, round(len(rows) / rate_hz / 0.01)):
        watched.add(block)
    return watched.document()


@pytest.mark.parametrize("whirl_hz", [-83.7, -0.9 / WATCHED_S, 12.0])
def test_lasting_contact_that_travels_around_is_a_whirl(whirl_hz: float) -> None:
    times_s = np.arange(20_000) / 20_000
    motion = watch(np.full(len(times_s), 1e-6), 2.0 * np.pi * whirl_hz * times_s, 20_000.0)
    assert motion["kind"] == ("forward whirl" if whirl_hz > 0.0 else "backward whirl")
    assert motion["whirl_hz"] == pytest.approx(whirl_hz, rel=1e-9)


def test_lasting_contact_at_one_place_is_rest() -> None:
    assert watch(np.full(5000, 1e-6), np.full(5000, -1.5), 10_000.0)["kind"] == "resting"


def test_impacts_are_counted_once_also_across_blocks() -> None:
    penetration = np.full(10_000, -1e-6)
    for start in range(95, 10_000, 400):  # 12 rows of contact, some of them across the end of a block
        penetration[start : start + 12] = 1e-6
    motion = watch(penetration, np.zeros(10_000), 10_000.0)
    assert motion == {"kind": "impacts", "whirl_hz": None, "impacts_hz": pytest.approx(25.0, rel=0.05)}
    assert motion_text(motion).startswith("impacts, 2")


def test_only_the_last_quarter_of_a_second_counts() -> None:
    penetration = np.full(10_000, -1e-6)
    penetration[:7_400] = 1e-6
    assert watch(penetration, np.zeros(10_000), 10_000.0)["kind"] == "free"


def test_a_hammer_impact_leads_from_free_motion_over_impacts_to_the_whirl_of_the_probes() -> None:
    simulation = rig.Simulation(rig.load_scene("hammer", {"commands": [], "duration_s": 1.6}))
    assert simulation.health()["motion"] is None
    simulation.advance(20_000)
    assert simulation.health()["motion"]["kind"] == "free"
    simulation.submit("hammer", {})
    simulation.advance(20_000)
    assert simulation.health()["motion"]["kind"] == "impacts"
    restored = rig.Simulation(simulation.scene)
    restored.restore(simulation.snapshot())
    last = [frame.samples["probes"] for frame in frames(simulation)][-3:]
    motion = simulation.health()["motion"]
    x, y = np.concatenate([each.values for each in last])[:, 2:4].T * 1.0
    hz = rig.whirl_frequency(x, y, np.arange(len(x)) / 20_000)
    assert motion["kind"] == "backward whirl"
    assert motion["whirl_hz"] == pytest.approx(-abs(hz), rel=2e-3)
    for _ in frames(restored):
        pass
    assert restored.health()["motion"] == motion
    status = {"end_s": None, "spin_hz": 6.1, "devices": [], "real_time_factor": 1.0, "time_s": 1.0, "motion": motion}
    status["lateness_ms"] = dict.fromkeys(("p50", "p99", "max", "last"), 0.0)
    assert f"backward whirl at {-motion['whirl_hz']:.1f} Hz" in status_parts(status)
