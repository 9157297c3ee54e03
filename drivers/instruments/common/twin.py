"""Twin of an instrument: serves the instrument's protocol from the rig's samples, and passes commands to its console.

A twin has the channels and the commands of the real instrument. It cannot see the truth.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import ClassVar

import numpy as np

from drivers.console import Accepted, Console
from drivers.instruments.common import protocol
from drivers.instruments.common.datasheet import Datasheet
from drivers.instruments.common.protocol import Codec, InstrumentMessage, ProtocolError, Reason
from drivers.link import Port
from drivers.sources.stream import RigStream, decimate, decimation_factor
from rig.base import wire
from rig.base.errors import InputError, Words
from rig.channels.table import Group
from rig.run.commands.command import as_number
from rig.serve.request_handler import one_line
from rig.serve.transport import NoReplyError

MANUFACTURER = "Virtual rotor-stator rig"


@dataclass(slots=True)
class _Running:
    """State of a stream that is sent to the host."""

    number: int
    channels: list[int]
    step: int
    """Decimation: every n-th row of the rig is sent."""
    parts: list[np.ndarray] = field(default_factory=list)
    """Counts that wait until they fill a message or the link is idle; a slow link receives fewer and longer messages.
    """
    first: wire.Block | None = None
    """Block with which `parts` begins."""
    messages: int = 0
    rows: int = 0
    dropped: int = 0


class Twin:
    """One instrument at one port. It has one state for all its users, like the real instrument.

    Args:
        stream: Sensor blocks of the rig.
        console: Console for the commands.
        port: Instrument's end of a link; `close` closes it too.
    """

    CODEC: ClassVar[Codec]
    TITLE: ClassVar[str]
    GROUP: ClassVar[str | None] = None
    """Channel group that it measures."""

    def __init__(self, stream: RigStream, console: Console, port: Port) -> None:
        self._stream = stream
        self._console = console
        self._port = port
        self._lock = threading.Lock()
        self._rate_hz = 0.0
        self._mask = 0
        self._streams = 0
        self._running: _Running | None = None
        self._listening = False
        self._leave: Callable[[], None] | None = None
        self._closed = False
        self.refused = 0
        """Requests that were refused or malformed."""
        port.serve(self.answer, self._on_idle)

    @property
    def running(self) -> bool:
        """Whether a stream is being sent to the host."""
        return self._running is not None

    @property
    def url(self) -> str:
        """URL for the host to open."""
        return self._port.url

    def answer(self, data: bytes) -> bytes:
        """Return the reply to a request; never raises."""
        sequence = 0
        try:
            sequence, request = self.CODEC.decode(data)
            reply = self._execute(request)
        except ProtocolError as error:
            sequence = error.sequence
            reply = protocol.Refused(error.reason, one_line(error))
        except InputError as error:
            reply = protocol.Refused(Reason.REFUSED, one_line(error))
        except NoReplyError as error:
            reply = protocol.Refused(Reason.UNAVAILABLE, one_line(error))
        self.refused += isinstance(reply, protocol.Refused)
        return self.CODEC.encode(reply, sequence)

    def send_command(self, command: protocol.InstrumentCommand) -> Accepted:
        """Send a command of this instrument to the rig.

        Raises:
            InputError: The rig refused the command.
            NoReplyError: No rig replies.
        """
        fields = {key: as_number(value) if isinstance(value, str) else value for key, value in asdict(command).items()}
        return self._console.send(command.COMMAND, **fields)

    def _execute(self, request: InstrumentMessage) -> InstrumentMessage:
        if isinstance(request, protocol.Identify):
            return protocol.Identity(self._datasheet().model_dump_json())
        if isinstance(request, protocol.InstrumentCommand):
            accepted = self.send_command(request)
            return protocol.Done(id=accepted.id, tick=accepted.tick, time_s=accepted.time_s)
        if isinstance(request, protocol.Configure):
            return self._configure(request)
        if isinstance(request, protocol.Start):
            return self._start()
        if isinstance(request, protocol.Stop):
            return self._stop(request)
        raise ProtocolError(Reason.KIND, f"kind must be a request; received {type(request).__name__}")

    def _datasheet(self) -> Datasheet:
        name = self.CODEC.address.name
        group = self._read_group() if self.GROUP else None
        return Datasheet(
            manufacturer=MANUFACTURER,
            model=f"{name} (virtual)",
            serial=f"VIRTUAL-{self.CODEC.address.number:03d}",
            virtual=True,
            title=self.TITLE if group is None else group.title,
            rate_hz=0 if group is None else group.rate_hz,
            channels=() if group is None else group.channels,
            acts=tuple(command.__name__ for command in self.CODEC.commands),
        )

    def _read_group(self) -> Group:
        """Return the measured group, as the rig runs it now."""
        if self.GROUP is None:
            raise InputError("request", f"one of a {self.CODEC.address.name}", Words("a request for measurements"))
        return self._stream.group(self.GROUP)

    def _configure(self, request: protocol.Configure) -> protocol.Configured:
        group = self._read_group()
        all_channels = (1 << len(group.channels)) - 1
        mask = request.channels or all_channels
        if mask & ~all_channels:
            raise InputError("channels", f"bits 0 to {len(group.channels) - 1}", bin(mask))
        rate = request.rate_hz or float(group.rate_hz)
        decimation_factor(group.rate_hz, rate)
        with self._lock:
            self._end("configured again", discard=True)
            self._mask, self._rate_hz = mask, rate
        return protocol.Configured(rate_hz=rate, channels=mask)

    def _start(self) -> protocol.Started:
        group = self._read_group()
        # Before the lock is taken: the transport may deliver a block during the call.
        if not self._listening:
            self._listening = True
            assert self.GROUP is not None
            self._leave = self._stream.listen(wire.sensor_key(self.GROUP), self.take, self.end_run)
        rate = self._rate_hz or float(group.rate_hz)
        mask = self._mask or (1 << len(group.channels)) - 1
        chosen = [n for n in range(len(group.channels)) if mask >> n & 1]
        step = decimation_factor(group.rate_hz, rate)
        if not chosen:
            raise InputError("channels", "configured again: this rig has other channels", bin(mask))
        with self._lock:
            self._end("started again", discard=True)
            self._streams += 1
            self._running = _Running(self._streams, chosen, step)
            return protocol.Started(self._streams)

    def _stop(self, request: protocol.Stop) -> protocol.Stopped:
        with self._lock:
            running = self._running
            if running is None or request.stream not in (0, running.number):
                return protocol.Stopped(request.stream, 0, 0)
            self._end("stopped", discard=bool(request.discard))
            return protocol.Stopped(running.number, running.rows, running.dropped)

    def _end(self, reason: str, *, discard: bool = False) -> None:
        """End the current stream; the caller holds the lock."""
        running, self._running = self._running, None
        if running is None:
            return
        if discard:
            self._port.discard()
        else:
            self._flush(running, everything=True)
        self._push(running, protocol.Ended(running.number, reason))

    def _push(self, running: _Running, message: InstrumentMessage) -> bool:
        running.messages += 1
        return self._port.push(self.CODEC.encode(message, running.messages))

    def take(self, block: wire.Block) -> None:
        """Send the selected rows of a block; never blocks."""
        with self._lock:
            running = self._running
            if running is None:
                return
            if block.values.shape[1] <= max(running.channels):
                self._end("the rig's channels have changed")
                return
            block = decimate(block, running.step)
            if not len(block.values):
                return
            first = running.first
            if first is not None:
                waiting_rows = sum(map(len, running.parts))
                if block.index != first.index + waiting_rows or block.rate_hz != first.rate_hz:
                    self._flush(running, everything=True)
            running.first = running.first or block
            running.parts.append(block.values[:, running.channels])
            self._flush(running)

    def _on_idle(self) -> None:
        with self._lock:
            if self._running is not None:
                self._flush(self._running)

    def _flush(self, running: _Running, *, everything: bool = False) -> None:
        """Push full messages, and the rest too if the link is idle; the caller holds the lock."""
        first = running.first
        if first is None:
            return
        columns = len(running.channels)
        max_rows = max(1, (self._port.max_bytes - protocol.ROWS_HEAD) // (4 * columns))
        waiting = sum(map(len, running.parts))
        if waiting < max_rows and not everything and not self._port.idle:
            return
        counts = np.concatenate(running.parts) if len(running.parts) > 1 else running.parts[0]
        start = 0
        while start < waiting and (waiting - start >= max_rows or everything or self._port.idle):
            part = counts[start : start + max_rows]
            rows = protocol.Rows(
                stream=running.number,
                index=first.index + start,
                tick=wire.row_tick(first.tick, first.rate_hz, first.tick_rate_hz, start),
                rate_hz=first.rate_hz,
                tick_rate_hz=first.tick_rate_hz,
                columns=columns,
                counts=part,
            )
            if self._push(running, rows):
                running.rows += len(part)
            else:
                running.dropped += len(part)
            start += len(part)
        running.parts = [counts[start:]] if start < waiting else []
        running.first = None
        if start < waiting:
            tick = wire.row_tick(first.tick, first.rate_hz, first.tick_rate_hz, start)
            running.first = replace(first, index=first.index + start, tick=tick, values=first.values[:0])

    def end_run(self, reason: str) -> None:
        """End the stream: the rig publishes no more blocks."""
        with self._lock:
            self._end(reason)

    def close(self) -> None:
        """Stop serving; further calls have no effect."""
        if self._closed:
            return
        self._closed = True
        with self._lock:
            self._end("the instrument was switched off")
        if self._leave is not None:
            self._leave()
        self._port.close()
