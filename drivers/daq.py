"""DAQ client: selected channels of a rig, aligned by sample number, in engineering units.

    with Daq.open("zenoh:127.0.0.1:7460", channels=["disk_x", "P_N"]) as daq:
        for samples in daq.blocks(2000):
            print(samples.times_s[0], samples.gap, samples["P_N"].max())

Data can be read by an iterator (`blocks`), by a callback (`call`) or with asyncio (`async for samples in
daq.ablocks(2000)`).
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from drivers.link import LinkTimeoutError
from drivers.sources import Source, open_source
from drivers.sources.samples import RowBuffer, RowReader, Samples, StreamEndedError, follow
from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.files import Closing
from rig.base.wire import Continuity, Gap
from rig.serve.transport import RigLostError

_MAX_GAPS = 1000
"""Number of gaps that are kept in detail; all are counted."""


class Aligner:
    """Merges the rows of several streams by their number; does no input or output itself.

    Args:
        columns: Columns to take from each stream.
        order: Position of each of these columns in the merged row, stream after stream.
        room: Largest number of rows of a stream that wait for the other streams; the oldest are dropped.
    """

    def __init__(self, columns: Mapping[str, Sequence[int]], order: Sequence[int], room: int) -> None:
        self._columns = {name: list(chosen) for name, chosen in columns.items()}
        self._order = np.argsort(order)
        self._room = room
        self._rows = Continuity()
        self._waiting: dict[str, deque[Samples]] = {name: deque() for name in columns}
        self._merged_rows = Continuity()
        self.gaps: deque[Gap] = deque(maxlen=_MAX_GAPS)
        self.unmatched = 0
        """Rows dropped because the row of another stream was missing."""

    @property
    def lost(self) -> dict[str, int]:
        """Missing rows of each stream."""
        return {name: self._rows.lost.get(name, 0) for name in self._columns}

    def feed(self, stream: str, samples: Samples) -> list[Samples]:
        """Add rows of one stream, and return the rows that are now complete."""
        runs = self._runs(stream)
        new = follow(self._rows, samples, stream)
        if new is None:
            return []
        if new.gap:
            self.gaps.append(Gap(stream, new.index - new.gap, new.gap))
        waiting = self._waiting[stream]
        if self._runs(stream) != runs:
            waiting.clear()
        waiting.append(new)
        surplus = sum(map(len, waiting)) - self._room
        while surplus > 0 and len(waiting) > 1:
            surplus -= len(waiting[0])
            self.unmatched += len(waiting.popleft())
        return self._complete()

    def _runs(self, stream: str) -> int:
        return self._rows.runs.get(stream, 0)

    def _complete(self) -> list[Samples]:
        complete = []
        # Row numbers of different runs do not match: wait until every stream has reached the newest run.
        newest = max(map(self._runs, self._columns))
        for name, waiting in self._waiting.items():
            if self._runs(name) < newest:
                waiting.clear()
        while all(self._waiting.values()):
            start = max(waiting[0].index for waiting in self._waiting.values())
            for waiting in self._waiting.values():
                self._trim(waiting, start)
            if not all(self._waiting.values()):
                break
            heads = {name: waiting[0] for name, waiting in self._waiting.items()}
            if any(head.index != start for head in heads.values()):
                continue
            rows = min(map(len, heads.values()))
            complete.append(self._merge(heads, rows))
            for waiting in self._waiting.values():
                self._trim(waiting, start + rows)
        return complete

    @staticmethod
    def _trim(waiting: deque[Samples], start: int) -> None:
        """Drop the rows before a number."""
        while waiting and waiting[0].index + len(waiting[0]) <= start:
            waiting.popleft()
        if waiting and waiting[0].index < start:
            waiting[0] = waiting[0].rows(start - waiting[0].index, len(waiting[0]))

    def _merge(self, heads: dict[str, Samples], rows: int) -> Samples:
        first = next(iter(heads.values()))
        chosen = [heads[name].values[:rows, columns] for name, columns in self._columns.items()]
        names = [heads[name].names[n] for name, columns in self._columns.items() for n in columns]
        units = [heads[name].units[n] for name, columns in self._columns.items() for n in columns]
        merged = replace(
            first,
            names=tuple(names[n] for n in self._order),
            units=tuple(units[n] for n in self._order),
            values=np.concatenate(chosen, axis=1)[:, self._order],
            gap=0,
        )
        new_rows = follow(self._merged_rows, merged)
        assert new_rows is not None
        return new_rows


class Daq(RowReader, Closing):
    """Reader of selected channels: blocks without gaps inside, with the number of samples missing before each.

    Args:
        source: Source of the samples; `close` closes it too.
        channels: Names of the channels, in the order of the columns; by default all of the source.
        rate_hz: Sample rate [Hz]: the source's own rate (default) divided by a whole number. Samples are decimated
            without a filter.
        buffer_s: Size of the buffer for unread samples [s], and for samples of a stream that wait for another stream.
            When it is full, the oldest samples are dropped and counted.

    Raises:
        InputError: The source has no such channel or rate.

    Example:
        With a rig that runs: `Daq.open("zenoh:127.0.0.1:7462", channels=["P_E"])`. Here with a stand-in source:

        >>> class Rows:
        ...     def streams(self):
        ...         return {"forces": ["P_E", "P_N"]}
        ...     def start(self, streams, rate_hz, on_samples, on_end):
        ...         self.on_samples, self.on_end = on_samples, on_end
        ...         return 1000.0
        ...     def report_position(self, index, *, room, lost): ...
        ...     def close(self): ...
        >>> source = Rows()
        >>> with Daq(source, channels=["P_N"]) as daq:
        ...     values = np.array([[3000.0, 2990.0], [3001.0, 2991.0], [3002.0, 2992.0]])
        ...     source.on_samples("forces", Samples(0, 0, 1000.0, 1e6, ("P_E", "P_N"), ("N", "N"), values))
        ...     source.on_end("forces", "completed")
        ...     for samples in daq.blocks(2):
        ...         print(samples.times_s, samples["P_N"], samples.unit("P_N"), samples.gap)
        [0.    0.001] [2990. 2991.] N 0
        [0.002] [2992.] N 0
    """

    def __init__(
        self,
        source: Source,
        *,
        channels: Sequence[str] | None = None,
        rate_hz: float | None = None,
        buffer_s: float = 10.0,
    ) -> None:
        super().__init__("daq")
        self._source = source
        self._wakers: set[Callable[[], None]] = set()
        self._closed = False
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None
        available = source.streams()
        stream_of_channel = {channel: name for name, names in available.items() for channel in names}
        self.channels = tuple(stream_of_channel if channels is None else channels)
        if not self.channels or len(set(self.channels)) != len(self.channels):
            raise InputError("channels", "at least one, each once", list(self.channels))
        for channel in self.channels:
            if channel not in stream_of_channel:
                raise UnknownNameError("channel", "one of the source's", channel, stream_of_channel)
        wanted = {name: [channel for channel in names if channel in self.channels] for name, names in available.items()}
        wanted = {name: chosen for name, chosen in wanted.items() if chosen}
        columns = {name: [list(available[name]).index(channel) for channel in wanted[name]] for name in wanted}
        order = [self.channels.index(channel) for chosen in wanted.values() for channel in chosen]
        self._running = set(wanted)
        self._has_samples = False
        self._early: list[tuple[str, Samples]] | None = []
        # Samples that arrive before the rate is known wait in `_early`.
        self.rate_hz = source.start(list(wanted), rate_hz, self._on_samples, self._on_end)
        self._room = max(1, round(buffer_s * self.rate_hz))
        with self._changed:
            self._aligner = Aligner(columns, order, self._room)
            self._buffer = RowBuffer(self._room)
            # Report that this client listens: a replay may wait for it.
            source.report_position(None, room=self._room, lost=0)
            early, self._early = self._early or [], None
            for name, samples in early:
                self._feed(name, samples)

    @classmethod
    def open(
        cls,
        url: str,
        *,
        channels: Sequence[str] | None = None,
        rate_hz: float | None = None,
        buffer_s: float = 10.0,
        wait_s: float = 3.0,
    ) -> Self:
        """Connect to the source at a URL.

        Args:
            url: `zenoh:127.0.0.1:7460`, or `can:zenoh:can0` for a CAN bus.
            channels: Names of the channels, in the order of the columns; by default all of the source.
            rate_hz: Sample rate [Hz]; by default the source's own rate.
            buffer_s: Size of the buffer for unread samples [s].
            wait_s: Longest wait for a rig to reply [s].

        Raises:
            InputError: The URL is malformed, or the source has no such channel or rate.
            ConnectionError: No rig replies.
        """
        source = open_source(url, wait_s=wait_s)
        try:
            return cls(source, channels=channels, rate_hz=rate_hz, buffer_s=buffer_s)
        except BaseException:
            source.close()
            raise

    @property
    def ended(self) -> str | None:
        """Reason for the end of the stream, or None; samples that have arrived can still be read."""
        return self._ended

    @property
    def dropped(self) -> int:
        """Samples dropped because they were not read in time."""
        return self._buffer.dropped

    @property
    def unmatched(self) -> int:
        """Samples dropped because the sample of another stream was missing."""
        return self._aligner.unmatched

    @property
    def lost(self) -> dict[str, int]:
        """Missing samples of each stream."""
        return self._aligner.lost

    @property
    def gaps(self) -> list[Gap]:
        """The most recent gaps, with their streams."""
        with self._changed:
            return list(self._aligner.gaps)

    def __iter__(self) -> Iterator[Samples]:
        return self.blocks()

    def call(self, function: Callable[[Samples], object], *, rows: int | None = None) -> None:
        """Call a function with each block, on a separate thread; a slow function loses samples, which are counted.

        Args:
            function: Called with the samples of each block.
            rows: Samples per block; by default all that have arrived.

        Raises:
            InputError: A function was given before.
        """
        if self._thread is not None:
            raise InputError("call", "made once", Words("a second function"))

        def loop() -> None:
            while True:
                try:
                    samples = self.read(rows, timeout_s=1.0)
                except LinkTimeoutError:
                    continue
                except StreamEndedError:
                    return
                except RigLostError as error:
                    self._error = error
                    return
                try:
                    function(samples)
                except BaseException as error:
                    self._error = error
                    return

        self._thread = threading.Thread(target=loop, name="daq calls", daemon=True)
        self._thread.start()

    def wait(self, *, timeout_s: float | None = None) -> bool:
        """Wait until `call` has passed on all samples of a stream that has ended.

        Args:
            timeout_s: Longest wait [s]; by default no limit.

        Returns:
            Whether all samples were passed on in time.

        Raises:
            BaseException: The function's exception, which ended the calls; RigLostError: the rig was lost.
        """
        if self._thread is None:
            raise InputError("wait", "called after call", Words("no function"))
        self._thread.join(timeout_s)
        if self._error is not None:
            raise self._error
        return not self._thread.is_alive()

    async def aread(self, rows: int | None = None, *, timeout_s: float = 5.0) -> Samples:
        """Read samples with asyncio; arguments and errors as for `read`."""
        import asyncio

        self._check(rows)
        loop, event = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            loop.call_soon_threadsafe(event.set)

        with self._changed:
            self._wakers.add(wake)
        try:
            async with asyncio.timeout(timeout_s):
                while True:
                    event.clear()
                    with self._changed:
                        if (ready := self._take(rows)) is not None:
                            return ready
                    await event.wait()
        except TimeoutError:
            raise self._timeout_error(rows, timeout_s) from None
        finally:
            with self._changed:
                self._wakers.discard(wake)

    async def ablocks(self, rows: int | None = None, *, timeout_s: float = 5.0) -> AsyncIterator[Samples]:
        """Yield blocks to the end of the stream, with asyncio."""
        while True:
            try:
                samples = await self.aread(rows, timeout_s=timeout_s)
            except StreamEndedError:
                return
            yield samples

    def __aiter__(self) -> AsyncIterator[Samples]:
        return self.ablocks()

    def _take(self, rows: int | None, *, whole: bool = True) -> Samples | None:
        """Return the rows that are ready; the caller holds the lock."""
        if self._closed:
            raise StreamEndedError("the client was closed")
        ready = super()._take(rows, whole=whole)
        if ready is not None:
            lost = sum(self._aligner.lost.values())
            self._source.report_position(self._position(ready), room=self._room, lost=lost)
        return ready

    def _position(self, ready: Samples) -> int:
        """Return the row of the source that follows rows which were read."""
        return ready.index + len(ready)

    def _on_samples(self, stream: str, samples: Samples) -> None:
        with self._changed:
            if self._early is not None:
                self._early.append((stream, samples))
                return
            self._feed(stream, samples)

    def _feed(self, stream: str, samples: Samples) -> None:
        if self._ended is not None:
            return
        if not self._has_samples:
            # Positions are reported relative to the first sample.
            self._has_samples = True
            self._source.report_position(samples.index, room=self._room, lost=0)
        complete = self._aligner.feed(stream, samples)
        for merged in complete:
            self._add(merged)
        if complete:
            self._notify()

    def _add(self, samples: Samples) -> None:
        """Put complete rows into the buffer."""
        self._buffer.add(samples)

    def _on_end(self, stream: str, reason: str) -> None:
        with self._changed:
            self._running.discard(stream)
            if not self._running and self._ended is None:
                self._ended = reason
                self._notify()

    def _notify(self) -> None:
        self._changed.notify_all()
        for wake in self._wakers:
            wake()

    def close(self) -> None:
        """Close the source; further calls have no effect."""
        with self._changed:
            self._closed = True
            self._notify()
        self._source.close()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)
