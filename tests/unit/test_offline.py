"""The Python interface: as in the package's docstring, and the contents of a run."""

from __future__ import annotations

import math
import pydoc
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rig
from rig.base.errors import InputError, UnknownNameError
from rig.physics.kernels.signals import ROW
from rig.run.offline import Run, frames, simulate
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation


@pytest.fixture(scope="module")
def shown() -> dict[str, Any]:
    """Variables after the example in the docstring of the package, run unchanged."""
    lines = textwrap.dedent((rig.__doc__ or "").split("\n\n")[1])
    assert len(lines.strip().splitlines()) == 5
    space: dict[str, Any] = {}
    exec(compile(lines, "rig.__doc__", "exec"), space)
    # The last three are expressions: evaluated as well.
    space["shown"] = [eval(line, space) for line in lines.strip().splitlines()[2:]]
    return space


@pytest.fixture(scope="module")
def run(shown: dict[str, Any]) -> Run:
    return shown["run"]


def test_the_lines_of_the_docstring_work(shown: dict[str, Any]) -> None:
    run = shown["run"]
    (true, true_unit), (measured, measured_unit), (disk_x, times_s) = shown["shown"]
    assert (true_unit, measured_unit) == ("m", "mm")
    assert true * 1e3 == pytest.approx(measured, abs=0.02)
    assert 500.0 < run["normal_force"].max() < 20_000.0, "it was hit and touched the ring"
    assert disk_x.max() == pytest.approx(true, abs=2e-5)
    assert disk_x.shape == times_s.shape == (40_000,)
    assert run.simulation.scene.drive.speed_hz == 5.2
    assert run.simulation.model.parameters["contact.friction"] == 0.3


def test_all_lists_the_public_interface() -> None:
    for name in rig.__all__:
        assert getattr(rig, name).__name__ in (name, f"rig.{name}")  # rig.ensemble is a package that can be called
    assert set(rig.__all__) <= set(dir(rig))
    assert not [name for name in dir(rig) if name.startswith("_") and not name.startswith("__")]
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        rig.nothing  # type: ignore[attr-defined]  # noqa: B018


def test_help_starts_with_an_example() -> None:
    page = pydoc.plain(pydoc.render_doc(rig))
    assert page.index('run = rig.simulate("hammer"') < page.index("CLASSES")
    for name in rig.__all__:
        assert f"class {name}(" in page or f"    {name}(" in page or f"    {name} (package)" in page, name


def test_signals_are_those_of_the_frames(run: Run) -> None:
    scene = load_scene("hammer", {"drive.speed_hz": 5.2, "contact.friction": 0.3})
    simulation = Simulation(scene)
    produced = list(frames(simulation, chunk_s=0.25))
    rows = np.concatenate([frame.rows[::2] for frame in produced[-1:]])
    assert simulation.tick == simulation.end_tick == 2_000_000
    assert len(produced) == 8
    assert run.signals[-len(rows) :].tobytes() == rows.tobytes()
    for group, names in ((group.name, group.names) for group in simulation.table.groups.values()):
        counts = np.concatenate([frame.samples[group].values for frame in produced])
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
        assert run.samples.unit(name) == channel.unit
        np.testing.assert_allclose(run.samples.to_si()[name], run.samples[name] * channel.si, rtol=1e-15)
        assert run.samples.to_si().unit(name) == run.unit(channel.signal)
    # The same name in both: the model's in SI, the probe's in its own unit.
    assert (run.unit("disk_x"), run.samples.unit("disk_x")) == ("m", "mm")
    assert run.samples.to_si().to_si().units == run.samples.to_si().units


def test_an_unknown_name_suggests_the_nearest(run: Run) -> None:
    parameters = run.simulation.model.parameters
    for look_up, wrong, near in (
        (run.__getitem__, "inner_x", "inner_ax"),
        (run.unit, "normal_forze", "normal_force"),
        (run.samples.__getitem__, "p_n", "P_N"),
        (run.samples.unit, "disk_z", "disk_x"),
        (run.counts.__getitem__, "hamer", "hammer"),
        (parameters.__getitem__, "contact.fricton", "contact.friction"),
    ):
        with pytest.raises(KeyError) as caught:
            look_up(wrong)
        assert isinstance(caught.value, InputError)
        assert near in str(caught.value)
        assert repr(wrong) in str(caught.value)
    for wrong in (0, None, "", "x" * 100_000):
        with pytest.raises(UnknownNameError) as caught:
            run[wrong]  # type: ignore[index]
        assert len(str(caught.value)) < 2_000


def test_each_object_has_a_one_line_representation(run: Run) -> None:
    frame = Simulation(run.simulation.scene).advance(50_000)
    assert len(repr(frame)) < 2_000
    for each in (run, run.simulation, run.simulation.scene, run.simulation.model.parameters, run.table):
        assert str(each) == repr(each)
        assert repr(each).startswith(f"{type(each).__name__}(")
        assert len(repr(each)) < 200
    assert repr(run.samples).startswith("Samples(disk_x, disk_y, ring_x, ring_y [mm], P_N, ")
    assert repr(run.samples).endswith("; 40000 rows at 20000 Hz, 0 to 1.99995 s)")
    assert "\n" not in repr(run.samples)


def test_a_run_iterates_over_its_signals(run: Run) -> None:
    assert tuple(run) == run.names
    assert "disk_x" in run
    assert "disk_z" not in run


def test_samples_are_columns_like_those_of_a_table(run: Run) -> None:
    assert len(run.samples) == len(run.times_s)
    assert list(run.samples) == list(run.samples.keys()) == list(run.samples.names)
    assert set(dict(run.samples)) == set(run.table.channels)
    assert ("disk_x" in run.samples, "disk_z" in run.samples) == (True, False)
    assert run.names == tuple(signal.name for signal in ROW)


def test_a_scene_is_given_by_name_path_or_object(tmp_path: Path) -> None:
    changes = {"drive.speed_hz": 5.2, "duration_s": 0.01, "sensors.rate_hz": 1_000}
    path = tmp_path / "mine.toml"
    path.write_text('duration_s = 0.5\n[[commands]]\nat_s = 0.02\ncommand = "hammer"\n')
    by_name = simulate("hammer", changes)
    loaded = simulate(load_scene("hammer"), changes)
    assert by_name.signals.tobytes() == loaded.signals.tobytes()
    assert simulate(path, changes).signals.tobytes() == by_name.signals.tobytes()
    for wrong in ("hamer", None, by_name, {"drive.speed_hz": 5.2}):
        with pytest.raises(InputError, match=r"^scene must be (one of .*hammer|a name)"):
            simulate(wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^drive\.sped_hz must be a field of a scene .* drive\.speed_hz"):
        simulate("hammer", {"drive.sped_hz": 5.2})


def test_a_run_keeps_the_selected_columns(tmp_path: Path) -> None:
    whole, folder = simulate("hammer", duration_s=0.25), tmp_path / "run"
    ledger = [name for name in whole.names if name.endswith(("energy", "work", "loss"))]
    some = simulate("hammer", duration_s=0.25, signals=("normal_force", *ledger), folder=folder)
    np.testing.assert_array_equal(some["normal_force"], whole["normal_force"])
    np.testing.assert_array_equal(some.energy().values, whole.energy().values)
    for one, other in ((some.samples, whole.samples), (some.counts, whole.counts)):
        assert one.values.dtype == other.values.dtype
        np.testing.assert_array_equal(one.values, other.values)
    np.testing.assert_array_equal(np.load(folder / "signals.npy"), some.signals)
    assert isinstance(some.signals, np.memmap)
    assert sorted(file.name for file in folder.iterdir()) == ["counts.npy", "samples.npy", "signals.npy"]
    assert some.unit("normal_force") == "N"
    # Another run into the same folder leaves the first one's data unchanged.
    mine = np.array(some.signals)
    few = simulate("hammer", duration_s=0.05, signals=["disk_x"], folder=str(folder))
    np.testing.assert_array_equal(some.signals, mine)
    assert (few.names, few.signals.shape) == (("disk_x",), (1000, 1))
    with pytest.raises(UnknownNameError, match=r"^name must be one of the signals it keeps"):
        few["normal_force"]
    with pytest.raises(InputError, match=r"^signals must be with kinetic_energy, .* for an energy ledger"):
        few.energy()
    (tmp_path / "file").write_text("")
    refused: list[tuple[dict[str, Any], str]] = [
        ({"signals": "disk_x"}, "signals must be a list of names"),
        ({"signals": 3}, "signals must be a list of names"),
        ({"signals": ["disk_z"]}, "signals must be names of the model's signals, such as disk_y"),
        ({"folder": tmp_path / "file"}, "folder must be a folder, or a new one in a folder that exists"),
        ({"folder": tmp_path / "no" / "such"}, "folder must be a folder, or a new one in a folder that exists"),
        ({"folder": 3}, "folder must be a folder, or a new one in a folder that exists"),
    ]
    for wrong, says in refused:
        with pytest.raises(InputError, match=f"^{says}"):
            simulate("hammer", duration_s=0.05, **wrong)


def test_times_are_those_of_the_samples(run: Run) -> None:
    np.testing.assert_allclose(run.samples.times_s, np.arange(40_000) / 20_000, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(run.times_s, run.samples.times_s)
    # The probes show the model's values, at the same instants.
    before = run.times_s < 0.02
    np.testing.assert_allclose(run.samples["ring_x"][before], run["ring_x"][before] * 1e3, rtol=0, atol=2e-3)


def test_events_and_edges(run: Run) -> None:
    (impact,) = run.events
    assert impact == {
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


def test_an_impossible_duration_is_an_input_error() -> None:
    with pytest.raises(InputError, match=r"^duration_s must be"):
        simulate(load_scene("drop"), duration_s=-1.0)


@pytest.mark.parametrize("changes", [5.2, ["drive.speed_hz"], {1: 2}])
def test_invalid_changes_are_an_input_error(changes: Any) -> None:
    for scene in ("hammer", load_scene("hammer")):
        with pytest.raises(InputError, match="changes must be a dictionary of values by dotted key"):
            simulate(scene, changes)


def test_the_shortest_run_is_a_block() -> None:
    assert len(simulate("hammer", duration_s=1e-9).times_s) == 10


def test_duration_is_rounded_up_to_a_whole_block() -> None:
    assert len(simulate(load_scene("drop"), duration_s=0.0012).times_s) == 30, "1.5 ms: three rows of truth"


def test_only_enabled_sensors_are_returned() -> None:
    run = simulate(load_scene("drop", {"sensors.groups": ["hammer"], "sensors.rate_hz": 1_000}), duration_s=0.1)
    assert list(run.samples) == ["hammer"]
    assert run.samples.unit("hammer") == "N"
    assert run.signals.shape == (100, len(ROW))
    assert len(run.samples["hammer"]) == 100


def test_commands_after_the_end_are_reported() -> None:
    run = simulate(load_scene("hammer"), duration_s=0.01)
    assert run.events == []
    assert run.simulation.health()["warnings"] == ["1 commands of the scene lie after its end and will not be executed"]
