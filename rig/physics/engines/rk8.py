"""Dormand and Prince's Runge-Kutta method of order 8 in twelve stages, with error estimates of order 5 and 3 (DOP853).

The coefficients are scipy's. Reference runs use this engine: in the first impacts order 4 needs 2 us for its accuracy
at 25 us, at three times the work.
"""

from __future__ import annotations

import numpy as np

from rig.physics.engines.common.runge_kutta import Tableau

ORDER = 8


def _tableau() -> Tableau:
    from scipy.integrate import DOP853

    s = DOP853.n_stages
    return Tableau(
        a=np.ascontiguousarray(DOP853.A[:s, :s]),
        b=np.ascontiguousarray(DOP853.B),
        c=np.ascontiguousarray(DOP853.C[:s]),
        coarse=np.ascontiguousarray(DOP853.E3),  # pyright: ignore[reportAttributeAccessIssue]
        fine=np.ascontiguousarray(DOP853.E5),  # pyright: ignore[reportAttributeAccessIssue]
        order=float(ORDER),
        rows=s + 1,
    )


METHOD = _tableau()
