"""Every contact law in every engine that accepts it, against `rk8` at a tolerance of 1e-12.

| the engine's                               | must agree with        | because                                      |
|--------------------------------------------|------------------------|----------------------------------------------|
| motion through impacts, each damping law   | rk8's at 1e-12         | an engine with its own copy of a law can err |
| motion through impacts, each stiffness law | the same               | the same                                     |
| limits below, except for order 1           | a law stronger by 10 % | a limit that this law passes is too wide     |

A turning shaft falls by 27 um on the ring, off its lowest point, and bounces on it 3 to 10 times in 20 ms.
"""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from rig import InputError
from rig.physics.contacts import DAMPING, STIFFNESS
from rig.physics.engines import ENGINES, load_engine
from rig.run.simulation import Simulation

from .test_engines import compute_motion, make_simulation, rms_distance

LAWS = [*(("damping_factor", name) for name in DAMPING), *(("stiffness", name) for name in STIFFNESS)]
FRICTIONS = {"exact": {}, "smoothed": {"contact__smoothing_speed": 10.0}, "none": {}}
"""In the order in which they are tried; smoothing over 10 mm/s, which explicit steps follow."""
DURATION_S = 0.02
STEP_US = 2
"""Step of an engine of fixed steps; the longest that any of these impacts allows is some hundred."""
LIMIT = 1e-3


def get_limit(engine: str) -> float:
    """Return the limit of the distance between an engine and the reference, as a share of the states' scale.

    An adaptive engine's error per step is its tolerance: 300 of these allow for some thirty steps per impact, and for
    the
    amplification by impacts. With fixed steps of 2 us, order 1 reaches 3e-3 (10 impacts); from order 2 on the corners
    of a
    force law limit the accuracy (Kelvin-Voigt's force jumps at onset and is clamped before separation, where no event
    is),
    up to 6e-4.
    """
    if tolerance := ENGINES[engine].tolerance:
        return 300.0 * tolerance
    return 5.0 * LIMIT if load_engine(engine).order < 2 else LIMIT


def make_falling(engine: str, field: str, law: str, friction: str, **choice: object) -> Simulation:
    """Prepare a simulation shortly before its first impact."""
    return make_simulation(
        "drop", engine, initial__position="given", initial__x_mm=0.35, initial__y_mm=-0.8, drive__speed_hz=6.2,
        contact__restitution=0.7, model__friction=friction, **{f"contact__{field}": law},
        **FRICTIONS[friction], **choice,
    )  # fmt: skip


@cache
def compute_reference(field: str, law: str, friction: str) -> np.ndarray:
    """Return the scaled states of the reference, shape (n, 7)."""
    return run_bouncing(make_falling("rk8", field, law, friction, engine__step_us=5, engine__tolerance=1e-12))


def run_bouncing(simulation: Simulation) -> np.ndarray:
    """Return the scaled states of a run that bounces, shape (n, 7)."""
    states = compute_motion(simulation, DURATION_S)
    assert simulation.health()["contacts"] >= 3
    return states


def choose_friction(engine: str, field: str, law: str) -> tuple[Simulation, str]:
    """Return the simulation by an engine with the first friction law that it accepts; skip the test if it accepts
    none.
    """
    choice = {} if ENGINES[engine].tolerance else {"engine__step_us": STEP_US}
    refusals = []
    for friction in FRICTIONS:
        try:
            return make_falling(engine, field, law, friction, **choice), friction
        except InputError as error:
            refusals.append(str(error))
    pytest.skip("; ".join(refusals))


@pytest.mark.parametrize(("field", "law"), LAWS)
@pytest.mark.parametrize("engine", ENGINES)
def test_law_is_the_same_in_every_engine(engine: str, field: str, law: str) -> None:
    simulation, friction = choose_friction(engine, field, law)
    assert rms_distance(run_bouncing(simulation), compute_reference(field, law, friction)) < get_limit(engine)


@pytest.mark.parametrize(("field", "law"), LAWS)
def test_limits_detect_a_law_that_is_ten_per_cent_stronger(field: str, law: str) -> None:
    simulation = make_falling("rk8", field, law, "exact")
    constants = simulation.model.constants
    stronger = {
        name: 1.1 * getattr(constants.contact, name) for name in ("stiffness", "damping_factor", "viscous_damping")
    }
    simulation.model = dataclasses.replace(
        simulation.model, constants=constants._replace(contact=constants.contact._replace(**stronger))
    )
    assert rms_distance(run_bouncing(simulation), compute_reference(field, law, "exact")) > LIMIT
