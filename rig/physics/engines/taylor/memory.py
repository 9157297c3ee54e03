"""Memory of a series between calls, and its order."""

from __future__ import annotations

from rig.physics.engines.common.memory import ENGINE_MEMORY
from rig.physics.engines.tape.columns import WIDTH

TICK, FRACTION, END_TICK, END_FRACTION = range(ENGINE_MEMORY + 1, ENGINE_MEMORY + 5)
"""Start and end of the series: whole tick and ticks beyond it."""
SPAN, LENGTH = ENGINE_MEMORY + 5, ENGINE_MEMORY + 6
"""Length of the series in time [s], below 0 for no series; length in the variable of the series."""
EVENT, SLACK, STALLED_STEPS = ENGINE_MEMORY + 7, ENGINE_MEMORY + 8, ENGINE_MEMORY + 9
"""Event that ends the series; whether the contact law would pull, so that the force is 0; successive steps of zero
length."""
ZERO_COEFFICIENTS = ENGINE_MEMORY + 10
"""Number of leading zero coefficients of each event's function at the start of the series, from the last event."""
NORTH, EAST = ENGINE_MEMORY + 13, ENGINE_MEMORY + 14
"""Transducer of each pair that has lost its preload: 0, or the sign of the displacement."""
INPUTS, SERIES_ORDER = ENGINE_MEMORY + 15, ENGINE_MEMORY + 26
"""Inputs of the series, 11 numbers; its order."""
SERIES = ENGINE_MEMORY + 31

ORDER = 16
"""Highest order of a series."""
RINGING = SERIES + (ORDER + 1) * WIDTH
"""Flag of a series of the shaft alone, while the housings ring by their modes, whose numbers follow."""
SERIES_END = RINGING + 225
"""End of this memory."""
