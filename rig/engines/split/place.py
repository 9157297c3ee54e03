"""What the splitting engine keeps between calls beside what the series keep, by position in the memory."""

from __future__ import annotations

from itertools import count

from rig.engines.split.flow import HOUSE_FLOW, LEVELS
from rig.engines.taylor.place import SERIES_END

_next = count(SERIES_END)
MODE = next(_next)
"""Which method moves on: the series, or kicks."""
LIMIT = next(_next)
"""The tolerance of the whole."""
HARDEST = next(_next)
"""Speed of the hardest rigid impact so far [m/s]."""
ROLLS, AGAIN = (next(_next) for _ in range(2))
"""Tick since which the contact's phase is what it is; tick from which kicks are held against a series again."""
UX, UY, PX, PY, SPIN, ANGLE = (next(_next) for _ in range(6))
X0, X1, X2, X3, Y0, Y1, Y2, Y3 = (next(_next) for _ in range(8))
"""Houses: inner displacement and rate, outer displacement and rate, horizontal and vertical."""
SLID = next(_next)
"""Sliding speed after the last kick, nan before the first of a contact."""
WANTED = next(_next)
"""Level asked for."""
REST, SPRING_X, SPRING_Y = (next(_next) for _ in range(3))
"""Rest of the shaft on its magnets and the springs of its flow about it."""
KICKED, CONJUGATE = (next(_next) for _ in range(2))
"""Level of the last kick, -1 before the first; h^2/24 of the coordinates in use."""
KICK = next(_next)
"""The last kick (`rig.engines.split.kick.Kick`): eight numbers."""
COS, SIN, TURNED = (KICK + 8 + i for i in range(3))
"""Direction of the unbalance, and the spin angle that it is for."""
GRID_TICKS = TURNED + 1
"""The grid's own step, for which ..."""
OWN_TICKS = GRID_TICKS + 1
FLOWS = OWN_TICKS + 1
FLOWS_END = FLOWS + HOUSE_FLOW * LEVELS
"""... these are the flows of the houses; and the step of rows, where trials are held."""
