"""What the splitting engine keeps between calls, by position in the memory."""

from __future__ import annotations

from itertools import count

from rig.engines.memory import OWN
from rig.engines.split.flow import HOUSE_FLOW, LEVELS

_next = count(OWN)
UX, UY, PX, PY, SPIN, THETA = (next(_next) for _ in range(6))
X0, X1, X2, X3, Y0, Y1, Y2, Y3 = (next(_next) for _ in range(8))
"""Houses: inner displacement and rate, outer displacement and rate, horizontal and vertical."""
SLID, DEPTH, RATE, AGO = (next(_next) for _ in range(4))
"""Sliding speed after the last kick, nan before the first of a contact; penetration, its rate and the time since the
last kick in flight."""
BEFORE, LAST, BEFORE_SPAN, LAST_STEP = (next(_next) for _ in range(4))
"""Normal force at the last kick but one, and at the last [N]; time between both; length of the last's step [s]."""
WANTED, SETTLED, BOUNCE = (next(_next) for _ in range(3))
"""Level asked for in contact, calm kicks in a row, mean rate of the gap in the last kick."""
REST, SPRING_X, SPRING_Y, ENGAGED = (next(_next) for _ in range(4))
"""Rest of the shaft on its magnets and the springs of its flow about it; whether the flow has the magnets."""
KICKED, CONJUGATE = (next(_next) for _ in range(2))
"""Level of the last kick, -1 before the first; h^2/24 of the coordinates in use."""
KICK = next(_next)
"""The last kick (`rig.engines.split.kick.Kick`): eight numbers."""
COS, SIN, ANGLE = (KICK + 8 + i for i in range(3))
"""Direction of the unbalance, and the spin angle that it is for."""
FLOWS = ANGLE + 1
FLOWS_END = FLOWS + HOUSE_FLOW * LEVELS
"""Flows of the houses."""
