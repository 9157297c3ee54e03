"""Tsitouras' adaptive Runge-Kutta method of order 5(4) in seven stages; the last is the next step's first.

Ch. Tsitouras, Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying assumption, Comput. Math.
Appl. 62 (2011) 770-775.
"""

from __future__ import annotations

import numpy as np

from rig.physics.engines.common.runge_kutta import Tableau

ORDER = 5

_A = np.zeros((6, 6))
_A[1, :1] = [0.161]
_A[2, :2] = [-0.008480655492356989, 0.335480655492357]
_A[3, :3] = [2.8971530571054935, -6.359448489975075, 4.3622954328695815]
_A[4, :4] = [5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525]
_A[5, :5] = [5.86145544294642, -12.92096931784711, 8.159367898576159, -0.071584973281401, -0.028269050394068383]

METHOD = Tableau(
    a=_A,
    b=np.array(
        [0.09646076681806523, 0.01, 0.4798896504144996, 1.379008574103742, -3.290069515436081, 2.324710524099774]
    ),
    c=np.array([0.0, 0.161, 0.327, 0.9, 0.9800255409045097, 1.0]),
    coarse=np.array(
        [
            -0.00178001105222577714, -0.0008164344596567469, 0.007880878010261995, -0.1447110071732629,
            0.5823571654525552, -0.45808210592918697, 1.0 / 66.0,
        ]
    ),
    fine=np.zeros(7),
    order=5.0,
    rows=7,
)  # fmt: skip
