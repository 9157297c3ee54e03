"""Values and zeros of the columns of a series, shape (order + 1, columns)."""

from __future__ import annotations

import math

from rig.physics.kernels.stage import kernel


@kernel
def series_at(Y, s, x):
    """Evaluate the first columns at s into x, as many as x has; the order is a multiple of 4."""
    order = len(Y) - 1
    for i in range(len(x)):
        x[i] = Y[order, i]
    for k in range(order - 4, -1, -4):
        # Along the rows, so that the compiler vectorises over columns.
        for i in range(len(x)):
            x[i] = (((x[i] * s + Y[k + 3, i]) * s + Y[k + 2, i]) * s + Y[k + 1, i]) * s + Y[k, i]


@kernel
def column_at(Y, column, shift, s):
    """Return value and slope of a column at s without its first `shift` coefficients, over s**shift."""
    value = slope = 0.0
    for k in range(len(Y) - 1, shift - 1, -1):
        slope = slope * s + value
        value = value * s + Y[k, column]
    return value, slope


@kernel
def refine(Y, column, shift, goal, low, high):
    """Return the position at which a column passes a value between low and high, by guarded Newton steps."""
    below = column_at(Y, column, shift, low)[0] < goal
    s = 0.5 * (low + high)
    for _ in range(100):
        value, slope = column_at(Y, column, shift, s)
        if value == goal:
            break
        if (value < goal) == below:
            low = s
        else:
            high = s
        new = s - (value - goal) / slope
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - s) <= 1e-16 * high or new in (low, high):
            s = new
            break
        s = new
    return s


@kernel
def first_zero(Y, column, shift, h):
    """Return the first zero up to h at which a column falls through 0; infinity if there is none.

    Excludes the `shift` leading coefficients, which are 0. A bound by the coefficients rules out most cases; otherwise
    samples are taken, with a search for a minimum between them.
    """
    first = Y[shift, column]
    if first <= 0.0:
        return 0.0
    least, power = first, 1.0
    for k in range(shift + 1, len(Y)):
        power *= h
        least += min(0.0, Y[k, column] * power)
    if least > 0.0:
        return math.inf
    before, falling = 0.0, Y[shift + 1, column] < 0.0
    for i in range(1, 9):
        s = 0.125 * i * h
        value, slope = column_at(Y, column, shift, s)
        if value <= 0.0:
            return refine(Y, column, shift, 0.0, before, s)
        if falling and slope > 0.0:
            low, high = before, s
            for _ in range(40):
                middle = 0.5 * (low + high)
                value, slope = column_at(Y, column, shift, middle)
                if value <= 0.0:
                    return refine(Y, column, shift, 0.0, before, middle)
                if slope < 0.0:
                    low = middle
                else:
                    high = middle
        before, falling = s, slope < 0.0
    return math.inf
