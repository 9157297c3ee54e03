"""The shaft's axis by its direction instead of two angles: what series and splitting calculate with.

u = (sin b, -sin G cos b, cos G cos b) is a unit vector along the axis, p = u' its rate. With small angles u is (b, -G).
"""

from __future__ import annotations

import math

from rig.physics.kernels.frames.angles import arc_sine, sin_cos
from rig.physics.kernels.stage import kernel


@kernel
def axis_of(euler, gamma, beta, gamma_rate, beta_rate):
    """Lateral direction ux, uy [1] and rate px, py [1/s] of the axis, by its angles and their rates."""
    if not euler:
        return beta, -gamma, beta_rate, -gamma_rate
    sG, cG = sin_cos(gamma)
    sb, cb = sin_cos(beta)
    return sb, -sG * cb, cb * beta_rate, -(cG * cb * gamma_rate - sG * sb * beta_rate)


@kernel
def angles_of(euler, ux, uy, px, py):
    """Gamma, beta [rad] and their rates [rad/s], by lateral direction and rate of the axis."""
    if not euler:
        return -uy, ux, -py, px
    cb2 = 1.0 - ux * ux
    cb = math.sqrt(cb2)
    uz = math.sqrt(cb2 - uy * uy)
    pz = -(ux * px + uy * py) / uz
    return arc_sine(-uy / cb), arc_sine(ux), (uy * pz - uz * py) / cb2, px / cb
