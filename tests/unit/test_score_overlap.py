"""The digital path by counts alone: position of a recording in the session, small gains, and time stamps of any
kind.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from replays.score.alignment.overlap import find_starts
from replays.score.card.scorecard import FAIL, Scorecard
from replays.score.judgement import judge
from rig.channels.table import default_table
from tests.score_daqs import RATE_HZ, make_counts, write_parquet, write_session

PROBES = default_table().groups["probes"]


def red(card: Scorecard) -> set[tuple[str, str]]:
    return {(row.quantity, row.channel) for row in card.rows if row.verdict == FAIL}


def columns_of(counts: np.ndarray) -> dict[str, np.ndarray]:
    values = PROBES.engineering(counts)
    return {f"{name} [mm]": values[:, n] for n, name in enumerate(PROBES.names)}


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """Noise on the probes."""
    return make_counts("probes", np.random.default_rng(7).standard_normal((12_000, 4)), None)


@pytest.fixture(scope="module")
def session(counts: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("sent") / "session.mcap", {"probes": counts})


@pytest.mark.parametrize("before", ["noise", "silence", "one row", "its end, 3 counts off", "its end"])
def test_a_daq_that_began_early_and_ends_late_is_judged_where_both_overlap(
    before: str, session: Path, counts: np.ndarray, tmp_path: Path
) -> None:
    rows = 70_000
    ahead = {
        "noise": make_counts("probes", np.random.default_rng(8).standard_normal((rows, 4)), None),
        "silence": np.zeros((rows, 4), dtype=np.int64),
        "one row": np.tile(counts[9:10], (rows, 1)),
        "its end, 3 counts off": np.tile(counts[-3500:], (20, 1)) + 3,
        "its end": np.tile(counts[-3500:], (20, 1)),
    }[before]
    daq = np.concatenate([ahead, counts, ahead[:700] + 1])
    card = judge(write_parquet(tmp_path / "daq.parquet", columns_of(daq)), [session])
    assert (card.path, red(card), card.outcome) == ("digital", set(), "pass"), card.verdict_line
    remarks = "\n".join(card.remarks)
    assert f"the first {rows} rows are not judged" in remarks
    assert "the last 700 rows are not judged" in remarks
    daq = np.delete(daq, rows + 9000, axis=0)
    assert red(judge(write_parquet(tmp_path / "daq.parquet", columns_of(daq)), [session])) == {
        ("missing rows", "probes")
    }


def test_a_daq_that_joins_after_half_a_minute_is_found(tmp_path: Path) -> None:
    counts = np.random.default_rng(9).integers(-10_000, 10_000, (31 * RATE_HZ, 1))
    session = write_session(tmp_path / "session.mcap", {"hammer": counts}, index=700)
    first = 31 * RATE_HZ - 8000
    daq = np.delete(counts[first:], 5000, axis=0)
    card = judge(write_parquet(tmp_path / "daq.parquet", {"hammer": daq[:, 0]}), [session])
    assert (card.path, red(card)) == ("digital", {("missing rows", "hammer")})
    assert card.row("missing rows", "hammer").note == f"rows {700 + first + 5000}"
    assert card.row("rows before the first", "hammer").value == first


@pytest.mark.parametrize("ppm", [0.2, 25.0])
@pytest.mark.parametrize(("mean", "spread"), [(2.5e6, 2e5), (6e6, 200.0), (0.0, 3e6)])
def test_a_small_gain_that_changes_counts_fails(
    ppm: float, mean: float, spread: float, session: Path, counts: np.ndarray, tmp_path: Path
) -> None:
    sent = counts.copy()
    sent[:, 1] = mean + spread * np.clip(np.random.default_rng(3).standard_normal(len(counts)), -2.5, 2.5)
    session = write_session(tmp_path / "session.mcap", {"probes": sent})
    columns = columns_of(sent)
    columns["disk_y [mm]"] *= 1.0 + 1e-6 * ppm
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [session])
    assert red(card) == {("scale", "disk_y")}, [row.cells() for row in card.rows if row.verdict == FAIL]
    assert card.row("scale", "disk_y").value == pytest.approx(ppm, rel=1e-3)


@pytest.mark.parametrize("off", [0.3, 0.6, 3.0])
def test_an_offset_fails_where_it_changes_counts(off: float, session: Path, counts: np.ndarray, tmp_path: Path) -> None:
    columns = columns_of(counts)
    columns["disk_y [mm]"] += off * PROBES.channels[1].scale
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [session])
    assert red(card) == ({("offset", "disk_y")} if off >= 0.5 else set())


def test_missing_digits_of_a_file_are_not_a_gain(session: Path, counts: np.ndarray, tmp_path: Path) -> None:
    small = counts // 40  # 6 digits are exact to less than half a count
    session = write_session(tmp_path / "session.mcap", {"probes": small})
    values = PROBES.engineering(small) - np.array([c.offset for c in PROBES.channels])
    lines = "".join(",".join(f"{each:.9f}" for each in row) + "\n" for row in values.tolist())
    (tmp_path / "daq.csv").write_text(",".join(f"{name} [mm]" for name in PROBES.names) + "\n" + lines)
    card = judge(tmp_path / "daq.csv", [session])
    assert {quantity for quantity, _ in red(card)} <= {"offset"}


QUIET = {
    "four of eight": (["probes", "forces"], 4, False),
    "five of eight, reversed": (["probes", "forces"], 3, True),
    "two of four": (["probes"], 2, True),
}
"""Groups, channels that whirl, and whether the others are in reverse order; these have only noise and a level."""


@pytest.mark.parametrize("which", QUIET)
def test_channels_of_noise_use_the_start_found_by_others(which: str, tmp_path: Path) -> None:
    groups, moving, reverse = QUIET[which]
    g, channels = np.random.default_rng(3), [c for group in groups for c in default_table().groups[group].channels]
    counts = np.rint(g.standard_normal((9000, len(channels))) * [c.noise_v / c.lsb_v for c in channels]).astype(
        np.int64
    )
    turn = 2.0 * np.pi * np.arange(8000) / 700.0
    for n in range(len(channels)):
        counts[1000:, n] += (
            np.rint(15.0 * np.arange(8000) * np.sin(turn + n)).astype(np.int64) if n < moving else 300_000
        )
    parts = dict(zip(groups, np.split(counts[1000:], len(groups), axis=1), strict=True))
    session = write_session(tmp_path / "session.mcap", parts)
    order = [*range(moving), *range(moving, len(channels))[:: -1 if reverse else 1]]
    columns = {f"channel {n + 1}": counts[:, c] * channels[c].lsb_v for n, c in enumerate(order)}
    card = judge(write_parquet(tmp_path / "daq.parquet", columns), [session])
    assert (card.path, red(card), card.outcome) == ("digital", set(), "pass"), card.verdict_line
    assert [card.row("mapping", name).value for name in columns] == [channels[c].name for c in order]


PERIOD = 1500


def make_repeating(rows: int, channels: int, generator: np.random.Generator) -> np.ndarray:
    """Return counts of a repeating signal, with noise below one count: a few in 10,000 are off by one."""
    counts = generator.integers(-50, 50, (PERIOD, channels))[np.arange(rows) % PERIOD]
    return counts + (generator.random(counts.shape) < 3e-4)


@pytest.mark.parametrize(("first", "last"), [(7200, 11_000), (0, 3800)], ids=["after", "before"])
def test_rows_outside_a_session_are_not_assigned_one_period_away(first: int, last: int, tmp_path: Path) -> None:
    """Nearly all of them are equal one period away, where more rows of the record would be in the session."""
    whole = make_repeating(11_000, 4, np.random.default_rng(0))
    session = write_session(tmp_path / "session.mcap", {"probes": whole[2700:8700]})
    card = judge(write_parquet(tmp_path / "daq.parquet", columns_of(whole[first:last])), [session])
    assert (card.path, red(card), card.outcome) == ("digital", set(), "pass"), card.verdict_line
    assert card.row("rows before the first", "probes").value == max(0, first - 2700)
    assert f"{max(2700 - first, last - 8700)} rows are not judged" in card.remarks[0]


def test_repeated_last_rows_of_a_session_are_not_a_start(tmp_path: Path) -> None:
    whole = make_repeating(6000, 4, np.random.default_rng(0))
    session = write_session(tmp_path / "session.mcap", {"probes": whole})
    daq = np.concatenate([whole[5700:], whole[1300:5300]])
    card = judge(write_parquet(tmp_path / "daq.parquet", columns_of(daq)), [session])
    assert {"doubled rows", "swapped rows"} & {quantity for quantity, _ in red(card)}


STALE_RANGES = {
    "the end first": [(15_000, 20_000), (3000, 8600)],
    "the end first, a row lost after it": [(15_000, 20_000), (3000, 5000), (5001, 8600)],
    "the begin last": [(3000, 14_000), (0, 7000)],
}
"""Rows of the session in a record, in its order."""


@pytest.mark.parametrize(("which", "repeats"), [*((which, False) for which in STALE_RANGES), ("the end first", True)])
def test_a_record_of_stale_rows_does_not_pass(which: str, repeats: bool, tmp_path: Path) -> None:
    g = np.random.default_rng(0)
    whole = make_repeating(20_000, 4, g) if repeats else g.integers(-50, 50, (20_000, 4))
    session = write_session(tmp_path / "session.mcap", {"probes": whole})
    daq = np.concatenate([whole[first:last] for first, last in STALE_RANGES[which]])
    card = judge(write_parquet(tmp_path / "daq.parquet", columns_of(daq)), [session])
    assert card.outcome != "pass", card.remarks
    doubts = "\n".join(card.evidence_gaps)
    assert "equal a run of rows in it" in doubts or {"doubled rows", "swapped rows"} & {row for row, _ in red(card)}


def test_stale_rows_in_one_table_of_several_do_not_pass(tmp_path: Path) -> None:
    g = np.random.default_rng(0)
    whole = {name: g.integers(-50, 50, (20_000, columns)) for name, columns in {"probes": 4, "hammer": 1}.items()}
    session = write_session(tmp_path / "session.mcap", whole)
    probes = np.concatenate([whole["probes"][15_000:], whole["probes"][3000:9000]])
    daq = write_session(tmp_path / "daq.mcap", {"probes": probes, "hammer": whole["hammer"][3000:9000]})
    card = judge(daq, [session])
    assert (card.path, card.outcome) == ("digital", "inconclusive"), card.verdict_line
    assert "probes: unjudged rows after the session equal a run of rows in it" in card.evidence_gaps


def test_a_start_without_unequal_rows_is_found_despite_longer_overlaps() -> None:
    whole = make_repeating(40_000, 1, np.random.default_rng(1))[:, 0]
    places = find_starts([whole[29_500:]], [whole[:30_000]], 1, 500)
    assert 29_500 in places
