"""Calls for tasks, timing, triggers and channels."""

from __future__ import annotations

import itertools
import re
import secrets
import threading
from collections.abc import Callable
from typing import Any

from nidaqmx import constants
from nidaqmx.constants import ChannelType, TriggerType
from nidaqmx.utils import unflatten_channel_string

from drivers.daqmx.hardware import scaling
from drivers.daqmx.hardware.device import Device
from drivers.daqmx.hardware.errors import Code, DaqmxError, describe, name_constant, refuse_value
from drivers.daqmx.hardware.outputs import Outputs
from drivers.daqmx.rpc.calls import Calls, call
from drivers.daqmx.tasks.configuration import VirtualChannel
from drivers.daqmx.tasks.task import Task
from drivers.sources import Source
from rig.base.errors import InputError

_MAX_TASKS = 64
SECRET_KEY = "rig-secret"
"""Key of the secret in the metadata of a call."""
_OUTPUTS = (ChannelType.DIGITAL_OUTPUT, ChannelType.ANALOG_OUTPUT)
_OUTPUT_CALLS = ("CreateDO", "CreateAO", "Write", "ResetDevice")
"""Beginnings of the calls that need the secret for every task."""
_INITIALIZE, _ATTACH = 1, 2
"""Behaviours for a session: a new one only, an existing one only."""


class Sessions(Calls):
    """Tasks of all programs.

    Args:
        device: The device.
        outputs: Its outputs.
        open_source: Opens a source of counts.
        secret: Required in the metadata of calls for outputs; None: they need none.
    """

    def __init__(
        self, device: Device, outputs: Outputs, open_source: Callable[[], Source], secret: str | None = None
    ) -> None:
        self._secret = secret
        self._device, self._outputs, self._open_source = device, outputs, open_source
        self._tasks: dict[str, Task] = {}
        self._lock = threading.Lock()
        self._numbers = itertools.count()
        self.bind()

    def close(self) -> None:
        """Stop all tasks; they cannot be started again."""
        for task in list(self._tasks.values()):
            task.stop(clear=True)

    def check(self, call: str, request: Any, context: Any) -> None:
        """Check the texts of a request, and its secret if it is for outputs, whose tasks all programs can name."""
        super().check(call, request, context)
        task = self._tasks.get(request.task.name) if hasattr(request, "task") else None
        is_output = task is not None and any(channel.kind in _OUTPUTS for channel in task.channels)
        if self._secret is None or not (is_output or call.startswith(_OUTPUT_CALLS)):
            return
        given = str(dict(context.invocation_metadata()).get(SECRET_KEY, ""))
        if not secrets.compare_digest(given.encode(), self._secret.encode()):
            code = Code.INCORRECT_PASSWORD if given else Code.PASSWORD_REQUIRED
            raise DaqmxError(
                code, f"outputs need the secret of `rig daqmx --secret FILE` as {SECRET_KEY} in the metadata"
            )

    def task(self, request: Any, *kinds: ChannelType, mismatch: Code = Code.READ_CHAN_TYPE_MISMATCH) -> Task:
        """Return the task of a request.

        Args:
            request: The request.
            kinds: Kinds of channels for which the call is made; by default any.
            mismatch: Code of the error if the task has channels of another kind.

        Raises:
            DaqmxError: It does not exist, or has channels of another kind.
        """
        if (task := self._tasks.get(request.task.name)) is None:
            raise DaqmxError(Code.INVALID_TASK, f"{request.task.name!r} was cleared, or never created")
        if kinds and task.kind not in kinds:
            raise DaqmxError(mismatch, f"the task has channels of the kind {task.kind.name.lower()}")
        return task

    # ---- tasks ----

    @call("CreateTask")
    def create_task(self, request: Any, _: Any, response: Any) -> None:
        """Create a task, or attach to one."""
        behaviour = request.initialization_behavior
        with self._lock:
            name = request.session_name or f"_unnamedTask<{next(self._numbers)}>"
            exists = name in self._tasks
            if (exists and behaviour == _INITIALIZE) or (not exists and behaviour == _ATTACH):
                raise DaqmxError(Code.DUPLICATE_TASK if exists else Code.INVALID_TASK, name)
            if len(self._tasks) >= _MAX_TASKS and not exists:
                raise DaqmxError(Code.PAL_MEMORY_FULL, f"there are {_MAX_TASKS} tasks; clear some")
            self._tasks.setdefault(name, Task(name, self._device, self._open_source))
        response.task.name, response.new_session_initialized = name, not exists

    @call("(Start|Stop|Clear)Task|TaskControl")
    def control_task(self, request: Any, _: Any, __: Any, action: str | None) -> None:
        """Start, stop, clear or verify a task; the other states have no effect."""
        task = self.task(request)
        action = action or constants.TaskMode(request.action_raw).name.removeprefix("TASK_").title()
        if action == "Start":
            task.start()
        elif action in ("Stop", "Abort", "Clear"):
            if action == "Clear":
                self._tasks.pop(task.name, None)
            task.stop(clear=action == "Clear")
        else:
            task.plan()

    @call("IsTaskDone")
    def is_task_done(self, request: Any, _: Any, response: Any) -> None:
        """Return whether a task is done."""
        response.is_task_done = self.task(request).done

    @call("WaitUntilTaskDone")
    def wait_until_done(self, request: Any, context: Any, _: Any) -> None:
        """Wait until a task is done."""
        self.task(request).wait(request.time_to_wait, context.is_active)

    @call("GetErrorString")
    def get_error_string(self, request: Any, _: Any, response: Any) -> None:
        """Return the text of an error code."""
        response.error_string = describe(request.error_code)

    @call("(Reset|SelfTest)Device")
    def reset_device(self, request: Any, _: Any, __: Any, action: str) -> None:
        """Stop all tasks; a self-test has no effect."""
        self._device.check_name(request.device_name)
        if action == "Reset":
            for task in list(self._tasks.values()):
                task.stop(abort=True)

    # ---- timing and triggers ----

    @call("Cfg(SampClk|Implicit)Timing")
    def configure_timing(self, request: Any, _: Any, __: Any, kind: str) -> None:
        """Set the sample clock and the number of samples."""
        task = self.task(request)
        if task.kind is ChannelType.ANALOG_OUTPUT or (task.kind, kind) == (ChannelType.DIGITAL_OUTPUT, "Implicit"):
            refuse_value("SAMP_TIMING_TYPE", "on demand for outputs, or a sample clock for lines", kind)
        types = {"Implicit": constants.SampleTimingType.IMPLICIT, "SampClk": constants.SampleTimingType.SAMPLE_CLOCK}
        task.set("SAMP_TIMING_TYPE", types[kind].value)
        task.set("SAMP_QUANT_SAMP_MODE", request.sample_mode_raw)
        task.set("SAMP_QUANT_SAMP_PER_CHAN", request.samps_per_chan)
        if kind == "SampClk":
            task.set("SAMP_CLK_RATE", request.rate)
            task.set("SAMP_CLK_SRC", request.source)
            task.set("SAMP_CLK_ACTIVE_EDGE", request.active_edge_raw)
            task.check_clock()

    @call("Cfg(Dig|Anlg)Edge(Start|Ref)Trig")
    def configure_trigger(self, request: Any, _: Any, __: Any, kind: str, which: str) -> None:
        """Start at an edge, or acquire around it."""
        task, which = self.task(request), which.upper()
        prefix = f"{kind.upper()}_EDGE_{which}_TRIG"
        task.set(f"{prefix}_SRC", request.trigger_source)
        if kind == "Dig":
            self._device.find_terminal(request.trigger_source)
            task.set(f"{prefix}_EDGE", request.trigger_edge_raw)
        else:
            task.set(f"{prefix}_SLOPE", request.trigger_slope_raw)
            task.set(f"{prefix}_LVL", request.trigger_level)
        if which == "REF":
            task.set("REF_TRIG_PRETRIG_SAMPLES", request.pretrigger_samples)
        edge = TriggerType.DIGITAL_EDGE if kind == "Dig" else TriggerType.ANALOG_EDGE
        task.set(f"{which}_TRIG_TYPE", edge.value)

    @call("Disable(Start|Ref)Trig")
    def disable_trigger(self, request: Any, _: Any, __: Any, which: str) -> None:
        """Remove a trigger."""
        self.task(request).set(f"{which.upper()}_TRIG_TYPE", TriggerType.NONE.value)

    # ---- channels ----

    @call("|".join(scaling.CALLS))
    def add_analog_inputs(self, request: Any, _: Any, response: Any) -> None:
        """Create analogue input channels."""
        usage, prefix = scaling.CALLS[type(response).__name__.removesuffix("Response")]
        physical, channels = self._device.expand(request.physical_channel, self._device.channels), []
        for name, each in _name_channels(request.name_to_assign_to_channel, physical):
            row = self._device.channel(each)
            gain, offset = scaling.get_scale(request, row)
            fixed = {
                "AI_MEAS_TYPE": usage.value, f"{prefix}_UNITS": request.units_raw, "AI_RESOLUTION": float(row.adc_bits),
                "AI_RAW_SAMP_SIZE": 16 if row.adc_bits <= 16 else 32,
                "AI_RNG_HIGH": row.adc_v, "AI_RNG_LOW": -row.adc_v,
                "AI_DEV_SCALING_COEFF": [0.0, row.lsb_v, 0.0, 0.0], "AI_LOWPASS_CUTOFF_FREQ": row.bandwidth_hz,
                "AI_TERM_CFG": getattr(request, "terminal_config_raw", -1), "AI_CUSTOM_SCALE_NAME": "",
                "AI_COUPLING": (constants.Coupling.AC if row.highpass_hz else constants.Coupling.DC).value,
            }  # fmt: skip
            settable = _get_limits("AI", request) | {"CHAN_DESCR": row.label}
            kind = ChannelType.ANALOG_INPUT
            channels.append(VirtualChannel(name, [each], kind, gain * row.lsb_v, offset, settable, fixed))
        self.task(request).add(channels)

    @call("|".join(scaling.COUNTER_CALLS))
    def add_counter(self, request: Any, _: Any, response: Any) -> None:
        """Create the counter input channel."""
        usage, edge = scaling.COUNTER_CALLS[type(response).__name__.removesuffix("Response")]
        physical = self._device.expand(request.counter, self._device.counters)
        prefix = re.sub(r"_(ACTIVE|START|STARTING)_EDGE$", "", edge)
        settable = {
            f"{prefix}_TERM": list(self._device.terminals)[-1],
            edge: getattr(request, "edge_raw", constants.Edge.RISING.value),
        }
        fixed: dict[str, Any] = {"CI_MEAS_TYPE": usage.value}
        if usage is constants.UsageTypeCI.COUNT_EDGES:
            settable["CI_COUNT_EDGES_INITIAL_CNT"] = request.initial_count
            settable["CI_COUNT_EDGES_DIR"] = request.count_direction_raw
        else:
            if request.units_raw not in (constants.FrequencyUnits.HZ.value, constants.TimeUnits.SECONDS.value):
                refuse_value("units", "Hz or seconds", name_constant(request.units_raw))
            settable |= _get_limits("CI", request)
            fixed[f"{prefix}_UNITS"] = request.units_raw
        name, kind = request.name_to_assign_to_channel or physical[0], ChannelType.COUNTER_INPUT
        self.task(request).add([VirtualChannel(name, physical, kind, attributes=settable, fixed=fixed)])

    @call("CreateAOVoltageChan")
    def add_analog_output(self, request: Any, *_: Any) -> None:
        """Create the analogue output channel."""
        self._outputs.check()
        physical = self._device.expand(request.physical_channel, self._device.analog_outputs)
        settable = _get_limits("AO", request)
        name, kind = request.name_to_assign_to_channel or physical[0], ChannelType.ANALOG_OUTPUT
        self.task(request).add([VirtualChannel(name, physical, kind, attributes=settable)])

    @call("CreateD([IO])Chan")
    def add_lines(self, request: Any, _: Any, __: Any, which: str) -> None:
        """Create digital channels."""
        kind, known = ChannelType.DIGITAL_INPUT, self._device.inputs | self._device.lines
        if which == "O":
            self._outputs.check()
            kind, known = ChannelType.DIGITAL_OUTPUT, self._device.lines
        lines, name = self._device.expand(request.lines, known), request.name_to_assign_to_lines
        names = unflatten_channel_string(request.lines)
        groups = [(name or (f"{names[0]}..." if len(names) > 1 else request.lines), lines)]  # the driver's name
        if request.line_grouping_raw == constants.LineGrouping.CHAN_PER_LINE.value:
            groups = [(each, [line]) for each, line in _name_channels(name, lines)]
        count = f"D{which}_NUM_LINES"
        self.task(request).add([VirtualChannel(*group, kind, fixed={count: len(group[1])}) for group in groups])


def _get_limits(prefix: str, request: Any) -> dict[str, Any]:
    if not request.min_val < request.max_val:
        detail = str(InputError("min_val", f"below max_val, {request.max_val:g}", request.min_val))
        raise DaqmxError(Code.MIN_NOT_LESS_THAN_MAX, detail)
    return {f"{prefix}_MIN": request.min_val, f"{prefix}_MAX": request.max_val}


def _name_channels(given: str, physical: list[str]) -> list[tuple[str, str]]:
    """Return names and physical channels: the given names, one numbered name, or the physical ones."""
    names = unflatten_channel_string(given)
    if len(names) != len(physical):
        names = [f"{given}{number}" for number in range(len(physical))] if given else physical
    return list(zip(names, physical, strict=True))
