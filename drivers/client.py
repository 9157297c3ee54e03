"""One client of a rig: its commands, its channels as they come, its events and its turns, in real time or in lockstep.

    import rig

    with rig.connect(channels=["disk_x", "disk_y", "keyphasor"]) as machine:
        machine.hammer(force_n=120.0)
        hit = machine.until(lambda samples: np.hypot(samples["disk_x"], samples["disk_y"]) > 1.2, within_s=2.0)
        print(hit.time_s, machine.event("hammer")["tick"])

What is read goes on from row to row: each call takes up where the last one ended, and times are simulated ones, exact
to the row. A rig in lockstep is stepped as far as a call needs: the same program has the same rows, however loaded the
machine is.
"""

from __future__ import annotations

import contextlib
import math
import queue
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np

from drivers.console import Console
from drivers.daq import Daq
from drivers.link import LinkTimeoutError
from drivers.sources import Source
from drivers.sources.rig import RigSource
from drivers.sources.samples import ALL, RowReader, Samples, StreamEndedError, follow, joined
from drivers.sources.stream import RigStream
from drivers.sources.turns import HALF, Turn, edges, turn_in
from rig.base import wire
from rig.base.errors import InputError, RefusedError, UnknownNameError, Words
from rig.serve.stream_check import BlockEnd, Catalogue, block_end_in, event_in
from rig.serve.transport import DEFAULT_ENDPOINT, Client
from rig.serve.waiting import Deadline

_PATIENCE_S = 10.0
"""How long a rig that runs may send nothing [s]."""
_TURN_S = 120.0
"""How long a device may wait for those before it by name to be done with a block [s]: zenoh keeps a kB of each request
for as long as the request might have taken, 50 MB of 400 a second."""
_LOST_S = 2.0
"""Rows of a block that is over are there, or lost [s]."""
_LOOK_S = 0.2
"""Period of the check for the end of the run while the client waits for a block [s]: its event may be lost."""


class NotSeenError(TimeoutError):
    """What was waited for did not come; the message says until when."""


@dataclass(frozen=True, slots=True)
class Row:
    """One row that met a condition.

    Attributes:
        time_s: Its simulated time [s].
        tick: The same, to the nearest [ticks].
        index: Its number at the rate that is read.
        values: Of each channel, in its unit.
    """

    time_s: float
    tick: int
    index: int
    values: dict[str, float]


class Rig(Console):
    """One rig, for one program: what `Console` commands, and what comes back.

    Args:
        client: Transport to the rig; closed with this.
        channels: Channels that are read, from now on; none: none, and commands and events alone.
        rate_hz: Rows per second [Hz]: a whole fraction of the channels' own, which is taken unless given.
        buffer_s: Rows that wait to be read [s]; beyond, the oldest are dropped, and the next rows tell of the gap.
        truth: Tables of the truth that come too, such as `contact`: a device under test must not see it, and so none
            comes unasked.
        name: Who asks; appears in the stream's events.
        source: Where the rows come from; the rig's own keys unless given.

    Raises:
        ConnectionError: No rig answers.
        InputError: There is no such channel, rate or table.
    """

    def __init__(
        self,
        client: Client,
        *,
        channels: Sequence[str] = (),
        rate_hz: float | None = None,
        buffer_s: float = 60.0,
        truth: Sequence[str] = (),
        name: str | None = None,
        source: Source | None = None,
    ) -> None:
        super().__init__(client, name=name)
        if isinstance(channels, str):
            raise InputError("channels", "a list of names", channels)
        if not buffer_s > 0.0:
            raise InputError("buffer_s", "greater than 0", buffer_s)
        status, document = self.status(), wire.decode_document(client.request(wire.CATALOGUE))
        self.pace: str = status["pace"]
        """real-time, lockstep or free."""
        catalogue = Catalogue.read(document)
        self._tick_rate_hz = catalogue.tick_rate_hz
        self._block_ticks = round(1e-3 * (status["block_ms"] or 0.0) * catalogue.tick_rate_hz)
        self._steps = self.pace == "lockstep" and self._block_ticks > 0
        """Over CAN a rig in lockstep cannot be stepped."""
        self._at: int = status["tick"]
        """Up to where a rig in lockstep was stepped [ticks]."""
        self.lost: dict[str, str] = {}
        """Devices under test that were put out while this client stepped the rig, with the reason."""
        self._ends: queue.SimpleQueue[BlockEnd | None] | None = None
        """Ends of blocks, from the first call of `blocks` in lockstep on; None: look why none comes."""
        self._joined, self._put_out = False, ""
        """State as a device under test: whether the rig waits for it, and the reason if the rig removed it."""
        self._events: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._seen: list[dict[str, Any]] = []
        client.subscribe(wire.EVENTS, self._on_event)
        self._truth: dict[str, RowReader] = {}
        stream = RigStream(client)
        for table in truth:
            known = document.get("truth", {})
            if table not in known:
                raise UnknownNameError("truth", "one of the rig's tables", table, known)
            self._truth[table] = _read_truth(stream, table, known[table]["columns"])
        self._daq: Daq | None = None
        if channels:
            source = source or RigSource(client)
            try:
                self._daq = Daq(source, channels=channels, rate_hz=rate_hz, buffer_s=buffer_s)
            except BaseException:
                source.close()
                raise
        self._room = max(1, round(0.5 * buffer_s * self.daq.rate_hz)) if channels else 0
        self._back: Samples | None = None
        """Rows that were read, and not taken."""
        self._next = math.ceil(self._at * self.daq.rate_hz / self._tick_rate_hz) if channels else 0
        client.settle()

    @classmethod
    def open(
        cls,
        url: str = "zenoh:" + DEFAULT_ENDPOINT,
        *,
        channels: Sequence[str] = (),
        rate_hz: float | None = None,
        buffer_s: float = 60.0,
        truth: Sequence[str] = (),
        name: str | None = None,
        wait_s: float = 3.0,
    ) -> Self:
        """The rig at a URL, as for `Daq.open`; close it, or use it as a context manager.

        Raises:
            InputError: The URL is malformed, or there is no such channel or rate.
            ConnectionError: Nothing is there.
        """
        given: dict[str, Any] = {"channels": channels, "rate_hz": rate_hz, "buffer_s": buffer_s}
        if url.startswith("can:"):
            from drivers.sources.can_client import CanClient

            if truth:
                raise InputError("truth", "left out over CAN: a bus carries none", list(truth))
            client = CanClient(url.removeprefix("can:"), wait_s=wait_s)
            given |= {"name": f"CAN {client.node}", "source": client.source}
        else:
            from rig.serve.transport.zenoh import client_of

            client = client_of(url, wait_s=wait_s)
            given |= {"name": name, "truth": truth}
        try:
            return cls(client, **given)
        except BaseException:
            client.close()
            raise

    def close(self) -> None:
        """End, and leave the rig running."""
        self._part()
        if self._daq is not None:
            self._daq.close()
        super().close()

    # ---- rows ----

    @property
    def daq(self) -> Daq:
        """What reads the channels: its losses, its rate.

        Raises:
            InputError: The client was opened without channels.
        """
        if self._daq is None:
            raise InputError("channels", "named where the rig is connected to", Words("none"))
        return self._daq

    def advance(self, duration_s: float) -> Samples:
        """Let the rig go on, and take the rows of that time: of real time when it comes, of lockstep at once.

        Fewer come where rows were lost behind them: the next ones tell of the gap.

        Raises:
            InputError: No time above 0 with a row in it.
            NotSeenError: The rig sent nothing for long.
            StreamEndedError: The run is over.
        """
        rows = round(duration_s * self.daq.rate_hz) if 0.0 < duration_s < math.inf else 0
        if rows < 1:
            raise InputError("duration_s", f"at least a row, {1.0 / self.daq.rate_hz:g} s", duration_s)
        return self._take(rows)

    def until(self, condition: Callable[[Samples], Any], *, within_s: float, piece_s: float = 0.05) -> Row:
        """Read to the first row that meets a condition; the rows behind it stay to be read.

        Args:
            condition: Given rows, whether each meets it, shape (rows,); rows come in pieces, each row once.
            within_s: In how much simulated time from the next row on [s].
            piece_s: Length of a piece [s].

        Raises:
            InputError: What the condition returns is no truth of each row.
            NotSeenError: No row met it.
            StreamEndedError: The run was over before.
        """
        rate = self.daq.rate_hz
        if not 0.0 < within_s < math.inf:
            raise InputError("within_s", "a time above 0", within_s)
        left, piece = max(1, round(within_s * rate)), max(1, round(piece_s * rate))
        first_s = last_s = None
        while left > 0:
            samples = self._take(min(piece, left), whole=False)
            left -= len(samples)
            first_s = samples.times_s[0] if first_s is None else first_s
            last_s = samples.times_s[-1]
            met = np.asarray(condition(samples))
            if met.shape != (len(samples),) or met.dtype != bool:
                raise InputError(
                    "condition",
                    f"one truth value a row, shape ({len(samples)},)",
                    Words(f"{met.dtype}, shape {met.shape}"),
                )
            if met.any():
                at = int(np.flatnonzero(met)[0])
                found = samples.rows(at, at + 1)
                self._give_back(samples.rows(at + 1, len(samples)))
                values = {name: float(found[name][0]) for name in found.names}
                return Row(float(found.times_s[0]), found.tick, found.index, values)
        raise NotSeenError(f"no row met the condition from {first_s:.6f} to {last_s:.6f} s")

    def turns(self, *, timeout_s: float = 60.0) -> Iterator[Turn]:
        """Whole turns of the shaft, one by one, with what machinery protection shows of each; to the end of the run.

        Args:
            timeout_s: Simulated time without a pulse that ends it [s].

        Raises:
            InputError: The channels are without the keyphasor.
            NotSeenError: No pulse came.
        """
        daq = self.daq
        if "keyphasor" not in daq.channels:
            raise InputError("channels", "with the keyphasor, which turns are told by", list(daq.channels))
        piece, most = max(1, round(0.1 * daq.rate_hz)), round(timeout_s * daq.rate_hz)
        held, told = None, 0
        try:
            while True:
                fresh = self._take(piece, whole=False)
                follows = held is not None and fresh.index == held.index + len(held)
                held, told = (joined(held, fresh), told) if held is not None and follows else (fresh, 0)
                edges_s = edges(held)
                high = held["keyphasor"] >= HALF
                if (high[1:-1] & ~high[:-2] & ~high[2:]).any():
                    raise InputError("rate_hz", "high enough for two rows in a pulse of the keyphasor", daq.rate_hz)
                for begin_s, end_s in pairwise(edges_s):
                    told = int(np.searchsorted(held.times_s, end_s))
                    yield turn_in(held, begin_s, end_s)
                if len(edges_s):
                    kept = max(0, int(np.searchsorted(held.times_s, edges_s[-1])) - 1)
                    held, told = held.rows(kept, len(held)), max(0, told - kept)
                if len(held) > most:
                    begin_s, end_s = held.times_s[[0, -1]]
                    raise NotSeenError(f"no pulse of the keyphasor from {begin_s:.6f} to {end_s:.6f} s")
        except StreamEndedError:
            return
        finally:
            # What is behind the last turn that was told is read by the next call.
            if held is not None:
                self._give_back(held.rows(told, len(held)))

    def blocks(self, *, patience_s: float = 10.0) -> Iterator[Samples]:
        """The rows of each block, to the end of the run: what a device under test is made of.

        A rig in lockstep is joined as the device `name`, and goes on when the loop asks for the next rows: a command
        that was sent before takes effect at the end of the block, however loaded the machine is. It is not stepped:
        that is for whoever tests the device. Rows that are missing part a block: the rows behind tell of the gap.

        Args:
            patience_s: How long the rig may wait for the device, wall time [s].

        Raises:
            InputError: The client was opened without channels.
            RefusedError: The rig waits for this device no longer, for the reason in the message.
            NotSeenError: The rig, which runs by itself, sent nothing for long.
        """
        daq = self.daq
        if self.pace == "lockstep":
            yield from self._blocks_done(patience_s)
        while self.pace != "lockstep":
            try:
                yield daq.read(timeout_s=_PATIENCE_S)
            except LinkTimeoutError as error:
                raise NotSeenError(f"the rig sent no rows: {error}") from error
            except StreamEndedError:
                return

    def _blocks_done(self, patience_s: float) -> Iterator[Samples]:
        """Join, and be done with each block when the next one is asked for."""
        if self._ends is None:
            self._ends = queue.SimpleQueue()
            self._client.subscribe(wire.BLOCK, self._on_block_end)
            self._client.settle()
        self._put_out = ""
        begin, self._joined = self.join(patience_s=patience_s).tick, True
        usual_s, self._timeout_s = self._timeout_s, _TURN_S if self._steps else self._timeout_s
        try:
            while (end := self._next_end(self._ends)) is not None:
                if end.tick > begin:
                    deadline = Deadline(_LOST_S)
                    for key, number in end.messages.items():
                        self._client.wait_for(key, number, timeout_s=deadline.left_s)
                    yield from self.daq.ready()
                    self.done(end.tick)
        except RefusedError as error:
            if wire.ENDED not in str(error):
                raise
        except ConnectionError:
            if self.daq.ended is None:
                raise
        finally:
            self._timeout_s = usual_s
            self._part()

    def _next_end(self, ends: queue.SimpleQueue[BlockEnd | None]) -> BlockEnd | None:
        """Return the end of the next block; None at that of the run.

        Raises:
            RefusedError: The rig removed the device.
        """
        while True:
            with contextlib.suppress(queue.Empty):
                if (end := ends.get(timeout=_LOOK_S)) is not None:
                    return end
            if self._put_out:
                raise RefusedError(f"the rig waits for {self._name} no longer: {self._put_out}")
            if self.daq.ended is not None:
                return None

    def _on_block_end(self, _: str, payload: bytes) -> None:
        assert self._ends is not None
        with contextlib.suppress(ValueError):
            self._ends.put(block_end_in(payload))

    def _part(self) -> None:
        """Leave, where the rig may wait for this device."""
        joined, self._joined = self._joined, False
        if joined:
            with contextlib.suppress(RefusedError, ConnectionError):
                self.leave()

    def _take(self, rows: int, *, whole: bool = True) -> Samples:
        """The next rows; of a rig in lockstep, stepped as far as that needs. Fewer where they need not be whole."""
        daq = self.daq
        taken, self._back = self._back, None
        if taken is not None and len(taken) >= rows:
            self._give_back(taken.rows(rows, len(taken)))
            return taken.rows(0, rows)
        deadline = Deadline(_PATIENCE_S)
        while taken is None or (whole and len(taken) < rows):
            # No more at a time than there is room for.
            missing = min(rows - (0 if taken is None else len(taken)), self._room)
            refused = self._step_to(self._next + missing)
            try:
                fresh = daq.read(missing, timeout_s=_LOST_S if self._steps and refused is None else _PATIENCE_S)
            except LinkTimeoutError as error:
                if refused is not None or not self._steps or deadline.passed:
                    raise refused or NotSeenError(f"the rig sent no rows: {error}") from error
                # What was published and has not come is lost: what comes behind it tells of the gap.
                self._next = max(self._next + 1, math.floor(self._at * daq.rate_hz / self._tick_rate_hz))
                continue
            self._next = fresh.index + len(fresh)
            if taken is not None and fresh.gap:
                self._give_back(fresh)
                return taken
            taken = fresh if taken is None else joined(taken, fresh)
        return taken

    def _step_to(self, row: int) -> RefusedError | None:
        """Step a rig in lockstep until the rows before one are made: no further, whatever has arrived.

        Returns:
            Why it refused: a run that is over tells that by its rows.
        """
        ticks = row * self._tick_rate_hz / self.daq.rate_hz - self._at
        if self._steps and ticks > 0.0:
            try:
                self._step(ticks)
            except RefusedError as error:
                return error
        return None

    def _step(self, ticks: float) -> None:
        """Step by whole blocks, so many ticks at least."""
        whole = math.ceil(ticks / self._block_ticks - 1e-9) * self._block_ticks
        taken = self.step(whole)
        self._at = taken.tick
        self.lost |= taken.lost

    def _give_back(self, samples: Samples) -> None:
        self._back = samples if len(samples) else None

    # ---- events ----

    def event(self, what: str | Callable[[dict[str, Any]], bool], *, timeout_s: float = 10.0) -> dict[str, Any]:
        """The next event of a kind since the rig was connected to, or since the last one that was asked for.

        Args:
            what: Its name, or what says whether it is the one.
            timeout_s: How long to wait for it [s].

        Raises:
            NotSeenError: It did not come.
        """
        wanted = (lambda event: event["event"] == what) if isinstance(what, str) else what
        deadline = Deadline(timeout_s)
        for place, event in enumerate(self._seen):
            if wanted(event):
                return self._seen.pop(place)
        while True:
            try:
                event = self._events.get(timeout=deadline.left_s)
            except queue.Empty:
                others = ", ".join(dict.fromkeys(event["event"] for event in self._seen)) or "none"
                raise NotSeenError(f"no such event in {timeout_s:g} s; what came: {others}") from None
            if wanted(event):
                return event
            self._seen.append(event)

    def _on_event(self, _: str, payload: bytes) -> None:
        with contextlib.suppress(ValueError):
            event = event_in(payload)
            self._events.put(event)
            if event["event"] == "device" and event.get("device") == self._name:
                lost = event.get("state") == "lost"
                self._put_out = str(event.get("reason", "not done in time, or with another block")) if lost else ""
            if self._ends is not None and (self._put_out or event["event"] == "end"):
                self._ends.put(None)

    # ---- the truth, by name ----

    def truth(self, table: str, *, to_s: float | None = None, timeout_s: float = 10.0) -> Samples:
        """Rows of a table of the truth, in SI, that came since the rig was connected to, or since the last call.

        Missing rows end a piece; `gap` of the next call's rows is their number.

        Args:
            table: One of those that were named when the rig was connected to.
            to_s: Wait until they reach this simulated time [s].
            timeout_s: How long [s].

        Raises:
            InputError: That table was not asked for.
            NotSeenError: They did not come in time.
        """
        if table not in self._truth:
            raise UnknownNameError(
                "table", "one that was named in `truth` when the rig was connected to", table, self._truth
            )
        deadline, made = Deadline(timeout_s), self._truth[table]
        found: Samples | None = None
        while found is None or (to_s is not None and found.times_s[-1] + 1.0 / found.rate_hz < to_s - 1e-9):
            if to_s is not None and self._steps and to_s * self._tick_rate_hz > self._at:
                self._step(to_s * self._tick_rate_hz - self._at)
            try:
                fresh = made.read(ALL, timeout_s=deadline.left_s, whole=False)
            except LinkTimeoutError:
                raise NotSeenError(f"no truth of {table} came in {timeout_s:g} s") from None
            if found is not None and fresh.gap:
                made.put_back(fresh)
                break
            found = fresh if found is None else joined(found, fresh)
        return found


def _read_truth(stream: RigStream, table: str, columns: Sequence[dict[str, str]]) -> RowReader:
    """Read a table of the truth, given its columns, from now on."""
    names, units = tuple(one["name"] for one in columns), tuple(one["unit"] for one in columns)
    made, rows = RowReader(f"truth of {table}"), wire.Continuity()

    def take(block: wire.Block) -> None:
        if (new := follow(rows, Samples.of(block, names, units))) is not None:
            made.add(new)

    stream.listen(wire.truth_key(table), take, lambda _: None)
    return made


def connect(
    url: str = "zenoh:" + DEFAULT_ENDPOINT, *, channels: Sequence[str] = (), wait_s: float = 3.0, **settings: Any
) -> Rig:
    """One client of a running rig: its commands, and what comes back.

    Args:
        url: `zenoh:HOST:PORT`, with `?tls=DIR` for a rig that is exposed, the name of a rig of this machine, or
            `can:INTERFACE:CHANNEL[?NAME=VALUE&...]`, with `node=N` for the number as a device under test: there
            commands, events and rows are those that frames carry, and the name is `CAN N`.
        channels: Channels that are read, from now on.
        wait_s: How long to wait for a rig to be there [s].
        settings: More of `Rig`: `rate_hz`, `buffer_s`, `truth`, `name`.

    Raises:
        InputError: The URL is malformed, or there is no such channel, rate or table.
        ConnectionError: Nothing is there.

    Example:
        Of a rig that runs: `with rig.connect(channels=["disk_x"]) as machine`.

        >>> connect("can:zenoh:can0", truth=["contact"])
        Traceback (most recent call last):
        rig.base.errors.InputError: truth must be left out over CAN: a bus carries none; instead received ['contact']
    """
    return Rig.open(url, channels=channels, wait_s=wait_s, **settings)
