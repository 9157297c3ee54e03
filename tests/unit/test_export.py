"""Files of a run: `rig simulate` writes what `simulate()` returns, and leaves no partial file."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from recorder.reader import Recording
from replays.recordings.export import SUFFIXES, check_run_output, make_writer, table_columns
from replays.recordings.verdict import stream_rows
from rig.base.errors import DiskError, InputError
from rig.cli.main import main
from rig.physics.kernels.signals import ROW, TRUTH
from rig.run.offline import Run, frames, simulate
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation

CHANGES = {"drive.speed_hz": 7.0, "contact.friction": 0.3, "seed": 5}
DURATION_S = 0.15


@pytest.fixture(scope="module")
def run() -> Run:
    return simulate(load_scene("hammer", {**CHANGES, "duration_s": DURATION_S}))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One file of each kind, written by the command."""
    folder = tmp_path_factory.mktemp("export")
    changes = [text for key, value in CHANGES.items() for text in ("--set", f"{key}={value}")]
    for suffix in SUFFIXES:
        with pytest.raises(SystemExit) as end:
            main(["simulate", "hammer", "-o", str(folder / f"run{suffix}"), *changes, "--duration-s", str(DURATION_S)])
        assert end.value.code == 0
    names = ["run.csv", "run.mcap", "run.parquet", "run.wav", "run.wav.json"]
    assert sorted(path.name for path in folder.iterdir()) == names, "no part is left"
    return folder


def expected(run: Run) -> np.ndarray:
    return np.column_stack([run.times_s, run.signals, run.samples.values])


def test_headings_name_everything_with_its_unit(run: Run) -> None:
    names = table_columns(run.simulation)
    assert names[0] == "time [s]"
    assert names[1 : 1 + len(ROW)] == [f"truth.{signal.name} [{signal.unit}]" for signal in ROW]
    assert names[1 + len(ROW) :] == [f"{c.name} [{c.unit}]" for c in run.table.channels.values()]
    assert len(set(names)) == len(names)
    assert {"truth.disk_x [m]", "disk_x [mm]", "truth.theta_rate [rad/s]", "speed [Hz]"} <= set(names)


def test_csv_is_the_run(folder: Path, run: Run) -> None:
    with (folder / "run.csv").open(newline="") as file:
        names, *rows = csv.reader(file)
    assert names == table_columns(run.simulation)
    np.testing.assert_array_equal(np.array(rows, dtype=float), expected(run))


def test_parquet_is_the_run(folder: Path, run: Run) -> None:
    from pyarrow import parquet

    table = parquet.read_table(folder / "run.parquet")
    assert table.column_names == table_columns(run.simulation)
    assert json.loads(table.schema.metadata[b"scene.json"])["scene"]["drive"]["speed_hz"] == 7.0
    assert "contact.friction" in json.loads(table.schema.metadata[b"parameters.json"])["values"]
    values = np.column_stack([column.to_numpy() for column in table.columns])
    np.testing.assert_array_equal(values, expected(run))


def test_mcap_is_the_run(folder: Path, run: Run) -> None:
    recording = Recording.open(folder / "run.mcap")
    assert recording.complete
    assert recording.end_reason == "completed"
    assert not recording.gaps
    for group in run.table.groups.values():
        samples = recording.samples(group.name)
        assert samples.names == group.names
        assert samples.units == tuple(channel.unit for channel in group.channels)
        np.testing.assert_allclose(samples.times_s, run.samples.times_s, rtol=0, atol=1e-12)
        for name in group.names:
            np.testing.assert_array_equal(samples[name], run.samples[name])
    for name, columns in TRUTH.items():
        truth = recording.truth(name)
        assert truth.names == columns
        assert truth.units == tuple(next(s.unit for s in ROW if s.name == column) for column in columns)
        np.testing.assert_allclose(truth.times_s, run.times_s[::10], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(truth.values, np.stack([run[column][::10] for column in columns], axis=-1))
    np.testing.assert_allclose(recording.edges(), run.edges_s, rtol=0, atol=1e-12)
    assert len(run.edges_s) == 1


def test_mcap_holds_events_parameters_and_scene(folder: Path, run: Run) -> None:
    recording = Recording.open(folder / "run.mcap")
    assert [event["event"] for event in recording.events] == ["start", "hammer", "end"]
    assert {key: recording.events[1][key] for key in run.events[0]} == run.events[0]
    assert (recording.events[-1]["time_s"], recording.events[-1]["reason"]) == (DURATION_S, "completed")
    last = {key: max(block.index + len(block.values) for block in recording.blocks(key)) for key in recording.streams}
    assert recording.events[-1]["rows"] == last
    friction = recording.parameters["values"]["contact.friction"]
    assert (friction["value"], friction["kind"]) == (0.3, "assumed")
    assert recording.scene["seed"] == 5
    assert recording.scene["scene"]["drive"]["speed_hz"] == 7.0


def test_mcap_ends_with_the_energy_the_engine_and_the_error_estimate(folder: Path, run: Run) -> None:
    status, health = Recording.open(folder / "run.mcap").last_status, run.simulation.health()
    assert status is not None
    for name in ("energy", "engine", "accuracy", "warnings"):
        assert status[name] == json.loads(json.dumps(health[name])), name
    assert (status["time_s"], status["state"], status["pace"]) == (DURATION_S, "ended", "none")
    assert [row.quantity for row in stream_rows(Recording.open(folder / "run.mcap"))][-1] == "energy residual"


def test_scene_of_a_recording_runs_again_to_the_same_bits(folder: Path, run: Run) -> None:
    from rig.run.scenes import parse_scene

    recording = Recording.open(folder / "run.mcap")
    again = simulate(parse_scene(recording.scene["scene"]))
    assert again.signals.tobytes() == run.signals.tobytes()
    np.testing.assert_array_equal(again.counts.values, run.counts.values)


def test_command_names_the_written_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.parquet"
    with pytest.raises(SystemExit) as end:
        main(["simulate", "drop", "-o", str(path), "--duration-s", "0.05"])
    assert end.value.code == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"{path}: 0.05 s simulated")
    assert "contacts" in printed
    assert "energy residual" in printed


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_existing_file_is_replaced_only_by_force(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"run{suffix}"
    path.write_text("precious")
    with pytest.raises(InputError, match=r"^output must be a new file \(--force replaces one\)"):
        make_writer(path, Simulation(load_scene("drop")))
    assert path.read_text() == "precious"
    with pytest.raises(SystemExit) as end:
        main(["simulate", "drop", "-o", str(path), "--duration-s", "0.01", "--force"])
    assert end.value.code == 0
    assert path.stat().st_size > 1_000
    beside = [path.with_name("run.wav.json")] if suffix == ".wav" else []
    assert sorted(tmp_path.iterdir()) == [path, *beside]


@pytest.mark.parametrize("name", ["run.txt", "run", "run.CSV", "run.csv.gz", ".csv"])
def test_another_suffix_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^output must be a file name that ends in \.mcap, \.parquet, \.csv or \.wav"):
        check_run_output(tmp_path / name, force=False)


def test_folders_are_not_made_and_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^output must be in a folder that exists"):
        check_run_output(tmp_path / "none" / "run.csv", force=True)
    (tmp_path / "run.csv").mkdir()
    with pytest.raises(InputError, match=r"^output must be a file, not a folder"):
        check_run_output(tmp_path / "run.csv", force=True)


class WriteError(Exception):
    """An error during writing."""


@pytest.mark.parametrize("error", [WriteError, KeyboardInterrupt])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_interrupted_writer_leaves_nothing(suffix: str, error: type[BaseException], tmp_path: Path) -> None:
    path = tmp_path / f"run{suffix}"
    simulation = Simulation(load_scene("drop"))
    with pytest.raises(error), make_writer(path, simulation) as writer:  # noqa: PT012
        for n, frame in enumerate(frames(simulation)):
            writer.write(frame)
            (made,) = tmp_path.iterdir()  # being written, under another name
            assert made.name.startswith(f"{path.name}.")
            assert made.suffix == ".part"
            if n == 2:
                raise error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_interrupted_writer_keeps_the_existing_file(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"run{suffix}"
    path.write_text("precious")
    simulation = Simulation(load_scene("drop"))
    with pytest.raises(WriteError), make_writer(path, simulation, force=True) as writer:  # noqa: PT012
        writer.write(simulation.advance(50_000))
        raise WriteError
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_disk_error_is_reported_and_leaves_no_file(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"run{suffix}"
    simulation = Simulation(load_scene("drop"))

    def refuse(rows: np.ndarray) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(DiskError, match="No space left"), make_writer(path, simulation) as writer:  # noqa: PT012
        monkeypatch.setattr(writer, "_append", refuse)
        for frame in frames(simulation, chunk_s=0.01):
            writer.write(frame)
    assert list(tmp_path.iterdir()) == []
