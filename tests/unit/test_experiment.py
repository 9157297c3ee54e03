"""The record of a run in its recording is sufficient to repeat it, bit for bit."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.reader import Recording
from recorder.session import RecordingSession
from replays.recordings.export import write_run
from replays.recordings.resimulation.experiment import Experiment, recorded_scene
from rig.base import wire
from rig.base.errors import InputError
from rig.run.offline import SentCommand, frames
from rig.run.scenes import load_scene, parse_scene
from rig.run.simulation import Simulation
from rig.serve.pacing import Lockstep
from rig.serve.service import Service
from rig.serve.transport.memory import MemoryClient, MemoryServer
from tests.waiting import PATIENCE_S

_LOW_RATES = {"sensors.truth_rate_hz": 500, "sensors.rate_hz": 5000}


def _record(path: Path, scene: str, changes: dict[str, Any]) -> Recording:
    simulation = Simulation(load_scene(scene, {**_LOW_RATES, **changes}))
    write_run(simulation, path)
    return Recording.open(path)


def _assert_same(recording: Recording, experiment: Experiment) -> None:
    """Assert that every block of sensors, truth and edges is reproduced, from the recording's first row to its last."""
    simulation = experiment.simulation()
    made: dict[str, list[wire.Block]] = {}
    for frame in experiment.frames(simulation, chunk_s=0.05):
        for key, block in [(wire.sensor_key(name), block) for name, block in frame.samples.items()] + [
            (wire.truth_key(name), block) for name, block in frame.truth.items()
        ]:
            made.setdefault(key, []).append(block)
    assert len(made) == 9
    for key, blocks in made.items():
        recorded = list(recording.blocks(key))
        first = recorded[0].index
        old = np.concatenate([block.values for block in recorded])
        new = np.concatenate([block.values for block in blocks])
        assert len(old) > 10
        assert first + len(old) == len(new)
        np.testing.assert_array_equal(old, new[first:], err_msg=key)


def test_a_scene_with_a_deleted_parameter_file_is_repeated(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text('title = "Mine"\nbase = "as-printed"\n[contact]\nfriction = 0.3\n[magnet]\nstiffness = 1.9\n')
    recording = _record(
        tmp_path / "own.mcap", "hammer", {"parameters": str(own), "contact.restitution": 0.8, "duration_s": 0.2}
    )
    own.unlink()
    experiment = Experiment.from_recording(recording)
    parameters = experiment.scene.load_parameters()
    assert parameters.entries["contact.friction"].value == 0.3
    assert parameters.entries["contact.restitution"].value == 0.8
    assert experiment.scene.duration_s == 0.2
    _assert_same(recording, experiment)


def test_a_parameter_set_of_the_rig_keeps_its_name(tmp_path: Path) -> None:
    recording = _record(tmp_path / "a.mcap", "drop", {"parameters": "as-printed", "duration_s": 0.05})
    scene = Experiment.from_recording(recording).scene
    assert (scene.parameters, scene.set) == ("as-printed", {})


def test_a_recording_without_a_method_for_rolling_was_made_by_series() -> None:
    simulation = Simulation(load_scene("hammer"))
    parameters, document = simulation.parameters_document(), simulation.scene_document()["scene"]

    def rolling(engine: Any) -> str:
        return parse_scene(recorded_scene(parameters, {**document, "engine": engine})).engine.rolling

    now = document["engine"]
    before = {key: value for key, value in now.items() if key != "rolling"}
    assert (rolling(now), rolling(before), rolling({"name": "rk8"})) == ("collocation", "series", "series")
    with pytest.raises(InputError, match=r"engine must be a table of named fields; received 'split'"):
        rolling("split")


def test_changes_are_of_the_scene_or_its_parameters(tmp_path: Path) -> None:
    experiment = Experiment.from_recording(_record(tmp_path / "a.mcap", "hammer", {"duration_s": 0.05}))
    changed = experiment.with_changes({"contact.friction": 0.2, "engine.name": "rk8", "seed": 5})
    assert changed.scene.set == {"contact.friction": 0.2}
    assert (changed.scene.engine.name, changed.scene.seed) == ("rk8", 5)
    assert changed.scene.engine.tolerance > 0.0, "another engine comes with its own tolerance"
    with pytest.raises(InputError, match=r"contact\.fricton must be a field"):
        experiment.with_changes({"contact.fricton": 0.2})


def test_commands_from_before_and_during_a_live_recording(tmp_path: Path) -> None:
    """The recorder starts after an impact; a change of speed and another impact follow."""
    simulation = Simulation(load_scene("stable-run", {**_LOW_RATES, "duration_s": 0.6}))
    server = MemoryServer()
    clock = Lockstep()
    service = Service(simulation, server, clock, block_ticks=10_000)
    service.prepare()
    running = threading.Thread(target=service.run)
    running.start()
    client = MemoryClient(server)

    def ask(name: str, **request: Any) -> dict[str, Any]:
        reply = wire.decode_document(
            client.request(wire.command_key(name), wire.encode_document(request), timeout_s=PATIENCE_S)
        )
        assert reply["accepted"], reply
        return reply

    ask("step", ticks=50_000)
    ask("hammer", force_n=80.0, duration_ms=4.0, direction=30.0)
    ask("step", ticks=100_000)
    session = RecordingSession(MemoryClient(server), tmp_path / "live.mcap")
    recording_thread = threading.Thread(target=session.run)
    recording_thread.start()
    _until(lambda: bool(service.status()["clients"]))
    ask("step", ticks=100_000)
    ask("speed", speed_hz=5.0)
    ask("hammer", force_n=60.0, duration_ms=5.0, direction="-y")
    ask("step", ticks=350_000)
    running.join(timeout=PATIENCE_S)
    recording_thread.join(timeout=PATIENCE_S)

    recording = Recording.open(tmp_path / "live.mcap")
    experiment = Experiment.from_recording(recording)
    assert [(command.tick, command.name) for command in experiment.commands] == [
        (50_000, "hammer"),
        (250_000, "speed"),
        (250_000, "hammer"),
    ]
    assert experiment.first_s >= 0.15
    _assert_same(recording, experiment)


def _until(true: Callable[[], bool]) -> None:
    for _ in range(400):
        if true():
            return
        time.sleep(0.01)
    pytest.fail("it never came")


def test_commands_are_sent_at_their_ticks_however_long_the_chunks_are() -> None:
    scene = load_scene("stable-run", {**_LOW_RATES, "duration_s": 0.3})
    commands = [SentCommand(120_000, "speed", {"speed_hz": 5.0}), SentCommand(40_000, "hammer", {"force_n": 50.0})]
    ends = []
    for chunk_s in (0.01, 1.0):
        simulation = Simulation(scene)
        produced = list(frames(simulation, chunk_s=chunk_s, commands=commands))
        events = [(event["event"], event["tick"]) for frame in produced for event in frame.events]
        assert events == [("hammer", 40_000), ("speed", 120_000)]
        ends.append(produced[-1].rows[-1].copy())
    np.testing.assert_array_equal(ends[0], ends[1])
