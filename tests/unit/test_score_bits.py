"""DAQs with converters of other bits than the rig's: their counts are exact; bits lost by one channel are not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from replays.score.card.scorecard import FAIL, Scorecard
from replays.score.judgement import judge
from rig.channels.table import default_table
from tests.score_daqs import RATE_HZ, make_counts, write_parquet, write_session

PROBES = default_table().groups["probes"]
ROWS = 5000
Columns = dict[str, np.ndarray]


def red(card: Scorecard) -> set[tuple[str, str]]:
    return {(row.quantity, row.channel) for row in card.rows if row.verdict == FAIL}


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """A quarter of a second of noise on the probes, within the converters' range."""
    return make_counts("probes", 0.25 * np.random.default_rng(7).standard_normal((ROWS, 4)), None)


@pytest.fixture(scope="module")
def session(counts: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("sent") / "session.mcap", {"probes": counts})


def nearest(counts: np.ndarray, bits: int) -> np.ndarray:
    return np.clip(np.rint(counts / 2.0 ** (24 - bits)), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1).astype(np.int64)


def in_mm(counts: np.ndarray) -> Columns:
    values = PROBES.engineering(counts)
    return {f"{name} [mm]": values[:, n] for n, name in enumerate(PROBES.names)}


def plain(values: np.ndarray, unit: str = "") -> Columns:
    return {name + unit: values[:, n] for n, name in enumerate(PROBES.names)}


FORMS: dict[str, Callable[[np.ndarray], Columns]] = {
    "12 bits, down": lambda c: plain(c >> 12),
    "14 bits, nearest": lambda c: plain(nearest(c, 14)),
    "16 bits, down": lambda c: plain((c >> 8).astype(np.int16)),
    "18 bits at the upper end": lambda c: plain(c >> 6 << 6),
    "24 bits in 32": lambda c: plain(c << 8),
    "16 bits in 32": lambda c: plain(c >> 8 << 16),
    "16 bits, mm": lambda c: in_mm(c >> 8 << 8),
    "12 bits, V": lambda c: plain(nearest(c, 12) * 2**12 * PROBES.channels[0].lsb_v, " [V]"),
    "fractions, 16 bits": lambda c: plain((c >> 8) / 2.0**15),
    "fractions, single precision": lambda c: plain((c / 2.0**23).astype(np.float32)),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_daq_of_other_bits_has_every_count(form: str, session: Path, counts: np.ndarray, tmp_path: Path) -> None:
    columns = FORMS[form](counts)
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [session])
    assert (card.path, red(card), card.outcome) == ("digital", set(), "pass"), card.verdict_line
    assert any("lower bits" in line for line in card.remarks) == (form not in ("24 bits in 32", list(FORMS)[-1]))
    name = next(iter(columns))
    values = np.unique(columns[name])
    columns[name][4000] = values[np.searchsorted(values, columns[name][4000]) - 3]  # some counts lower
    columns = {each: np.delete(column, 1500) for each, column in columns.items()}
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [session])
    assert red(card) == {("altered values", "disk_x"), ("missing rows", "probes")}


@pytest.mark.parametrize("before", ["idle"])
@pytest.mark.parametrize("form", ["12 bits, down", "16 bits, mm"])
def test_a_daq_of_other_bits_may_begin_early(
    form: str, before: str, session: Path, counts: np.ndarray, tmp_path: Path
) -> None:
    g = np.random.default_rng(8)
    ahead = make_counts("probes", 0.2 * g.standard_normal((70_000, 4)), None)
    ahead = ahead if before == "noise" else np.rint(40.0 * g.standard_normal((70_000, 4))).astype(np.int64)
    card = judge(write_parquet(tmp_path / "daq.parquet", FORMS[form](np.r_[ahead, counts])), [session])
    assert (card.path, red(card), card.outcome) == ("digital", set(), "pass"), card.verdict_line


@pytest.mark.parametrize("subtype", ["PCM_16", "PCM_24", "PCM_32", "FLOAT"])
def test_a_wav_of_full_scale_fractions_has_every_count(
    subtype: str, session: Path, counts: np.ndarray, tmp_path: Path
) -> None:
    soundfile = pytest.importorskip("soundfile")
    soundfile.write(tmp_path / "daq.wav", counts / 2.0**23, RATE_HZ, subtype=subtype)
    card = judge(tmp_path / "daq.wav", [session])
    assert (card.path, red(card), card.outcome) == ("digital", set(), "pass"), card.verdict_line


def test_whole_numbers_in_a_wav_are_counts(session: Path, counts: np.ndarray, tmp_path: Path) -> None:
    soundfile = pytest.importorskip("soundfile")
    soundfile.write(tmp_path / "daq.wav", (counts >> 8).astype(np.int16), RATE_HZ)
    card = judge(tmp_path / "daq.wav", [session])
    assert (card.path, red(card), card.outcome) == ("digital", set(), "pass"), card.verdict_line


@pytest.mark.parametrize("lost", [1, 8])
@pytest.mark.parametrize("form", ["mm", "counts", "16 bits"])
def test_bits_lost_by_one_channel_are_altered_values(
    form: str, lost: int, session: Path, counts: np.ndarray, tmp_path: Path
) -> None:
    counts = counts if form != "16 bits" else counts >> 8
    fewer = counts.copy()
    fewer[:, 1] = fewer[:, 1] >> lost << lost
    columns = in_mm(fewer) if form == "mm" else plain(fewer)
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [session])
    assert (card.path, red(card)) == ("digital", {("altered values", "disk_y")})


@pytest.mark.parametrize("ppm", [300.0])
def test_a_gain_of_a_daq_of_other_bits_fails(ppm: float, session: Path, counts: np.ndarray, tmp_path: Path) -> None:
    columns = FORMS["16 bits, mm"](counts)
    columns["ring_x [mm]"] *= 1.0 + 1e-6 * ppm
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [session])
    assert red(card) == {("altered values", "ring_x")}
