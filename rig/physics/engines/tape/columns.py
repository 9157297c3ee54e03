"""Columns of a Taylor series behind the vector of state and integrals, whose columns come first."""

from __future__ import annotations

from rig.physics.kernels import signals as S

TIME, PULSE_SINE, PULSE_COSINE = range(S.N_VECTOR, S.N_VECTOR + 3)
"""Time since the start [s]; sine and cosine of the hammer's pulse; ..."""
TURNS = {S.GAMMA: S.N_VECTOR + 3, S.BETA: S.N_VECTOR + 5, S.THETA: S.N_VECTOR + 7}
"""... sine and, behind it, cosine of each angle; ..."""
ROOT = S.N_VECTOR + 9
"""... root of the penetration. All before this have a rate by time."""
FORCE, EVENTS = ROOT + 1, ROOT + 2
"""Normal force, and three functions that events are made of.

In flight the first is the square of the distance; sliding, the second is the sliding speed and the third what falls
through 0 where the law would pull; rolling, they are the penetration and the friction.
"""
WIDTH = EVENTS + 3
