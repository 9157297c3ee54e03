"""Samples from a CAN bus: one stream for each sample message of `drivers.can.signals`, in the FD layout if it is sent.

Sample numbers in frames wrap. The message Rates gives the decimation, Sync the number of the sample that is due, and
Clock the simulated time, which determines the complete number. Frames that arrive before Rates and Sync wait for them.
The source only acknowledges frames; it sends what `send` receives.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivers.can.message import CanMessage, MessageTable
from drivers.can.signals import RigState, default_messages, messages_for
from drivers.link import LinkTimeoutError
from drivers.sources.samples import RIG_LOST, Samples
from drivers.sources.stream import decimation_factor
from rig.base import wire
from rig.base.errors import InputError, RefusedError
from rig.channels.channel_file import read_channels
from rig.channels.table import default_table
from rig.serve.transport import RigLostError
from rig.serve.waiting import Deadline

_SILENCE_TIMEOUT_S = 3.0
"""A bus that is silent for longer has no rig any more: the rig sends a heartbeat every second."""
_BATCH_S = 0.01
_QUIET_S = 0.05
"""Silence after which no further kind of sample message is expected, if the rig does not state their number."""
_FIRST_FRAMES_TIMEOUT_S = 5.0
"""Longest wait for the first frame of each sample message that the rig states; a busy machine needs a second."""
_LEAD_S = 1.0
"""Time before the start of the streams from which frames are passed on [s]."""
_MAX_EARLY_FRAMES = 50_000
"""Buffered frames before Rates and Sync: about 5 s of all messages."""
_TICK_RATE_HZ = 1e6
_WRAP = 1 << 32
"""The index in a Sync wraps after this number of samples: 59.7 h at 20 kHz."""


class SampleDecoder:
    """Decodes sample frames into samples; does no input or output itself.

    Args:
        messages: The sample messages to decode, by name.
        decimation: Decimation: every n-th instant in the frames is returned.
    """

    def __init__(self, messages: dict[str, CanMessage], decimation: int = 1) -> None:
        self._messages = messages
        self._decimation = decimation
        self._expected: dict[str, int] = {}
        """Sample number of the next instant at the recording rate, by message."""
        self.malformed = 0

    def decode(self, name: str, frames: list[bytes], rate_hz: int, step: int, near_index: int) -> list[Samples]:
        """Decode frames of one message, in the order of their arrival.

        Args:
            name: Name of the message.
            frames: Data fields of the frames.
            rate_hz: Recording rate of the rig [Hz].
            step: Distance between two instants in the frames [samples at the recording rate].
            near_index: A sample number near that of the first frame.

        Returns:
            One piece for each run of frames without a gap.
        """
        message = self._messages[name]
        form = message.samples
        assert form is not None
        whole = [data for data in frames if len(data) == message.length]
        self.malformed += len(frames) - len(whole)
        if not whole:
            return []
        low_bits, values = form.unpack(np.frombuffer(b"".join(whole), np.uint8).reshape(-1, message.length))
        unit = step if form.index_width < 4 else 1
        numbers = _unwrap_numbers(low_bits, 8 * form.index_width, self._expected.get(name, near_index) // unit) * unit
        span = form.rows * step
        self._expected[name] = int(numbers[-1]) + span
        engineering = form.engineering(values)
        blocks = []
        for run in np.split(np.arange(len(numbers)), np.flatnonzero(np.diff(numbers) != span) + 1):
            index = int(numbers[run[0]]) // step
            rows = engineering[run[0] * form.rows : (run[-1] + 1) * form.rows]
            first = -index % self._decimation
            if len(rows) > first:
                blocks.append(
                    Samples(
                        index=(index + first) // self._decimation,
                        tick=round((index + first) * step * _TICK_RATE_HZ / rate_hz),
                        rate_hz=rate_hz / step / self._decimation,
                        tick_rate_hz=_TICK_RATE_HZ,
                        names=tuple(channel.name for channel in form.channels),
                        units=tuple(channel.unit for channel in form.channels),
                        values=rows[first :: self._decimation],
                    )
                )
        return blocks


def _unwrap_numbers(low_bits: np.ndarray, bits: int, near_index: int) -> np.ndarray:
    """Restore numbers of which only the low bits are known.

    Args:
        low_bits: The low bits, shape (frames,).
        bits: Number of known bits.
        near_index: A number near the first one; each following number is the one nearest to its predecessor.
    """
    modulus = 1 << bits
    first = near_index + (int(low_bits[0]) - near_index + modulus // 2) % modulus - modulus // 2
    steps = (np.diff(low_bits) + modulus // 2) % modulus - modulus // 2
    return first + np.concatenate([[0], np.cumsum(steps)])


def full_index(low_bits: int, near: int) -> int:
    """Return the sample number with these low 32 bits that is nearest to `near`."""
    return near + (low_bits - near + _WRAP // 2) % _WRAP - _WRAP // 2


class CanSource:
    """Sample messages of the rig on a bus.

    Args:
        spec: INTERFACE:CHANNEL?NAME=VALUE&... of python-can's bus. `layout=fd` or `layout=classic` selects one where
            both are sent, `channels=FILE.toml` is the rig's channel table, and `node=N` the number as a device under
            test.
        wait_s: Longest wait for a rig [s]; a rig announces itself once a second.
        table: Messages; by default those of the standard channel table.
        on_frame: Called with name and raw values of each frame of the rig that carries no samples, after the samples
            that arrived before it, on the reading thread. For a Sync it receives the unwrapped `index`, and `rate`,
            once Rates has arrived.

    Raises:
        InputError: The bus does not exist.
    """

    def __init__(
        self,
        spec: str,
        *,
        wait_s: float = 3.0,
        table: MessageTable | None = None,
        on_frame: Callable[[str, dict[str, int]], None] | None = None,
    ) -> None:
        from drivers.link.can import open_bus, parse_spec

        interface, channel, settings = parse_spec(spec)
        if interface == "zenoh":
            settings.setdefault("connect_s", wait_s)
        self._layout_name = settings.pop("layout", None)
        if self._layout_name not in (None, "fd", "classic"):
            raise InputError("layout", "fd or classic", self._layout_name)
        self.node = settings.pop("node", 1)
        """Number as a device under test."""
        self.channels = default_table()
        """Channel table that the frames are decoded with."""
        if (channels := settings.pop("channels", None)) is not None:
            self.channels = read_channels(Path(channels))
            table = messages_for(self.channels)
        self.table = self._table = table or default_messages()
        self._on_frame = on_frame
        self._other_layout = 0
        self._wait_s, self._opening = wait_s, Deadline(wait_s)
        self._bus = open_bus(spec, interface, channel, **settings)
        self._lock = threading.RLock()
        self.rates: dict[str, int] | None = None
        """Raw values of the last Rates: how samples are decimated."""
        self.lockstep = False
        """Whether the rig runs in lockstep, in which nothing is sent before the first step."""
        self._started = (0, 0)
        self._sync: int | None = None
        self._new_sync: int | None = None
        """Index of the latest Sync as sent, while Rates is missing."""
        self._has_no_clock = False
        self._clock_s: int | None = None
        """Simulated time of the latest Clock [s]."""
        self._numbers_of_messages = {"fd": 0, "classic": 0}
        """Number of the run's sample messages by layout, from Clock; 0: not stated."""
        self._beat: dict[str, int] | None = None
        """Raw values of the latest Heartbeat."""
        self._is_restarted = False
        self._end_reason: str | None = None
        self._rates_known = threading.Event()
        self._early: deque[tuple[float, int, bytes]] = deque(maxlen=_MAX_EARLY_FRAMES)
        self._batch: dict[int, list[bytes]] = {}
        self._decoder: SampleDecoder | None = None
        self._wanted: dict[int, str] = {}
        self._on_samples: Callable[[str, Samples], None] | None = None
        self._on_end: Callable[[str, str], None] | None = None
        self._closed = False
        self._identifiers = {name: row.identifier for name, row in self._table.by_name.items()}
        self._seen_identifiers: dict[int, None] = {}
        self._sample_identifiers = {row.identifier for row in (*self._table.fd, *self._table.classic)}
        self._thread = threading.Thread(target=self._read, name=f"can {channel} reads", daemon=True)
        self._thread.start()

    def streams(self) -> dict[str, tuple[str, ...]]:
        """Return the channels of each sample message in the layout that is sent.

        Raises:
            InputError: The bus has no rig, or its rig has another channel table or layout.
        """
        self.wait()
        assert self.rates is not None
        if self._other_layout:
            must = f"a rig with the sample messages {self._table.layout} (?channels=FILE.toml for another table)"
            raise InputError("can", must, self._other_layout)
        layout = self._layout_name or ("fd" if self.rates["fd_step"] else "classic")
        if not self.rates[f"{layout}_step"]:
            raise InputError("layout", "one that the rig sends", layout)
        self._layout_name = layout
        rows = self._table.fd if layout == "fd" else self._table.classic
        # A run may lack groups: list the messages that have been seen; in lockstep, all that may come.
        before, stated = 0, self._numbers_of_messages[layout]
        for _ in Deadline(_FIRST_FRAMES_TIMEOUT_S).polls(_QUIET_S):
            seen = sum(row.identifier in self._seen_identifiers for row in rows)
            if self.lockstep or self._end_reason is not None or (seen >= stated if stated else 0 < seen == before):
                break
            before = seen
        return {
            row.name: tuple(channel.name for channel in row.samples.channels)
            for row in rows
            if row.samples and (self.lockstep or row.identifier in self._seen_identifiers)
        }

    def wait(self) -> None:
        """Wait for a rig's Clock, Rates and Sync; without Clock, a time after a wrap would be too small.

        Raises:
            InputError: No rig is on that bus.
        """
        left_s = max(self._opening.left_s, min(self._wait_s, _SILENCE_TIMEOUT_S))
        if not self._rates_known.wait(left_s) or self.rates is None:
            must = f"a bus with a rig on it (no Clock, Rates and Sync in {self._wait_s:g} s)"
            raise InputError("can", must, self._bus.channel_info)

    def send(self, identifier: int, data: bytes) -> None:
        """Send one classic frame.

        Raises:
            LinkTimeoutError: The bus did not accept the frame within 1 s.
            RigLostError: The rig was lost, or another runs there now.
            RefusedError: The run has ended.
        """
        import can

        if (reason := self._end_reason) is not None:
            raise RigLostError(reason) if reason.startswith(RIG_LOST) else RefusedError(wire.ENDED)
        try:
            self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False), timeout=1.0)
        except (can.CanError, OSError, ValueError) as error:
            raise LinkTimeoutError(f"can: the bus did not accept a frame ({error})") from None

    def start(
        self,
        streams: Sequence[str],
        rate_hz: float | None,
        on_samples: Callable[[str, Samples], None],
        on_end: Callable[[str, str], None],
    ) -> float:
        """Start the streams, with the frames of the last second since the source was opened."""
        rates = self.rates
        assert rates is not None
        self._started = (rates["rate"], rates[f"{self._layout_name}_step"])
        native = rates["rate"] / rates[f"{self._layout_name}_step"]
        decimation = 1 if rate_hz is None else decimation_factor(native, rate_hz)
        with self._lock:
            self._decoder = SampleDecoder({name: self._table.by_name[name] for name in streams}, decimation)
            self._wanted = {self._identifiers[name]: name for name in streams}
            self._on_samples, self._on_end, ended = on_samples, on_end, self._end_reason
            early, self._early = self._early, deque(maxlen=1)
            for arrival_s, identifier, data in early:
                if identifier in self._wanted and arrival_s >= early[-1][0] - _LEAD_S:
                    self._batch.setdefault(identifier, []).append(data)
            self.deliver()
        if ended is not None:
            self._finish(ended)
        return native / decimation

    def _read(self) -> None:
        import can

        last_poll_s = last_delivery_s = time.monotonic()
        beat, silence_s = None, 0.0
        while not self._closed:
            try:
                message = self._bus.recv(_BATCH_S)
            except (can.CanError, OSError, ValueError):
                break
            now = time.monotonic()
            # If this process was suspended, that time is no silence of the bus.
            silence_s, last_poll_s = silence_s + min(now - last_poll_s, 10 * _BATCH_S), now
            if message is not None:
                if not (message.is_error_frame or message.is_remote_frame or message.is_extended_id):
                    silence_s = 0.0
                    state = self.take(message.arbitration_id, bytes(message.data))
                    beat = beat if state is None else state
                    if self._is_restarted:
                        break
            elif self._on_samples is not None and silence_s > _SILENCE_TIMEOUT_S:
                break
            if now - last_delivery_s > _BATCH_S:
                last_delivery_s = now
                self.deliver()
            if beat == RigState.ENDED and message is None:
                # The bus is silent, so all frames of the run have arrived.
                self._finish("the rig's run has ended")
                return
        self._finish(RIG_LOST)

    def take(self, identifier: int, data: bytes) -> int | None:
        """Process a frame; return the state if it is a heartbeat."""
        if identifier in self._sample_identifiers:
            with self._lock:
                if self._on_samples is None:
                    self._seen_identifiers[identifier] = None
                    self._early.append((time.monotonic(), identifier, data))
                elif identifier in self._wanted:
                    self._batch.setdefault(identifier, []).append(data)
            return None
        row = self._table.by_identifier.get(identifier)
        if row is None or len(data) != row.length:
            return None
        raw, state = row.decode(data), None
        if not row.is_known(raw):
            return None
        if row.name == "Sync":
            self._new_sync = raw["index"]
        elif row.name == "Clock":
            self._clock_s = raw["seconds"]
            self._numbers_of_messages = {layout: raw[f"{layout}_messages"] for layout in ("fd", "classic")}
            self._new_sync = self._new_sync if self._sync is None else self._sync % _WRAP
        elif row.name == "Rates":
            # Clock precedes it in each period; rigs of version 0.1 send none.
            self._has_no_clock, self.rates = self.rates is not None, raw
        elif row.name == "Heartbeat":
            state = raw["state"]
            self._other_layout = raw["layout"] if raw["layout"] not in (0, self._table.layout) else 0
            self.lockstep |= state == RigState.LOCKSTEP
            if (last := self._beat) is not None:
                # The time of one rig never steps back, and it prepares once.
                stepped_back = (raw["time"] - last["time"]) % _WRAP >= _WRAP // 2
                self._is_restarted |= stepped_back or state == RigState.PREPARING != last["state"]
            self._beat = raw
        if self._new_sync is not None and self.rates is not None and (rate_hz := self.rates["rate"]):
            near = (self._sync or 0) if self._clock_s is None else self._clock_s * rate_hz
            self._sync, self._new_sync = full_index(self._new_sync, near), None
            if self._on_frame is not None:
                self._on_frame("Sync", {"index": self._sync, "rate": rate_hz})
        if self.lockstep and self._sync is None and self.rates is not None and self._beat is not None:
            # No Sync before the first step: the next samples follow the last block.
            self._sync = self._beat["time"] * self.rates["rate"] // 1_000_000
        if self._on_frame is not None and row.name != "Sync":
            self.deliver()
            self._on_frame(row.name, raw)
        has_clock = self._clock_s is not None or self._has_no_clock
        if has_clock and self._sync is not None and self.rates is not None and self.rates["rate"]:
            self._rates_known.set()
        return state

    def deliver(self) -> None:
        """Pass the decoded frames to the reader."""
        with self._lock:
            rates, decoder, take = self.rates, self._decoder, self._on_samples
            if decoder is None or take is None or rates is None or self._sync is None:
                return
            batch, self._batch = self._batch, {}
            step = rates[f"{self._layout_name}_step"]
            if (rates["rate"], step) != self._started:
                # Frames of another run, whose numbers count something else.
                return
            for identifier, frames in batch.items():
                name = self._wanted[identifier]
                for samples in decoder.decode(name, frames, rates["rate"], step, self._sync):
                    take(name, samples)

    def _finish(self, reason: str) -> None:
        with self._lock:
            self._end_reason = reason
            self.deliver()
            end, names = self._on_end, list(self._wanted.values())
        for name in names:
            if end is not None:
                end(name, reason)

    @property
    def statistics(self) -> dict[str, Any]:
        """Count of sample frames with a wrong length (`malformed`)."""
        return {"malformed": 0 if self._decoder is None else self._decoder.malformed}

    def report_position(self, index: int | None, *, room: int, lost: int) -> None:
        """Ignore the reader's position, for which frames do not exist."""

    def close(self) -> None:
        """Leave the bus; further calls have no effect."""
        if self._closed:
            return
        import can

        self._closed = True
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)
        with contextlib.suppress(can.CanError):  # its adapter may be gone
            self._bus.shutdown()
