"""Properties of a task that a program can set, by their names in the protocol."""

from __future__ import annotations

from typing import Any

from nidaqmx import constants as c

DEFAULTS: dict[str, Any] = {
    "SAMP_TIMING_TYPE": c.SampleTimingType.ON_DEMAND.value,
    "SAMP_CLK_RATE": 1000.0, "SAMP_CLK_SRC": "OnboardClock", "SAMP_CLK_ACTIVE_EDGE": c.Edge.RISING.value,
    "SAMP_QUANT_SAMP_MODE": c.AcquisitionType.FINITE.value, "SAMP_QUANT_SAMP_PER_CHAN": 1000,
    "START_TRIG_TYPE": c.TriggerType.NONE.value, "START_TRIG_RETRIGGERABLE": False,
    "DIG_EDGE_START_TRIG_SRC": "", "DIG_EDGE_START_TRIG_EDGE": c.Edge.RISING.value,
    "ANLG_EDGE_START_TRIG_SRC": "", "ANLG_EDGE_START_TRIG_SLOPE": c.Slope.RISING.value,
    "ANLG_EDGE_START_TRIG_LVL": 0.0,
    "REF_TRIG_TYPE": c.TriggerType.NONE.value, "REF_TRIG_PRETRIG_SAMPLES": 2,
    "DIG_EDGE_REF_TRIG_SRC": "", "DIG_EDGE_REF_TRIG_EDGE": c.Edge.RISING.value,
    "ANLG_EDGE_REF_TRIG_SRC": "", "ANLG_EDGE_REF_TRIG_SLOPE": c.Slope.RISING.value,
    "ANLG_EDGE_REF_TRIG_LVL": 0.0,
    "INPUT_BUF_SIZE": 0, "AUTO_START": True, "READ_ALL_AVAIL_SAMP": False,
    "OVERWRITE": c.OverwriteMode.DO_NOT_OVERWRITE_UNREAD_SAMPLES.value,
    "RELATIVE_TO": c.ReadRelativeTo.CURRENT_READ_POSITION.value, "OFFSET": 0,
    "WAIT_MODE": c.WaitMode.WAIT_FOR_INTERRUPT.value, "LOGGING_MODE": c.LoggingMode.OFF.value,
}  # fmt: skip
"""Value of each property of a new task."""
FIXED = ("OVERWRITE", "RELATIVE_TO", "OFFSET", "LOGGING_MODE", "SAMP_CLK_ACTIVE_EDGE")
"""Properties with one value only."""
_BUFFER_SIZES = ((100.0, 1_000), (10_000.0, 10_000), (1_000_000.0, 100_000))
"""Highest rate [Hz] and size of the buffer [samples per channel] of a continuous acquisition, as documented for
NI-DAQmx."""


def get_buffer_size(rate_hz: float, wanted: int) -> int:
    """Return the size of the buffer of a continuous acquisition [samples per channel].

    Args:
        rate_hz: Sample rate [Hz].
        wanted: Number of samples that the program gave with the rate.
    """
    return max(wanted, next((size for limit, size in _BUFFER_SIZES if rate_hz <= limit), 1_000_000))
