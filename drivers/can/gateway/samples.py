"""Sample frames: converts the rig's blocks to complete frames of complete instants."""

from __future__ import annotations

import numpy as np

from drivers.can.bus.frame import BRS, FD, FD_WIDTH, RECORDS, octets
from drivers.can.message import ABSENT, CanMessage
from drivers.can.schedule import Schedule
from drivers.can.signals import find_mismatch
from rig.base import wire
from rig.base.errors import InputError, Words
from rig.channels.table import ChannelTable

_MAX_WAITING_ROWS = 50_000
"""Longest wait for another group's samples: 5 s at the usual rate."""


class SampleFrames:
    """Builds the sample frames of one message: only complete frames, so the last instants of a run may be missing.

    Args:
        message: A message with samples.
        step: Decimation [samples of the recording].
        columns: Columns of each group's blocks to send, for the groups that the rig has.
    """

    def __init__(self, message: CanMessage, step: int, columns: dict[str, list[int]]) -> None:
        assert message.samples is not None
        self.message = message
        self.step = step
        self.columns = columns
        self._samples = message.samples
        self._waiting: dict[str, np.ndarray] = {}
        """Decimated samples of each group that are in no frame yet, shape (rows, channels of the group in the message).
        """
        self._places = {
            group: [place for place, channel in enumerate(message.samples.channels) if channel.group == group]
            for group in columns
        }
        self._rows = wire.Continuity()
        """Received rows of each group, and built frames."""

    @property
    def skipped(self) -> int:
        """Frames that could not be built because samples were missing."""
        return self._rows.lost.get("", 0)

    def take(self, group: str, block: wire.Block) -> tuple[np.ndarray, np.ndarray] | None:
        """Add a block of a channel group.

        Returns:
            The frames that are complete now, or None: numbers of their last instants in the recording, shape (frames,),
            and their data, uint8, shape (frames, length).
        """
        first = -(-block.index // self.step)
        counts = block.values[first * self.step - block.index :: self.step]
        if len(self.columns[group]) < counts.shape[1]:
            counts = counts[:, self.columns[group]]
        gap = self._rows.follow(group, first, len(counts))
        if gap is None and group in self._waiting:
            counts = np.concatenate((self._waiting[group], counts))
        # Bounded, as another group of the message may be held back or stopped.
        self._waiting[group] = counts[-_MAX_WAITING_ROWS:]
        if len(self._waiting) < len(self.columns):
            return None
        rows, ends = self._samples.rows, {name: self._rows.next[name] for name in self.columns}
        low = -(-max(end - len(self._waiting[name]) for name, end in ends.items()) // rows)
        high = min(ends.values()) // rows
        if high <= low:
            return None
        values = np.zeros(((high - low) * rows, len(self._samples.channels)), np.int32)
        for name, end in ends.items():
            start = low * rows - (end - len(self._waiting[name]))
            values[:, self._places[name]] = self._waiting[name][start : start + len(values)]
            self._waiting[name] = self._waiting[name][start + len(values) :]
        self._rows.follow("", low, high - low)
        numbers = np.arange(low, high) * rows
        data = self._samples.pack(numbers * self.step if self.message.fd else numbers, values, self.message.length)
        self._mark_absent(data)
        return (numbers + rows - 1) * self.step, data

    def _mark_absent(self, data: np.ndarray) -> None:
        """Mark each channel that the rig does not have as absent, in classic frames."""
        missing = np.frombuffer(ABSENT.to_bytes(2, "little", signed=True), np.uint8)
        for place, channel in enumerate(self._samples.channels):
            if channel.group not in self.columns:
                start = self._samples.index_width + 2 * place
                data[:, start : start + 2] = missing


def find_decimations(table: ChannelTable, schedule: Schedule) -> tuple[int, dict[bool, int]]:
    """Return the rig's sample rate [Hz], and the decimation for FD (True) and classic frames.

    Raises:
        InputError: The samples cannot be sent at that rate, or have another calibration than the messages.
    """
    rates = {group.rate_hz for group in table.groups.values()}
    if len(rates) != 1:
        raise InputError("sample rates", "the same for all channel groups on a CAN bus", sorted(rates))
    rate = rates.pop()
    can_channels = {each.name: each for row in schedule.table.fd if row.samples for each in row.samples.channels}
    if (name := find_mismatch(table, can_channels)) is not None:
        raise InputError(f"channel {name}", "calibrated as in the channel table of the messages", name)
    for name, channel in can_channels.items():
        if channel.group in table.groups and name not in table.groups[channel.group].names:
            must = f"sent with its group, {channel.group}, on a CAN bus"
            raise InputError(f"channel {name}", must, Words("no such channel"))
    decimations = {}
    for fd, wanted in ((True, schedule.fd_hz), (False, schedule.classic_hz)):
        if wanted is not None:
            if rate % wanted:
                raise InputError("--can-rate", f"a divisor of the samples' rate, {rate} Hz", wanted)
            decimations[fd] = rate // wanted
    return rate, decimations


def make_sample_frames(table: ChannelTable, schedule: Schedule, decimations: dict[bool, int]) -> list[SampleFrames]:
    """Return the builders of all sample messages that are sent, with the channels that the rig has."""
    builders = []
    for message in (*schedule.table.fd, *schedule.table.classic):
        if message.samples is None or message.fd not in decimations:
            continue
        columns = {
            group: [table.groups[group].names.index(row.name) for row in message.samples.channels if row.group == group]
            for group in message.samples.groups
            if group in table.groups
        }
        if columns:
            builders.append(SampleFrames(message, decimations[message.fd], columns))
    return builders


def make_records(message: CanMessage, data: np.ndarray) -> np.ndarray:
    """Return frames as an array of the widest layout of `drivers.can.bus.frame.RECORDS`, shape (frames,).

    Args:
        message: Their message.
        data: uint8, shape (frames, length).
    """
    records = np.zeros(len(data), RECORDS[FD_WIDTH])
    records["identifier"] = message.identifier
    records["length"] = message.length
    records["flags"] = FD | BRS if message.fd else 0
    octets(records)[:, : message.length] = data
    return records
