"""Client of one rig: commands, channel data, events and shaft turns, in real time or in lockstep.

    import rig

    with rig.connect(channels=["disk_x", "disk_y", "keyphasor"]) as machine:
        machine.hammer(force_n=120.0)
        hit = machine.until(lambda samples: np.hypot(samples["disk_x"], samples["disk_y"]) > 1.2, within_s=2.0)
        print(hit.time_s, machine.event("hammer")["tick"])

Reading is continuous: each call returns the samples that follow those of the previous call. All times are simulated
times, exact to the sample. A rig in lockstep is stepped as far as a call needs, so a program receives the same samples
however loaded the computer is.
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
from drivers.sources.samples import ALL_AVAILABLE, RIG_LOST, RowReader, Samples, StreamEndedError, follow, merge_samples
from drivers.sources.stream import RigStream
from drivers.sources.turns import Turn, find_pulses, measure_turn
from rig.base import wire
from rig.base.errors import InputError, RefusedError, UnknownNameError, Words
from rig.channels.orbit import PULSE_LEVEL
from rig.serve.stream_check import BlockEnd, Catalogue, parse_block_end
from rig.serve.transport import DEFAULT_ENDPOINT, Client, RigLostError
from rig.serve.waiting import Deadline

_SILENCE_S = 10.0
"""Longest silence of a rig that runs in real time [s]."""
_DONE_TIMEOUT_S = 120.0
"""Longest wait of a device for the devices before it, in order of name, to finish a block [s]. Zenoh reserves 1 kB for
each request during this time: 50 MB at 400 requests per second."""
_ARRIVAL_S = 2.0
"""Wait for samples of a finished block before they count as lost [s]."""
_END_POLL_S = 0.2
"""Period of the check for the end of the run while waiting for a block [s]; the end event may be lost."""


class NotSeenError(TimeoutError):
    """The event or condition waited for did not occur; the message gives the period that was searched."""


@dataclass(frozen=True, slots=True)
class Row:
    """The samples of all channels at one time, at which a condition was met.

    Attributes:
        time_s: Simulated time [s].
        tick: Simulated time, rounded [ticks].
        index: Sample number at the rate of the client.
        values: Value of each channel, in the channel's unit.
    """

    time_s: float
    tick: int
    index: int
    values: dict[str, float]


class Rig(Console):
    """Client of one rig: the commands of `Console`, and the rig's samples and events.

    Args:
        client: Transport to the rig; `close` closes it too.
        channels: Channels to read, from now on; without channels the client has commands and events only.
        rate_hz: Sample rate [Hz]: the channels' own rate (default) divided by a whole number.
        buffer_s: Size of the buffer for unread samples [s]. When it is full, the oldest samples are dropped, and the
            next ones report the gap.
        truth: Tables of noise-free model quantities to read as well, such as `contact`. None by default, as a
            device under test must not see them.
        name: Name of this client in the stream's events.
        source: Source of the samples; by default the rig's own keys.

    Raises:
        ConnectionError: No rig replies.
        InputError: The rig has no such channel, rate or table.

    Example:
        Capture 0.2 s from a hammer impact on, of a rig that runs:

            with rig.connect(channels=["hammer", "disk_x"], rate_hz=10_000) as machine:
                machine.hammer(force_n=120.0, duration_ms=2.0)
                machine.until(lambda samples: samples["hammer"] > 5.0, within_s=1.0)
                response = machine.advance(0.2)
                print(response.times_s, response["disk_x"], response.unit("disk_x"))
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
        """Pace of the rig: real-time, lockstep or free."""
        catalogue = Catalogue.read(document)
        self._tick_rate_hz = catalogue.tick_rate_hz
        self._block_ticks = round(1e-3 * (status["block_ms"] or 0.0) * catalogue.tick_rate_hz)
        self._is_stepper = self.pace == "lockstep" and self._block_ticks > 0
        """Whether this client steps the rig; over CAN a rig in lockstep cannot be stepped."""
        self._at_tick: int = status["tick"]
        """Tick to which this client has stepped a rig in lockstep."""
        self.lost: dict[str, str] = {}
        """Devices under test that the rig removed while this client stepped it, with the reason."""
        self._block_ends: queue.SimpleQueue[BlockEnd | None] | None = None
        """Ends of blocks, from the first call of `blocks` in lockstep; None makes the reader check whether the run has
        ended."""
        self._is_joined, self._removal = False, ""
        """State as a device under test: whether the rig waits for it, and the reason if the rig removed it."""
        self._events: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._other_events: list[dict[str, Any]] = []
        stream = RigStream(client, on_event=self._on_event)
        self._truth: dict[str, RowReader] = {}
        for table in truth:
            tables = document.get("truth", {})
            if table not in tables:
                raise UnknownNameError("truth", "one of the rig's tables", table, tables)
            self._truth[table] = _read_truth(stream, table, tables[table]["columns"])
        self._daq: Daq | None = None
        if channels:
            source = source or RigSource(client, stream=stream)
            try:
                self._daq = Daq(source, channels=channels, rate_hz=rate_hz, buffer_s=buffer_s)
            except BaseException:
                source.close()
                raise
        self._max_read_rows = max(1, round(0.5 * buffer_s * self.daq.rate_hz)) if channels else 0
        self._unread: Samples | None = None
        """Samples that were read but not yet returned."""
        self._next_row = math.ceil(self._at_tick * self.daq.rate_hz / self._tick_rate_hz) if channels else 0
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
        """Connect to the rig at a URL, as `Daq.open` does; close the client, or use it as a context manager.

        Raises:
            InputError: The URL is malformed, or the rig has no such channel or rate.
            ConnectionError: No rig replies.
        """
        arguments: dict[str, Any] = {"channels": channels, "rate_hz": rate_hz, "buffer_s": buffer_s}
        if url.startswith("can:"):
            from drivers.sources.can_client import CanClient

            if truth:
                raise InputError("truth", "left out over CAN, which cannot carry it", list(truth))
            client = CanClient(url.removeprefix("can:"), wait_s=wait_s)
            arguments |= {"name": f"CAN {client.node}", "source": client.source}
        else:
            from rig.serve.transport.zenoh import connect_url

            client = connect_url(url, wait_s=wait_s)
            arguments |= {"name": name, "truth": truth}
        try:
            return cls(client, **arguments)
        except BaseException:
            client.close()
            raise

    def close(self) -> None:
        """Disconnect; the rig continues."""
        self._leave_lockstep()
        if self._daq is not None:
            self._daq.close()
        super().close()

    # ---- samples ----

    @property
    def daq(self) -> Daq:
        """The DAQ client that reads the channels, with its rate and its counts of lost samples.

        Raises:
            InputError: The client was opened without channels.
        """
        if self._daq is None:
            raise InputError("channels", "given to rig.connect", Words("none"))
        return self._daq

    def advance(self, duration_s: float) -> Samples:
        """Return the samples of the next `duration_s`; a rig in lockstep is stepped through this time.

        Fewer samples are returned where a gap follows them; the next samples report it.

        Args:
            duration_s: Simulated time [s], at least one sample.

        Raises:
            InputError: The duration is not a number, or shorter than one sample.
            NotSeenError: The rig sent nothing for 10 s.
            StreamEndedError: The run has ended.
            RigLostError: The rig was lost.
        """
        rows = round(duration_s * self.daq.rate_hz) if 0.0 < duration_s < math.inf else 0
        if rows < 1:
            raise InputError("duration_s", f"at least one sample, {1.0 / self.daq.rate_hz:g} s", duration_s)
        return self._read_rows(rows)

    def until(self, condition: Callable[[Samples], Any], *, within_s: float, piece_s: float | None = None) -> Row:
        """Read to the first sample that meets a condition; the samples after it remain to be read.

        Args:
            condition: Function of samples that returns whether each meets the condition, a boolean array of shape
                (rows,).
                It is called for pieces of the data in order, once for each sample.
            within_s: Simulated time to search, from the next sample on [s].
            piece_s: Length of a piece [s]. A command that follows takes effect at the end of the piece. By default a
                piece is a block of a rig in lockstep, and 0.05 s of other rigs.

        Raises:
            InputError: The condition does not return one boolean per sample.
            NotSeenError: No sample met the condition in this time.
            StreamEndedError: The run ended first.
            RigLostError: The rig was lost.
        """
        rate = self.daq.rate_hz
        if not 0.0 < within_s < math.inf:
            raise InputError("within_s", "a time above 0", within_s)
        if piece_s is None:
            piece_s = self._block_ticks / self._tick_rate_hz if self._is_stepper else 0.05
        remaining, piece = max(1, round(within_s * rate)), max(1, round(piece_s * rate))
        first_s = last_s = None
        while remaining > 0:
            samples = self._read_rows(min(piece, remaining), whole=False)
            remaining -= len(samples)
            first_s = samples.times_s[0] if first_s is None else first_s
            last_s = samples.times_s[-1]
            met = np.asarray(condition(samples))
            if met.shape != (len(samples),) or met.dtype != bool:
                raise InputError(
                    "condition",
                    f"one boolean per sample, shape ({len(samples)},)",
                    Words(f"{met.dtype}, shape {met.shape}"),
                )
            if met.any():
                at = int(np.flatnonzero(met)[0])
                result = samples.rows(at, at + 1)
                self._put_back(samples.rows(at + 1, len(samples)))
                values = {name: float(result[name][0]) for name in result.names}
                return Row(float(result.times_s[0]), result.tick, result.index, values)
        raise NotSeenError(f"no sample met the condition from {first_s:.6f} to {last_s:.6f} s")

    def turns(self, *, timeout_s: float = 60.0) -> Iterator[Turn]:
        """Yield one `Turn` for each revolution of the shaft, with the values of a machinery protection monitor.

        Stops at the end of the run.

        Args:
            timeout_s: Longest simulated time without a keyphasor pulse [s].

        Raises:
            InputError: The keyphasor is not among the channels, or the rate is too low for its pulse.
            NotSeenError: No pulse came.
            RigLostError: The rig was lost.
        """
        daq = self.daq
        if "keyphasor" not in daq.channels:
            raise InputError("channels", "with the keyphasor, whose pulses delimit the turns", list(daq.channels))
        piece, max_rows = max(1, round(0.1 * daq.rate_hz)), round(timeout_s * daq.rate_hz)
        window, sent = None, 0
        try:
            while True:
                fresh = self._read_rows(piece, whole=False)
                follows = window is not None and fresh.index == window.index + len(window)
                window, sent = (merge_samples(window, fresh), sent) if window is not None and follows else (fresh, 0)
                edges_s = find_pulses(window)
                high = window["keyphasor"] >= PULSE_LEVEL
                if (high[1:-1] & ~high[:-2] & ~high[2:]).any():
                    raise InputError("rate_hz", "high enough for two samples per keyphasor pulse", daq.rate_hz)
                for begin_s, end_s in pairwise(edges_s):
                    sent = int(np.searchsorted(window.times_s, end_s))
                    yield measure_turn(window, begin_s, end_s)
                if len(edges_s):
                    first_row = max(0, int(np.searchsorted(window.times_s, edges_s[-1])) - 1)
                    window, sent = window.rows(first_row, len(window)), max(0, sent - first_row)
                if len(window) > max_rows:
                    begin_s, end_s = window.times_s[[0, -1]]
                    raise NotSeenError(f"no keyphasor pulse from {begin_s:.6f} to {end_s:.6f} s")
        except StreamEndedError:
            return
        finally:
            # The samples after the last yielded turn are for the next call.
            if window is not None:
                self._put_back(window.rows(sent, len(window)))

    def blocks(self, *, patience_s: float = 10.0) -> Iterator[Samples]:
        """Yield the samples of each block, to the end of the run: the main loop of a device under test.

        In lockstep the rig waits for this client as for a device `name`, and continues when the loop requests the next
        block: a command sent before takes effect at the end of the block, however loaded the computer is. The client
        does not step the rig; the test bench does. Missing samples split a block, and the samples after them report the
        gap.

        Args:
            patience_s: Longest time that the rig waits for this client [s of wall time].

        Raises:
            InputError: The client was opened without channels.
            RefusedError: The rig has removed this device, for the reason in the message.
            NotSeenError: A rig that is not in lockstep sent nothing for 10 s.
            RigLostError: The rig was lost.
        """
        daq = self.daq
        if self.pace == "lockstep":
            yield from self._yield_lockstep_blocks(patience_s)
        while self.pace != "lockstep":
            try:
                yield daq.read(timeout_s=_SILENCE_S)
            except LinkTimeoutError as error:
                raise NotSeenError(f"the rig sent no samples: {error}") from error
            except StreamEndedError:
                return

    def _yield_lockstep_blocks(self, patience_s: float) -> Iterator[Samples]:
        """Join, and report each block as done when the next one is requested."""
        if self._block_ends is None:
            self._block_ends = queue.SimpleQueue()
            self._client.subscribe(wire.BLOCK, self._on_block_end)
            self._client.settle()
        self._removal = ""
        begin, self._is_joined = self.join(patience_s=patience_s).tick, True
        usual_timeout_s, self._timeout_s = self._timeout_s, _DONE_TIMEOUT_S if self._is_stepper else self._timeout_s
        try:
            while (end := self._wait_for_block_end(self._block_ends)) is not None:
                if end.tick > begin:
                    deadline = Deadline(_ARRIVAL_S)
                    for key, number in end.messages.items():
                        self._client.wait_for(key, number, timeout_s=deadline.left_s)
                    yield from self.daq.ready()
                    self.done(end.tick)
        except RefusedError as error:
            if wire.ENDED not in str(error):
                raise
        except ConnectionError:
            if (reason := self.daq.ended) is None or reason.startswith(RIG_LOST):
                raise
        finally:
            self._timeout_s = usual_timeout_s
            self._leave_lockstep()

    def _wait_for_block_end(self, ends: queue.SimpleQueue[BlockEnd | None]) -> BlockEnd | None:
        """Return the end of the next block; None at that of the run.

        Raises:
            RefusedError: The rig removed the device.
            RigLostError: The rig was lost.
        """
        while True:
            with contextlib.suppress(queue.Empty):
                if (end := ends.get(timeout=_END_POLL_S)) is not None:
                    return end
            if self._removal:
                raise RefusedError(f"the rig has removed {self._name}: {self._removal}")
            if (reason := self.daq.ended) is not None:
                if reason.startswith(RIG_LOST):
                    raise RigLostError(reason)
                return None

    def _on_block_end(self, _: str, payload: bytes) -> None:
        assert self._block_ends is not None
        with contextlib.suppress(ValueError):
            self._block_ends.put(parse_block_end(payload))

    def _leave_lockstep(self) -> None:
        """Leave the rig if it may wait for this device."""
        was_joined, self._is_joined = self._is_joined, False
        if was_joined:
            with contextlib.suppress(RefusedError, ConnectionError):
                self.leave()

    def _read_rows(self, rows: int, *, whole: bool = True) -> Samples:
        """Return the next rows, after stepping a rig in lockstep to them; fewer at a gap, or unless `whole`."""
        daq = self.daq
        rows_read, self._unread = self._unread, None
        if rows_read is not None and len(rows_read) >= rows:
            self._put_back(rows_read.rows(rows, len(rows_read)))
            return rows_read.rows(0, rows)
        deadline = Deadline(_SILENCE_S)
        while rows_read is None or (whole and len(rows_read) < rows):
            # At most as many at a time as the buffer holds.
            missing = min(rows - (0 if rows_read is None else len(rows_read)), self._max_read_rows)
            refused = self._step_to(self._next_row + missing)
            try:
                fresh = daq.read(missing, timeout_s=_ARRIVAL_S if self._is_stepper and refused is None else _SILENCE_S)
            except LinkTimeoutError as error:
                if refused is not None or not self._is_stepper or deadline.passed:
                    raise refused or NotSeenError(f"the rig sent no samples: {error}") from error
                # Samples that were published and have not arrived are lost; the next ones report the gap.
                self._next_row = max(self._next_row + 1, math.floor(self._at_tick * daq.rate_hz / self._tick_rate_hz))
                continue
            self._next_row = fresh.index + len(fresh)
            if rows_read is not None and fresh.gap:
                self._put_back(fresh)
                return rows_read
            rows_read = fresh if rows_read is None else merge_samples(rows_read, fresh)
        return rows_read

    def _step_to(self, row: int) -> RefusedError | None:
        """Step a rig in lockstep until it has published all rows before `row`, and no further.

        Returns:
            The refusal, if any; at the end of a run the reader sees the end of the stream instead.
        """
        ticks = row * self._tick_rate_hz / self.daq.rate_hz - self._at_tick
        if self._is_stepper and ticks > 0.0:
            try:
                self._step(ticks)
            except RefusedError as error:
                return error
        return None

    def _step(self, ticks: float) -> None:
        """Step by at least `ticks`, in whole blocks."""
        whole = math.ceil(ticks / self._block_ticks - 1e-9) * self._block_ticks
        reply = self.step(whole)
        self._at_tick = reply.tick
        self.lost |= reply.lost

    def _put_back(self, samples: Samples) -> None:
        self._unread = samples if len(samples) else None

    # ---- events ----

    def event(self, what: str | Callable[[dict[str, Any]], bool], *, timeout_s: float = 10.0) -> dict[str, Any]:
        """Return the next event of a kind since the connection or since the event that the previous call returned.

        Args:
            what: Name of the event, or a function that returns whether an event matches.
            timeout_s: Longest wait [s of wall time].

        Raises:
            NotSeenError: No such event came.
            RigLostError: The rig was lost.
        """
        wanted = (lambda event: event["event"] == what) if isinstance(what, str) else what
        deadline = Deadline(timeout_s)
        for place, event in enumerate(self._other_events):
            if wanted(event):
                return self._other_events.pop(place)
        while True:
            try:
                event = self._events.get(timeout=deadline.left_s)
            except queue.Empty:
                self._check_rig()
                if self._daq is not None and (self._daq.ended or "").startswith(RIG_LOST):
                    raise RigLostError(RIG_LOST) from None
                others = ", ".join(dict.fromkeys(event["event"] for event in self._other_events)) or "none"
                raise NotSeenError(f"no such event in {timeout_s:g} s; received instead: {others}") from None
            if wanted(event):
                return event
            self._other_events.append(event)

    def _on_event(self, event: dict[str, Any]) -> None:
        if self._rig is not None and self._client.rig not in (None, self._rig):
            return  # of the rig that runs there now
        self._events.put(event)
        if event["event"] == "device" and event.get("device") == self._name:
            lost = event.get("state") == "lost"
            self._removal = str(event.get("reason", "not done in time, or with another block")) if lost else ""
        if self._block_ends is not None and (self._removal or event["event"] == "end"):
            self._block_ends.put(None)

    # ---- truth tables ----

    def truth(self, table: str, *, to_s: float | None = None, timeout_s: float = 10.0) -> Samples:
        """Return the rows of a truth table, in SI units, since the connection or since the previous call.

        A gap ends the returned rows; `gap` of the next ones is the number of missing rows.

        Args:
            table: A table named in `truth` when connecting.
            to_s: Simulated time to wait for [s]; a rig in lockstep is stepped to it.
            timeout_s: Longest wait [s of wall time].

        Raises:
            InputError: The table was not named when connecting.
            NotSeenError: The rows did not come in time.
        """
        if table not in self._truth:
            raise UnknownNameError("table", "a table named in `truth` of rig.connect", table, self._truth)
        deadline, reader = Deadline(timeout_s), self._truth[table]
        result: Samples | None = None
        while result is None or (to_s is not None and result.times_s[-1] + 1.0 / result.rate_hz < to_s - 1e-9):
            if to_s is not None and self._is_stepper and to_s * self._tick_rate_hz > self._at_tick:
                self._step(to_s * self._tick_rate_hz - self._at_tick)
            try:
                fresh = reader.read(ALL_AVAILABLE, timeout_s=deadline.left_s, whole=False)
            except LinkTimeoutError:
                raise NotSeenError(f"no rows of the truth table {table} came in {timeout_s:g} s") from None
            if result is not None and fresh.gap:
                reader.put_back(fresh)
                break
            result = fresh if result is None else merge_samples(result, fresh)
        return result


def _read_truth(stream: RigStream, table: str, columns: Sequence[dict[str, str]]) -> RowReader:
    """Subscribe to a truth table with these columns, and return its reader."""
    names, units = tuple(one["name"] for one in columns), tuple(one["unit"] for one in columns)
    reader, rows = RowReader(f"truth of {table}"), wire.Continuity()

    def take(block: wire.Block) -> None:
        if (new := follow(rows, Samples.from_block(block, names, units, block.values))) is not None:
            reader.add(new)

    stream.listen(wire.truth_key(table), take, lambda _: None)
    return reader


def connect(
    url: str = "zenoh:" + DEFAULT_ENDPOINT, *, channels: Sequence[str] = (), wait_s: float = 3.0, **settings: Any
) -> Rig:
    """Connect to a running rig.

    Args:
        url: `HOST:PORT` or `zenoh:HOST:PORT`, with `?tls=DIR` for a rig served with TLS; the name of a rig on this
            computer; or `can:INTERFACE:CHANNEL[?NAME=VALUE&...]`, with `node=N` for the node number of a device under
            test. Over CAN the commands, events and channels are those of the bus, and the client's name is `CAN N`.
        channels: Channels to read, from now on.
        wait_s: Longest wait for a rig to reply [s].
        settings: Further arguments of `Rig`: `rate_hz` [Hz], `buffer_s` [s], `truth`, `name`.

    Returns:
        The client; close it, or use it as a context manager.

    Raises:
        InputError: The URL is malformed, or the rig has no such channel, rate or table.
        ConnectionError: No rig replies.

    Example:
        With a rig that runs: `with rig.connect(channels=["disk_x"]) as machine`.

        >>> connect("can:zenoh:can0", truth=["contact"])
        Traceback (most recent call last):
        rig.base.errors.InputError: truth must be left out over CAN, which cannot carry it; received ['contact']
    """
    return Rig.open(url, channels=channels, wait_s=wait_s, **settings)
