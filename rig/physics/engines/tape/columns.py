"""Columns of a Taylor series after those of state and integrals."""

from __future__ import annotations

from rig.physics.kernels import signals as S

TIME, PULSE_SINE, PULSE_COSINE = range(S.N_VECTOR, S.N_VECTOR + 3)
"""Time since the start [s]; sine and cosine of the hammer pulse."""
TURNS = {S.GAMMA: S.N_VECTOR + 3, S.BETA: S.N_VECTOR + 5, S.THETA: S.N_VECTOR + 7}
"""Sine of each angle, followed by its cosine."""
ROOT = S.N_VECTOR + 9
"""Root of the penetration, the last column with a rate by time."""
FORCE, EVENTS = ROOT + 1, ROOT + 2
"""Normal force, and the columns of three event functions.

In flight the first is the square of the distance. In sliding, the second is the sliding speed, and the third falls
through 0 where the law would pull. In rolling, the first two are penetration and friction.
"""
WIDTH = EVENTS + 3
