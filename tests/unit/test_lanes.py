"""The batch kernel: its equations against those of the engines, its runs against the engines, independence of lanes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import rig
import rig.run.scenes
from rig.base.errors import InputError
from rig.ensemble import batch as batches
from rig.ensemble import lanes as L
from rig.ensemble.batch import QUANTITIES, Batch
from rig.physics.kernels import signals as S
from rig.physics.kernels.dynamics import axis_acceleration, evaluate
from rig.physics.kernels.frames.axis import axis_from_angles
from rig.physics.kernels.frames.geometry import State, compute_pose
from rig.physics.kernels.laws.contact import BACKWARD, FLIGHT, FORWARD, ROLLING
from rig.run.simulation import Simulation

NUMBERS = [name for name, quantity in QUANTITIES.items() if quantity.kind == "number" and name != "steps"]

LAW = {"contact.damping_factor": 0.4, "contact.viscous_damping": 20.0}


@pytest.mark.parametrize("shaft", ["euler", "planar"])
@pytest.mark.parametrize("phase", [FLIGHT, FORWARD, BACKWARD, ROLLING])
def test_the_rates_are_those_of_the_model(phase: int, shaft: str) -> None:
    scene = rig.load_scene(
        "hammer", {"contact.damping_factor": 0.4, "contact.viscous_damping": 20.0, "model.shaft": shaft}
    )
    simulation = Simulation(scene)
    constants, rng = simulation.model.constants, np.random.default_rng(phase)
    inputs = simulation._inputs()._replace(
        hammer_force=80.0,
        hammer_x=0.6,
        hammer_y=0.8,
        hammer_start=1000,
        hammer_end=5000,
        speed_slope=3.0,
        speed_tick=500,
    )
    m = np.zeros(L._ROWS * L.LANES)
    rows = m.reshape(-1, L.LANES)
    scales = np.array([5e-3, 5e-3, 1.0, 2e-5, 2e-5, 2e-5, 2e-5, 1.0, 1.0, 40.0, 0.1, 0.1, 0.1, 0.1])
    expected = np.zeros((L.N_VECTOR, L.LANES))
    for lane in range(L.LANES):
        y = np.zeros(S.N_VECTOR)
        y[: S.N_STATE] = scales * rng.normal(size=S.N_STATE)
        angle = rng.uniform(-math.pi, math.pi)  # in the ring, 5 um deep
        reach = constants.contact.clearance + 5e-6
        along = simulation.model.state(ring_x=y[3] + reach * math.cos(angle), ring_y=y[4] + reach * math.sin(angle))
        y[:2] = along[:2]
        dy, out = np.zeros(S.N_VECTOR), np.zeros(S.N_OBSERVED)
        tick, onset = 1000 + 400 * lane, 0.05
        evaluate.py_func(constants, inputs, tick, 0.25, onset, phase, True, y, dy, out)
        state = State(*y[: S.N_STATE])
        pose = compute_pose.py_func(constants.levels, state)
        acceleration = axis_acceleration.py_func(state, pose, dy[S.GAMMA_RATE], dy[S.BETA_RATE])
        ux, uy, px, py = axis_from_angles(constants.levels.euler, y[0], y[1], y[7], y[8])
        houses = y[3:7], y[10:14]
        rows[L._Z : L._Z + 14, lane] = [ux, uy, px, py, pose.w, y[2], *houses[0], *houses[1]]
        rows[L._Z + L.TIME, lane] = (tick + 0.25) * 1e-6
        depth = out[S.PENETRATION]
        rows[L._Z + L.ROOT, lane] = math.sqrt(max(depth, 0.0))
        own = rows[L._C :, lane]
        own[: L.N_CONSTANTS] = batches._constants_row(simulation.model)
        own[L.HAMMER : L.ENGAGED + 1] = [80.0, 0.6, 0.8, 1e-3, 250.0, inputs.speed, 3.0, 5e-4, 1.0]
        slides = phase in (FORWARD, BACKWARD)
        sign = {FORWARD: 1.0, BACKWARD: -1.0}.get(phase, 0.0)
        own[L.TOUCHING : L.ONSET + 1] = [phase != FLIGHT, slides, sign, phase == ROLLING, onset]
        w_rate = dy[S.THETA_RATE] + (
            (acceleration_spin(pose, state, dy[S.GAMMA_RATE])) if constants.levels.euler else 0.0
        )
        speed = math.sqrt(depth) if slides else 1.0
        losses = sum(
            dy[S.N_STATE + [each.name for each in S.INTEGRALS].index(name)]
            for name in ("bearing_loss", "house_loss", "contact_loss", "friction_loss")
        )
        supplied = dy[S.DRIVE_WORK] + dy[S.HAMMER_WORK] + dy[S.UNBALANCE_WORK]
        column = [px, py, acceleration[0], acceleration[1], w_rate, dy[S.THETA], *dy[3:7], *dy[10:14], 1.0]
        expected[:, lane] = [
            *(speed * each for each in column),
            0.5 * slides * out[S.PENETRATION_RATE],
            speed * dy[S.CONTACT_IMPULSE],
            speed * (supplied - losses),
            speed * losses,
        ]
    L.evaluate(m)
    computed = rows[L._D : L._D + L.N_VECTOR]
    scale = np.abs(expected).max(axis=1, keepdims=True) + 1e-12
    assert np.abs(computed - expected).max() > 0.0  # two independent ways
    np.testing.assert_allclose(computed / scale, expected / scale, atol=2e-9 if phase != FLIGHT else 1e-11)


def acceleration_spin(pose: Any, state: Any, gamma_rate: float) -> float:
    """Return the rate of Gamma' sin b, the difference between w and theta'."""
    return gamma_rate * pose.sb + state.dG * state.db * pose.cb


def draw(n: int, seed: int = 0, **scene: Any) -> tuple[Batch, np.ndarray]:
    """Return a batch over friction, impulse and clearance, and values in which half of the runs whirl."""
    rng = np.random.default_rng(seed)
    loaded = rig.load_scene("hammer", {"duration_s": 0.6, **scene})
    batch = Batch(loaded, ["contact.friction", "hammer.force_n", "ring.clearance"])
    return batch, rng.uniform([0.02, 20.0, 0.8], [0.4, 150.0, 1.05], (n, 3))


def test_outcomes_and_forces_are_those_of_another_engine() -> None:
    batch, values = draw(24)
    lanes = batch.run(values)
    taylor = draw(24, **{"engine.name": "taylor"})[0].run(values)
    assert lanes["engine"].tolist() == ["lanes"] * 24
    assert taylor["engine"].tolist() == ["taylor"] * 24
    assert lanes["outcome"].tolist() == taylor["outcome"].tolist()
    assert {"free", "backward whirl"} <= {*lanes["outcome"]}
    assert lanes["trusted"].all()
    for name, share, close in (
        ("first_contact_s", 24, 3e-3), ("peak_force_n", 20, 1e-2), ("peak_radius_mm", 20, 1e-2),
        ("peak_reaction_x_n", 20, 2e-2), ("time_to_whirl_s", 16, 1e-2),
    ):  # fmt: skip
        same = np.isclose(lanes[name], taylor[name], rtol=close, equal_nan=True)
        assert np.count_nonzero(same) >= share, f"{name}: {lanes[name]}, {taylor[name]}"


def test_a_run_does_not_depend_on_its_neighbours() -> None:
    batch, values = draw(19, 1)
    together = batch.run(values)
    order = np.random.default_rng(2).permutation(19)
    shuffled = batch.run(values[order])
    alone = batch.run(values[7:8])
    for name in NUMBERS:
        np.testing.assert_array_equal(together[name][order], shuffled[name])
        np.testing.assert_array_equal(together[name][7:8], alone[name])


def test_an_early_end_has_the_outcome_of_the_whole_run() -> None:
    batch, values = draw(120, 3, duration_s=3.0)
    early = batch.run(values)
    whole = Batch(batch.scene, batch.keys, early_end=False).run(values)
    assert np.count_nonzero(early["end_s"] < 2.9) > 100
    assert early["outcome"].tolist() == whole["outcome"].tolist()
    whirls = early["outcome"] == "backward whirl"
    np.testing.assert_allclose(early["whirl_hz"][whirls], whole["whirl_hz"][whirls], rtol=0.03)


@pytest.mark.parametrize(
    ("scene", "changes"),
    [
        ("drop", {}), ("partial-rub", {}), ("coast-down", {}), ("hammer-house", {}),
        ("hammer", {"parameters": "dtu-2019"}),
        ("hammer", {"house.preload": 300.0}), ("hammer", {"contact.restitution": 0.5}),
        ("hammer", {"model.shaft": "planar", "model.magnet": "linear"}), ("hammer", {"model.friction": "none"}),
    ],
)  # fmt: skip
def test_each_kind_of_scene_has_the_outcome_of_the_engine(scene: str, changes: dict[str, Any]) -> None:
    loaded = rig.load_scene(scene, {**changes, "duration_s": 1.0})
    value = [[loaded.load_parameters()["drive.torque_gain"]]]
    lanes = Batch(loaded, ["drive.torque_gain"], early_end=False).run(value, repeat=False)
    engine = Batch(rig.load_scene(loaded, {"engine.name": "taylor"}), ["drive.torque_gain"]).run(value)
    assert lanes["engine"][0] == "lanes"
    assert lanes["trusted"][0], lanes["energy_residual_j"]
    assert lanes["outcome"][0] == engine["outcome"][0]
    np.testing.assert_allclose(lanes["peak_radius_mm"], engine["peak_radius_mm"], rtol=0.02)
    np.testing.assert_allclose(lanes["dissipated_j"], engine["dissipated_j"], rtol=0.05)


def test_models_that_the_kernel_lacks_run_with_the_engine_of_the_scene() -> None:
    scene = rig.load_scene("hammer", {"duration_s": 0.1})
    keys = ["model.friction", "contact.friction"]
    table = Batch(scene, keys).run([["exact", 0.25], ["smoothed", 0.25]])
    assert table["engine"].tolist() == ["lanes", "split"]
    assert table["contacts"][0] == pytest.approx(table["contacts"][1], abs=6)


def test_a_run_that_cannot_be_trusted_is_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    batch, values = draw(6, 4)
    good = batch.run(values)
    monkeypatch.setattr(batches, "TOLERANCE", 0.3)
    bad = batch.run(values, repeat=False)
    assert not bad["trusted"][good["contacts"] > 3].all()
    repeated = batch.run(values)
    assert repeated["engine"].tolist() == ["lanes" if trusted else "split" for trusted in bad["trusted"]]
    assert repeated["trusted"].all()
    assert repeated["outcome"].tolist() == good["outcome"].tolist()


def test_a_check_estimates_the_error() -> None:
    batch, values = draw(40, 5)
    table = batch.run(values, check=True)
    finite = np.isfinite(table["error_estimate"])
    assert np.count_nonzero(finite) >= 38
    assert np.median(table["error_estimate"]) < 1e-3
    assert not table["trusted"][~finite & (table["engine"] == "lanes")].any()


def test_a_speed_command_and_a_release_take_effect_at_their_instants() -> None:
    scene = rig.load_scene("stable-run", {"duration_s": 1.0})
    data = scene.model_dump()
    data["commands"] = [
        {"at_s": 0.1, "command": "speed", "speed_hz": 6.5}, {"at_s": 0.4, "command": "release"},
    ]  # fmt: skip
    scene = rig.run.scenes.parse_scene(data)
    value = [[0.25]]
    lanes = Batch(scene, ["contact.friction"]).run(value, repeat=False)
    engine = Batch(rig.load_scene(scene, {"engine.name": "taylor"}), ["contact.friction"]).run(value)
    assert lanes["trusted"][0]
    assert lanes["first_contact_s"][0] == pytest.approx(engine["first_contact_s"][0], abs=1e-4)
    np.testing.assert_allclose(lanes["peak_force_n"], engine["peak_force_n"], rtol=0.05)


def test_runs_continue_from_the_end_of_others() -> None:
    scene = rig.load_scene("hammer", {"duration_s": 0.3})
    whirling = Batch(scene, ["drive.speed_hz"], early_end=False).run([[6.2], [6.2], [6.2]])
    assert whirling["outcome"].tolist() == ["backward whirl"] * 3
    still = Batch(rig.load_scene("stable-run", {"duration_s": 0.6}), ["drive.speed_hz", "contact.friction"])
    values = [[6.2, 0.25], [5.5, 0.25], [6.2, 0.002]]
    from_rest = still.run(values)
    assert from_rest["outcome"].tolist() == ["free"] * 3
    continued = still.run(values, start=whirling["end"])
    assert continued["outcome"].tolist() == ["backward whirl", "backward whirl", "impacts"]
    assert continued["trusted"].all()
    assert continued["whirl_hz"][0] == pytest.approx(whirling["whirl_hz"][0], rel=0.02)


def test_a_run_that_cannot_start_has_failed_alone() -> None:
    scene = rig.load_scene("hammer", {"duration_s": 0.1})
    table = Batch(scene, ["ring.offset_x"]).run([[0.0], [5.0]])
    assert table["outcome"].tolist()[1] == "failed"
    assert table["trusted"].tolist() == [True, False]
    with pytest.raises(rig.InputError, match=r"ring\.offset must be within"):
        Batch(rig.load_scene("hammer", {"ring.offset_x": 5.0}), ["contact.friction"])


def test_a_finer_tolerance_of_the_scene_makes_the_batch_finer() -> None:
    batch, values = draw(12, 6)
    fine = draw(12, 6, **{"engine.tolerance": 3e-8})[0].run(values)
    assert fine["engine"].tolist() == ["lanes"] * 12
    assert (fine["steps"] > 1.5 * batch.run(values)["steps"]).all()
    assert np.max(np.abs(fine["energy_residual_j"])) < 1e-6


@pytest.mark.parametrize("value", ["much", True, -0.1, float("nan")])
def test_a_value_that_a_parameter_does_not_accept_is_refused(value: Any) -> None:
    batch = Batch(rig.load_scene("hammer"), ["contact.friction"])
    with pytest.raises(rig.InputError, match=r"contact\.friction must be a number from 0 to .*; received"):
        batch.run([[0.2], [value]])


@pytest.mark.parametrize("position", ["top", "given"])
@pytest.mark.parametrize(("key", "value"), [("ring.clearance", 1.2), ("shaft.arm_ring", 0.21)])
def test_a_parameter_that_moves_the_start_is_that_of_a_scene(key: str, value: float, position: str) -> None:
    changes = {"contact.stiffness": 2.8e10, "duration_s": 0.01}  # a number, so that it depends on no other parameter
    start = {"initial.position": position, "initial.x_mm": 0.5, "initial.y_mm": -0.7}
    scene = rig.load_scene("hammer", {**changes, **start})
    varied = Batch(scene, [key]).run([[value]], repeat=False)
    scene = rig.load_scene(scene, {key: value})
    same = Batch(scene, ["contact.friction"]).run([[0.25]], repeat=False)
    assert varied["outcome"][0] != "failed"
    for name in ("end", "peak_force_n", "peak_radius_mm", "contacts"):
        assert np.array_equal(varied[name], same[name]), name


def test_a_ring_that_does_not_hold_the_shaft_at_rest_fails() -> None:
    scene = rig.load_scene("hammer", {"contact.stiffness": 2.8e10, "ring.offset_y": -1.2, "duration_s": 0.01})
    assert Batch(scene, ["ring.clearance"]).run([[0.5], [0.2]])["outcome"].tolist() == ["free", "failed"]


@pytest.mark.parametrize(
    "changes",
    [
        {"parameters": "dtu-2019"},
        {"model.friction": "none", "contact.friction": 0.2},
        {"contact.stiffness": "internal-sphere", "shaft.radius": 20.0},
        {"initial.position": "top", "shaft.arm_ring": 0.21},
    ],
    ids=str,
)
def test_keys_that_change_the_meaning_of_others_are_those_of_a_scene(changes: dict[str, Any]) -> None:
    scene = rig.load_scene("hammer", {"contact.stiffness": 2.8e10, "duration_s": 0.03})
    varied = Batch(scene, [*changes]).run([[*changes.values()]], repeat=False)
    same = Batch(rig.load_scene(scene, changes), ["seed"]).run([[1]], repeat=False)
    assert np.array_equal(varied["end"], same["end"])


def test_a_refused_combination_fails_alone_and_a_wrong_value_is_refused() -> None:
    scene = rig.load_scene("hammer", {"duration_s": 0.03})
    impacts = tuple(scene.commands[0].model_copy(update={"at_s": at_s}) for at_s in (0.01, 0.028))
    scene = scene.model_copy(update={"commands": impacts})
    batch = Batch(scene, ["hammer.at_s", "hammer.duration_ms"])
    assert batch.run([[0.01, 5.0], [0.02, 9.0]])["outcome"].tolist() == ["impacts", "failed"]
    with pytest.raises(InputError, match=r"^hammer\.duration_ms must be"):
        batch.run([[0.01, -5.0]])
    with pytest.raises(InputError, match=r"^drive\.speed_hz must be at most drive\.top_speed = 15 Hz; received 15\.5"):
        Batch(scene, ["drive.speed_hz"]).run([[15.5]])


def test_a_batch_may_be_empty_and_has_one_shape() -> None:
    batch = Batch(rig.load_scene("hammer"), ["contact.friction"])
    assert len(batch.run([])["outcome"]) == 0
    with pytest.raises(InputError, match=r"^values must be an array of shape \(runs, 1\); received shape \(1, 3\)"):
        batch.run([[0.1, 0.2, 0.3]])


def test_a_short_pulse_without_contact_is_trusted() -> None:
    scene = rig.load_scene("hammer", {"duration_s": 0.1})
    table = Batch(scene, ["hammer.duration_ms"]).run([[0.5]], repeat=False)
    assert (table["outcome"][0], table["contacts"][0], table["trusted"][0]) == ("free", 0.0, True)
