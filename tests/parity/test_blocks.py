"""The division of a run into calls changes no bit of its results, and neither does a repetition."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.physics.engines import ENGINES
from rig.physics.kernels.signals import COLUMN
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

END = 600_000
COMMANDS: dict[int, list[tuple[str, dict[str, Any]]]] = {
    150_000: [("speed", {"speed_hz": 5.0})],
    205_000: [("hammer", {"force_n": 700.0, "duration_ms": 2.0, "direction": 200.0})],
    400_000: [("release", {})],
}
"""Sent by a client at these ticks, independent of the cuts; the scene's own impact is at 20 ms."""


@dataclass(frozen=True)
class RunOutput:
    """Everything that a run published, as one piece."""

    rows: np.ndarray
    samples: dict[str, np.ndarray]
    truth: dict[str, np.ndarray]
    edges: np.ndarray
    events: list[dict[str, Any]]
    health: dict[str, Any]


def run_with_cuts(*cuts: int, scene: str = "hammer", overrides: dict[str, Any] | None = None) -> RunOutput:
    """Run with advances of these lengths in turn, each shortened to the next command or the end."""
    simulation = Simulation(load_scene(scene, {"drive.speed_hz": 6.2, **(overrides or {})}))
    lengths = cycle(cuts)
    rows, edges, events = [], [], []
    samples: dict[str, list[np.ndarray]] = {}
    truth: dict[str, list[np.ndarray]] = {}
    next_rows: dict[str, int] = {}
    while simulation.tick < END:
        tick = simulation.tick
        for name, request in COMMANDS.get(tick, []):
            assert simulation.submit(name, request) == tick
        stop = min([END, *(at for at in COMMANDS if at > tick)])
        frame = simulation.advance(min(next(lengths), stop - tick))
        assert frame.tick == tick
        assert frame.tick + frame.ticks == simulation.tick
        rows.append(frame.rows.copy())
        events += frame.events
        for kind, kept, made in (("samples", samples, frame.samples), ("truth", truth, frame.truth)):
            for name, block in made.items():
                due = next_rows.get(f"{kind} {name}", 0)
                assert (block.tick, block.index) == (tick, due), "no row is missing between two blocks"
                next_rows[f"{kind} {name}"] = due + len(block.values)
                kept.setdefault(name, []).append(block.values)
        if frame.edges is not None:
            assert frame.edges.index == next_rows.get("edges", 0)
            next_rows["edges"] = frame.edges.index + len(frame.edges.values)
            edges.append(frame.edges.tick + frame.edges.values[:, 0])
    return RunOutput(
        rows=np.concatenate(rows),
        samples={name: np.concatenate(blocks) for name, blocks in samples.items()},
        truth={name: np.concatenate(blocks) for name, blocks in truth.items()},
        edges=np.concatenate(edges) if edges else np.empty(0),
        events=events,
        health=simulation.health(),
    )


def assert_same(one: RunOutput, other: RunOutput) -> None:
    assert one.rows.tobytes() == other.rows.tobytes()
    for made, again in ((one.samples, other.samples), (one.truth, other.truth)):
        assert made.keys() == again.keys()
        for name in made:
            assert made[name].dtype == again[name].dtype
            assert made[name].shape == again[name].shape
            assert made[name].tobytes() == again[name].tobytes(), name
    assert one.events == other.events
    assert one.health == other.health
    assert one.edges.tobytes() == other.edges.tobytes()


@pytest.fixture(scope="module")
def whole() -> RunOutput:
    """The run with the smallest number of cuts that the commands allow."""
    return run_with_cuts(END)


def test_the_run_has_rows_to_compare(whole: RunOutput) -> None:
    assert [event["event"] for event in whole.events] == ["hammer", "speed", "hammer", "release"]
    assert [event["tick"] for event in whole.events] == [20_000, 150_000, 205_000, 400_000]
    assert whole.health["contacts"] > 10
    assert len(whole.edges) == 3
    assert len(whole.rows) == END // 25
    assert {name: len(values) for name, values in whole.samples.items()} == dict.fromkeys(
        ("probes", "forces", "accelerations", "drive", "hammer"), END // 50
    )
    assert {len(values) for values in whole.truth.values()} == {END // 500}


@pytest.mark.parametrize(
    "cuts", [(500,), (1_000,), (10_000,), (250_000,), (10_000, 1_000, 250_000), (500, 37_500, 99_500)]
)
def test_cuts_change_no_bit(whole: RunOutput, cuts: tuple[int, ...]) -> None:
    assert_same(whole, run_with_cuts(*cuts))


@given(cuts=st.lists(st.integers(1, 400).map(lambda n: 500 * n), min_size=1, max_size=8))
@settings(max_examples=8, deadline=None)
def test_no_mix_of_cuts_changes_a_bit(whole: RunOutput, cuts: list[int]) -> None:
    assert_same(whole, run_with_cuts(*cuts))


@pytest.mark.parametrize(
    "overrides",
    [
        {"engine.name": "rk4", "engine.step_us": 5},
        {"engine.step_us": 50, "sensors.rate_hz": 2_000, "sensors.truth_rate_hz": 200},
        {"drive.mode": "ideal", "parameters": "as-printed", "sensors.groups": '["drive", "forces"]'},
    ],
    ids=["rk4", "slow", "ideal"],
)
def test_cuts_change_no_bit_of_other_scenes(overrides: dict[str, Any]) -> None:
    assert_same(run_with_cuts(END, overrides=overrides), run_with_cuts(15_000, 5_000, overrides=overrides))


def test_cuts_change_no_bit_of_a_doubt() -> None:
    # Without friction the shaft keeps bouncing, and errors grow until the estimate exceeds its limit, which is an
    # event.
    whole = run_with_cuts(END, overrides={"model.friction": "none"})
    # A second event follows when another quantity, the whirl frequency, exceeds its tolerance.
    expected = ["hammer", "speed", "hammer", "warning", "release", "warning"]
    assert [event["event"] for event in whole.events] == expected
    assert_same(whole, run_with_cuts(15_000, 5_000, overrides={"model.friction": "none"}))


def test_commands_of_one_tick_take_effect_in_order() -> None:
    simulation = Simulation(load_scene("stable-run"))
    for speed_hz in (3.0, 9.0, 5.0):
        simulation.submit("speed", {"speed_hz": speed_hz})
    frame = simulation.advance(simulation.block_ticks)
    assert [event["speed_hz"] for event in frame.events] == [3.0, 9.0, 5.0]


def test_a_release_of_the_scene_finds_the_magnets_released() -> None:
    commands = '[{ at_s = 0.05, command = "release" }]'
    simulation = Simulation(load_scene("stable-run", {"commands": commands}))
    simulation.submit("release", {})
    simulation.advance(100_000)
    health = simulation.health()
    assert abs(health["energy"]["residual_j"]) < 1e-5 * health["energy"]["dissipated_j"], "booked once"


def test_an_impact_of_the_scene_may_meet_a_running_impact() -> None:
    simulation = Simulation(load_scene("hammer"))
    simulation.advance(18_000)
    simulation.submit("hammer", {"force_n": 50.0, "duration_ms": 10.0})
    frame = simulation.advance(20_000)
    assert [event["event"] for event in frame.events] == ["hammer", "warning"]
    assert frame.rows[:, COLUMN["hammer_force"]].max() == pytest.approx(50.0, rel=1e-3), "the first one goes on"


def test_same_seed_same_bits_and_another_seed_only_another_noise(whole: RunOutput) -> None:
    assert_same(whole, run_with_cuts(END))
    other = run_with_cuts(END, overrides={"seed": 2})
    assert other.rows.tobytes() == whole.rows.tobytes()
    assert other.events == whole.events
    for name, counts in whole.samples.items():
        assert np.mean(other.samples[name] != counts) > 0.9


def test_a_scene_command_equals_a_command_sent_at_its_tick() -> None:
    scene = load_scene("hammer")
    simulation = Simulation(scene.model_copy(update={"commands": ()}))
    request = scene.commands[0].request.model_dump(exclude={"command"})
    first = simulation.advance(20_000).rows.copy()
    simulation.submit("hammer", request)
    second = simulation.advance(80_000).rows
    frame = Simulation(scene).advance(100_000)
    assert np.concatenate([first, second]).tobytes() == frame.rows.tobytes()


@pytest.mark.parametrize("engine", ENGINES)
def test_cuts_change_no_bit_with_any_engine(engine: str) -> None:
    # Hammer impact, contacts and the first rolling, in the longest steps of an adaptive engine.
    def motion(length: int) -> tuple[bytes, ...]:
        method = ENGINES[engine]
        simulation = Simulation(
            load_scene(
                "hammer",
                {
                    "engine.name": engine,
                    "model.friction": "exact" if "exact" in method.frictions else "smoothed",
                    "sensors.rate_hz": 1000,
                    "sensors.truth_rate_hz": 1000,
                },
            )
        )
        rows = [simulation.advance(length).rows.copy() for _ in range(120_000 // length)]
        assert simulation.health()["contacts"] > 0
        return np.concatenate(rows).tobytes(), simulation._motion.y.tobytes(), simulation._motion.memory.tobytes()

    assert motion(1_000) == motion(120_000)
