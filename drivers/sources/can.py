"""Samples from a CAN bus: one stream a message of `drivers.can.signals`, in the FD layout where it is sent.

Numbers in the frames wrap. Rates contains the decimation, Sync the sample number that is due now, and Clock the
simulated time, which gives the number in full. Frames that come before Rates and Sync wait for them. Nothing is sent:
the client takes part in the bus only by acknowledging.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivers.can.message import Message, MessageTable
from drivers.can.signals import State, default_messages, messages_for
from drivers.link import LinkTimeoutError
from drivers.sources.samples import Samples
from drivers.sources.stream import RIG_GONE, whole_step
from rig.base.errors import InputError
from rig.channels.channel_file import read_channels
from rig.channels.table import default_table
from rig.serve.waiting import Deadline

_PATIENCE_S = 3.0
"""A bus that is silent for so long has no rig any more, whose heart beats once a second."""
_PORTION_S = 0.01
_SETTLED_S = 0.05
"""When nothing new was seen for so long, all that there is has been seen."""
_EARLY = 50_000
"""Frames that wait for Rates and Sync: about 5 s of everything."""
_TICK_RATE_HZ = 1e6
_WRAP = 1 << 32
"""The index in a Sync is modulo this number of samples: 59.7 h at 20 kHz."""


class Layout:
    """Puts frames of samples together; sans-IO.

    Args:
        messages: Those whose samples are wanted, by name.
        thinned: Every so many instants of those in the frames are taken.
    """

    def __init__(self, messages: dict[str, Message], thinned: int = 1) -> None:
        self._messages = messages
        self._thinned = thinned
        self._expected: dict[str, int] = {}
        """Number of the instant that comes next, in the recording."""
        self.malformed = 0

    def decode(self, name: str, frames: list[bytes], rate_hz: int, step: int, about: int) -> list[Samples]:
        """Samples of frames of one message, in the order in which they came.

        Args:
            name: Of the message.
            frames: Data.
            rate_hz: Rate of the recording [Hz].
            step: Samples of the recording from one instant to the next.
            about: Number in the recording that is near those of the first frame.
        """
        message = self._messages[name]
        form = message.samples
        assert form is not None
        whole = [data for data in frames if len(data) == message.length]
        self.malformed += len(frames) - len(whole)
        if not whole:
            return []
        short, values = form.unpack(np.frombuffer(b"".join(whole), np.uint8).reshape(-1, message.length))
        unit = step if form.index_width < 4 else 1
        numbers = _lengthen(short, 8 * form.index_width, self._expected.get(name, about) // unit) * unit
        span = form.rows * step
        self._expected[name] = int(numbers[-1]) + span
        engineering = form.engineering(values)
        found = []
        for run in np.split(np.arange(len(numbers)), np.flatnonzero(np.diff(numbers) != span) + 1):
            index = int(numbers[run[0]]) // step
            rows = engineering[run[0] * form.rows : (run[-1] + 1) * form.rows]
            first = -index % self._thinned
            if len(rows) > first:
                found.append(
                    Samples(
                        index=(index + first) // self._thinned,
                        tick=round((index + first) * step * _TICK_RATE_HZ / rate_hz),
                        rate_hz=rate_hz / step / self._thinned,
                        tick_rate_hz=_TICK_RATE_HZ,
                        names=tuple(channel.name for channel in form.channels),
                        units=tuple(channel.unit for channel in form.channels),
                        values=rows[first :: self._thinned],
                    )
                )
        return found


def _lengthen(short: np.ndarray, bits: int, about: int) -> np.ndarray:
    """Whole numbers whose last bits are given, the first near `about`, each next near the one before."""
    modulus = 1 << bits
    first = about + (int(short[0]) - about + modulus // 2) % modulus - modulus // 2
    steps = (np.diff(short) + modulus // 2) % modulus - modulus // 2
    return first + np.concatenate([[0], np.cumsum(steps)])


def full_index(short: int, near: int) -> int:
    """Return the number of a sample of which the last 32 bits are known, within 2^31 samples of another one."""
    return near + (short - near + _WRAP // 2) % _WRAP - _WRAP // 2


class CanSource:
    """The rig's sample messages on a bus.

    Args:
        spec: INTERFACE:CHANNEL?NAME=VALUE&... of python-can's bus; `layout=fd` or `layout=classic` chooses one where
            both are sent, `channels=FILE.toml` says which channel table the rig runs with, and `node=N` is the number
            as a device under test.
        wait_s: How long to wait for a rig to be there [s]; it tells of itself once a second.
        table: Messages; by default those of the rig's own channel table.
        on_frame: Takes name and raw values of each frame of the rig that carries no samples, behind those that came
            before it; on the thread that reads. Of a Sync it receives `index` without the wrap, and `rate`, once Rates
            has come.

    Raises:
        InputError: There is no such bus.
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
        self._wish = settings.pop("layout", None)
        if self._wish not in (None, "fd", "classic"):
            raise InputError("layout", "fd or classic", self._wish)
        self.node = settings.pop("node", 1)
        """Number as a device under test."""
        self.channels = default_table()
        """The channel table that is believed."""
        if (channels := settings.pop("channels", None)) is not None:
            self.channels = read_channels(Path(channels))
            table = messages_for(self.channels)
        self.table = self._table = table or default_messages()
        self._on_frame = on_frame
        self._other_layout = 0
        self._wait_s = wait_s
        self._bus = open_bus(spec, interface, channel, **settings)
        self._lock = threading.RLock()
        self.rates: dict[str, int] | None = None
        """How samples are picked, as the rig tells it last."""
        self.lockstep = False
        """Whether the rig runs in lockstep, where nothing comes before it is stepped."""
        self._started = (0, 0)
        self._sync: int | None = None
        self._new_sync: int | None = None
        """Index of the latest Sync, as it is in the frame, until Rates has come."""
        self._clock_s: int | None = None
        """Simulated time of the latest Clock [s]."""
        self._end_us = 0
        self._known = threading.Event()
        self._early: deque[tuple[int, bytes]] = deque(maxlen=_EARLY)
        self._portion: dict[int, list[bytes]] = {}
        self._layout: Layout | None = None
        self._wanted: dict[int, str] = {}
        self._on_samples: Callable[[str, Samples], None] | None = None
        self._on_end: Callable[[str, str], None] | None = None
        self._closed = False
        self._identifiers = {name: row.identifier for name, row in self._table.by_name.items()}
        self._seen: dict[int, None] = {}
        self._sampled = {row.identifier for row in (*self._table.fd, *self._table.classic)}
        self._thread = threading.Thread(target=self._read, name=f"can {channel} reads", daemon=True)
        self._thread.start()

    def streams(self) -> dict[str, tuple[str, ...]]:
        """The sample messages of the layout that is sent.

        Raises:
            InputError: No rig is on that bus.
        """
        self.wait()
        assert self.rates is not None
        if self._other_layout:
            must = f"a rig with the sample messages {self._table.layout} (?channels=FILE.toml tells of others)"
            raise InputError("can", must, self._other_layout)
        layout = self._wish or ("fd" if self.rates["fd_step"] else "classic")
        if not self.rates[f"{layout}_step"]:
            raise InputError("layout", "one that the rig sends", layout)
        self._wish = layout
        rows = self._table.fd if layout == "fd" else self._table.classic
        # A run may lack groups: only what has been seen is there; of lockstep, all that may come.
        count = -1
        for _ in Deadline(_PATIENCE_S).polls(_SETTLED_S):
            if self.lockstep or count >= max(1, len(self._seen)):
                break
            count = len(self._seen)
        return {
            row.name: tuple(channel.name for channel in row.samples.channels)
            for row in rows
            if row.samples and (self.lockstep or row.identifier in self._seen)
        }

    def wait(self) -> None:
        """Wait until a rig is there, and it is known how samples are picked.

        Raises:
            InputError: No rig is on that bus.
        """
        if not self._known.wait(self._wait_s) or self.rates is None:
            must = f"a bus with a rig on it (no Rates and Sync in {self._wait_s:g} s)"
            raise InputError("can", must, self._bus.channel_info)

    def send(self, identifier: int, data: bytes) -> None:
        """Send one classic frame.

        Raises:
            LinkTimeoutError: The bus does not take it.
        """
        import can

        try:
            self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False), timeout=1.0)
        except (can.CanError, OSError, ValueError) as error:
            raise LinkTimeoutError(f"can: the bus does not take a frame ({error})") from None

    def start(
        self,
        streams: Sequence[str],
        rate_hz: float | None,
        on_samples: Callable[[str, Samples], None],
        on_end: Callable[[str, str], None],
    ) -> float:
        """Begin with what has come since the source was opened."""
        rates = self.rates
        assert rates is not None
        self._started = (rates["rate"], rates[f"{self._wish}_step"])
        native = rates["rate"] / rates[f"{self._wish}_step"]
        thinned = 1 if rate_hz is None else whole_step(native, rate_hz)
        with self._lock:
            self._layout = Layout({name: self._table.by_name[name] for name in streams}, thinned)
            self._wanted = {self._identifiers[name]: name for name in streams}
            self._on_samples, self._on_end = on_samples, on_end
            early, self._early = self._early, deque(maxlen=1)
            for identifier, data in early:
                if identifier in self._wanted:
                    self._portion.setdefault(identifier, []).append(data)
            self.hand_on()
        return native / thinned

    def _read(self) -> None:
        import can

        heard = handed = time.monotonic()
        beat = None
        while not self._closed:
            try:
                message = self._bus.recv(_PORTION_S)
            except (can.CanError, OSError, ValueError):
                break
            now = time.monotonic()
            if message is not None:
                if not (message.is_error_frame or message.is_remote_frame or message.is_extended_id):
                    heard = now
                    state = self.take(message.arbitration_id, bytes(message.data))
                    beat = beat if state is None else state
            elif self._on_samples is not None and now - heard > _PATIENCE_S:
                break
            if now - handed > _PORTION_S:
                handed = now
                self.hand_on()
            if beat == State.ENDED and message is None:
                # The bus is silent, so nothing of the run is still to come.
                self._finish("the rig's run has ended")
                return
        self._finish(RIG_GONE)

    def take(self, identifier: int, data: bytes) -> int | None:
        """A frame; returns the state in a heartbeat."""
        if identifier in self._sampled:
            with self._lock:
                if self._on_samples is None:
                    self._seen[identifier] = None
                    self._early.append((identifier, data))
                elif identifier in self._wanted:
                    self._portion.setdefault(identifier, []).append(data)
            return None
        row = self._table.by_identifier.get(identifier)
        if row is None or len(data) != row.length:
            return None
        raw, state = row.decode(data), None
        if row.name == "Sync":
            self._new_sync = raw["index"]
        elif row.name == "Clock":
            self._clock_s = raw["seconds"]
            self._new_sync = self._new_sync if self._sync is None else self._sync % _WRAP
        elif row.name == "Rates":
            self.rates = raw
        elif row.name == "Heartbeat":
            state = raw["state"]
            self._other_layout = raw["layout"] if raw["layout"] not in (0, self._table.layout) else 0
            self.lockstep |= state == State.LOCKSTEP
            self._end_us = raw["time"]
        if self._new_sync is not None and self.rates is not None and (rate_hz := self.rates["rate"]):
            near = (self._sync or 0) if self._clock_s is None else self._clock_s * rate_hz
            self._sync, self._new_sync = full_index(self._new_sync, near), None
            if self._on_frame is not None:
                self._on_frame("Sync", {"index": self._sync, "rate": rate_hz})
        if self.lockstep and self._sync is None and self.rates is not None:
            # No Sync before the first step: what comes next is behind the last block.
            self._sync = self._end_us * self.rates["rate"] // 1_000_000
        if self._on_frame is not None and row.name != "Sync":
            self.hand_on()
            self._on_frame(row.name, raw)
        if self._sync is not None and self.rates is not None and self.rates["rate"]:
            self._known.set()
        return state

    def hand_on(self) -> None:
        """Give what has come to whoever takes it."""
        with self._lock:
            rates, layout, take = self.rates, self._layout, self._on_samples
            if layout is None or take is None or rates is None or self._sync is None:
                return
            portion, self._portion = self._portion, {}
            step = rates[f"{self._wish}_step"]
            if (rates["rate"], step) != self._started:
                # Another run, of which the numbers mean something else.
                return
            for identifier, frames in portion.items():
                name = self._wanted[identifier]
                for samples in layout.decode(name, frames, rates["rate"], step, self._sync):
                    take(name, samples)

    def _finish(self, reason: str) -> None:
        with self._lock:
            self.hand_on()
            end, names = self._on_end, list(self._wanted.values())
        for name in names:
            if end is not None:
                end(name, reason)

    @property
    def statistics(self) -> dict[str, Any]:
        """Frames that were no samples though their identifier says so."""
        return {"malformed": 0 if self._layout is None else self._layout.malformed}

    def taken(self, index: int | None, *, room: int, lost: int) -> None:
        """A bus does not ask how far its nodes are."""

    def close(self) -> None:
        """Leave the bus; may be called again."""
        if self._closed:
            return
        self._closed = True
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)
        self._bus.shutdown()
