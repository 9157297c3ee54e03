"""Memory of an engine between calls, apart from the state: common counters, then the engine's own numbers.

Constants are positions in the array `memory`, shape (MEMORY,).
"""

from __future__ import annotations

PHASE, ONSET = 0, 1
"""Contact phase (`rig.physics.kernels.laws.contact`); impact speed of the current contact, floored [m/s]."""
CONTACTS, FLOORED, CLAMPS, CONTACT_STEPS = 2, 3, 4, 5
"""Number of contacts; of those below the speed floor; of steps at which the law would have pulled; of steps in
contact."""
PEAK_FORCE = 6
"""Largest normal force at the engine's own steps [N]."""
STEPS, EVALUATIONS, REJECTED, CEILING = 7, 8, 9, 10
"""Number of steps; of evaluations of the equations; of rejected steps; of steps of minimum length with an error above
the tolerance, and grid steps given up for too many parts."""
TOLERANCE, PART_LENGTH = 11, 12
"""Required scaled error per step; length of the next part [ticks]."""
OLD_FORCE, FORCE_SPAN, LAST_FORCE = 13, 14, 15
"""Previous normal force [N], time from it to the last one [ticks], last normal force [N]."""
ROLLED_S = 16
"""Time of rolling contact that was integrated by collocation [s]."""
ENGINE_MEMORY = 17
"""Start of the engine's own numbers."""
MEMORY = 1280
