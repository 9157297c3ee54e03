"""Task of a program: start, stop and reads."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from nidaqmx.constants import AcquisitionType, ChannelType, SampleTimingType

from drivers.daqmx.hardware.device import Device
from drivers.daqmx.hardware.errors import Code, DaqmxError
from drivers.daqmx.tasks.acquisition import Acquisition, Plan
from drivers.daqmx.tasks.configuration import Configuration
from drivers.daqmx.tasks.counters import Counter
from drivers.link import LinkTimeoutError
from drivers.sources import Source
from drivers.sources.samples import ALL_AVAILABLE, Samples, StreamEndedError, merge_samples
from rig.serve.waiting import Deadline

_MAX_READ = 1 << 23
"""Largest number of values of all channels that a read may want: 67 MB in a reply, and as much for each copy."""
POLL_S = 0.2
"""Period at which a waiting call checks whether its program still waits [s]."""


class Task(Configuration):
    """A task; calls of several threads are safe.

    Args:
        name: Name.
        device: The device.
        open_source: Opens a source of counts.
    """

    def __init__(self, name: str, device: Device, open_source: Callable[[], Source]) -> None:
        super().__init__(device)
        self.name = name
        self.position = 0
        """Samples read since the start."""
        self.acquisition: Acquisition | None = None
        self.output: Callable[[range], None] | None = None
        """Writes the output samples of a range to the lines, for a task with a sample clock."""
        self._cleared = self._aborted = False
        self._generator = threading.Thread()
        self._plan = Plan(0)
        self._open_source = open_source

    def start(self) -> None:
        """Start.

        Raises:
            DaqmxError: The task runs or was cleared, or its settings do not match the device.
        """
        with self.changed:
            self._check_stopped()
            if self._cleared:
                raise DaqmxError(Code.INVALID_TASK, f"{self.name!r} was cleared")
            names, rate_hz, plan = self.plan()
            if names:
                generates = self.kind is ChannelType.DIGITAL_OUTPUT
                if generates and self.output is None:
                    raise DaqmxError(Code.OUTPUT_BUF_SIZE_TOO_SMALL_TO_START_GEN, "write samples first")
                source = self._open_source()
                try:
                    self.acquisition = Acquisition(source, names, rate_hz, plan)
                except BaseException:
                    source.close()
                    raise
                if generates:
                    self._generator = threading.Thread(target=self._generate, args=(self.acquisition,), daemon=True)
                    self._generator.start()
            self._plan, self.position, self.started, self._aborted = plan, 0, True, False
            self.changed.notify_all()

    def stop(self, *, clear: bool = False, abort: bool = False) -> None:
        """Stop; unread samples are discarded.

        Args:
            clear: The task cannot be started again, by a call in progress.
            abort: A read that follows is an error and does not start the task, unless its program stops or starts it.
        """
        with self.changed:
            self._cleared |= clear
            self._aborted = abort and (self.started or self._aborted)
            acquisition, self.acquisition, self.started, self.position = self.acquisition, None, False, 0
            self.changed.notify_all()
        if acquisition is not None:
            acquisition.close()

    @property
    def done(self) -> bool:
        """Return whether no acquisition runs.

        Raises:
            DaqmxError: The acquisition ended by an error.
        """
        acquisition = self.acquisition
        if acquisition is None:
            return True
        if acquisition.failure is not None:
            raise DaqmxError(*acquisition.failure)
        if acquisition.ended is not None and not acquisition.complete:
            raise DaqmxError(Code.DEV_CANNOT_BE_ACCESSED, acquisition.ended)
        return acquisition.complete and not self._generator.is_alive()

    def wait_for_change(self, timeout_s: float) -> None:
        """Wait for the next start or stop."""
        with self.changed:
            self.changed.wait(timeout_s)

    def wait(self, timeout_s: float, active: Callable[[], bool]) -> None:
        """Wait until the task is done.

        Raises:
            DaqmxError: It is not in time, or the acquisition ended by an error.
        """
        deadline = Deadline(None if timeout_s < 0.0 else timeout_s)
        while not self.done:
            if deadline.passed or not active():
                raise DaqmxError(Code.WAIT_UNTIL_DONE_DOES_NOT_INDICATE_DONE, f"not done after {timeout_s:g} s")
            if (acquisition := self.acquisition) is not None:
                acquisition.wait(timeout_s=min(POLL_S, deadline.left_s))
                if self._generator.is_alive():
                    self._generator.join(min(POLL_S, deadline.left_s))

    def _generate(self, acquisition: Acquisition) -> None:
        """Write the output samples at the sample clock: those of a block when the block arrives."""
        number = 0
        while self.acquisition is acquisition and not (acquisition.done and not acquisition.available):
            with contextlib.suppress(LinkTimeoutError, StreamEndedError):
                arrived = len(acquisition.read(ALL_AVAILABLE, timeout_s=POLL_S, whole=False))
                if self.acquisition is acquisition and self.output is not None:
                    self.output(range(number, number + arrived))
                number += arrived

    # ---- reads ----

    @property
    def counter(self) -> Counter | None:
        """Measurement of a counter, once the task runs."""
        return self._plan.measure if self.started else None

    def read(self, count: int, timeout_s: float, active: Callable[[], bool]) -> tuple[Samples, int]:
        """Return the next samples, and 0 or the code of the error that made them fewer than wanted.

        Args:
            count: Number of samples; negative: all of a finite acquisition, or all available.
            timeout_s: Longest wait [s]; negative: none.
            active: Returns whether the program still waits.

        Raises:
            DaqmxError: Samples were lost, the rig is lost, or the task cannot be read.
        """
        if self.kind not in (ChannelType.ANALOG_INPUT, ChannelType.COUNTER_INPUT, ChannelType.DIGITAL_INPUT):
            raise DaqmxError(Code.READ_NO_INPUT_CHANS_IN_TASK, "the task has outputs only")
        if count * len(self.channels) > _MAX_READ:
            raise DaqmxError(Code.PAL_MEMORY_FULL, f"{count} samples of {len(self.channels)} channels in one read")
        automatic = not self.started
        if automatic:
            if not self.settings["AUTO_START"]:
                raise DaqmxError(Code.CANNOT_READ_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED, "start it")
            if self._aborted:
                raise DaqmxError(Code.OPERATION_ABORTED, "the device was reset; start the task again")
            self.start()
        acquisition, plan = self.acquisition, self._plan
        if acquisition is None:
            raise DaqmxError(Code.OPERATION_ABORTED, "the task was stopped")
        try:
            samples, status = self._wait_for_samples(acquisition, plan, count, timeout_s, active)
            while plan.newest_only and not status and len(samples) < count:
                more, status = self._wait_for_samples(acquisition, plan, 1, timeout_s, active)
                samples = merge_samples(samples, more)
            self.position += len(samples)
            return samples, status
        finally:
            if automatic and (plan.newest_only or (acquisition.complete and not acquisition.available)):
                self.stop()

    def _wait_for_samples(
        self, acquisition: Acquisition, plan: Plan, count: int, timeout_s: float, active: Callable[[], bool]
    ) -> tuple[Samples, int]:
        whole, keep = True, None if plan.retrigger else plan.keep
        if count < 0:
            whole = keep is not None and not self.settings["READ_ALL_AVAIL_SAMP"]
            count = keep - self.position if keep is not None and whole else ALL_AVAILABLE
        if plan.newest_only:
            count, whole = 1, True
        if keep is not None and whole and self.position + count > keep:
            detail = f"{count} samples from {self.position} on; the finite acquisition has {keep}"
            raise DaqmxError(Code.SAMPLES_WILL_NEVER_BE_AVAILABLE, detail)
        deadline = Deadline(None if timeout_s < 0.0 else timeout_s)
        if count == 0:
            return self._no_samples(), 0
        while True:
            if acquisition.failure is not None:
                raise DaqmxError(*acquisition.failure)
            try:
                samples = acquisition.read(count, timeout_s=min(POLL_S, deadline.left_s), whole=whole)
                short = whole and len(samples) < count
                return samples, int(Code.DEV_CANNOT_BE_ACCESSED) if short else 0
            except LinkTimeoutError:
                if not active():
                    raise DaqmxError(Code.OPERATION_ABORTED, "the program no longer waits") from None
                if deadline.passed:
                    return next(acquisition.ready(), self._no_samples()), int(Code.SAMPLES_NOT_YET_AVAILABLE)
            except StreamEndedError as error:
                closed = self.acquisition is not acquisition
                if closed:
                    raise DaqmxError(Code.OPERATION_ABORTED, "the task was stopped") from None
                raise DaqmxError(Code.DEV_CANNOT_BE_ACCESSED, str(error)) from None

    def _no_samples(self) -> Samples:
        width = self._plan.columns
        return Samples(0, 0, 1.0, 1.0, ("",) * width, ("",) * width, np.zeros((0, width), dtype=np.int32))

    def attributes(self) -> dict[str, Any]:
        """Return the properties of the task, by their names in the protocol."""
        acquisition, lines = self.acquisition, [len(channel.physical) for channel in self.channels]
        names = ", ".join(channel.name for channel in self.channels)
        available = 0 if acquisition is None else acquisition.available
        finite = self.settings["SAMP_QUANT_SAMP_MODE"] == AcquisitionType.FINITE.value
        clocked = self.settings["SAMP_TIMING_TYPE"] != SampleTimingType.ON_DEMAND.value
        wanted = max(0, self.settings["SAMP_QUANT_SAMP_PER_CHAN"] - self.position)
        default = wanted if finite and clocked and not self.settings["READ_ALL_AVAIL_SAMP"] else available
        return self.settings | {
            "NAME": self.name, "CHANNELS": names, "CHANNELS_TO_READ": names, "NUM_CHANS": len(self.channels),
            "DEVICES": self.device.name if self.channels else "", "NUM_DEVICES": int(bool(self.channels)),
            "AVAIL_SAMP_PER_CHAN": available, "CURR_READ_POS": self.position,
            "TOTAL_SAMP_PER_CHAN_ACQUIRED": 0 if acquisition is None else acquisition.acquired,
            "DEFAULT_NUMBER_OF_SAMPLES_TO_READ": default if clocked else 1,
            "DIGITAL_LINES_BYTES_PER_CHAN": max(lines, default=0), "RAW_DATA_WIDTH": 4 * len(self.channels),
            "OVERLOADED_CHANS_EXIST": False, "INPUT_ONBRD_BUF_SIZE": 0,
            "SAMP_CLK_MAX_RATE": float(min(channel.rate_hz for channel in self.device.table.channels.values())),
        }  # fmt: skip
