"""Taylor series: its coefficients, its events, and its uses.

| what                                   | must agree with                                          |
|----------------------------------------|----------------------------------------------------------|
| series of a ringing housing            | the cosine, and the cosine's own remainder after order 16 |
| first coefficients of any phase        | the kernels' equations, and how those change             |
| code of the series                     | the code that the equations generate now                 |
| first zero of a polynomial             | the roots from which it was constructed                  |
| one impact                             | its quadrature, to 1e-9                                  |
| first impacts under Coulomb's friction | heyoka on independent equations                          |
| the two laws of a contact left open    | rk8, which steps through them in time                    |
| impacts along a line, nothing turning  | rk8's impacts, with friction and without                 |
| rolling in a stiff, linear contact     | the required friction, whatever the depth                |
| steps of an impact                     | some 16, whatever the tolerance of the onset             |
| error over a ladder of tolerances      | falls at every rung                                      |
| energy residual                        | 0, within some tolerances                                |
| state at an instant                    | the same bits, however dense the rows are                |
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from replays.studies.common.random_scene import draw_scene
from replays.studies.peers import PEERS, Setting, scaled_error
from replays.studies.peers.common.window import cut_window
from replays.studies.stability.scenes.worker import Task, run_task
from replays.studies.stability.trials.flight import house_oscillator
from replays.studies.stability.trials.impacts import first_impact
from replays.studies.stability.trials.motion import move, quiet_inputs, state
from rig import load_scene, simulate
from rig.physics.engines import load_engine
from rig.physics.engines.common.memory import CEILING, CLAMPS, CONTACT_STEPS, CONTACTS, MEMORY, ONSET, PHASE, STEPS
from rig.physics.engines.tape.columns import EVENTS, ROOT, WIDTH
from rig.physics.engines.tape.taylor import SERIES as CODE
from rig.physics.engines.taylor.memory import ORDER, SERIES
from rig.physics.engines.taylor.polynomial import first_zero
from rig.physics.kernels import signals as S
from rig.physics.kernels.dynamics import evaluate
from rig.physics.kernels.laws.contact import BACKWARD, FLIGHT, FORWARD, ROLLING
from rig.run.simulation import Simulation
from tests.scenes import QUIET


def make_simulation(
    scene: str = "hammer", engine: str = "taylor", tolerance: float = 1e-9, **changes: Any
) -> Simulation:
    """Prepare a simulation with rows 1 ms apart; dots of dotted keys are written `__`."""
    dotted = {key.replace("__", "."): value for key, value in changes.items()}
    choice = {"engine.name": engine, "engine.tolerance": tolerance}
    return Simulation(load_scene(scene, {**QUIET, **choice, **dotted}))


def get_series(memory: np.ndarray) -> np.ndarray:
    """Return the coefficients in an engine's memory, shape (ORDER + 1, WIDTH)."""
    return memory[SERIES:][: (ORDER + 1) * WIDTH].reshape(ORDER + 1, WIDTH)


def compute_states(simulation: Simulation, duration_s: float) -> np.ndarray:
    """Return states on a grid of 1 ms, shape (n, 14)."""
    return simulation.advance(round(duration_s * 1e6)).rows[:, : S.N_STATE].copy()


def test_series_of_a_cosine_ends_with_its_own_remainder() -> None:
    constants, mode = house_oscillator()
    # Exactly the preload that the transducers need: their difference is the pair's force.
    constants = constants._replace(house=constants.house._replace(preload=1e3))
    angular, amplitude = 2.0 * math.pi * mode.frequency_hz, 1e-6
    y = state(y_ih=amplitude * mode.inner, y_oh=amplitude * mode.outer)
    memory, rows = np.zeros(MEMORY), np.empty((1, S.N_ROW))
    inputs = quiet_inputs(tick_s=1e-6)
    # A loose tolerance, for a long series.
    engine = load_engine("taylor")
    engine.start(constants, inputs, y, memory, 1.0, 1e-1)
    engine.advance(constants, inputs, y, memory, 0, 1, 1, 1, rows)
    series = get_series(memory)
    times = np.array([2.0, 2.5, 3.0, 3.5]) / angular
    errors = []
    for time in times:
        value = np.polynomial.polynomial.polyval(time, series[:, 4])
        error = abs(value / (amplitude * mode.inner) - math.cos(angular * time))
        # The cosine has even powers only: the remainder begins with the 18th.
        assert error == pytest.approx((angular * time) ** 18 / math.factorial(18), rel=0.05)
        errors.append(error)
    slope = np.polyfit(np.log(times), np.log(errors), 1)[0]
    assert slope == pytest.approx(ORDER + 2, abs=0.15)


@pytest.mark.parametrize("phase", [FLIGHT, FORWARD, BACKWARD, ROLLING])
@pytest.mark.parametrize("mode", ["torque", "ideal"])
def test_first_coefficients_are_the_equations(phase: int, mode: str) -> None:
    simulation = make_simulation(drive__mode=mode, model__magnet="cylinders")
    simulation.advance(22_000)  # into the impact
    constants, inputs = simulation.model.constants, simulation._inputs()
    # A state of that phase: in the ring or pushed into it, spinning either way.
    contact = constants.contact
    height = contact.clearance + contact.offset_y + (-2e-4 if phase == FLIGHT else 2e-5)
    y = state(
        Gamma=-height / constants.shaft.arm_ring, beta=3e-4, theta=0.7, x_ih=2e-6, y_ih=-1e-6, x_oh=1e-6, y_oh=2e-6,
        Gamma_rate=-0.1, beta_rate=-0.7, theta_rate=-35.0 if phase == BACKWARD else 35.0, vx_ih=1e-3, vy_ih=2e-3,
        vx_oh=-1e-3, vy_oh=1e-3,
    )  # fmt: skip
    memory = np.zeros(MEMORY)
    engine = load_engine("taylor")
    engine.start(constants, inputs, y, memory, 1.0, 1e-9)
    memory[PHASE], memory[ONSET] = phase, 0.1
    before = y.copy()
    engine.advance(constants, inputs, y, memory, simulation.tick, 1, 0, 1, np.empty((0, S.N_ROW)))
    series = get_series(memory)

    def rates(at: np.ndarray, fraction: float) -> np.ndarray:
        dy, out = np.empty(S.N_VECTOR), np.empty(S.N_OBSERVED)
        evaluate(constants, inputs, simulation.tick, fraction, memory[ONSET], phase, True, at, dy, out)
        return dy

    dy = rates(before, 0.0)
    slow = series[0, ROOT] if phase in (FORWARD, BACKWARD) else 1.0
    first = series[1] / slow
    np.testing.assert_allclose(first[: S.N_VECTOR], dy, rtol=1e-9, atol=1e-12)
    if phase in (FLIGHT, ROLLING):
        # The second ones by a central difference along the motion.
        step = 1e-7
        ahead, behind = np.empty(S.N_VECTOR), np.empty(S.N_VECTOR)
        for place, sign in ((ahead, 1.0), (behind, -1.0)):
            place[:] = [np.polynomial.polynomial.polyval(sign * step, series[:, i]) for i in range(S.N_VECTOR)]
        change = (rates(ahead, step / inputs.tick_s) - rates(behind, -step / inputs.tick_s)) / (2.0 * step)
        size = np.abs(change) + np.abs(dy) / 1e-3
        assert (np.abs(2.0 * series[2, : S.N_VECTOR] - change) / np.maximum(size, 1e-9)).max() < 1e-5


def test_the_code_of_the_series_is_up_to_date() -> None:
    code = "import sys; from rig.physics.engines.tape.taylor import source; sys.stdout.write(source())"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    generated = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert generated.stdout == CODE.read_text(), (
        "regenerate it: NUMBA_DISABLE_JIT=1 python -m rig.physics.engines.tape.taylor"
    )


def test_first_zero_of_a_polynomial() -> None:
    def column(roots: list[complex], sign: float = 1.0) -> np.ndarray:
        table = np.zeros((ORDER + 1, WIDTH))
        coefficients = np.real(np.polynomial.polynomial.polyfromroots(roots))
        table[: len(coefficients), EVENTS] = sign * coefficients
        return table

    def zero(table: np.ndarray, shift: int = 0, length: float = 1.0) -> float:
        return first_zero(table, EVENTS, shift, length)

    assert zero(column([0.3, 0.7, 2.0], -1.0)) == pytest.approx(0.3, abs=1e-14)
    assert zero(column([0.9, 1.5])) == pytest.approx(0.9, abs=1e-14)
    assert zero(column([1.1, 1.5])) == math.inf
    # Twice through 0 between two samples.
    assert zero(column([0.55, 0.5501])) == pytest.approx(0.55, abs=1e-12)
    # No zero.
    assert zero(column([0.55 + 1e-4j, 0.55 - 1e-4j])) == math.inf
    # On the wrong side from the start; and at 0 by the previous state, once or twice.
    assert zero(column([-0.5])) == math.inf
    assert zero(column([-0.5], -1.0)) == 0.0
    assert zero(column([0.0, 0.4], -1.0), 1) == pytest.approx(0.4, abs=1e-14)
    assert zero(column([0.0, 0.0, 0.8], -1.0), 2) == pytest.approx(0.8, abs=1e-14)


@pytest.mark.parametrize("speed", [0.3, 0.01])
def test_an_impact_is_its_quadrature(speed: float) -> None:
    errors = first_impact("taylor", speed, tolerance=1e-13)
    assert max(errors.values()) < 1e-9, errors


def test_first_impacts_agree_with_heyoka() -> None:
    pytest.importorskip("heyoka")
    problem = cut_window(load_scene("hammer"), end_s=0.05, sample_s=1e-3, friction="exact")
    peer = PEERS["heyoka"].solve(problem, Setting("1e-15", 1e-15), budget_s=100.0)
    assert peer.failure is None
    simulation = make_simulation(tolerance=1e-12)
    assert scaled_error(compute_states(simulation, 0.05), peer.states[:50]) < 1e-9
    assert simulation._motion.memory[CONTACTS] == len(peer.onsets) == 16
    # Sixteen impacts of a hundred steps each, by a series in time alone.
    assert simulation._motion.memory[CONTACT_STEPS] < 30 * 16


def scale_states(motion: np.ndarray) -> np.ndarray:
    """Return states in units of their scales."""
    from rig.physics.engines.common.method import PER_SCALE

    return motion * PER_SCALE


CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "transducers lose their preload": ("hammer", {"house__preload": 200.0}),
    "the law would pull": ("hammer", {"contact__damping_factor": "kelvin-voigt"}),
    "another exponent": ("hammer", {"contact__exponent": 1.3}),
    "smoothed friction": ("hammer", {"model__friction": "smoothed"}),
    "ideal drive": ("hammer", {"drive__mode": "ideal"}),
    "magnets one by one": ("hammer", {"model__magnet": "cylinders"}),
    "ideal drive and magnets one by one": ("hammer", {"model__magnet": "cylinders", "drive__mode": "ideal"}),
    "gap as printed": ("hammer", {"parameters": "as-printed"}),
    "small angles, fixed ring": ("hammer", {"model__shaft": "planar", "model__stator": "rigid"}),
    "no outer house": ("hammer", {"model__stator": "inner-house"}),
    "at rest along the ring": ("drop", {}),
}


@pytest.mark.parametrize("case", CASES)
def test_agrees_with_rk8(case: str) -> None:
    scene, changes = CASES[case]
    one, other = (
        make_simulation(scene, tolerance=1e-11, **changes),
        make_simulation(scene, "rk8", 1e-11, engine__step_us=5, **changes),
    )
    # Sixteen impacts amplify an error a thousand times: compare up to the fourth.
    first, second = scale_states(compute_states(one, 0.034)), scale_states(compute_states(other, 0.034))
    assert one._motion.memory[CONTACTS] == other._motion.memory[CONTACTS] > 0
    assert np.sqrt(np.mean((first - second) ** 2)) < 1e-8
    # The ledger's columns against the largest of their kind.
    ledger = slice(S.N_STATE, S.N_VECTOR)
    np.testing.assert_allclose(one._motion.y[ledger], other._motion.y[ledger], rtol=1e-7, atol=1e-9)
    if "pull" in case:
        assert one._motion.memory[CLAMPS] > 0


def test_the_error_falls_with_the_tolerance_and_the_ledger_closes() -> None:
    exact = scale_states(compute_states(make_simulation(tolerance=1e-13), 0.05))
    errors = []
    for tolerance in (1e-5, 1e-6, 1e-7, 1e-8, 1e-9):
        simulation = make_simulation(tolerance=tolerance)
        errors.append(float(np.sqrt(np.mean((scale_states(compute_states(simulation, 0.05)) - exact) ** 2))))
        assert abs(simulation.health()["energy"]["residual_share"]) < 100.0 * tolerance
        assert simulation._motion.memory[CEILING] == 0.0
    assert all(fine < 0.3 * coarse for coarse, fine in pairwise(errors)), errors
    assert errors[-1] < 1e-8


def test_rows_change_no_bit_and_a_new_input_ends_a_series() -> None:
    dense = make_simulation(sensors__rate_hz=40_000, sensors__truth_rate_hz=40_000)
    sparse = make_simulation()
    rows = np.concatenate([dense.advance(25).rows.copy() for _ in range(30_000 // 25)])
    assert rows[::40].tobytes() == sparse.advance(30_000).rows.tobytes()
    # A series of a quiet flight extends beyond the command: it is not valid there.
    early, late = make_simulation("stable-run"), make_simulation("stable-run", "rk8", 1e-11)
    for simulation in (early, late):
        simulation.advance(7_000)
        simulation.submit("hammer", {"force_n": 20.0, "duration_ms": 2.0})
    one, other = scale_states(compute_states(early, 0.02)), scale_states(compute_states(late, 0.02))
    assert np.abs(other[:, 8]).max() > 1e-2
    assert np.abs(one - other).max() < 1e-9


def test_a_long_flight_takes_few_steps() -> None:
    simulation = make_simulation("stable-run")
    simulation.advance(500_000)
    assert simulation._motion.memory[STEPS] <= 150
    motion = move("taylor", simulation.model.constants, quiet_inputs(magnets=True), state(beta=1e-4), ticks=1000)
    assert motion.contacts == 0


@pytest.mark.parametrize("stiffness", ["johnson-cylinder", "palmgren-cylinder", "liu-cylinder"])
def test_the_peak_agrees_with_the_law_for_every_exponent(stiffness: str) -> None:
    # Close to an onset the series of delta^n is useless, and a series' own force there was 562 kN.
    changes = {"contact.stiffness": stiffness, "sensors.chain": "ideal"}
    peaks = [
        simulate("hammer", {**changes, "engine.name": name}, duration_s=0.04).simulation.health()
        for name in ("taylor", "rk8")
    ]
    assert peaks[0]["peak_normal_force_n"] == pytest.approx(peaks[1]["peak_normal_force_n"], rel=3e-3)
    assert peaks[0]["contacts"] == peaks[1]["contacts"]
    assert not peaks[0]["warnings"]


@pytest.mark.parametrize("friction", [0.0, 0.22])
@pytest.mark.parametrize("force", [300.0, 320.0, 330.0])
def test_motion_along_a_line_continues_after_contact(friction: float, force: float) -> None:
    # At a sliding speed of exactly 0, phases that change at one depth change back at once.
    impact = {"at_s": 0.018, "command": "hammer", "force_n": force, "duration_ms": 1.0, "direction": "y"}
    changes = {**QUIET, "model.stator": "rigid", "drive.speed_hz": 0.0, "ring.clearance": 0.2685, "commands": [impact]}
    changes |= {"contact.restitution": 0.9478, "contact.friction": friction}
    one, other = (
        simulate("hammer", {**changes, "engine.name": name}, duration_s=0.05).simulation for name in ("taylor", "rk8")
    )
    assert one._motion.memory[CONTACTS] == other._motion.memory[CONTACTS] > 1
    assert np.abs(scale_states(one._motion.y[: S.N_STATE]) - scale_states(other._motion.y[: S.N_STATE])).max() < 1e-6
    assert one._motion.memory[STEPS] < 400
    assert not one.health()["warnings"]


def test_a_contact_with_a_small_onset_speed_continues() -> None:
    # It begins deeper than it may without friction: rolling began before the ring, where there is no force.
    run = {name: run_task(Task(draw_scene(21, 385), name, 1e-9)) for name in ("taylor", "rk8")}
    assert [done.failure for done in run.values()] == ["", ""]
    assert scaled_error(run["taylor"].states, run["rk8"].states) < 1e-5


def test_a_stiff_linear_contact_rolls() -> None:
    rows = []
    for name in ("taylor", "rk8"):
        law = {"contact__stiffness": 5.8e11, "contact__damping_factor": "kelvin-voigt"}
        simulation = make_simulation("drop", name, **law)
        simulation.advance(310_000)  # to rest, 20 pm deep
        parts = []
        for force in (2.0, 100.0):  # along the ring: friction stops the shaft under one of them
            simulation.submit("hammer", {"force_n": force, "duration_ms": 2.0, "direction": "x"})
            parts.append(simulation.advance(10_000).rows.copy())
        rows.append(np.concatenate(parts))
    one, other = (each[:, S.N_VECTOR + S.FRICTION_FORCE] for each in rows)
    assert np.abs(other).max() > 7.0
    np.testing.assert_allclose(one, other, atol=0.01)
    assert np.abs(scale_states(rows[0][:, : S.N_STATE] - rows[1][:, : S.N_STATE])).max() < 1e-4
