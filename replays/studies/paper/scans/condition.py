"""Conditions and frequency of backward whirl: closed forms, and the rig for comparison.

A point mass m on a circular orbit of radius r touches the ring at the whirl frequency w, with a spring K and a damper
D. Radially N = m r (w^2 - w_n^2), so w must be above w_n (the paper's eq. 42). Along the ring, friction drives with at
most mu N and damping brakes with D r w. So a whirl is sustained, and a sliding whirl accelerates, if
mu (w^2 - w_n^2) >= 2 zeta w_n w, that is |w| >= w_n [zeta/mu + sqrt(1 + (zeta/mu)^2)]. This is eq. 43, whose "<="
refers to two negative frequencies (the next sentence mentions the sign), with the ratio zeta for its D, which has a
unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from replays.studies.ladder.quantity import find_rolling_start
from replays.studies.paper.scans.pulse import Pulse, PulseRun, pulse_scene
from replays.studies.stability.trials.boundary import BOUNCING, FREE, NAMES, ROLLING, SLIDING
from replays.studies.stability.trials.motion import base_model, move, pivoted_mass, quiet_inputs, state
from rig.channels.orbit import phase, whirl_frequency
from rig.ensemble.batch import Batch
from rig.physics.kernels.constants import Constants
from rig.physics.levels import ModelLevels

ENGINE = "split"
FRICTIONS = (0.05, 0.08, 0.12, 0.18, 0.25, 0.35)
"""Frictions for which the slowest accelerating whirl is computed."""
SPINS_HZ = (3.2, 6.2, 9.0)
"""Spins for which the least sustaining friction is computed [Hz]."""
_TICKS_S = 1e6
_CLASSES = {"free": FREE, "backward whirl": ROLLING, "forward whirl": SLIDING}
_MAX_SLOWDOWN = 1e-3
"""Largest relative decrease of a steady whirl frequency in half a second."""
_NAN = (math.nan, math.nan)


class Oscillator(NamedTuple):
    """The shaft at the ring as a mass with spring and damper."""

    mass: float
    """m = I_xx / l_0A^2 [kg]."""
    natural: float
    """w_n [rad/s]."""
    ratio: float
    """zeta [1]."""


def oscillator(constants: Constants) -> Oscillator:
    """Return the shaft referred to the ring, with the mean damping of both directions.

    On a circle the dampers in x and y act alternately, so their mean over a turn is that of the two values.
    """
    shaft, magnet = constants.shaft, constants.magnet
    mass = pivoted_mass(constants)
    lever = (shaft.arm_magnet / shaft.arm_ring) ** 2
    natural = math.sqrt(magnet.stiffness * lever / mass)
    damping = 0.5 * (magnet.damping_x + magnet.damping_y) * lever
    return Oscillator(mass, natural, damping / (2.0 * mass * natural))


def critical_whirl(own: Oscillator, friction: float) -> float:
    """Return the slowest whirl that friction sustains against damping [rad/s], eq. 43."""
    share = own.ratio / friction
    return own.natural * (share + math.sqrt(1.0 + share * share))


def least_friction(own: Oscillator, whirl: float) -> float:
    """Return the least friction that sustains a whirl [1], eq. 43; infinite below the natural frequency."""
    excess = whirl * whirl - own.natural**2
    return 2.0 * own.ratio * own.natural * whirl / excess if excess > 0.0 else math.inf


def friction_with_houses(constants: Constants, spin: float) -> float:
    """Return the least friction that sustains whirl with dissipation in the housings' beams [1].

    The rotating normal force excites the inner and outer housing, two masses on a line in x and in y (eqs. 22-25), at
    their amplitudes of forced vibration; friction must supply the mean power of their dampers.
    """
    own = oscillator(constants)
    whirl, radius = rolling_circle(constants, spin)
    whirl = -whirl
    force = normal_force(own, whirl, radius)
    power = -0.5 * whirl * force * sum(amplitude.imag for amplitude in _ring_motion(constants, whirl, force))
    return least_friction(own, whirl) + power / (radius * whirl * force)


def _ring_motion(constants: Constants, whirl: float, force: float) -> tuple[complex, complex]:
    """Return the complex amplitudes of the ring's centre in x and y under a rotating force [m]."""
    house = constants.house
    lines = (
        (house.inner_beam_stiffness + 1j * whirl * house.inner_beam_damping, complex(house.pair_stiffness_horizontal)),
        (complex(house.pair_stiffness_vertical), house.outer_beam_stiffness + 1j * whirl * house.outer_beam_damping),
    )
    amplitudes = []
    for link, support in lines:
        matrix = np.array(
            [
                [link - house.inner_mass * whirl**2, -link],
                [-link, link + support - house.outer_mass * whirl**2],
            ]
        )
        amplitudes.append(complex(np.linalg.solve(matrix, np.array([force, 0.0]))[0]))
    return amplitudes[0], amplitudes[1]


def friction_swing(constants: Constants, spin: float) -> float:
    """Return the amplitude of the friction about its mean in a rolling whirl with moving housings [N].

    The housings are more compliant horizontally than vertically, so the ring's centre moves on an ellipse with half
    axes X and Y: a circle in the direction of whirl, and one of radius |X - Y|/2 against it. Relative to the shaft, the
    latter rotates at twice the whirl frequency and accelerates and brakes it along the ring by m w^2 |X - Y| / 2.
    """
    own = oscillator(constants)
    whirl, radius = rolling_circle(constants, spin)
    force = normal_force(own, whirl, radius)
    across, up = _ring_motion(constants, -whirl, force)
    return 0.5 * own.mass * whirl**2 * abs(across - up)


def normal_force(own: Oscillator, whirl: float, radius: float) -> float:
    """Return the force on the ring in a circular whirl [N]: m r (w^2 - w_n^2)."""
    return own.mass * radius * (whirl * whirl - own.natural**2)


def rolling_whirl(constants: Constants, spin: float) -> tuple[float, float]:
    """Return the whirl frequency of rolling [rad/s, negative] and the penetration [m]: w = -spin R_S / (r0 + delta).

    delta is Hertz's penetration at the force of the circular whirl, by fixed-point iteration with a rate of about
    delta/r0.
    """
    own, contact = oscillator(constants), constants.contact
    depth = 0.0
    for _ in range(50):
        radius = contact.clearance + depth
        whirl = spin * constants.shaft.radius / radius
        depth = (max(0.0, normal_force(own, whirl, radius)) / contact.stiffness) ** (1.0 / contact.exponent)
    return -spin * constants.shaft.radius / (contact.clearance + depth), depth


def rolling_circle(constants: Constants, spin: float) -> tuple[float, float]:
    """Return whirl frequency [rad/s] and radius [m] of rolling at a spin [rad/s]."""
    whirl, depth = rolling_whirl(constants, spin)
    return whirl, constants.contact.clearance + depth


def bare_rig(friction: float) -> Constants:
    """Return the system of the closed forms: linear magnets, a rigid centred ring, equal damping in both directions."""
    constants = base_model(ModelLevels(magnet="linear", shaft="planar", stator="rigid")).constants
    damping = 0.5 * (constants.magnet.damping_x + constants.magnet.damping_y)
    return constants._replace(
        shaft=constants.shaft._replace(unbalance=0.0, gravity=0.0),
        magnet=constants.magnet._replace(damping_x=damping, damping_y=damping),
        contact=constants.contact._replace(offset_x=0.0, offset_y=0.0, friction=friction),
    )


def _whirl_state(constants: Constants, whirl: float, spin: float) -> np.ndarray:
    """Return a state on the ring EAST of its centre, whirling backward [rad/s, as a positive number]."""
    arm = constants.shaft.arm_ring
    radius = constants.contact.clearance
    # y = -arm Gamma: Gamma' > 0 moves down, which at EAST is backward.
    return state(
        beta=(radius + constants.contact.offset_x) / arm,
        Gamma=-constants.contact.offset_y / arm,
        Gamma_rate=whirl * radius / arm,
        theta_rate=spin,
    )


def gains_speed(constants: Constants, whirl: float) -> bool:
    """Return whether a sliding whirl accelerates at a spin above that of rolling."""
    # Three times the spin of rolling; a larger one would show the gyroscopic moment, which the closed form neglects.
    spin = 3.0 * whirl * constants.contact.clearance / constants.shaft.radius
    motion = move(
        ENGINE,
        constants,
        quiet_inputs(spin=spin, magnets=True, ideal=True),
        _whirl_state(constants, whirl, spin),
        ticks=round(0.4 * _TICKS_S),
        every=500,
    )
    last = motion.times > 0.35
    touching = motion.column("penetration")[last] > 0.0
    angle = phase(motion.column("ring_x")[last], motion.column("ring_y")[last])
    passed_s = float(motion.times[last][-1] - motion.times[last][0])
    return bool(touching.all()) and float(angle[0] - angle[-1]) > whirl * passed_s


def keeps_whirling(constants: Constants, y0: np.ndarray, spin: float) -> bool:
    """Return whether a whirl stays in contact for 1 s at a constant spin without slowing down in the second half.

    It may slip during part of each turn; it is then steady, but slightly slower than one that rolls.
    """
    inputs = quiet_inputs(spin=spin, magnets=True, ideal=True)
    motion = move(ENGINE, constants, inputs, y0, ticks=round(1.0 * _TICKS_S), every=500)
    if not (motion.column("penetration") > 0.0).all():
        return False
    x, y = motion.column("ring_x"), motion.column("ring_y")

    def whirl_hz(begin_s: float) -> float:
        part = (motion.times > begin_s) & (motion.times <= begin_s + 0.1)
        return whirl_frequency(x[part], y[part], motion.times[part], about=0.0)

    return whirl_hz(0.9) < (1.0 - _MAX_SLOWDOWN) * whirl_hz(0.4)  # both are negative


def bisect(holds: Callable[[float], bool], low: float, high: float) -> float:
    """Return where a test changes from false (at `low`) to true (at `high`), on a logarithmic scale; NaN if nowhere."""
    if holds(low) or not holds(high):
        return math.nan
    for _ in range(10):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if holds(middle) else (middle, high)
    return math.sqrt(low * high)


class Threshold(NamedTuple):
    """A threshold, simulated and by closed form."""

    friction: float
    spin_hz: float
    closed: float
    bare: float
    full: float
    with_houses: float
    used: tuple[float, float]
    """Mean and maximum of friction over normal force in the full rig at mu = 0.25, rolling."""

    @property
    def error(self) -> float:
        """Relative deviation of the bare rig from the closed form."""
        return self.bare / self.closed - 1.0


def start_thresholds(frictions: tuple[float, ...] = FRICTIONS) -> list[Threshold]:
    """Return the slowest accelerating sliding whirl [Hz], by friction; `full` is NaN, as its magnets are not linear."""
    rows = []
    for mu in frictions:
        constants = bare_rig(mu)
        closed = critical_whirl(oscillator(constants), mu)
        bare = bisect(partial(gains_speed, constants), 0.6 * closed, 2.0 * closed)
        rows.append(Threshold(mu, math.nan, closed / (2 * math.pi), bare / (2 * math.pi), math.nan, math.nan, _NAN))
    return rows


def sustain_thresholds(spins_hz: tuple[float, ...] = SPINS_HZ) -> list[Threshold]:
    """Return the least friction that sustains a rolling whirl, by spin."""
    thresholds = []
    for spin_hz in spins_hz:
        spin = 2.0 * math.pi * spin_hz
        bare = bare_rig(0.25)
        whirl, _ = rolling_whirl(bare, spin)
        closed = least_friction(oscillator(bare), -whirl)
        full = base_model(ModelLevels()).constants
        bare_mu, full_mu = (bisect(_make_test(each, spin), 0.3 * closed, 6.0 * closed) for each in (bare, full))
        with_houses, used = friction_with_houses(full, spin), friction_demand(full, spin)
        thresholds.append(Threshold(math.nan, spin_hz, closed, bare_mu, full_mu, with_houses, used))
    return thresholds


class Slip(NamedTuple):
    """Transition of a sliding whirl to rolling, on the bare rig without damping or drive."""

    whirl_hz: float
    """Initial whirl frequency [Hz]."""
    kept: float
    """Final spin over initial spin [1]."""
    kept_closed: float
    time_s: float
    time_closed_s: float


def remaining_spin(constants: Constants) -> float:
    """Return the part of its spin that a shaft keeps after slipping from rest on a rigid ring until it rolls [1].

    The friction impulse J gives m v = J along the ring and R_S J = I_zz (spin before - after); rolling means v = R_S
    spin.
    """
    shaft = constants.shaft
    return shaft.polar_inertia / (shaft.polar_inertia + pivoted_mass(constants) * shaft.radius**2)


def find_slips() -> list[Slip]:
    """Return transitions from sliding whirl to rolling, simulated and by closed form.

    m r w' = mu N with N = m r (w^2 - w_n^2), so the time is the elementary integral of dw / (mu (w^2 - w_n^2)). The
    contact is also assumed to be rigid, so r = r0.
    """
    constants = bare_rig(0.25)
    constants = constants._replace(magnet=constants.magnet._replace(damping_x=0.0, damping_y=0.0), torque_gain=0.0)
    own, r0, radius = oscillator(constants), constants.contact.clearance, constants.shaft.radius
    spin, kept, mu = 2.0 * math.pi * 6.2, remaining_spin(constants), constants.contact.friction
    slips = []
    for whirl_hz in (12.0, 20.0, 40.0):
        begin = 2.0 * math.pi * whirl_hz
        # The initial whirl adds to the momentum from friction: I_zz spin + m R_S v is conserved.
        after = kept + (1.0 - kept) * r0 * begin / (radius * spin)
        high, low = (math.log((w - own.natural) / (w + own.natural)) for w in (after * spin * radius / r0, begin))
        inputs = quiet_inputs(spin=spin, magnets=True)
        motion = move(
            ENGINE, constants, inputs, _whirl_state(constants, begin, spin), ticks=round(0.5 * _TICKS_S), every=50
        )
        rolls_s = find_rolling_start(motion.times, motion.rows, radius)
        spin_end = float(motion.column("theta_rate")[motion.times >= rolls_s].mean())
        slips.append(Slip(whirl_hz, spin_end / spin, after, rolls_s, (high - low) / (2.0 * mu * own.natural)))
    return slips


def friction_demand(constants: Constants, spin: float) -> tuple[float, float]:
    """Return mean and maximum of friction over normal force in a rolling whirl [1]."""
    inputs = quiet_inputs(spin=spin, magnets=True, ideal=True)
    motion = move(ENGINE, constants, inputs, settle_rolling(constants, spin), ticks=round(0.5 * _TICKS_S), every=100)
    normal, friction = (motion.column(name)[1000:] for name in ("normal_force", "friction_force"))
    there = normal > 0.0
    return abs(float(friction.mean() / normal.mean())), float(np.max(np.abs(friction[there] / normal[there])))


def _make_test(constants: Constants, spin: float) -> Callable[[float], bool]:
    """Return a test of whether a rolling whirl persists at a friction."""
    start = settle_rolling(constants, spin)

    def holds(mu: float) -> bool:
        changed = constants._replace(contact=constants.contact._replace(friction=mu))
        return keeps_whirling(changed, start, spin)

    return holds


def settle_rolling(constants: Constants, spin: float) -> np.ndarray:
    """Return a settled rolling whirl of a rig, as state and integrals."""
    whirl, _ = rolling_whirl(constants, spin)
    inputs = quiet_inputs(spin=spin, magnets=True, ideal=True)
    y0 = _whirl_state(constants, -whirl, spin)
    return move(ENGINE, constants, inputs, y0, ticks=round(0.5 * _TICKS_S), every=10_000).end


@dataclass(frozen=True)
class Start:
    """Outcome of one pulse over friction.

    Attributes:
        force_n: Peak of the pulse [N].
        frictions: Frictions, shape (n,).
        classes: Classes of `replays.studies.stability.trials.boundary`, shape (n,).
    """

    force_n: float
    frictions: np.ndarray
    classes: np.ndarray

    @property
    def first(self) -> float:
        """Least scanned friction that ends in a rolling whirl; NaN if none does."""
        rolls = np.flatnonzero(self.classes == ROLLING)
        return float(self.frictions[rolls[0]]) if len(rolls) else math.nan

    @property
    def always(self) -> float:
        """Least scanned friction above which all runs do; NaN if the highest does not."""
        other = np.flatnonzero(self.classes != ROLLING)
        after = int(other[-1]) + 1 if len(other) else 0
        return float(self.frictions[after]) if after < len(self.frictions) else math.nan

    @property
    def words(self) -> str:
        """Number of runs per class, in words."""
        return ", ".join(f"{n} {NAMES[k]}" for k in range(len(NAMES)) if (n := int(np.sum(self.classes == k))))


def start_by_pulse(force_n: float, *, points: int) -> Start:
    """Scan friction for one pulse of 5 ms at 6.2 Hz."""
    frictions = np.linspace(0.02, 0.40, points)
    runs = Batch(pulse_scene(Pulse(force_n=force_n)), ["contact.friction"]).run(frictions[:, None])
    return Start(force_n, frictions, np.array([_CLASSES.get(outcome, BOUNCING) for outcome in runs["outcome"]]))


def pulse_whirl(constants: Constants, *, force_n: float, duration_s: float) -> float:
    """Return the whirl frequency if a half-sine pulse at the disk became motion along the ring [rad/s]."""
    shaft = constants.shaft
    impulse = force_n * duration_s * 2.0 / math.pi
    speed = impulse * shaft.arm_disk * shaft.arm_ring / shaft.transverse_inertia
    return speed / constants.contact.clearance


def sweep_pulses(speeds_hz: tuple[float, ...]) -> list[Pulse]:
    """Return a pulse for each speed with a drive at constant speed, for testing the law of the whirl frequency."""
    pulse = Pulse(changes={"drive.mode": "ideal"}, force_n=150.0)
    return [replace(pulse, label=f"{speed:g} Hz", speed_hz=speed) for speed in speeds_hz]


def law_hz(speed_hz: float) -> tuple[float, float]:
    """Return the whirl frequency of rolling in the corrected rig [Hz], and with a rigid ring."""
    constants = base_model(ModelLevels()).constants
    whirl, _ = rolling_whirl(constants, 2.0 * math.pi * speed_hz)
    return whirl / (2.0 * math.pi), -speed_hz * constants.shaft.radius / constants.contact.clearance


def law_error(result: PulseRun, speed_hz: float) -> float:
    """Return the relative deviation of the simulated whirl frequency from the closed form."""
    return result.whirl_hz / law_hz(speed_hz)[0] - 1.0
