"""Exports, read by third-party readers: they equal the recording, to the last bit if the format allows."""

from __future__ import annotations

import csv
import gc
import json
import os
import subprocess
import sys
import wave
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.contents.metadata import Beginning
from recorder.reader import Recording
from recorder.writer import RecordingWriter
from replays.recordings.export import write_run
from replays.recordings.formats import clock
from replays.recordings.formats.exporting.export import Written, export, written_suffixes
from replays.recordings.formats.exporting.selection import Selection, Unit, select
from replays.recordings.formats.mapping import FileOptions
from replays.recordings.formats.source import open_source
from replays.recordings.resimulation.experiment import Experiment
from replays.recordings.validation.comparison import validate
from rig.base.errors import InputError
from rig.base.wire import EVENTS, Block, encode_block, encode_document, sensor_key
from rig.cli.main import main
from rig.run.scenes import load_scene
from rig.run.simulation import Simulation
from tests.commands import run_captured

DURATION_S = 0.12


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("formats") / "run.mcap"
    simulation = Simulation(load_scene("hammer", {"duration_s": DURATION_S, "seed": 7, "sensors.truth_rate_hz": 2000}))
    write_run(simulation, path)
    return Recording.open(path)


@pytest.fixture(scope="module")
def gappy(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The same without a block of the probes, and with two others exchanged."""
    path = tmp_path_factory.mktemp("gaps") / "gaps.mcap"
    with RecordingWriter(
        path, catalogue=recording.catalogue, parameters=recording.parameters, scene=recording.scene
    ) as writer:
        for name in recording.table.groups:
            key = sensor_key(name)
            blocks = [
                Block(
                    b.tick + at * 50,
                    b.index + at,
                    b.rate_hz,
                    b.tick_rate_hz,
                    np.ascontiguousarray(b.values[at : at + 200]),
                )
                for b in recording.blocks(key)
                for at in range(0, len(b.values), 200)
            ]
            if name == "probes":
                del blocks[3]
                blocks[5], blocks[6] = blocks[6], blocks[5]
            for block in blocks:
                writer.write(key, encode_block(block), 0)
    return Recording.open(path)


@pytest.fixture(scope="module")
def noted(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The probes of the same, with a manual command and a note, as a running rig reports them."""
    path = tmp_path_factory.mktemp("noted") / "noted.mcap"
    events = [
        *recording.events[:-1],
        {"event": "command", "tick": 50_000, "time_s": 0.05, "id": 1, "command": "speed", "from": "a console",
         "request": {"speed_hz": 5.2}},
        {"event": "speed", "tick": 50_000, "time_s": 0.05, "speed_hz": 5.2},
        {"event": "note", "tick": 70_000, "time_s": 0.07, "text": "bearing is wärm", "tags": ["look"]},
        recording.events[-1],
    ]  # fmt: skip
    with RecordingWriter(
        path, catalogue=recording.catalogue, parameters=recording.parameters, scene=recording.scene
    ) as writer:
        for _, payload in recording.payloads(sensor_key("probes")):
            writer.write(sensor_key("probes"), payload, 0)
        for event in events:
            writer.write(EVENTS, encode_document(event), 0)
    return Recording.open(path)


EXPECTED_EVENTS = [
    (0.0, "start", "start: scene hammer, seed 7, pace none"),
    (0.02, "hammer", "hammer: force_n 100.0, duration_ms 5.0, direction x"),
    (0.05, "speed", "speed: speed_hz 5.2, from a console"),
    (0.07, "note", "note: bearing is wärm #look"),
    (0.12, "end", "end: reason completed"),
]


def test_mdf_has_events_attachments_and_readable_comments(noted: Recording, tmp_path: Path) -> None:
    from asammdf import MDF

    path = tmp_path / "x.mf4"
    written(noted, path)
    with MDF(path) as mdf:
        events: list[Any] = list(mdf.events)
        assert [(round(event.value, 9), event.name, event.comment) for event in events] == EXPECTED_EVENTS
        assert {(event.event_type, event.sync_type) for event in events} == {(6, 1)}, "markers in seconds"
        attached = {str(block.file_name): mdf.extract_attachment(n)[0] for n, block in enumerate(mdf.attachments)}
        assert json.loads(attached.pop("catalogue.json")) == noted.catalogue
        assert json.loads(attached.pop("parameters.json")) == noted.parameters
        assert json.loads(attached.pop("scene.json")) == {**noted.scene, "taken": noted.commands}
        assert not attached
        about = str(mdf.header.description)
        assert about.startswith("Virtual rotor-stator rig, scene hammer (Hammer during a stable run")
        assert "{" not in about
        assert (mdf.header.project, mdf.header.subject) == ("rotor-stator-rig", "hammer")
        comment = mdf.get("disk_x").comment
        assert comment.startswith("Disk displacement, horizontal (EAST +), from the ring's centre line; Eddy-current")
        assert comment.endswith("24 bits over +-20 V, to 5000 Hz; 3.94 V per mm, -10 V at 0; calibration assumed")


def test_events_and_documents_are_exported_if_the_format_allows(noted: Recording, tmp_path: Path) -> None:
    from nptdms import TdmsFile
    from pyarrow import parquet

    files = {}
    for suffix in written_suffixes():
        _, (files[suffix],) = written(noted, tmp_path / f"x{suffix}", "probes")
    properties = TdmsFile.read_metadata(tmp_path / "x.tdms").properties
    assert properties["events"].splitlines() == [f"{time_s:.6f} s  {text}" for time_s, _, text in EXPECTED_EVENTS]
    assert json.loads(properties["scene.json"]) == {**noted.scene, "taken": noted.commands}
    metadata = parquet.read_schema(tmp_path / "x.parquet").metadata
    assert json.loads(metadata[b"parameters.json"]) == noted.parameters
    beside = json.loads((tmp_path / "x.csv.json").read_text())
    for events in (json.loads(metadata[b"events"]), beside["events"]):
        assert [(each["time_s"], each["event"]) for each in events] == [
            (time_s, name) for time_s, name, _ in EXPECTED_EVENTS
        ]
        assert (events[2]["from"], events[3]["text"]) == ("a console", "bearing is wärm")
    assert beside["documents"]["scene"] == {**noted.scene, "taken": noted.commands}
    assert beside["documents"]["catalogue"] == noted.catalogue
    assert [(one["tick"], one["request"]) for one in noted.commands] == [(50_000, {"speed_hz": 5.2})]
    left_out = "5 events, catalogue, parameters and scene: left out, as UFF58 has no place for them"
    assert files[".uff"].documents == left_out
    assert files[".wav"].documents.endswith(": in x.wav.json")
    short = select(noted, channels=["disk_x"], from_s=0.03, to_s=0.06)
    assert [event.name for event in short.events] == ["speed"]


@pytest.mark.parametrize("suffix", [".mf4", ".tdms", ".parquet", ".uff"])
def test_an_export_with_events_is_imported_again(suffix: str, noted: Recording, tmp_path: Path) -> None:
    path, mapping, again = (str(tmp_path / name) for name in (f"x{suffix}", "x.toml", "again.mcap"))
    written(noted, Path(path), "probes")
    for arguments in ([path, "--template", mapping], [path, "-m", mapping, "-o", again]):
        with pytest.raises(SystemExit) as end:
            main(["import", *arguments])
        assert end.value.code == 0
    found = Recording.open(again)
    if suffix != ".uff":
        commands = [
            {"at_s": one.at_s, **one.request.model_dump()} for one in Experiment.from_recording(found).scene.commands
        ]
        assert commands[1:] == [{"at_s": 0.05, "command": "speed", "speed_hz": 5.2}], "what was sent is the scene's own"
    np.testing.assert_allclose(found.samples("probes").values, noted.samples("probes").values, rtol=0, atol=1e-6)
    assert len(json.dumps(found.scene["import"]["files"])) < 3_000, "without the rig's documents"


def written(
    recording: Recording, path: Path, *channels: str, unit: Unit = "engineering", truth: bool = False
) -> tuple[Selection, list[Written]]:
    merged = path.suffix in (".csv", ".parquet", ".wav")
    selection = select(recording, channels=channels, unit=unit, truth=truth, merged=merged)
    return selection, export(selection, path)


def counts_of(recording: Recording, group: str) -> np.ndarray:
    return np.concatenate([block.values for block in recording.blocks(sensor_key(group))])


@pytest.mark.skipif(sys.platform != "linux", reason="file names are text")
@pytest.mark.parametrize("suffix", written_suffixes())
def test_a_recording_with_an_undecodable_name_is_exported(suffix: str, recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"a\xff\x01.mcap")
    path.write_bytes(recording.path.read_bytes())
    opened = Recording.open(path)
    opened.metadata["rig"]["scene"] = "\x01"
    chosen = select(opened, channels=["disk_x"])
    assert (chosen.metadata["recording"], chosen.metadata["scene"]) == ("a\\udcff\\x01.mcap", "\\x01")
    export(chosen, tmp_path / f"out{suffix}")


def test_mdf_by_asammdf(recording: Recording, tmp_path: Path) -> None:
    from asammdf import MDF

    path = tmp_path / "x.mf4"
    written(recording, path, truth=True)
    with MDF(path) as mdf:
        groups: list[Any] = list(mdf.groups)
        names = [group.channel_group.acq_name for group in groups]
        assert names[:5] == list(recording.table.groups)
        assert mdf.header.start_time.timestamp() == pytest.approx(recording.clock[0, 1], abs=1e-3)
        assert "seed 7" in str(mdf.header.description)
        for number, group in enumerate(recording.table.groups.values()):
            samples, counts = recording.samples(group.name), counts_of(recording, group.name)
            for c, channel in enumerate(group.channels):
                found = mdf.get(channel.name, group=number)
                raw = mdf.get(channel.name, group=number, raw=True)
                assert found.unit == channel.unit
                assert channel.label in found.comment
                np.testing.assert_array_equal(raw.samples, counts[:, c])
                np.testing.assert_allclose(found.samples, samples.values[:, c], rtol=1e-15, atol=0)
                np.testing.assert_allclose(found.timestamps, samples.times_s, rtol=0, atol=1e-12)
        force = mdf.get("truth.contact.normal_force")
        np.testing.assert_array_equal(force.samples, recording.truth("contact")["normal_force"])
        assert (force.unit, len(force.timestamps)) == ("N", round(DURATION_S * 2000))


def test_a_released_mdf_file_is_closed(recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from asammdf import MDF
    from asammdf.blocks import mdf_v4

    path = tmp_path / "x.mf4"
    written(recording, path)
    made, make = [], mdf_v4.NamedTemporaryFile
    monkeypatch.setattr(mdf_v4, "NamedTemporaryFile", lambda **options: made.append(make(**options)) or made[-1])
    for owner in (MDF, mdf_v4.MDF4):  # the garbage collector may reach the temporary file before them
        monkeypatch.delattr(owner, "__del__")
    source = open_source(path, FileOptions())
    assert [file.closed for file in made] == [False]
    del source
    gc.collect()
    assert made[0].closed


def test_tdms_by_nptdms(recording: Recording, tmp_path: Path) -> None:
    from nptdms import TdmsFile

    path = tmp_path / "x.tdms"
    written(recording, path)
    with TdmsFile.open(path) as file:
        assert file.properties["parameter_set"] == "corrected"
        for name, group in recording.table.groups.items():
            samples, counts = recording.samples(name), counts_of(recording, name)
            for c, channel in enumerate(group.channels):
                found = file[name][channel.name]
                assert found.properties["unit_string"] == channel.unit
                assert found.properties["rig_sensitivity_v"] == channel.sensitivity_v
                np.testing.assert_array_equal(found.read_data(scaled=False), counts[:, c])
                np.testing.assert_allclose(found[:], samples.values[:, c], rtol=1e-15, atol=0)
                np.testing.assert_allclose(found.time_track(), samples.times_s, rtol=0, atol=1e-9)


def test_uff_by_the_columns_of_its_specification(recording: Recording, tmp_path: Path) -> None:
    """Read by field positions, as the documentation of dataset 58 gives them, not by a library."""
    path = tmp_path / "x.uff"
    written(recording, path, "disk_x", "P_E")
    data = path.read_bytes()
    for name, group, kind in (("disk_x", "probes", (8, 1, 0)), ("P_E", "forces", (9, 0, 1))):
        head, rest = [], data
        for _ in range(13):
            line, rest = rest.split(b"\n", 1)
            head.append(line.decode("ascii"))
        assert head[0] == "    -1"
        assert head[1][:6] == "    58"
        assert head[1][6] == "b"
        little, ieee, lines, size = (int(head[1][a:b]) for a, b in ((7, 13), (13, 19), (19, 31), (31, 43)))
        assert (little, ieee, lines) == (1, 2, 11)
        assert head[2].strip() == name
        assert (int(head[7][:5]), head[7][31:41].strip()) == (1, name)
        precision, rows, even = (int(head[8][a:b]) for a, b in ((0, 10), (10, 20), (20, 30)))
        assert (precision, even, float(head[8][43:56])) == (4, 1, 5e-5)
        assert (int(head[9][:10]), head[9][26:46].strip(), head[9][47:67].strip()) == (17, "Time", "s")
        assert tuple(int(head[10][a:b]) for a, b in ((0, 10), (10, 15), (15, 20))) == kind
        assert head[10][47:67].strip() == recording.table.channels[name].unit
        assert size == 8 * rows
        values = np.frombuffer(rest[:size], "<f8")
        np.testing.assert_array_equal(values, recording.samples(group)[name])
        assert rest[size : size + 8] == b"\n    -1\n"
        data = rest[size + 8 :]
    assert data == b""


FREEDOMS = {
    "disk_x": (1, 1), "disk_y": (1, 2), "ring_x": (2, 1), "ring_y": (2, 2), "P_N": (3, 2), "P_S": (4, -2),
    "P_E": (5, 1), "P_W": (6, -1), "inner_x": (7, 1), "inner_y": (7, 2), "outer_x": (8, 1), "outer_y": (8, 2),
    "speed": (9, 6), "keyphasor": (10, 0), "hammer": (1, 1),
}  # fmt: skip
"""Node and direction: x is 1, y is 2, against them is negative, turning about the shaft is 6."""


def test_uff_nodes_do_not_depend_on_the_selection(recording: Recording, tmp_path: Path) -> None:
    import pyuff

    path = tmp_path / "x.uff"
    written(recording, path, "outer_y", "truth.forces.P_W", "truth.forces.magnet_y", "truth.contact.normal_force")
    heads: list[Any] = [pyuff.UFF(str(path)).read_sets(n, header_only=True) for n in range(4)]
    found = {head["id1"]: (head["rsp_node"], head["rsp_dir"]) for head in heads}
    assert found["outer_y"] == FREEDOMS["outer_y"]
    assert found["truth.forces.P_W"] == FREEDOMS["P_W"]
    assert found["truth.forces.magnet_y"][1] == 2
    assert found["truth.contact.normal_force"][1] == 0
    assert heads[0]["id5"] == "node 8: outer; direction 2: y, up; group=accelerations"


def test_uff_by_pyuff(recording: Recording, tmp_path: Path) -> None:
    import pyuff

    path = tmp_path / "x.uff"
    written(recording, path)
    file = pyuff.UFF(str(path))
    channels = list(recording.table.channels.values())
    assert list(file.get_set_types()) == [58] * len(channels)
    for n, channel in enumerate(channels):
        found: Any = file.read_sets(n)
        assert (found["id1"], found["ordinate_axis_units_lab"]) == (channel.name, channel.unit)
        assert (found["rsp_ent_name"], found["rsp_node"], found["rsp_dir"]) == (channel.name, *FREEDOMS[channel.name])
        assert found["id5"].startswith(f"node {found['rsp_node']}: ")
        assert (found["ref_node"], found["ref_dir"]) == (0, 0)
        np.testing.assert_array_equal(found["data"], recording.samples(channel.group)[channel.name])


def test_uff_has_the_exact_start_time(recording: Recording, tmp_path: Path) -> None:
    import pyuff

    selection = select(recording, channels=["disk_x"])
    late = replace(selection, tables=(replace(selection.tables[0], first_s=70_000.123456789),))
    export(late, path := tmp_path / "late.uff")
    source = open_source(path, FileOptions())
    assert source.read(source.entries[0]).first_s == 70_000.123456789
    head: Any = pyuff.UFF(str(path)).read_sets(0, header_only=True)
    assert head["abscissa_min"] == pytest.approx(70_000.123457, abs=1e-6), "where another program looks"


def test_csv_by_the_csv_module(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    written(recording, path)
    with path.open(newline="") as file:
        names, *rows = csv.reader(file)
    assert names == ["time [s]", *(f"{c.name} [{c.unit}]" for c in recording.table.channels.values())]
    values = np.array(rows, dtype=float)
    expected = np.column_stack([recording.samples(name).values for name in recording.table.groups])
    np.testing.assert_array_equal(values[:, 1:], expected)
    beside = json.loads((tmp_path / "x.csv.json").read_text())
    assert beside["tables"][0]["columns"][0]["sensitivity_v"] == recording.table.channels["disk_x"].sensitivity_v


def test_parquet_by_pyarrow(recording: Recording, tmp_path: Path) -> None:
    from pyarrow import parquet

    path = tmp_path / "x.parquet"
    written(recording, path, "forces", unit="counts")
    table = parquet.read_table(path)
    np.testing.assert_array_equal(
        np.column_stack([c.to_numpy() for c in table.columns[1:]]), counts_of(recording, "forces")
    )
    metadata = table.schema.field("P_N [counts]").metadata
    channel = recording.table.channels["P_N"]
    assert float(metadata[b"scale"]) == channel.scale
    assert json.loads(table.schema.metadata[b"rig"])["scene"] == "hammer"


# libsndfile adds a chunk of peaks to floating point, which scipy skips with a warning.
@pytest.mark.filterwarnings("ignore:Chunk .non-data. not understood")
def test_wav_by_scipy_and_the_wave_module(recording: Recording, tmp_path: Path) -> None:
    from scipy.io import wavfile

    written(recording, tmp_path / "f.wav", "probes")
    rate, samples = wavfile.read(tmp_path / "f.wav")
    assert (rate, samples.dtype) == (20_000, np.float32)
    beside = json.loads((tmp_path / "f.wav.json").read_text())["tables"][0]["columns"]
    for c, column in enumerate(beside):
        channel = recording.table.channels[column["name"]]
        values = samples[:, c].astype(float) * column["full_scale"] + column["offset_exported"]
        expected = recording.samples("probes")[column["name"]]
        np.testing.assert_allclose(values, expected, rtol=0, atol=1e-12)
        assert column["full_scale"] == pytest.approx(channel.adc_v / channel.sensitivity_v)

    written(recording, tmp_path / "i.wav", "forces", unit="counts")
    with wave.open(str(tmp_path / "i.wav")) as file:
        assert (file.getsampwidth(), file.getnchannels(), file.getframerate()) == (4, 4, 20_000)
        integers = np.frombuffer(file.readframes(file.getnframes()), "<i4").reshape(-1, 4)
    np.testing.assert_array_equal(integers, counts_of(recording, "forces") << 8)


def test_volts_equal_the_converter_input(recording: Recording, tmp_path: Path) -> None:
    selection, _ = written(recording, tmp_path / "x.parquet", "disk_x", unit="volts")
    table = selection.tables[0]
    volts = np.concatenate([table.convert_column(0, chunk) for chunk in selection.chunks(table)])
    channel = recording.table.channels["disk_x"]
    mm = recording.samples("probes")["disk_x"]
    np.testing.assert_allclose(volts, channel.bias_v + channel.sensitivity_v * mm, rtol=0, atol=1e-12)


def test_a_range_holds_its_ends_and_several_rates_make_several_tables(recording: Recording, tmp_path: Path) -> None:
    selection = select(recording, channels=["disk_x", "truth.contact"], from_s=0.01, to_s=0.05, merged=True)
    files = export(selection, tmp_path / "x.csv")
    assert [entry.path.name for entry in files] == ["x-20000Hz.csv", "x-2000Hz.csv"]
    times = np.loadtxt(files[1].path, delimiter=",", skiprows=1)[:, 0]
    np.testing.assert_allclose(times, np.arange(20, 101) / 2000, rtol=0, atol=1e-12)
    assert files[0].tables[0][2] == 801


def test_one_rate_by_a_declared_method(recording: Recording, tmp_path: Path) -> None:
    selection = select(recording, channels=["ring_x", "truth.contact.normal_force"], merged=True)
    files = export(selection, tmp_path / "x.parquet", rate_hz=5000, method="linear")
    assert files[0].tables[0][1:3] == (5000, int((DURATION_S - 1 / 2000) * 5000 + 1e-6) + 1)
    with pytest.raises(InputError, match=r"^unit must be engineering or volts"):
        export(select(recording, unit="counts"), tmp_path / "y.tdms", rate_hz=1000)


def test_missing_rows_are_omitted_or_nan(gappy: Recording, tmp_path: Path) -> None:
    from nptdms import TdmsFile

    assert gappy.streams["rig/sensors/probes"].rows == round(DURATION_S * 20_000) - 200
    written(gappy, tmp_path / "x.csv", "probes")
    values = np.loadtxt(tmp_path / "x.csv", delimiter=",", skiprows=1)
    samples = gappy.samples("probes")
    order = np.argsort(samples.index)
    np.testing.assert_allclose(values[:, 0], samples.times_s[order], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(values[:, 1:], samples.values[order])
    written(gappy, tmp_path / "x.tdms", "disk_x")
    found = TdmsFile.read(tmp_path / "x.tdms")["probes"]["disk_x"][:]
    assert np.flatnonzero(np.isnan(found)).tolist() == list(range(600, 800))
    np.testing.assert_array_equal(found[~np.isnan(found)], samples["disk_x"][order])
    with pytest.raises(InputError, match=r"^range must be free of missing rows for a WAV file"):
        written(gappy, tmp_path / "x.wav", "disk_x")
    _, summary = written(gappy, tmp_path / "x.mf4")
    assert summary[0].tables[0][3] == 200
    assert {path.suffix for path in tmp_path.iterdir()} == {".csv", ".json", ".tdms", ".mf4"}


@pytest.mark.parametrize("suffix", written_suffixes())
def test_one_row_is_exported_and_zero_rows_are_refused(suffix: str, recording: Recording, tmp_path: Path) -> None:
    key = sensor_key("probes")
    for rows in (0, 1):
        path = tmp_path / f"{rows}.mcap"
        with RecordingWriter(
            path, catalogue=recording.catalogue, parameters=recording.parameters, scene=recording.scene
        ) as writer:
            for block in list(recording.blocks(key))[:rows]:
                payload = encode_block(replace(block, values=np.ascontiguousarray(block.values[:1])))
                writer.write(key, payload, 0)
    _, summary = written(Recording.open(tmp_path / "1.mcap"), tmp_path / f"x{suffix}")
    assert summary[0].tables[0][2] == 1
    with pytest.raises(InputError, match=r"^file must be a recording with samples; received '.*0\.mcap'"):
        written(Recording.open(tmp_path / "0.mcap"), tmp_path / f"y{suffix}")
    with pytest.raises(InputError, match=r"^file must be a recording with two samples of a channel"):
        validate(Recording.open(tmp_path / "1.mcap"))
    assert not list(tmp_path.glob("y*"))


@pytest.mark.parametrize("suffix", written_suffixes())
def test_a_failed_export_leaves_no_file(suffix: str, recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / f"x{suffix}"
    path.write_text("precious")
    selection = select(recording, merged=True)

    def stop(part: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(selection, path, force=True, progress=stop)
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-o", "x.xls"], "--output must be a file name that ends in .mf4, .tdms, .uff"),
        (["-o", ""], "--output must be a file name that ends in .mf4, .tdms, .uff"),
        (["-o", "no/x.csv"], "--output must be in a folder that exists"),
        (["-o", "x.csv", "--channels", "disk_z"], "--channels must be a channel of the recording, such as disk_y"),
        (
            ["-o", "x.csv", "--channels", "foo"],
            "--channels must be a channel of the recording, one of its groups (probes",
        ),
        (["-o", "x.csv", "--channels", "truth.nothing"], "--channels must be one of truth.state, truth."),
        (["-o", "x.csv", "--channels", "truth.state.foo"], "--channels must be truth.state.COLUMN with one of "),
        (["-o", "x.csv", "--unit", "mils"], "--unit must be engineering, volts or counts"),
        (["-o", "x.csv", "--method", "magic"], "--method must be polyphase or linear"),
        (["-o", "x.csv", "--from", "5"], "range must be in the recording, 0 to 0.11995 s; received 'from 5 s'"),
        (["-o", "x.csv", "--from", "0.1", "--to", "0.05"], "--to must be after --from 0.1"),
        (["-o", "x.csv", "--rate-hz", "0"], "--rate-hz must be between 1 and 1e6"),
        (["-o", "x.tdms", "--rate-hz", "1000", "--unit", "counts"], "--unit must be engineering or volts"),
    ],
)
def test_wrong_exports_are_refused_in_one_line(
    arguments: list[str],
    message: str,
    recording: Recording,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["export", str(recording.path), *arguments])
    printed = capsys.readouterr()
    assert end.value.code == 2
    assert printed.out == ""
    assert printed.err.startswith(f"rig: {message}")
    assert "None" not in printed.err
    assert len(printed.err) < 600
    assert printed.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("module", "says"),
    [
        ("raise ModuleNotFoundError(name='pyuff')", "not installed: pip install 'rotor-stator-rig[formats]'\n"),
        (
            "raise OSError('no libuff')",
            "installed and broken (OSError: no libuff): pip install --force-reinstall pyuff\n",
        ),
        ("import no_such_module", "installed and broken (ModuleNotFoundError: No module named 'no_such_module'): pip"),
    ],
)
def test_a_package_that_a_format_needs_is_named(
    module: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "pyuff", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    Path("pyuff.py").write_text(module)
    Path("run.uff").write_text("    -1\n")
    status, output, complaints = run_captured(capsys, "import", "run.uff", "--template", "mapping.toml")
    assert (status, output, complaints.count("\n")) == (2, "", 1)
    assert complaints.startswith(f"rig: UFF files need the package pyuff, which is {says}")
    assert not Path("mapping.toml").exists()


@pytest.mark.parametrize(("rate_hz", "target_hz"), [(51_200.0, 20_000.0), (10_000.0, 20_000.0), (19_998.7, 20_000.0)])
def test_polyphase_reproduces_a_tone(rate_hz: float, target_hz: float) -> None:
    """Compared with the closed form: a tone in the pass band, at instants between samples, within 90 dB."""
    tone_hz = 0.8 * clock.PASS_BAND * min(rate_hz, target_hz) / 2
    axis = clock.TimeAxis(0.0131, rate_hz, round(rate_hz * 0.4))
    values = 3.0 + np.sin(2 * np.pi * tone_hz * axis.instants())
    first_s, rows = 0.0131 + 0.1234567, 3000
    found = clock.resample_polyphase(values, axis, first_s, target_hz, rows)
    wanted = 3.0 + np.sin(2 * np.pi * tone_hz * (first_s + np.arange(rows) / target_hz))
    assert np.abs(found - wanted).max() < 2 * np.pi * tone_hz / rate_hz / 512 + 1e-4  # its grid of instants is 1/512


def test_polyphase_suppresses_aliases() -> None:
    axis = clock.TimeAxis(0.0, 20_000.0, 20_000)
    tone = np.sin(2 * np.pi * 2_600.0 * axis.instants())
    found = clock.resample_polyphase(tone, axis, 0.1, 5_000.0, 4_000)
    assert np.abs(found).max() < 1e-4
    assert np.abs(clock.interpolate_linear(tone, axis, 0.1 + np.arange(4_000) / 5_000.0)).max() > 0.9


def test_parts_of_a_rotation_are_exported_as_one(recording: Recording, tmp_path: Path) -> None:
    parts = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    half = round(0.5 * DURATION_S * 1e9)
    for number, path in enumerate(parts):
        with RecordingWriter(
            path, catalogue=recording.catalogue, parameters=recording.parameters, scene=recording.scene,
            beginning=Beginning(metadata={"series": {"id": "one", "number": str(number)}}),
        ) as writer:  # fmt: skip
            for name in recording.table.groups:
                for time_ns, payload in recording.payloads(sensor_key(name)):
                    if (time_ns >= half) == bool(number):
                        writer.write(sensor_key(name), payload, time_ns)
    for name, files in (("one", [recording.path]), ("two", parts[::-1])):
        with pytest.raises(SystemExit) as end:
            main(["export", *map(str, files), "-o", str(tmp_path / f"{name}.csv"), "--channels", "P_N,ring_x"])
        assert end.value.code == 0
    assert (tmp_path / "two.csv").read_bytes() == (tmp_path / "one.csv").read_bytes()


@pytest.mark.wallclock
def test_tables_are_made_without_pandas() -> None:
    """Its import takes longer than a table of one second; in a separate process, because others import it here."""
    code = (
        "import sys, numpy as np; from replays.recordings.formats.readers.columnar import arrow_table, float_schema; "
        "t = arrow_table([np.arange(3.0), np.arange(6.0)[::2]], float_schema(['a', 'b'])); "
        "print(t.to_pydict(), 'pandas' in sys.modules)"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "{'a': [0.0, 1.0, 2.0], 'b': [0.0, 2.0, 4.0]} False"
