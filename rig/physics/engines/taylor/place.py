"""What a series keeps between calls, by position in the memory; and its order."""

from __future__ import annotations

from rig.physics.engines.common.memory import OWN
from rig.physics.engines.tape.columns import WIDTH

TICK, FRACTION, END_TICK, END_FRACTION = range(OWN + 1, OWN + 5)
"""Start and end of the series: whole tick and ticks beyond."""
SPAN, LENGTH = OWN + 5, OWN + 6
"""Its length in time [s], below 0 for none; and in the variable that it is a series in."""
EVENT, SLACK, STALLED = OWN + 7, OWN + 8, OWN + 9
"""What ends it; whether the contact's law asks for tension, so that there is no force; steps in a row of no length."""
KNOWN = OWN + 10
"""Leading coefficients of each event's function that are 0 at the start of the series, by what was before."""
NORTH, EAST = OWN + 13, OWN + 14
"""Which transducer of a pair has lost its preload: 0, or the sign of the displacement."""
INPUTS, SERIES_ORDER = OWN + 15, OWN + 26
"""Inputs that the series is of, 11 numbers; its order."""
SERIES = OWN + 31

ORDER = 16
"""Highest order of a series."""
RINGING = SERIES + (ORDER + 1) * WIDTH
"""A mark that the series is of the shaft alone, and the housings ring by their modes, whose numbers follow."""
SERIES_END = RINGING + 225
"""Behind both."""
