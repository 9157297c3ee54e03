"""Direction of the shaft's axis in place of two angles, for the Taylor series and the split engine.

u = (sin b, -sin G cos b, cos G cos b) is a unit vector along the axis, p = u' its rate. With small angles u is (b, -G).
"""

from __future__ import annotations

import math

from rig.physics.kernels.frames.angles import arc_sine, sin_cos
from rig.physics.kernels.stage import kernel


@kernel
def axis_from_angles(euler, gamma, beta, gamma_rate, beta_rate):
    """Return lateral direction ux, uy [1] and rate px, py [1/s] of the axis from its angles and their rates."""
    if not euler:
        return beta, -gamma, beta_rate, -gamma_rate
    sG, cG = sin_cos(gamma)
    sb, cb = sin_cos(beta)
    return sb, -sG * cb, cb * beta_rate, -(cG * cb * gamma_rate - sG * sb * beta_rate)


@kernel
def angles_from_axis(euler, ux, uy, px, py):
    """Return Gamma, beta [rad] and their rates [rad/s] from lateral direction and rate of the axis."""
    if not euler:
        return -uy, ux, -py, px
    cb2 = 1.0 - ux * ux
    cb = math.sqrt(cb2)
    uz = math.sqrt(cb2 - uy * uy)
    pz = -(ux * px + uy * py) / uz
    return arc_sine(-uy / cb), arc_sine(ux), (uy * pz - uz * py) / cb2, px / cb
