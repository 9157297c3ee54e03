"""Lanes of a series: products and quotients, whose factors' coefficients A and B are stored in one lane each.

The k-th coefficient of a product is the sum of A_j B_(k-j) over all j; `acc` holds the terms of 0 < j < k, computed for
all lanes at once. `later` is 0 for k = 0, else 1.
"""

from __future__ import annotations

from numba import float64, int64, njit

from rig.physics.kernels.laws.contact import SMOOTHED
from rig.physics.kernels.laws.magnet import RIPPLED
from rig.physics.kernels.stage import STAGE, stage

_FACTORS, _SUMS = float64[:, ::1], float64[::1]


@stage
def is_wide(constants, inputs):
    """Return whether a scene needs the additional lanes, as few scenes do."""
    contact = constants.contact
    return (
        contact.gap_counts_outer != 0.0
        or (contact.exponent != 1.5 and contact.exponent != 1.0)
        or constants.levels.friction == SMOOTHED
        or (inputs.magnet_engaged and constants.magnet.terms == RIPPLED)
    )


@njit((_FACTORS, _FACTORS, _SUMS, int64, int64), **STAGE)
def sum_lower_products(A, B, acc, k, lanes):
    """Sum the products of the coefficients below the k-th, for a number of lanes."""
    for p in range(lanes):
        acc[p] = 0.0
    for j in range(1, k):
        for p in range(lanes):
            acc[p] += A[j, p] * B[k - j, p]


# With explicit types the function is compiled once; a lane's number is a literal, which would have its own type.
@njit(float64(_FACTORS, _FACTORS, _SUMS, int64, float64, int64, float64, float64), **STAGE)
def product(A, B, acc, k, later, p, left, right):
    """Return the k-th coefficient of a product and store its factors in lane p."""
    A[k, p], B[k, p] = left, right
    return acc[p] + A[0, p] * right + left * (later * B[0, p])


@njit(float64(_FACTORS, _FACTORS, _SUMS, int64, float64, int64, float64, float64, float64), **STAGE)
def quotient(A, B, acc, k, later, p, divisor, dividend, inverse):
    """Return the k-th coefficient of a quotient, from the inverse of the divisor's first coefficient.

    Lane p holds divisor and quotient as factors.
    """
    A[k, p], B[k, p] = divisor, (dividend - acc[p] - divisor * (later * B[0, p])) * inverse
    return B[k, p]


@stage
def complex_power(A, B, acc, k, later, p, x, y, exponent):
    """Return the k-th coefficients of (x + i y)^exponent, by squaring as in `kernels.laws.magnet`, from lane p on."""
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
