"""Drivers of instruments, with the interface that a driver of a real instrument would have.

`Instrument` identifies itself, `Sampler` also measures. Use each from one thread at a time;
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
from drivers.instruments.common.protocol import Codec, InstrumentMessage, ProtocolError
from drivers.link import QUEUE_MESSAGES, Link, LinkError, LinkTimeoutError, open_link
from drivers.sources.samples import RowReader, Samples, follow
from rig.base.errors import InputError, RefusedError, Words
from rig.base.files import Closing
from rig.base.wire import Continuity
from rig.channels.table import Group
from rig.serve.waiting import Deadline

M = TypeVar("M", bound=InstrumentMessage)
_POLL_S = 1.0
_STOP_TIMEOUT_S = 0.5
"""Longest wait for the instrument to stop when the driver is closed [s]."""


@dataclass(frozen=True, slots=True)
class Configuration:
    """Channels, units and sample rate of an instrument from its next start on."""

    channels: tuple[str, ...]
    units: tuple[str, ...]
    rate_hz: float


@dataclass(frozen=True, slots=True)
class CommandDone:
    """Acknowledgement of a command.

    Attributes:
        id: Number of the command in the rig's run.
        tick: Effective tick.
        time_s: The same as simulated time [s].
    """

    id: int
    tick: int
    time_s: float


class Instrument(Closing):
    """One instrument at the end of a link.

    Args:
        link: The link; `close` closes it too.
        timeout_s: Longest wait for a reply [s].
    """

    CODEC: ClassVar[Codec]

    def __init__(self, link: Link, *, timeout_s: float = 3.0) -> None:
        self.link = link
        self._timeout_s = timeout_s
        # Random, so that a late reply to an earlier user of the line is not mistaken for a reply to this driver.
        self._sequence = random.getrandbits(32)
        self._data: deque[InstrumentMessage] = deque()
        self._datasheet: Datasheet | None = None
        self.malformed = 0
        """Messages that do not follow this protocol."""
        self.dropped = 0
        """Data messages dropped because they were not read in time."""

    @classmethod
    def open(cls, url: str, *, timeout_s: float = 3.0) -> Self:
        """Connect to the instrument of this kind at a URL.

        Args:
            url: One of the forms of `drivers.link.open_link`, such as `zenoh:127.0.0.1:7462`.
            timeout_s: Longest wait for a reply [s].

        Raises:
            InputError: The URL is malformed.
            LinkError: No instrument replies.
        """
        instrument = cls(open_link(url, cls.CODEC.address), timeout_s=timeout_s)
        try:
            instrument.identify()
        except BaseException:
            instrument.close()
            raise
        return instrument

    def identify(self) -> Datasheet:
        """Read identification and calibration from the instrument."""
        self._datasheet = parse_datasheet(self.ask(protocol.Identify(), protocol.Identity).datasheet)
        return self._datasheet

    @property
    def datasheet(self) -> Datasheet:
        """Identification and calibration, as read last."""
        return self._datasheet or self.identify()

    @property
    def lost(self) -> int:
        """Messages that were dropped or corrupted at this end of the link; lost rows show as gaps as well."""
        return self.link.lost + self.dropped + self.malformed

    def close(self) -> None:
        """Close the link; further calls have no effect."""
        self.link.close()

    def _send_command(self, command: protocol.InstrumentCommand) -> CommandDone:
        """Send a command.

        Raises:
            RefusedError: The instrument refused the command, for the reason in the message.
            LinkError: No reply came; the command may or may not take effect.
        """
        done = self.ask(command, protocol.Done)
        return CommandDone(id=done.id, tick=done.tick, time_s=done.time_s)

    def ask(self, request: InstrumentMessage, expected: type[M]) -> M:
        """Send a request of the protocol, and return the reply, which must be of the expected class.

        Raises:
            RefusedError: The instrument refused the request, for the reason in the message.
            LinkError: The instrument could not reply, or did not in time.
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
                self._store(message)
            elif sequence == self._sequence and isinstance(message, protocol.Refused):
                if message.reason in (protocol.Reason.REFUSED, protocol.Reason.VALUE):
                    raise RefusedError(message.text)
                raise LinkError(f"the {self.CODEC.address.name} could not reply: {message.text}")
            elif sequence == self._sequence and isinstance(message, expected):
                return message
        raise LinkTimeoutError(
            f"the {self.CODEC.address.name} did not reply to {type(request).__name__} in {self._timeout_s:g} s"
        )

    def _receive(self, timeout_s: float) -> tuple[int, InstrumentMessage] | None:
        data = self.link.receive(timeout_s=timeout_s)
        if data is None:
            return None
        try:
            return self.CODEC.decode(data)
        except ProtocolError:
            self.malformed += 1
            return None

    def _store(self, message: InstrumentMessage) -> None:
        if len(self._data) >= QUEUE_MESSAGES:
            self._data.popleft()
            self.dropped += 1
        self._data.append(message)


class Sampler(Instrument, RowReader):
    """Driver of a measuring instrument: configure, start, read."""

    def __init__(self, link: Link, *, timeout_s: float = 3.0) -> None:
        Instrument.__init__(self, link, timeout_s=timeout_s)
        RowReader.__init__(self, self.CODEC.address.name)
        self._group: Group | None = None
        self._stream: int | None = None
        self._rows = Continuity()

    def configure(self, *, channels: tuple[str, ...] | list[str] | None = None, rate_hz: float = 0.0) -> Configuration:
        """Select channels and rate; ends a stream that runs.

        Args:
            channels: Names from the datasheet; by default all. The columns are in the order of the datasheet.
            rate_hz: Sample rate [Hz]: the datasheet's rate divided by a whole number. Samples are decimated after the
                conditioner's own low-pass, without a further filter. 0 selects the datasheet's rate.

        Returns:
            The channels, units and rate that the instrument has accepted.

        Raises:
            InputError: The channel does not exist.
            RefusedError: The instrument does not have this rate.
        """
        datasheet = self.identify()
        chosen = datasheet.group(tuple(channels)).names if channels else tuple(row.name for row in datasheet.channels)
        mask = sum(1 << n for n, row in enumerate(datasheet.channels) if row.name in chosen)
        reply = self.ask(protocol.Configure(rate_hz=float(rate_hz), channels=mask), protocol.Configured)
        names = tuple(row.name for n, row in enumerate(datasheet.channels) if reply.channels >> n & 1)
        self._group = group = datasheet.group(names)
        self._stream = None
        return Configuration(names, tuple(row.unit for row in group.channels), reply.rate_hz)

    def start(self) -> None:
        """Start a stream, of all channels if `configure` was not called.

        Raises:
            RefusedError: The instrument measures nothing.
        """
        if self._group is None:
            self.configure()
        self._buffer.clear()
        self._rows = Continuity()
        self._ended = None
        self._stream = self.ask(protocol.Start(), protocol.Started).stream

    def stop(self) -> None:
        """Stop the stream; samples that have arrived can still be read."""
        self._stop(discard=False)

    def close(self) -> None:
        """Stop the stream and close the link; further calls have no effect."""
        if self._stream is not None and self._ended is None:
            self._ended = "the driver was closed"
            self._timeout_s = min(self._timeout_s, _STOP_TIMEOUT_S)
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
        """Receive the next data message, and return False if none arrived in time."""
        message = self._next(deadline)
        if isinstance(message, protocol.Ended):
            if message.stream == self._stream:
                self._ended = message.reason
        elif isinstance(message, protocol.Rows) and message.stream == self._stream:
            self._add(message)
        return message is not None

    def _next(self, deadline: Deadline) -> InstrumentMessage | None:
        if self._data:
            return self._data.popleft()
        while True:
            passed = deadline.passed
            received = self._receive(min(deadline.left_s, _POLL_S))
            if received is not None and isinstance(received[1], protocol.Rows | protocol.Ended):
                return received[1]
            if passed:
                return None

    def _add(self, rows: protocol.Rows) -> None:
        group = self._group
        if group is None or rows.columns != len(group.channels) or not len(rows.counts):
            self.malformed += 1
            return
        new_samples = Samples(
            index=rows.index,
            tick=rows.tick,
            rate_hz=rows.rate_hz,
            tick_rate_hz=rows.tick_rate_hz,
            names=group.names,
            units=tuple(channel.unit for channel in group.channels),
            values=group.engineering(rows.counts),
        )
        if (new := follow(self._rows, new_samples)) is not None:
            self._buffer.add(new)
