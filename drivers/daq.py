"""The DAQ client: chosen channels of a rig, aligned on their sample number, in engineering units.

    with Daq.open("zenoh:127.0.0.1:7460", channels=["disk_x", "P_N"]) as daq:
        for samples in daq.blocks(2000):
            print(samples.times_s[0], samples.gap, samples["P_N"].max())

`blocks` is the iterator form, `call` the callback form, and `async for samples in daq.ablocks(2000)` the asyncio form.
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
from drivers.sources.samples import Pile, RowReader, Samples, StreamEndedError, follow
from rig.base.closeable import Closing
from rig.base.errors import InputError, UnknownNameError, Words
from rig.base.wire import Continuity, Gap

_GAPS = 1000
"""Gaps that are remembered; all are counted."""


class Aligner:
    """Makes rows of some streams one row, by their number; sans-IO.

    Args:
        columns: Which columns of each stream are wanted.
        order: Where each of these columns goes, stream after stream.
        room: Rows of a stream that wait for the others; beyond, the oldest go.
    """

    def __init__(self, columns: Mapping[str, Sequence[int]], order: Sequence[int], room: int) -> None:
        self._columns = {name: list(chosen) for name, chosen in columns.items()}
        self._order = np.argsort(order)
        self._room = room
        self._rows = Continuity()
        self._waiting: dict[str, deque[Samples]] = {name: deque() for name in columns}
        self._joint = Continuity()
        self.gaps: deque[Gap] = deque(maxlen=_GAPS)
        self.unmatched = 0
        """Rows that were dropped because those of another stream were not there."""

    @property
    def lost(self) -> dict[str, int]:
        """Rows of each stream that never came."""
        return {name: self._rows.lost.get(name, 0) for name in self._columns}

    def feed(self, stream: str, samples: Samples) -> list[Samples]:
        """Take rows of one stream; returns the rows that are complete now."""
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
        made = []
        # Numbers of different runs do not belong together: the streams that are behind must first have begun anew.
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
            made.append(self._join(heads, rows))
            for waiting in self._waiting.values():
                self._trim(waiting, start + rows)
        return made

    @staticmethod
    def _trim(waiting: deque[Samples], start: int) -> None:
        """Forget rows before a number."""
        while waiting and waiting[0].index + len(waiting[0]) <= start:
            waiting.popleft()
        if waiting and waiting[0].index < start:
            waiting[0] = waiting[0].rows(start - waiting[0].index, len(waiting[0]))

    def _join(self, heads: dict[str, Samples], rows: int) -> Samples:
        first = next(iter(heads.values()))
        chosen = [heads[name].values[:rows, columns] for name, columns in self._columns.items()]
        names = [heads[name].names[n] for name, columns in self._columns.items() for n in columns]
        units = [heads[name].units[n] for name, columns in self._columns.items() for n in columns]
        joint = replace(
            first,
            names=tuple(names[n] for n in self._order),
            units=tuple(units[n] for n in self._order),
            values=np.concatenate(chosen, axis=1)[:, self._order],
            gap=0,
        )
        followed = follow(self._joint, joint)
        assert followed is not None
        return followed


class Daq(RowReader, Closing):
    """Chosen channels as blocks without a gap inside; each tells how many rows are missing right before it.

    Args:
        source: Closed with this.
        channels: Names, which come in this order; all where none are given.
        rate_hz: Rows per second [Hz]: a whole fraction of what the source has; every n-th row is taken, without a
            further filter. None is the source's own.
        buffer_s: Rows that wait to be read, and rows of a stream that wait for those of another [s]; beyond, the oldest
            are dropped and counted.

    Raises:
        InputError: There is no such channel or rate.

    Example:
        Of a rig that runs: `Daq.open("zenoh:127.0.0.1:7462", channels=["P_E"])`. Here of a source of our own:

        >>> class Rows:
        ...     def streams(self):
        ...         return {"forces": ["P_E", "P_N"]}
        ...     def start(self, streams, rate_hz, on_samples, on_end):
        ...         self.on_samples, self.on_end = on_samples, on_end
        ...         return 1000.0
        ...     def taken(self, index, *, room, lost): ...
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
        home = {channel: name for name, names in available.items() for channel in names}
        self.channels = tuple(home if channels is None else channels)
        if not self.channels or len(set(self.channels)) != len(self.channels):
            raise InputError("channels", "at least one, each once", list(self.channels))
        for channel in self.channels:
            if channel not in home:
                raise UnknownNameError("channel", "one of the source's", channel, home)
        wanted = {name: [channel for channel in names if channel in self.channels] for name, names in available.items()}
        wanted = {name: chosen for name, chosen in wanted.items() if chosen}
        columns = {name: [list(available[name]).index(channel) for channel in wanted[name]] for name in wanted}
        order = [self.channels.index(channel) for chosen in wanted.values() for channel in chosen]
        self._running = set(wanted)
        self._begun = False
        self._early: list[tuple[str, Samples]] | None = []
        # What arrives before the rate is known waits.
        self.rate_hz = source.start(list(wanted), rate_hz, self._on_samples, self._on_end)
        self._room = max(1, round(buffer_s * self.rate_hz))
        with self._changed:
            self._aligner = Aligner(columns, order, self._room)
            self._pile = Pile(self._room)
            # It listens now: a replay may wait for that.
            source.taken(None, room=self._room, lost=0)
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
        """Channels at a URL: `zenoh:127.0.0.1:7460` or `can:zenoh:can0`; waits for a rig to be there.

        Raises:
            InputError: The URL is malformed, or there is no such channel or rate.
            ConnectionError: Nothing is there.
        """
        source = open_source(url, wait_s=wait_s)
        try:
            return cls(source, channels=channels, rate_hz=rate_hz, buffer_s=buffer_s)
        except BaseException:
            source.close()
            raise

    @property
    def ended(self) -> str | None:
        """Why nothing more comes, once that is so; what has come can still be read."""
        return self._ended

    @property
    def dropped(self) -> int:
        """Rows that were dropped because nobody read them in time."""
        return self._pile.dropped

    @property
    def unmatched(self) -> int:
        """Rows that were dropped because those of another stream were not there."""
        return self._aligner.unmatched

    @property
    def lost(self) -> dict[str, int]:
        """Rows of each stream that never came."""
        return self._aligner.lost

    @property
    def gaps(self) -> list[Gap]:
        """The last gaps, with the stream that they were in."""
        with self._changed:
            return list(self._aligner.gaps)

    def __iter__(self) -> Iterator[Samples]:
        return self.blocks()

    def call(self, function: Callable[[Samples], object], *, rows: int | None = None) -> None:
        """Call a function with each block, on a thread of its own; one that is slow loses rows, which are counted."""
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
                try:
                    function(samples)
                except BaseException as error:
                    self._error = error
                    return

        self._thread = threading.Thread(target=loop, name="daq calls", daemon=True)
        self._thread.start()

    def wait(self, *, timeout_s: float | None = None) -> bool:
        """Wait until `call` has handed on everything; returns whether it has.

        Raises:
            BaseException: What the function raised, which ended the calls.
        """
        if self._thread is None:
            raise InputError("wait", "called after call", Words("no function"))
        self._thread.join(timeout_s)
        if self._error is not None:
            raise self._error
        return not self._thread.is_alive()

    async def aread(self, rows: int | None = None, *, timeout_s: float = 5.0) -> Samples:
        """As `read`, for asyncio."""
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
            raise self._late(rows, timeout_s) from None
        finally:
            with self._changed:
                self._wakers.discard(wake)

    async def ablocks(self, rows: int | None = None, *, timeout_s: float = 5.0) -> AsyncIterator[Samples]:
        """Read until the end, for asyncio."""
        while True:
            try:
                samples = await self.aread(rows, timeout_s=timeout_s)
            except StreamEndedError:
                return
            yield samples

    def __aiter__(self) -> AsyncIterator[Samples]:
        return self.ablocks()

    def _take(self, rows: int | None, *, whole: bool = True) -> Samples | None:
        """Rows that are ready; the lock is held."""
        if self._closed:
            raise StreamEndedError("the client was closed")
        ready = super()._take(rows, whole=whole)
        if ready is not None:
            lost = sum(self._aligner.lost.values())
            self._source.taken(ready.index + len(ready), room=self._room, lost=lost)
        return ready

    def _on_samples(self, stream: str, samples: Samples) -> None:
        with self._changed:
            if self._early is not None:
                self._early.append((stream, samples))
                return
            self._feed(stream, samples)

    def _feed(self, stream: str, samples: Samples) -> None:
        if self._ended is not None:
            return
        if not self._begun:
            # What is to come will be measured from here.
            self._begun = True
            self._source.taken(samples.index, room=self._room, lost=0)
        made = self._aligner.feed(stream, samples)
        for joint in made:
            self._pile.add(joint)
        if made:
            self._notify()

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
        """Close the source; may be called again."""
        with self._changed:
            self._closed = True
            self._notify()
        self._source.close()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)
