"""Properties of each engine: its order, its friction, and its limits.

| the engine's                           | must be                          | because                             |
|----------------------------------------|----------------------------------|-------------------------------------|
| error on a smooth problem against step | h^p with the order p it names    | definition of order                 |
| error of split on every scene          | within 10 times the tolerance    | it controls that error              |
| sliding speed while it rolls           | 0                                | Filippov: rolling is a phase        |
| distance of smoothed to exact friction | proportional to v_s              | creep is v_s atanh(needed / mu)     |
| linearly implicit run at v_s = 1 um/s  | near to exact Coulomb            | L-stable                            |
| explicit run at v_s = 1 um/s, 25 us    | wrong, and its energy ledger too | stable below 2 m v_s / (mu F_n)     |
| spin without drive, in the air         | constant, without unbalance      | no moment about the shaft's axis    |
| spin without drive, in the ring        | less; the energy ledger closes   | friction alone brakes it            |
"""

from __future__ import annotations

import dataclasses
from importlib import import_module
from itertools import product
from typing import Any

import numpy as np
import pytest

from rig import InputError, load_scene, simulate
from rig.physics.engines import ENGINES, load_engine
from rig.physics.engines.common.memory import CEILING, CONTACTS, EVALUATIONS, MEMORY, PHASE, STEPS
from rig.physics.kernels import signals as S
from rig.physics.kernels.laws.contact import ROLLING
from rig.run.simulation import Simulation
from tests.scenes import QUIET

_MEASURED = [0, 1, 3, 4, 7, 8, 9]
EXACT = [name for name, method in ENGINES.items() if "exact" in method.frictions]


def make_simulation(scene: str, engine: str, smoothing_speed: float | None = None, **changes: Any) -> Simulation:
    """Prepare a simulation with rows 1 ms apart.

    Dots of dotted keys are written `__`; v_s [m/s] may be below the limit of a scene.
    """
    dotted = {key.replace("__", "."): value for key, value in changes.items()}
    simulation = Simulation(load_scene(scene, {**QUIET, "engine.name": engine, **dotted}))
    if smoothing_speed is not None:
        constants = simulation.model.constants
        contact = constants.contact._replace(smoothing_speed=smoothing_speed)
        simulation.model = dataclasses.replace(simulation.model, constants=constants._replace(contact=contact))
    return simulation


def compute_motion(simulation: Simulation, duration_s: float) -> np.ndarray:
    """Return scaled states on a grid of 1 ms, shape (n, 7)."""
    rows = simulation.advance(round(duration_s * 1e6)).rows
    return rows[:, _MEASURED] / S.STATE_SCALE[_MEASURED]


def rms_distance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the RMS difference over states and time."""
    return float(np.sqrt(np.mean((one - other) ** 2)))


def fit_slope(steps: list[Any], errors: list[float]) -> float:
    """Return the fitted exponent of the error as a function of the step."""
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


def get_engine_row(engine: str, table: dict[str, Any], what: str) -> Any:
    """Return an engine's row of a table of this module, or fail with the table that lacks it."""
    assert engine in table, f"{engine} must have a row in {what}"
    return table[engine]


SMOOTH_STEPS = {
    "rk8": [500, 250, 200, 160],
    "tsit5": [50, 40, 25, 20],  # at longer steps the error of order 6 is the larger
    "rosenbrock": [250, 200, 160, 100],
    "rk4": [100, 50, 40, 25],
    "verlet": [100, 50, 40, 25],
    "semi-implicit-euler": [50, 25, 20, 10],
}


# Series choose their own steps: test_taylor checks their order; split's are the same.
@pytest.mark.parametrize("engine", [name for name in ENGINES if name not in ("taylor", "split")])
def test_order_on_the_smooth_problem(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # The order of the plain method: no error estimate may shorten a step.
    for name in ("rk8", engine):
        module = import_module(f"rig.physics.engines.{name.replace('-', '_')}")
        if hasattr(module, "METHOD"):
            monkeypatch.setattr(module, "METHOD", module.METHOD._replace(order=0.0))

    # Undamped free flight at 220 Hz on stiff, hardening magnets, in a ring too wide to touch: smooth and nonlinear.
    simulation = make_simulation(
        "stable-run", "rk8", ring__clearance=15.0, initial__position="given", initial__x_mm=0.8, initial__y_mm=0.4,
        magnet__stiffness=1000.0, shaft__damping_ratio_x=0.0, shaft__damping_ratio_y=0.0, drive__speed_hz=8.0,
    )  # fmt: skip
    constants, inputs = simulation.model.constants, simulation._inputs()

    def swing(name: str, step: int) -> np.ndarray:
        module, y, memory = load_engine(name), simulation._motion.y.copy(), np.zeros(MEMORY)
        rows = np.empty((7, S.N_ROW))
        module.start(constants, inputs, y, memory, float(step), ENGINES[name].tolerance)
        module.advance(constants, inputs, y, memory, 0, step, 56_000 // step, 8_000 // step, rows)
        assert memory[CONTACTS] == 0.0
        assert memory[STEPS] == 56_000 // step, "no step was divided"
        return rows[:, [0, 1, 7, 8]] / np.array([1e-2, 1e-2, 10.0, 10.0])

    exact = swing("rk8", 20)
    steps = get_engine_row(engine, SMOOTH_STEPS, "SMOOTH_STEPS: four or more steps [us] at which its order shows")
    errors = [float(np.linalg.norm(swing(engine, step) - exact)) for step in steps]
    assert fit_slope(steps, errors) == pytest.approx(load_engine(engine).order, abs=0.15)


SCENES: dict[str, tuple[str, dict[str, Any], float, float]] = {
    "first impacts": ("hammer", {}, 0.0, 0.05),
    "start of the whirl": ("hammer", {}, 0.0, 0.2),
    "drop": ("drop", {}, 0.0, 0.06),
    "resonance with contact": ("run-up", {}, 8.0, 0.1),
    "stable run": ("stable-run", {"initial__position": "given", "initial__x_mm": 0.3}, 0.0, 0.1),
}
"""Scene, changes, start and length [s]."""


@pytest.mark.parametrize("name", SCENES)
def test_split_keeps_its_tolerance_on_every_scene(name: str) -> None:
    scene, changes, start_s, duration_s = SCENES[name]
    first = make_simulation(scene, "split", **changes)
    if start_s:
        first.advance(round(start_s * 1e6))

    def run(engine: str, **choice: Any) -> tuple[np.ndarray, Simulation]:
        simulation = make_simulation(scene, engine, **changes, **choice)
        simulation.tick, simulation._motion.y = first.tick, first._motion.y.copy()
        return compute_motion(simulation, duration_s), simulation

    exact, reference = run("rk8", engine__step_us=5, engine__tolerance=1e-13)
    assert (reference._motion.memory[CONTACTS] > 0) == (name != "stable run")
    tolerances = [1e-2, 1e-3, 1e-4]
    errors = [rms_distance(run("split", engine__tolerance=tolerance)[0], exact) for tolerance in tolerances]
    assert all(error < 10.0 * tolerance for error, tolerance in zip(errors, tolerances, strict=True)), errors


# Cases in which a fixed step was wrong: hard impacts, lost preload, another gap, other exponents and sets.
HARD: dict[str, dict[str, Any]] = {
    "300 N": {"commands": [{"at_s": 0.02, "command": "hammer", "force_n": 300.0, "duration_ms": 5.0}]},
    "lost preload": {"house.preload": 300.0},
    "as printed": {"parameters": "as-printed"},
    "another rig": {"parameters": "dtu-2019"},
    "exponent 1.1": {"contact.stiffness": "palmgren-cylinder"},
    "no friction": {"model.friction": "none"},
    "rigid stator": {"model.stator": "rigid"},
}


@pytest.mark.parametrize("name", HARD)
def test_split_is_accurate_in_hard_cases_and_estimates_its_error(name: str) -> None:
    bare = {"sensors.chain": "ideal", "sensors.rate_hz": 1000, "sensors.truth_rate_hz": 1000, **HARD[name]}
    exact = simulate("hammer", {**bare, "engine.name": "taylor", "engine.tolerance": 1e-12}, duration_s=0.15)
    run = simulate("hammer", bare, duration_s=0.15)
    error = np.sqrt(np.mean(((run.signals - exact.signals)[:, : S.N_STATE] / S.STATE_SCALE) ** 2, axis=1)).max()
    estimate = run.simulation.health()["accuracy"]["estimate"]
    assert error < 10.0 * run.simulation.scene.engine.tolerance
    assert 0.2 * estimate < error < 5.0 * estimate + 3e-5


def test_whirl_is_accurate_as_long_as_its_error_growth_allows() -> None:
    # In whirl small differences grow by 0.3 per second: a factor of 400 in 20 s. The ledger still closes to far less
    # than the tolerance of the motion (3e-4), which sets the steps of rolling.
    bare = {"sensors.chain": "ideal", "sensors.rate_hz": 100, "sensors.truth_rate_hz": 100}
    run = simulate("hammer", bare, duration_s=20.0)
    health = run.simulation.health()
    assert health["accuracy"]["doubted_s"] is None
    assert abs(health["energy"]["residual_share"]) < 1e-6


@pytest.mark.parametrize("engine", ["rk8", "tsit5", "taylor"])
def test_rolling_holds_the_sliding_speed_at_zero(engine: str) -> None:
    simulation = make_simulation("hammer", engine)
    simulation.advance(200_000)
    assert simulation._motion.memory[PHASE] == ROLLING
    rows = simulation.advance(300_000).rows
    assert (rows[:, S.COLUMN["normal_force"]] > 0.0).all()
    assert np.abs(rows[:, S.COLUMN["friction_force"]]).max() > 1.0
    assert np.abs(rows[:, S.COLUMN["sliding_speed"]]).max() < 1e-6


def test_smoothed_friction_is_as_far_from_exact_as_its_smoothing_speed() -> None:
    exact = compute_motion(make_simulation("hammer", "rk8"), 0.15)
    speeds = [5e-3, 2.5e-3, 1e-3, 0.5e-3]
    errors = [
        rms_distance(compute_motion(make_simulation("hammer", "rk8", v, model__friction="smoothed"), 0.15), exact)
        for v in speeds
    ]
    assert fit_slope(speeds, errors) == pytest.approx(1.0, abs=0.15)


# Error over the first 0.05 s after the hammer pulse: sixteen impacts, which amplify small errors a thousand times.
CLASS = {
    "split": ({}, 3e-4),
    "tsit5": ({"engine__tolerance": 1e-7}, 1e-3),
    "rk4": ({"engine__step_us": 5}, 3e-4),
    "verlet": ({"engine__step_us": 1}, 1e-2),
    "rk8": ({"engine__step_us": 20}, 1e-6),
    "taylor": ({}, 1e-7),
    "rosenbrock": ({"engine__tolerance": 1e-7}, 1e-4),
}


@pytest.mark.parametrize("engine", EXACT)
def test_engines_agree_on_exact_friction(engine: str) -> None:
    exact = compute_motion(make_simulation("hammer", "rk8", engine__tolerance=1e-10), 0.05)
    choice, limit = get_engine_row(engine, CLASS, "CLASS: how it is run, and how far it may be from rk8 after 0.05 s")
    assert rms_distance(compute_motion(make_simulation("hammer", engine, **choice), 0.05), exact) < limit


@pytest.mark.parametrize("engine", EXACT)
def test_without_a_drive_only_contact_brakes_the_shaft(engine: str) -> None:
    free = {"drive__torque_gain": 0.0, "shaft__unbalance_eccentricity": 0.0}
    spin = make_simulation("stable-run", engine, **free).advance(100_000).rows[:, S.COLUMN["theta_rate"]]
    np.testing.assert_allclose(spin, spin[0], rtol=1e-9)  # a sagging shaft turns as evenly, except for its tilt
    simulation = make_simulation("hammer", engine, **free)
    spin = simulation.advance(100_000).rows[:, S.COLUMN["theta_rate"]]
    assert spin[-1] < spin[0] - 1.0
    energy = simulation.health()["energy"]
    assert abs(energy["residual_share"]) < energy["alarm_share"]


@pytest.mark.parametrize("engine", [name for name in ENGINES if name not in EXACT])
def test_engines_without_exact_friction_refuse_it(engine: str) -> None:
    with pytest.raises(InputError, match="friction"):
        make_simulation("hammer", engine, model__friction="exact")


@pytest.mark.parametrize("smoothing_speed", [1e-4, 1e-6])
def test_linearly_implicit_engine_is_stable_at_any_smoothing_speed(smoothing_speed: float) -> None:
    exact = compute_motion(make_simulation("hammer", "rk8"), 0.15)
    implicit = make_simulation(
        "hammer", "rosenbrock", smoothing_speed, model__friction="smoothed", engine__tolerance=1e-6
    )
    assert rms_distance(compute_motion(implicit, 0.15), exact) < 4e-3
    assert implicit._motion.memory[CEILING] == 0.0
    assert abs(implicit.health()["energy"]["residual_share"]) < 3e-5

    # An explicit step of 25 us is some hundred times too long: it adds energy, and the ledger reports it.
    explicit = make_simulation("hammer", "rk4", smoothing_speed, model__friction="smoothed", engine__step_us=25)
    assert rms_distance(compute_motion(explicit, 0.15), exact) > 1e-2
    assert abs(explicit.health()["energy"]["residual_share"]) > 1e-2
    # The same with error control: several times the work.
    if smoothing_speed == 1e-4:
        adaptive = make_simulation("hammer", "rk8", smoothing_speed, model__friction="smoothed")
        compute_motion(adaptive, 0.15)
        assert adaptive._motion.memory[EVALUATIONS] > 2.0 * implicit._motion.memory[EVALUATIONS]


@pytest.mark.parametrize(
    ("engine", "friction"),
    [*product(("rosenbrock", "verlet", "semi-implicit-euler"), ("none", "switch")), ("taylor", "none")],
)
def test_other_friction_laws(engine: str, friction: str) -> None:
    # The two low orders at 1 us and up to the second impact only.
    exact = compute_motion(make_simulation("hammer", "rk8", model__friction=friction), 0.034)
    choice = {} if ENGINES[engine].tolerance else {"engine__step_us": 1}
    run = make_simulation("hammer", engine, model__friction=friction, **choice)
    assert rms_distance(compute_motion(run, 0.034), exact) < (1e-4 if ENGINES[engine].tolerance else 2e-2)
    assert run._motion.memory[CONTACTS] >= 1.0
