"""Radau IIA collocation: nodes and weights, and the responses of linear bodies over one step.

The node values of a body z' = Z z + b u are linear in its state at the start of the step and in u at the nodes. E.
Hairer and G. Wanner, Solving Ordinary Differential Equations II, 2nd ed., section IV.5.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from rig.physics.kernels.stage import kernel

STAGES = 8
"""Nodes of a step: with fewer, steps are too short for 1e-4; with more, the cost of a step grows more than its
length."""


class Collocation(NamedTuple):
    """Coefficients of the method for a step of length 1."""

    nodes: np.ndarray  # right Radau points, the last is 1, shape (STAGES,)
    integrals: np.ndarray  # integral of each node's polynomial up to each node, shape (STAGES, STAGES)
    tail: np.ndarray  # last two Legendre coefficients of node values, shape (2, STAGES)
    inner: np.ndarray  # barycentric weights of the nodes, shape (STAGES,)
    outer: np.ndarray  # the same with the start of the step as the first node, shape (STAGES + 1,)


def radau(stages: int) -> Collocation:
    """Return the coefficients for the right Radau points, the zeros of P_s - P_(s-1)."""
    series = np.zeros(stages + 1)
    series[stages - 1 :] = -1.0, 1.0
    x = np.sort(legendre.legroots(series).real)
    for _ in range(3):
        x -= legendre.legval(x, series) / legendre.legval(x, legendre.legder(series))
    x[-1] = 1.0
    values = legendre.legvander(x, stages)
    integral = np.empty((stages, stages))
    integral[:, 0] = 0.5 * (x + 1.0)
    for k in range(1, stages):
        integral[:, k] = 0.5 * (values[:, k + 1] - values[:, k - 1]) / (2.0 * k + 1.0)
    inverse = np.linalg.inv(values[:, :stages])
    nodes = 0.5 * (x + 1.0)

    def weights(points: np.ndarray) -> np.ndarray:
        apart = points[:, None] - points[None, :] + np.eye(len(points))
        return 1.0 / np.prod(apart, axis=1)

    return Collocation(
        nodes,
        np.ascontiguousarray(integral @ inverse),
        np.ascontiguousarray(inverse[-2:]),
        weights(nodes),
        weights(np.concatenate([[0.0], nodes])),
    )


NODES, INTEGRALS, TAIL, INNER, OUTER = radau(STAGES)


@kernel
def interpolation(with_start, s, weights):
    """Write the weights of node values for the value at a fraction of a step.

    Args:
        with_start: Whether the start of the step is a node; its weight is 0 otherwise.
        s: Fraction of the step.
        weights: Out, shape (STAGES + 1,), the start of the step first.
    """
    left = s if with_start else 1.0
    weights[0] = 1.0
    for i in range(STAGES):
        weights[i + 1] = left
        left *= s - NODES[i]
    right = 1.0
    for i in range(STAGES - 1, -1, -1):
        weights[i + 1] *= right * (OUTER[i + 1] if with_start else INNER[i])
        right *= s - NODES[i]
    weights[0] = right * OUTER[0] if with_start else 0.0


@kernel
def invert(matrix, n):
    """Replace a matrix, shape (n, n), by its inverse: Gauss-Jordan elimination with column pivots.

    Returns:
        False for a singular matrix.
    """
    order = np.empty(n)
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        order[k] = float(pivot)
        value = matrix[pivot, k]
        if not abs(value) > 0.0:
            return False
        if pivot != k:
            for j in range(n):
                matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
        matrix[k, k] = 1.0
        for j in range(n):
            matrix[k, j] /= value
        for i in range(n):
            if i != k:
                factor = matrix[i, k]
                matrix[i, k] = 0.0
                for j in range(n):
                    matrix[i, j] -= factor * matrix[k, j]
    for k in range(n - 1, -1, -1):
        pivot = int(order[k])
        if pivot != k:
            for i in range(n):
                matrix[i, k], matrix[i, pivot] = matrix[i, pivot], matrix[i, k]
    return True


@kernel
def collocate(Z, driven, gain, h, free, forced):
    """Compute the responses of a linear body over a step.

    Args:
        Z: Matrix of the body, shape (n, n).
        driven: Component whose rate contains u.
        gain: Rate of that component per u.
        h: Length of the step [s].
        free: Node values per initial component, out, shape (n, n, STAGES): component, initial component, node.
        forced: Node values per u at a node, out, shape (n, STAGES, STAGES): component, node of u, node.
    """
    n = len(Z)
    size = n * STAGES
    K = np.zeros(size * size).reshape((size, size))
    for c in range(n):
        for i in range(STAGES):
            K[c * STAGES + i, c * STAGES + i] = 1.0
            for d in range(n):
                for j in range(STAGES):
                    K[c * STAGES + i, d * STAGES + j] -= h * INTEGRALS[i, j] * Z[c, d]
    invert(K, size)
    for c in range(n):
        for i in range(STAGES):
            row = c * STAGES + i
            for d in range(n):
                total = 0.0
                for j in range(STAGES):
                    total += K[row, d * STAGES + j]
                free[c, d, i] = total
            for j in range(STAGES):
                total = 0.0
                for k in range(STAGES):
                    total += K[row, driven * STAGES + k] * INTEGRALS[k, j]
                forced[c, j, i] = gain * h * total
