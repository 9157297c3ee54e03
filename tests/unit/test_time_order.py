"""Logs and recordings whose times go backwards, repeat or hardly change: read correctly, or one line and no
traceback.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recorder.reader import Recording
from replays.recordings.formats.clock import make_axis
from replays.score.card.scorecard import FAIL, PASS
from replays.score.judgement import judge
from rig.base.errors import InputError
from rig.base.wire import EDGES, Block, decode_block, encode_block, get_schema
from rig.channels.table import default_table
from tests.commands import run_captured
from tests.hostile.files import PROBES, SESSIONS, Layout
from tests.score_daqs import RATE_HZ, make_counts, write_session

GROUP = default_table().groups["probes"]
ROWS = np.arange(2000)
TIMES_S = ROWS / RATE_HZ


def change_stamp(row: int, time_s: float) -> np.ndarray:
    """Return the stamps with one of them changed."""
    return np.where(row == ROWS, time_s, TIMES_S)


ASCENDING = "time stamps must be ascending"
TOO_LARGE = "not finite numbers up to 1e+12 s"
STAMPS: dict[str, tuple[np.ndarray, str]] = {
    "descending": (TIMES_S[::-1], ASCENDING),
    "in random order": (np.random.default_rng(1).permutation(TIMES_S), ASCENDING),
    "the last before the first": (change_stamp(1999, -1.0), ""),
    "the first far behind": (change_stamp(0, 1e9), ""),
    "a step back": (np.where(ROWS < 1000, TIMES_S, TIMES_S - 0.03), ""),
    "one back": (change_stamp(1000, 0.02), ASCENDING),
    "begun again": (TIMES_S % 0.05, ""),
    "in pairs the wrong way": (TIMES_S[ROWS ^ 1], ASCENDING),
    "all equal": (np.full(2000, 5.0), ASCENDING),
    "equal in pairs": (np.repeat(TIMES_S[::2], 2), ASCENDING),
    "one equal": (change_stamp(1000, TIMES_S[999]), ASCENDING),
    "single precision since 1970": ((1.7e9 + TIMES_S).astype(np.float32).astype(float), ASCENDING),
    "steps of 1e-12 s": (1e-12 * ROWS, ASCENDING),
    "steps of 1e-300 s": (1e-300 * ROWS, ASCENDING),
    "one step of 1e-12 s": (change_stamp(1000, TIMES_S[999] + 1e-12), ""),
    "before zero": (TIMES_S - 100.0, ""),
    "steps of 1e12 s": (1e12 * ROWS, TOO_LARGE),
}
"""Stamps, and the line by which `rig import -o` refuses them."""
NO_RATE = ("descending", "all equal", "steps of 1e-12 s", "steps of 1e-300 s")


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    return make_counts("probes", np.random.default_rng(7).standard_normal((4000, 4)), None)


@pytest.fixture(scope="module")
def session(counts: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("sent") / "session.mcap", {"probes": counts})


def log(folder: Path, times_s: np.ndarray, counts: np.ndarray) -> Path:
    rows = np.column_stack([times_s, GROUP.engineering(counts[: len(times_s)])]).tolist()
    lines = [
        "time [s]," + ",".join(f"{name} [mm]" for name in GROUP.names),
        *(",".join(map(repr, row)) for row in rows),
    ]
    path = folder / "log.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("name", STAMPS)
def test_a_log_with_stamps_out_of_order_is_imported_or_refused_in_one_line(
    name: str, counts: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times_s, message = STAMPS[name]
    path, target = log(tmp_path, times_s, counts), tmp_path / "out.mcap"
    status, _, line = run_captured(capsys, "import", path, "-o", target)
    if message:
        assert (status, line.count("\n"), target.exists()) == (2, 1, False), line
        assert message in line
    else:
        assert status == 0, line
        assert sum(len(block.values) for block in Recording.open(target).blocks(PROBES)) == len(times_s)


@pytest.mark.parametrize("name", STAMPS)
def test_stamps_out_of_order_do_not_change_the_digital_path(
    name: str, session: Path, counts: np.ndarray, tmp_path: Path
) -> None:
    times_s, message = STAMPS[name]
    path = log(tmp_path, times_s, counts)
    if message == TOO_LARGE:
        with pytest.raises(InputError, match="not finite numbers up to"):
            judge(path, [session])
        return
    card = judge(path, [session])
    assert card.path == "digital"
    failing = {row.quantity for row in card.rows if row.verdict == FAIL}
    assert failing <= {"stamp rate", "stamps that go back"}  # the counts of each row are right
    assert ("stamps that go back" in failing) == bool((np.diff(times_s) < 0.0).any())


def test_stamps_without_a_rate_do_not_change_the_analogue_path(
    session: Path, counts: np.ndarray, tmp_path: Path
) -> None:
    cards = [
        judge(log(tmp_path, times_s, counts), [session], path="analogue")
        for times_s in (TIMES_S, *(STAMPS[name][0] for name in NO_RATE))
    ]
    # Separate quantities judge the stamps.
    right, *others = [
        [(row.quantity, row.channel, row.verdict) for row in card.rows if not row.quantity.startswith("stamp")]
        for card in cards
    ]
    assert ("polarity", "disk_x", PASS) in right
    assert others == [right] * len(NO_RATE)


@pytest.mark.parametrize("name", NO_RATE)
def test_stamps_without_a_rate_are_refused_in_one_line(name: str) -> None:
    with pytest.raises(InputError, match=r"ascending by 1 ns or more on average .*disk_x, "):
        make_axis(STAMPS[name][0], line=True, what="disk_x")
    assert make_axis(1e-9 * ROWS, line=True, what="disk_x").rate_hz == pytest.approx(1e9)


Change = Callable[[Block, int], dict[str, object]]
REPEATED, MISPLACED = "with repeated or decreasing row numbers", "have a time that does not fit their row number"
NOT_BLOCKS, TURNED = "that are not blocks or do not fit the catalogue", "have edges that are not in ascending order"
STATE = "rig/truth/state"
TICKS: dict[str, tuple[str, Change, str]] = {
    "one back": (PROBES, lambda block, n: {"tick": block.tick - 150_000 * (n == 3)}, MISPLACED),
    "one as the one before": (PROBES, lambda block, n: {"tick": block.tick - 100_000 * (n == 3)}, MISPLACED),
    "all at zero": (PROBES, lambda block, n: {"tick": 0}, MISPLACED),
    "descending": (PROBES, lambda block, n: {"tick": 500_000 - 100_000 * n}, MISPLACED),
    "before zero": (PROBES, lambda block, n: {"tick": block.tick - 10**6}, NOT_BLOCKS),
    "rows before zero": (PROBES, lambda block, n: {"index": block.index - 4000}, NOT_BLOCKS),
    "a row number as before": (PROBES, lambda block, n: {"index": block.index - 500 * (n == 3)}, REPEATED),
    "the first again": (PROBES, lambda block, n: {"index": 0, "tick": 0}, REPEATED),
    "in reverse": (PROBES, lambda block, n: {"index": 2500 - 500 * n, "tick": 500_000 - 100_000 * n}, REPEATED),
    "of the truth": (STATE, lambda block, n: {"tick": block.tick - 150_000 * (n == 3)}, MISPLACED),
    "the truth again": (STATE, lambda block, n: {"tick": 0, "index": 0}, REPEATED),
    "edges back": (EDGES, lambda block, n: {"tick": max(0, block.tick - 300_000 * (n == 1))}, TURNED),
    "edges as before": (EDGES, lambda block, n: {"values": block.values - block.values, "tick": 100_000}, TURNED),
    "edges descending": (EDGES, lambda block, n: {"tick": 500_000 - 100_000 * n}, TURNED),
}
"""Key, change of each block by its number, and the doubt."""


@pytest.fixture(scope="module")
def layout() -> Layout:
    return Layout(Recording.open(SESSIONS / "hammer-5.2.mcap"))


@pytest.mark.parametrize("name", TICKS)
def test_blocks_out_of_order_in_time_are_a_doubt_in_each_command(
    name: str, layout: Layout, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key, change, doubt = TICKS[name]
    spoilt, numbers = copy.deepcopy(layout), iter(range(1000))
    for at, (topic, payload, time_ns) in enumerate(spoilt.messages):
        if topic == key:
            block = decode_block(payload, get_schema(topic) or "")
            spoilt.messages[at] = (topic, encode_block(replace(block, **change(block, next(numbers)))), time_ns)
    path = spoilt.write(tmp_path / "x.mcap")
    doubts = [line for line in Recording.open(path).doubts if doubt in line]
    assert len(doubts) == 1, Recording.open(path).doubts
    assert key in doubts[0]
    status, shown, _ = run_captured(capsys, "info", path)
    assert status == 1
    assert doubt in " ".join(shown.split())
    status, _, lines = run_captured(capsys, "export", path, "-o", tmp_path / "x.csv")
    assert status == 0
    assert doubt in lines
