"""Agreement of each level of the model with other results, and the cost of leaving it out.

| level                         | must agree with                              | because                              |
|-------------------------------|----------------------------------------------|--------------------------------------|
| planar against Euler          | each other, to the square of the tilt        | small-angle theory                   |
| planar, two engines           | each other, to their own error               | one model in two formulations        |
| rigid impacts, drop           | closed form: heights r0-scaled by e^2        | Newton's restitution                 |
| rigid impact, oblique         | closed form: Coulomb impulse, rolled or slid | Coulomb's law on impulses            |
| rigid impacts, ledgers        | zero residual                                | first law                            |
| rigid impacts, whirl          | rolls at R_S spin / r0, force M_eff r0 w^2   | kinematics and centrifugal force     |
| rigid ring                    | a higher peak than on housings               | nothing yields (numerics: +57 %)     |
| fixed bodies of the stator    | transducers transmit the ring's force        | statics                              |
| ideal drive                   | the prescribed spin                          | definition                           |
| lowered levels                | no more steps of the engine                  | omitted parts cost nothing           |
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from rig.physics.engines import ENGINES
from rig.physics.kernels.signals import COLUMN
from rig.run.motion import energy_balance
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

BARE: dict[str, Any] = {
    "sensors.chain": "ideal", "sensors.groups": ["hammer"], "sensors.rate_hz": 1000, "sensors.truth_rate_hz": 1000,
}  # fmt: skip
IMPACT = {"model.contact": "impact", "model.stator": "rigid"}


class Run:
    """A finished run by the simulation, its rows and its parameters."""

    def __init__(self, scene: str, seconds: float, **changes: Any) -> None:
        self.simulation = Simulation(load_scene(scene, {**BARE, **changes}))
        ticks = round(seconds * 1e6)
        self.rows = self.simulation.advance(ticks).rows.copy()
        self.times = np.arange(len(self.rows)) * self.simulation.row_ticks * 1e-6
        self.constants = self.simulation.model.constants

    def __getitem__(self, name: str) -> np.ndarray:
        return self.rows[:, COLUMN[name]]

    @property
    def residual_share(self) -> float:
        return float(self.simulation.health()["energy"]["residual_share"])


def difference(name: str, tilt: float) -> float:
    """Return planar less Euler in free swing from a tilt [rad], at equal tilts relative to it."""
    x_mm = tilt * 197.0
    changes = {
        "initial.position": "given", "initial.x_mm": x_mm, "ring.clearance": 20.0, "ring.offset_y": 0.0,
        "shaft.unbalance_eccentricity": 0.0, "gravity.acceleration": 0.0, "model.magnet": "linear",
        "engine.name": "rk8", "drive.speed_hz": 6.2,
    }  # fmt: skip
    planar = Run("stable-run", 0.05, **changes, **{"model.shaft": "planar"})
    euler = Run("stable-run", 0.05, **changes)
    return float(np.abs(planar[name] - euler[name]).max()) / tilt


def test_planar_differs_from_euler_by_the_square_of_the_tilt() -> None:
    small, large = difference("beta", 0.01), difference("beta", 0.04)
    assert 1.8 < math.log(large / small, 4.0) < 2.2
    assert 0.02 * 0.04**2 < large < 2.0 * 0.04**2


@pytest.mark.parametrize("friction", ["none", "exact"])
def test_planar_model_agrees_on_two_engines(friction: str) -> None:
    planar = {"model.shaft": "planar", "model.friction": friction}
    split = Run("hammer", 0.031, **planar, **{"engine.step_us": 5})
    rk8 = Run("hammer", 0.031, **planar, **{"engine.name": "rk8"})
    assert split["contact_impulse"][-1] > 0.1
    for name, scale in (("Gamma", 5e-3), ("beta", 5e-3), ("theta_rate", 40.0), ("x_ih", 20e-6)):
        assert np.abs(split[name] - rk8[name]).max() < 5e-7 * scale, name
    euler = Run("hammer", 0.031, **{"model.friction": friction, "engine.name": "rk8"})
    assert np.abs(euler["beta"] - rk8["beta"]).max() > 5e-7 * 5e-3


def find_tops(run: Run) -> list[float]:
    """Return the heights between impacts above the ring's lowest point [m]."""
    y = run["ring_y"]
    found = []
    for i in range(1, len(y) - 1):
        if y[i] > y[i - 1] and y[i] >= y[i + 1]:
            slope, bend = 0.5 * (y[i + 1] - y[i - 1]), y[i + 1] - 2.0 * y[i] + y[i - 1]
            found.append(y[i] - 0.5 * slope**2 / bend + run.constants.contact.clearance)
    return found


def test_drop_on_a_rigid_ring_rebounds_by_the_closed_form() -> None:
    run = Run("drop", 0.5, **IMPACT)
    shaft, contact = run.constants.shaft, run.constants.contact
    clearance, e = contact.clearance, contact.restitution
    height = 2.0 * clearance
    found = find_tops(run)
    assert found[:3] == pytest.approx([1.50e-3, 1.215e-3, 0.984e-3], rel=2e-3)
    assert found[:8] == pytest.approx([height * e ** (2 * n) for n in range(1, 9)], rel=1e-3)
    # A pendulum: to the square of the angle the ring's point falls straight, at this rate.
    fall = shaft.mass * shaft.gravity * shaft.arm_centre * shaft.arm_ring / shaft.transverse_inertia
    speed = math.sqrt(2.0 * fall * height)
    assert speed == pytest.approx(0.145, rel=5e-3)
    mass = shaft.transverse_inertia / shaft.arm_ring**2
    impulse = run["contact_impulse"]
    # From the first impact at 25.6 ms up to the second.
    assert impulse[24] == 0.0
    assert impulse[40] == pytest.approx((1.0 + e) * mass * speed, rel=1e-3)
    # Infinitely many bounces end in lasting contact, after v/a (1+e)/(1-e) and the fall.
    rest = speed / fall + 2.0 * e * speed / fall / (1.0 - e)
    assert rest < 0.5
    weight = mass * fall
    # There the compliant law carries it, and it still oscillates slightly.
    assert (impulse[-1] - impulse[-11]) / 0.01 == pytest.approx(weight, rel=1e-2)
    assert run["ring_y"][-1] == pytest.approx(-clearance, abs=1e-6)
    assert run.simulation.health()["contacts"] < 60
    dissipated = float(energy_balance(run.rows, run.rows[0])["dissipated"][-1])
    assert dissipated == pytest.approx(weight * height, rel=1e-3)
    assert abs(run.residual_share) < 1e-6


@pytest.mark.parametrize(("friction", "sticks"), [(0.02, False), (0.25, False), (0.9, True)])
def test_oblique_impact_has_coulombs_impulse(friction: float, *, sticks: bool) -> None:
    """A spinning shaft dropped: w grows or falls by R_S jt / Izz, jt = min(mu jn, the impulse that stops v_t)."""
    e = 0.5
    run = Run(
        "drop", 0.028, **IMPACT,
        **{"drive.speed_hz": 3.0, "contact.friction": friction, "contact.restitution": e, "drive.torque_gain": 1e-5,
           "model.shaft": "planar", "shaft.unbalance_eccentricity": 0.0},
    )  # fmt: skip
    shaft = run.constants.shaft
    fall = shaft.mass * shaft.gravity * shaft.arm_centre * shaft.arm_ring / shaft.transverse_inertia
    speed = math.sqrt(4.0 * fall * run.constants.contact.clearance)
    mass, spin = shaft.transverse_inertia / shaft.arm_ring**2, 2.0 * math.pi * 3.0
    normal = (1.0 + e) * mass * speed
    together = shaft.radius * spin / (1.0 / mass + shaft.radius**2 / shaft.polar_inertia)
    tangential = min(friction * normal, together)
    assert (tangential == together) == sticks
    assert run["contact_impulse"][-1] == pytest.approx(normal, rel=2e-3)
    change = spin - run["theta_rate"][-1]
    assert change == pytest.approx(shaft.radius * tangential / shaft.polar_inertia, rel=3e-3)
    # Less the contribution of the gyroscopic moment before.
    along = np.diff(run["ring_x"]) / 1e-3
    assert abs(along[26] - along[24]) == pytest.approx(tangential / mass, rel=0.02, abs=1e-3)
    assert abs(run.residual_share) < 1e-4


def measure_whirl(run: Run) -> float:
    """Return the frequency of the last 0.2 s [Hz], from the slope of the phase."""
    phase = np.unwrap(np.arctan2(run["ring_y"], run["ring_x"]))[-200:]
    return float(np.polyfit(run.times[-200:], phase, 1)[0]) / (2.0 * math.pi)


def test_rigid_impacts_whirl_by_the_kinematics() -> None:
    run = Run("hammer", 1.0, **IMPACT)
    # In lasting contact, the compliant law penetrates as far as the force requires.
    shaft, clearance = run.constants.shaft, run.constants.contact.clearance
    radius = np.hypot(run["ring_x"], run["ring_y"])[-200:]
    depth = float(np.mean(run["penetration"][-200:]))
    assert 1e-6 < depth < 2e-5
    assert radius.mean() == pytest.approx(clearance + depth, abs=1e-7)
    spin = (run["theta"][-1] - run["theta"][-200]) / (run.times[-1] - run.times[-200]) / (2.0 * math.pi)
    frequency = measure_whirl(run)
    assert frequency == pytest.approx(-spin * shaft.radius / radius.mean(), rel=1e-3)
    impulse = run["contact_impulse"]
    force = (impulse[-1] - impulse[-200]) / (run.times[-1] - run.times[-200])
    mass = shaft.transverse_inertia / shaft.arm_ring**2
    centrifugal = mass * radius.mean() * (2.0 * math.pi * frequency) ** 2
    assert force == pytest.approx(centrifugal, rel=0.02)  # magnets and gyroscopic moment left out
    assert abs(run.residual_share) < 1e-3
    # Rolling: nothing slides once it whirls.
    assert np.abs(run["sliding_speed"][-200:]).max() < 0.02 * shaft.radius * spin * 2.0 * math.pi


def test_rigid_ring_hits_harder_and_whirls_faster() -> None:
    housings, rigid = Run("hammer", 1.0), Run("hammer", 1.0, **{"model.stator": "rigid"})
    impacts = Run("hammer", 1.0, **IMPACT)
    peaks = [run.simulation.health()["peak_normal_force_n"] for run in (housings, rigid)]
    assert peaks[1] / peaks[0] == pytest.approx(1.57, abs=0.06)
    f = [measure_whirl(run) for run in (housings, rigid, impacts)]
    assert 1.001 < f[1] / f[0] < 1.006
    assert f[2] == pytest.approx(f[1], rel=2e-4)  # the same law once it rolls
    # An impact has no force; the contact that lasts has.
    assert 400.0 < impacts.simulation.health()["peak_normal_force_n"] < peaks[1]


@pytest.mark.parametrize("stator", ["rigid", "inner-house"])
@pytest.mark.parametrize("engine", ["split", "rk8"])
def test_fixed_bodies_pass_the_force_on(stator: str, engine: str) -> None:
    run = Run("hammer", 0.6, **{"model.stator": stator, "engine.name": engine})
    force = run["normal_force"][-200:]
    assert force.min() > 100.0
    across, upright = (run["P_E"] - run["P_W"])[-200:], (run["P_N"] - run["P_S"])[-200:]
    nx, ny = (run[name][-200:] / np.hypot(run["ring_x"], run["ring_y"])[-200:] for name in ("ring_x", "ring_y"))
    friction = run["friction_force"][-200:]
    load_x, load_y = force * nx - friction * ny, force * ny + friction * nx
    if stator == "rigid":
        assert np.abs(across - load_x).max() < 1e-6 * np.abs(load_x).max()
        assert np.abs(upright - load_y).max() < 1e-6 * np.abs(load_y).max()
        assert not run.rows[:, [COLUMN[name] for name in ("x_ih", "y_ih", "x_oh", "y_oh")]].any()
    else:
        house = run.constants.house
        beam = house.inner_beam_stiffness * run["x_ih"] + house.inner_beam_damping * run["vx_ih"]
        assert np.abs(across - beam[-200:]).max() < 1e-6 * np.abs(across).max()
        assert not run.rows[:, [COLUMN[name] for name in ("x_oh", "y_oh")]].any()
    assert abs(run.residual_share) < ENGINES[engine].energy


def test_ideal_drive_keeps_the_spin() -> None:
    run = Run("hammer", 0.3, **{"drive.mode": "ideal", "model.shaft": "planar"})
    assert run["contact_impulse"][-1] > 1.0
    assert np.abs(run["theta_rate"] - 2.0 * math.pi * 6.2).max() < 1e-9


@pytest.mark.parametrize(
    "lowered",
    [{"model.magnet": "linear"}, {"model.shaft": "planar"}, {"model.stator": "rigid"}],
)
def test_a_lower_level_needs_no_more_steps(lowered: dict[str, str]) -> None:
    # With one method: split's steps are of several kinds.
    changes = {"engine.name": "taylor"}
    full, less = (Run("hammer", 0.5, **changes, **more).simulation.health()["steps"] for more in ({}, lowered))
    assert less < 1.2 * full  # other contacts, about as many
