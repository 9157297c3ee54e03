"""Stability map of every engine over step and stiffness: energy of an undamped oscillator after 60 periods.

Two oscillators are used: the inner housing on its beam, and the shaft in the ring on a linear contact. For fixed-step
engines, theory predicts a line h w = const.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from replays.studies.common.engines import traits
from replays.studies.stability.trials.motion import bare_shaft, base_model, move, pivoted_mass, quiet_inputs, state
from rig.physics.kernels.constants import Constants
from rig.physics.levels import ModelLevels

PERIODS = 60
_DEPTH = 20e-6
"""Static depth of the contact [m]."""
GROWN = 3.0
"""Energy ratio above which a run counts as unstable."""


class Map(NamedTuple):
    """Map of one engine on one oscillator.

    Attributes:
        engine: Name of the engine.
        oscillator: "house" or "contact".
        steps_us: Steps, shape (n,) [us].
        stiffness: Stiffnesses, shape (m,) [N/m].
        mass: Mass [kg].
        ratio: Final over initial energy, shape (m, n); inf if it is not finite.
    """

    engine: str
    oscillator: str
    steps_us: np.ndarray
    stiffness: np.ndarray
    mass: float
    ratio: np.ndarray

    @property
    def limit(self) -> float:
        """Theoretical limit of h w; NaN if there is none."""
        return traits(self.engine).limit()


def house_ratio(engine: str, step_s: float, stiffness: float, *, periods: int = PERIODS) -> float:
    """Return the energy ratio of the inner housing on its undamped beam, with the outer housing fixed."""
    constants = base_model(ModelLevels(magnet="linear", shaft="planar", stator="inner-house")).constants
    house = constants.house._replace(inner_beam_damping=0.0, inner_beam_stiffness=stiffness)
    constants = constants._replace(house=house, contact=constants.contact._replace(clearance=1e200))
    y0 = state(x_ih=1e-6)
    return _ratio(engine, constants, y0, step_s, stiffness, house.inner_mass, ("x_ih", "vx_ih"), 1.0, periods)


def contact_ratio(engine: str, step_s: float, stiffness: float, *, periods: int = PERIODS) -> float:
    """Return the energy ratio of a small oscillation of the shaft on an undamped linear contact, loaded by its weight.

    The weight is scaled to a depth of 20 µm, and the oscillation is 1/100 of that; with a smaller one, error control
    would have no effect.
    """
    constants = bare_shaft(damping_factor=0.0, exponent=1.0, stiffness=stiffness, gravity=True)
    shaft = constants.shaft
    depth = shaft.mass * shaft.gravity * shaft.arm_centre / shaft.arm_ring / stiffness
    shaft = shaft._replace(gravity=shaft.gravity * _DEPTH / depth)
    constants = constants._replace(shaft=shaft)
    # Gamma > 0 lowers the shaft.
    rest = (constants.contact.clearance + _DEPTH) / shaft.arm_ring
    y0 = state(Gamma=rest + 0.01 * _DEPTH / shaft.arm_ring)
    columns = ("Gamma", "Gamma_rate")
    return _ratio(engine, constants, y0, step_s, stiffness, pivoted_mass(constants), columns, shaft.arm_ring, periods,
                  rest=rest)  # fmt: skip


OSCILLATORS = {"house": house_ratio, "contact": contact_ratio}


def chart(engine: str, oscillator: str, *, points: int, periods: int = PERIODS) -> Map:
    """Return the map of one engine on one oscillator.

    Args:
        engine: Name of the engine.
        oscillator: "house" or "contact".
        points: Points along each axis.
        periods: Length of each run.
    """
    steps = np.geomspace(2.0, 1000.0, points)
    stiffness = np.geomspace(1e5, 1e10, points)
    mass = base_model(ModelLevels()).constants.house.inner_mass if oscillator == "house" else pivoted_mass(bare_shaft())
    run = OSCILLATORS[oscillator]
    ratio = np.full((points, points), np.nan)
    for i, k in enumerate(stiffness):
        for j, h in enumerate(steps):
            # Smaller products only take long runs; for larger ones the result is certain.
            if 5e-2 < h * 1e-6 * math.sqrt(k / mass) < (30.0 if oscillator == "house" else 5.0):
                ratio[i, j] = run(engine, h * 1e-6, float(k), periods=periods)
    return Map(engine, oscillator, steps, stiffness, mass, ratio)


def _ratio(
    engine: str, constants: Constants, y0: np.ndarray, step_s: float, stiffness: float, mass: float,
    columns: tuple[str, str], arm: float, periods: int, rest: float = 0.0,
) -> float:  # fmt: skip
    """Return the energy in the last quarter relative to that in the first part; `rest` is the equilibrium.

    The first part is a quarter; for the contact a fortieth, before growth lifts the shaft off. In the contact `split`
    first settles, and its position of rest is its mean.
    """
    angular = math.sqrt(stiffness / mass)
    # Beyond every limit, a few steps suffice; more would only overflow.
    longest = 40 if angular * step_s > 3.6 else 10**9
    ticks = min(longest, max(40, math.ceil(periods * 2.0 * math.pi / (angular * step_s))))
    with np.errstate(all="ignore"):
        try:
            motion = move(
                engine, constants, quiet_inputs(tick_s=step_s), y0, ticks=ticks, step=1, every=max(1, ticks // 997)
            )
        except ZeroDivisionError:  # overflow of a force over its distance
            return math.inf
        place, speed = arm * (motion.column(columns[0]) - rest), arm * motion.column(columns[1])
        part = len(place) // 4

        def energy(window: slice) -> float:
            return stiffness * float(np.mean(place[window] ** 2)) + mass * float(np.mean(speed[window] ** 2))

        early = part if columns[0] == "x_ih" else max(4, len(place) // 40)
        ratio = energy(slice(-part, None)) / energy(slice(None, early))
    return ratio if math.isfinite(ratio) else math.inf
