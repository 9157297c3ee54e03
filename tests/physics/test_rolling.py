"""Rolling of `split` by collocation: its numbers in closed form, its motion against the series.

| what                              | must agree with                                        |
|-----------------------------------|--------------------------------------------------------|
| nodes and weights                 | integrals of powers; Lagrange's polynomials            |
| responses of a linear body        | the matrix exponential, for a force that is a power    |
| matrices of the linear bodies     | the kernels' rates, by the change of one state         |
| settled whirl over 0.2 s          | `taylor` from the same state, at each tolerance        |
| whirl that creeps                 | the same with smoothed friction, wide and narrow       |
| the companion's estimate          | the distance from `taylor`                             |
| energy residual                   | 0, within the tolerance                                |
| rows                              | the same bits, however the run is cut into calls       |
| contact that slips                | `taylor`, after the exit to a series                   |
| contact that a hammer pulse ends  | the same; the series begins without a sliding speed    |
| normal force between the nodes    | `taylor`, within the tolerance of the largest force    |
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rig import load_scene
from rig.base.errors import InputError
from rig.physics.engines import load_engine
from rig.physics.engines.common.memory import CEILING, MEMORY, PHASE, ROLLED_S
from rig.physics.engines.split import layout
from rig.physics.engines.split.condensed import ROWS_OF_STATE, SIGN_OF_STATE, body_matrices
from rig.physics.engines.split.radau import INTEGRALS, NODES, STAGES, collocate, interpolation, invert
from rig.physics.kernels import signals as S
from rig.physics.kernels.constants import Inputs
from rig.physics.kernels.dynamics import evaluate
from rig.physics.kernels.laws.contact import FLIGHT, ROLLING
from rig.physics.kernels.records import pack_record
from rig.physics.model import build_model
from rig.run.motion import energy_balance
from rig.run.simulation import Simulation
from tests.scenes import QUIET


def make_simulation(engine: str, tolerance: float, **changes: Any) -> Simulation:
    """Return a hammer run by `split` with collocation, without companion, rows 1 ms apart; `__` represents a dot."""
    dotted = {key.replace("__", "."): value for key, value in changes.items()}
    choice = {"engine.name": engine, "engine.tolerance": tolerance, "engine.companion": False}
    rolling = {"engine.rolling": "collocation"} if engine == "split" else {}
    return Simulation(load_scene("hammer", {**QUIET, **choice, **rolling, **dotted}))


def memory_of(simulation: Simulation) -> np.ndarray:
    return simulation.snapshot().state["_motion"].memory


def scaled_error(rows: np.ndarray, reference: np.ndarray) -> float:
    """Return the RMS of the scaled states' differences over all rows [1]."""
    away = (rows[:, : S.N_STATE] - reference[:, : S.N_STATE]) / S.STATE_SCALE
    return float(np.sqrt(np.mean(away**2)))


def get_python_function(kernel: Any) -> Any:
    """Return the uncompiled function of a kernel."""
    return getattr(kernel, "py_func", kernel)


def test_nodes_and_weights_integrate_powers() -> None:
    powers = np.arange(2 * STAGES - 1)
    at_nodes = NODES[:, None] ** powers
    assert NODES[-1] == 1.0
    # At the end for powers as in Gauss's rules, at each node for those of the polynomial.
    assert INTEGRALS[-1] @ at_nodes == pytest.approx(1.0 / (powers + 1.0), rel=1e-12)
    own = powers[:STAGES]
    assert INTEGRALS @ at_nodes[:, :STAGES] == pytest.approx(NODES[:, None] ** (own + 1) / (own + 1.0), rel=1e-11)


@pytest.mark.parametrize("with_start", [True, False])
@pytest.mark.parametrize("part", [0.0, 0.3, 1.0])
def test_interpolation_is_exact_for_polynomials(with_start: bool, part: float) -> None:
    weights, points = np.empty(STAGES + 1), np.concatenate([[0.0], NODES])
    get_python_function(interpolation)(with_start, part, weights)
    for power in range(STAGES + with_start):
        assert weights @ points**power == pytest.approx(part**power, abs=1e-10)


@pytest.mark.parametrize("parameters", ["corrected", "dtu-2019"])
def test_linear_bodies_respond_as_in_closed_form(parameters: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from scipy.linalg import expm

    monkeypatch.setattr("rig.physics.engines.split.radau.invert", get_python_function(invert))
    scene, power = load_scene("hammer", {"parameters": parameters}), 3
    shafts, housings = get_python_function(body_matrices)(
        build_model(scene.load_parameters(), scene.model).constants, INPUTS
    )
    for Z in (*shafts, *housings):
        n, h = len(Z), 0.5 / np.abs(np.linalg.eigvals(Z)).max()
        free, forced = np.empty((n, n, STAGES)), np.empty((n, STAGES, STAGES))
        get_python_function(collocate)(Z, n // 2, -2.0, h, free, forced)
        # z' = Z z - 2 u on the driven component, u = (t/h)^3: u and its derivatives are states too.
        whole = np.zeros((n + power + 1, n + power + 1))
        whole[:n, :n], whole[n // 2, n] = Z, -2.0
        for k in range(power):
            whole[n + k, n + k + 1] = (power - k) / h
        end = np.abs(expm(whole * h)[:n, -1])
        for i, node in enumerate(NODES):
            exact = expm(whole * h * node)
            assert free[:, :, i] == pytest.approx(exact[:n, :n], rel=1e-6, abs=0.0)
            assert (np.abs(forced[:, :, i] @ NODES**power - exact[:n, -1]) < 1e-6 * end).all()


INPUTS = Inputs(1e-6, 0.0, 1.0, 0.0, 0, 0, 0.0, 0.0, 0, ideal_drive=False, magnet_engaged=True)


def test_collocation_is_the_default_of_split_only() -> None:
    assert load_scene("hammer").engine.rolling == "collocation"
    with pytest.raises(InputError, match=r"engine.rolling must be series with engine rk8; received 'collocation'"):
        load_scene("hammer", {"engine.name": "rk8", "engine.rolling": "collocation"})
    for rolling, size in (("collocation", layout.MEMORY), ("series", MEMORY)):
        simulation = Simulation(load_scene("hammer", {"engine.rolling": rolling}))
        changing = [getattr(simulation, name) for name in ("_motion", "_companion")]  # before the engine starts
        assert [len(motion.memory) for motion in changing] == [size, size]
    assert load_engine("split").memory_size == layout.MEMORY
    assert load_scene("hammer", {"engine.name": "rk8"}).engine.rolling == "series"


@pytest.mark.parametrize("changes", [{}, {"model__stator": "rigid"}, {"parameters": "dtu-2019"}])
def test_linear_bodies_are_the_kernels(changes: dict[str, Any]) -> None:
    constants = make_simulation("split", 1e-3, model__magnet="linear", **changes).model.constants
    # Weight turns the shaft, and with it the spin: no part of a linear body.
    constants = constants._replace(shaft=constants.shaft._replace(gravity=0.0))
    shafts, housings = body_matrices(pack_record(constants)[0], pack_record(INPUTS)[0])
    matrix = np.zeros((14, 14))
    for first, block in zip((0, 2, 4, 6, 10), (*shafts, *housings), strict=True):
        matrix[first : first + len(block), first : first + len(block)] = block
    small, found, out = 1e-6, np.empty((14, 14)), np.full(S.N_OBSERVED, np.nan)
    for column in range(14):
        sides = []
        for sign in (1.0, -1.0):
            y, dy = np.zeros(S.N_VECTOR), np.full(S.N_VECTOR, np.nan)
            y[ROWS_OF_STATE[column]] = sign * small * SIGN_OF_STATE[column]
            evaluate(constants, INPUTS, 0, 0.0, 1.0, FLIGHT, False, y, dy, out)
            sides.append(dy[ROWS_OF_STATE] * SIGN_OF_STATE)
        found[:, column] = (sides[0] - sides[1]) / (2.0 * small)
    # The unbalance rotates with the spin; it does not belong to a linear body.
    found[:4, 4:6] = 0.0
    assert np.abs(found - matrix).max() < 1e-6 * np.abs(matrix).max()
    assert found == pytest.approx(matrix, rel=1e-6, abs=1e-3)


@pytest.mark.parametrize(("tolerance", "error"), [(1e-2, 2e-3), (1e-4, 1e-4), (1e-6, 2e-6)])
def test_settled_whirl_agrees_with_the_series(tolerance: float, error: float) -> None:
    reference = make_simulation("taylor", 1e-11).advance(300_000).rows
    run = make_simulation("split", tolerance)
    first = run.first_row.copy()
    rows = run.advance(300_000).rows
    memory = memory_of(run)
    assert scaled_error(rows, reference) < error
    # The law applied to the polynomial's penetration would err by newtons.
    forces, exact = (each[:, S.COLUMN["normal_force"]] for each in (rows, reference))
    assert np.abs(forces - exact).max() < 2.0 * tolerance * exact.max()
    assert memory[ROLLED_S] > 0.15
    assert memory[CEILING] == 0.0
    ledger = energy_balance(rows, first)
    assert np.abs(ledger["residual"]).max() < 0.1 * tolerance * ledger["dissipated"].max() + 1e-6


@pytest.mark.parametrize("smoothing_speed", [5.0, 0.5])
def test_smoothed_friction_creeps_by_collocation(smoothing_speed: float) -> None:
    changes = {"model__friction": "smoothed", "contact__smoothing_speed": smoothing_speed}
    exact = make_simulation("taylor", 1e-11, **changes).advance(250_000).rows
    run = make_simulation("split", 1e-4, **changes)
    first = run.first_row.copy()
    rows = run.advance(250_000).rows
    assert memory_of(run)[ROLLED_S] > 0.1
    assert scaled_error(rows, exact) < 1e-4
    creep, friction = (S.COLUMN[name] for name in ("sliding_speed", "friction_force"))
    assert np.abs(exact[-20:, creep]).max() > 1e-3 * smoothing_speed * 1e-3
    # Between nodes as well: the law turns a few micrometres per second into newtons.
    assert np.abs(rows - exact)[100:, friction].max() < 1e-3 * np.abs(exact[100:, friction]).max()
    ledger = energy_balance(rows, first)
    assert np.abs(ledger["residual"]).max() < 1e-5 * ledger["dissipated"].max() + 1e-6


@pytest.mark.parametrize("tolerance", [1e-2, 3e-4])
def test_the_companion_also_rolls_and_estimates_the_error(tolerance: float) -> None:
    """Its steps are shorter. At equal steps it would share the error, because it uses the same constraint."""
    exact = make_simulation("taylor", 1e-11).advance(600_000).rows
    run = make_simulation("split", tolerance, engine__companion=True)
    rows = run.advance(600_000).rows
    own, finer = (run.snapshot().state[name].memory for name in ("_motion", "_companion"))
    assert finer[ROLLED_S] > 0.4
    assert finer[layout.ROLLING_STEPS] > own[layout.ROLLING_STEPS]
    away = (rows[:, : S.N_STATE] - exact[:, : S.N_STATE]) / S.STATE_SCALE
    error = float(np.sqrt(np.mean(away**2, axis=1)).max())
    assert 0.3 * error < run.health()["accuracy"]["estimate"] < 3.0 * error


def test_results_do_not_depend_on_the_division_into_calls() -> None:
    whole = make_simulation("split", 1e-3).advance(200_000).rows.copy()
    run = make_simulation("split", 1e-3)
    parts = np.concatenate([run.advance(1000 * n).rows.copy() for n in (61, 1, 1, 7, 30, 100)])
    assert memory_of(run)[layout.ROLLING_STEPS] > 0
    assert np.array_equal(whole, parts)


def test_a_command_ends_rolling_at_once() -> None:
    reference, run = make_simulation("taylor", 1e-11), make_simulation("split", 1e-4)
    for simulation in (reference, run):
        simulation.advance(150_000)
        simulation.submit("hammer", {"force_n": 40.0, "duration_ms": 3.0, "direction": "y"})
    assert memory_of(run)[layout.PLACES] > 0
    rows = run.advance(100_000).rows
    assert scaled_error(rows, reference.advance(100_000).rows) < 1e-3
    # A series keeps its initial sliding speed, and the whirl would drift by it.
    assert np.abs(rows[:3, S.COLUMN["sliding_speed"]]).max() < 1e-9


def test_slipping_contact_returns_to_a_series() -> None:
    # A drive that brakes hard: the normal force falls with the whirl, until friction can no longer hold.
    changes = {"drive__ramp_rate": 20.0, "drive__torque_gain": 1.0}
    reference, run = make_simulation("taylor", 1e-11, **changes), make_simulation("split", 1e-4, **changes)
    for simulation in (reference, run):
        simulation.advance(200_000)
        simulation.submit("speed", {"speed_hz": 1.0})
        simulation.advance(200_000)
    before = memory_of(run).copy()
    assert before[layout.PLACES] > 0
    rows, exact = run.advance(60_000).rows, reference.advance(60_000).rows
    after = memory_of(run)
    assert after[layout.PLACES] == 0
    assert before[PHASE] == ROLLING != after[PHASE]
    sliding = np.abs(rows[:, S.COLUMN["friction_force"]]) > 0.999 * 0.25 * rows[:, S.COLUMN["normal_force"]]
    assert (sliding & (rows[:, S.COLUMN["normal_force"]] > 0.0)).any()
    assert scaled_error(rows, exact) < 1e-3
