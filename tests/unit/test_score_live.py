"""A DAQ that delivers while the rig runs: its data are judged as any file, and their latency is reported."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from recorder.session import RecordingSession
from replays.score.card.scorecard import FAIL, NO_LIMIT, Scorecard
from replays.score.judgement import judge
from replays.score.records import live
from replays.score.records.live import Arrivals, Delivered, collect
from rig.base.errors import InputError, RefusedError
from rig.base.wire import STATUS, encode_block, sensor_key
from rig.channels.table import default_table
from rig.serve.transport import Client
from tests.commands import run_captured
from tests.score_daqs import RATE_HZ, make_counts, write_session

from .recorder_stream import ScriptedClient, make_block

PROBES = default_table().groups["probes"]
HEADING = ",".join(f"{name} [mm]" for name in PROBES.names) + "\n"
BLOCK = RATE_HZ // 100


def lines(counts: np.ndarray) -> str:
    return "".join(",".join(map(repr, row)) + "\n" for row in PROBES.engineering(counts).tolist())


def red(card: Scorecard) -> set[str]:
    return {row.quantity for row in card.rows if row.verdict == FAIL}


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """Two seconds of noise."""
    volts = np.random.default_rng(1).standard_normal((2 * RATE_HZ, 4))
    return make_counts("probes", volts, None)


def test_latency_is_relative_to_the_arrival_of_the_rigs_block(counts: np.ndarray, tmp_path: Path) -> None:
    session = write_session(tmp_path / "session.mcap", {"probes": counts})
    daq = tmp_path / "daq.csv"
    daq.write_text(HEADING + lines(counts))
    blocks = np.arange(len(counts) // BLOCK)
    # A block reaches the session at its first row; half of each comes from the DAQ after 20 ms, the rest after 30.
    rows = 1 + np.column_stack([blocks * BLOCK + BLOCK // 2, (blocks + 1) * BLOCK]).ravel()
    unix_s = 1.7e9 + np.column_stack([blocks * 0.01 + 0.02, blocks * 0.01 + 0.03]).ravel()
    card = judge(daq, [session], arrivals=Arrivals(rows, unix_s, 1e-4))
    latency = card.row("latency", "probes")
    assert (red(card), latency.verdict) == (set(), NO_LIMIT)
    assert latency.value == pytest.approx(0.025, rel=1e-3)
    assert "at most 0.03 s; a line through a pipe takes 0.0001 s" in latency.note
    assert "latency" not in {row.quantity for row in judge(daq, [session]).rows if row.verdict == NO_LIMIT}


def test_rows_from_before_the_session_are_not_judged(counts: np.ndarray, tmp_path: Path) -> None:
    daq = tmp_path / "daq.csv"
    daq.write_text(HEADING + lines(np.delete(counts[:20_000], 8000, axis=0)))
    card = judge(daq, [write_session(tmp_path / "late.mcap", {"probes": counts[6001:]}, index=6001)])
    assert (red(card), card.row("missing rows", "probes").note) == ({"missing rows"}, "rows 8000")
    assert any("first 6001 rows are not judged" in each for each in card.remarks)
    first = judge(daq, [write_session(tmp_path / "first.mcap", {"probes": counts[6001:]})])  # its rows begin with 0
    assert (red(first), first.row("missing rows", "probes").note) == ({"missing rows"}, "rows 1999")


class Deliverer:
    """A rig that sends blocks, and a DAQ that writes them into a pipe, from a moment on and without some rows."""

    def __init__(self, *, without: tuple[int, ...] = (), blocks: int = 150) -> None:
        self.client, (self.source, self._sink) = ScriptedClient(), os.pipe()
        self._without, self._blocks = without, blocks
        self.stopped, self.over, self.told = threading.Event(), threading.Event(), list[tuple[float, str]]()
        threading.Thread(target=self._act, daemon=True).start()

    def _act(self) -> None:
        while STATUS not in self.client.subscribed and not self.over.is_set():
            time.sleep(0.002)
        if self.over.is_set():
            os.close(self._sink)
            return
        with os.fdopen(self._sink, "w") as pipe:
            pipe.write(HEADING)
            for number in range(self._blocks):
                block = make_block(sensor_key("probes"), number)
                self.client.publish(sensor_key("probes"), encode_block(block))
                kept = [n for n in range(len(block.values)) if block.index + n not in self._without]
                pipe.write(lines(block.values[kept]))
                pipe.flush()
            pipe.write("0.1,0.2")  # truncated

    def collect(self, folder: Path) -> Delivered:
        def report(part: float, text: str) -> None:
            self.told.append((part, text))

        try:
            return collect(cast(Client, self.client), self.source, folder, 5.0, stopped=self.stopped, report=report)
        finally:
            self.over.set()


@pytest.fixture(autouse=True)
def _short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "_MARGIN_S", 0.05)
    monkeypatch.setattr(live, "_FLOOR_LINES", 10)


def test_received_data_are_judged_like_a_file(tmp_path: Path) -> None:
    daq = Deliverer(without=(7000, 7001))
    found = daq.collect(tmp_path)
    assert found.remarks[0].startswith("live: 30000 lines in ")
    assert found.remarks[0].endswith(", to the DAQ's end")
    assert found.arrivals.floor_s > 0.0
    card = judge(found.file, [found.session], arrivals=found.arrivals)
    assert (red(card), card.row("missing rows", "probes").note) == ({"missing rows"}, "rows 7000 to 7001")
    assert "the last line is cut and was ignored: 2 of 4 columns" in card.remarks


def test_an_interruption_keeps_the_complete_lines(tmp_path: Path) -> None:
    daq = Deliverer(blocks=20)
    read, write = os.pipe()
    daq.source = read
    os.write(write, (HEADING + lines(make_block(sensor_key("probes"), 0).values) + "0.1,0.").encode())
    threading.Timer(0.5, daq.stopped.set).start()
    found = daq.collect(tmp_path)
    assert found.remarks[0].endswith(", until it was interrupted")
    assert len(found.file.read_text(encoding="utf-8").splitlines()) == 1 + BLOCK == found.arrivals.rows[-1]
    assert any(text == f"{1 + BLOCK} lines" and 0.0 <= part < 1.0 for part, text in daq.told)


def nobody(daq: Deliverer, _: pytest.MonkeyPatch) -> None:
    daq.client.replies.clear()


def silent(daq: Deliverer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "PATIENCE_S", 0.1)
    daq.source, _ = os.pipe()


def full(_: Deliverer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RecordingSession, "run", lambda *_: SimpleNamespace(error="No space left"))


@pytest.mark.parametrize(
    ("how", "kind", "message"),
    [(nobody, ConnectionError, "no reply"), (silent, InputError, "in 0.1 s"), (full, RefusedError, "No space left")],
)
def test_errors_during_a_live_run_are_reported(
    how: Callable[[Deliverer, pytest.MonkeyPatch], None], kind: type[Exception], message: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    daq = Deliverer(blocks=5)
    how(daq, monkeypatch)
    with pytest.raises(kind, match=message):
        daq.collect(tmp_path)


def test_wrong_options_are_refused_in_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for arguments, message in (
        (["-", "--against", "sent.mcap"], "--against must be left out"),
        (["daq.csv"], "--against must be given"),
        (["daq.csv", "--against", "sent.mcap", "--for-s", "3"], "--for-s must be left out"),
        (["-", "--for-s", "1"], "--for-s must be from 2 to 600"),
        (["-"], "fed by a pipe"),
    ):
        monkeypatch.setattr("sys.stdin.isatty", lambda: True)
        status, _, err = run_captured(capsys, "score", *arguments)
        assert (status, err.count("\n")) == (2, 1), err
        assert message in err
