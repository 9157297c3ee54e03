"""Fits with a simulation per residual: few residuals, bounded steps, and values that the model refuses."""

from __future__ import annotations

import numpy as np
import pytest

from replays.estimate.least_squares import fit

TIMES = np.linspace(0.0, 1.0, 50)


class Decay:
    """a exp(-b t) against a = 2, b = 3; it refuses b below `least`."""

    def __init__(self, least: float = -np.inf) -> None:
        self.least, self.runs = least, 0

    def residuals(self, values: np.ndarray) -> np.ndarray | None:
        self.runs += 1
        if values[1] < self.least:
            return None
        return values[0] * np.exp(-values[1] * TIMES) - 2.0 * np.exp(-3.0 * TIMES)

    def slopes(self, values: np.ndarray, _residuals: np.ndarray) -> np.ndarray:
        decay = np.exp(-values[1] * TIMES)
        return np.column_stack([decay, -values[0] * TIMES * decay])


def test_a_fit_needs_few_runs_and_returns_the_last_slopes() -> None:
    model = Decay()
    found = fit(model.residuals, model.slopes, np.array([1.0, 1.0]), rounds=10)
    assert found is not None
    assert found.values == pytest.approx([2.0, 3.0], abs=0.1)
    assert found.squares < 1e-2
    assert found.slopes is not None
    assert found.slopes.shape == (50, 2)
    assert model.runs <= 8


def test_an_invalid_start_is_no_fit_and_an_invalid_step_is_shortened() -> None:
    model = Decay(least=2.9)
    assert fit(model.residuals, model.slopes, np.array([2.0, 1.0]), rounds=3) is None
    found = fit(model.residuals, model.slopes, np.array([2.0, 6.0]), rounds=10)
    assert found is not None
    assert found.values[1] >= 2.9
    assert found.squares < 0.1


@pytest.mark.parametrize(("limit", "expected"), [({"farthest": 2.5}, 2.5), ({"longest": 0.25}, 1.25)])
def test_values_and_steps_stay_within_their_bounds(limit: dict[str, float], expected: float) -> None:
    model = Decay()
    rounds = 1 if "longest" in limit else 10
    found = fit(model.residuals, model.slopes, np.array([1.0, 1.0]), rounds=rounds, **limit)
    assert found is not None
    assert np.abs(found.values).max() == pytest.approx(expected, abs=1e-6)


def test_a_value_without_effect_is_kept() -> None:
    start = np.array([1.0])
    found = fit(lambda _: np.ones(5), lambda *_: np.zeros((5, 1)), start, rounds=5)
    assert found is not None
    assert found.values is start
    assert found.slopes is None
