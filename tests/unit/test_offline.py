"""The Python interface: as the package's own first lines show it, and what a run holds."""

from __future__ import annotations

import math
import textwrap
from typing import Any

import numpy as np
import pytest

import rig
from rig.errors import InputError
from rig.kernels.signals import ROW
from rig.offline import Run, frames, simulate
from rig.scenes import load_scene
from rig.simulation import Simulation


@pytest.fixture(scope="module")
def shown() -> dict[str, Any]:
    """What the lines in the docstring of the package leave behind, run as they stand there."""
    lines = textwrap.dedent((rig.__doc__ or "").split("\n\n")[1])
    assert len(lines.strip().splitlines()) == 5
    space: dict[str, Any] = {}
    exec(compile(lines, "rig.__doc__", "exec"), space)
    # The last two are expressions: evaluated as well.
    space["shown"] = [eval(line, space) for line in lines.strip().splitlines()[3:]]
    return space


@pytest.fixture(scope="module")
def run(shown: dict[str, Any]) -> Run:
    return shown["run"]


def test_the_lines_of_the_docstring_work(shown: dict[str, Any]) -> None:
    run = shown["run"]
    (peak, unit), (disk_x, times_s) = shown["shown"]
    assert (peak, unit) == (run["normal_force"].max(), "N")
    assert 500.0 < peak < 20_000.0, "it was hit and touched the ring"
    assert disk_x.shape == times_s.shape == (40_000,)
    assert shown["scene"].drive.speed_hz == 5.2
    assert run.simulation.model.parameters["contact.friction"] == 0.3


def test_everything_is_the_public_interface() -> None:
    for name in rig.__all__:
        assert getattr(rig, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        rig.nothing  # noqa: B018


def test_signals_are_those_of_the_frames(run: Run) -> None:
    scene = load_scene("hammer", {"drive.speed_hz": 5.2, "contact.friction": 0.3})
    simulation = Simulation(scene)
    made = list(frames(simulation, chunk_s=0.25))
    rows = np.concatenate([frame.rows[::2] for frame in made[-1:]])
    assert simulation.tick == simulation.end_tick == 2_000_000
    assert len(made) == 8
    assert run.signals[-len(rows) :].tobytes() == rows.tobytes()
    for group, names in ((group.name, group.names) for group in simulation.table.groups.values()):
        counts = np.concatenate([frame.samples[group].values for frame in made])
        for c, name in enumerate(names):
            np.testing.assert_array_equal(run.counts[name], counts[:, c])


def test_samples_are_the_counts_in_engineering_units(run: Run) -> None:
    assert list(run.samples) == list(run.table.channels)
    for name, channel in run.table.channels.items():
        assert run.counts[name].dtype == np.int32
        volts = run.counts[name] * channel.lsb_v
        np.testing.assert_allclose(
            run.samples[name],
            (volts - channel.bias_v) / channel.sensitivity_v,
            rtol=0,
            atol=1e-9 * abs(channel.scale) * 2**23,
        )


def test_every_signal_has_a_column_and_a_unit(run: Run) -> None:
    assert run.signals.shape == (len(run.times_s), len(ROW))
    for n, signal in enumerate(ROW):
        np.testing.assert_array_equal(run[signal.name], run.signals[:, n])
        assert run.unit(signal.name) == signal.unit
    for name, channel in run.table.channels.items():
        assert run.sample_unit(name) == channel.unit
    # The same name on both sides: the model's in SI, the probe's in its own unit.
    assert (run.unit("disk_x"), run.sample_unit("disk_x")) == ("m", "mm")
    for wrong in ("nothing", "inner_x"):
        with pytest.raises(KeyError):
            run[wrong]
        with pytest.raises(KeyError):
            run.unit(wrong)
    with pytest.raises(KeyError):
        run.sample_unit("normal_force")


def test_times_are_those_of_the_samples(run: Run) -> None:
    np.testing.assert_allclose(run.sample_times_s, np.arange(40_000) / 20_000, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(run.times_s, run.sample_times_s)
    # The probes see what the model says, at the same instants.
    before = run.times_s < 0.02
    np.testing.assert_allclose(run.samples["ring_x"][before], run["ring_x"][before] * 1e3, rtol=0, atol=2e-3)


def test_events_and_edges(run: Run) -> None:
    (blow,) = run.events
    assert blow == {
        "event": "hammer",
        "tick": 20_000,
        "time_s": 0.02,
        "force_n": 100.0,
        "duration_ms": 5.0,
        "direction": "x",
    }
    turns = (run["theta"][-1] - run["theta"][0]) / (2 * math.pi)
    assert len(run.edges_s) == math.floor(turns)
    assert np.all(np.diff(run.edges_s) > 0.9 / 5.2)


def test_energy_ledger_closes(run: Run) -> None:
    ledger = run.energy()
    assert ledger["dissipated"][-1] > 0.05
    # The engine's own error: the first impacts at its own step.
    assert np.abs(ledger["residual"]).max() < 3e-4 * ledger["dissipated"][-1]
    np.testing.assert_allclose(
        ledger["stored"] - ledger["supplied"] + ledger["dissipated"], ledger["residual"], rtol=0, atol=1e-12
    )


def test_another_duration_and_its_progress() -> None:
    parts: list[float] = []
    run = simulate(load_scene("drop"), duration_s=0.25, progress=parts.append)
    assert len(run.times_s) == 5_000
    assert parts == pytest.approx([0.4, 0.8, 1.0])
    assert run.simulation.scene.duration_s == 0.25
    assert run.edges_s.shape == (0,)


def test_a_duration_that_cannot_be_is_the_users_error() -> None:
    with pytest.raises(InputError, match=r"^duration_s must be"):
        simulate(load_scene("drop"), duration_s=-1.0)


def test_duration_is_rounded_up_to_a_whole_block() -> None:
    assert len(simulate(load_scene("drop"), duration_s=0.0012).times_s) == 30, "1.5 ms: three rows of truth"


def test_only_the_sensors_that_are_on() -> None:
    run = simulate(load_scene("drop", {"sensors.groups": ["hammer"], "sensors.rate_hz": 1_000}), duration_s=0.1)
    assert list(run.samples) == ["hammer"]
    assert run.sample_unit("hammer") == "N"
    assert run.signals.shape == (100, len(ROW))
    assert len(run.samples["hammer"]) == 100


def test_commands_behind_the_end_are_told() -> None:
    run = simulate(load_scene("hammer"), duration_s=0.01)
    assert run.events == []
    assert run.simulation.health()["warnings"] == ["1 commands of the scene lie after its end and will not be given"]
