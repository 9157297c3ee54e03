"""Measurements of input channels, and the scales of analogue ones, from volts to the unit that a program defines."""

from __future__ import annotations

from typing import Any

from nidaqmx import constants as c

from drivers.daqmx.hardware.errors import name_constant, refuse_value
from rig.channels.table import Channel

_GRAVITY, _POUND, _INCH, _MIL = 9.80665, 4.4482216152605, 25.4e-3, 25.4e-6
"""Standard gravity [m/s^2], pound-force [N], inch and mil [m]."""
_MAX_FACTOR = 1e15
"""Largest factor of a scale, and inverse of the smallest one: products of three are finite and not zero."""
_Accel, _Force = c.AccelSensitivityUnits, c.ForceIEPESensorSensitivityUnits
_Probe, _Velocity = c.EddyCurrentProxProbeSensitivityUnits, c.VelocityIEPESensorSensitivityUnits
_UNITS: dict[Any, float] = {
    c.VoltageUnits.VOLTS: 1.0, c.BridgeUnits.VOLTS_PER_VOLT: 1.0, c.BridgeUnits.MILLIVOLTS_PER_VOLT: 1e-3,
    c.AccelUnits.G: _GRAVITY, c.AccelUnits.METERS_PER_SECOND_SQUARED: 1.0,
    c.AccelUnits.INCHES_PER_SECOND_SQUARED: _INCH,
    c.ForceUnits.NEWTONS: 1.0, c.ForceUnits.POUNDS: _POUND, c.ForceUnits.KILOGRAM_FORCE: _GRAVITY,
    c.LengthUnits.METERS: 1.0, c.LengthUnits.INCHES: _INCH,
    c.VelocityUnits.METERS_PER_SECOND: 1.0, c.VelocityUnits.INCHES_PER_SECOND: _INCH,
}  # fmt: skip
"""SI value of each unit."""
_SENSITIVITIES: dict[Any, float] = {
    _Accel.MILLIVOLTS_PER_G: 1e-3 / _GRAVITY, _Accel.VOLTS_PER_G: 1.0 / _GRAVITY,
    _Force.MILLIVOLTS_PER_NEWTON: 1e-3, _Force.MILLIVOLTS_PER_POUND: 1e-3 / _POUND,
    _Probe.MILLIVOLTS_PER_MIL: 1e-3 / _MIL, _Probe.VOLTS_PER_MIL: 1.0 / _MIL,
    _Probe.MILLIVOLTS_PER_MILLIMETER: 1.0, _Probe.VOLTS_PER_MILLIMETER: 1e3, _Probe.MILLIVOLTS_PER_MICRON: 1e3,
    _Velocity.MILLIVOLTS_PER_MILLIMETER_PER_SECOND: 1.0, _Velocity.MILLIVOLTS_PER_INCH_PER_SECOND: 1e-3 / _INCH,
}  # fmt: skip
"""SI value of each unit of a sensitivity."""
CALLS = {
    "CreateAIVoltageChan": (c.UsageTypeAI.VOLTAGE, "AI_VOLTAGE"),
    "CreateAIAccelChan": (c.UsageTypeAI.ACCELERATION_ACCELEROMETER_CURRENT_INPUT, "AI_ACCEL"),
    "CreateAIForceIEPEChan": (c.UsageTypeAI.FORCE_IEPE_SENSOR, "AI_FORCE"),
    "CreateAIVelocityIEPEChan": (c.UsageTypeAI.VELOCITY_IEPE_SENSOR, "AI_VELOCITY"),
    "CreateAIPosEddyCurrProxProbeChan": (c.UsageTypeAI.POSITION_EDDY_CURRENT_PROX_PROBE, "AI_EDDY_CURRENT_PROX_PROBE"),
    "CreateAIBridgeChan": (c.UsageTypeAI.BRIDGE, "AI_BRIDGE"),
    "CreateAIForceBridgeTwoPointLinChan": (c.UsageTypeAI.FORCE_BRIDGE, "AI_FORCE"),
}
"""Measurement and prefix of the properties, by the call that creates a channel."""
COUNTER_CALLS = {
    "CreateCICountEdgesChan": (c.UsageTypeCI.COUNT_EDGES, "CI_COUNT_EDGES_ACTIVE_EDGE"),
    "CreateCIFreqChan": (c.UsageTypeCI.FREQUENCY, "CI_FREQ_STARTING_EDGE"),
    "CreateCIPeriodChan": (c.UsageTypeCI.PERIOD, "CI_PERIOD_STARTING_EDGE"),
    "CreateCIPulseChanFreq": (c.UsageTypeCI.PULSE_FREQ, "CI_PULSE_FREQ_START_EDGE"),
    "CreateCIPulseChanTime": (c.UsageTypeCI.PULSE_TIME, "CI_PULSE_TIME_START_EDGE"),
}
"""Measurement and property of the first edge, by the call that creates a channel."""


def get_scale(request: Any, channel: Channel) -> tuple[float, float]:
    """Return gain and offset from volts to the unit of a request that creates a channel.

    The bias of a channel is removed where a device couples the sensor by a capacitor, that is for IEPE sensors.

    Args:
        request: The request.
        channel: Row of the channel table.

    Raises:
        DaqmxError: A unit is not supported, or a sensitivity, excitation or difference is zero or not finite.
    """
    unit = _get_size(_UNITS, request, "units")
    if hasattr(request, "sensitivity"):
        size = _get_size(_SENSITIVITIES, request, "sensitivity_units")
        gain = 1.0 / (_check(request.sensitivity, "sensitivity") * size * unit)
        return gain, -channel.bias_v * gain if hasattr(request, "current_excit_val") else 0.0
    if not hasattr(request, "voltage_excit_val"):
        return 1.0 / unit, 0.0
    gain = 1.0 / _check(request.voltage_excit_val, "voltage_excit_val")
    if not hasattr(request, "first_electrical_val"):
        return gain / unit, 0.0
    electrical, physical = _get_size(_UNITS, request, "electrical_units"), _get_size(_UNITS, request, "physical_units")
    span = _check(request.second_electrical_val - request.first_electrical_val, "difference of the electrical values")
    height = _check(request.second_physical_val - request.first_physical_val, "difference of the physical values")
    slope = height / span
    offset = request.first_physical_val - request.first_electrical_val * slope
    return gain / electrical * slope * physical / unit, offset * physical / unit


def _get_size(sizes: dict[Any, float], request: Any, field: str) -> float:
    found = {unit.value: size for unit, size in sizes.items()}
    if (number := getattr(request, f"{field}_raw")) not in found:
        refuse_value(field, "supported by the device", name_constant(number))
    return found[number]


def _check(value: float, what: str) -> float:
    if not 1.0 / _MAX_FACTOR <= abs(value) <= _MAX_FACTOR:
        refuse_value(what, f"from {1.0 / _MAX_FACTOR:g} to {_MAX_FACTOR:g} in size", value)
    return value
