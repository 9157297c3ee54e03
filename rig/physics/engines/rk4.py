"""Classical Runge-Kutta method of order 4 in four stages, without error estimate."""

from __future__ import annotations

import numpy as np

from rig.physics.engines.common.runge_kutta import Tableau

ORDER = 4
METHOD = Tableau(
    a=np.array([[0, 0, 0, 0], [1 / 2, 0, 0, 0], [0, 1 / 2, 0, 0], [0, 0, 1, 0]]),
    b=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]),
    c=np.array([0, 1 / 2, 1 / 2, 1]),
    coarse=np.zeros(5),
    fine=np.zeros(5),
    order=0.0,
    rows=5,
)
