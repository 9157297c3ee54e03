"""Imports of foreign logs: text byte by byte, MDF4 as a measuring system writes it, others."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import tomllib
import wave
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.reader import Recording
from replays.recordings.formats import clock
from replays.recordings.formats import mapping as mappings
from replays.recordings.formats.conversion import Conversion, convert, write_recording
from replays.recordings.formats.guessing.template import example, template
from replays.recordings.formats.mapping import FileOptions
from replays.recordings.formats.source import open_source
from replays.recordings.resimulation.experiment import Experiment
from rig.base import units
from rig.base.errors import InputError
from rig.cli.main import main
from tests.commands import run_for_output


def imported(folder: Path, files: list[Path], mapping: str, *, name: str = "out") -> tuple[Conversion, Recording]:
    path = folder / f"{name}.toml"
    path.write_text(mapping)
    conversion = convert(files, mappings.load_mapping(path))
    write_recording(conversion, folder / f"{name}.mcap")
    return conversion, Recording.open(folder / f"{name}.mcap")


def comma(number: float) -> str:
    return f"{number:.6f}".replace(".", ",")


RATE_HZ = 5000


@pytest.fixture(scope="module")
def daq_text(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A log as a German measuring amplifier exports it: header, semicolons, decimal commas, a row of units, latin-1."""
    path = tmp_path_factory.mktemp("text") / "messung.txt"
    t = np.arange(2000) / RATE_HZ
    columns = np.round(
        np.stack([t, -10.0 + 0.7 * np.sin(300 * t), 40.0 * np.cos(300 * t), 112.4 + t, 372.0 + 5 * t], axis=1), 6
    )
    lines = [
        "Messung;Rotorpruefstand", "Datum;21.11.2026", "Prüfer;M. Müller", "",
        "Zeit;Wegsonde X;Weg Y;Kraft N;Drehzahl", "s;V;µm;lbf;U/min",
        *(";".join(comma(value) for value in row) for row in columns),
    ]  # fmt: skip
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode("latin-1"))
    return path, columns


TEXT_MAPPING = """
[channels.ring_x]
source = "Wegsonde X"
sensitivity = "200 mV/mil"
bias = -10.0
sign = -1
[channels.ring_y]
source = "Weg Y"
[channels.P_N]
source = "Kraft N"
[channels.speed]
source = "Drehzahl"
[channels.oil_temperature]
source = "Kraft N"
unit = "V"
to = "bearing"
to_unit = "V"
"""


def test_text_with_semicolons_and_decimal_commas(daq_text: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    path, columns = daq_text
    conversion, recording = imported(tmp_path, [path], TEXT_MAPPING)
    expected = {
        "ring_x": ("probes", -(columns[:, 1] + 10.0) / 0.2 * 0.0254),  # 200 mV/mil, 1 mil = 25.4 um
        "ring_y": ("probes", columns[:, 2] * 1e-3),
        "P_N": ("forces", columns[:, 3] * 4.4482216152605),
        "speed": ("drive", columns[:, 4] / 60.0),
        "oil_temperature": ("bearing", columns[:, 3]),
    }
    for name, (group, values) in expected.items():
        samples = recording.samples(group)
        assert samples.rate_hz == RATE_HZ
        np.testing.assert_allclose(samples.times_s, columns[:, 0], rtol=0, atol=1e-9)
        half = 0.5 * abs(recording.table.channels[name].scale)
        assert np.abs(samples[name] - values).max() <= half * (1 + 1e-6)
        reach = np.abs(values - recording.table.channels[name].offset).max()
        assert half < 2.0**-29 * reach, "no resolution of a 24-bit converter is lost"
    assert recording.table.channels["ring_x"].sensitivity_v == pytest.approx(-7.874, abs=1e-3)
    ring = recording.table.channels["ring_x"]
    volts = np.concatenate([b.values[:, 0] for b in recording.blocks("rig/sensors/probes")]) * ring.lsb_v
    np.testing.assert_allclose(
        volts, columns[:, 1], rtol=0, atol=1e-7
    )  # counts are those of the voltage, bias included
    assert any("latin-1" in remark for remark in conversion.remarks)
    assert recording.scene["import"]["channels"]["P_N"]["source"] == "messung.txt Kraft N"
    assert recording.scene["import"]["mapping"]["channels"]["ring_x"]["sign"] == -1
    assert recording.events[0]["event"] == "import"
    with pytest.raises(InputError, match=r"scene it ran: add \[experiment\] to the mapping"):
        Experiment.from_recording(recording)


@pytest.mark.parametrize(
    ("text", "names", "units"),
    [
        ("a,b\n1,2\n2,3\n", ["a", "b"], ["", ""]),
        ("# made by x\ntime (s)\tforce (kN)\n0\t1.5\n0.1\t2.5\n", ["force"], ["kN"]),
        ("1.0;2.0\n2.0;3.0\n3.0;4.0\n", ["column 1", "column 2"], ["", ""]),
        ("  0.0   1.5e-3\n  0.1   2.5e-3\n  0.2  3.5e-3\n", ["column 1", "column 2"], ["", ""]),
        ('"Time [ms]","x [um]"\n0,1\n1,2\n', ["x"], ["um"]),
        ("2026-11-21 10:00:00.000,1\n2026-11-21 10:00:00.010,2\n", ["column 1", "column 2"], None),
    ],
)
def test_dialects_are_found_out(text: str, names: list[str], units: list[str] | None, tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text(text)
    if units is None:
        source = open_source(path, FileOptions(time_column=1))
        assert source.start is not None
        assert source.entries[0].rate_hz == pytest.approx(100.0)
        return
    source = open_source(path, FileOptions())
    assert [entry.name for entry in source.entries] == names
    assert [entry.unit for entry in source.entries] == units


THREE = [[0.0, 0.1, 0.2], [1.5, 2.5, 3000.0]]
WITH_HOLES = [[0.0, 0.1, 0.2], [1.0, 2.0, math.nan], [math.nan, math.nan, 5.0]]


@pytest.mark.parametrize(
    ("content", "columns"),
    [
        (b"\xef\xbb\xbftime,x [mm]\n0,1.5\n0.1,2.5\n0.2,3000\n", THREE),
        (b"sep=;\r\ntime;x [mm]\r\n0,0;1,5\r\n0,1;2,5\r\n0,2;3000\r\n", THREE),
        (b'"time, s","x, mm"\n0,1.5\n0.1,2.5\n0.2,3000\n', THREE),
        (b'time,x [mm]\n0,"1.5"\n0.1,"2.5"\n0.2,"3,000"\n', THREE),
        (b"time;x [mm]\n0,0;1,5\n0,1;2,5\n0,2;3.000,0\n", THREE),
        ("time;x [mm]\n0,0;1,5\n0,1;2,5\n0,2;3\u00a0000,0\n".encode(), THREE),
        (b"time,x [mm],\n0,1.5,\n0.1,2.5,\n0.2,3000,\n", THREE),
        (b"time,x [mm]\n0,1.5,\n0.1,2.5,\n0.2,3000,\n", THREE),
        (b"time;x [mm];\n0,0;1,5\n0,1;2,5\n0,2;3000\n", THREE),
        (b"time,x [mm]\r\r\n0,1.5\r\r\n0.1,2.5\r\r\n0.2,3000\r\r\n", THREE),
        (b"time,x [mm]\n\n0,1.5\n0.1,2.5\n\n0.2,3000\n", THREE),
        ("time\tx [mm]\n0,0\t1,5\n0,1\t2,5\n0,2\t3000\n".encode("utf-16"), THREE),
        (("time\tx [mm]\n" + "\n" * 196 + "0,0\t1,5\n0,1\t2,5\n0,2\t3000\n").encode("utf-16"), THREE),
        (b"time,x [mm],y\n0,1,\n0.1,2,\n0.2,,5\n", WITH_HOLES),
        (b"x [mm]\n1,5\n2,5\n3,5\n", [None, [1.5, 2.5, 3.5]]),
        (b"when,x [mm]\n10:00:00.0,1.5\n10:00:00.1,2.5\n10:00:00.2,3000\n", [[36000, 36000.1, 36000.2], THREE[1]]),
        (b"Date;x [mm]\n2026-11-21 10:00:00,5;1,5\n2026-11-21 10:00:00,6;2,5\n2026-11-21 10:00:00,7;3000\n",
         [[0.5, 0.6, 0.7], THREE[1]]),
        (b"t,x [mm]\n2026-11-21T10:00:00.5+02:00,1.5\n2026-11-21T10:00:00.6+02:00,2.5\n"
         b"2026-11-21T10:00:00.7+02:00,3000\n",
         [[0.5, 0.6, 0.7], THREE[1]]),
    ],
)  # fmt: skip
def test_no_line_of_a_text_file_is_lost(content: bytes, columns: list[list[float] | None], tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(content)
    source = open_source(path, FileOptions())
    assert [entry.name for entry in source.entries] == ["x", "y"][: len(columns) - 1]
    assert source.entries[0].unit == "mm"
    signals = [source.read(entry) for entry in source.entries]
    for signal, expected in zip(signals, columns[1:], strict=True):
        np.testing.assert_array_equal(signal.values, expected)
    times_s = signals[0].times_s
    assert (times_s is None) == (columns[0] is None)
    if times_s is not None:
        np.testing.assert_allclose(times_s, columns[0] or [], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("time", "hour_utc"), [("2026-11-21T10:00:00+02:00", 8), ("2026-11-21T10:00:00", 10), ("2026-11-21T10:00:00Z", 10)]
)
def test_wall_time_of_text(time: str, hour_utc: int, tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text(f"time,P_N [N]\n{time},1\n{time.replace(':00:00', ':00:01')},2\n")
    conversion, _ = imported(tmp_path, [path], '[channels.P_N]\nsource = "P_N"\n')
    assert (conversion.start.hour, conversion.start.utcoffset()) == (hour_utc, timedelta(0))
    assert any("no time zone" in remark for remark in conversion.remarks) == (len(time) == 19)


def test_seconds_since_1970_give_the_date(tmp_path: Path) -> None:
    path = rows_csv(tmp_path / "x.csv", {"time": 1_800_000_000.0 + np.arange(100) / 100, "P_N [N]": np.arange(100.0)})
    conversion, _ = imported(tmp_path, [path], '[channels.P_N]\nsource = "P_N"\n')
    assert conversion.start.timestamp() == pytest.approx(1_800_000_000.0, abs=1e-3)


def test_labview_measurement_file(tmp_path: Path) -> None:
    lines = [
        "LabVIEW Measurement\t", "Writer_Version\t2", "Separator\tTab", "Decimal_Separator\t,", "Multi_Headings\tYes",
        "X_Columns\tNo", "Date\t2026/11/21", "Time\t09:51:39,25", "***End_of_Header***\t", "\t", "Channels\t2\t\t",
        "Samples\t3\t3\t", "Y_Unit_Label\tNewtons\tg\t", "X0\t0,0\t0,0\t", "Delta_X\t3,906250E-5\t3,906250E-5\t",
        "***End_of_Header***\t\t\t", "X_Value\tForce\tAcc\tComment", "\t0,5\t1,5\t", "\t0,25\t-2,5", "\t-1\t0",
    ]  # fmt: skip
    lines = [line.rstrip("\t") if n >= 17 else line for n, line in enumerate(lines)]
    path = tmp_path / "x.lvm"
    path.write_text("\n".join(lines) + "\n")
    mapping = '[channels.hammer]\nsource = "Force"\n[channels.inner_x]\nsource = "Acc"\n'
    conversion, recording = imported(tmp_path, [path], mapping)
    assert recording.samples("hammer").rate_hz == 25_600
    np.testing.assert_allclose(recording.samples("hammer")["hammer"], [0.5, 0.25, -1.0])
    np.testing.assert_allclose(recording.samples("accelerations")["inner_x"], 9.80665 * np.array([1.5, -2.5, 0]))
    assert conversion.start.isoformat().startswith("2026-11-21T09:51:39.25")


@pytest.fixture(scope="module")
def daq_mdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An MDF4 as a measuring system writes it: two groups at two rates, 16-bit integers with a conversion, floats."""
    from asammdf import MDF, Signal

    path = tmp_path_factory.mktemp("mdf") / "daq.mf4"
    fast, slow = np.arange(8192) / 51_200.0, np.arange(400) / 2_500.0
    codes = np.round(20_000 * np.sin(700 * fast)).astype(np.int16)
    codes[100:103] = 32_767
    pulse = (np.modf(fast * 40.0 + 0.3)[0] < 0.1).astype(np.float32) * 5.0
    with MDF(version="4.10") as mdf:
        mdf.append(
            [
                Signal(codes, fast, name="AI0", unit="V", conversion={"a": 10.0 / 32_768, "b": 0.0}),
                Signal(pulse, fast, name="Keyphasor", unit="V"),
            ],
            acq_name="Fast",
            common_timebase=True,
        )
        mdf.append(
            [
                Signal(np.linspace(370, 380, 400).astype(np.float32), slow, name="Speed", unit="rpm"),
                Signal(np.array([b"on", b"of"] * 200), slow, name="State", encoding="utf-8"),
            ],
            acq_name="Slow",
            common_timebase=True,
        )
        mdf.save(path)
    return path


MDF_MAPPING = """
[channels.hammer]
source = "AI0"
sensitivity = "2.25 mV/N"
[channels.speed]
source = "Speed"
[keyphasor]
source = "Keyphasor"
threshold = 2.5
"""


def test_a_foreign_mdf_keeps_its_integers(daq_mdf: Path, tmp_path: Path) -> None:
    conversion, recording = imported(tmp_path, [daq_mdf], MDF_MAPPING)
    codes = np.round(20_000 * np.sin(700 * np.arange(8192) / 51_200.0)).astype(int)
    codes[100:103] = 32_767
    blocks = list(recording.blocks("rig/sensors/hammer"))
    np.testing.assert_array_equal(np.concatenate([block.values[:, 0] for block in blocks]), codes)
    np.testing.assert_allclose(recording.samples("hammer")["hammer"], codes * (10 / 32_768) / 2.25e-3, rtol=1e-12)
    # At 51.2 kHz the sample period is a fraction of a microsecond: the times are exact nevertheless.
    np.testing.assert_allclose(recording.samples("hammer").times_s, np.arange(8192) / 51_200.0, rtol=0, atol=1e-12)
    assert recording.samples("drive").rate_hz == 2500
    np.testing.assert_allclose(recording.samples("drive")["speed"], np.linspace(370, 380, 400) / 60, rtol=1e-6)
    assert any("non-numeric" in remark for remark in conversion.remarks)
    # The pulse rises where 40 t + 0.3 is whole, within a sample; half height between two samples.
    edges = recording.edges()
    exact = (np.arange(1, 1 + len(edges)) - 0.3) / 40.0
    assert len(edges) == 6
    assert np.all((exact > edges - 1 / 51_200) & (exact <= edges + 1 / 51_200))


def test_mdf_masters_in_milliseconds_and_of_an_angle(tmp_path: Path) -> None:
    from asammdf import MDF, Signal

    path, t = tmp_path / "x.mf4", np.arange(50) / 1000
    with MDF(version="4.10") as mdf:
        for number, (name, stamps) in enumerate((("a", 1e3 * t), ("b", t))):
            mdf.append([Signal(np.arange(50.0), stamps, name=name, unit="N")], common_timebase=True)
            master: Any = mdf.groups[number].channels[0]
            master.unit, master.sync_type = ("ms", 1) if name == "a" else ("rad", 2)
        mdf.save(path)
    by_time, by_angle = open_source(path, FileOptions()).entries
    assert by_time.rate_hz == pytest.approx(1000.0)
    assert by_angle.rate_hz is None
    _, recording = imported(tmp_path, [path], '[channels.P_N]\nsource = "a"\n')
    np.testing.assert_allclose(recording.samples("forces").times_s, t, rtol=0, atol=1e-9)
    with pytest.raises(InputError, match=r"^time\.rate_hz must be set, as the file has no rate for b"):
        imported(tmp_path, [path], '[channels.P_N]\nsource = "b"\n', name="angle")


def test_a_mean_is_subtracted_within_the_range(tmp_path: Path) -> None:
    t = np.arange(1000) / 1000
    path = rows_csv(
        tmp_path / "x.csv", {"time": t, "d [um]": np.where(t < 0.5, 7000.0, 30.0 + 10.0 * np.sign(t - 0.7495))}
    )
    mapping = '[time]\nfrom_s = 0.5\n[channels.disk_x]\nsource = "d"\nbias = "mean"\n'
    _, recording = imported(tmp_path, [path], mapping)
    samples = recording.samples("probes")
    assert samples.times_s[0] == 0.0
    np.testing.assert_allclose(samples["disk_x"], 0.01 * np.sign(samples.times_s - 0.2495), rtol=0, atol=1e-9)


def test_the_noise_of_a_channel_is_reported(tmp_path: Path) -> None:
    """White noise of known size under a slow intermittent motion."""
    t = np.arange(20_000) / 10_000
    noise = 0.003 * np.random.default_rng(4).standard_normal(len(t))
    path = rows_csv(tmp_path / "x.csv", {"time": t, "d [mm]": np.where(t > 0.5, np.sin(400 * t), 0.0) + noise})
    _, recording = imported(tmp_path, [path], '[channels.disk_x]\nsource = "d"\n')
    assert recording.table.channels["disk_x"].noise_v == pytest.approx(0.003, rel=0.1)


def test_full_scale_counts_overrange(daq_mdf: Path, tmp_path: Path) -> None:
    mapping = MDF_MAPPING.replace('"2.25 mV/N"', '"2.25 mV/N"\nfull_scale = 9.99')
    conversion, _ = imported(tmp_path, [daq_mdf], mapping)
    assert {c.name: c.overrange for c in conversion.channels} == {"hammer": 3, "speed": 0}


def test_a_foreign_wav_shows_clipped_samples(tmp_path: Path) -> None:
    path = tmp_path / "x.wav"
    codes = np.array([0, 1000, -32_768, 32_767, 5, -7], dtype="<i2")
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(8000)
        file.writeframes(codes.tobytes())
    mapping = '[channels.outer_x]\nsource = "channel 1"\nunit = "m/s^2"\nfactor = 50.0\n'
    conversion, recording = imported(tmp_path, [path], mapping)
    np.testing.assert_allclose(recording.samples("accelerations")["outer_x"], codes / 32_768 * 50, rtol=1e-12)
    assert conversion.channels[0].overrange == 2


def test_tdms_groups_start_at_their_declared_times(tmp_path: Path) -> None:
    """Two groups of another writer, the second started 0.25 s later; integers with LabVIEW's linear scale."""
    from nptdms import ChannelObject, TdmsWriter

    began = np.datetime64("2026-11-21T10:00:00.000000")
    scaled = {
        "unit_string": "N", "wf_increment": 1e-3, "wf_start_time": began, "NI_Scaling_Status": "unscaled",
        "NI_Number_Of_Scales": np.uint32(1), "NI_Scale[0]_Scale_Type": "Linear", "NI_Scale[0]_Linear_Slope": 0.5,
        "NI_Scale[0]_Linear_Y_Intercept": 100.0, "NI_Scale[0]_Linear_Input_Source": np.uint32(0xFFFFFFFF),
    }  # fmt: skip
    late = {"unit_string": "g", "wf_increment": 5e-4, "wf_start_time": began + np.timedelta64(250_000, "us")}
    path = tmp_path / "x.tdms"
    with TdmsWriter(path) as writer:
        writer.write_segment([
            ChannelObject("Force", "North", np.arange(-500, 500, dtype=np.int16), scaled),
            ChannelObject("Acc", "X", np.linspace(-1, 1, 1000), late),
        ])  # fmt: skip
    conversion, recording = imported(
        tmp_path, [path], '[channels.P_N]\nsource = "North"\n[channels.inner_x]\nsource = "X"\ngroup = "Acc"\n'
    )
    np.testing.assert_array_equal(_counts(recording, "forces")[:, 0], np.arange(-500, 500))
    np.testing.assert_allclose(recording.samples("forces")["P_N"], 100 + 0.5 * np.arange(-500, 500))
    acceleration = recording.samples("accelerations")
    np.testing.assert_allclose(acceleration.times_s, 0.25 + np.arange(1000) / 2000, rtol=0, atol=1e-9)
    np.testing.assert_allclose(acceleration.values[:, 0], 9.80665 * np.linspace(-1, 1, 1000), atol=1e-8)
    assert conversion.start.isoformat() == "2026-11-21T10:00:00+00:00"
    assert recording.clock[0, 1] - recording.clock[0, 0] == pytest.approx(conversion.start.timestamp(), abs=1e-3)


# pyuff leaves the file that it writes to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("binary", [0, 1])
def test_uff_of_pyuff(binary: int, tmp_path: Path) -> None:
    import pyuff

    path, t = tmp_path / "x.uff", np.arange(300) / 4000
    values = 5.0 * np.sin(100 * t)
    file = pyuff.UFF(str(path))
    for name, unit_name in (("Mic", "Pa"), ("P 1", "kN")):
        file.write_sets(
            pyuff.prepare_58(
                binary=binary, id1=name, func_type=1, rsp_node=1, rsp_dir=1, ref_node=0, ref_dir=0, ord_data_type=4,
                num_pts=len(t), abscissa_spacing=1, abscissa_min=0.0, abscissa_inc=1 / 4000, z_axis_value=0.0,
                abscissa_spec_data_type=17, ordinate_spec_data_type=9, ordinate_axis_units_lab=unit_name,
                orddenom_spec_data_type=0, z_axis_spec_data_type=0, data=values, x=t,
            ),
            "add",
        )  # fmt: skip
    _, recording = imported(tmp_path, [path], '[channels.P_W]\nsource = "P 1"\n')
    samples = recording.samples("forces")
    assert samples.rate_hz == 4000
    np.testing.assert_allclose(samples["P_W"], 1e3 * values, rtol=0, atol=1e-5)


def test_parquet_with_instants_and_integers(tmp_path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    ns = 1_800_000_000_500_000_000 + np.arange(100) * 2_000_000
    table = pyarrow.table(
        {"timestamp": pyarrow.array(ns, pyarrow.timestamp("ns", tz="UTC")), "code": pyarrow.array(range(100), "int16")}
    )
    parquet.write_table(table, tmp_path / "x.parquet")
    mapping = '[channels.P_N]\nsource = "code"\nunit = "lbf"\nfactor = 0.25\n'
    conversion, recording = imported(tmp_path, [tmp_path / "x.parquet"], mapping)
    assert recording.samples("forces").rate_hz == 500
    np.testing.assert_array_equal(_counts(recording, "forces")[:, 0], np.arange(100))
    assert conversion.start.timestamp() == pytest.approx(1_800_000_000.5)


def test_an_interrupted_import_leaves_no_file(daq_mdf: Path, tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_text(MDF_MAPPING)
    conversion = convert([daq_mdf], mappings.load_mapping(path))

    def stop(part: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_recording(conversion, tmp_path / "out.mcap", progress=stop)
    assert list(tmp_path.iterdir()) == [path]


def rows_csv(path: Path, columns: dict[str, np.ndarray]) -> Path:
    table = np.column_stack(list(columns.values()))
    lines = [",".join(columns), *(",".join(repr(float(value)) for value in row) for row in table)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("angles", [(45.0, 135.0), (-30.0, 75.0), (200.0, 290.0)])
def test_probes_at_any_angles_become_x_and_y(angles: tuple[float, float], tmp_path: Path) -> None:
    t = np.arange(400) / 1000
    x, y = 0.3 * np.cos(90 * t), 0.2 * np.sin(90 * t + 0.4)
    a, b = (x * math.cos(math.radians(angle)) + y * math.sin(math.radians(angle)) for angle in angles)
    path = rows_csv(tmp_path / "x.csv", {"time": t, "A [mm]": a, "B [mm]": b})
    _, recording = imported(
        tmp_path, [path],
        f'[[rotate]]\nchannels = ["ring_x", "ring_y"]\nangles_deg = [{angles[0]}, {angles[1]}]\n'
        '[channels.ring_x]\nsource = "A"\n[channels.ring_y]\nsource = "B"\n',
    )  # fmt: skip
    samples = recording.samples("probes")
    np.testing.assert_allclose(samples["ring_x"], x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(samples["ring_y"], y, rtol=0, atol=1e-9)


def make_trigger(t: np.ndarray, at: tuple[float, ...]) -> np.ndarray:
    """Return ramps of 2 ms from 0 to 5 V, half way at the given times."""
    up = [np.clip((t - when) / 2e-3 + 0.5, 0, 1) for when in at]
    down = [np.clip((t - when - 0.05) / 2e-3 + 0.5, 0, 1) for when in at]
    return 5.0 * (np.sum(up, axis=0) - np.sum(down, axis=0))


def two_clocks(folder: Path, *, offset_s: float, ppm: float) -> list[Path]:
    t = np.arange(8000) / 4000
    other = np.arange(9000) / 5000  # its own clock; true time is offset + (1 + ppm) other
    true = offset_s + (1 + ppm * 1e-6) * other
    return [
        rows_csv(folder / "a.csv", {"time": t, "trig": make_trigger(t, (0.5, 1.6)), "F [N]": 100 * np.sin(40 * t)}),
        rows_csv(
            folder / "b.csv", {"time": other, "trig": make_trigger(true, (0.5, 1.6)), "d [um]": 100 * np.sin(40 * true)}
        ),
    ]  # fmt: skip


CLOCK_MAPPING = """
[resample]
method = "polyphase"
rate_hz = 4000
[[align]]
reference = { source = "trig", file = "a.csv" }
moved = { source = "trig", file = "b.csv" }
METHOD
[channels.hammer]
source = "F"
[channels.disk_x]
source = "d"
"""


@pytest.mark.parametrize(
    ("method", "ppm", "within"), [("edge", 150.0, 2e-4), ("edge", 0.0, 2e-4), ("correlation", 0.0, 2e-3)]
)
def test_two_clocks_are_aligned(method: str, ppm: float, within: float, tmp_path: Path) -> None:
    """The same motion, recorded by two systems: after alignment it is the same at the same time."""
    files = two_clocks(tmp_path, offset_s=0.123456, ppm=ppm)
    conversion, recording = imported(tmp_path, files, CLOCK_MAPPING.replace("METHOD", f'method = "{method}"'))
    force, way = recording.samples("hammer"), recording.samples("probes")
    true = np.sin(40 * way.times_s)
    inner = slice(200, -400)
    np.testing.assert_allclose(way["disk_x"][inner] * 10, true[inner], rtol=0, atol=within)
    np.testing.assert_allclose(force["hammer"] / 100, np.sin(40 * force.times_s), rtol=0, atol=1e-6)
    remark = next(remark for remark in conversion.remarks if "moved by" in remark)
    assert remark.startswith("b.csv: moved by +123.4")
    if ppm:
        assert f"{ppm:+.0f}" in remark


def test_files_are_placed_by_their_times_of_day(tmp_path: Path) -> None:
    for name, late_ms in (("a.csv", 0), ("b.csv", 250)):
        rows = [
            f"2026-11-21 10:00:0{(n + late_ms) // 1000}.{(n + late_ms) % 1000:03d},{n + late_ms}" for n in range(900)
        ]
        (tmp_path / name).write_text("Timestamp,F [N]\n" + "\n".join(rows) + "\n")
    mapping = "".join(f'[channels.{c}]\nsource = "F"\nfile = "{f}"\n' for c, f in (("P_N", "a.csv"), ("P_S", "b.csv")))
    _, recording = imported(tmp_path, [tmp_path / "a.csv", tmp_path / "b.csv"], mapping)
    samples = recording.samples("forces")
    np.testing.assert_allclose(samples["P_N"], 250.0 + np.arange(650), atol=1e-6)
    np.testing.assert_allclose(samples["P_S"], samples["P_N"], atol=1e-6)


def test_one_group_of_a_file_is_aligned_without_the_others(tmp_path: Path) -> None:
    """A TDMS file of two devices: the second one's clock is 0.0123 s late, and only its group is shifted."""
    from nptdms import ChannelObject, TdmsWriter

    late_s = 0.0123
    about = {"wf_increment": 1e-3, "wf_start_time": np.datetime64("2026-11-21T10:00:00.000000"), "unit_string": "N"}
    t = np.arange(1000) / 1000
    path = tmp_path / "x.tdms"
    with TdmsWriter(path) as writer:
        writer.write_segment([
            ChannelObject("A", "trigger", (t >= 0.5) * 5.0, about), ChannelObject("A", "north", np.sin(20 * t), about),
            ChannelObject("B", "trigger", (t + late_s >= 0.5) * 5.0, about),
            ChannelObject("B", "south", np.sin(20 * (t + late_s)), about),
        ])  # fmt: skip
    mapping = """
[resample]
method = "polyphase"
[[align]]
reference = { source = "trigger", group = "A" }
moved = { source = "trigger", group = "B" }
scope = "group"
[channels.P_N]
source = "north"
[channels.P_S]
source = "south"
"""
    conversion, recording = imported(tmp_path, [path], mapping)
    samples = recording.samples("forces")
    # Edges are found to a sample: 0.0123 s is 12.3 samples, and both triggers cross half height between two.
    np.testing.assert_allclose(samples["P_N"], np.sin(20 * (samples.times_s + 0.012)), rtol=0, atol=1e-6)
    np.testing.assert_allclose(samples["P_S"], samples["P_N"], rtol=0, atol=20 * 1.01e-3)
    assert "x.tdms, group B: moved by +12.0000 ms" in " ".join(conversion.remarks)
    with pytest.raises(InputError, match='scope "group"'):
        imported(tmp_path, [path], mapping.replace('scope = "group"\n', ""), name="file")


def test_a_clock_error_of_some_ppm_is_corrected(tmp_path: Path) -> None:
    """Stamps 12 ppm fast give a rate of 999.988 Hz: at 1000 Hz nothing may drift."""
    n = np.arange(40_000)
    t = n / 1000 * (1 + 12e-6)
    path = rows_csv(tmp_path / "x.csv", {"time": t, "P_N [N]": np.sin(300 * t)})
    mapping = '[resample]\nmethod = "polyphase"\nrate_hz = 1000\n[channels.P_N]\nsource = "P_N"\n'
    conversion, recording = imported(tmp_path, [path], mapping)
    samples = recording.samples("forces")
    inside = slice(60, -60)  # where the filter has samples on both sides
    expected = np.sin(300 * samples.times_s)
    np.testing.assert_allclose(samples["P_N"][inside], expected[inside], rtol=0, atol=1e-5)
    assert "999.988 Hz to 1000 Hz" in conversion.channels[0].time


def test_the_example_has_every_option_and_imports(tmp_path: Path) -> None:
    """Logs of a typical rig, generated here in volts; the import recovers the motion from which they were computed."""
    text = example()
    for model in (each for each in vars(mappings).values() if hasattr(each, "model_fields")):
        for name in model.model_fields:
            assert re.search(rf"^(# )?\[*{name}\b|\b{name} = ", text, re.MULTILINE), f"{model.__name__}.{name}"
    rate = 20_000
    t = np.arange(20_000) / rate
    x, y = 0.02 * np.sin(250 * t), 0.03 * np.cos(90 * t)  # mm
    per_mm = 0.2 / 0.0254
    near = [per_mm * (math.cos(angle) * x + math.sin(angle) * y) for angle in np.radians([45, 135])]
    delayed = 30.0 * np.sin(400 * (t - 12.5e-6))
    impact = np.where(np.abs(t - 0.5) < 2.5e-3, 100.0 * np.cos(np.pi * (t - 0.5) / 5e-3), 0.0)
    trigger = np.where((t > 0.1) & (t < 0.3) | (t > 0.7), 5.0, 0.0)
    late = 1000  # samples by which the second recorder began later
    rows_csv(tmp_path / "daq.csv", {
        "time": t, "Prox 1": near[0] - 10.0, "Prox 2": near[1] - 9.0, "Acc 1": delayed / 9.80665 * 100.0,
        "Charge 1": -2e-3 * 50.0 * np.sin(100 * t), "Pt100": 1.0 + t, "Trigger": trigger,
        "Key": 5.0 * (np.modf(6.2 * t + 0.3)[0] < 0.2),
    })  # fmt: skip
    rows_csv(tmp_path / "hammer.csv", {
        "time": t[:-late], "Hammer": 2.25e-3 * impact[late:], "Trigger": trigger[late:],
    })  # fmt: skip
    conversion, recording = imported(tmp_path, [tmp_path / "daq.csv", tmp_path / "hammer.csv"], text)
    zero_s = conversion.document["zero_s"]
    probes = recording.samples("probes")
    at = np.rint((probes.times_s + zero_s) * rate).astype(int)
    inside = slice(100, -100)
    for name, motion in (("ring_x", x), ("ring_y", y)):
        found, expected = probes[name], motion[at]
        # The mean of an imported signal is assumed to be zero.
        assert np.ptp((found - expected)[inside]) < 1e-6
    accelerations = recording.samples("accelerations")
    # Samples that need no shift stay unchanged, at times in whole microseconds.
    acceleration = 30.0 * np.sin(400 * (accelerations.times_s + zero_s))  # m/s^2
    np.testing.assert_allclose(accelerations["inner_x"], acceleration, rtol=0, atol=30 * 400 * 0.6e-6)
    force = recording.samples("forces")
    np.testing.assert_allclose(
        force["P_E"][inside], 50.0 * np.sin(100 * (force.times_s + zero_s))[inside], rtol=0, atol=1e-4
    )
    (timed,) = Experiment.from_recording(recording).scene.commands
    assert timed.at_s == pytest.approx(0.2, abs=1e-4)
    assert timed.at_s + zero_s == pytest.approx(0.5 - 2.5e-3, abs=1e-4)  # time zero is inside the log
    assert Experiment.from_recording(recording).scene.drive.speed_hz == pytest.approx(6.2, rel=1e-3)
    assert recording.samples("bearing").names == ("oil_temperature",)


def test_missing_values_are_gaps_or_filled_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    lines = ["time,P_N [N]", *(f"{n / 1000},{'NaN' if n in (3, 4, 9) else n}" for n in range(20))]
    path.write_text("\n".join(lines) + "\n")
    mapping = '[channels.P_N]\nsource = "P_N"\n'
    conversion, recording = imported(tmp_path, [path], mapping)
    samples = recording.samples("forces")
    assert samples.index.tolist() == [n for n in range(20) if n not in (3, 4, 9)]
    np.testing.assert_allclose(samples.values[:, 0], samples.index)
    assert recording.streams["rig/sensors/forces"].lost == 3
    assert conversion.channels[0].missing == 3
    conversion, recording = imported(tmp_path, [path], mapping + 'missing = "hold"\n', name="held")
    assert recording.samples("forces").values[[3, 4, 9], 0].tolist() == [2, 2, 8]
    assert "3 missing values held" in conversion.channels[0].time
    with pytest.raises(InputError, match=r"^channels\.P_N must be free of missing values.*row 4 at 0.003 s"):
        imported(tmp_path, [path], mapping + 'missing = "refuse"\n', name="refused")


def test_samples_lost_in_a_network_are_gaps(tmp_path: Path) -> None:
    n = np.array([k for k in range(500) if k not in (50, 51, 300)])
    path = rows_csv(tmp_path / "x.csv", {"time": 7.0 + n / 1000, "P_N [N]": n * 1.0})
    _, recording = imported(tmp_path, [path], '[channels.P_N]\nsource = "P_N"\n')
    samples = recording.samples("forces")
    assert samples.index.tolist() == n.tolist()
    np.testing.assert_allclose(samples.times_s, n / 1000, rtol=0, atol=1e-9)
    assert recording.streams["rig/sensors/forces"].lost == 3


def test_uneven_time_stamps_are_reported_and_not_assumed_even(tmp_path: Path) -> None:
    generator = np.random.default_rng(3)
    t = np.arange(1000) / 1000 + generator.uniform(-2e-4, 2e-4, 1000)
    path = rows_csv(tmp_path / "x.csv", {"time": t, "P_N [N]": np.sin(20 * t)})
    mapping = '[channels.P_N]\nsource = "P_N"\n'
    with pytest.raises(InputError, match=r'^resample.method must be "linear" .* from an even rate of 1000'):
        imported(tmp_path, [path], mapping)
    conversion, recording = imported(tmp_path, [path], f'[resample]\nmethod = "linear"\nrate_hz = 1000\n{mapping}')
    samples = recording.samples("forces")
    expected = np.sin(20 * (samples.times_s + t[0]))
    np.testing.assert_allclose(samples.values[:, 0], expected, rtol=0, atol=20**2 * 1.4e-3**2 / 8)  # h^2 f''/8
    assert 150 < conversion.channels[0].jitter_us < 250
    _, recording = imported(tmp_path, [path], f'[time]\nstamps = "line"\n{mapping}', name="line")
    assert len(recording.samples("forces").times_s) == 1000


def hammer_log(path: Path, *, at_s: float, force_n: float, duration_s: float) -> Path:
    t = np.arange(20_000) / 10_000
    part = (t - at_s) / duration_s
    pulse = np.where((part > 0) & (part < 1), force_n * np.sin(np.pi * np.clip(part, 0, 1)), 0.0)
    noise = 0.2 * np.random.default_rng(1).standard_normal(len(t))
    columns = {
        "time": t,
        "hammer [N]": pulse + noise,
        "disk_x [mm]": 0.01 * np.sin(30 * t),
        "speed [rpm]": 312.0 + 0 * t,
    }
    return rows_csv(path, columns)


HAMMER_MAPPING = """
[hammer]
threshold_n = 8.0
pre_s = 0.25
[experiment]
scene = "hammer"
set = { "contact.friction" = 0.25 }
speed_hz = "measured"
commands = "detected"
[channels.hammer]
source = "hammer"
[channels.disk_x]
source = "disk_x"
[channels.speed]
source = "speed"
"""


def test_a_hammer_pulse_is_found_and_becomes_a_scene(tmp_path: Path) -> None:
    path = hammer_log(tmp_path / "x.csv", at_s=0.73211, force_n=87.0, duration_s=6.5e-3)
    conversion, recording = imported(tmp_path, [path], HAMMER_MAPPING)
    assert len(conversion.pulses) == 1
    experiment = Experiment.from_recording(recording)
    # The rig ran before: the simulation starts at the first sample, with any angle of the shaft.
    assert experiment.begin is not None
    assert (experiment.first_s, experiment.begin.tick) == (0.0, 0)
    (timed,) = experiment.scene.commands
    impact = timed.request.model_dump()
    assert timed.at_s == pytest.approx(0.25, abs=2e-4)
    assert impact["force_n"] == pytest.approx(87.0, rel=0.01)
    assert impact["duration_ms"] == pytest.approx(6.5, rel=0.02)
    assert experiment.scene.drive.speed_hz == pytest.approx(5.2)
    assert experiment.scene.set["contact.friction"] == 0.25
    assert experiment.scene.sensors.groups == ("probes", "drive", "hammer")
    assert experiment.scene.sensors.rate_hz == 10_000
    assert [event["event"] for event in recording.events] == ["import", "hammer", "end"]
    assert experiment.scene.duration_s == pytest.approx(2.0 - (0.73211 - 0.25), abs=2e-4)
    assert recording.metadata["rig"]["scene"] == "hammer"


def test_an_incomplete_hammer_pulse_is_reported(tmp_path: Path) -> None:
    path = hammer_log(tmp_path / "x.csv", at_s=0.73211, force_n=87.0, duration_s=6.5e-3)
    lines = path.read_text(encoding="utf-8").splitlines()
    ends = rows_of(tmp_path / "ends.csv", lines[:7350])
    gap = rows_of(tmp_path / "gap.csv", [re.sub(",[^,]*", ",", line, count=1) if 7350 < n < 7380 else line
                                         for n, line in enumerate(lines)])  # fmt: skip
    for log, incomplete in ((path, 0), (ends, 1), (gap, 1)):
        conversion, _ = imported(tmp_path, [log], HAMMER_MAPPING, name=log.stem)
        assert sum("is incomplete" in remark for remark in conversion.remarks) == incomplete
    with pytest.raises(
        InputError, match=r"^time must be a range with a hammer pulse \(at 0.7321 s\); received 1 to inf s"
    ):
        imported(tmp_path, [path], f"[time]\nfrom_s = 1.0\n{HAMMER_MAPPING}", name="after")


def test_doubtful_lines_of_a_mapping_are_remarked(tmp_path: Path) -> None:
    path = hammer_log(tmp_path / "x.csv", at_s=0.73211, force_n=87.0, duration_s=6.5e-3)
    mapping = HAMMER_MAPPING.replace("pre_s = 0.25", "pre_s = 7").replace('"disk_x"', '"speed"\nunit = "mm"')
    conversion, _ = imported(tmp_path, [path], mapping)
    assert "the log has 0.7321 s before the first hammer pulse, less than hammer.pre_s = 7 s" in conversion.remarks
    assert "disk_x and speed have the same source, speed" in conversion.remarks


def rows_of(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_a_delay_moves_a_channel_back(tmp_path: Path) -> None:
    t = np.arange(2000) / 10_000
    late_s = 370e-6
    path = rows_csv(tmp_path / "x.csv", {"time": t, "a [N]": np.sin(200 * t), "b [N]": np.sin(200 * (t - late_s))})
    mapping = '[channels.P_N]\nsource = "a"\n[channels.P_S]\nsource = "b"\ndelay_us = 370\n'
    conversion, recording = imported(tmp_path, [path], mapping, name="apart")
    north, south = recording.samples("P_N"), recording.samples("P_S")
    assert [len(north), len(south)] == [2000, 2000]
    np.testing.assert_allclose(south["P_S"], np.sin(200 * (t - late_s)), rtol=0, atol=2e-9)  # the original samples
    np.testing.assert_allclose(north.times_s - south.times_s, late_s, rtol=0, atol=1e-9)  # at separate instants
    assert any("P_S" in remark and "forces_2" in remark for remark in conversion.remarks)
    _, recording = imported(tmp_path, [path], f'[resample]\nmethod = "polyphase"\n{mapping}')
    samples = recording.samples("forces")
    np.testing.assert_allclose(samples["P_S"][100:-100], samples["P_N"][100:-100], rtol=0, atol=2e-5)


@pytest.mark.parametrize("suffix", [".mf4", ".tdms", ".uff", ".csv", ".parquet", ".wav"])
def test_export_and_import_reproduce_the_values(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """rig simulate, export, import --template, import: the same values within half a count, by the commands alone."""
    source, other, back = tmp_path / "a.mcap", tmp_path / f"b{suffix}", tmp_path / "c.mcap"
    mapping = tmp_path / "m.toml"
    changes = ("contact.friction=0.22", "drive.profile=[[0.0, 5.0], [1.0, 6.0]]", "engine.name=rk4")
    otherwise = ["--parameters", "as-printed", *(word for change in changes for word in ("--set", change))]
    for arguments in (
        ["simulate", "hammer", "-o", str(source), "--duration-s", "0.1", *otherwise],
        ["export", str(source), "-o", str(other)],
        ["import", str(other), "--template", str(mapping)],
        ["import", str(other), "-m", str(mapping), "-o", str(back)],
        ["info", str(back)],
    ):
        with pytest.raises(SystemExit) as end:
            main(arguments)
        assert end.value.code == 0, capsys.readouterr().err
    a, b = Recording.open(source), Recording.open(back)
    assert list(b.table.groups) == list(a.table.groups)
    if suffix != ".uff":  # that format cannot hold the scene
        assert Experiment.from_recording(b).scene == Experiment.from_recording(a).scene
        assert b.table.channels["inner_x"].bandwidth_hz == a.table.channels["inner_x"].bandwidth_hz
    for name in a.table.groups:
        ours, theirs = a.samples(name), b.samples(name)
        assert (theirs.names, theirs.units, theirs.rate_hz) == (ours.names, ours.units, ours.rate_hz)
        np.testing.assert_allclose(theirs.times_s, ours.times_s, rtol=0, atol=1e-9)
        scales = [a.table.channels[channel].scale for channel in ours.names]
        assert np.all(np.abs(theirs.values - ours.values) <= 0.5 * np.abs(scales) * (1 + 1e-6))
        if suffix in (".mf4", ".tdms"):
            for block_a, block_b in zip(_counts(a, name), _counts(b, name), strict=True):
                np.testing.assert_array_equal(block_a, block_b)


def _counts(recording: Recording, group: str) -> np.ndarray:
    return np.concatenate([block.values for block in recording.blocks(f"rig/sensors/{group}")])


def test_a_template_of_an_unknown_file_imports_unchanged(daq_mdf: Path, tmp_path: Path) -> None:
    text = template([daq_mdf])
    assert text.count("PLEASE CHECK") == 2
    assert re.search(r"# bandwidth_hz = HZ +# PLEASE CHECK", text), "filters are what it cannot know"
    assert re.search(r"pulses_per_turn = 1 +# PLEASE CHECK: 40 pulses a second do not fit the speed", text)
    assert "# daq.mf4: MDF 4.10, 3 signals" in text
    _, recording = imported(tmp_path, [daq_mdf], text)
    assert {name: group.names for name, group in recording.table.groups.items()} == {
        "drive": ("speed",), "drive_2": ("keyphasor",), "fast": ("AI0",),
    }  # fmt: skip
    assert len(recording.edges()) == 6
    from recorder.viewer.canvas import Canvas, new_stream
    from recorder.viewer.file import paint

    assert paint(recording, Canvas(new_stream("test"))).points > 0


@pytest.mark.parametrize(
    ("unit_from", "unit_to", "expected"),
    [
        ("mil", "mm", 0.0254), ("µm", "mm", 1e-3), ("in", "mm", 25.4), ("lbf", "N", 4.4482216152605), ("kN", "N", 1e3),
        ("g", "m/s^2", 9.80665), ("m/s²", "m/s^2", 1), ("rpm", "Hz", 1 / 60), ("1/min", "Hz", 1 / 60),
        ("rad/s", "Hz", 1 / (2 * math.pi)),
    ],
)  # fmt: skip
def test_units(unit_from: str, unit_to: str, expected: float) -> None:
    assert units.factor(unit_from, unit_to, field="x") == pytest.approx(expected, rel=1e-14)


def test_hysteresis_keeps_noise_from_making_edges() -> None:
    t = np.arange(10_000) / 10_000
    signal = np.sin(2 * np.pi * 5 * t - 1.0) + 0.02 * np.sin(2 * np.pi * 3001 * t)
    axis = clock.TimeAxis(0.0, 10_000.0, len(t))
    found, _ = clock.find_crossings(signal, axis, threshold=0.0, hysteresis=0.2)
    np.testing.assert_allclose(found, (np.arange(5) + 0.5 / np.pi) / 5, atol=2e-3)
    assert len(clock.find_crossings(signal, axis, threshold=0.0, hysteresis=0.0)[0]) > len(found)


CSV = "time,x [mm],y [V]\n0,1,2\n0.001,2,3\n0.002,3,4\n0.003,4,5\n"
X = '[channels.disk_x]\nsource = "x"\n'


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ("[channels.disk_x]\nsource =", "m.toml must be a TOML file"),
        ("", "m.toml: channels must be given"),
        (
            "[channels.disk_x]\nsource = 'z'\n",
            "m.toml: channels.disk_x.source must be a signal of the file, such as x, y",
        ),
        ("[channels.disk_z]\nsource = 'x'\n", "m.toml: channels.disk_z must be a channel of the rig (such as disk_y"),
        (X + "unit = 'N'\n", "m.toml: channels.disk_x.unit must be a unit of length"),
        (X + "unit = 'furlong'\n", "m.toml: channels.disk_x.unit must be one of m, cm, mm"),
        (X + "sign = 2\n", "m.toml: channels.disk_x.sign must be"),
        (X + "colour = 'red'\n", "m.toml: channels.disk_x.colour must be a known field, such as "),
        ("[channels.disk_x]\nsource = 'y'\n", "m.toml: channels.disk_x.unit must be a unit of length"),
        (
            "[channels.disk_x]\nsource = 'y'\nsensitivity = '7.87'\n",
            "m.toml: channels.disk_x.sensitivity must be volts per unit",
        ),
        (
            "[channels.disk_x]\nsource = 'y'\nsensitivity = '1 V/N'\n",
            "m.toml: channels.disk_x.sensitivity must be volts per unit of length",
        ),
        (
            X + "sensitivity = '2 bananas'\n",
            "m.toml: channels.disk_x.sensitivity must be volts per unit, such as",
        ),
        (X + "group = 'fast'\n", "m.toml: channels.disk_x.group must be omitted: the file has no groups"),
        (X + "sensitivity = '7 V/mm'\n", "m.toml: channels.disk_x.unit must be V or mV with a sensitivity"),
        (X + "factor = 0.0\n", "m.toml: channels.disk_x.factor must be another number than 0"),
        (X + "file = 'q.csv'\n", "m.toml: channels.disk_x.file must be one of x.csv"),
        ("[time]\nfrom_s = 9.0\n" + X, "range must be one in which all channels of probes have samples"),
        ("[time]\nfrom_s = 2.0\nto_s = 1.0\n" + X, "m.toml: time.to_s must be after time.from_s"),
        (
            "[resample]\nrate_hz = 500\n" + X,
            'm.toml: resample.method must be "polyphase" or "linear" with resample.rate_hz',
        ),
        ("[time]\nrate_hz = 1000.5\n" + X.replace("disk_x", "disk_y"), None),
        ("[time]\nrate_hz = 2000\n" + X, "m.toml: time.rate_hz must be within 1% of the 1000 Hz of x in x.csv"),
        ("[file]\ntime_column = 'clock'\n" + X, "m.toml: file.time_column must be a column of x.csv"),
        ("[file]\ntime_column = 'none'\n" + X, "m.toml: time.rate_hz must be set, as the file has no rate"),
        ("[file]\nencoding = 'klingon'\n" + X, "m.toml: file.encoding must be a text encoding"),
        ("[hammer]\n" + X, "m.toml: hammer must be left out without a channel `hammer`"),
        ("[keyphasor]\nsource = 'y'\nangle_deg = 400\n" + X, "m.toml: keyphasor.angle_deg must be less than or equal"),
        ("[keyphasor]\nsource = 'y'\nthreshold = 99.0\n" + X, "m.toml: keyphasor.threshold must be between 2 and 5"),
        (
            "[[rotate]]\nchannels = ['disk_x', 'disk_y']\nangles_deg = [0, 90]\n" + X,
            "m.toml: rotate.channels must be mapped",
        ),
        (X + "ripple_db = 2\n", "m.toml: channels.disk_x.ripple_db must be left out with the filter butterworth"),
        (
            "[defaults]\nfilter = 'none'\n" + X + "filter_order = 2\n",
            "m.toml: channels.disk_x.filter_order must be left out with the filter none",
        ),
        (X + "unit = 'mm'\nfilter_order = 9\n", "m.toml: channels.disk_x.filter_order must be from 1 to 8"),
        (X + "bias = 'men'\n", "m.toml: channels.disk_x.bias must be a valid number or 'mean'"),
        (
            "[experiment]\nscene = 'drop'\ncommands = 'detect'\n" + X,
            "m.toml: experiment.commands must be a list or 'scene' or 'detected'; received 'detect'",
        ),
        ("[experiment]\nscene = 'dance'\n" + X, "scene must be one of"),
        ("[experiment]\nscene = 'drop'\nset = { 'contact.frictoin' = 1 }\n" + X, "contact.frictoin must be"),
    ],
)
def test_wrong_mappings_are_refused_in_one_line(
    mapping: str,
    message: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("x.csv").write_text(CSV)
    Path("m.toml").write_text(mapping)
    with pytest.raises(SystemExit) as end:
        main(["import", "x.csv", "-m", "m.toml", "-o", "o.mcap"])
    printed = capsys.readouterr()
    if message is None:  # over so few samples the rate is whole
        assert end.value.code == 0
        return
    assert end.value.code == 2
    assert printed.err.startswith(f"rig: {message}")
    assert printed.err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.toml", "x.csv"]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("x.mf4", b"MDF     4.10 and nothing more", "file must be an intact MDF file"),
        ("x.tdms", b"TDSm\x0e\x00\x00", "file must be"),
        ("x.uff", b"    -1\n    58\nrubbish\n", "file must be"),
        ("x.wav", b"RIFF1234WAVE", "file must be an intact WAV file"),
        ("x.parquet", b"PAR1....PAR1", "file must be an intact Parquet file"),
        ("x.csv", b"\0\1\2\3" * 50, "file must be a text file"),
        ("x.csv", b"just words\nand more\n", "file must be a text file with lines of numbers"),
        ("x.csv", b"a,b\n1,2\n2,3\n3,4\n4,5\n5,6,7\n", "file must be a text file of 2 columns throughout"),
        ("x.csv", b"", "file must be a file that is not empty"),
        ("x.xlsx", b"PK", "file must be a file that ends in .mf4"),
        ("x.csv", b"time,x [mm]\n0,1\n1,2\n1,3\n0,4\n", "time stamps must be ascending"),
    ],
)
def test_damaged_files_are_refused_in_one_line(
    name: str, content: bytes, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(content)
    Path("m.toml").write_text(X)
    with pytest.raises(SystemExit) as end:
        main(["import", name, "-m", "m.toml", "-o", "o.mcap"])
    printed = capsys.readouterr()
    assert end.value.code == 2
    assert printed.err.startswith(f"rig: {message}"), printed.err
    assert printed.err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["m.toml", name])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
@pytest.mark.parametrize("name", ["log.csv", "log.wav"])
def test_a_pipe_is_no_log_and_is_not_waited_for(name: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match=r"^file must be a file that can be read; received .*not a regular"):
        open_source(tmp_path / name, FileOptions())


# pyuff leaves the file that it writes to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("suffix", [".tdms", ".uff"])
@pytest.mark.parametrize("kept", [0.02, 0.6, 0.97])
def test_a_truncated_file_is_refused_in_one_line(
    suffix: str, kept: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    whole, cut = tmp_path / f"whole{suffix}", tmp_path / f"cut{suffix}"
    t = np.arange(20_000) / RATE_HZ
    if suffix == ".tdms":
        import nptdms

        about = {"wf_increment": 1.0 / RATE_HZ, "unit_string": "mm"}
        with nptdms.TdmsWriter(whole) as writer:
            writer.write_segment([nptdms.ChannelObject("g", name, np.sin(t), about) for name in ("x", "y")])
    else:
        import pyuff

        file = pyuff.UFF(str(whole))
        for name in ("x", "y"):
            file.write_sets(pyuff.prepare_58(
                binary=1, func_type=1, rsp_node=1, rsp_dir=1, ref_node=1, ref_dir=1, data=np.sin(t), x=t, id1=name,
                abscissa_spacing=1, abscissa_min=0.0, abscissa_inc=1.0 / RATE_HZ, abscissa_spec_data_type=17,
                ordinate_spec_data_type=8, orddenom_spec_data_type=0, num_pts=len(t), ord_data_type=4, z_axis_value=0.0,
                z_axis_spec_data_type=0, ordinate_axis_units_lab="mm",
            ), "add")  # fmt: skip
    assert {entry.name for entry in open_source(whole, FileOptions()).entries} == {"x", "y"}
    content = whole.read_bytes()
    cut.write_bytes(content[: int(kept * len(content))])
    (tmp_path / "m.toml").write_text("[channels.disk_y]\nsource = 'y'\nunit = 'mm'\n")
    with pytest.raises(SystemExit) as end:
        main(["import", str(cut), "-m", str(tmp_path / "m.toml"), "-o", str(tmp_path / "o.mcap")])
    printed = capfd.readouterr()
    assert end.value.code == 2
    assert printed.err.startswith("rig: file must be an intact ")
    assert "it is truncated" in printed.err or kept < 0.1
    assert printed.err.count("\n") == 1
    assert "m.toml" not in printed.err.split("received")[0]


def test_an_unknown_group_is_reported(daq_mdf: Path, tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text("[channels.disk_y]\nsource = 'Speed'\ngroup = 'sluggish'\n")
    with pytest.raises(InputError, match=r"disk_y\.group must be one of Fast, Slow; received 'sluggish'"):
        convert([daq_mdf], mappings.load_mapping(tmp_path / "m.toml"))


def test_the_import_is_reported_in_one_line_per_channel(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "log.csv"
    t = np.arange(500) / 1000.0
    rows_csv(path, {"time": t, "a": np.sin(t), "b": np.cos(t), "c": np.sin(t)})
    units_of = {"disk_x": ("a", "mm"), "ring_y": ("b", "um"), "inner_x": ("c", "m/s^2")}
    mapping = "".join(f"[channels.{n}]\nsource = '{s}'\nunit = '{u}'\n" for n, (s, u) in units_of.items())
    (tmp_path / "m.toml").write_text(mapping + "bias = -2.0\n")
    lines = run_for_output(capsys, "import", path, "-m", tmp_path / "m.toml", "-o", tmp_path / "o.mcap").splitlines()
    (x,), (y,), (a,) = ([line.split() for line in lines if line.startswith(f"{name} ")] for name in units_of)
    assert x[:3] == ["disk_x", "a", "source"]
    assert x[-1] == "mm"
    assert y[2:8] == ["0.001", "mm", "per", "um", "*", "source"]
    assert " ".join(a[2:6]) == "(source + 2) 2"
    text = "\n".join(lines)
    assert text.count("samples as they were") == 1
    assert not re.search(r"e-\d\d", text), "no dust"
    assert "jitter" not in text


def test_unknown_properties_of_an_imported_channel_are_omitted(
    daq_mdf: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    imported(tmp_path, [daq_mdf], template([daq_mdf]))
    with pytest.raises(SystemExit):
        main(["info", str(tmp_path / "out.mcap")])
    printed = capsys.readouterr().out
    assert printed.count("not known") == 3, printed
    assert "seed" not in printed
    assert "parameters" not in printed


def test_a_template_lists_the_other_signals(daq_mdf: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "t.toml"
    with pytest.raises(SystemExit):
        main(["import", str(daq_mdf), "--template", str(target)])
    assert "2 lines to check" in capsys.readouterr().out
    text = target.read_text()
    plain, _, rest = text.partition("# Uncomment the tables that you need:\n")
    taken_up = "\n".join(line.removeprefix("#").removeprefix(" ") for line in rest.splitlines())
    tables = tomllib.loads(plain.replace("[channels.AI0]", "[channels.hammer]") + taken_up)
    mapping = mappings.Mapping(**tables)
    assert mapping.align
    assert mapping.keyphasor
    assert mapping.hammer
    assert mapping.experiment


def test_a_json_comment_is_recognised_by_its_label(tmp_path: Path) -> None:
    from replays.recordings.formats.guessing.template import shorten_label
    from replays.recordings.formats.source import Entry

    assert shorten_label(Entry("x", "", "mm", 1, None, label="{\n  of two lines")) == "{ of two lines"
    assert shorten_label(Entry("x", "", "mm", 1, None, label="long " * 20)).endswith("...")


@pytest.mark.parametrize(
    ("name", "module"), [("x.mf4", "asammdf"), ("x.tdms", "nptdms"), ("x.uff", "pyuff"), ("x.wav", "soundfile")]
)
def test_a_missing_library_is_named(name: str, module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    (tmp_path / name).write_bytes(b"something")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r"pip install 'rotor-stator-rig\[formats\]'"):
        template([tmp_path / name])


def test_the_document_in_the_recording_is_json(daq_text: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    conversion, _ = imported(tmp_path, [daq_text[0]], TEXT_MAPPING)
    assert len(json.loads(json.dumps(conversion.document))["files"][0]["sha256"]) == 64


@pytest.mark.parametrize("version", ["3.30", "4.10", "4.20"])
def test_all_versions_of_mdf_are_read(version: str, tmp_path: Path) -> None:
    from asammdf import MDF, Signal

    t = np.arange(100) / 1000.0
    kinds = ["u1", "i2", "f4", "f8", "u8", "?"]
    with MDF(version=version) as mdf:
        mdf.append([Signal((t > 0.05).astype(kind), t, name=kind, unit="mm") for kind in kinds], common_timebase=True)
        path = Path(mdf.save(tmp_path / "a.mf4"))
    source = open_source(path, FileOptions())
    found = {entry.name: source.read(entry).physical for entry in source.entries}
    assert list(found) == kinds
    for values in found.values():
        np.testing.assert_array_equal(values, t > 0.05)


def test_a_record_without_a_keyphasor_pulse_has_no_edges() -> None:
    """A log that begins after a pulse and ends before the next one has noise only; so has a flank cut by its start."""
    rng = np.random.default_rng(1)
    turn = np.zeros(20_000)
    turn[8_000:8_500] = 1.0
    flanks = np.convolve(turn, np.full(200, 0.005), "same")
    even = clock.TimeAxis(0.0, 1000.0, len(turn))

    def edges(values: np.ndarray) -> list[int]:
        return np.rint(1000.0 * clock.find_crossings(values, even, threshold=None, hysteresis=None)[0]).tolist()

    for noise in (1e-4, 0.01):
        shown = flanks + noise * rng.standard_normal(len(turn))
        assert edges(shown[9_000:]) == edges(shown[:400]) == []
        assert len(edges(shown)) == len(edges(shown[7_995:])) == len(edges(shown[7_950:])) == 1
        assert all(not edges(shown[at:]) for at in range(8_400, 8_530))
    bipolar = np.gradient(flanks) + 1e-4 * rng.standard_normal(len(turn))
    sine = np.sin(0.01 * np.arange(len(turn))) + 0.01 * rng.standard_normal(len(turn))
    assert len(edges(bipolar)) > 0
    assert len(edges(sine)) in (31, 32)


def test_a_subtracted_offset_is_a_remark(tmp_path: Path) -> None:
    path = rows_csv(tmp_path / "x.csv", {"time": np.arange(500) / 1000, "P_N [N]": 7.0 + np.arange(500) % 2})
    for bias, how in (('"mean"', "its mean"), ("7.5", "by the mapping")):
        mapping = f'[channels.P_N]\nsource = "P_N"\nbias = {bias}\n'
        conversion, _ = imported(tmp_path, [path], mapping, name=how.split()[-1])
        assert f"P_N: an offset of 7.5 N was subtracted ({how}, bias)" in conversion.remarks
    conversion, _ = imported(tmp_path, [path], '[channels.P_N]\nsource = "P_N"\n')
    assert not any("offset" in remark for remark in conversion.remarks)


_IMPORT = """
import sys
from pathlib import Path
from replays.recordings.formats.conversion import convert, write_recording
from replays.recordings.formats.mapping import load_mapping
log = Path(sys.argv[1])
write_recording(convert([log], load_mapping(log.with_suffix(".toml"))), log.with_suffix(".mcap"))
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the peak is read from /proc")
@pytest.mark.parametrize("suffix", [".wav", ".tdms"])
def test_memory_does_not_depend_on_the_length_of_a_log(tmp_path: Path, suffix: str) -> None:
    rate_hz, names = 51_200, [f"channel {number + 1}" for number in range(8)]
    channels = "".join(
        f'[channels.c{number}]\nsource = "{name}"\nunit = "V"\nto = "c"\nto_unit = "V"\n{"bias = 1.0" * (number % 2)}\n'
        for number, name in enumerate(names)
    )
    peaks_kb = []
    for seconds in (5, 20):
        log = tmp_path / f"{seconds}{suffix}"
        log.with_suffix(".toml").write_text(f'{channels}[keyphasor]\nsource = "channel 1"\n')
        second = np.random.default_rng(0).integers(-9000, 9000, (rate_hz, len(names)), dtype=np.int16)
        second[:, 0] = np.where(np.arange(rate_hz) % 2560 < 256, 9000, -9000)
        if suffix == ".wav":
            soundfile = pytest.importorskip("soundfile")
            soundfile.write(log, np.tile(second, (seconds, 1)), rate_hz, subtype="PCM_16")
        else:
            nptdms = pytest.importorskip("nptdms")
            rate = {"wf_increment": 1.0 / rate_hz}
            with nptdms.TdmsWriter(log) as file:
                for _ in range(seconds):
                    columns = zip(names, second.T, strict=True)
                    file.write_segment([nptdms.ChannelObject("g", name, each, rate) for name, each in columns])
        peaks_kb.append(int(subprocess.check_output([sys.executable, "-c", _IMPORT, str(log)], text=True)))
    assert peaks_kb[1] < 1.1 * peaks_kb[0], peaks_kb
