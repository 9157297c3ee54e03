"""What a series has lanes for: products and quotients, whose factors' coefficients A and B stand in a lane each.

The k-th coefficient of a product takes A_j B_(k-j) over all j: what those between give, `acc`, is summed up for all
lanes at once. `later` is 0 for k = 0, else 1.
"""

from __future__ import annotations

from numba import float64, int64, njit

from rig.physics.kernels.laws.contact import SMOOTHED
from rig.physics.kernels.laws.magnet import RIPPLED
from rig.physics.kernels.stage import STAGE, stage

_FACTORS, _SUMS = float64[:, ::1], float64[::1]


@stage
def is_wide(constants, inputs):
    """Whether a scene is one of the few that ask for the lanes behind."""
    contact = constants.contact
    return (
        contact.gap_counts_outer != 0.0
        or (contact.exponent != 1.5 and contact.exponent != 1.0)
        or constants.levels.friction == SMOOTHED
        or (inputs.magnet_engaged and constants.magnet.terms == RIPPLED)
    )


@njit((_FACTORS, _FACTORS, _SUMS, int64, int64), **STAGE)
def sum_below(A, B, acc, k, lanes):
    """What the coefficients below the k-th give to the products of so many lanes."""
    for p in range(lanes):
        acc[p] = 0.0
    for j in range(1, k):
        for p in range(lanes):
            acc[p] += A[j, p] * B[k - j, p]


# Named types: each lane's number is a constant, which the compiler takes for a type of its own, and it would compile
# the function once a lane.
@njit(float64(_FACTORS, _FACTORS, _SUMS, int64, float64, int64, float64, float64), **STAGE)
def product(A, B, acc, k, later, p, left, right):
    """The k-th coefficient of a product, whose factors go into lane p."""
    A[k, p], B[k, p] = left, right
    return acc[p] + A[0, p] * right + left * (later * B[0, p])


@njit(float64(_FACTORS, _FACTORS, _SUMS, int64, float64, int64, float64, float64, float64), **STAGE)
def quotient(A, B, acc, k, later, p, divisor, dividend, inverse):
    """The k-th coefficient of a quotient, by the inverse of the divisor's first; both go into lane p, as factors."""
    A[k, p], B[k, p] = divisor, (dividend - acc[p] - divisor * (later * B[0, p])) * inverse
    return B[k, p]


@stage
def complex_power(A, B, acc, k, later, p, x, y, exponent):
    """The k-th coefficients of (x + i y)^exponent, by squaring as in `kernels.laws.magnet`; lanes from p on."""
    power_x, power_y, begun = 1.0 - later, 0.0, False
    while exponent > 0:
        if exponent & 1:
            if begun:
                one = product(A, B, acc, k, later, p, power_x, x)
                one -= product(A, B, acc, k, later, p + 1, power_y, y)
                two = product(A, B, acc, k, later, p + 2, power_x, y)
                two += product(A, B, acc, k, later, p + 3, power_y, x)
                power_x, power_y = one, two
                p += 4
            else:
                power_x, power_y, begun = x, y, True
        exponent >>= 1
        if exponent > 0:
            one = product(A, B, acc, k, later, p, x, x)
            one -= product(A, B, acc, k, later, p + 1, y, y)
            y = 2.0 * product(A, B, acc, k, later, p + 2, x, y)
            x = one
            p += 3
    return power_x, power_y
