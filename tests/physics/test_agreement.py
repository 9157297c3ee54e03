"""Agreement of the rig's physics with results that are not its own code.

| the rig's                       | must agree with                         | because                                  |
|---------------------------------|-----------------------------------------|------------------------------------------|
| contact force, turned           | itself, turned by the same angle        | frame invariance: no special direction   |
| first impacts, 0.1 s of hammer  | DOP853 at 1e-11 on Lagrange's equations | two derivations and solvers; not chaotic |
| first impacts, 0.06 s of drop   | the same                                | the same                                 |
| free flight                     | matrix exponential, linear equations    | small motion is linear                   |
| energy ledger                   | zero residual                           | first law                                |
| momentum ledger                 | zero residual                           | Newton and Euler                         |
| pivot reaction                  | static lever rule                       | statics                                  |
| whirl                           | backward, rolling, -spin R_S/(r0+delta) | kinematics of rolling; paper's eq. 41    |
| mean whirl force                | grows as spin squared                   | centrifugal force                        |
| 2 ms hammer                     | dies out                                | too little energy to keep rolling        |
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from replays.studies.peers import Setting, scipy_solvers
from replays.studies.peers.common.solution import Manner
from replays.studies.peers.common.window import cut_window
from rig import Run, load_parameters, load_scene, simulate
from rig.physics.kernels import signals as S
from rig.physics.kernels.laws.contact import FORWARD, SMOOTHED, TOUCHING, ring_force
from rig.physics.model import build_model
from rig.run.motion import DISSIPATED
from rig.run.offline import frames
from rig.run.simulation import Simulation


@pytest.fixture(scope="module")
def whirl() -> Run:
    """The hammer scene with all levels, without noise."""
    return simulate(load_scene("hammer", {"sensors.noise": False}))


@pytest.mark.parametrize(
    ("scene", "duration_s", "changes"),
    [
        ("hammer", 0.1, {}),
        ("hammer", 0.1, {"drive.mode": "ideal"}),
        ("hammer", 0.1, {"parameters": "dtu-2019"}),
        # Transducers that open make kinks that the engine does not locate: two impacts, at a shorter step.
        ("hammer", 0.032, {"house.preload": 100.0, "engine.step_us": 5}),
        ("drop", 0.06, {}),
    ],
)
def test_first_impacts_against_independent_solver(scene: str, duration_s: float, changes: dict[str, object]) -> None:
    # Plain Python has the smoothed law.
    quiet = {
        "sensors.noise": False, "sensors.rate_hz": 10_000, "model.friction": "smoothed", "engine.name": "rk8",
    }  # fmt: skip
    given = load_scene(scene, {**quiet, **changes})
    run = simulate(given, duration_s=duration_s)
    problem = cut_window(given, end_s=float(run.times_s[-1]), sample_s=float(run.times_s[1]))
    setting = Setting("1e-11", 1e-11)
    with np.errstate(all="ignore"):  # trial steps of the solver may overflow
        solution = scipy_solvers.solve(
            problem, setting=setting, budget_s=60.0, method="DOP853", manner=Manner(plain=True)
        )
    assert solution.failure is None
    assert solution.contacts >= 2, "the comparison must reach through impacts"
    np.testing.assert_allclose(solution.times, run.times_s, atol=1e-12)
    error = np.abs(run.signals[:, : S.N_STATE] - solution.states) / S.STATE_SCALE
    assert np.sqrt(np.mean(error**2, axis=1)).max() < 1e-4
    assert run.simulation.health()["contacts"] == solution.contacts


@pytest.mark.parametrize("phase", [TOUCHING, FORWARD])
def test_contact_force_is_frame_invariant(phase: int) -> None:
    rng = np.random.default_rng(3)
    contact = build_model(load_parameters()).constants.contact
    for _ in range(200):
        angle = rng.uniform(-math.pi, math.pi)
        e = rng.normal(size=2)
        e *= (contact.clearance + rng.uniform(0, 3e-5)) / np.hypot(*e)
        v = rng.normal(size=2) * 0.1
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        law = (rng.normal() * 0.3, 0.1, SMOOTHED, phase, contact)
        plain = np.array(ring_force(*e, *v, *law))
        turned = np.array(ring_force(*(turn @ e), *(turn @ v), *law))
        assert plain[2] > 0.0
        assert plain[4] != 0.0
        np.testing.assert_allclose(turned[:2], turn @ plain[:2], rtol=1e-9)
        # A rotation by rounding moves the penetration by 1e-19 m, one part in 1e11 of the smallest here.
        np.testing.assert_allclose(turned[2:-2], plain[2:-2], rtol=1e-8)
        np.testing.assert_allclose(turned[-2:], turn @ plain[-2:], rtol=1e-9)


def test_free_flight_follows_the_linear_solution() -> None:
    from scipy.linalg import expm

    # A ring wide enough to avoid contact, spinning, small motion about the centre (no gravity), no unbalance.
    changes = {
        "gravity.acceleration": 0.0,
        "shaft.unbalance_eccentricity": 0.0,
        "ring.offset_y": 0.0,
        "initial.position": "given",
        "initial.x_mm": 0.01,
        "initial.y_mm": -0.005,
        "drive.speed_hz": 12.0,
        "sensors.noise": False,
    }
    run = simulate(load_scene("stable-run", changes), duration_s=1.0)
    c = run.simulation.model.constants
    Ixx, Izz, lB, K = c.shaft.transverse_inertia, c.shaft.polar_inertia, c.shaft.arm_magnet, c.magnet.stiffness
    spin = 2 * math.pi * 12.0
    # Gamma, beta, rates: Ixx G'' = -K lB^2 G - Dy lB^2 G' - Izz w b', Ixx b'' = -K lB^2 b - Dx lB^2 b' + Izz w G'
    stiff, gyro = K * lB**2 / Ixx, Izz * spin / Ixx
    dx, dy = (damping * lB**2 / Ixx for damping in (c.magnet.damping_x, c.magnet.damping_y))
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-stiff, 0, -dy, -gyro], [0, -stiff, gyro, -dx]])
    start = run.signals[0, [0, 1, 7, 8]]
    size = np.array([1.0, 1.0, math.sqrt(stiff), math.sqrt(stiff)]) * np.linalg.norm(start[:2])
    for n in (1, 5_000, 19_999):
        expected = expm(A * run.times_s[n]) @ start
        # The remaining difference: the magnets' hardening and the sines, of third order in the tilt.
        assert np.abs((run.signals[n, [0, 1, 7, 8]] - expected) / size).max() < 1e-3
    assert run["normal_force"].max() == 0.0


@pytest.mark.parametrize("scene", ["hammer", "drop", "stable-run", "run-up"])
def test_ledgers_close(scene: str) -> None:
    simulation = Simulation(load_scene(scene, {"duration_s": 2.0, "engine.name": "rk8"}))
    first = simulation.first_row
    column = S.COLUMN
    for frame in frames(simulation):
        rows = frame.rows[:: len(frame.rows) // 10]
        dissipated = sum(rows[-1, column[name]] for name in DISSIPATED)
        energies = simulation.health()["energy"]
        assert abs(energies["residual_j"]) <= 1e-6 * max(dissipated, 1e-6)
        for axis in "xyz":
            stored = rows[:, column[f"angular_momentum_{axis}"]] - first[column[f"angular_momentum_{axis}"]]
            residual = stored - rows[:, column[f"angular_impulse_{axis}"]]
            scale = max(np.abs(rows[:, column[f"angular_momentum_{axis}"]]).max(), 1e-3)
            assert np.abs(residual).max() < 1e-6 * scale
    for axis in "xy":
        stored = rows[:, column[f"house_momentum_{axis}"]]
        np.testing.assert_allclose(stored, rows[:, column[f"house_impulse_{axis}"]], atol=1e-9)


@pytest.mark.parametrize("scene", ["hammer", "drop", "stable-run", "run-up"])
def test_ledger_of_the_default_engine_closes_to_its_own_error(scene: str) -> None:
    simulation = Simulation(load_scene(scene, {"duration_s": 2.0}))
    assert simulation.scene.engine.name == "split"
    for _ in frames(simulation):
        assert not [text for text in simulation.health()["warnings"] if "energy" in text]


def test_the_printed_gap_creates_energy_and_the_ledger_shows_it() -> None:
    run = simulate(load_scene("hammer", {"parameters": "as-printed", "engine.name": "rk8"}), duration_s=0.3)
    assert abs(run["gap_work"][-1]) > 1e-5
    energy = run.energy()
    assert abs(energy["residual"][-1]) < 1e-6 * energy["dissipated"][-1]


def test_pivot_carries_its_share_at_rest() -> None:
    run = simulate(load_scene("stable-run", {"drive.speed_hz": 0.0}), duration_s=0.01)
    shaft = run.simulation.model.constants.shaft
    weight = shaft.mass * shaft.gravity
    # Lever rule about the magnets: R l0B = M g (l0B - l0C).
    assert run["pivot_y"][-1] == pytest.approx(weight * (1 - shaft.arm_centre / shaft.arm_magnet), rel=1e-9)
    assert run["magnet_y"][-1] == pytest.approx(weight * shaft.arm_centre / shaft.arm_magnet, rel=1e-9)


def test_rig_of_the_paper_sags_out_of_a_centred_ring() -> None:
    model = build_model(load_parameters())
    contact = model.constants.contact
    assert contact.damping_factor == pytest.approx(0.1665, abs=1e-4)
    # Hence the ring's offset.
    assert abs(model.sag) > contact.clearance


def measure_whirl(run: Run, *, from_s: float) -> dict[str, float]:
    """Return the figures of the whirl from the model's own signals: phase slope of the shaft in the ring."""
    kept = run.times_s >= from_s
    phase = np.unwrap(np.angle(run["ring_x"][kept] + 1j * run["ring_y"][kept]))
    times = run.times_s[kept]
    constants = run.simulation.model.constants
    orbit = constants.contact.clearance + run["penetration"][kept]
    rolling = -np.mean(run["theta_rate"][kept] * constants.shaft.radius / orbit)
    return {
        "hz": float(np.polyfit(times, phase, 1)[0] / (2 * math.pi)),
        "law_hz": float(rolling / (2 * math.pi)),
        "spin_hz": float(run["theta_rate"][kept].mean() / (2 * math.pi)),
        "force": float(run["normal_force"][kept].mean()),
        "slip": float(np.abs(run["sliding_speed"][kept]).mean()),
    }


def test_whirl_rolls_backward_and_its_force_grows_as_spin_squared() -> None:
    speeds, forces = [], []
    for speed_hz in (3.2, 4.2, 5.2, 6.2):
        run = simulate(load_scene("hammer", {"drive.speed_hz": speed_hz, "sensors.noise": False}))
        figures = measure_whirl(run, from_s=1.5)
        assert figures["hz"] < 0.0
        assert figures["hz"] == pytest.approx(figures["law_hz"], rel=2e-3)
        surface = 2 * math.pi * figures["spin_hz"] * run.simulation.model.constants.shaft.radius
        assert figures["slip"] < 0.01 * surface
        speeds.append(figures["spin_hz"])
        forces.append(figures["force"])
    slope = np.polyfit(np.log(speeds), np.log(forces), 1)[0]
    # The inward pull of the magnets lowers the smaller forces: slightly above 2.
    assert 1.95 < slope < 2.2
    np.testing.assert_allclose(forces, [130, 230, 361, 523], rtol=0.08)


def test_whirl_after_a_short_impact_decays() -> None:
    scene = load_scene("hammer")
    short = scene.commands[0].request.model_copy(update={"duration_ms": 2.0})
    scene = scene.model_copy(update={"commands": (scene.commands[0].model_copy(update={"request": short}),)})
    run = simulate(scene)
    assert run["normal_force"].max() > 0.0, "it must have touched"
    assert run["normal_force"][run.times_s > 1.0].max() == 0.0


def test_spin_dips_and_recovers(whirl: Run) -> None:
    spin = whirl["theta_rate"] / (2 * math.pi)
    assert spin.min() < 5.9
    assert 6.0 < spin[-1] < 6.2


def test_transducer_pairs_carry_the_load_in_halves(whirl: Run) -> None:
    preload = whirl.simulation.model.constants.house.preload
    np.testing.assert_allclose(whirl["P_N"] - preload, -(whirl["P_S"] - preload), atol=1e-8)
    amplitude = np.ptp((whirl["P_E"] - whirl["P_W"])[whirl.times_s > 1.5]) / 2
    # The reaction carries the normal force and the inertia of the housings.
    assert 500.0 < amplitude < 620.0
