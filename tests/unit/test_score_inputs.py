"""Inputs of `rig score`: requested channels, limits, and incomplete files."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from replays.score.card.limits import load_limits
from replays.score.card.scorecard import FAIL, PASS, Scorecard
from replays.score.judgement import judge
from rig.base.errors import InputError
from rig.base.outcome import Outcome
from rig.channels.table import default_table
from tests.commands import run_captured
from tests.score_daqs import make_counts, write_parquet, write_session

PROBES = default_table().groups["probes"]


def red(card: Scorecard) -> set[tuple[str, str]]:
    return {(row.quantity, row.channel) for row in card.rows if row.verdict == FAIL}


def columns_of(counts: np.ndarray, *names: str) -> dict[str, np.ndarray]:
    values = PROBES.engineering(counts)
    return {f"{name} [mm]": values[:, PROBES.names.index(name)] for name in names or PROBES.names}


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """Noise on the probes."""
    return make_counts("probes", np.random.default_rng(7).standard_normal((4000, 4)), None)


@pytest.fixture(scope="module")
def session(counts: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("sent") / "session.mcap", {"probes": counts})


@pytest.mark.parametrize("path", [None, "analogue"])
def test_an_absent_channel_fails_unless_it_was_not_requested(
    path: None, session: Path, counts: np.ndarray, tmp_path: Path
) -> None:
    daq = write_parquet(tmp_path / "daq.parquet", columns_of(counts, "disk_x", "ring_y"))
    card = judge(daq, [session], path=path)
    assert red(card) >= {("recorded", "disk_y"), ("recorded", "ring_x")}
    assert "--channels" in card.row("recorded", "disk_y").note
    card = judge(daq, [session], path=path, channels=["disk_x", "ring_y"])
    assert not {quantity for quantity, _ in red(card)} & {"recorded"}
    assert card.row("recorded", "disk_x").verdict == PASS
    assert ("recorded", "disk_y") in red(judge(daq, [session], path=path, channels=["disk_x", "disk_y"]))
    assert ("recorded", "disk_y") in red(judge(daq, [session], path=path, channels=["probes"]))


@pytest.mark.parametrize(("at", "gap_s"), [(1, 3600.0), (100, 3600.0), (399, 86400.0)])
def test_a_clock_adjustment_gives_no_traceback(at: int, gap_s: float, session: Path, tmp_path: Path) -> None:
    stamps = np.arange(400) * 1e-3
    stamps[at:] += gap_s
    columns = {"time [s]": stamps, "disk_x [mm]": np.sin(0.04 * np.arange(400))}
    daq = write_parquet(tmp_path / "daq.parquet", columns)
    with suppress(InputError):  # a rate that no record can have is refused in one line
        assert judge(daq, [session]).outcome != Outcome.PASS


def test_a_column_without_a_value_is_absent(session: Path, counts: np.ndarray, tmp_path: Path) -> None:
    columns = columns_of(counts) | {"ring_x [mm]": np.full(len(counts), np.nan)}
    assert ("recorded", "ring_x") in red(judge(write_parquet(tmp_path / "daq.parquet", columns), [session]))


def test_a_channel_missing_in_the_session_is_refused_in_one_line(
    session: Path, counts: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    daq = write_parquet(tmp_path / "daq.parquet", columns_of(counts))
    status, _, err = run_captured(capsys, "score", daq, "--against", str(session), "--channels", "disk_x,disk_z")
    assert (status, err.count("\n")) == (2, 1), err
    assert "--channels must be" in err
    assert "disk_z" in err


@pytest.mark.parametrize("value", [0.0, 1.5, np.nan])
@pytest.mark.parametrize("unit", ["mm", "V"])
def test_dead_channels_fail_with_a_junit_file(
    value: float, unit: str, session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = {f"{name} [{unit}]": np.full(4000, value) for name in PROBES.names}
    daq, report = write_parquet(tmp_path / "daq.parquet", columns), tmp_path / "score.xml"
    status, _, _ = run_captured(capsys, "score", daq, "--against", str(session), "--junit", str(report))
    assert status == 1
    assert report.read_text().count("<failure") >= len(PROBES.names)


@pytest.mark.filterwarnings("error")
def test_a_stretch_without_values_gives_no_warning(session: Path, counts: np.ndarray, tmp_path: Path) -> None:
    columns = columns_of(counts)
    for values in columns.values():
        values[1300:2700] = np.nan
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [session], path="analogue")
    assert card.outcome == "fail"


@pytest.mark.parametrize("channels", ["", ",", " , "])
def test_no_channel_at_all_is_refused(
    channels: str, session: Path, counts: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From an empty variable of a shell: no channel would be judged, and each record would pass."""
    daq = write_parquet(tmp_path / "daq.parquet", columns_of(counts))
    status, _, err = run_captured(capsys, "score", daq, "--against", str(session), "--channels", channels)
    assert (status, err.count("\n")) == (2, 1), err
    assert "--channels must be one or more names, separated by commas" in err


def test_an_unknown_channel_of_a_mapping_is_named_with_its_line(
    session: Path, counts: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    daq, mapping = write_parquet(tmp_path / "daq.parquet", columns_of(counts)), tmp_path / "m.toml"
    mapping.write_text('[channels.disk_z]\nsource = "disk_x"\n', encoding="utf-8")
    status, _, err = run_captured(capsys, "score", daq, "--against", str(session), "-m", str(mapping))
    assert (status, err.count("\n")) == (2, 1), err
    assert "channels.disk_z must be named as a channel" in err


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        ("low = 20.0, high = -20.0", "low = 20, high = -20"),
        ("low = 1, high = 0", "low = 1, high = 0"),
        ("low = nan", "gain.low"),
        ("high = inf", "gain.high"),
        ('high = 1.0, measures = "lenght"', "lenght"),
    ],
)
def test_a_limit_that_always_or_never_passes_is_refused(ends: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "ours.toml"
    file.write_text(f'title = "x"\n[analogue]\ngain = {{ {ends}, kind = "assumed", source = "me" }}\n')
    with pytest.raises(InputError) as error:
        load_limits(file)
    assert message in str(error.value)


def test_a_limit_reversed_by_the_channel_table_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "ours.toml"
    file.write_text(
        'title = "x"\n[analogue]\nnoise = { low = 1e9, high = { of = "noise" }, kind = "assumed", source = "me" }\n'
    )
    with pytest.raises(InputError, match="limit noise of disk_x must be with low at most high"):
        load_limits(file).bounds("analogue", "noise", PROBES.channels[0])


@pytest.mark.parametrize("kept", [1, 20, 75])
def test_a_text_with_a_truncated_last_line_is_judged_without_it(
    kept: int, session: Path, counts: np.ndarray, tmp_path: Path
) -> None:
    lines = [",".join(map(repr, row)) for row in PROBES.engineering(counts[:2000]).tolist()]
    heading = ",".join(f"{name} [mm]" for name in PROBES.names)
    (tmp_path / "daq.csv").write_text("\n".join([heading, *lines[:-1], lines[-1][:kept]]))
    card = judge(tmp_path / "daq.csv", [session])
    assert (card.path, card.outcome) == ("digital", "pass"), card.verdict_line
    assert any("last line" in remark for remark in card.remarks)
    assert card.row("rows after the last", "probes").value == len(counts) - 1999


@pytest.mark.parametrize(
    ("period", "lost", "outcome"), [(40, 40, "inconclusive"), (40, 1, "fail"), (0, 40, "fail"), (0, 0, "pass")]
)
def test_a_loss_of_whole_periods_is_no_pass(period: int, lost: int, outcome: str, tmp_path: Path) -> None:
    rows = np.arange(6000)
    counts = np.random.default_rng(1).integers(-2_000_000, 2_000_000, (len(rows), 4))
    if period:
        phases = 2.0 * np.pi * (rows[:, None] / period + np.arange(4) / 7.0)
        counts = np.rint(2e6 * np.sin(phases)).astype(np.int64)
    session = write_session(tmp_path / "sent.mcap", {"probes": counts})
    kept = np.delete(counts, slice(3000, 3000 + lost), axis=0)
    card = judge(write_parquet(tmp_path / "daq.parquet", columns_of(kept)), [session], path="digital")
    assert card.outcome == outcome, card.verdict_line
    assert any("whole periods" in each for each in card.evidence_gaps) == bool(period)
