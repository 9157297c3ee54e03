"""Brent's method compared with closed forms and another implementation."""

from __future__ import annotations

import math

import pytest

from rig.base.maths.roots import find_root


@pytest.mark.parametrize("within", [1e-6, 1e-12, 1e-16])
@pytest.mark.parametrize(
    ("function", "low", "high", "root"),
    [
        (lambda x: x * x - 2.0, 0.0, 2.0, math.sqrt(2.0)),
        (lambda x: 2.0 - x * x, 2.0, 0.0, math.sqrt(2.0)),
        (lambda x: math.exp(x) - 3.0, -5.0, 40.0, math.log(3.0)),
        (lambda x: math.atan(1e3 * (x - 0.3)), -1.0, 7.0, 0.3),
        (lambda x: (x - 0.5) ** 9, -1.0, 3.0, 0.5),
        (lambda x: x, 0.0, 1.0, 0.0),
        (lambda x: x - 1.0, 0.0, 1.0, 1.0),
    ],
)
def test_root_is_the_closed_form_and_scipys_to_the_bit(function, low: float, high: float, root: float, within: float):
    from scipy.optimize import brentq

    found = find_root(function, low, high, within=within)
    assert abs(found - root) <= within + 1e-15 * abs(root)
    assert found == brentq(function, low, high, xtol=within, maxiter=1000)


def test_a_missing_change_of_sign_raises() -> None:
    with pytest.raises(ValueError, match="change its sign from 1 to 2"):
        find_root(lambda x: x, 1.0, 2.0, within=1e-9)


def test_a_search_ends_at_non_finite_values() -> None:
    with pytest.raises(ValueError, match="no root found"):
        find_root(lambda x: math.nan if 0.0 < x < 1.0 else x - 0.5, 0.0, 1.0, within=1e-9)
