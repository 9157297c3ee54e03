"""Layout of the memory that rolling by collocation keeps between calls, after that of the series."""

from __future__ import annotations

from rig.physics.engines.split.place import HARDEST
from rig.physics.engines.split.radau import STAGES
from rig.physics.kernels import signals as S

PLACES, PLACE, TURNS = HARDEST + 1, HARDEST + 2, HARDEST + 3
"""Steps a turn of rolling by collocation, 0 while a series is at hand; place of the step in its turn; turns with these
places, at most 3."""
STEP_S, WHIRL_RATE = HARDEST + 4, HARDEST + 5
"""Length of a step [s]; rate of the contact angle that it was chosen by [rad/s]."""
READY_TICK = HARDEST + 6
"""Tick from which a rolling series may be left for collocation; below 0 unless it rolls."""
WORST = HARDEST + 7
"""Largest error estimate of the turn over its limit."""
NORMAL_X, NORMAL_Y = HARDEST + 8, HARDEST + 9
"""Contact normal at the start of the turn."""
LAST_UNKNOWNS = HARDEST + 10
"""Unknowns at the end of the last step, by the contact normal there, shape (6,)."""
ROLLING_STEPS, WAITS = HARDEST + 16, HARDEST + 17
"""Steps of rolling by collocation; whether the responses over a step of another length are to be made."""

MAX_PLACES = 48
"""Most steps a turn: over-damped contacts need them from a first guess."""
START_FORCE, START_FRICTION = HARDEST + 18, HARDEST + 19
"""Normal and friction force at the start of the step [N]."""
NODE_VALUES = HARDEST + 20
"""State and integrals at the start of the step and at its nodes, shape (STAGES + 1, N_VECTOR)."""
SHAFT_FREE = NODE_VALUES + (STAGES + 1) * S.N_VECTOR
SHAFT_FORCED = SHAFT_FREE + 3 * 4 * STAGES
HOUSE_FREE = SHAFT_FORCED + 3 * 2 * STAGES**2
HOUSE_FORCED = HOUSE_FREE + 2 * 16 * STAGES
INVERSES = HOUSE_FORCED + 2 * 4 * STAGES**2
HISTORY = INVERSES + MAX_PLACES * 4 * STAGES**2
UNKNOWNS = HISTORY + 3 * MAX_PLACES * 6 * STAGES
NODE_STATES = UNKNOWNS + 6 * STAGES
UNDRIVEN = NODE_STATES + 14 * STAGES
AT_NODES = UNDRIVEN + 14 * STAGES
POWERS = AT_NODES + 19 * STAGES
RESIDUALS = POWERS + 15 * STAGES
CHANGES = RESIDUALS + 2 * STAGES
MEMORY = CHANGES + 2 * STAGES
"""Of a step at work; rows of STAGES numbers each."""
