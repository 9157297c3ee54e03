"""Trials of the engines in both directions: required results pass, and failures predicted by theory fail.

| what                          | must agree with                                   |
|-------------------------------|---------------------------------------------------|
| every cell of the quick table | its expected verdict                              |
| impact quadrature             | an integration of the equation of motion by scipy |
| limits h w on the map         | where maps of rk4, Verlet and Euler turn unstable |
| decay of rk4 on an oscillator | abs(R(i h w))^2 per step                          |
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from replays.studies.common.closed_forms import impact
from replays.studies.common.engines import traits
from replays.studies.stability.maps.atlas import GROWN, contact_ratio, house_ratio
from replays.studies.stability.trials.cell import Cell
from replays.studies.stability.trials.motion import bare_shaft, base_model, pivoted_mass
from replays.studies.stability.trials.trials import TRIALS
from rig.base.errors import InputError
from rig.physics.engines import ENGINES
from rig.physics.levels import ModelLevels


@cache
def quick(trial: str, engine: str) -> tuple[Cell, ...]:
    """Return the cells of a quick trial; they are the same each time."""
    return tuple(TRIALS[trial].run(engine, True))


@pytest.mark.parametrize("trial", TRIALS)
@pytest.mark.parametrize("engine", ENGINES)
def test_every_cell_agrees(engine, trial):
    wrong = [cell for cell in quick(trial, engine) if not cell.agrees]
    assert not wrong, "\n".join(
        f"{c.case}: {c.value:.3g} against {c.limit:.3g}, expected {c.expected}: {c.because}" for c in wrong
    )


def test_known_failures_are_expected_to_fail():
    # The table must contain cells that are expected to fail.
    found = {(cell.case, cell.holds) for trial in ("T1", "T2", "T7", "T14") for cell in quick(trial, "rk4")
             if cell.expected is False}  # fmt: skip
    assert {case for case, _ in found} >= {"step of h w = 3", "step of 200 us", "v_s = 1e-05 m/s", "v0 = 1e-05 m/s"}
    assert not any(holds for _, holds in found)


def test_a_cell_reports_disagreement():
    cell = Cell("case", 2.0, 1.0, "")
    assert not cell.holds
    assert not cell.agrees
    assert cell._replace(expected=False).agrees
    assert cell._replace(expected=None).agrees
    assert not cell._replace(value=math.nan).holds
    assert cell._replace(value=math.nan).document()["value"] == "nan"


@pytest.mark.parametrize(("factor", "speed"), [(0.0, 0.3), (0.1665, 0.3), (1.4328, 1e-4)])
def test_impact_quadrature_against_an_integration(factor, speed):
    from scipy.integrate import solve_ivp

    mass, stiffness, floor = 1.99, 2.86e10, 1e-3
    right = impact(mass=mass, speed=speed, stiffness=stiffness, exponent=1.5, factor=factor, speed_floor=floor)

    def rates(t, z):
        force = stiffness * max(0.0, z[0]) ** 1.5 * (1.0 + factor * z[1] / max(speed, floor))
        return [z[1], -force / mass]

    def apart(t, z):
        return z[0] + (1.0 if t == 0.0 else 0.0)

    setattr(apart, "terminal", True)  # noqa: B010 - a function has no such attribute, the library wants one
    run = solve_ivp(rates, (0.0, 0.1), [0.0, speed], method="DOP853", events=apart, rtol=1e-11, atol=1e-18,
                    max_step=right.duration / 50)  # fmt: skip
    assert run.t[-1] == pytest.approx(right.duration, rel=1e-6)
    assert -run.y[1, -1] == pytest.approx(right.restitution * speed, rel=1e-6)
    assert run.y[0].max() == pytest.approx(right.depth, rel=1e-3)


@pytest.mark.parametrize("engine", [name for name in ENGINES if math.isfinite(traits(name).limit())])
@pytest.mark.parametrize("oscillator", [house_ratio, contact_ratio])
def test_linear_limits(engine, oscillator):
    limit = traits(engine).limit()
    mass = base_model(ModelLevels()).constants.house.inner_mass
    if oscillator is contact_ratio:
        mass = pivoted_mass(bare_shaft())
    stiffness = 1e8
    step = limit / math.sqrt(stiffness / mass)
    assert oscillator(engine, 0.97 * step, stiffness) < GROWN
    assert oscillator(engine, 1.03 * step, stiffness) > GROWN


def test_split_has_no_limit_for_the_houses():
    mass = base_model(ModelLevels()).constants.house.inner_mass
    for hw in (2.0, 5.0, 20.0):
        step = hw / math.sqrt(1e8 / mass)
        assert house_ratio("split", step, 1e8) == pytest.approx(1.0, abs=0.05)


def test_rk4_damps_as_theory_says():
    mass, stiffness, periods = base_model(ModelLevels()).constants.house.inner_mass, 1e8, 60
    hw = 0.3
    step = hw / math.sqrt(stiffness / mass)
    # From the middle of the first quarter to the middle of the last.
    steps = 0.75 * periods * 2.0 * math.pi / hw
    measured = house_ratio("rk4", step, stiffness, periods=periods)
    assert np.log(measured) == pytest.approx(steps * math.log(1.0 - hw**6 / 72.0 + hw**8 / 576.0), rel=0.02)


def test_unknown_names_are_refused():
    from replays.studies.stability.table import select_engines, select_trials

    assert select_trials("t3, T7") == ["T3", "T7"]
    with pytest.raises(InputError, match="T99"):
        select_trials("T99")
    with pytest.raises(InputError, match="euler-forward"):
        select_engines("euler-forward")
