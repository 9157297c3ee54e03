"""Housings that ring by their modes while `split` flies.

| what                                   | must agree with                                             |
|----------------------------------------|-------------------------------------------------------------|
| state after any time                   | the matrix exponential                                      |
| housing loss and impulse               | the power of the dashpots and the force, by quadrature      |
| a run of impacts                       | `taylor`, which follows the ringing by series               |
| contacts and peak force                | the same: no impact is missed under a housing that swings   |
| rows                                   | the same bits, however the run is cut into calls            |
| housings that lose a preload in flight | `taylor`: they do not ring by modes there                   |
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rig import load_scene
from rig.physics.engines.common.memory import CONTACTS, PEAK_FORCE, STEPS
from rig.physics.engines.split.condensed import body_matrices
from rig.physics.engines.split.layout import MEMORY
from rig.physics.engines.taylor.memory import RINGING
from rig.physics.engines.taylor.ringing import RINGS, add_ringing, set_modes, start_ringing
from rig.physics.kernels import signals as S
from rig.physics.kernels.constants import Constants, Inputs
from rig.physics.kernels.records import pack_record
from rig.physics.model import build_model
from rig.run.simulation import Simulation
from tests.scenes import QUIET

ROWS = ((S.X_IH, S.X_OH, S.VX_IH, S.VX_OH), (S.Y_IH, S.Y_OH, S.VY_IH, S.VY_OH))
INPUTS = Inputs(1e-6, 0.0, 1.0, 0.0, 0, 0, 6.0, 0.0, 0, False, True)


def constants_of(changes: dict[str, Any]) -> Constants:
    scene = load_scene("hammer", changes)
    return build_model(scene.load_parameters(), scene.model).constants


def get_python_function(kernel: Any) -> Any:
    """Return the uncompiled function of a kernel."""
    return getattr(kernel, "py_func", kernel)


def matrices_of(constants: Constants) -> np.ndarray:
    return get_python_function(body_matrices)(pack_record(constants)[0], pack_record(INPUTS)[0])[1]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"parameters": "as-printed"},
        {"parameters": "dtu-2019"},
        {"model.stator": "inner-house"},
        {"house.outer_beam_damping": 2e5},  # one mode is overdamped
    ],
)
def test_ringing_is_the_matrix_exponential(changes: dict[str, Any]) -> None:
    from scipy.integrate import simpson
    from scipy.linalg import expm

    constants = constants_of(changes)
    matrices, memory, house = matrices_of(constants), np.zeros(MEMORY), constants.house
    set_modes(house, matrices, memory)
    assert memory[RINGS] == 1.0
    start = np.zeros(S.N_VECTOR)
    moves = 1.0 if constants.levels.outer_house else 0.0
    for row, value in zip(ROWS[0] + ROWS[1], (3e-6, -2e-6, 0.01, 0.02, -1e-6, 4e-6, -0.03, 0.01), strict=True):
        start[row] = value * (moves if row in (S.X_OH, S.Y_OH, S.VX_OH, S.VY_OH) else 1.0)
    remainder = start.copy()
    assert start_ringing(constants, memory, remainder, -5e-4, 0.0)
    assert memory[RINGING] == 1.0
    assert not remainder[: S.N_STATE].any()
    times = np.linspace(0.0, 2e-3, 2001)
    runs = np.zeros((len(times), S.N_VECTOR))
    for time, run in zip(times, runs, strict=True):
        add_ringing(memory, time, run)
    for rows, matrix in zip(ROWS, matrices, strict=True):
        exact = np.array([expm(matrix * time) @ start[list(rows)] for time in times[::400]])
        found, size = runs[::400][:, list(rows)], np.abs(exact).max(axis=0)
        assert np.abs(found - exact).max(axis=0) == pytest.approx(0.0, abs=1e-9 * size.max())
    slip, outer = runs[:, S.VX_IH] - runs[:, S.VX_OH], runs[:, S.VY_OH]
    power = house.inner_beam_damping * slip**2 + moves * house.outer_beam_damping * outer**2
    assert runs[-1, S.HOUSE_LOSS] == pytest.approx(simpson(power, x=times), rel=1e-4, abs=1e-12)
    if moves:
        force_x = -house.pair_stiffness_horizontal * runs[:, S.X_OH]
        force_y = -house.outer_beam_stiffness * runs[:, S.Y_OH] - house.outer_beam_damping * outer
        assert runs[-1, S.HOUSE_IMPULSE_X] == pytest.approx(simpson(force_x, x=times), rel=1e-4)
        assert runs[-1, S.HOUSE_IMPULSE_Y] == pytest.approx(simpson(force_y, x=times), rel=1e-4)


def test_coincident_modes_are_excluded() -> None:
    constants, memory = constants_of({}), np.zeros(MEMORY)
    matrices = matrices_of(constants)
    matrices[1] = -np.eye(4) + np.eye(4, k=1)
    set_modes(constants.house, matrices, memory)
    assert memory[RINGS] == 0.0


def run(scene: str, duration_ticks: int, **changes: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of a run and its memory."""
    dotted = {key.replace("__", "."): value for key, value in changes.items()}
    simulation = Simulation(load_scene(scene, {**QUIET, "engine.companion": False, **dotted}))
    rows = simulation.advance(duration_ticks).rows.copy()
    return rows, simulation.snapshot().state["_motion"].memory


@pytest.mark.parametrize(
    ("scene", "ticks", "changes"),
    [
        ("partial-rub", 300_000, {}),
        ("drop", 100_000, {}),
        ("hammer", 90_000, {"parameters": "as-printed"}),
        ("hammer", 75_000, {"house__preload": 60.0}),  # lost again and again
        ("hammer", 90_000, {"model__stator": "inner-house", "contact__restitution": 0.9}),
    ],
)
def test_impacts_are_those_of_the_series(scene: str, ticks: int, changes: dict[str, Any]) -> None:
    exact, series = run(scene, ticks, engine__name="taylor", engine__tolerance=1e-11, **changes)
    rows, memory = run(scene, ticks, engine__tolerance=1e-5, **changes)
    away = (rows[:, : S.N_STATE] - exact[:, : S.N_STATE]) / S.STATE_SCALE
    assert np.sqrt(np.mean(away**2, axis=1)).max() < 1e-3
    assert memory[CONTACTS] == series[CONTACTS]
    assert memory[PEAK_FORCE] == pytest.approx(series[PEAK_FORCE], rel=1e-3)
    losses = [S.COLUMN["house_loss"], S.COLUMN["house_impulse_x"], S.COLUMN["house_impulse_y"]]
    scale = np.abs(exact[:, losses]).max(axis=0)
    assert np.abs(rows - exact)[:, losses].max(axis=0) == pytest.approx(0.0, abs=1e-3 * scale.max())


def test_flight_takes_fewer_steps_and_does_not_depend_on_calls() -> None:
    whole, memory = run("partial-rub", 300_000)
    _, series = run("partial-rub", 300_000, engine__rolling="series")
    assert memory[STEPS] < 0.5 * series[STEPS]
    simulation = Simulation(load_scene("partial-rub", {**QUIET, "engine.companion": False}))
    parts = [simulation.advance(1000 * count).rows.copy() for count in (1, 66, 3, 150, 80)]
    assert np.array_equal(whole, np.concatenate(parts))


@pytest.mark.parametrize("preload", [1e-9, 1e-3, 0.1])
def test_a_small_preload_approaches_no_preload(preload: float) -> None:
    def states(newtons: float) -> np.ndarray:
        engine = {"engine.name": "taylor", "engine.tolerance": 1e-9, "engine.companion": False}
        simulation = Simulation(load_scene("hammer", {**QUIET, **engine, "duration_s": 0.05, "house.preload": newtons}))
        return simulation.advance(simulation.end_tick).rows[:, : S.N_STATE].copy()

    difference = np.abs(states(preload) - states(0.0)) / S.STATE_SCALE
    assert difference.max() < 0.3 * preload + 1e-6, "a transducer is lost and found at one and the same force"
