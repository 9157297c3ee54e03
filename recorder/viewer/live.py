"""A running rig on a canvas, as a guest that the rig never waits for."""

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
from recorder.viewer.pace import CURVES_S, FASTEST_S, POINTS, Pace
from recorder.viewer.painter import Painter
from rig.base import wire
from rig.base.text import printable
from rig.channels.table import ChannelTable
from rig.serve.stream_check import Catalogue, Intake, event_in
from rig.serve.transport import Client
from rig.serve.transport.clients import Reporter

NAME = "viewer"
ROWS_PER_S = 500.0
"""Points of each curve per simulated second [Hz]; full rate around hammer pulses."""
_TICK_S = FASTEST_S
_HEARTBEAT_S = 0.5
_INBOX = 4000
_OLDEST_S = 1.5
"""How many payloads wait at most, and for how long [s]; then the oldest go."""
_QUIET_S = 0.3
_GONE_S = 3.0
"""How long a rig that is gone may take to be there again [s]: a viewer that was stopped is linked again in a second."""
_CHECK_S = 1.0
_PATIENCE_S = 0.3
_NOTED_S = 10.0
_CONTACT = wire.truth_key("contact")


@dataclass(frozen=True, slots=True)
class Described:
    """What a rig says of itself, as far as it is drawn.

    Attributes:
        catalogue: Its streams.
        geometry: Its lengths.
        contact_columns: Column names of its truth table of the contact; empty if it has none.
    """

    catalogue: Catalogue
    geometry: Geometry
    contact_columns: tuple[str, ...]

    @property
    def table(self) -> ChannelTable:
        """Its channels."""
        return self.catalogue.table


def ask(client: Client) -> Described:
    """Ask the rig that a client is connected to.

    Args:
        client: The rig.

    Raises:
        NoReplyError: No rig answers.
        InputError: What answers is no rig of this version.
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
    """Draws a rig's streams from now on until they end."""

    def __init__(
        self,
        client: Client,
        canvas: Canvas,
        described: Described,
        *,
        wall: Callable[[], float] = time.time,
        taken: Callable[[], int | None] | None = None,
    ) -> None:
        """Prepare the canvas; nothing is received before `run`.

        Args:
            client: The rig.
            canvas: Where to draw.
            described: What the rig says of itself.
            wall: The wall clock [s since 1970].
            taken: Number of the latest picture that the viewer has taken in, or None if nobody looks; without it
                pictures are not counted and nothing is thinned for a viewer.
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
        self._taken = taken
        self._pace = None if taken is None else Pace()
        self._curves_s = self._folded_s = self._noted_s = -math.inf
        self._noted_every_s = FASTEST_S
        self._fresh = False
        self._missing: dict[str, int] = {}
        self._inbox: deque[tuple[float, str, bytes]] = deque(maxlen=_INBOX)
        self._intake = Intake(described.catalogue)
        self._continuity = wire.Continuity()
        self._received_index = 0
        self._there: bool | None = None
        self._gone_at_s = 0.0
        self.ended: str | None = None
        """Why the run ended, as the rig states it; None before."""
        self._stalled = False
        self.failed = False
        """Whether the run failed, or the rig went without an end."""
        self._malformed = 0
        self.skipped = 0
        """Sensor rows that arrived and were not drawn, because the viewer's window did not take them."""
        self._oldest_s = 0.0
        self.waits_s = 0.0
        """How long what came waits on our side [s]: for us to take it, and for the viewer's server to have it."""

    @property
    def malformed(self) -> int:
        """Payloads that were not what their key and the rig's catalogue promise."""
        return self._malformed + self._intake.refused

    @property
    def received(self) -> int:
        """Sensor rows that arrived."""
        return sum(rows for key, rows in self._continuity.received.items() if key in self._groups)

    @property
    def lost(self) -> int:
        """Sensor rows that did not arrive: the viewer takes what it gets."""
        return sum(rows for key, rows in self._continuity.lost.items() if key in self._groups)

    def run(self, *, stop: Callable[[], bool] = lambda: False, tell: Callable[[str], None] = lambda text: None) -> str:
        """Draw until the rig ends, is gone, or `stop` says so.

        Args:
            stop: Asked again and again.
            tell: Is told every second how it goes.

        Returns:
            Why it ended, in one line.
        """
        self._client.subscribe(f"{wire.SENSORS}/*", self.take, lossless=False)
        if self._force_column is not None:
            self._client.subscribe(_CONTACT, self.take, lossless=False)
        # Events are few: those from before we came are fetched.
        self._client.subscribe(wire.EVENTS, self.take, history=True)
        self._client.watch(wire.ALIVE, self._watch)
        try:
            return self._draw_on(stop, tell)
        finally:
            self._report(done=True)

    def _draw_on(self, stop: Callable[[], bool], tell: Callable[[str], None]) -> str:
        heard_s, beat_s, check_s = time.monotonic(), 0.0, 0.0
        while True:
            now_s = time.monotonic()
            if self.take_in():
                heard_s = now_s
            if self._pace is not None and self._taken is not None:
                self._pace.taken_in(self._taken(), now_s=now_s)
            if self._pace is None or self._pace.due(now_s):
                self._draw(now_s)
            elif now_s - self._folded_s >= CURVES_S:
                self._painter.fold(most=POINTS)
                self._folded_s = now_s
            if now_s - check_s >= _CHECK_S:
                self._check_canvas()
                if self._pace is not None:
                    self._tell_pace(self._pace, now_s, tell)
                check_s = now_s
            if now_s - beat_s >= _HEARTBEAT_S:
                self._report()
                beat_s = now_s
            reason = self._reason(now_s, heard_s) or ("the viewer was closed" if stop() else None)
            if reason is not None:
                if self.ended is None:
                    self._painter.note(self._painter.now_s, reason, level="WARN")
                self._painter.close()
                return reason
            # An absolute grid is not needed here: a late picture is only late.
            time.sleep(max(0.0, _TICK_S - (time.monotonic() - now_s)))

    def _reason(self, now_s: float, heard_s: float) -> str | None:
        if now_s - heard_s < _QUIET_S:
            return None
        if self.ended is not None:
            self.failed = self.ended.startswith("failed")
            return f"the rig ended: {self.ended}"
        if self._there is False and now_s - self._gone_at_s > _GONE_S:
            self.failed = True
            return "the rig is gone without ending its stream (killed, or the connection broke)"
        return None

    def take(self, key: str, payload: bytes) -> None:
        """Take a payload, from any thread."""
        self._inbox.append((time.monotonic(), key, payload))

    def _watch(self, there: bool) -> None:
        self._gone_at_s = time.monotonic()
        self._there = there

    def _report(self, *, done: bool = False) -> None:
        self._reporter.tell(self._received_index, lost=self.lost, done=done)

    def _check_canvas(self) -> None:
        """Stop drawing for a viewer that takes nothing, or memory would fill with what it still has to get."""
        begin_s = time.monotonic()
        stalled = not self._canvas.keeps_up(timeout_s=_PATIENCE_S)
        self.waits_s, self._oldest_s = self._oldest_s + time.monotonic() - begin_s, 0.0
        if self._stalled and not stalled:
            text = f"the viewer took nothing for a while: {self.skipped} rows in all were not drawn"
            self._painter.note(self._painter.now_s, text, level="WARN")
        self._stalled = stalled

    def _draw(self, now_s: float) -> None:
        """Draw a picture of the latest instant, and the curves until then."""
        if self._stalled or not self._fresh:
            return
        if self._pace is not None:
            self._canvas.picture += 1
            self._pace.drew(self._canvas.picture, now_s=now_s)
        for name in self._groups.values():
            self._painter.frame(name)
        if now_s - self._curves_s >= CURVES_S - 1e-6:
            self._painter.flush(most=None if self._pace is None else POINTS)
            self._curves_s = now_s
        self._fresh = False
        if self._missing:
            rows = ", ".join(f"{rows} rows of {name}" for name, rows in self._missing.items())
            text = f"{rows} did not reach the viewer (a recording may have them)"
            self._painter.note(self._painter.now_s, text, level="WARN")
            self._missing = {}

    def _tell_pace(self, pace: Pace, now_s: float, tell: Callable[[str], None]) -> None:
        """Say how far the viewer is behind and what is left out; in the log of events, too, if that has changed."""
        every_s, behind_s = max(pace.every_s, pace.interval_s), pace.behind_s(now_s)
        who = "viewer loading" if pace.looked_at else "no viewer looks"
        if behind_s is not None:
            who = f"viewer {behind_s:.1f} s behind"
        points = min(ROWS_PER_S, POINTS / max(every_s, CURVES_S))
        thinned = f"{1.0 / every_s:.1f} of {1.0 / FASTEST_S:.0f} pictures/s, {points:.0f} of {ROWS_PER_S:.0f} points/s"
        tell(f"{who}, {thinned}; {self.waits_s:.2f} s here")
        changed = not 0.4 < every_s / self._noted_every_s < 2.5
        if changed and behind_s is not None and now_s - self._noted_s >= _NOTED_S:
            self._noted_s, self._noted_every_s = now_s, every_s
            level = "INFO" if points == ROWS_PER_S else "WARN"
            self._painter.note(self._painter.now_s, f"{who}, so it gets {thinned} a curve; peaks stay", level=level)

    def take_in(self) -> bool:
        """Take all that has arrived; whether anything had."""
        arrived: list[tuple[str, bytes]] = []
        now_s = time.monotonic()
        while self._inbox:
            came_s, key, payload = self._inbox.popleft()
            if key == wire.EVENTS or now_s - came_s < _OLDEST_S:
                self._oldest_s = max(self._oldest_s, now_s - came_s)
                arrived.append((key, payload))
        # Stable: each key stays in order, and its blocks come together. Events first: they announce hammer pulses.
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
                event = event_in(payload)
            except ValueError:
                self._malformed += 1
                continue
            self._painter.add_event(event)
            if event["event"] == "end":
                self.ended = printable(event.get("reason") or "no reason given", 500)

    def _take_blocks(self, key: str, payloads: list[bytes]) -> None:
        taken = []
        for payload in payloads:
            try:
                taken += self._intake.take(key, payload)
            except ValueError:
                self._malformed += 1
        run: list[wire.Block] = []
        for _, block, *_ in taken:
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
        """Take consecutive blocks."""
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
