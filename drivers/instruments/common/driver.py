"""The host's side of an instrument: what a driver of a real one would look like to its user.

`Instrument` identifies itself, `Sampler` also measures. Both are for one thread at a time;
`drivers.instruments.common.aio` has the asyncio forms.
"""

from __future__ import annotations

import contextlib
import random
from collections import deque
from dataclasses import dataclass
from typing import ClassVar, Self, TypeVar

from drivers.instruments.common import protocol
from drivers.instruments.common.datasheet import Datasheet, parse_datasheet
from drivers.instruments.common.protocol import Codec, Message, ProtocolError
from drivers.link import ROOM, Link, LinkError, LinkTimeoutError, open_link
from drivers.sources.samples import RowReader, Samples, follow
from rig.base.closeable import Closing
from rig.base.errors import InputError, RefusedError, Words
from rig.base.wire import Continuity
from rig.channels.table import Group
from rig.serve.waiting import Deadline

M = TypeVar("M", bound=Message)
_SLICE_S = 1.0
_FAREWELL_S = 0.5
"""How long closing waits for the instrument to stop."""


@dataclass(frozen=True, slots=True)
class Configuration:
    """What an instrument measures from its next start on."""

    channels: tuple[str, ...]
    units: tuple[str, ...]
    rate_hz: float


@dataclass(frozen=True, slots=True)
class Done:
    """An act that was accepted.

    Attributes:
        id: Number of the command in the rig's run.
        tick: When it takes effect [ticks of the simulated clock].
        time_s: The same [s].
    """

    id: int
    tick: int
    time_s: float


class Instrument(Closing):
    """One instrument at the end of a link.

    Args:
        link: Closed with the instrument.
        timeout_s: How long to wait for a reply [s].
    """

    CODEC: ClassVar[Codec]

    def __init__(self, link: Link, *, timeout_s: float = 3.0) -> None:
        self.link = link
        self._timeout_s = timeout_s
        # From anywhere, so that a late reply to whoever had the line before is not taken for ours.
        self._sequence = random.getrandbits(32)
        self._data: deque[Message] = deque()
        self._datasheet: Datasheet | None = None
        self.malformed = 0
        """Messages that were none of this protocol."""
        self.dropped = 0
        """Messages of data that came while nobody read, beyond what is kept."""

    @classmethod
    def open(cls, url: str, *, timeout_s: float = 3.0) -> Self:
        """The instrument of this kind at a URL (`drivers.link.open_link`).

        Raises:
            InputError: The URL is malformed.
            LinkError: Nothing is there, or nothing answers.
        """
        instrument = cls(open_link(url, cls.CODEC.address), timeout_s=timeout_s)
        try:
            instrument.identify()
        except BaseException:
            instrument.close()
            raise
        return instrument

    def identify(self) -> Datasheet:
        """Identification and calibration, as the instrument tells them now."""
        self._datasheet = parse_datasheet(self.ask(protocol.Identify(), protocol.Identity).datasheet)
        return self._datasheet

    @property
    def datasheet(self) -> Datasheet:
        """Identification and calibration, as the instrument told them last."""
        return self._datasheet or self.identify()

    @property
    def lost(self) -> int:
        """Messages that were dropped or spoilt at this end of the link; lost rows show as gaps as well."""
        return self.link.lost + self.dropped + self.malformed

    def close(self) -> None:
        """Close the link; may be called again."""
        self.link.close()

    def _act(self, act: protocol.Act) -> Done:
        """Tell the instrument to do something.

        Raises:
            RefusedError: It refuses, for the reason in the message.
            LinkError: No reply came; whether it was done is not known.
        """
        done = self.ask(act, protocol.Done)
        return Done(id=done.id, tick=done.tick, time_s=done.time_s)

    def ask(self, request: Message, expected: type[M]) -> M:
        """Send a request of the protocol; returns the reply, which must be of that kind.

        Raises:
            RefusedError: The instrument refuses, for the reason in the message.
            LinkError: It could not answer, or did not in time.
        """
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        deadline = Deadline(self._timeout_s)
        self.link.send(self.CODEC.encode(request, self._sequence), timeout_s=self._timeout_s)
        while not deadline.passed:
            received = self._receive(deadline.left_s)
            if received is None:
                continue
            sequence, message = received
            if isinstance(message, protocol.Rows | protocol.Ended):
                self._keep(message)
            elif sequence == self._sequence and isinstance(message, protocol.Refused):
                if message.reason in (protocol.Reason.REFUSED, protocol.Reason.VALUE):
                    raise RefusedError(message.text)
                raise LinkError(f"the {self.CODEC.address.name} could not answer: {message.text}")
            elif sequence == self._sequence and isinstance(message, expected):
                return message
        raise LinkTimeoutError(
            f"the {self.CODEC.address.name} did not answer {type(request).__name__} in {self._timeout_s:g} s"
        )

    def _receive(self, timeout_s: float) -> tuple[int, Message] | None:
        data = self.link.receive(timeout_s=timeout_s)
        if data is None:
            return None
        try:
            return self.CODEC.decode(data)
        except ProtocolError:
            self.malformed += 1
            return None

    def _keep(self, message: Message) -> None:
        if len(self._data) >= ROOM:
            self._data.popleft()
            self.dropped += 1
        self._data.append(message)


class Sampler(Instrument, RowReader):
    """An instrument that measures: configure, start, read."""

    def __init__(self, link: Link, *, timeout_s: float = 3.0) -> None:
        Instrument.__init__(self, link, timeout_s=timeout_s)
        RowReader.__init__(self, self.CODEC.address.name)
        self._group: Group | None = None
        self._stream: int | None = None
        self._rows = Continuity()

    def configure(self, *, channels: tuple[str, ...] | list[str] | None = None, rate_hz: float = 0.0) -> Configuration:
        """Choose what to measure; a stream that runs ends.

        Args:
            channels: Names from the datasheet; all of them where none are given. They come in the datasheet's order.
            rate_hz: Rows per second [Hz], a whole fraction of the datasheet's rate; every n-th row is taken, with the
                conditioner's own low-pass and no further filter. 0 is the datasheet's rate.

        Raises:
            InputError: There is no such channel.
            RefusedError: There is no such rate.
        """
        datasheet = self.identify()
        wanted = datasheet.group(tuple(channels)).names if channels else tuple(row.name for row in datasheet.channels)
        mask = sum(1 << n for n, row in enumerate(datasheet.channels) if row.name in wanted)
        reply = self.ask(protocol.Configure(rate_hz=float(rate_hz), channels=mask), protocol.Configured)
        names = tuple(row.name for n, row in enumerate(datasheet.channels) if reply.channels >> n & 1)
        self._group = group = datasheet.group(names)
        self._stream = None
        return Configuration(names, tuple(row.unit for row in group.channels), reply.rate_hz)

    def start(self) -> None:
        """Begin a stream, configured to all channels where nothing else was asked for.

        Raises:
            RefusedError: The instrument has nothing to measure.
        """
        if self._group is None:
            self.configure()
        self._pile.clear()
        self._rows = Continuity()
        self._ended = None
        self._stream = self.ask(protocol.Start(), protocol.Started).stream

    def stop(self) -> None:
        """End the stream; what came before can still be read."""
        self._stop(discard=False)

    def close(self) -> None:
        """Stop what runs and close the link; may be called again."""
        if self._stream is not None and self._ended is None:
            self._ended = "the driver was closed"
            self._timeout_s = min(self._timeout_s, _FAREWELL_S)
            with contextlib.suppress(LinkError, InputError):
                self._stop(discard=True)
        super().close()

    def _stop(self, *, discard: bool) -> None:
        self.ask(protocol.Stop(self._stream or 0, int(discard)), protocol.Stopped)

    def _take(self, rows: int | None, *, whole: bool = True) -> Samples | None:
        if self._stream is None:
            raise InputError("read", "called after start", Words("no stream"))
        return super()._take(rows, whole=whole)

    def _wait(self, deadline: Deadline) -> bool:
        """Take the next message of data; False where none came in time."""
        message = self._next(deadline)
        if isinstance(message, protocol.Ended):
            if message.stream == self._stream:
                self._ended = message.reason
        elif isinstance(message, protocol.Rows) and message.stream == self._stream:
            self._add(message)
        return message is not None

    def _next(self, deadline: Deadline) -> Message | None:
        if self._data:
            return self._data.popleft()
        while True:
            passed = deadline.passed
            received = self._receive(min(deadline.left_s, _SLICE_S))
            if received is not None and isinstance(received[1], protocol.Rows | protocol.Ended):
                return received[1]
            if passed:
                return None

    def _add(self, rows: protocol.Rows) -> None:
        group = self._group
        if group is None or rows.columns != len(group.channels) or not len(rows.counts):
            self.malformed += 1
            return
        came = Samples(
            index=rows.index,
            tick=rows.tick,
            rate_hz=rows.rate_hz,
            tick_rate_hz=rows.tick_rate_hz,
            names=group.names,
            units=tuple(channel.unit for channel in group.channels),
            values=group.engineering(rows.counts),
        )
        if (new := follow(self._rows, came)) is not None:
            self._pile.add(new)
