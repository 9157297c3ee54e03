"""The device: its terminals and channels follow from the channel table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from nidaqmx.constants import AcquisitionType, BusType, ProductCategory
from nidaqmx.utils import unflatten_channel_string

from drivers.console import Console
from drivers.daqmx.hardware.errors import Code, DaqmxError
from drivers.daqmx.hardware.scaling import CALLS, COUNTER_CALLS
from rig.channels.orbit import PULSE_LEVEL
from rig.channels.table import Channel, ChannelTable

_HAMMER_LEVEL_N = 10.0
"""Force at which the digital terminal of the hammer rises [N], far above the noise of its channel."""
_AI_USAGES = [usage.value for usage, _ in CALLS.values()]
_CI_USAGES = [usage.value for usage, _ in COUNTER_CALLS.values()]
OUTPUT_LINES: dict[str, Callable[[Console], Any] | None] = {
    "port0/line0": Console.hammer, "port0/line1": lambda console: console.speed(0.0),
    "port0/line2": None, "port0/line3": None, "port2/line0": Console.stop, "port2/line1": Console.release,
}  # fmt: skip
"""Command at the rising edge of each output line, if any. A pattern for a whole port0 does not end the run."""


@dataclass(frozen=True, slots=True)
class Terminal:
    """Digital signal derived from a channel.

    Attributes:
        channel: Name in the channel table.
        level: Value from which the signal is high [unit of the channel].
    """

    channel: str
    level: float


class Device:
    """Names and properties of one device.

    Args:
        name: Name of the device, such as `rig`.
        table: Channel table of the rig.
    """

    def __init__(self, name: str, table: ChannelTable) -> None:
        self.name = name
        self.table = table
        self.channels = dict(zip((f"{name}/ai{n}" for n in range(len(table.channels))), table.channels, strict=True))
        """Channel of the table by physical analogue input, in table order."""
        terminals = {"PFI0": Terminal("hammer", _HAMMER_LEVEL_N), "PFI8": Terminal("keyphasor", PULSE_LEVEL)}
        self.terminals = {f"/{name}/{pin}": one for pin, one in terminals.items() if one.channel in table.channels}
        """Digital terminals by name."""
        self.lines = {f"{name}/{line}": line for line in OUTPUT_LINES}
        """Output lines, without the device."""
        self.inputs = {f"{name}/port1/line{n}": one for n, one in enumerate(self.terminals.values())}
        """Signal of each input line."""
        self.counters = [f"{name}/ctr0"] if "keyphasor" in table.channels else []
        self.analog_outputs = [f"{name}/ao0"] if "speed" in table.channels else []
        """Physical analogue outputs: the set point of the drive."""

    def find_terminal(self, name: str) -> Terminal:
        """Return the signal of a digital terminal.

        Raises:
            DaqmxError: The device has no such terminal.
        """
        found = {key.lower(): value for key, value in self.terminals.items()}
        if (key := "/" + name.lower().lstrip("/")) not in found:
            known = ", ".join(self.terminals) or "none"
            raise DaqmxError(Code.INVALID_ROUTING_SOURCE_TERMINAL_NAME_ROUTING, f"{name}; terminals: {known}")
        return found[key]

    def expand(self, text: str, known: Any) -> list[str]:
        """Return the physical channels of a list or range, such as `rig/ai0:3`; a port stands for all of its lines.

        Args:
            text: The list.
            known: Names of the physical channels of the wanted kind.

        Raises:
            DaqmxError: A device or a channel does not exist.
        """
        found: list[str] = []
        for name in [each.strip().lstrip("/") for each in unflatten_channel_string(text)] or [text]:
            self.check_name(name.partition("/")[0])
            matches = [one for one in known if name.lower() in (one.lower(), one.lower().rpartition("/line")[0])]
            if not matches:
                raise DaqmxError(Code.PHYSICAL_CHAN_DOES_NOT_EXIST, f"{name}; this device has {', '.join(known)}")
            found += matches
        return found

    def check_name(self, name: str) -> None:
        """Raise an error unless this is the name of the device.

        Raises:
            DaqmxError: It is another one.
        """
        if name.lower() != self.name.lower():
            raise DaqmxError(Code.INVALID_DEVICE_ID, f"{name or 'no name'}; the device is {self.name}")

    def attributes(self) -> dict[str, Any]:
        """Return the properties of the device, by their names in the protocol."""
        rows = list(self.table.channels.values())
        rates, ranges = [float(row.rate_hz) for row in rows], sorted({row.adc_v for row in rows})
        return {
            "PRODUCT_TYPE": "rotor-stator-rig", "PRODUCT_CATEGORY": ProductCategory.DSA.value, "PRODUCT_NUM": 0,
            "SERIAL_NUM": 0, "BUS_TYPE": BusType.TCPIP.value, "TCPIP_HOSTNAME": "127.0.0.1", "IS_SIMULATED": True,
            "AI_PHYSICAL_CHANS": ", ".join(self.channels), "AO_PHYSICAL_CHANS": ", ".join(self.analog_outputs),
            "CI_PHYSICAL_CHANS": ", ".join(self.counters), "CO_PHYSICAL_CHANS": "",
            "DI_LINES": ", ".join(self.inputs | self.lines),
            "DI_PORTS": ", ".join(f"{self.name}/port{n}" for n in range(3)),
            "DO_LINES": ", ".join(self.lines), "DO_PORTS": f"{self.name}/port0, {self.name}/port2",
            "TERMINALS": ", ".join(self.terminals),
            "AI_MAX_SINGLE_CHAN_RATE": max(rates), "AI_MAX_MULTI_CHAN_RATE": min(rates), "AI_MIN_RATE": 1.0,
            "AI_SIMULTANEOUS_SAMPLING_SUPPORTED": True,
            "AI_VOLTAGE_RNGS": [value for high in ranges for value in (-high, high)],
            "AI_SUPPORTED_MEAS_TYPES": _AI_USAGES, "CI_SUPPORTED_MEAS_TYPES": _CI_USAGES,
            "AI_SAMP_MODES": [AcquisitionType.FINITE.value, AcquisitionType.CONTINUOUS.value],
            "CI_SAMP_CLK_SUPPORTED": True, "CI_MAX_SIZE": 32,
            "AO_SAMP_CLK_SUPPORTED": False, "AO_VOLTAGE_RNGS": [-10.0, 10.0],
            "ANLG_TRIG_SUPPORTED": True, "DIG_TRIG_SUPPORTED": bool(self.terminals), "TIME_TRIG_SUPPORTED": False,
        }  # fmt: skip

    def physical_attributes(self, name: str) -> dict[str, Any]:
        """Return the properties of a physical channel.

        Raises:
            DaqmxError: It does not exist.
        """
        self.expand(name, [*self.channels, *self.analog_outputs, *self.counters, *self.inputs, *self.lines])
        return {
            "PHYSICAL_CHAN_AI_SUPPORTED_MEAS_TYPES": _AI_USAGES, "PHYSICAL_CHAN_CI_SUPPORTED_MEAS_TYPES": _CI_USAGES,
            "PHYSICAL_CHAN_DI_SAMP_CLK_SUPPORTED": name in self.inputs,
            "PHYSICAL_CHAN_DO_SAMP_CLK_SUPPORTED": name in self.lines,
        }  # fmt: skip

    def channel(self, physical: str) -> Channel:
        """Return the row of the channel table of a physical analogue input."""
        return self.table.channels[self.channels[physical]]
