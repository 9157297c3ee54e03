"""Samples as frames: what a rig's blocks become on a bus, whole frames of whole instants."""

from __future__ import annotations

import numpy as np

from drivers.can.bus.frame import BRS, FD, FD_WIDTH, RECORDS, octets
from drivers.can.message import ABSENT, Message
from drivers.can.schedule import Schedule
from drivers.can.signals import unlike
from rig.base import wire
from rig.base.errors import InputError
from rig.channels.table import ChannelTable

_MOST_KEPT = 50_000
"""Picked samples of a group that wait for those of another: 5 s at the usual rate."""


class SampleFrames:
    """The samples of one message; only whole frames are made, so the last instants of a run may never be sent.

    Args:
        message: With samples.
        step: Samples of the recording from one to the next.
        columns: Columns of each sensor group's blocks, for the groups that the rig has.
    """

    def __init__(self, message: Message, step: int, columns: dict[str, list[int]]) -> None:
        assert message.samples is not None
        self.message = message
        self.step = step
        self.columns = columns
        self._samples = message.samples
        self._kept: dict[str, np.ndarray] = {}
        """Picked samples of each group that are in no frame yet, shape (rows, channels of it that the message has)."""
        self._places = {
            group: [place for place, channel in enumerate(message.samples.channels) if channel.group == group]
            for group in columns
        }
        self._rows = wire.Continuity()
        """Of the picked samples of each group, and of the frames."""

    @property
    def skipped(self) -> int:
        """Frames that never were, because samples were missing."""
        return self._rows.lost.get("", 0)

    def take(self, group: str, block: wire.Block) -> tuple[np.ndarray, np.ndarray] | None:
        """Add a block of a sensor group.

        Returns:
            What is complete with it, if anything: due numbers of the frames' last instants in the recording, shape
            (frames,), and data of the frames, uint8, shape (frames, length).
        """
        first = -(-block.index // self.step)
        counts = block.values[first * self.step - block.index :: self.step]
        if len(self.columns[group]) < counts.shape[1]:
            counts = counts[:, self.columns[group]]
        gap = self._rows.follow(group, first, len(counts))
        if gap is None and group in self._kept:
            counts = np.concatenate((self._kept[group], counts))
        # Where another group of the message is held back, or has stopped, its own does not pile up for ever.
        self._kept[group] = counts[-_MOST_KEPT:]
        if len(self._kept) < len(self.columns):
            return None
        rows, ends = self._samples.rows, {name: self._rows.next[name] for name in self.columns}
        low = -(-max(end - len(self._kept[name]) for name, end in ends.items()) // rows)
        high = min(ends.values()) // rows
        if high <= low:
            return None
        values = np.zeros(((high - low) * rows, len(self._samples.channels)), np.int32)
        for name, end in ends.items():
            start = low * rows - (end - len(self._kept[name]))
            values[:, self._places[name]] = self._kept[name][start : start + len(values)]
            self._kept[name] = self._kept[name][start + len(values) :]
        self._rows.follow("", low, high - low)
        numbers = np.arange(low, high) * rows
        data = self._samples.pack(numbers * self.step if self.message.fd else numbers, values, self.message.length)
        self._mark_absent(data)
        return (numbers + rows - 1) * self.step, data

    def _mark_absent(self, data: np.ndarray) -> None:
        """Classic frames say of each channel that the rig does not have that it is not there."""
        missing = np.frombuffer(ABSENT.to_bytes(2, "little", signed=True), np.uint8)
        for place, channel in enumerate(self._samples.channels):
            if channel.group not in self.columns:
                start = self._samples.index_width + 2 * place
                data[:, start : start + 2] = missing


def steps(table: ChannelTable, schedule: Schedule) -> tuple[int, dict[bool, int]]:
    """Rate of the rig's samples, and how many go from one to the next, for FD (True) and classic frames.

    Raises:
        InputError: They cannot be sent at that rate, or have another calibration than the messages.
    """
    rates = {group.rate_hz for group in table.groups.values()}
    if len(rates) != 1:
        raise InputError("sample rates", "the same for all sensor groups to go on a CAN bus", sorted(rates))
    rate = rates.pop()
    known = {channel.name: channel for row in schedule.table.fd if row.samples for channel in row.samples.channels}
    if (name := unlike(table, known)) is not None:
        raise InputError(f"channel {name}", "calibrated as in the channel table that the messages are made of", name)
    found = {}
    for fd, wanted in ((True, schedule.fd_hz), (False, schedule.classic_hz)):
        if wanted is not None:
            if rate % wanted:
                raise InputError("--can-rate", f"a divisor of the samples' rate, {rate} Hz", wanted)
            found[fd] = rate // wanted
    return rate, found


def sample_frames(table: ChannelTable, schedule: Schedule, picked: dict[bool, int]) -> list[SampleFrames]:
    """Makers of all sample messages that are sent, for what the rig has of their channels."""
    found = []
    for message in (*schedule.table.fd, *schedule.table.classic):
        if message.samples is None or message.fd not in picked:
            continue
        columns = {
            group: [table.groups[group].names.index(row.name) for row in message.samples.channels if row.group == group]
            for group in message.samples.groups
            if group in table.groups
        }
        if columns:
            found.append(SampleFrames(message, picked[message.fd], columns))
    return found


def records_of(message: Message, data: np.ndarray) -> np.ndarray:
    """Frames as an array of the widest layout of `drivers.can.bus.frame.RECORDS`, shape (frames,).

    Args:
        message: What they are.
        data: uint8, shape (frames, length).
    """
    records = np.zeros(len(data), RECORDS[FD_WIDTH])
    records["identifier"] = message.identifier
    records["length"] = message.length
    records["flags"] = FD | BRS if message.fd else 0
    octets(records)[:, : message.length] = data
    return records
