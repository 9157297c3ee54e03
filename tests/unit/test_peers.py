"""Third-party solvers on the rig's equations: they solve the same problem, or report that they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from replays.studies.peers import ERROR_SCALE, PEERS, Library, Peer, Problem, Setting, scaled_error
from replays.studies.peers.common.reference import find_reference
from replays.studies.peers.common.right_hand_side import derivative, jacobian, pack, switching
from replays.studies.peers.common.solution import MISSED_HAMMER
from replays.studies.peers.common.window import cut_window
from replays.studies.peers.plain_python import PlainPython
from rig.base.errors import InputError
from rig.physics.kernels.laws.contact import BACKWARD, FLIGHT, FORWARD, ROLLING, TOUCHING
from rig.physics.kernels.signals import STATE_SCALE
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

LIBRARY = {name: peer.module for name, peer in PEERS.items()}


def problem(end_s: float, *, scene: str = "hammer", changes: dict | None = None, **options) -> Problem:
    options = {"friction": "smoothed", "sample_s": 1e-3} | options
    return cut_window(load_scene(scene, changes), end_s=end_s, **options)


def solve(name: str, given: Problem, tolerance: float, **options):
    if LIBRARY[name]:
        pytest.importorskip(LIBRARY[name], reason=f"{name} needs the extra `peers`")
    return PEERS[name].solve(given, Setting(f"{tolerance:g}", tolerance), **options)


def states_in_contact(given: Problem, *, count: int) -> np.ndarray:
    """Return states around the ring, shape (count, 14); the housings move less than a transducer's preload."""
    rng = np.random.default_rng(1)
    spread = STATE_SCALE * [0.05, 0.0, 1.0, 0.3, 0.3, 0.3, 0.3, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    y = given.y0 + rng.normal(size=(count, 14)) * spread
    y[:, 1] = (0.94e-3 + y[:, 3]) / given.constants.shaft.arm_ring
    return y


@pytest.mark.parametrize("scene", ["hammer", "drop", "run-up", "stable-run"])
def test_a_problem_has_the_initial_state_of_the_simulation(scene: str) -> None:
    simulation = Simulation(load_scene(scene))
    given = cut_window(load_scene(scene), end_s=0.01)
    np.testing.assert_array_equal(given.y0, simulation.first_row[:14])
    drive = ("speed", "speed_slope", "speed_tick", "ideal_drive", "magnet_engaged", "tick_s")
    inputs = simulation._inputs()
    assert [getattr(given.inputs, name) for name in drive] == [getattr(inputs, name) for name in drive]
    assert given.constants == simulation.model.constants


def test_a_window_ends_where_the_inputs_change() -> None:
    scene = load_scene("hammer", {"commands": [{"at_s": at, "command": "hammer"} for at in (0.02, 0.05)]})
    assert cut_window(scene, end_s=0.05).corners == pytest.approx((0.02, 0.025))
    with pytest.raises(InputError, match=r"at most 0\.05 s"):
        cut_window(scene, end_s=0.051)
    with pytest.raises(InputError, match="end_s"):
        cut_window(scene, end_s=0.0)


@pytest.mark.parametrize("changes", [{}, {"drive.mode": "ideal"}, {"parameters": "as-printed"}])
@pytest.mark.parametrize("phase", [FLIGHT, TOUCHING])
def test_compiled_and_plain_python_are_the_same_equations(changes: dict, phase: int) -> None:
    # Euler's equations in the rotating frame against Lagrange's in the angles.
    given = replace(problem(0.03, changes=changes), phase=phase, onset_speed=0.1)
    parameters, plain = pack(given), PlainPython(given)
    for y in states_in_contact(given, count=8):
        wanted = np.array(plain.rates(0.0213, y))
        np.testing.assert_allclose(derivative(0.0213, y, parameters), wanted, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(switching(0.0213, y, parameters), plain.switching(0.0213, y), atol=1e-15)


def test_the_matrix_of_the_implicit_methods_is_the_slope_of_the_rates() -> None:
    given = replace(problem(0.03), phase=TOUCHING, onset_speed=0.1)
    parameters = pack(given)
    for y in states_in_contact(given, count=3):
        slopes = jacobian(0.0213, y, parameters)
        for i in range(14):
            step = np.zeros(14)
            step[i] = 1e-6 * STATE_SCALE[i]
            change = derivative(0.0213, y + step, parameters) - derivative(0.0213, y - step, parameters)
            found, wanted = slopes @ (2.0 * step) / STATE_SCALE, change / STATE_SCALE
            np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-3 * np.max(np.abs(wanted)))


@pytest.mark.parametrize("changes", [{}, {"drive.mode": "ideal"}, {"model.magnet": "cylinders"}])
@pytest.mark.parametrize("phase", [FLIGHT, TOUCHING, FORWARD, ROLLING])
def test_heyoka_has_the_same_equations(changes: dict, phase: int) -> None:
    # The direction vector of the axis against the angles: compared through the flow, by a difference quotient.
    hy = pytest.importorskip("heyoka", reason="needs the extra `peers`")
    from replays.studies.peers import taylor_equations as taylor

    given = replace(problem(0.03, changes=changes), phase=phase, onset_speed=0.1)
    parameters = pack(given)
    kind = taylor.system_kind(given, phase, pulse_on=True)._replace(exact=phase in (FORWARD, ROLLING))
    variables, rates, _ = taylor.equations(kind)
    function = hy.cfunc(rates, vars=variables)
    numbers = taylor.parameter_values(given)
    values = np.array([numbers[name] for name in taylor.PARAMETERS])[: function.nparams]
    ideal = given.inputs.ideal_drive
    for y in states_in_contact(given, count=4):
        dy = derivative(0.0213, y, parameters)
        step = 1e-6 / np.max(np.abs(dy / STATE_SCALE))
        ahead, behind = (taylor.to_series(y + way * step * dy, ideal_drive=ideal) for way in (1.0, -1.0))
        wanted = (ahead - behind) / (2.0 * step)
        found = function(taylor.to_series(y, ideal_drive=ideal), pars=values, time=0.0213)
        np.testing.assert_allclose(found, wanted, atol=1e-8 * np.max(np.abs(wanted)))


@pytest.mark.parametrize("phase", [FLIGHT, BACKWARD, ROLLING])
def test_diffrax_has_the_equations_of_heyoka(phase: int) -> None:
    jax = pytest.importorskip("jax", reason="needs the extra `peers`")
    hy = pytest.importorskip("heyoka", reason="needs the extra `peers`")
    from replays.studies.peers import taylor_equations as taylor
    from replays.studies.peers.diffrax_solver import evaluate

    given = replace(problem(0.03), phase=phase, onset_speed=0.1)
    kind = taylor.system_kind(given, phase, pulse_on=True)._replace(exact=True)
    variables, rates, _ = taylor.equations(kind)
    function = hy.cfunc(rates, vars=variables)
    numbers = taylor.parameter_values(given)
    values = np.array([numbers[name] for name in taylor.PARAMETERS])
    for y in states_in_contact(given, count=2):
        scaled = taylor.to_series(y, ideal_drive=False)
        wanted = function(scaled, pars=values[: function.nparams], time=0.0213)
        with jax.enable_x64(True):
            found = np.array(evaluate(kind, 0.0213, scaled, values)[0])
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-12 * np.max(np.abs(wanted)))


@pytest.mark.parametrize(("friction", "contact"), [("smoothed", {}), ("exact", {"damping_factor": 0.0})])
@pytest.mark.parametrize(("name", "tolerance", "within"), [("heyoka", 1e-15, 1e-8), ("cvode-adams", 1e-13, 2e-7)])
def test_tight_solvers_agree(name: str, tolerance: float, within: float, friction: str, contact: dict) -> None:
    # 0.05 s: 14 to 16 contacts; exact and memoryless, they roll as well.
    given = problem(0.05, friction=friction, **contact)
    found = solve(name, given, tolerance)
    wanted = solve("scipy-dop853", given, 1e-13)
    assert found.failure is None
    assert wanted.failure is None
    assert (found.contacts, found.switches) == (wanted.contacts, wanted.switches)
    assert wanted.contacts >= 14
    assert (wanted.switches > 2 * wanted.contacts) == (friction == "exact")
    assert scaled_error(found.states, wanted.states) < within
    np.testing.assert_allclose(found.onsets, wanted.onsets, rtol=1e-5, atol=1e-6)


def test_a_contact_without_sliding_rolls_from_the_start() -> None:
    # A drop from the top is symmetric: friction does no work, and must not create a direction.
    given = problem(0.055, scene="drop", friction="exact")
    for name, tolerance in (("scipy-dop853", 1e-9), ("cvode-adams", 1e-10), ("heyoka", 1e-12)):
        if not PEERS[name].installed:
            continue
        solution = solve(name, given, tolerance)
        assert solution.failure is None
        assert solution.contacts == 2
        assert solution.switches == 4
        assert np.max(np.abs(solution.states[:, [1, 2, 3, 5, 9]])) < 1e-12


def test_a_drop_without_sliding_does_not_stall_at_tensile_force() -> None:
    # Friction and normal force reach 0 at one instant: a loose series must not keep sliding under a tensile force.
    given = problem(0.5, scene="drop", friction="exact")
    solution = solve("heyoka", given, 1e-4)
    assert solution.failure is None
    assert solution.switches < 200


def test_the_time_of_a_library_without_python_is_reported() -> None:
    given = problem(0.03)
    led = solve("heyoka", given, 1e-8)
    assert led.own_s is not None
    assert 0.0 < led.own_s < led.cpu_s
    assert solve("cvode-adams", given, 1e-8).own_s is None


def test_a_drop_meets_the_ring_after_the_time_of_a_pendulum() -> None:
    # Rigid pendulum under gravity from r0 above the ring's centre to r0 below: physics.md's 25.6 ms and 0.145 m/s,
    # here by energy: Ixx G'^2 / 2 = M g l0C (sin G1 - sin G0).
    given = problem(0.03, scene="drop")
    shaft, contact = given.constants.shaft, given.constants.contact
    (time_s, speed), *_ = solve("scipy-dop853", given, 1e-10).onsets
    top, bottom = (contact.offset_y + way * contact.clearance for way in (1.0, -1.0))
    gained = shaft.mass * shaft.gravity * shaft.arm_centre * (top - bottom) / shaft.arm_ring
    rate = np.sqrt(2.0 * gained / shaft.transverse_inertia)
    lean = np.sqrt(1.0 - (bottom / shaft.arm_ring) ** 2)
    assert speed == pytest.approx(shaft.arm_ring * lean * rate, rel=1e-6)
    fall = shaft.mass * shaft.gravity * shaft.arm_centre / shaft.transverse_inertia
    assert time_s == pytest.approx(rate / fall, rel=1e-4)  # except for the inclination of a hundredth


@pytest.mark.parametrize("name", PEERS)
def test_every_peer_flies(name: str) -> None:
    if not PEERS[name].quick:
        pytest.skip("compiles for a minute; its equations are compared by themselves")
    given = problem(0.004, friction=None if PEERS[name].exact_friction else "smoothed")
    wanted = solve("scipy-dop853", given, 1e-12)
    if LIBRARY[name]:
        pytest.importorskip(LIBRARY[name], reason=f"{name} needs the extra `peers`")
    solution = PEERS[name].solve(given)
    assert solution.failure is None
    assert solution.states.shape == (5, 14)
    assert solution.contacts == 0
    assert solution.steps > 0 or name.endswith("-python")
    assert solution.evaluations > 0
    assert scaled_error(solution.states, wanted.states) < 1e-4


def test_cvode_is_the_same_compiled_and_as_installed() -> None:
    given = problem(0.03)
    wanted = solve("scipy-dop853", given, 1e-11)
    errors = []
    for name in ("cvode-bdf", "cvode-bdf-python"):
        solution = solve(name, given, 1e-7)
        assert solution.contacts == 2
        errors.append(scaled_error(solution.states, wanted.states))
    assert max(errors) < 1e-4
    assert max(errors) < 5.0 * min(errors)


def test_sampling_does_not_change_the_steps_of_cvode() -> None:
    coarse, fine = (solve("cvode-adams", problem(0.03, sample_s=every), 1e-6) for every in (1e-3, 1e-4))
    assert coarse.evaluations == fine.evaluations
    np.testing.assert_array_equal(coarse.states, fine.states[::10])


@pytest.mark.parametrize("name", ["cvode-bdf", "scipy-bdf"])
def test_without_stops_a_short_pulse_is_stepped_over(name: str) -> None:
    pulse = {"at_s": 0.1, "command": "hammer", "force_n": 400.0, "duration_ms": 1.0}
    given = problem(0.12, changes={"commands": [pulse]})
    missed = solve(f"{name}-no-stops", given, 1e-4)
    assert missed.failure == MISSED_HAMMER
    assert missed.contacts == 0
    hit = solve(name, given, 1e-4)
    assert hit.failure is None
    assert hit.contacts > 0


def test_without_events_a_tight_tolerance_does_not_help() -> None:
    # The impact speed is latched at a step's end, inside the contact, where the approach has slowed down.
    given = problem(0.05)
    wanted = solve("scipy-dop853", given, 1e-12)
    located, late = (solve(name, given, 1e-8) for name in ("scipy-dop853", "scipy-dop853-no-events"))
    assert late.onsets[0][0] > located.onsets[0][0]
    assert late.onsets[0][1] < located.onsets[0][1]
    assert scaled_error(located.states, wanted.states) < 1e-4
    assert scaled_error(late.states, wanted.states) > 1e-3


def test_mujoco_flies_with_first_order() -> None:
    given = problem(0.025)  # the hammer's pulse, no contact
    wanted = solve("scipy-dop853", given, 1e-10)
    coarse, fine = (solve("mujoco", given, step).states for step in (4e-5, 2e-5))
    ratio = scaled_error(coarse, wanted.states) / scaled_error(fine, wanted.states)
    assert ratio == pytest.approx(2.0, abs=0.1)
    assert scaled_error(fine, wanted.states) < 1e-3


@pytest.mark.parametrize("name", ["scipy-dop853", "scipy-bdf-python", "cvode-adams", "cvode-bdf-python", "heyoka"])
def test_a_spent_budget_is_a_failure_and_no_exception(name: str) -> None:
    solution = solve(name, problem(0.05), 1e-12, budget_s=0.0)
    assert solution.failure is not None
    assert "budget" in solution.failure
    assert np.isnan(solution.states[-1]).all()


def test_an_unsupported_problem_of_a_peer_is_a_failure() -> None:
    exact = problem(0.01, friction="exact")
    for name in ("scipy-bdf-python", "scipy-bdf-no-events"):
        failure = solve(name, exact, 1e-6).failure
        assert failure is not None
        assert "friction" in failure


def test_a_state_that_pulses_up_is_a_failure() -> None:
    given = problem(0.01)
    wild = replace(given, y0=np.where(np.arange(14) == 3, 1e200, given.y0))
    assert solve("scipy-dop853", wild, 1e-6, budget_s=5.0).failure is not None


def test_a_missing_library_names_the_extra() -> None:
    peer = Peer("none", "None", Library("none", "scipy_solvers", "no_such_solver"), (Setting("1", 1.0),))
    assert not peer.installed
    with pytest.raises(InputError, match=r"rotor-stator-rig\[peers\]"):
        peer.solve(problem(0.01))


def test_error_is_the_rms_of_the_scaled_states() -> None:
    a, b = np.zeros((3, 14)), np.zeros((3, 14))
    b[:, [0, 1, 3, 4, 7, 8, 9]] = 2.0 * ERROR_SCALE
    b[:, [2, 5, 6, 10, 11, 12, 13]] = 1e9  # no part of it
    assert scaled_error(a, b) == pytest.approx(2.0)


def test_reference_has_an_error_bar_of_two_unlike_codes() -> None:
    reference = find_reference(problem(0.03))
    if reference is None:
        pytest.skip("needs the extra `peers`")
    assert reference.independent == PEERS["heyoka"].installed
    assert 0.0 < reference.error < 1e-8
