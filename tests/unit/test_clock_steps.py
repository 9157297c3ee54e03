"""Steps of the clock of a log: gaps with a place and a size, in import and score; they do not change its rate."""

from pathlib import Path

import numpy as np
import pytest

from recorder.reader import Recording
from replays.recordings.formats.clock import TimeAxis, make_axis
from replays.score.records.recorded import RecordedTable
from tests.commands import run_captured

ROWS, AT = 3000, 1500
N = np.arange(ROWS)
AFTER_STEP = N >= AT


def axis(times_s: np.ndarray, *, line: bool = False) -> TimeAxis:
    return make_axis(times_s, line=line, what="x")


@pytest.mark.parametrize("rate_hz", [12.5, 1000.0, 1010.0, 51_200.0])
@pytest.mark.parametrize("size", ["hour", "-hour", "0.5", "-0.5", "-3.3 rows", "7.4 rows", "year"])
def test_a_step_of_the_clock_is_a_gap_and_the_rate_is_that_of_the_rows(rate_hz: float, size: str) -> None:
    known_s = {"hour": 3600.0, "-hour": -3600.0, "0.5": 0.5, "-0.5": -0.5, "year": 3.2e7}
    size_s = known_s.get(size) or float(size.split()[0]) / rate_hz
    stamps = N / rate_hz + size_s * AFTER_STEP
    found = axis(stamps)
    assert found.rate_hz == pytest.approx(rate_hz, rel=1e-6)
    assert found.times_s is None
    rows = round(size_s * rate_hz)  # of an early step, as many rows are missing; of others one row marks the place
    missing = rows if 2 <= rows < 3 * ROWS else 1
    assert found.numbers is not None
    assert found.numbers.tolist() == (N + missing * AFTER_STEP).tolist()
    (step,) = found.steps
    assert (step.row, step.missing) == (AT, missing)
    assert step.size_s == pytest.approx(size_s, rel=1e-6, abs=1e-9) or step.size_s == 0.0
    table = RecordedTable(ROWS, 0, lambda _: [stamps[:, None]])
    assert table.rate_hz == pytest.approx(rate_hz, rel=1e-6)  # the rate of `rig score`


def test_midnight_is_no_gap() -> None:
    found = axis((N / 1000 + 86_400.0 - 1.5) % 86_400.0)
    assert (found.rows, found.times_s, found.numbers) == (ROWS, None, None)
    assert [step.missing for step in found.steps] == [0]


def test_several_steps_and_lost_rows() -> None:
    stamps = np.delete(N / 1000 + 3600.0 * ((N >= 700) & (N < 2000)) + 0.0421 * (N >= 2500), [100, 101, 2900])
    found = axis(stamps)
    assert found.rate_hz == pytest.approx(1000.0, rel=1e-6)
    assert found.rows == ROWS + 1 + 1 + 42
    assert [(step.row, step.size_s > 0.0) for step in found.steps] == [
        (100, False), (698, True), (1998, False), (2498, True),
    ]  # fmt: skip


@pytest.mark.parametrize("size_s", [0.0, 3600.0, -3600.0, 0.5])
def test_jitter_does_not_hide_a_step(size_s: float) -> None:
    jitter_s = 2e-4 * np.random.default_rng(1).standard_normal(ROWS)
    found = axis(N / 1000 + jitter_s + size_s * AFTER_STEP, line=True)
    assert found.rate_hz == pytest.approx(1000.0, rel=2e-5)
    assert len(found.steps) == (size_s != 0.0)


def test_rounded_and_late_stamps_are_no_steps() -> None:
    seconds = N / 51_200
    rounded = [np.floor(seconds / each + 1e-6) * each for each in (1e-3, 1e-4)]
    late = np.maximum.accumulate(N / 1000 + 5e-3 * (N % 100 < 20))
    for stamps in (*rounded, np.floor(N / 1010 * 1000) / 1000, late):
        found = axis(stamps, line=True)
        assert (found.steps, found.rows) == ((), ROWS)
    stepped = axis(rounded[1] + 3600.0 * AFTER_STEP, line=True)
    assert stepped.rate_hz == pytest.approx(51_200.0, rel=1e-4)
    assert len(stepped.steps) == 1


def test_an_import_and_its_verdict_name_the_step(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, target = tmp_path / "log.csv", tmp_path / "out.mcap"
    lines = [f"{t!r},{n % 7}.5" for n, t in enumerate((N[:400] / 1000 + 3600.0 * (N[:400] >= 150)).tolist())]
    path.write_text("time [s],P_E [N]\n" + "\n".join(lines) + "\n", encoding="utf-8")
    status, out, _ = run_captured(capsys, "import", path, "-o", target)
    assert status == 0
    assert "log.csv: the clock steps by +3600 s: 1 row missing after row 150, at 0.149 s" in " ".join(out.split())
    recording = Recording.open(target)
    assert recording.samples("forces").rate_hz == 1000.0
    assert recording.streams["rig/sensors/forces"].lost == 1
    _, out, _ = run_captured(capsys, "info", target)
    assert "fail: 1 row" in out
