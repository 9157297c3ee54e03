"""The compiled equations of motion compared with analytical results.

| what                             | must agree with                       | because                                  |
|----------------------------------|---------------------------------------|------------------------------------------|
| angular momentum about the pivot | sum of the moments, in space vectors  | Newton-Euler against angles              |
| the shaft with its scene turned  | the same, turned                      | no direction of the plane is special     |
| steady precession of a level top | M g l / (Izz w), at large angles      | gyroscopic terms, exact solution         |
| small whirl on the magnets       | roots of Ixx w^2 - Izz W w - K l0B^2  | sign and size of the gyroscopic coupling |
| forced whirl                     | closed form of the linear rotor       | unbalance: size, phase, sense            |
| spin-up, hammer alone            | exponential, A d 2/pi                 | drive and pulse                          |
| sliding impact                   | tangential = mu x normal impulse      | friction's sign and size                 |
| housing under a steady load      | springs in series and parallel        | housing equations                        |
| lost preload                     | half the stiffness; the stored energy | one-sided transducers                    |
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from replays.studies.peers import Problem
from replays.studies.peers.common.right_hand_side import derivative, pack
from replays.studies.stability.trials.motion import MotionResult, base_model, move, pivoted_mass, quiet_inputs, state
from rig.physics.kernels.constants import Constants, Inputs
from rig.physics.kernels.laws.contact import FLIGHT, TOUCHING
from rig.physics.levels import ModelLevels
from rig.run.motion import STORED

SPIN = 2 * math.pi * 6.2
FREE = {"gravity": 0.0, "unbalance": 0.0}
REMOTE_RING = {"clearance": 10.0, "offset_x": 0.0, "offset_y": 0.0}
"""A ring beyond the shaft's reach."""
UNDAMPED = {"damping_x": 0.0, "damping_y": 0.0}


def make_constants(
    levels: dict[str, Any] | None = None,
    *,
    shaft: dict[str, float] | None = None,
    magnet: dict[str, float] | None = None,
    contact: dict[str, float] | None = None,
    house: dict[str, float] | None = None,
    gain: float = 0.0,
) -> Constants:
    """Return the default constants with the given ones replaced, and this gain of the drive."""
    base = base_model(ModelLevels.model_validate({"friction": "smoothed", **(levels or {})})).constants
    return base._replace(
        shaft=base.shaft._replace(**shaft or {}),
        magnet=base.magnet._replace(**magnet or {}),
        contact=base.contact._replace(**contact or {}),
        house=base.house._replace(**house or {}),
        torque_gain=gain,
    )


def compute_rates(
    constants: Constants, inputs: Inputs, y: np.ndarray, *, t: float = 0.0, onset_speed: float | None = None
) -> np.ndarray:
    """Return the rates of the 14 states, in a contact with an onset speed or in flight, shape (14,)."""
    phase = FLIGHT if onset_speed is None else TOUCHING
    given = Problem("state", constants, inputs, y[:14], phase, onset_speed or 1.0, np.array([0.0, 1.0]))
    return derivative(t, y[:14].copy(), pack(given))


def run(constants: Constants, inputs: Inputs, y0: np.ndarray, *, ticks: int, every: int = 0) -> MotionResult:
    return move("rk8", constants, inputs, y0, ticks=ticks, every=every, tolerance=1e-12)


def compute_axis(q: np.ndarray) -> np.ndarray:
    """Return the unit vector along the shaft, in space."""
    G, b = q[0], q[1]
    return np.array([math.sin(b), -math.sin(G) * math.cos(b), math.cos(G) * math.cos(b)])


def differentiate(values: list[np.ndarray], h: float) -> np.ndarray:
    """Return the derivative of fourth order, from values at -2, -1, 1 and 2 h."""
    return (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)


def axis_rate(q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    h = 1e-4 / (1 + np.abs(qd).max())
    return differentiate([compute_axis(q + k * h * qd) for k in (-2, -1, 1, 2)], h)


def angular_momentum(constants: Constants, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    a, G = compute_axis(q), q[0]
    # Rotation of the frame, from its two rotations in space: G' about x, b' about the y axis rotated by G.
    turning = np.array([qd[0], qd[1] * math.cos(G), qd[1] * math.sin(G)])
    w = turning @ a + qd[2]
    return constants.shaft.transverse_inertia * (turning - (turning @ a) * a) + constants.shaft.polar_inertia * w * a


def random_state(rng: np.random.Generator, size: float) -> np.ndarray:
    y = size * rng.standard_normal(14)
    y[2], y[9] = rng.uniform(0, 6), rng.uniform(-60, 60)
    y[3:7] *= 1e-4
    y[10:14] *= 0.1
    return y


@pytest.mark.parametrize("ideal", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_angular_momentum_grows_by_the_moments_in_space(seed: int, ideal: bool) -> None:
    constants = make_constants(
        shaft={"unbalance": 4e-3}, magnet={"damping_x": 11.0, "damping_y": 17.0, "a5": 2e6, "a7": 3e9},
        contact={"stiffness": 1e6, "smoothing_speed": 0.1}, house={"preload": 1e9}, gain=0.1,
    )  # fmt: skip
    shaft, magnet, law, house = constants.shaft, constants.magnet, constants.contact, constants.house
    y = random_state(np.random.default_rng(seed), 0.3)
    along = np.array([math.cos(0.7), math.sin(0.7), 0.0])
    inputs = quiet_inputs(spin=50.0, magnets=True, ideal=ideal, pulse=(40.0, 0, 1_000_000))
    out = compute_rates(constants, inputs._replace(hammer_x=along[0], hammer_y=along[1]), y, t=0.3, onset_speed=0.5)
    q, qd, qdd = y[:3], y[7:10], out[7:10]
    a, ad, h = compute_axis(q), axis_rate(q, qd), 1e-5
    moved = [angular_momentum(constants, q + k * h * qd, qd + k * h * qdd) for k in (-2, -1, 1, 2)]
    rate = differentiate(moved, h)

    def moment(arm: float, force: np.ndarray) -> np.ndarray:
        return arm * np.cross(a, force)

    B, Bd = shaft.arm_magnet * a[:2], shaft.arm_magnet * ad[:2]
    r = math.hypot(*B)
    pull = magnet.stiffness * (r + magnet.a3 * r**3 + magnet.a5 * r**5 + magnet.a7 * r**7) / r
    turned = y[2] + shaft.unbalance_phase
    out_of_balance = shaft.unbalance * y[9] ** 2 * np.array([math.cos(turned), math.sin(turned), 0.0])
    total = moment(shaft.arm_magnet, np.array([*(-pull * B - [magnet.damping_x, magnet.damping_y] * Bd), 0.0]))
    total += moment(shaft.arm_centre, np.array([0.0, -shaft.mass * shaft.gravity, 0.0]))
    total += moment(shaft.arm_disk, out_of_balance + 40.0 * math.sin(math.pi * 0.3) * along)
    e = shaft.arm_ring * a[:2] - y[3:5] - [law.offset_x, law.offset_y]
    n = e / np.linalg.norm(e)
    across = np.array([-n[1], n[0]])
    u = shaft.arm_ring * ad[:2] - y[10:12]
    w = angular_momentum(constants, q, qd) @ a / shaft.polar_inertia
    depth = np.linalg.norm(e) - law.clearance
    F_n = max(0.0, law.stiffness * depth**1.5 * (1 + law.damping_factor * (u @ n) / 0.5))
    F_t = law.friction * F_n * math.tanh((u @ across + shaft.radius * w) / law.smoothing_speed)
    total += moment(shaft.arm_ring, np.array([*(-F_n * n - F_t * across), 0.0])) - shaft.radius * F_t * a

    rest = rate - total  # the drive's share; it may act along the axis only
    scale = np.abs(rate).max()
    assert F_n > 0.0
    assert np.linalg.norm(rest - (rest @ a) * a) < 1e-7 * scale
    if ideal:
        assert out[9] == 0.0
    else:
        assert rest @ a == pytest.approx(0.1 * (50.0 - y[9]), abs=1e-7 * scale)
    # The housing receives the opposite force.
    x = house.inner_mass * out[10] + house.outer_mass * out[12] + house.pair_stiffness_horizontal * y[5]
    up = house.inner_mass * out[11] + house.outer_mass * out[13]
    up += house.outer_beam_damping * y[13] + house.outer_beam_stiffness * y[6]
    assert (x, up) == pytest.approx(tuple(F_n * n + F_t * across), rel=1e-9, abs=1e-6)


@pytest.mark.parametrize("angle", [0.4, 2.0, 3.9, 5.5])
def test_the_shaft_turns_with_its_scene(angle: float) -> None:
    gain, aim = 0.1, 20.0
    constants = make_constants(
        {"stator": "rigid"}, shaft=FREE, magnet={"damping_x": 3.0, "damping_y": 3.0},
        contact={"stiffness": 1e6, "smoothing_speed": 0.1, "offset_x": 0.0, "offset_y": 0.0}, gain=gain,
    )  # fmt: skip
    y = random_state(np.random.default_rng(3), 0.2)
    y[3:7] = y[10:14] = 0.0
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])

    def motion(y: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, np.ndarray, float]:
        qdd = compute_rates(constants, quiet_inputs(spin=aim, magnets=True), y, onset_speed=0.4)[7:10]
        h = 1e-4
        before, after = (axis_rate(y[:3] + k * h * y[7:10], y[7:10] + k * h * qdd) for k in (-1, 1))
        w = y[9] + y[7] * math.sin(y[1])
        # The drive acts on theta', which is w less the frame's own rotation about the axis: this is subtracted.
        w_rate = qdd[2] + qdd[0] * math.sin(y[1]) + y[7] * y[8] * math.cos(y[1])
        w_rate -= gain / constants.shaft.polar_inertia * (aim - y[9])
        return compute_axis(y[:3]), axis_rate(y[:3], y[7:10]), w, (after - before) / (2 * h), w_rate

    a, ad, w, add, w_rate = motion(y)
    a2, ad2 = turn @ a, turn @ ad
    z = np.zeros(14)
    z[1], z[0], z[2] = math.asin(a2[0]), math.atan2(-a2[1], a2[2]), y[2]
    z[8] = ad2[0] / math.cos(z[1])
    z[7] = (math.sin(z[0]) * math.sin(z[1]) * z[8] - ad2[1]) / (math.cos(z[0]) * math.cos(z[1]))
    z[9] = w - z[7] * math.sin(z[1])
    b, bd, w2, bdd, w2_rate = motion(z)
    assert b == pytest.approx(a2, abs=1e-12)
    assert bd == pytest.approx(ad2, abs=1e-9)
    assert w2 == pytest.approx(w)
    assert bdd == pytest.approx(turn @ add, rel=1e-5, abs=1e-5 * np.abs(add).max())
    assert w2_rate == pytest.approx(w_rate, rel=1e-9)


def test_level_top_precesses_steadily_at_large_angles() -> None:
    # An axis that stays level precesses about the vertical at M g l / (Izz w), whatever the angle.
    constants = make_constants(shaft={"unbalance": 0.0}, magnet=UNDAMPED, contact=REMOTE_RING)
    shaft, w = constants.shaft, 2000.0
    rate = shaft.mass * shaft.gravity * shaft.arm_centre / (shaft.polar_inertia * w)
    motion = run(constants, quiet_inputs(), state(beta_rate=rate, theta_rate=w), ticks=1_000_000, every=200_000)
    assert motion.column("beta")[-1] > 1.1  # rad: far from small
    assert motion.column("beta") == pytest.approx(rate * motion.times, abs=1e-8)
    assert motion.column("Gamma") == pytest.approx(0.0, abs=1e-8)
    assert motion.column("theta_rate") == pytest.approx(w, rel=1e-10)


def get_lateral(motion: MotionResult) -> np.ndarray:
    """Return x + i y of the axis at unit arm, small angles, shape (n,)."""
    return motion.column("beta") - 1j * motion.column("Gamma")


@pytest.mark.parametrize("spin", [SPIN, 400.0, -400.0, 5000.0])
@pytest.mark.parametrize("which", [0, 1])
def test_small_whirl_has_the_gyroscopic_frequencies(spin: float, which: int) -> None:
    constants = make_constants({"magnet": "linear"}, shaft=FREE, magnet=UNDAMPED, contact=REMOTE_RING)
    shaft, size = constants.shaft, 1e-6
    spring = constants.magnet.stiffness * shaft.arm_magnet**2
    roots = np.roots([shaft.transverse_inertia, -shaft.polar_inertia * spin, -spring])
    whirl = float(np.sort(roots.real)[which])  # backward (negative), forward
    y0 = state(beta=size, Gamma_rate=-size * whirl, theta_rate=spin)
    every = 25 * round(8e4 / abs(whirl))
    motion = run(constants, quiet_inputs(spin=spin, magnets=True, ideal=True), y0, ticks=4 * every, every=every)
    assert len(motion.times) == 4
    assert get_lateral(motion) == pytest.approx(size * np.exp(1j * whirl * motion.times), abs=1e-8 * size)


def test_unbalance_drives_the_linear_rotors_forced_whirl() -> None:
    constants = make_constants(
        {"magnet": "linear"}, shaft={**FREE, "unbalance": 1.28e-7}, magnet=UNDAMPED, contact=REMOTE_RING
    )
    shaft, spin = constants.shaft, 30.0
    spring = constants.magnet.stiffness * shaft.arm_magnet**2
    stiffness = spring - (shaft.transverse_inertia - shaft.polar_inertia) * spin**2
    u0 = shaft.arm_disk * shaft.unbalance * spin**2 / stiffness * np.exp(1j * shaft.unbalance_phase)
    v0 = 1j * spin * u0
    y0 = state(beta=u0.real, Gamma=-u0.imag, beta_rate=v0.real, Gamma_rate=-v0.imag, theta_rate=spin)
    motion = run(constants, quiet_inputs(spin=spin, magnets=True, ideal=True), y0, ticks=350_000, every=50_000)
    assert get_lateral(motion) == pytest.approx(u0 * np.exp(1j * spin * motion.times), abs=1e-8 * abs(u0))


def test_drive_and_hammer_alone() -> None:
    constants = make_constants(shaft=FREE, magnet=UNDAMPED, contact=REMOTE_RING, gain=0.02)
    motion = run(constants, quiet_inputs(spin=SPIN), state(), ticks=25_000, every=5000)
    grown = 1 - np.exp(-0.02 / constants.shaft.polar_inertia * motion.times)
    assert motion.column("theta_rate") == pytest.approx(SPIN * grown, rel=1e-9)

    constants = make_constants(shaft=FREE, magnet=UNDAMPED, contact=REMOTE_RING)
    inputs = quiet_inputs(pulse=(100.0, 2000, 7000))
    wanted = constants.shaft.arm_disk * 100.0 * 5e-3 * 2 / math.pi / constants.shaft.transverse_inertia
    for (x, y), rate in (((1.0, 0.0), "beta_rate"), ((0.0, -1.0), "Gamma_rate")):
        end = run(constants, inputs._replace(hammer_x=x, hammer_y=y), state(), ticks=10_000).final_value(rate)
        assert end == pytest.approx(wanted, rel=1e-4)  # the cosine at the hammer's arm is 1 to 2e-5


@pytest.mark.parametrize("sense", [-1.0, 1.0])
def test_sliding_impact_has_coulombs_impulse(sense: float) -> None:
    # No spin inertia and a held speed: no gyroscopic moment, and the surface never stops sliding. A hard contact: the
    # normal must not turn while it lasts.
    constants = make_constants(
        {"stator": "rigid", "shaft": "planar", "friction": "exact"}, shaft={**FREE, "polar_inertia": 1e-12},
        magnet=UNDAMPED, contact={"stiffness": 1e15, "offset_x": 0.0, "offset_y": 0.0},
    )  # fmt: skip
    arm, v, spin = constants.shaft.arm_ring, 0.2, sense * 200.0
    y0 = state(beta=(1.0 - 1e-6) * constants.contact.clearance / arm, beta_rate=v / arm, theta_rate=spin)
    done = run(constants, quiet_inputs(spin=spin, ideal=True), y0, ticks=100)
    assert done.contacts == 1
    vx, vy = arm * done.final_value("beta_rate"), -arm * done.final_value("Gamma_rate")
    assert vx < 0.0
    # Friction pushes the top of the scene down if the shaft turns forward: against the surface's motion.
    assert vy / (v - vx) == pytest.approx(-sense * constants.contact.friction, rel=2e-3)
    # The drive supplies the work that holds the speed: w x (R_S x tangential impulse).
    paid = 200.0 * constants.shaft.radius * abs(vy) * pivoted_mass(constants)
    assert done.final_value("drive_work") == pytest.approx(paid, rel=2e-3)


def test_house_under_a_steady_load_is_springs() -> None:
    constants = make_constants(contact=REMOTE_RING)
    house, Fx, Fy = constants.house, 300.0, -200.0
    x_oh, y_oh = Fx / house.pair_stiffness_horizontal, Fy / house.outer_beam_stiffness
    x_ih, y_ih = x_oh + Fx / house.inner_beam_stiffness, y_oh + Fy / house.pair_stiffness_vertical
    y = state(x_ih=x_ih, y_ih=y_ih, x_oh=x_oh, y_oh=y_oh)
    found = compute_rates(constants, quiet_inputs(), y)[10:14]
    assert found == pytest.approx([-Fx / house.inner_mass, -Fy / house.inner_mass, 0.0, 0.0], abs=1e-9 * Fx)
    # Up loads north, east loads east: half of the load each, about the preload.
    row = run(constants, quiet_inputs(), y, ticks=25)
    changes = [row.column(name)[0] - house.preload for name in ("P_N", "P_S", "P_E", "P_W")]
    assert changes == pytest.approx([Fy / 2, -Fy / 2, Fx / 2, -Fx / 2])


def test_lost_preload_halves_the_stiffness() -> None:
    P0, undamped = 100.0, {"inner_beam_damping": 0.0, "outer_beam_damping": 0.0}
    constants = make_constants(shaft=FREE, magnet=UNDAMPED, contact=REMOTE_RING, house={"preload": P0, **undamped})
    house = constants.house
    k, u0 = house.pair_stiffness_vertical, 2 * P0 / house.pair_stiffness_vertical
    for u, force in ((0.5 * u0, P0), (3 * u0, 2 * P0 + k / 2 * 2 * u0)):
        assert compute_rates(constants, quiet_inputs(), state(y_ih=u))[11] == pytest.approx(-force / house.inner_mass)
    # The round trip conserves the energy: an oscillation well into the half-open range.
    y0 = state(vx_ih=0.2, vy_ih=0.3)
    motion = move("taylor", constants, quiet_inputs(), y0, ticks=10_000, every=250, tolerance=1e-12)
    for name in ("P_N", "P_S", "P_E", "P_W"):
        assert (motion.column(name) == 0.0).any(), "all four come loose at some time"
    stored = np.sum([motion.column(name) for name in STORED], axis=0)
    assert stored == pytest.approx(stored[0], rel=1e-9)
