"""Time stamps of a record of counts: rows are always judged by counts, and bad stamps fail."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from replays.score.card.scorecard import FAIL
from replays.score.judgement import judge
from replays.score.records.recorded import RecordedTable
from rig.channels.table import default_table
from tests.score_daqs import RATE_HZ, make_counts, write_parquet, write_session

PROBES = default_table().groups["probes"]
ROWS = 6000


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """Noise on the probes."""
    return make_counts("probes", np.random.default_rng(7).standard_normal((ROWS, 4)), None)


@pytest.fixture(scope="module")
def session(counts: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("sent") / "session.mcap", {"probes": counts})


def stepped(times_s: np.ndarray, by_s: float, back: int | None = None) -> np.ndarray:
    return times_s + by_s * ((np.arange(len(times_s)) >= 2000) & (np.arange(len(times_s)) < (back or len(times_s))))


STAMPS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], set[str]]] = {
    "first ones unsigned": (
        lambda t: np.where(np.arange(len(t)) < 101, t + 2.0**32, t),
        {"stamps that go back"},
    ),
    "equal": (lambda t: np.zeros(len(t)), {"stamp rate"}),
    "reversed": (lambda t: t[::-1].copy(), {"stamps that go back"}),
    "ms": (lambda t: 1e3 * t, {"stamp rate"}),
    "an hour forward": (lambda t: stepped(t, 3600.0), {"stamp jitter", "stamp rate"}),
    "an hour back": (lambda t: stepped(t, -3600.0), {"stamps that go back"}),
    "an hour forward and back": (lambda t: stepped(t, 3600.0, 4000), {"stamps that go back"}),
    "half a second": (lambda t: stepped(t, 0.5), {"stamp jitter", "stamp rate"}),
    "10 % fast": (lambda t: 1.1 * t, {"stamp rate"}),
    "random": (lambda t: np.random.default_rng(1).uniform(0.0, 1.0, len(t)), {"stamps that go back"}),
}


@pytest.mark.parametrize("resolution_s", [1e-3, 1e-4, 4e-5, 3e-5])
@pytest.mark.parametrize("rate_hz", [20_000.0, 20_006.0])
def test_coarse_stamps_give_the_rate(resolution_s: float, rate_hz: float) -> None:
    stamps = np.floor(np.arange(20_000) / rate_hz / resolution_s + 1e-6) * resolution_s
    assert RecordedTable(len(stamps), 0, lambda _: [stamps[:, None]]).rate_hz == pytest.approx(rate_hz, rel=20e-6)


def test_lost_rows_do_not_change_the_rate_of_stamps() -> None:
    stamps = np.delete(np.arange(20_000) / RATE_HZ, [3000, 3001, 9000])
    assert RecordedTable(len(stamps), 0, lambda _: [stamps[:, None]]).rate_hz == pytest.approx(RATE_HZ, rel=1e-9)


JITTER: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "10 us, some go back": lambda t, g: t + 1e-5 * g.standard_normal(len(t)),
    "12.5 us, many go back": lambda t, g: t + 1.25e-5 * g.standard_normal(len(t)),
    "late by 10 us on average": lambda t, g: t + 1e-5 * g.exponential(1.0, len(t)),
    "10 us, and 1000 rows are missing": lambda t, g: np.delete(
        t + 1e-5 * g.uniform(-1.0, 1.0, len(t)), slice(500, 1500)
    ),
}


@pytest.mark.parametrize("kind", JITTER)
def test_jitter_does_not_change_the_rate_of_stamps(kind: str) -> None:
    for seed in range(4):
        stamps = JITTER[kind](np.arange(12_000) / RATE_HZ, np.random.default_rng(seed))
        table = RecordedTable(len(stamps), 0, lambda _, stamps=stamps: [stamps[:, None]])
        assert table.rate_hz == pytest.approx(RATE_HZ, rel=3e-6)


@pytest.mark.parametrize("kind", STAMPS)
def test_stamps_do_not_choose_the_path(kind: str, session: Path, counts: np.ndarray, tmp_path: Path) -> None:
    change, right = STAMPS[kind]
    values = np.column_stack([change(np.arange(ROWS) / RATE_HZ), PROBES.engineering(counts)])
    values = np.delete(values, [3000, 3001], axis=0)
    heads = ["time [s]", *(f"{name} [mm]" for name in PROBES.names)]
    card = judge(write_parquet(tmp_path / "daq.parquet", dict(zip(heads, values.T, strict=True))), [session])
    assert (card.path, card.outcome) == ("digital", "fail")
    red = {row.quantity for row in card.rows if row.verdict == FAIL}
    assert red & right, red
    assert "missing rows" in red
    assert not red & {"altered values", "foreign rows", "scale", "offset", "doubled rows", "swapped rows"}
