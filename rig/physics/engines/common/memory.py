"""What an engine keeps between calls beside the state: counters that every engine shares, then its own numbers.

Positions in the array `memory`, shape (MEMORY,).
"""

from __future__ import annotations

PHASE, ONSET = 0, 1
"""Phase of the contact (`rig.physics.kernels.laws.contact`); impact speed of the running contact, floored [m/s]."""
CONTACTS, FLOORED, CLAMPS, CONTACT_STEPS = 2, 3, 4, 5
"""Contacts begun; of these, slower than the speed floor; steps at which the law would have pulled; steps in contact."""
PEAK_FORCE = 6
"""Largest normal force [N], by the engine's own steps."""
STEPS, EVALUATIONS, REJECTED, CEILING = 7, 8, 9, 10
"""Steps taken; evaluations of the equations; steps taken again shorter; steps at the least length with an estimate
still above the tolerance, or grids given up for want of parts."""
TOLERANCE, SIZE = 11, 12
"""Scaled error a step that is asked for; length proposed for the next part [ticks]."""
BEFORE, BEFORE_SPAN, LAST = 13, 14, 15
"""Normal force before the last [N], time between both [ticks], last normal force [N]."""
ROLLED_S = 16
"""Time in which contact that rolls was integrated by collocation [s]."""
OWN = 17
"""From here on an engine's own."""
MEMORY = 1280
