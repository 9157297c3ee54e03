"""Calls that read and write samples, and events; the complete servicer."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from nidaqmx.constants import ChannelType, FillMode

from drivers.daqmx.hardware.errors import Code, DaqmxError, refuse_value
from drivers.daqmx.rpc.calls import call
from drivers.daqmx.rpc.properties import Properties
from drivers.daqmx.tasks.task import POLL_S, Task
from drivers.sources.samples import Samples

_MAX_ON_DEMAND = 10_000
"""Largest number of samples of a write without a sample clock, which sets them one after another."""
_PIECE = 1 << 16
"""Values that are Python objects at a time: they need four times the memory."""


class DaqmxServicer(Properties):
    """All calls that the device supports."""

    @call("Read(Analog|Binary(?!U)|Counter|Ctr)(Scalar)?(F64|I16|I32|U32|Freq|Time)(Ex|Scalar)?")
    def read_values(
        self, request: Any, context: Any, response: Any, family: str, first: str | None, kind: str, last: str | None
    ) -> None:
        """Read analogue inputs, scaled or as counts, or the counter."""
        task = self.task(request, ChannelType.COUNTER_INPUT if family.startswith("C") else ChannelType.ANALOG_INPUT)
        scalar = "Scalar" in (first, last)
        if scalar and len(task.channels) > 1:
            raise DaqmxError(Code.ONE_CHAN_READ_FOR_MULTI_CHAN_TASK, "read an array")
        if kind == "I16" and any(channel.fixed["AI_RAW_SAMP_SIZE"] > 16 for channel in task.channels):
            raise DaqmxError(Code.READ_DATA_TYPE_TOO_SMALL, "the converter has more than 16 bits; read 32 bits")
        fields = [one.name for one in response.DESCRIPTOR.fields if one.name not in ("status", "samps_per_chan_read")]
        counter = task.counter
        if counter is not None and counter.clocked and not task.clocked:
            values, status = np.array([[counter.count]]), 0
        else:
            count = 1 if scalar else request.num_samps_per_chan
            samples, status = task.read(count, request.timeout, context.is_active)
            values = _scale(task, samples) if family == "Analog" else samples.values
        width = len(fields) if task.kind is ChannelType.COUNTER_INPUT else len(task.channels)
        if len(values) and (values.shape[1] != width or (kind == "U32" and values.dtype.kind == "f")):
            raise DaqmxError(Code.INCORRECT_READ_FUNCTION, "the counter measures something else")
        if scalar:
            if status:
                raise DaqmxError(Code(status), "no sample came in time")
            for name, value in zip(fields, values[0].tolist(), strict=True):
                setattr(response, name, value)
            return
        response.status, response.samps_per_chan_read = status, len(values)
        arrays = values.reshape(-1, width).T if family == "Ctr" else [_fill(values.reshape(-1, width), request)]
        for name, array in zip(fields, arrays, strict=True):
            for begin in range(0, len(array), _PIECE):
                getattr(response, name).extend(array[begin : begin + _PIECE].tolist())

    @call("ReadAnalogWaveforms")
    def read_waveforms(self, request: Any, context: Any, response: Any) -> None:
        """Read scaled samples with their simulated times, counted from the epoch of the format, 1904."""
        task = self.task(request, ChannelType.ANALOG_INPUT)
        samples, response.status = task.read(request.num_samps_per_chan, request.timeout, context.is_active)
        response.samps_per_chan_read = len(samples)
        ticks = round(samples.tick * 2**64 / samples.tick_rate_hz)
        for channel, column in zip(task.channels, _scale(task, samples).T, strict=True):
            waveform = response.waveforms.add(dt=1.0 / samples.rate_hz, y_data=column.tolist())
            waveform.t0.seconds, waveform.t0.fractional_seconds = divmod(ticks, 2**64)
            waveform.attributes["NI_ChannelName"].string_value = channel.name

    @call("ReadRaw")
    def read_raw(self, request: Any, context: Any, response: Any) -> None:
        """Read counts as bytes, sample after sample, with all channels of a sample together."""
        task = self.task(request, ChannelType.ANALOG_INPUT)
        size = max(channel.fixed["AI_RAW_SAMP_SIZE"] for channel in task.channels) // 8
        samples, response.status = task.read(request.num_samps_per_chan, request.timeout, context.is_active)
        response.read_array = samples.values.astype(f"<i{size}").tobytes()
        if len(response.read_array) > request.array_size_in_bytes:
            raise DaqmxError(Code.READ_BUFFER_TOO_SMALL, f"{len(response.read_array)} bytes were read")
        response.samps_read, response.num_bytes_per_samp = len(samples), size

    # ---- digital lines ----

    @call("ReadDigital(Lines|U32|ScalarU32)")
    def read_lines(self, request: Any, context: Any, response: Any, kind: str) -> None:
        """Read lines as one byte each, or as the bits of a number."""
        task = self.task(request, ChannelType.DIGITAL_INPUT, ChannelType.DIGITAL_OUTPUT)
        count, columns = 1, {}
        lines, device = [channel.physical for channel in task.channels], self._device
        if task.kind is ChannelType.DIGITAL_INPUT and task.plan()[0]:
            wanted = 1 if kind == "ScalarU32" else request.num_samps_per_chan
            samples, status = task.read(wanted, request.timeout, context.is_active)
            count, columns = len(samples), dict(zip(samples.names, samples.values.T, strict=True))
            if kind != "ScalarU32":
                response.status = status
            elif status:
                raise DaqmxError(Code(status), "no sample came in time")
        states = np.zeros((count, len(lines), max(map(len, lines))), dtype=np.uint8)
        for number, group in enumerate(lines):
            for place, line in enumerate(group):
                if (terminal := device.inputs.get(line)) is None:
                    states[:, number, place] = self._outputs.lines[device.lines[line]]
                elif count:
                    row = device.table.channels[terminal.channel]
                    states[:, number, place] = columns[row.name] * row.scale + row.offset >= terminal.level
        if kind == "Lines":
            grouped = request.fill_mode_raw == FillMode.GROUP_BY_CHANNEL.value
            response.read_array = (states.swapaxes(0, 1) if grouped else states).tobytes()
            response.samps_per_chan_read, response.num_bytes_per_samp = count, states.shape[2]
            return
        bits = np.zeros(states.shape[1:], dtype=np.int64)
        for number, group in enumerate(lines):
            bits[number, : len(group)] = [1 << _get_line(line) for line in group]
        values = (states * bits).sum(axis=2)
        if kind == "ScalarU32":
            response.value = int(values[0, 0])
        else:
            response.read_array.extend(_fill(values, request).tolist())
            response.samps_per_chan_read = count

    @call("WriteDigital(Lines|U32|ScalarU32|Waveforms)")
    def write_lines(self, request: Any, _: Any, response: Any, kind: str) -> None:
        """Set lines, given as one byte each or as the bits of a number; with a sample clock, at the clock."""
        task = self.task(request, ChannelType.DIGITAL_OUTPUT, mismatch=Code.WRITE_CHAN_TYPE_MISMATCH)
        lines = [channel.physical for channel in task.channels]
        if kind == "Waveforms":
            signals = [
                np.frombuffer(each.y_data, np.uint8).reshape(-1, max(1, each.signal_count))[:, ::-1]  # line 0 is last
                for each in request.waveforms
            ]
            if [each.shape[1] for each in signals] != list(map(len, lines)) or len(set(map(len, signals))) != 1:
                raise DaqmxError(Code.NUM_LINES_MISMATCH_IN_READ_OR_WRITE, "a signal for each line of each channel")
        elif kind == "Lines":
            data = np.frombuffer(request.write_array, dtype=np.uint8)
            signals = list(_unfill(data, request, (len(lines), max(map(len, lines)))).swapaxes(0, 1))
        else:
            data = np.array([request.value] if kind == "ScalarU32" else request.write_array, dtype=np.int64)
            columns = zip(lines, _unfill(data, request, (len(lines),)).T, strict=True)
            signals = [values[:, None] >> np.array([*map(_get_line, group)]) & 1 for group, values in columns]
        states = np.hstack([each[:, : len(group)] for group, each in zip(lines, signals, strict=True)]).astype(bool)
        names = [self._device.lines[line] for group in lines for line in group]

        def get_states(number: int) -> dict[str, bool]:
            return dict(zip(names, states[number % len(states)].tolist(), strict=True))

        if task.clocked and len(states):
            task.output = lambda numbers: self._generate([get_states(number) for number in numbers])
        self._start(task, request, len(states))
        for number in range(0 if task.clocked else len(states)):
            self._outputs.set_lines(get_states(number))
        if kind != "ScalarU32":
            response.samps_per_chan_written = len(states)

    def _generate(self, samples: list[dict[str, bool]]) -> None:
        """Set lines at the clock; like a signal without feedback, an edge that the rig refuses has no effect."""
        with contextlib.suppress(DaqmxError, ConnectionError):
            self._outputs.set_lines(*samples)

    @call("WriteAnalog(Scalar)?F64")
    def write_volts(self, request: Any, _: Any, response: Any, scalar: str | None) -> None:
        """Set the set point of the drive."""
        task = self.task(request, ChannelType.ANALOG_OUTPUT, mismatch=Code.WRITE_CHAN_TYPE_MISMATCH)
        values = [request.value] if scalar else list(request.write_array)
        self._start(task, request, len(values))
        limits = task.channels[0].attributes
        for volts in values:
            if not limits["AO_MIN"] <= volts <= limits["AO_MAX"]:
                raise DaqmxError(Code.INVALID_AO_DATA_WRITE, f"{volts:g} V is outside of the channel's limits")
            self._outputs.set_volts(volts)
        if not scalar:
            response.samps_per_chan_written = len(values)

    @staticmethod
    def _start(task: Task, request: Any, count: int) -> None:
        """Start the task of a write of a number of samples."""
        if not task.clocked and count > _MAX_ON_DEMAND:
            refuse_value("num_samps_per_chan", f"at most {_MAX_ON_DEMAND} without a sample clock", count)
        if not task.started and request.auto_start:
            task.start()
        elif not task.started and not task.clocked:
            raise DaqmxError(Code.CANNOT_WRITE_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING, "start the task")

    # ---- events ----

    @call("RegisterEveryNSamplesEvent")
    def report_samples(self, request: Any, context: Any, response: Any) -> Iterator[Any]:
        """Report each time that a number of samples was acquired."""
        task, due, acquisition = self.task(request), request.n_samples, None
        if due < 1:
            refuse_value("n_samples", "at least 1", due)
        context.send_initial_metadata(())
        while context.is_active():
            if task.acquisition is not acquisition:
                acquisition, due = task.acquisition, request.n_samples
            if acquisition is not None and acquisition.acquired >= due:
                due += request.n_samples
                kind = request.every_n_samples_event_type_raw
                yield response(every_n_samples_event_type_raw=kind, n_samples=request.n_samples)
            elif acquisition is None or acquisition.wait(timeout_s=POLL_S):
                task.wait_for_change(POLL_S)

    @call("RegisterDoneEvent")
    def report_done(self, request: Any, context: Any, response: Any) -> Iterator[Any]:
        """Report that a task is done, once for each start."""
        task, reported = self.task(request), None
        context.send_initial_metadata(())
        while context.is_active():
            acquisition = task.acquisition
            if acquisition is None or acquisition is reported or not acquisition.wait(timeout_s=POLL_S):
                task.wait_for_change(POLL_S)
                continue
            reported, status = acquisition, 0 if acquisition.complete else Code.DEV_CANNOT_BE_ACCESSED
            yield response(status=int(status if acquisition.failure is None else acquisition.failure[0]))


def _scale(task: Task, samples: Samples) -> np.ndarray:
    gain, offset = np.array([(channel.gain, channel.offset) for channel in task.channels]).T
    return samples.values * gain + offset


def _fill(values: np.ndarray, request: Any) -> np.ndarray:
    """Return an array in the layout of a request; grouped by channel, fewer samples than wanted leave a gap."""
    wanted = max(request.num_samps_per_chan, len(values))
    if request.array_size_in_samps < wanted * values.shape[1]:
        detail = f"{wanted} samples of {values.shape[1]} channels for {request.array_size_in_samps} values"
        raise DaqmxError(Code.READ_BUFFER_TOO_SMALL, detail)
    if getattr(request, "fill_mode_raw", 0) == FillMode.GROUP_BY_SCAN_NUMBER.value:
        return values.ravel()
    return np.pad(values, ((0, wanted - len(values)), (0, 0))).T.ravel()


def _unfill(data: np.ndarray, request: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return written data by sample, channel and line."""
    count = getattr(request, "num_samps_per_chan", 1)
    if data.size != count * int(np.prod(shape)):
        raise DaqmxError(Code.NUM_LINES_MISMATCH_IN_READ_OR_WRITE, f"{data.size} values for {count} samples of {shape}")
    if getattr(request, "data_layout_raw", 0) == FillMode.GROUP_BY_SCAN_NUMBER.value:
        return data.reshape(count, *shape)
    return data.reshape(shape[0], count, *shape[1:]).swapaxes(0, 1)


def _get_line(name: str) -> int:
    return int(name.rpartition("line")[2])
