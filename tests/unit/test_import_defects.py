"""Defects of logs by format: each is imported with a remark, or refused in one line with exit status 2."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recorder.reader import Recording
from tests.commands import run_captured

ROWS, RATE_HZ = 120, 1000.0
N = np.arange(ROWS)
Columns = dict[str, np.ndarray]


def write_text(path: Path, times: np.ndarray, unit: str, columns: Columns, header_lines: int = 0) -> None:
    names = [f"time [{unit}]", *(f'"{name} [N]"' for name in columns)]
    texts = [[*map(repr, times.tolist())], *([str(value) for value in each.tolist()] for each in columns.values())]
    lines = [*(f"# {n}: note" for n in range(header_lines)), ",".join(names), *map(",".join, zip(*texts, strict=True))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_lvm(path: Path, times: np.ndarray, unit: str, columns: Columns, header_lines: int = 0) -> None:
    head = ["LabVIEW Measurement", "Separator\tTab", "Decimal_Separator\t.", "X_Columns\tOne"]
    head += [*(f"Note {n}\tx" for n in range(header_lines)), "***End_of_Header***", ""]
    head += [f"Channels\t{len(columns)}", "Y_Unit_Label" + "\tN" * len(columns), "***End_of_Header***"]
    head += ["\t".join(["X_Value", *(name.replace("\n", " ") for name in columns), "Comment"])]
    texts = [[*map(repr, times.tolist())], *([str(value) for value in each.tolist()] for each in columns.values())]
    path.write_text("\n".join([*head, *map("\t".join, zip(*texts, strict=True))]) + "\n", encoding="utf-8")


def write_parquet(path: Path, times: np.ndarray, unit: str, columns: Columns, header_lines: int = 0) -> None:
    import pyarrow
    from pyarrow import parquet

    named = {f"time [{unit}]": times} | {f"{name} [N]": values for name, values in columns.items()}
    table = pyarrow.table({name: pyarrow.array(values.tolist()) for name, values in named.items()})
    table = table if len(times) else table.cast(pyarrow.schema([(name, pyarrow.float64()) for name in named]))
    parquet.write_table(table.replace_schema_metadata({f"note {n}": "x" for n in range(header_lines)}), path)


def write_mdf(path: Path, times: np.ndarray, unit: str, columns: Columns, header_lines: int = 0) -> None:
    from asammdf import MDF, Signal

    with MDF(version="4.10") as mdf:
        mdf.append(
            [
                Signal(values if values.dtype.kind != "U" else values.astype("S"), times, name=name, unit="N",
                       comment="x\n" * header_lines, encoding="utf-8")
                for name, values in columns.items()
            ],
            common_timebase=True,
        )  # fmt: skip
        mdf.groups[0].channels[0].unit = unit
        mdf.save(path, overwrite=True)


def write_tdms(path: Path, times: np.ndarray, unit: str, columns: Columns, header_lines: int = 0) -> None:
    import nptdms

    about = {f"note {n}": "x" for n in range(header_lines)}
    with nptdms.TdmsWriter(path) as file:
        channels = [nptdms.ChannelObject("g", "time", times, {"unit_string": unit})]
        channels += [
            nptdms.ChannelObject(
                "g", name, values if values.dtype.kind != "U" else values.tolist(), {"unit_string": "N"}
            )
            for name, values in columns.items()
        ]
        file.write_segment([nptdms.RootObject(about), *channels])


WRITERS: dict[str, Callable[..., None]] = {
    ".csv": write_text, ".lvm": write_lvm, ".parquet": write_parquet, ".mf4": write_mdf, ".tdms": write_tdms,
}  # fmt: skip
SIGNALS = {"P_E": 3000.0 + N % 7, "P_N": 2900.0 + N % 5}
TEXT_ONLY = (".csv", ".lvm")


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize(
    "defect",
    ["none", "no rows", "one row", "unknown unit", "clock step", "300 header lines", "invalid samples", "all invalid",
     "text", "line break in a name", "line break in the file name"],
)  # fmt: skip
def test_a_defect_is_a_remark_or_an_error_of_one_line(
    suffix: str, defect: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times, columns, unit, lines = N / RATE_HZ, dict(SIGNALS), "s", 0
    rows = {"no rows": 0, "one row": 1}.get(defect, ROWS)
    unit = "fortnight" if defect == "unknown unit" else unit
    lines = 300 if defect == "300 header lines" else 0
    times = times + 3600.0 * (N >= 50) if defect == "clock step" else times
    if defect == "invalid samples":
        columns["P_N"] = np.where(N == 7, np.nan, columns["P_N"])
        if suffix in TEXT_ONLY:
            marks = {3: "OVER", 8: "#N/A", 9: "1.#INF", 11: "-", 13: "", 17: "ausser Bereich"}
            columns["P_N"] = np.array([marks.get(n, str(value)) for n, value in enumerate(columns["P_N"].tolist())])
    columns["P_S"] = {"all invalid": np.full(ROWS, np.nan), "text": np.array(["on", "off 2"] * (ROWS // 2))}.get(
        defect, columns["P_N"]
    )
    if defect == "line break in a name":
        columns["P\nW"] = columns["P_E"]
    path = tmp_path / (f"a\nb{suffix}" if defect == "line break in the file name" else f"log{suffix}")
    WRITERS[suffix](path, times[:rows], unit, {name: each[:rows] for name, each in columns.items()}, lines)
    status, out, error = run_captured(capsys, "import", path, "-o", tmp_path / "out.mcap")
    refused = defect in ("no rows", "one row") or (defect == "unknown unit" and suffix != ".lvm")
    assert status == (2 if refused else 0), error
    assert error.count("\n") <= 1
    assert "Traceback" not in out + error
    if refused:
        assert error.startswith("rig: ")
        return
    out = " ".join(out.split())
    samples = Recording.open(tmp_path / "out.mcap").samples("forces")
    assert samples.rate_hz == RATE_HZ
    missing = {"clock step": 1, "invalid samples": 7 if suffix in TEXT_ONLY else 1}.get(defect, 0)
    assert samples.index[-1] + 1 - len(samples) == missing
    if defect == "clock step":
        assert "the clock steps by +3600 s: 1 row missing after row 50" in out
    if defect == "text":
        assert "left out: P_S" in out
    if defect == "all invalid":
        assert "left out: P_S must be a signal with valid values" in out
    if defect == "invalid samples" and suffix in TEXT_ONLY:
        assert "'ausser Bereich' (P_N)" in out


UFF_HEAD = """    -1
    58
P_E
NONE
NONE
NONE
NONE
    1         0    0         0       NONE         1   1       NONE         0   0
         4{rows:10d}         1  0.00000e+00  1.00000e-03  0.00000e+00
        17    0    0    0 Time                 s
         9    0    0    0 NONE                 N
         0    0    0    0 NONE                 NONE
         0    0    0    0 NONE                 NONE"""


@pytest.mark.parametrize(
    ("suffix", "rows", "name"),
    [(".wav", 0, "log"), (".wav", 1, "log"), (".wav", ROWS, "log"), (".wav", ROWS, "a\nb"), (".uff", 0, "log"),
     (".uff", 1, "log"), (".uff", ROWS, "log"), (".uff", ROWS, "a\nb")],
)  # fmt: skip
def test_a_format_without_time_stamps(
    suffix: str, rows: int, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"{name}{suffix}"
    values = 0.5 + 0.01 * (N[:rows] % 7)
    if suffix == ".wav":
        import soundfile

        soundfile.write(path, values, round(RATE_HZ), subtype="PCM_24")
    else:
        path.write_text(
            "\n".join([*UFF_HEAD.format(rows=rows).splitlines(), *map("{:20.11e}".format, values), "    -1"])
        )
    status, out, error = run_captured(capsys, "import", path, "-o", tmp_path / "out.mcap")
    assert (status, error.count("\n")) == ((0, 0) if rows > 1 else (2, 1)), out + error
    if rows > 1:
        groups = Recording.open(tmp_path / "out.mcap").table.groups.values()
        assert [group.rate_hz for group in groups] == [RATE_HZ]


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".tdms"])
@pytest.mark.parametrize("unit", ["excel days", "d"])
def test_serial_days_of_a_spreadsheet_are_understood_if_told(
    suffix: str, unit: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"log{suffix}"
    WRITERS[suffix](path, 45000.5 + N / RATE_HZ / 86_400.0, unit, SIGNALS)
    status, out, error = run_captured(capsys, "import", path, "-o", tmp_path / "out.mcap")
    if unit == "d":
        assert (status, error.count("\n")) == (2, 1)
        assert 'file.time_unit must be set to "excel d"' in error
        return
    assert status == 0, error
    assert "from 2023-03-15T12:00:00" in " ".join(out.split())
    assert Recording.open(tmp_path / "out.mcap").samples("forces").rate_hz == RATE_HZ


def test_serial_days_are_no_unit_of_an_mdf_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_mdf(tmp_path / "log.mf4", N / RATE_HZ, "excel d", SIGNALS)
    status, _, error = run_captured(capsys, "import", tmp_path / "log.mf4", "-o", tmp_path / "out.mcap")
    assert (status, error.count("\n")) == (2, 1)
    assert "file.time_unit must be a unit of durations" in error
