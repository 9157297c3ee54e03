"""Live drawing of a running rig. The viewer is a client that the rig never waits for."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from recorder.viewer.canvas import Canvas
from recorder.viewer.drawings.geometry import Geometry
from recorder.viewer.pace import CURVE_INTERVAL_S, MAX_POINTS, MIN_INTERVAL_S, Pace
from recorder.viewer.painter import Painter
from rig.base import wire
from rig.base.text import printable
from rig.channels.table import ChannelTable
from rig.serve.stream_check import BlockValidator, Catalogue, parse_event
from rig.serve.transport import Client
from rig.serve.transport.clients import Reporter

NAME = "viewer"
ROWS_PER_S = 500.0
"""Points of each curve per simulated second [Hz], except for full rate around hammer pulses."""
SAVING_INTERVAL_S = 1.0
"""Time over which data are written to a file together [s]: a longer one needs more memory, a shorter one more disk."""
_TICK_S = MIN_INTERVAL_S
_HEARTBEAT_INTERVAL_S = 0.5
_MAX_WAITING = 4000
"""Largest number of waiting payloads; beyond it, the oldest are dropped."""
_MAX_AGE_S = 1.5
"""Longest time that a payload waits before it is dropped [s]."""
_END_SILENCE_S = 0.3
"""Silence after which the end of a run is final [s]."""
_RETURN_S = 3.0
"""Time that a lost rig may take to return [s]; a suspended viewer has its link again within a second."""
_CHECK_INTERVAL_S = 1.0
"""Interval of the checks whether the viewer receives data [s]."""
_CHECK_TIMEOUT_S = 0.3
"""Longest wait for the viewer in such a check [s]."""
_NOTE_INTERVAL_S = 10.0
"""Shortest interval between two notes about the pace [s]."""
_CONTACT = wire.truth_key("contact")


@dataclass(frozen=True, slots=True)
class Described:
    """Description of a rig, as needed for drawing.

    Attributes:
        catalogue: Declared streams.
        geometry: Lengths.
        contact_columns: Column names of the truth table `contact`; empty if the rig has none.
    """

    catalogue: Catalogue
    geometry: Geometry
    contact_columns: tuple[str, ...]

    @property
    def table(self) -> ChannelTable:
        """Channel table."""
        return self.catalogue.table


def request_document(client: Client) -> Described:
    """Request the description of a rig.

    Args:
        client: Connection to the rig.

    Raises:
        NoReplyError: No rig replies.
        InputError: The reply does not come from a rig of this version.
    """
    catalogue = Catalogue.read(wire.decode_document(client.request(wire.CATALOGUE)))
    parameters = wire.decode_document(client.request(wire.PARAMETERS))
    contact = catalogue.truth.get("contact")
    return Described(
        catalogue=catalogue,
        geometry=Geometry.from_parameters(parameters),
        contact_columns=() if contact is None else tuple(str(column.get("name")) for column in contact.columns),
    )


class LiveView:
    """View of a rig's streams from now until they end."""

    def __init__(
        self,
        client: Client,
        canvas: Canvas,
        described: Described,
        *,
        wall: Callable[[], float] = time.time,
        get_processed: Callable[[], int | None] | None = None,
        interval_s: float = CURVE_INTERVAL_S,
    ) -> None:
        """Prepare the canvas without receiving anything yet.

        Args:
            client: Connection to the rig.
            canvas: Canvas to draw on.
            described: Description of the rig.
            wall: Wall clock [unix s].
            get_processed: Returns the number of the latest picture that the viewer has processed, or None if no viewer
                is open. Without this function, pictures are not counted and curves are not thinned for the viewer.
            interval_s: Interval at which curves are drawn; for a file, `SAVING_INTERVAL_S` [s].
        """
        self._client = client
        self._reporter = Reporter(client, NAME)
        self._canvas = canvas
        self._table = described.table
        self._wall = wall
        self._painter = Painter(canvas, described.table, described.geometry, rows_per_s=ROWS_PER_S, whole=False)
        self._groups = {wire.sensor_key(name): name for name in described.table.groups}
        self._beat_key = next(iter(self._groups), "")
        columns = described.contact_columns
        self._force_column = columns.index("normal_force") if "normal_force" in columns else None
        self._get_processed = get_processed
        self._pace = None if get_processed is None else Pace()
        self._interval_s = interval_s
        self._curves_s = self._folded_s = self._noted_s = -math.inf
        self._noted_every_s = MIN_INTERVAL_S
        self._fresh = False
        self._missing: dict[str, int] = {}
        self._inbox: deque[tuple[float, str, bytes]] = deque(maxlen=_MAX_WAITING)
        self._validator = BlockValidator(described.catalogue)
        self._continuity = wire.Continuity()
        self._received_index = 0
        self._alive: bool | None = None
        self._lost_at_s = 0.0
        self.ended: str | None = None
        """Reason for the end of the run, as stated by the rig; None before."""
        self._stalled = False
        self.failed = False
        """True if the run failed, or the rig disappeared without an end event."""
        self._malformed = 0
        self.skipped = 0
        """Sensor rows received but not drawn, because the viewer's window did not accept them."""
        self._oldest_s = 0.0
        self.waits_s = 0.0
        """Delay of the data in this process [s]: in the inbox, and until the viewer's server has them."""

    @property
    def malformed(self) -> int:
        """Number of payloads that do not fit the format of their key or the catalogue."""
        return self._malformed + self._validator.refused

    @property
    def received(self) -> int:
        """Number of sensor rows received."""
        return sum(rows for key, rows in self._continuity.received.items() if key in self._groups)

    @property
    def lost(self) -> int:
        """Number of sensor rows lost; the viewer does not request lost data again."""
        return sum(rows for key, rows in self._continuity.lost.items() if key in self._groups)

    def run(
        self, *, stop: Callable[[], bool] = lambda: False, on_message: Callable[[str], None] = lambda text: None
    ) -> str:
        """Draw until the rig ends or disappears, or until `stop` returns True.

        Args:
            stop: Polled in each cycle.
            on_message: Receives a progress message every second.

        Returns:
            The reason for the end, in one line.
        """
        self._client.subscribe(f"{wire.SENSORS}/*", self.take, lossless=False)
        if self._force_column is not None:
            self._client.subscribe(_CONTACT, self.take, lossless=False)
        # Events are few, so earlier ones are fetched as well.
        self._client.subscribe(wire.EVENTS, self.take, history=True)
        self._client.watch(wire.ALIVE, self._watch)
        try:
            return self._draw_until_end(stop, on_message)
        finally:
            self._report(done=True)

    def _draw_until_end(self, stop: Callable[[], bool], on_message: Callable[[str], None]) -> str:
        received_s, heartbeat_s, check_s = time.monotonic(), 0.0, 0.0
        while True:
            now_s = time.monotonic()
            if self.take_in():
                received_s = now_s
            if self._pace is not None and self._get_processed is not None:
                self._pace.record_displayed(self._get_processed(), now_s=now_s)
            if self._pace is None or self._pace.due(now_s):
                self._draw(now_s)
            elif now_s - self._folded_s >= self._interval_s:
                self._painter.fold(most=MAX_POINTS)
                self._folded_s = now_s
            if now_s - check_s >= max(_CHECK_INTERVAL_S, self._interval_s):
                self._check_canvas()
                if self._pace is not None:
                    self._report_pace(self._pace, now_s, on_message)
                check_s = now_s
            if now_s - heartbeat_s >= _HEARTBEAT_INTERVAL_S:
                self._report()
                heartbeat_s = now_s
            reason = self._reason(now_s, received_s) or ("the viewer was closed" if stop() else None)
            if reason is not None:
                if self.ended is None:
                    self._painter.note(self._painter.now_s, reason, level="WARN")
                self._painter.close()
                return reason
            # A late picture does no harm, so no absolute schedule is needed.
            time.sleep(max(0.0, _TICK_S - (time.monotonic() - now_s)))

    def _reason(self, now_s: float, received_s: float) -> str | None:
        if now_s - received_s < _END_SILENCE_S:
            return None
        if self.ended is not None:
            self.failed = self.ended.startswith("failed")
            return f"the rig ended: {self.ended}"
        if self._alive is False and now_s - self._lost_at_s > _RETURN_S:
            self.failed = True
            return "the rig disappeared without ending its stream (killed, or connection lost)"
        return None

    def take(self, key: str, payload: bytes) -> None:
        """Queue a payload. Safe to call from any thread."""
        self._inbox.append((time.monotonic(), key, payload))

    def _watch(self, alive: bool) -> None:
        self._lost_at_s = time.monotonic()
        self._alive = alive

    def _report(self, *, done: bool = False) -> None:
        self._reporter.send(self._received_index, lost=self.lost, done=done)

    def _check_canvas(self) -> None:
        """Stop drawing for a viewer that accepts no data, so that memory does not fill up."""
        begin_s = time.monotonic()
        stalled = not self._canvas.keeps_up(timeout_s=_CHECK_TIMEOUT_S)
        self.waits_s, self._oldest_s = self._oldest_s + time.monotonic() - begin_s, 0.0
        if self._stalled and not stalled:
            text = f"the viewer did not accept data for a while: {self.skipped} rows in total were not drawn"
            self._painter.note(self._painter.now_s, text, level="WARN")
        self._stalled = stalled

    def _draw(self, now_s: float) -> None:
        """Draw a picture of the latest instant, and the curves up to it."""
        if self._stalled or not self._fresh:
            return
        if self._pace is not None:
            self._canvas.picture += 1
            self._pace.record_drawn(self._canvas.picture, now_s=now_s)
        for name in self._groups.values():
            self._painter.frame(name)
        if now_s - self._curves_s >= self._interval_s - 1e-6:
            self._painter.flush(most=None if self._pace is None else MAX_POINTS)
            self._curves_s = now_s
        self._fresh = False
        if self._missing:
            rows = ", ".join(f"{rows} rows of {name}" for name, rows in self._missing.items())
            text = f"{rows} did not reach the viewer (a recording may have them)"
            self._painter.note(self._painter.now_s, text, level="WARN")
            self._missing = {}

    def _report_pace(self, pace: Pace, now_s: float, on_message: Callable[[str], None]) -> None:
        """Report the viewer's delay and the thinning; if they changed, also in the event log."""
        every_s, behind_s = max(pace.every_s, pace.interval_s), pace.behind_s(now_s)
        state = "viewer loading" if pace.is_viewed else "no viewer open"
        if behind_s is not None:
            state = f"viewer late by {behind_s:.1f} s"
        points = min(ROWS_PER_S, MAX_POINTS / max(every_s, CURVE_INTERVAL_S))
        rates = f"{1 / every_s:.1f} of {1 / MIN_INTERVAL_S:.0f} pictures/s, {points:.0f} of {ROWS_PER_S:.0f} points/s"
        on_message(f"{state}, {rates}; {self.waits_s:.2f} s here")
        changed = not 0.4 < every_s / self._noted_every_s < 2.5
        if changed and behind_s is not None and now_s - self._noted_s >= _NOTE_INTERVAL_S:
            self._noted_s, self._noted_every_s = now_s, every_s
            level = "INFO" if points == ROWS_PER_S else "WARN"
            self._painter.note(self._painter.now_s, f"{state}, reduced to {rates} a curve; peaks are kept", level=level)

    def take_in(self) -> bool:
        """Process all queued payloads and return whether there were any."""
        arrived: list[tuple[str, bytes]] = []
        now_s = time.monotonic()
        while self._inbox:
            arrival_s, key, payload = self._inbox.popleft()
            if key == wire.EVENTS or now_s - arrival_s < _MAX_AGE_S:
                self._oldest_s = max(self._oldest_s, now_s - arrival_s)
                arrived.append((key, payload))
        # Events first, as they announce hammer pulses. The sort is stable, so each key stays in order.
        arrived.sort(key=lambda item: (item[0] != wire.EVENTS, item[0]))
        for key, items in groupby(arrived, key=lambda item: item[0]):
            payloads = [payload for _, payload in items]
            if key == wire.EVENTS:
                self._take_events(payloads)
            elif key in self._groups or key == _CONTACT:
                self._take_blocks(key, payloads)
        return bool(arrived)

    def _take_events(self, payloads: list[bytes]) -> None:
        for payload in payloads:
            try:
                event = parse_event(payload)
            except ValueError:
                self._malformed += 1
                continue
            self._painter.add_event(event)
            if event["event"] == "end":
                self.ended = printable(event.get("reason") or "no reason given", 500)

    def _take_blocks(self, key: str, payloads: list[bytes]) -> None:
        blocks = []
        for payload in payloads:
            try:
                blocks += self._validator.take(key, payload)
            except ValueError:
                self._malformed += 1
        run: list[wire.Block] = []
        for _, block, *_ in blocks:
            gap = self._continuity.follow(key, block.index, len(block.values))
            if gap is not None:
                self._take_run(key, run)
                run = []
                if gap.size > 0 and key in self._groups:
                    name = self._groups[key]
                    self._missing[name] = self._missing.get(name, 0) + gap.size
            run.append(block)
        self._take_run(key, run)

    def _take_run(self, key: str, run: list[wire.Block]) -> None:
        """Process consecutive blocks."""
        if not run:
            return
        if key == self._beat_key:
            self._received_index = run[-1].index + len(run[-1].values)
        if self._stalled:
            self.skipped += sum(len(block.values) for block in run) if key in self._groups else 0
            return
        self._fresh = True
        values = np.concatenate([block.values for block in run])
        ticks_a_row = run[0].tick_rate_hz / run[0].rate_hz
        times_s = (run[0].tick + ticks_a_row * np.arange(len(values))) / run[0].tick_rate_hz
        if key == _CONTACT:
            if self._force_column is not None:
                self._painter.add_truth(times_s, values[:, self._force_column])
            return
        name = self._groups[key]
        group = self._table.groups[name]
        if key == self._beat_key:
            self._canvas.clock.mark(float(times_s[-1]), self._wall())
        self._painter.add(name, times_s, group.engineering(values))
