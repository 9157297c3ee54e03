"""Calls that get, set and reset properties; they differ by scope and type only."""

from __future__ import annotations

from typing import Any

from drivers.daqmx.hardware.errors import Code, DaqmxError
from drivers.daqmx.rpc.calls import call
from drivers.daqmx.rpc.sessions import Sessions
from drivers.daqmx.tasks.settings import DEFAULTS

DRIVER_VERSION = {"NIDAQ_MAJOR_VERSION": 25, "NIDAQ_MINOR_VERSION": 5, "NIDAQ_UPDATE_VERSION": 0}
"""Version of the driver that the device reports."""
_UNNAMED = {0x31E8: "DEFAULT_NUMBER_OF_SAMPLES_TO_READ"}
"""Properties without a name in the protocol."""


class Properties(Sessions):
    """Sessions with their properties."""

    @call("Get(System|Device|PhysicalChan|Task|Chan|Read|Write|Timing|Trig|Buffer)(?:Info)?Attribute.*")
    def get_property(self, request: Any, _: Any, response: Any, scope: str) -> None:
        """Get a property."""
        name, values = _get_name(request), self._read(scope, request)
        if name not in values:
            raise DaqmxError(Code.ATTRIBUTE_NOT_SUPPORTED_IN_TASK_CONTEXT, f"{name} of {scope}")
        target = "value_raw" if hasattr(response, "value_raw") else "value"
        if isinstance(values[name], list):
            getattr(response, target).extend(values[name])
        else:
            setattr(response, target, values[name])

    @call("(Set|Reset)(Chan|Read|Write|Timing|Trig|Buffer)Attribute.*")
    def set_property(self, request: Any, _: Any, __: Any, kind: str, scope: str) -> None:
        """Set a property, or reset it."""
        task, name = self.task(request), _get_name(request)
        value = getattr(request, "value_raw", getattr(request, "value", None))
        if scope != "Chan":
            return task.set(name, DEFAULTS.get(name) if kind == "Reset" else value)
        for channel in task.find(request.channel):
            if name not in channel.attributes or kind == "Reset":
                raise DaqmxError(
                    Code.ATTRIBUTE_NOT_SUPPORTED_IN_TASK_CONTEXT, f"{name} of {channel.name} cannot be set"
                )
            channel.attributes[name] = value
        return None

    def _read(self, scope: str, request: Any) -> dict[str, Any]:
        device = self._device
        if scope == "System":
            return {"DEV_NAMES": device.name, "TASKS": "", "SCALES": "", "GLOBAL_CHANS": ""} | DRIVER_VERSION
        if scope == "Device":
            device.check_name(request.device_name)
            return device.attributes()
        if scope == "PhysicalChan":
            return device.physical_attributes(request.physical_channel)
        task = self.task(request)
        if scope != "Chan":
            return task.attributes()
        channel, counter = task.find(request.channel)[0], task.counter
        common = {"CHAN_TYPE": channel.kind.value, "PHYSICAL_CHAN_NAME": ", ".join(channel.physical)}
        return common | channel.fixed | channel.attributes | {"CI_COUNT": 0 if counter is None else counter.count}


def _get_name(request: Any) -> str:
    number = request.attribute_raw or request.attribute
    values = request.DESCRIPTOR.fields_by_name["attribute"].enum_type.values_by_number
    return values[number].name.partition("_ATTRIBUTE_")[2] if number in values else _UNNAMED.get(number, f"{number:#x}")
