"""Memory layout of rolling by collocation, after the memory of the series."""

from __future__ import annotations

from rig.physics.engines.split.memory import MAX_IMPACT_SPEED
from rig.physics.engines.split.radau import STAGES
from rig.physics.kernels import signals as S

PLACES, PLACE, TURNS = MAX_IMPACT_SPEED + 1, MAX_IMPACT_SPEED + 2, MAX_IMPACT_SPEED + 3
"""Steps per turn of rolling by collocation, 0 for a series; index of the step in its turn; number of turns with these
steps, at most 3."""
STEP_S, WHIRL_RATE = MAX_IMPACT_SPEED + 4, MAX_IMPACT_SPEED + 5
"""Length of a step [s]; rate of the contact angle that determined it [rad/s]."""
READY_TICK = MAX_IMPACT_SPEED + 6
"""Tick from which collocation may replace a rolling series; below 0 for a series that does not roll."""
TURN_ERROR = MAX_IMPACT_SPEED + 7
"""Largest error estimate of the turn over its limit."""
NORMAL_X, NORMAL_Y = MAX_IMPACT_SPEED + 8, MAX_IMPACT_SPEED + 9
"""Contact normal at the start of the turn."""
LAST_UNKNOWNS = MAX_IMPACT_SPEED + 10
"""Unknowns at the end of the last step, relative to the contact normal there, shape (6,)."""
ROLLING_STEPS, STALE_RESPONSES = MAX_IMPACT_SPEED + 16, MAX_IMPACT_SPEED + 17
"""Number of steps of rolling by collocation; whether the responses for a new step length must be computed."""

MAX_PLACES = 48
"""Largest number of steps per turn: over-damped contacts need it from the first guess."""
START_FORCE, START_FRICTION = MAX_IMPACT_SPEED + 18, MAX_IMPACT_SPEED + 19
"""Normal and friction force at the start of the step [N]."""
NODE_VALUES = MAX_IMPACT_SPEED + 20
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
"""Workspace of the current step, in rows of STAGES numbers."""
