"""A running rig on a canvas, as a guest that the rig never waits for."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from recorder.viewer.canvas import Canvas
from recorder.viewer.geometry import Geometry
from recorder.viewer.painter import Painter
from rig import wire
from rig.channels import ChannelTable
from rig.transport import Client

NAME = "viewer"
ROWS_PER_S = 500.0
"""Points of each curve per simulated second [Hz]; full rate around hammer blows."""
_TICK_S = 0.04
_FLUSH_EVERY = 4
_HEARTBEAT_S = 0.5
_INBOX = 4000
"""Payloads held at most, about 4 s of all streams; then the oldest go."""
_QUIET_S = 0.3
_CHECK_S = 1.0
_PATIENCE_S = 0.3
_CONTACT = wire.truth_key("contact")


@dataclass(frozen=True, slots=True)
class Described:
    """What a rig says of itself, as far as it is drawn.

    Attributes:
        table: Its channels.
        geometry: Its lengths.
        contact_columns: Column names of its truth table of the contact; empty if it has none.
    """

    table: ChannelTable
    geometry: Geometry
    contact_columns: tuple[str, ...]


def ask(client: Client, *, wait_s: float = 2.0) -> Described:
    """Ask the rig that a client is connected to.

    Args:
        client: The rig.
        wait_s: How long it may take to answer [s]: a rig that is being prepared listens already.

    Raises:
        NoReplyError: No rig answers.
    """
    catalogue = wire.decode_document(client.request(wire.CATALOGUE, timeout_s=max(wait_s, 0.5)))
    parameters = wire.decode_document(client.request(wire.PARAMETERS))
    contact = catalogue.get("truth", {}).get("contact", {}).get("columns", [])
    return Described(
        table=ChannelTable.model_validate(catalogue["table"]),
        geometry=Geometry.from_parameters(parameters),
        contact_columns=tuple(column["name"] for column in contact),
    )


class LiveView:
    """Draws a rig's streams from now on until they end."""

    def __init__(
        self, client: Client, canvas: Canvas, described: Described, *, wall: Callable[[], float] = time.time
    ) -> None:
        """Prepare the canvas; nothing is received before `run`.

        Args:
            client: The rig.
            canvas: Where to draw.
            described: What the rig says of itself.
            wall: The wall clock [s since 1970].
        """
        self._client = client
        self._canvas = canvas
        self._table = described.table
        self._wall = wall
        self._painter = Painter(canvas, described.table, described.geometry, rows_per_s=ROWS_PER_S, whole=False)
        self._groups = {wire.sensor_key(name): name for name in described.table.groups}
        self._beat_key = next(iter(self._groups), "")
        columns = described.contact_columns
        self._force_column = columns.index("normal_force") if "normal_force" in columns else None
        self._inbox: deque[tuple[str, bytes]] = deque(maxlen=_INBOX)
        self._continuity = wire.Continuity()
        self._received_index = 0
        self._there: bool | None = None
        self._gone_at_s = 0.0
        self._end: str | None = None
        self._stalled = False
        self.malformed = 0
        self.skipped = 0
        """Sensor rows that arrived and were not drawn, because the viewer's window did not take them."""

    @property
    def received(self) -> int:
        """Sensor rows that arrived."""
        return sum(rows for key, rows in self._continuity.received.items() if key in self._groups)

    @property
    def lost(self) -> int:
        """Sensor rows that did not arrive: the viewer takes what it gets."""
        return sum(rows for key, rows in self._continuity.lost.items() if key in self._groups)

    def run(self, *, stop: Callable[[], bool] = lambda: False) -> str:
        """Draw until the rig ends, is gone, or `stop` says so.

        Returns:
            Why it ended, in one line.
        """
        self._client.subscribe(f"{wire.SENSORS}/*", self._take, lossless=False)
        if self._force_column is not None:
            self._client.subscribe(_CONTACT, self._take, lossless=False)
        # Events are few: those from before we came are fetched.
        self._client.subscribe(wire.EVENTS, self._take, history=True)
        self._client.watch(wire.ALIVE, self._watch)
        count, heard_s, beat_s, check_s = 0, time.monotonic(), 0.0, 0.0
        while True:
            now_s = time.monotonic()
            if self._draw():
                heard_s = now_s
            count += 1
            if count % _FLUSH_EVERY == 0:
                self._painter.flush()
            if now_s - check_s >= _CHECK_S:
                self._check_canvas()
                check_s = now_s
            if now_s - beat_s >= _HEARTBEAT_S:
                self._report()
                beat_s = now_s
            reason = self._reason(now_s, heard_s) or ("the viewer was closed" if stop() else None)
            if reason is not None:
                if self._end is None:
                    self._painter.note(self._painter.now_s, reason, level="WARN")
                self._painter.close()
                self._report(done=True)
                return reason
            # An absolute grid is not needed here: a late picture is only late.
            time.sleep(max(0.0, _TICK_S - (time.monotonic() - now_s)))

    def _reason(self, now_s: float, heard_s: float) -> str | None:
        if now_s - heard_s < _QUIET_S:
            return None
        if self._end is not None:
            return f"the rig ended: {self._end}"
        if self._there is False and now_s - self._gone_at_s > _QUIET_S:
            return "the rig is gone without ending its stream (killed, or the connection broke)"
        return None

    def _take(self, key: str, payload: bytes) -> None:
        self._inbox.append((key, payload))

    def _watch(self, there: bool) -> None:
        self._gone_at_s = time.monotonic()
        self._there = there

    def _report(self, *, done: bool = False) -> None:
        document = {
            "name": NAME,
            "received_index": self._received_index,
            "lost": self.lost,
            "wall_s": self._wall(),
            "done": done,
        }
        self._client.report(f"{wire.CLIENTS}/{NAME}", wire.encode_document(document))

    def _check_canvas(self) -> None:
        """Stop drawing for a viewer that takes nothing, or memory would fill with what it still has to get."""
        stalled = not self._canvas.keeps_up(timeout_s=_PATIENCE_S)
        if self._stalled and not stalled:
            text = f"the viewer took nothing for a while: {self.skipped} rows in all were not drawn"
            self._painter.note(self._painter.now_s, text, level="WARN")
        self._stalled = stalled

    def _draw(self) -> bool:
        """Draw all that has arrived; whether anything had."""
        arrived = []
        while self._inbox:
            arrived.append(self._inbox.popleft())
        # Stable: each key stays in order, and its blocks come together. Events first: they tell of the hammer.
        arrived.sort(key=lambda item: (item[0] != wire.EVENTS, item[0]))
        for key, items in groupby(arrived, key=lambda item: item[0]):
            payloads = [payload for _, payload in items]
            if key == wire.EVENTS:
                self._draw_events(payloads)
            elif key in self._groups or key == _CONTACT:
                self._draw_blocks(key, payloads)
        return bool(arrived)

    def _draw_events(self, payloads: list[bytes]) -> None:
        for payload in payloads:
            try:
                event = wire.decode_document(payload)
                self._painter.add_event(event)
            except (ValueError, TypeError, json.JSONDecodeError):
                self.malformed += 1
                continue
            if event.get("event") == "end":
                self._end = str(event.get("reason", "no reason given"))

    def _draw_blocks(self, key: str, payloads: list[bytes]) -> None:
        schema = wire.schema_of(key)
        run: list[wire.Block] = []
        for payload in payloads:
            try:
                block = wire.decode_block(payload, schema or "")
            except (ValueError, KeyError):
                self.malformed += 1
                continue
            gap = self._continuity.follow(key, block.index, len(block.values))
            if gap is not None:
                self._draw_run(key, run)
                run = []
                if gap.size > 0 and key in self._groups:
                    self._painter.note(
                        float(block.times_s[0]),
                        f"{gap.size} rows of {self._groups[key]} did not reach the viewer (a recording may have them)",
                        level="WARN",
                    )
            run.append(block)
        self._draw_run(key, run)
        if key in self._groups and not self._stalled:
            self._painter.frame(self._groups[key])

    def _draw_run(self, key: str, run: list[wire.Block]) -> None:
        """Draw consecutive blocks."""
        if not run:
            return
        if key == self._beat_key:
            self._received_index = run[-1].index + len(run[-1].values)
        if self._stalled:
            self.skipped += sum(len(block.values) for block in run) if key in self._groups else 0
            return
        values = np.concatenate([block.values for block in run])
        ticks_a_row = run[0].tick_rate_hz / run[0].rate_hz
        times_s = (run[0].tick + ticks_a_row * np.arange(len(values))) / run[0].tick_rate_hz
        if key == _CONTACT:
            if self._force_column is not None and values.shape[1] > self._force_column:
                self._painter.add_truth(times_s, values[:, self._force_column])
            return
        name = self._groups[key]
        group = self._table.groups[name]
        if values.shape[1] != len(group.channels):
            self.malformed += len(run)
            return
        if key == self._beat_key:
            self._canvas.clock.mark(float(times_s[-1]), self._wall())
        self._painter.add(name, times_s, group.engineering(values))
