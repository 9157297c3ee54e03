"""Where a blow leads to lasting backward whirl, over friction and the blow's force: the class by every engine."""

from __future__ import annotations

import numpy as np

from replays.stability.motion import hammer_run, move

FREE, BOUNCING, SLIDING, ROLLING = range(4)
"""Class at the end of a run: out of contact; now and then in it; always in it and slipping; always, and rolling."""
NAMES = ("free", "bouncing", "sliding whirl", "rolling whirl")
_WINDOW_S = 0.05


def whirl_class(engine: str, mu: float, force_n: float, *, duration_s: float = 1.0, tolerance: float = 0.0) -> int:
    """Class of the run over its last 50 ms: the blow lasts 5 ms, the rotor runs at 6.2 Hz, friction is Coulomb's."""
    constants, inputs, y0 = hammer_run("exact", mu=mu, force_n=force_n)
    motion = move(engine, constants, inputs, y0, ticks=round(duration_s * 1e6), every=1000, tolerance=tolerance)
    last = motion.times > duration_s - _WINDOW_S
    touching = motion.column("penetration")[last] > 0.0
    if not touching.any():
        return FREE
    if not touching.all():
        return BOUNCING
    slip = np.abs(motion.column("sliding_speed")[last])
    return ROLLING if float(np.max(slip)) < 1e-2 else SLIDING


QUICK_POINTS: tuple[tuple[float, float, int], ...] = ()
