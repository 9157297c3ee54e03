"""The paper's runs against closed forms.

| what                                  | agrees with                                                        |
| ---                                   | ---                                                                |
| time and speed of the drop's impact   | a body about a pivot that falls through 2 r0                       |
| impulse of the ring over a whole drop | the weight's, from release to rest                                 |
| impulse of the first contact          | between (1+e) v times the reduced mass and the whole one           |
| rebounds of the drop, rigid housing   | e^2 of the height before, less the weight's part in the contact    |
| whirl frequency                       | -Omega R_S / (r0 + delta), delta by Hertz at m r (w^2 - w_n^2)     |
| force in the whirl, rigid ring        | m r (w^2 - w_n^2), what bends the path                             |
| slowest whirl that friction speeds up | w_n [zeta/mu + sqrt(1 + (zeta/mu)^2)], eq. 43                      |
| least friction that keeps up whirl    | the same, solved for mu; with the housings' loss in the full rig   |
| what whirl costs the housings         | forced vibration of two masses on a line                           |
| swing of the friction in rolling      | m w^2 |X - Y|/2 of the ring's ellipse                              |
| spin kept from slipping to rolling    | I_zz spin + m R_S v is kept; of a slip from rest I_zz/(I_zz+m R_S^2) |
| time from slipping to rolling         | mu (w^2 - w_n^2) = w', integrated by quadrature                    |
| decay of a free shaft                 | zeta of eq. 10's D on I_xx/l_0B^2, not on M                        |
| line of the unbalance in whirl        | M eps spin^2 l_0I/l_0A over m r w^2, rigid ring and held drive      |
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest

from replays.studies.paper.findings import conditions
from replays.studies.paper.open_questions import compute_fall, restitution, ring_weight
from replays.studies.paper.reproduction import bare_drop, drop_impact, drop_impulse, drop_rebounds
from replays.studies.paper.scans import condition
from replays.studies.paper.scans.pulse import Pulse, PulseRun, outcome
from replays.studies.stability.trials.motion import base_model, move, quiet_inputs, state
from rig.physics.levels import ModelLevels
from rig.physics.parameters import load_parameters
from rig.run.offline import Run, simulate
from rig.run.scenes import load_scene

P = load_parameters("corrected")
MASS = P["shaft.transverse_inertia"] / P["shaft.arm_ring"] ** 2
STIFFNESS = P["magnet.stiffness"] * (P["shaft.arm_magnet"] / P["shaft.arm_ring"]) ** 2
R0, RS = P["ring.clearance"], P["shaft.radius"]
K = base_model(ModelLevels()).constants.contact.stiffness
"""Hertz's, of the internal sphere; tested against its formula with the contact laws."""
DAMPING = (
    (P["shaft.damping_ratio_x"] + P["shaft.damping_ratio_y"])
    * math.sqrt(P["magnet.stiffness"] * P["shaft.mass"])
    * (P["shaft.arm_magnet"] / P["shaft.arm_ring"]) ** 2
)
"""Mean of 2 zeta sqrt(K M) in x and in y, referred to the ring [N s/m]."""


@cache
def drop(parameters: str) -> Run:
    changes = {"parameters": parameters, "duration_s": 0.5, "sensors.chain": "ideal", "sensors.groups": ["hammer"]}
    return simulate(load_scene("drop", changes))


@cache
def held(speed_hz: float, stator: str = "two-houses") -> PulseRun:
    changes = {"drive.mode": "ideal", "model.stator": stator}
    return outcome(Pulse(changes=changes, speed_hz=speed_hz, force_n=150.0))


def solve_rolling(speed_hz: float) -> tuple[float, float]:
    """Return whirl frequency [rad/s] and penetration [m], found as a root."""

    def residual(depth: float) -> float:
        whirl = 2 * math.pi * speed_hz * RS / (R0 + depth)
        return K * depth**1.5 - (R0 + depth) * (MASS * whirl**2 - STIFFNESS)

    from scipy.optimize import brentq

    root: Any = brentq(residual, 1e-9, 1e-4, xtol=1e-15)
    depth = float(root)
    return 2 * math.pi * speed_hz * RS / (R0 + depth), depth


@pytest.mark.parametrize("parameters", ["as-printed", "corrected"])
def test_drop_reaches_the_ring_as_a_body_falls(parameters):
    acceleration = P["shaft.mass"] * 9.81 * P["shaft.arm_centre"] * P["shaft.arm_ring"] / P["shaft.transverse_inertia"]
    time_s, speed = drop_impact(drop(parameters))
    assert time_s == pytest.approx(math.sqrt(4 * R0 / acceleration), rel=1e-4)
    assert speed == pytest.approx(math.sqrt(4 * R0 * acceleration), rel=1e-4)
    assert compute_fall(drop(parameters).simulation.model.constants) == pytest.approx((time_s, speed), rel=1e-4)
    assert (time_s, speed) == (pytest.approx(25.6e-3, abs=0.05e-3), pytest.approx(0.145, abs=0.001))


@pytest.mark.parametrize("parameters", ["as-printed", "corrected"])
def test_ring_returns_the_momentum_of_the_weight(parameters):
    run = drop(parameters)
    weight = P["shaft.mass"] * 9.81 * P["shaft.arm_centre"] / P["shaft.arm_ring"]
    assert run["contact_impulse"][-1] == pytest.approx(weight * run.times_s[-1], rel=1e-3)
    assert ring_weight(run.simulation.model.constants) == pytest.approx(weight, rel=1e-12)


@pytest.mark.parametrize("parameters", ["as-printed", "corrected"])
def test_first_contact_of_the_drop_is_between_a_free_and_a_fixed_house(parameters):
    speed, e = drop_impact(drop(parameters))[1], P["contact.restitution"]
    reduced = MASS * P["house.inner_mass"] / (MASS + P["house.inner_mass"])
    assert (1 + e) * speed * reduced < drop_impulse(drop(parameters)) < (1 + e) * speed * MASS


@pytest.mark.parametrize(("parameters", "e"), [("corrected", 0.9), ("as-printed", 0.9132)])
def test_rebounds_of_the_drop_have_the_heights_of_the_restitution(parameters, e):
    run = bare_drop({"parameters": parameters, "model.stator": "rigid"})
    heights = drop_rebounds(run)
    assert restitution(run) == pytest.approx(e, abs=1e-4)
    assert [heights[0], *(heights[1:5] / heights[:4])] == pytest.approx([e**2] * 5, rel=6e-3)
    stiff = bare_drop({"parameters": parameters, "model.stator": "rigid", "contact.stiffness": 100.0 * K})
    assert drop_rebounds(stiff)[0] == pytest.approx(e**2, rel=1e-3)
    # The housings take the momentum: the shaft passes on downward and is thrown back later.
    assert drop_rebounds(drop(parameters))[0] < 0.3 * e**2


@pytest.mark.parametrize("speed_hz", [3.2, 6.2, 9.0])
def test_whirl_frequency_agrees_with_rolling(speed_hz):
    whirl, depth = solve_rolling(speed_hz)
    assert held(speed_hz).outcome == "backward whirl"
    assert held(speed_hz).whirl_hz == pytest.approx(-whirl / (2 * math.pi), rel=1e-3)
    own, own_depth = condition.rolling_whirl(base_model(ModelLevels()).constants, 2 * math.pi * speed_hz)
    assert (own, own_depth) == pytest.approx((-whirl, depth), rel=1e-9)


@pytest.mark.parametrize("speed_hz", [3.2, 6.2])
def test_force_in_whirl_bends_the_path(speed_hz):
    whirl, depth = solve_rolling(speed_hz)
    force = (R0 + depth) * (MASS * whirl**2 - STIFFNESS)
    # The magnets harden, and the shaft sags 3.4 mm into them: about 1 N more stiffness than at their centre.
    assert held(speed_hz, "rigid").normal_n == pytest.approx(force, rel=1.5e-2)


@pytest.mark.parametrize("mu", [0.08, 0.3])
def test_slowest_whirl_accelerated_by_friction(mu):
    natural = math.sqrt(STIFFNESS / MASS)
    ratio = DAMPING / (2 * MASS * natural)
    closed = natural * (ratio / mu + math.sqrt(1 + (ratio / mu) ** 2))
    (found,) = condition.start_thresholds((mu,))
    assert found.bare * 2 * math.pi == pytest.approx(closed, rel=3e-3)
    assert found.closed * 2 * math.pi == pytest.approx(closed, rel=1e-12)


@pytest.mark.parametrize("spin_hz", [6.2, 9.0])
def test_minimum_friction_for_whirl(spin_hz):
    whirl, depth = solve_rolling(spin_hz)
    normal, drag = (R0 + depth) * (MASS * whirl**2 - STIFFNESS), DAMPING * (R0 + depth) * whirl
    (found,) = condition.sustain_thresholds((spin_hz,))
    assert found.bare == pytest.approx(drag / normal, rel=5e-3)
    assert found.closed == pytest.approx(drag / normal, rel=1e-6)
    # The housings take a share of it. In moving housings the force is higher, and their loss grows with its square.
    assert found.full == pytest.approx(found.with_houses, rel=0.07)
    assert found.full == pytest.approx(found.used[0], rel=0.03)
    # It rolls through the whole turn only with far more friction.
    assert found.used[1] > 2.0 * found.full


def test_start_and_sustain_have_the_same_condition():
    own = condition.oscillator(base_model(ModelLevels()).constants)
    for mu in (0.01, 0.1, 0.4):
        assert condition.least_friction(own, condition.critical_whirl(own, mu)) == pytest.approx(mu, rel=1e-12)
    assert math.isinf(condition.least_friction(own, 0.99 * own.natural))


def test_house_loss_agrees_with_forced_vibration():
    constants, spin = base_model(ModelLevels()).constants, 2 * math.pi * 6.2
    whirl, depth = condition.rolling_whirl(constants, spin)
    begun = condition.settle_rolling(constants, spin)
    run = move("split", constants, quiet_inputs(spin=spin, magnets=True, ideal=True), begun, ticks=500_000, every=100)
    lost = run.column("house_loss")
    power = (lost[-1] - lost[0]) / (run.times[-1] - run.times[0])
    own = condition.oscillator(constants)
    radius = constants.contact.clearance + depth
    extra = condition.friction_with_houses(constants, spin) - condition.least_friction(own, -whirl)
    force = condition.normal_force(own, whirl, radius)
    # The closed form uses the force on a rigid ring. In a moving ring it is higher, and power grows with its square.
    higher = (float(np.mean(run.column("normal_force"))) / force) ** 2
    assert power == pytest.approx(extra * force * radius * -whirl * higher, rel=0.02)


@pytest.mark.parametrize(("stator", "share"), [("two-houses", 1.0), ("rigid", 0.0)])
def test_friction_varies_with_the_ellipse_of_the_ring(stator, share):
    """Equal damping in x and y, no weight, no unbalance: the housings alone cause the swing at twice the whirl
    frequency.
    """
    constants, spin = base_model(ModelLevels(stator=stator)).constants, 2 * math.pi * 9.0
    damping = 0.5 * (constants.magnet.damping_x + constants.magnet.damping_y)
    constants = constants._replace(
        shaft=constants.shaft._replace(unbalance=0.0, gravity=0.0),
        magnet=constants.magnet._replace(damping_x=damping, damping_y=damping),
        contact=constants.contact._replace(offset_x=0.0, offset_y=0.0),
    )
    begun = condition.settle_rolling(constants, spin)
    run = move("split", constants, quiet_inputs(spin=spin, magnets=True, ideal=True), begun, ticks=500_000, every=50)
    friction, normal = (run.column(name)[2000:] for name in ("friction_force", "normal_force"))
    times = run.times[2000:]
    whirl, depth = condition.rolling_whirl(constants, spin)
    turning = np.exp(2j * whirl * times) * np.hanning(len(times))
    swing = 2.0 * abs(np.sum((friction - friction.mean()) * turning)) / np.sum(np.hanning(len(times)))
    expected = condition.friction_swing(base_model(ModelLevels()).constants, spin)
    force = condition.normal_force(condition.oscillator(constants), whirl, constants.contact.clearance + depth)
    # The closed form uses the force on a rigid ring.
    assert swing == pytest.approx(share * expected * float(normal.mean()) / force, abs=0.12 * expected)


def test_slip_to_rolling():
    """Total time by quadrature, spin by the momentum that friction transfers."""
    from scipy.integrate import quad

    polar, spin = P["shaft.polar_inertia"], 2 * math.pi * 6.2
    natural = math.sqrt(STIFFNESS / MASS)
    for slip in condition.find_slips():
        begin = 2 * math.pi * slip.whirl_hz
        after = (polar * spin + MASS * RS * R0 * begin) / (polar + MASS * RS**2)
        time_s: Any = quad(lambda w: 1 / (P["contact.friction"] * (w * w - natural**2)), begin, after * RS / R0)
        assert slip.kept == pytest.approx(after / spin, rel=2e-3)
        assert slip.time_s == pytest.approx(float(time_s[0]), rel=5e-3)
        assert (slip.kept_closed, slip.time_closed_s) == pytest.approx((after / spin, float(time_s[0])), rel=1e-9)
    kept = condition.remaining_spin(base_model(ModelLevels()).constants)
    assert kept == pytest.approx(polar / (polar + MASS * RS**2), rel=1e-12)


def test_free_decay_is_faster_than_the_nominal_damping_ratio():
    constants = condition.bare_rig(0.25)._replace(magnet=base_model(ModelLevels(magnet="linear")).constants.magnet)
    begun = state(beta=0.5 * R0 / P["shaft.arm_ring"])
    run = move("split", constants, quiet_inputs(magnets=True, ideal=True), begun, ticks=1_000_000, every=100)
    beta = run.column("beta")
    tops = np.flatnonzero((beta[1:-1] > beta[:-2]) & (beta[1:-1] >= beta[2:])) + 1
    decrement = math.log(beta[tops[0]] / beta[tops[-1]]) / (len(tops) - 1)
    ratio = decrement / math.hypot(2 * math.pi, decrement)
    modal = P["shaft.transverse_inertia"] / P["shaft.arm_magnet"] ** 2
    assert ratio == pytest.approx(P["shaft.damping_ratio_x"] * math.sqrt(P["shaft.mass"] / modal), rel=5e-3)


def test_unbalance_in_whirl_is_a_line_of_its_force():
    found = outcome(Pulse(changes={"drive.mode": "ideal", "model.stator": "rigid"}, duration_s=4.0))
    spin, whirl = 2 * math.pi * 6.2, solve_rolling(6.2)[0]
    unbalance = (
        P["shaft.mass"] * P["shaft.unbalance_eccentricity"] * spin**2 * P["shaft.arm_disk"] / P["shaft.arm_ring"]
    )
    assert found.imbalance == pytest.approx(unbalance / (MASS * R0 * whirl**2), rel=0.01)


def test_conditions_of_the_paper_are_those_of_the_closed_forms():
    """Eqs. 42 and 43 with the shaft as a mass at the ring: M r0 w^2 over spring and damper, w over the slowest."""
    whirl, natural = 2 * math.pi * 83.7, math.sqrt(STIFFNESS / MASS)
    held_by = STIFFNESS * R0 + DAMPING * R0 * whirl
    share = DAMPING / (2 * MASS * natural * P["contact.friction"])
    slowest = natural * (share + math.sqrt(1 + share**2))
    expected = (P["shaft.mass"] * R0 * whirl**2 / held_by, whirl / slowest, natural / whirl)
    assert conditions(base_model(ModelLevels()).constants, -83.7) == pytest.approx(expected, rel=1e-12)
