"""Configuration of a task: channels, timing and triggers."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any

from nidaqmx import constants as c
from nidaqmx.utils import unflatten_channel_string

from drivers.daqmx.hardware.device import Device, Terminal
from drivers.daqmx.hardware.errors import Code, DaqmxError, name_constant, refuse_value
from drivers.daqmx.tasks.acquisition import Plan, Trigger
from drivers.daqmx.tasks.counters import Counter
from drivers.daqmx.tasks.settings import DEFAULTS, FIXED, get_buffer_size
from drivers.sources.stream import decimation_factor
from rig.base.errors import InputError
from rig.channels.table import Channel

MAX_BUFFER = 1 << 25
"""Largest number of samples of all channels in a buffer, 128 MB."""


@dataclass
class VirtualChannel:
    """Channel of a task.

    Attributes:
        name: Name.
        physical: Physical channels: one, or the lines of a digital channel.
        kind: Kind.
        gain: Unit of the measurement per count.
        offset: Value at count 0.
        attributes: Properties by name; those in `fixed` cannot be set.
    """

    name: str
    physical: list[str]
    kind: c.ChannelType
    gain: float = 1.0
    offset: float = 0.0
    attributes: dict[str, Any] = field(default_factory=dict)
    fixed: dict[str, Any] = field(default_factory=dict)


class Configuration:
    """Channels and properties of a task, which it checks against the device.

    Args:
        device: The device.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.channels: list[VirtualChannel] = []
        self.settings = dict(DEFAULTS)
        self.started = False
        """True while the task runs, also without an acquisition."""
        self.changed = threading.Condition()
        """Notified at each start and stop; its lock is held while the task changes."""

    @property
    def kind(self) -> c.ChannelType:
        """Kind of the channels.

        Raises:
            DaqmxError: The task has none.
        """
        if not self.channels:
            raise DaqmxError(Code.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK, "create a channel first")
        return self.channels[0].kind

    @property
    def clocked(self) -> bool:
        """True if the task has a sample clock."""
        return bool(self.settings["SAMP_TIMING_TYPE"] == c.SampleTimingType.SAMPLE_CLOCK.value)

    def add(self, channels: list[VirtualChannel]) -> None:
        """Add channels.

        Raises:
            DaqmxError: The task runs, a name or physical channel is in use, or the kinds differ.
        """
        with self.changed:
            self._check_stopped()
            for channel in channels:
                if self.channels and channel.kind is not self.kind:
                    raise DaqmxError(Code.MULTI_CHAN_TYPES_IN_TASK, channel.name)
                if channel.name in (other.name for other in self.channels):
                    raise DaqmxError(Code.CHAN_ALREADY_IN_TASK, channel.name)
                if set(channel.physical) & {name for other in self.channels for name in other.physical}:
                    raise DaqmxError(Code.DUPLICATE_PHYSICAL_CHANS_NOT_SUPPORTED, ", ".join(channel.physical))
                if channel.kind is c.ChannelType.COUNTER_INPUT and self.channels:
                    raise DaqmxError(Code.MULTIPLE_COUNTER_INPUT_TASK, "the device has one counter")
                self.channels.append(channel)

    def find(self, names: str) -> list[VirtualChannel]:
        """Return the channels of a list of names; without names all.

        Raises:
            DaqmxError: A channel is not in the task.
        """
        found = {channel.name.lower(): channel for channel in self.channels}
        wanted = [name.strip() for name in unflatten_channel_string(names)] or list(found)
        for name in wanted:
            if name.lower() not in found:
                raise DaqmxError(Code.INVALID_CHANNEL, f"{name} is not in the task")
        if not wanted:
            raise DaqmxError(Code.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK, "create a channel first")
        return [found[name.lower()] for name in wanted]

    def set(self, name: str, value: Any) -> None:
        """Set a property.

        Raises:
            DaqmxError: The task runs, or has no such property that can be set.
        """
        if name not in DEFAULTS:
            raise DaqmxError(Code.ATTRIBUTE_NOT_SUPPORTED_IN_TASK_CONTEXT, f"{name} cannot be set")
        if name in FIXED and value != DEFAULTS[name]:
            refuse_value(name, f"{name_constant(DEFAULTS[name])}", name_constant(value))
        with self.changed:
            self._check_stopped()
            self.settings[name] = value

    # ---- settings to a plan ----

    def plan(self) -> tuple[list[str], float, Plan]:
        """Return the channels of the table to acquire, the rate of the rig's rows [Hz] and the plan.

        Raises:
            DaqmxError: The settings do not match the device.
        """
        names = self._find_columns()
        if not names:
            return [], 0.0, Plan(0)
        columns = len(names)
        triggers = {which: self._find_trigger(which) for which in ("START", "REF")}
        names += dict.fromkeys(one.channel for one in triggers.values() if one and one.channel not in names)
        rows, settings = self.device.table.channels, self.settings
        rate_hz = float(min(rows[name].rate_hz for name in names))
        measure = self._make_counter()
        timing, mode = settings["SAMP_TIMING_TYPE"], settings["SAMP_QUANT_SAMP_MODE"]
        if timing == c.SampleTimingType.ON_DEMAND.value:
            if any(triggers.values()):
                raise DaqmxError(Code.TRIG_WHEN_ON_DEMAND_SAMP_TIMING, "give the task a sample clock")
            return names, rate_hz, Plan(columns, newest_only=True, measure=measure)
        clocked = measure is None or measure.clocked
        if timing != (c.SampleTimingType.SAMPLE_CLOCK if clocked else c.SampleTimingType.IMPLICIT).value:
            must = "a sample clock" if clocked else "implicit"
            refuse_value("SAMP_TIMING_TYPE", f"{must} for this measurement", name_constant(timing))
        step, wanted_hz = (self.check_clock(rate_hz), settings["SAMP_CLK_RATE"]) if clocked else (1, rate_hz)
        finite, size = mode == c.AcquisitionType.FINITE.value, settings["SAMP_QUANT_SAMP_PER_CHAN"]
        if mode not in (c.AcquisitionType.FINITE.value, c.AcquisitionType.CONTINUOUS.value):
            refuse_value("SAMP_QUANT_SAMP_MODE", "finite or continuous", name_constant(mode))
        retrigger = settings["START_TRIG_RETRIGGERABLE"] and finite and triggers["START"] is not None
        endless = retrigger or not finite
        buffer = settings["INPUT_BUF_SIZE"] or (get_buffer_size(wanted_hz, size) if endless else size)
        buffer = max(buffer, size if finite else 1)
        if buffer * len(names) > MAX_BUFFER or size < 1:
            detail = f"a buffer of {buffer} samples of {len(names)} channels; at most {MAX_BUFFER} together"
            raise DaqmxError(Code.PAL_MEMORY_FULL, detail)
        pretrigger = settings["REF_TRIG_PRETRIG_SAMPLES"]
        if triggers["REF"] is not None and not (finite and 2 <= pretrigger < size):
            refuse_value("REF_TRIG_PRETRIG_SAMPLES", "from 2 to below the samples of a finite acquisition", pretrigger)
        return names, rate_hz, Plan(
            columns, step=step, keep=size if finite else None, max_rows=buffer, start=triggers["START"],
            reference=triggers["REF"], pretrigger=pretrigger, measure=measure, retrigger=retrigger,
        )  # fmt: skip

    def check_clock(self, native_hz: float | None = None) -> int:
        """Return the rows of the rig per sample.

        Raises:
            DaqmxError: The device does not support the rate or the source of the sample clock.
        """
        rate_hz, clock = self.settings["SAMP_CLK_RATE"], self.settings["SAMP_CLK_SRC"]
        if native_hz is None:
            rows = self.device.table.channels
            native_hz = float(min(rows[name].rate_hz for name in self._find_columns() or rows))
        clocks = ("", "OnboardClock", f"/{self.device.name}/ai/SampleClock", f"/{self.device.name}/PFI9")
        if clock.lower() not in map(str.lower, clocks):
            raise DaqmxError(Code.INVALID_ROUTING_SOURCE_TERMINAL_NAME_ROUTING, f"{clock}; clocks: {clocks[1:]}")
        try:
            return decimation_factor(native_hz, rate_hz)
        except InputError as error:
            refuse_value("SAMP_CLK_RATE", error.must, rate_hz)

    def _find_columns(self) -> list[str]:
        """Return the channels of the table that the task reads."""
        if self.kind is c.ChannelType.ANALOG_INPUT:
            return [self.device.channels[channel.physical[0]] for channel in self.channels]
        if self.kind is c.ChannelType.COUNTER_INPUT:
            return [self._find_signal().channel]
        if self.kind in (c.ChannelType.DIGITAL_INPUT, c.ChannelType.DIGITAL_OUTPUT):
            lines = [line for channel in self.channels for line in channel.physical]
            found = [self.device.inputs[line].channel for line in lines if line in self.device.inputs]
            return list(dict.fromkeys(found or list(self.device.channels.values())[: self.clocked]))
        return []

    def _find_signal(self) -> Terminal:
        channel = self.channels[0]
        return self.device.find_terminal(next(v for key, v in channel.attributes.items() if key.endswith("_TERM")))

    def _make_counter(self) -> Counter | None:
        if self.kind is not c.ChannelType.COUNTER_INPUT:
            return None
        values, terminal = self.channels[0].attributes, self._find_signal()
        usage = c.UsageTypeCI(self.channels[0].fixed["CI_MEAS_TYPE"])
        return Counter(
            usage, self.device.table.channels[terminal.channel], terminal,
            rising=next(value for key, value in values.items() if key.endswith("_EDGE")) == c.Edge.RISING.value,
            count=values.get("CI_COUNT_EDGES_INITIAL_CNT", 0),
            up=values.get("CI_COUNT_EDGES_DIR") != c.CountDirection.COUNT_DOWN.value,
        )  # fmt: skip

    def _find_trigger(self, which: str) -> Trigger | None:
        """Return the trigger START or REF of the settings, in counts."""
        kind = self.settings[f"{which}_TRIG_TYPE"]
        if kind == c.TriggerType.NONE.value:
            return None
        if kind == c.TriggerType.DIGITAL_EDGE.value:
            terminal = self.device.find_terminal(self.settings[f"DIG_EDGE_{which}_TRIG_SRC"])
            row = self.device.table.channels[terminal.channel]
            level, gain = (terminal.level - row.offset) / row.scale, row.scale
            rising = self.settings[f"DIG_EDGE_{which}_TRIG_EDGE"] == c.Edge.RISING.value
        elif kind == c.TriggerType.ANALOG_EDGE.value:
            row, gain, offset = self._find_analog_source(self.settings[f"ANLG_EDGE_{which}_TRIG_SRC"])
            level = (self.settings[f"ANLG_EDGE_{which}_TRIG_LVL"] - offset) / gain
            rising = self.settings[f"ANLG_EDGE_{which}_TRIG_SLOPE"] == c.Edge.RISING.value
        else:
            refuse_value(f"{which}_TRIG_TYPE", "a digital or an analog edge", name_constant(kind))
        return Trigger(row.name, level, rising == (gain > 0.0))

    def _find_analog_source(self, name: str) -> tuple[Channel, float, float]:
        for channel in self.channels:
            if channel.name.lower() == name.lower() and channel.kind is c.ChannelType.ANALOG_INPUT:
                return self.device.channel(channel.physical[0]), channel.gain, channel.offset
        row = self.device.channel(self.device.expand(name, self.device.channels)[0])
        return row, row.lsb_v, 0.0

    def _check_stopped(self) -> None:
        if self.started:
            raise DaqmxError(Code.CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING, "stop the task first")
