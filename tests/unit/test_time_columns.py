"""Columns of times in every unit and form, and fields and units that are refused rather than assumed."""

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from replays.recordings.formats.mapping import FileOptions, parse_mapping
from replays.recordings.formats.source import Source, open_source
from rig.base import units
from rig.base.errors import InputError
from tests.commands import run_captured

STEP_S = 1e-3
EPOCH_S = 1764075600


def log(folder: Path, heading: str, times: list[str], column: str = "P_E [N]") -> Path:
    path = folder / "log.csv"
    rows = [f"{heading},{column}", *(f"{time},{n % 7}.5" for n, time in enumerate(times))]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def stamps(source: Source) -> np.ndarray:
    times_s = source.read(source.entries[0]).times_s
    assert times_s is not None
    return times_s


@pytest.mark.parametrize(
    ("heading", "each_s"),
    [
        ("time [s]", 1.0), ("time", 1.0), ("Time (minutes)", 60.0), ("Time [MIN]", 60.0), ("time [msec]", 1e-3),
        ("t [µs]", 1e-6), ("t [ns]", 1e-9), ("Time [d]", 86400.0), ("time [hours]", 3600.0), ("time_ms", 1e-3),
        ("Time us", 1e-6),        ("time [MS]", 1e-3), ("timestamp [unix ms]", 1e-3), ("time [ms since epoch]", 1e-3),
        ("seconds", 1.0),
    ],
)  # fmt: skip
def test_a_column_of_times_has_the_unit_of_its_heading(tmp_path: Path, heading: str, each_s: float) -> None:
    source = open_source(log(tmp_path, heading, [f"{n * STEP_S / each_s:.12g}" for n in range(20)]), FileOptions())
    assert [entry.name for entry in source.entries] == ["P_E"]
    np.testing.assert_allclose(stamps(source), STEP_S * np.arange(20), rtol=1e-9, atol=1e-12)
    if each_s != 1.0:  # a generated mapping declares it
        assert units.size_si(str(source.options["time_unit"])) == each_s


@pytest.mark.parametrize(("unit", "per_s"), [("s", 1), ("ms", 1000), ("us", 10**6), ("ns", 10**9)])
def test_the_unit_of_a_time_since_1970_follows_from_its_size(tmp_path: Path, unit: str, per_s: int) -> None:
    texts = [str(EPOCH_S * per_s + n * per_s // 1000) if per_s > 1 else str(EPOCH_S + n) for n in range(20)]
    source = open_source(log(tmp_path, "timestamp", texts), FileOptions())
    assert (f"numbers of timestamp read as {unit} since 1970" in source.remarks) == (unit != "s")
    times_s = stamps(source)
    step_s = STEP_S if per_s > 1 else 1.0
    np.testing.assert_allclose(times_s - EPOCH_S, step_s * np.arange(20), atol=1e-6)


@pytest.mark.parametrize("unit", ["M", "bananas", "mm", "weeks"])
def test_a_time_column_with_an_unknown_unit_must_be_specified(tmp_path: Path, unit: str) -> None:
    path = log(tmp_path, f"time [{unit}]", [str(n) for n in range(20)])
    with pytest.raises(InputError, match=rf"file.time_unit must be set .*received '{unit}'"):
        open_source(path, FileOptions())
    times_s = stamps(open_source(path, FileOptions(time_unit="min")))
    np.testing.assert_allclose(times_s, 60.0 * np.arange(20))


def test_a_mapping_accepts_any_spelling_of_time_units_only() -> None:
    channels = {"P_E": {"source": "P_E", "unit": "N"}}
    for unit in ("s", "sec", "ms", "us", "\u00b5s", "ns", "min", "h", "datetime", "Minutes", "d", "epoch ms"):
        parse_mapping({"file": {"time_unit": unit}, "channels": channels}, name="m")
    for unit in ("mm", "M", "fortnight"):
        with pytest.raises(InputError, match=r"m: file.time_unit must be s, ms, .*, excel d or datetime"):
            parse_mapping({"file": {"time_unit": unit}, "channels": channels}, name="m")


@pytest.mark.parametrize("headings", ["Date,Time", "Day,Clock", "Time,Date"])
def test_a_date_and_a_time_of_day_in_two_columns_are_one_instant(tmp_path: Path, headings: str) -> None:
    moments = [("2026-11-25", f"23:59:59.{990 + n:03d}") for n in range(10)]
    moments += [("2026-11-26", f"00:00:00.{n:03d}") for n in range(10)]  # over midnight
    swap = -1 if headings == "Time,Date" else 1
    source = open_source(log(tmp_path, headings, [",".join(pair[::swap]) for pair in moments]), FileOptions())
    assert [entry.name for entry in source.entries] == ["P_E"]
    assert source.start == datetime(2026, 11, 25, 23, 59, 59)
    np.testing.assert_allclose(stamps(source), 0.99 + STEP_S * np.arange(20), atol=1e-9)


def test_fields_of_blanks_are_missing_values(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = [f"{n / 10},{n if n % 2 else ' '},{'     ' if n % 2 else n}\n" for n in range(20)]
    path.write_text("timestamp,A,B\n" + "".join(rows), encoding="utf-8")
    source = open_source(path, FileOptions())
    first, second = (source.read(entry).values for entry in source.entries)
    np.testing.assert_array_equal(np.isnan(first), np.arange(20) % 2 == 0)
    np.testing.assert_array_equal(np.isnan(second), np.arange(20) % 2 == 1)


def test_a_file_without_a_row_is_refused_in_one_line(tmp_path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    for names in (("time [s]", "P_E [N]"), ("P_E [N]", "disk_x [mm]")):
        path = tmp_path / "empty.parquet"
        parquet.write_table(pyarrow.table({name: pyarrow.array([], pyarrow.float64()) for name in names}), path)
        with pytest.raises(InputError, match="file must be a file with rows of values"):
            open_source(path, FileOptions())


def test_an_import_by_guess_refuses_an_unknown_unit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for unit, must in (("um pk-pk", "detector"), ("M", "unambiguous: m or min"), ("furlong", "a known unit")):
        path = log(tmp_path, "time [s]", [f"{n * STEP_S:g}" for n in range(300)], column=f"disk_x [{unit}]")
        status, _, line = run_captured(capsys, "import", path, "-o", tmp_path / "out.mcap")
        assert status == 2
        assert must in line
        assert "unit of disk_x" in line
    assert not (tmp_path / "out.mcap").exists()


MOMENTS = [datetime(2026, 11, 25, 23, 59, 59, 990_000) + n * timedelta(milliseconds=1) for n in range(20)]
SPELLINGS: dict[str, tuple[str, str]] = {
    "German": ("%d.%m.%Y;%H:%M:%S,{ms}", "Datum;Uhrzeit"),
    "German in one column": ("%d.%m.%Y %H:%M:%S,{ms}", "Zeit"),
    "US": ("%m/%d/%Y;%I:%M:%S.{ms} %p", "Date;Time"),
    "US in one column": ("%m/%d/%Y %I:%M:%S.{ms} %p", "Timestamp"),
    "month by name": ("%d-%b-%Y %H:%M:%S.{ms}", "time"),
    "ISO with slashes": ("%Y/%m/%d %H:%M:%S.{ms}", "time"),
    "ISO": ("%Y-%m-%dT%H:%M:%S.{ms}Z", "time"),
    "two digits of a year": ("%d.%m.%y %H:%M:%S.{ms}", "time"),
    "colon before the fraction": ("%Y-%m-%d %H:%M:%S:{ms}", "time"),
}


@pytest.mark.parametrize("kind", SPELLINGS)
def test_dates_and_times_of_many_spellings(tmp_path: Path, kind: str) -> None:
    form, heading = SPELLINGS[kind]
    texts = [f"{each:{form}}".replace("{ms}", f"{each.microsecond // 1000:03d}") for each in MOMENTS]
    mark = "," if "," in form else "."
    lines = [f"{heading};P_E [N]", *(f"{text};{n}{mark}5" for n, text in enumerate(texts))]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    source = open_source(tmp_path / "log.csv", FileOptions())
    assert [entry.name for entry in source.entries] == ["P_E"]
    assert source.start is not None
    assert source.start.replace(tzinfo=None) == datetime(2026, 11, 25, 23, 59, 59)
    np.testing.assert_allclose(stamps(source), 0.99 + STEP_S * np.arange(20), atol=1e-9)


def test_an_ambiguous_date_is_reported_and_nanoseconds_are_kept(tmp_path: Path) -> None:
    texts = [f"03/04/2026 12:00:00.{n * 19531:09d}" for n in range(20)]
    source = open_source(log(tmp_path, "time", texts), FileOptions())
    np.testing.assert_allclose(stamps(source), 19531e-9 * np.arange(20), atol=1e-12)
    assert any("read as month/day/year" in remark for remark in source.remarks)


@pytest.mark.parametrize("heading", ["__time", "_time_", "Elapsed Time", "abs_time", "#time", "rel. time", "Temps"])
def test_names_of_time_columns(tmp_path: Path, heading: str) -> None:
    source = open_source(log(tmp_path, heading, [repr(n * STEP_S) for n in range(20)]), FileOptions())
    assert [entry.name for entry in source.entries] == ["P_E"]


def test_a_damaged_number_is_refused(tmp_path: Path) -> None:
    path = log(tmp_path, "time", [repr(n * STEP_S) for n in range(20)])
    path.write_text(path.read_text(encoding="utf-8").replace("6.5", "6.5.1"), encoding="utf-8")
    with pytest.raises(InputError, match=r"invalid value '6\.5\.1'"):
        open_source(path, FileOptions())


LVM = "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\t{mode}\n***End_of_Header***\t\n\t\n"
SEGMENT = (
    "Channels\t2\nDate\t2026/11/25\t2026/11/25\nTime\t13:00:0{second}.5\t13:00:0{second}.5\nY_Unit_Label\tN\tmm\n"
    "X0\t0.0\t0.0\nDelta_X\t0.001\t0.001\n***End_of_Header***\t\t\n"
)


@pytest.mark.parametrize("segments", [1, 2])
@pytest.mark.parametrize("mode", ["No", "One", "Multi"])
def test_labview_files_with_comments_and_segments(tmp_path: Path, mode: str, segments: int) -> None:
    text = LVM.format(mode=mode)
    for k in range(segments):
        heading = "X_Value\tP_E\tX_Value\tdisk_x" if mode == "Multi" else "X_Value\tP_E\tdisk_x"
        text += SEGMENT.format(second=2 * k) + heading + "\tComment\n"
        for n in range(6):
            x, comment = f"{n * STEP_S:g}", "\tset 1" if n == 2 else ""
            slow = f"\t{2 * n * STEP_S:g}\t{n + 0.25}" if n < 3 else "\t\t"
            value = 10 * k + n + 0.5
            row = {"No": f"\t{value}\t{n}", "One": f"{x}\t{value}\t{n}", "Multi": f"{x}\t{value}{slow}"}[mode]
            text += row + comment + "\n"
        text += "\n"
    (tmp_path / "log.lvm").write_text(text, encoding="utf-8")
    source = open_source(tmp_path / "log.lvm", FileOptions())
    assert [(entry.name, entry.unit) for entry in source.entries] == [("P_E", "N"), ("disk_x", "mm")]
    signals = [source.read(entry) for entry in source.entries]
    times_s = np.concatenate([2.0 * k + STEP_S * np.arange(6) for k in range(segments)])
    assert signals[0].values.tolist() == [10 * k + n + 0.5 for k in range(segments) for n in range(6)]
    if mode == "No" and segments == 1:
        assert (signals[0].times_s, signals[0].rate_hz) == (None, 1000.0)
    else:
        np.testing.assert_allclose(stamps(source), times_s, atol=1e-12)
    if mode == "Multi":
        expected = [2.0 * k + 2 * n * STEP_S for k in range(segments) for n in range(3)]
        np.testing.assert_allclose(signals[1].times_s, expected, atol=1e-12)
        assert source.entries[1].rows == 3 * segments


def test_one_odd_signal_does_not_stop_the_import_of_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [f"{n * STEP_S:g},{n % 7}.5,{n % 5},{n},9.9e37,on {n}" for n in range(300)]
    heading = "time [s],P_E [N],P_N [km/h],P_S [mm pp],P_W [N],state"
    (tmp_path / "log.csv").write_text("\n".join([heading, *rows]) + "\n", encoding="utf-8")
    status, out, error = run_captured(capsys, "import", tmp_path / "log.csv", "-o", tmp_path / "out.mcap")
    assert (status, error) == (0, "")
    out = " ".join(out.split())
    for remark in ("left out: unit of P_N", "left out: unit of P_S", "left out: P_W must", "text left out: state"):
        assert remark in out
