"""The live view of a rig that is a list of payloads; the view reads the wall clock to detect silence."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.viewer import live
from recorder.viewer.canvas import Canvas, new_stream
from rig.base import wire
from rig.serve.transport import NoReplyError
from rig.serve.transport.memory import key_matches
from tests.unit.viewer_recording import RADIUS_MM, RATE_HZ, Saved, Synthetic, generate_messages, make_replies
from tests.waiting import PATIENCE_S, time_limit

pytestmark = pytest.mark.wallclock


class ScriptedClient:
    """Delivers a list of payloads as soon as the viewer watches for the rig; may remove the rig afterwards."""

    foreign = 0
    rig = "a rig"

    def __init__(self, recording: Synthetic, payloads: Iterable[tuple[str, bytes]], *, killed: bool = False) -> None:
        self._replies = make_replies(recording)
        self._payloads = list(payloads)
        self._killed = killed
        self._callbacks: list[tuple[str, Callable[[str, bytes], None]]] = []
        self.options: dict[str, dict[str, Any]] = {}
        self.reports: list[tuple[str, dict[str, Any]]] = []

    def subscribe(self, key: str, on_message: Callable[[str, bytes], None], **options: Any) -> None:
        self._callbacks.append((key, on_message))
        self.options[key] = options

    def request(self, key: str, payload: bytes = b"", *, timeout_s: float = 2.0) -> bytes:
        if key not in self._replies:
            raise NoReplyError("nobody there")
        return self._replies[key]

    def watch(self, key: str, callback: Callable[[bool], None]) -> None:
        assert key == wire.ALIVE
        callback(True)
        for sent_key, payload in self._payloads:
            for pattern, on_message in self._callbacks:
                if key_matches(pattern, sent_key):
                    on_message(sent_key, payload)
        if self._killed:
            callback(False)

    def report(self, key: str, payload: bytes) -> None:
        self.reports.append((key, wire.decode_document(payload)))

    def close(self) -> None:
        pass


def run(client: ScriptedClient, path: Path, **options: Any) -> tuple[str, live.LiveView, Saved]:
    stream = new_stream("live test")
    stream.save(path)
    view = live.LiveView(client, Canvas(stream), live.request_document(client), **options)
    reason = view.run()
    stream.flush()
    stream.disconnect()
    return reason, view, Saved(path)


def payloads_of(recording: Synthetic) -> list[tuple[str, bytes]]:
    return [message for block in generate_messages(recording) for message in block]


@pytest.fixture(scope="module")
def recording() -> Synthetic:
    return Synthetic(duration_s=1.5)


def test_live_view_draws_the_stream_and_ends_with_it(recording: Synthetic, tmp_path: Path) -> None:
    client = ScriptedClient(recording, payloads_of(recording))
    reason, view, saved = run(client, tmp_path / "live.rrd", wall=lambda: 1.8e9)
    assert reason == "the rig ended: completed"
    assert (view.received, view.lost, view.malformed) == (5 * len(recording.times_s), 0, 0)
    first, _ = saved["/orbit/ring/reading", "Points2D:labels"].values[-1]
    assert first == "BACKWARD whirl -83.0 Hz"
    assert [state for (state,) in saved["/contact/truth_of_the_model", "StateChange:state"].values] == [
        "free",
        "contact",
    ]
    assert saved["/events", "TextLog:text"].values[-1] == ["end: reason completed"]
    ring = saved["/sensors/probes/ring", "Scalars:scalars"]
    assert not np.isnan(ring.walls_s).any()
    near = np.abs(ring.times_s - recording.hit_s) < 0.049
    assert near.sum() == pytest.approx(0.098 * RATE_HZ, rel=0.01)
    far = np.abs(ring.times_s - recording.hit_s) > 0.06
    assert far.sum() <= 1.1 * live.ROWS_PER_S * recording.times_s[-1]
    assert max(row[0] for row in ring.values) == pytest.approx(RADIUS_MM, abs=3e-3)


def test_lost_blocks_are_not_requested_again(recording: Synthetic, tmp_path: Path) -> None:
    client = ScriptedClient(recording, payloads_of(recording)[-1:])
    run(client, tmp_path / "options.rrd")
    for key, options in client.options.items():
        if key != wire.EVENTS:
            assert options["lossless"] is False
    assert f"{wire.SENSORS}/*" in client.options


def test_heartbeat_reports_received_rows(recording: Synthetic, tmp_path: Path) -> None:
    client = ScriptedClient(recording, payloads_of(recording))
    run(client, tmp_path / "beat.rrd", wall=lambda: 42.0)
    assert client.reports
    assert {key for key, _ in client.reports} == {f"{wire.CLIENTS}/viewer"}
    assert [document["done"] for _, document in client.reports[:-1]] == [False] * (len(client.reports) - 1)
    last = {"name": "viewer", "received_index": len(recording.times_s), "lost": 0, "done": True}
    assert client.reports[-1][1].items() >= last.items()
    assert len({document["secret"] for _, document in client.reports}) == 1


def test_a_killed_rig_is_noticed(recording: Synthetic, tmp_path: Path) -> None:
    half = payloads_of(recording)[:300]
    reason, view, saved = run(ScriptedClient(recording, half, killed=True), tmp_path / "killed.rrd")
    assert view.failed
    assert reason.startswith("the rig disappeared without ending its stream")
    assert saved["/events", "TextLog:text"].values[-1] == [reason]
    assert saved["/events", "TextLog:level"].values[-1] == ["WARN"]


def test_lost_blocks_are_counted_reported_and_shown_as_a_gap(recording: Synthetic, tmp_path: Path) -> None:
    payloads = list(generate_messages(recording))
    kept = [message for number, block in enumerate(payloads) if number not in (20, 21) for message in block]
    _, view, saved = run(ScriptedClient(recording, kept), tmp_path / "lost.rrd")
    assert view.lost == 5 * 400
    texts = [text for (text,) in saved["/events", "TextLog:text"].values]
    assert [text.count("400 rows of ") for text in texts if "did not reach the viewer" in text] == [5]
    ring = saved["/sensors/probes/ring", "Scalars:scalars"]
    assert any(math.isnan(row[0]) for row in ring.values)
    assert not ((ring.times_s > 0.2001) & (ring.times_s < 0.2199)).any()


def test_invalid_payloads_are_counted_and_skipped(recording: Synthetic, tmp_path: Path) -> None:
    good = payloads_of(recording)
    bad = [
        (wire.sensor_key("probes"), b"no block"),
        (wire.EVENTS, b"{"),
        (wire.EVENTS, b"[]"),
        (wire.sensor_key("unknown"), b"whatever"),
        (wire.EDGES, b""),
    ]
    reason, view, _ = run(ScriptedClient(recording, good[:100] + bad + good[100:]), tmp_path / "bad.rrd")
    assert reason == "the rig ended: completed"
    assert view.malformed == 3
    assert view.received == 5 * len(recording.times_s)


def test_a_slow_viewer_drops_the_oldest_blocks_and_reports_it(recording: Synthetic, tmp_path: Path) -> None:
    long = Synthetic(duration_s=9.0)
    reason, view, saved = run(ScriptedClient(long, payloads_of(long)), tmp_path / "behind.rrd")
    assert reason == "the rig ended: completed"
    assert 0 < view.received < 5 * len(long.times_s)
    assert saved["/sensors/probes/ring", "Scalars:scalars"].times_s[-1] == pytest.approx(long.times_s[-1], abs=0.01)


def test_the_picture_is_drawn_at_the_pace_of_the_viewer_not_of_the_rig(recording: Synthetic, tmp_path: Path) -> None:
    # All of it arrives at once: one frame, not one per block.
    _, _, saved = run(ScriptedClient(recording, payloads_of(recording)), tmp_path / "frames.rrd")
    assert len(saved["/orbit/ring/trace", "LineStrips2D:strips"].values) <= 3


@pytest.mark.parametrize("prompt", [True, False])
def test_a_slow_viewer_gets_fewer_pictures_with_all_peaks(recording: Synthetic, tmp_path: Path, prompt: bool) -> None:
    blocks = list(generate_messages(recording))
    client = ScriptedClient(recording, [])
    stream = new_stream("paced")
    stream.save(tmp_path / "paced.rrd")
    messages: list[str] = []
    view = live.LiveView(
        client, Canvas(stream), live.request_document(client), get_processed=lambda: 1_000_000 if prompt else 0
    )

    def publish() -> bool:
        for message in [message for block in blocks[:5] for message in block]:
            view.take(*message)
        del blocks[:5]
        return False

    assert view.run(stop=publish, on_message=messages.append) == "the rig ended: completed"
    stream.flush()
    stream.disconnect()
    saved = Saved(tmp_path / "paced.rrd")
    pictures = len(saved["/orbit/ring/trace", "LineStrips2D:strips"].values)
    assert pictures > 5 if prompt else pictures <= 2
    assert messages[-1].startswith("viewer late by 0." if prompt else "viewer loading")
    ring = saved["/sensors/probes/ring", "Scalars:scalars"]
    assert view.received == 5 * len(recording.times_s)
    assert max(row[0] for row in ring.values) == pytest.approx(RADIUS_MM, abs=3e-3)
    assert ring.times_s[-1] == pytest.approx(recording.times_s[-1], abs=0.01 if prompt else 0.1)
    # Around the hammer pulse all rows are present, for slow viewers too.
    near = np.abs(ring.times_s - recording.hit_s) < 0.049
    assert near.sum() == pytest.approx(0.098 * RATE_HZ, rel=0.01)
    far = np.abs(ring.times_s - recording.hit_s) > 0.06
    assert far.sum() > 500 if prompt else far.sum() < 200


def test_closing_the_viewer_ends_the_view(recording: Synthetic, tmp_path: Path) -> None:
    stream = new_stream("closed")
    stream.save(tmp_path / "closed.rrd")
    client = ScriptedClient(recording, payloads_of(recording)[:10])
    with time_limit(PATIENCE_S):
        reason = live.LiveView(client, Canvas(stream), live.request_document(client)).run(stop=lambda: True)
    stream.flush()
    stream.disconnect()
    assert reason == "the viewer was closed"


def test_a_stalled_window_is_not_drawn(recording: Synthetic, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Canvas, "keeps_up", lambda self, *, timeout_s: False)
    monkeypatch.setattr(live, "_CHECK_INTERVAL_S", 0.0)
    blocks = list(generate_messages(recording))
    early = [message for block in blocks[:10] for message in block]
    late = [message for block in blocks[10:] for message in block]
    client = ScriptedClient(recording, early)
    stream = new_stream("stalled")
    stream.save(tmp_path / "stalled.rrd")
    view = live.LiveView(client, Canvas(stream), live.request_document(client))
    ticks = iter(range(100))

    def publish_later() -> bool:
        if next(ticks) == 3:
            for key, payload in late:
                view.take(key, payload)
        return False

    assert view.run(stop=publish_later) == "the rig ended: completed"
    stream.flush()
    stream.disconnect()
    assert view.skipped == 5 * (len(recording.times_s) - 2000)
    assert view.received == 5 * len(recording.times_s)
    assert client.reports[-1][1]["received_index"] == len(recording.times_s)
    assert Saved(tmp_path / "stalled.rrd")["/sensors/probes/ring", "Scalars:scalars"].times_s[-1] <= 0.1
