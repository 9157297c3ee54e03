"""Trials without contact (T1, T5, T6): an undamped mode of the housings, a hammer pulse, free flight of the rig."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from replays.studies.common.closed_forms import Mode, linear_motion, stiffest_mode
from replays.studies.common.engines import traits
from replays.studies.peers.common.problem import scaled_error
from replays.studies.stability.trials.cell import Cell
from replays.studies.stability.trials.motion import bare_shaft, base_model, move, quiet_inputs, state
from rig.physics.engines import ENGINES
from rig.physics.kernels.constants import Constants
from rig.physics.kernels.signals import COLUMN
from rig.physics.levels import ModelLevels

_UNREACHED_CLEARANCE = 1e200
"""Clearance of a ring that is never reached [m]."""


def house_oscillator() -> tuple[Constants, Mode]:
    """Return the rig at rest without contact or damping, and the stiffest mode of its housings (vertical)."""
    constants = base_model(ModelLevels(magnet="linear", shaft="planar")).constants
    house = constants.house._replace(inner_beam_damping=0.0, outer_beam_damping=0.0, preload=1e7)
    # With the true preload of the transducers, a growing mode would unload them, soften and stay bounded.
    contact = constants.contact._replace(clearance=_UNREACHED_CLEARANCE)
    mode = stiffest_mode(
        inner=house.inner_mass, outer=house.outer_mass, link=house.pair_stiffness_vertical,
        support=house.outer_beam_stiffness,
    )  # fmt: skip
    return constants._replace(house=house, contact=contact), mode


def house_energy(constants: Constants, states: np.ndarray) -> np.ndarray:
    """Return the energy of the housings' vertical motion [J], shape (n,); `states` has shape (n, 14 or more)."""
    house = constants.house
    inner, outer, inner_rate, outer_rate = (states[:, COLUMN[name]] for name in ("y_ih", "y_oh", "vy_ih", "vy_oh"))
    return 0.5 * (
        house.inner_mass * inner_rate**2
        + house.outer_mass * outer_rate**2
        + house.pair_stiffness_vertical * (inner - outer) ** 2
        + house.outer_beam_stiffness * outer**2
    )


def _ring_down(engine: str, duration_s: float, hw: float = 0.0) -> float:
    """Return E/E0 of the housings' stiffest mode, E averaged over the last 5 %; h w > 0 sets the step."""
    constants, mode = house_oscillator()
    angular = 2.0 * math.pi * mode.frequency_hz
    step_s = hw / angular if hw else ENGINES[engine].step_us * 1e-6
    step, tick_s = (1, step_s) if hw else (ENGINES[engine].step_us, 1e-6)
    amplitude = 1e-6
    y0 = state(y_ih=amplitude * mode.inner, y_oh=amplitude * mode.outer)
    ticks = round(duration_s / tick_s)
    with np.errstate(all="ignore"):
        motion = move(engine, constants, quiet_inputs(tick_s=tick_s), y0, ticks=ticks, step=step, every=step)
        energy = house_energy(constants, motion.rows)
        window = max(1, len(energy) // 20)
        # It starts from rest, where the energy that a first-order method conserves equals the true energy.
        return float(np.mean(energy[-window:]) / energy[0])


def ring_down_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T1: an undamped mode at the engine's own step, and at steps around the theoretical limits."""
    yield Cell("own step, 0.2 s", abs(_ring_down(engine, 0.2) - 1.0), 0.01,
               "an undamped mode keeps its energy within 1 %")  # fmt: skip
    limit = traits(engine).oscillator_limit
    for hw in (1.9, 2.5, 3.0):
        growth = _ring_down(engine, 0.1, hw) - 1.0
        expected, because = None, ""
        if limit is not None:
            expected = hw < limit
            boundless = math.isinf(limit)
            because = "no limit: exact flow, error control, or implicit" if boundless else ""
            because = because or f"h w = {hw:g} against its limit of {limit:.4g}"
        # Energy must not grow without limit: near the stability limit it varies by 1/(1 - h w/2), beyond it by powers
        # of ten. Damping by a coarse step is shown in the atlas.
        yield Cell(f"step of h w = {hw:g}", growth, 100.0, because, expected)


def pulse_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T5: a pulse of 5 ms on a shaft at rest, at the engine's own step and at the longest step of a scene."""
    constants = bare_shaft()
    constants = constants._replace(contact=constants.contact._replace(clearance=_UNREACHED_CLEARANCE))
    force, start, end = 100.0, 100_000, 105_000
    right = constants.shaft.arm_disk * force * (end - start) * 1e-6 * 2.0 / math.pi
    for case, step in (("own step", 0), ("longest step a scene takes, 1 ms", 1000)):
        # Nothing else moves, so an adaptive engine reaches the pulse with its longest steps.
        motion = move(engine, constants, quiet_inputs(pulse=(force, start, end)), state(), ticks=200_000, step=step)
        got = float(motion.final_value("beta_rate")) * constants.shaft.transverse_inertia
        allowance = traits(engine).allowance
        # A low-order engine resolves the pulse poorly: the trapezoidal rule with five steps.
        limit = 0.5 if step and allowance > 1.0 else 1e-3 * allowance
        yield Cell(case, abs(got / right - 1.0), limit,
                   "no step is longer than the grid's, which is shorter than the pulse")  # fmt: skip


def free_flight(engine: str) -> float:
    """Return the scaled error of 0.2 s of free flight (planar rig, linear magnets) against the matrix exponential."""
    c = base_model(ModelLevels(magnet="linear", shaft="planar")).constants
    c = c._replace(contact=c.contact._replace(clearance=_UNREACHED_CLEARANCE), shaft=c.shaft._replace(unbalance=0.0))
    spin = 2.0 * math.pi * 6.2
    y0 = state(
        Gamma=3e-3, beta=-2e-3, Gamma_rate=0.2, beta_rate=0.5, theta_rate=spin, x_ih=5e-6, y_ih=-4e-6, vx_oh=0.01,
        vy_ih=0.02,
    )  # fmt: skip
    inputs = quiet_inputs(spin=spin, magnets=True)
    motion = move(engine, c, inputs, y0, ticks=200_000, every=10_000)
    times = np.append(motion.times, 0.2)
    return scaled_error(motion.states, linear_motion(*_linear_rates(c, spin), y0[:14], times))


def _linear_rates(c: Constants, spin: float) -> tuple[np.ndarray, np.ndarray]:
    """Return A and b of z' = A z + b with z = Gamma, beta, theta, x_ih, y_ih, x_oh, y_oh and their rates.

    Returns:
        Arrays of shapes (14, 14) and (14,).
    """
    s, m, h = c.shaft, c.magnet, c.house
    # y = -l Gamma, x = l beta.
    a, b = np.zeros((14, 14)), np.zeros(14)
    a[:7, 7:] = np.eye(7)
    arm2, gyro = s.arm_magnet**2, s.polar_inertia * spin
    a[7, 0] = -m.stiffness * arm2
    a[7, 7], a[7, 8] = -m.damping_y * arm2, -gyro
    a[8, 1] = -m.stiffness * arm2
    a[8, 8], a[8, 7] = -m.damping_x * arm2, gyro
    a[7:9] /= s.transverse_inertia
    for inner, outer, link, damping, ground, loss in (
        (3, 5, h.inner_beam_stiffness, h.inner_beam_damping, h.pair_stiffness_horizontal, 0.0),
        (4, 6, h.pair_stiffness_vertical, 0.0, h.outer_beam_stiffness, h.outer_beam_damping),
    ):
        columns = [inner, outer, inner + 7, outer + 7]
        a[inner + 7, columns] = np.array([-link, link, -damping, damping]) / h.inner_mass
        a[outer + 7, columns] = np.array([link, -link - ground, damping, -damping - loss]) / h.outer_mass
    b[7] = s.mass * s.gravity * s.arm_centre / s.transverse_inertia  # gravity lowers y: Gamma grows
    return a, b


def free_flight_cases(engine: str, quick: bool) -> Iterator[Cell]:
    """Yield T6: free flight against the matrix exponential."""
    limit = 1e-4 * traits(engine).allowance
    yield Cell("0.2 s", free_flight(engine), limit, "a smooth linear problem")
