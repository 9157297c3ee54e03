"""Numbers on the questions that the paper leaves open; the report's template interprets them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from replays.studies.common.closed_forms import Impact, impact, stiffest_mode
from replays.studies.paper.claim import Groups, Results, median
from replays.studies.paper.reproduction import G, Reproduction, bare_drop, drop_impact, drop_impulse, drop_rebounds
from replays.studies.paper.scans.condition import oscillator
from replays.studies.paper.scans.pulse import Pulse
from replays.studies.paper.scans.spread import free_values, phases
from replays.studies.paper.statement import statements
from rig.physics.kernels.constants import Constants
from rig.physics.magnets import cylinder_stiffness, field_sum_stiffness
from rig.physics.model import magnet_geometry, reference_impact
from rig.physics.parameters import load_parameters
from rig.run.offline import Run, simulate
from rig.run.scenes import load_scene

PAPER_DROP_N = 100.0
OUTER_MASSES_KG = (7.18, 8.88, 10.58)
PAIR_STIFFNESS = (0.5, 1.0, 2.0)
"""Factors on the stiffness K_ft of one transducer."""
K_FT = 8.88e7
STIFFNESSES_KN_M = (0.74, 1.0, 1.3, 1.7, 2.5)
_LENGTHS_MM = (10.0, 16.9, 25.0, 35.0, 50.0)
_PRINTED_RATIO = 13.5

Numbers = dict[str, Any]


def question_groups(*, ensemble: int) -> Groups:
    """Return hammer pulses for the questions on the housings."""
    groups: Groups = {}
    for mass in OUTER_MASSES_KG:
        pulse = Pulse(label=f"M_oh {mass:g} kg", changes={"house.outer_mass": mass})
        groups[f"mass {mass:g}"] = phases(pulse, ensemble)
    for factor in PAIR_STIFFNESS:
        keys = ("house.pair_stiffness_vertical", "house.pair_stiffness_horizontal")
        pulse = Pulse(label=f"k_T {factor:g} K_ft", changes=dict.fromkeys(keys, factor * K_FT))
        groups[f"pair {factor:g}"] = phases(pulse, ensemble)
    return groups


def compute_fall(constants: Constants) -> tuple[float, float]:
    """Return time [s] and speed at the ring [m/s] of a fall through the whole clearance, from rest, for small angles.

    About the pivot I_xx Gamma'' = M g l_0C, so the height at the ring decreases with a = M g l_0C l_0A / I_xx.
    """
    shaft = constants.shaft
    a = shaft.mass * shaft.gravity * shaft.arm_centre * shaft.arm_ring / shaft.transverse_inertia
    height = 2.0 * constants.contact.clearance
    return math.sqrt(2.0 * height / a), math.sqrt(2.0 * a * height)


def ring_weight(constants: Constants) -> float:
    """Return the shaft's weight at the ring [N], the mean force of a drop from release to rest."""
    shaft = constants.shaft
    return shaft.mass * shaft.gravity * shaft.arm_centre / shaft.arm_ring


def drop_numbers(by_set: dict[str, Reproduction]) -> Numbers:
    """Return the numbers that compare the drop's 100 N with the change of momentum."""
    model = by_set["corrected"].drop.simulation.model
    contact, masses = model.constants.contact, reference_impact(model.parameters)
    time_s, speed = compute_fall(model.constants)

    def compute_impact(mass: float, at: float = speed, stiffness: float = contact.stiffness) -> Impact:
        return impact(
            mass=mass, speed=at, stiffness=stiffness, exponent=contact.exponent, factor=contact.damping_factor,
            speed_floor=contact.speed_floor,
        )  # fmt: skip

    stiffness = _find_printed_peak(lambda k: compute_impact(masses.shaft_mass, stiffness=k).peak, 1e4, 1e12)
    slow = _find_printed_peak(lambda v: compute_impact(masses.mass, v).peak, 2e-3, 1.0)
    free = compute_impact(masses.mass)
    half_sine_ms = 1e3 * math.pi / 2.0 * free.impulse / PAPER_DROP_N
    return {
        "fall_ms": time_s * 1e3,
        "speed": speed,
        "free": free,
        "fixed": compute_impact(masses.shaft_mass),
        "runs": {name: _drop_run(one) for name, one in by_set.items()},
        "rebounds": {
            f"{name}, {house}": (drop_rebounds(run), restitution(run) ** 2)
            for name, one in by_set.items()
            for house, run in (
                ("rigid housing", bare_drop({"parameters": name, "model.stator": "rigid"})),
                ("both housings", one.drop),
            )
        },
        "amplified": _amplification(by_set["corrected"].drop),
        "passes": (masses.shaft_mass - free.restitution * masses.house_mass) / (masses.shaft_mass + masses.house_mass),
        "half_sine_ms": half_sine_ms,
        "ratio": half_sine_ms / (free.duration * 1e3),
        "soft": {
            "stiffness": stiffness,
            "times": contact.stiffness / stiffness,
            "depth_mm": compute_impact(masses.shaft_mass, stiffness=stiffness).depth * 1e3,
        },
        "clearance_mm": contact.clearance * 1e3,
        "height_um": 1e6 * 2.0 * contact.clearance * (slow / speed) ** 2,
        "weight": ring_weight(model.constants),
        "house_n": 100.0 * model.constants.house.inner_mass,
        "house_g_n": 100.0 * G * model.constants.house.inner_mass,
    }


def restitution(run: Run) -> float:
    """Return the coefficient of restitution of the drop's first contact on a fixed ring, by closed form."""
    model = run.simulation.model
    contact = model.constants.contact
    return impact(
        mass=reference_impact(model.parameters).shaft_mass, speed=compute_fall(model.constants)[1],
        stiffness=contact.stiffness, exponent=contact.exponent, factor=contact.damping_factor,
        speed_floor=contact.speed_floor,
    ).restitution  # fmt: skip


def _drop_run(one: Reproduction) -> Numbers:
    run = one.drop
    time_s, speed = drop_impact(run)
    return {
        "fall_ms": time_s * 1e3,
        "speed": speed,
        "impulse": drop_impulse(run),
        "force": run["normal_force"].max(),
        "reaction": one.numbers["drop_reaction"],
        "mean_force": run["contact_impulse"][-1] / run.times_s[-1],
    }


def _amplification(run: Run) -> Numbers:
    """Return the largest reaction relative to its own contact force and to that of a rigid housing."""
    reaction = float((run["P_S"] - run["P_N"]).max())
    rigid = bare_drop({"model.stator": "rigid"})
    return {
        "contact": reaction / float(run["normal_force"].max()),
        "rigid": reaction / float(rigid["normal_force"].max()),
    }


def _find_printed_peak(peak: Callable[[float], float], low: float, high: float) -> float:
    """Return the argument at which an increasing peak [N] equals the printed one, by a logarithmic search."""
    from scipy.optimize import brentq

    root: Any = brentq(
        lambda logarithm: math.log(peak(math.exp(logarithm)) / PAPER_DROP_N), math.log(low), math.log(high), xtol=1e-6
    )
    return math.exp(float(root))


class Reading(NamedTuple):
    """A variant of the housings' masses and springs."""

    value: float
    mode_hz: float
    """Highest vertical natural frequency [Hz]."""
    forces: tuple[int, ...]
    """E - W and N - S in whirl, then the largest value of each [N]."""


def house_numbers(results: Results) -> dict[str, Numbers]:
    """Compare variants: 8.88 kg as the outer housing or both housings (`mass`); K_ft / 2 or 2 K_ft (`pair`)."""
    p = load_parameters("corrected")

    def reading(group: str, value: float, *, mass: float, link: float) -> Reading:
        mode = stiffest_mode(
            inner=p["house.inner_mass"], outer=mass, link=link, support=p["house.outer_beam_stiffness"]
        )
        keys = ("reaction_x_n", "reaction_y_n", "peak_x_n", "peak_y_n")
        return Reading(value, mode.frequency_hz, tuple(round(median(results[group], key)) for key in keys))

    def differences(readings: list[Reading]) -> Numbers:
        whirl, highest = ([each.forces[place] for each in readings] for place in (0, 2))
        return {
            "readings": readings,
            "whirl_spread": max(whirl) / min(whirl) - 1.0,
            "highest_spread": max(highest) / min(highest) - 1.0,
        }

    link, outer = p["house.pair_stiffness_vertical"], p["house.outer_mass"]
    masses = [reading(f"mass {mass:g}", mass, mass=mass, link=link) for mass in OUTER_MASSES_KG]
    pairs = [reading(f"pair {factor:g}", factor, mass=outer, link=factor * K_FT) for factor in PAIR_STIFFNESS]
    zeta, damping = 0.054, p["house.outer_beam_damping"]
    implied = (damping / (2.0 * zeta)) ** 2 / p["house.outer_beam_stiffness"]
    return {
        "mass": {"zeta": zeta, "damping": damping, "implied_kg": implied, **differences(masses)},
        "pair": differences(pairs),
    }


def magnet_numbers() -> Numbers:
    """Return stiffnesses for possible numbers and lengths of the magnets."""
    base = load_parameters("corrected")
    used = base["magnet.stiffness"] / 1e3
    most = int(math.pi / math.asin(base["magnet.bearing_magnet_radius"] / base["magnet.bearing_radius"]))
    values: dict[tuple[int, float], tuple[float, float]] = {}
    for count in (8, most):
        for length in _LENGTHS_MM:
            geometry = magnet_geometry(base.override({"magnet.count": float(count), "magnet.length": length}))
            values[count, length] = field_sum_stiffness(geometry) / 1e3, cylinder_stiffness(geometry) / 1e3
    best = values[8, 16.9][1]
    return {
        "tried": values,
        "used_kn_m": used,
        "best_kn_m": best,
        "enough": next((magnets for magnets, (_, exact) in values.items() if round(exact, 2) >= used), None),
    }


def running_numbers() -> Numbers:
    """Return w_n [Hz] and the smallest gap [mm] by stiffness [kN/m], to find those without contact."""
    values = {}
    for stiffness in STIFFNESSES_KN_M:
        changes = {"duration_s": 3.0, "magnet.stiffness": stiffness, "sensors.chain": "ideal", "sensors.rate_hz": 2000}
        run = simulate(load_scene("stable-run", {**changes, "sensors.groups": ["hammer"]}))
        natural_hz = oscillator(run.simulation.model.constants).natural / (2.0 * math.pi)
        values[stiffness] = natural_hz, -1e3 * float(run["penetration"].max())
    return {"tried": values, "free": [stiffness for stiffness, (_, gap_mm) in values.items() if gap_mm > 0.0]}


class PaperAxis(NamedTuple):
    """An axis of the paper and the clearances that it allows."""

    name: str
    ours: float
    low: float
    high: float
    allowed_mm: tuple[float, float]
    """Clearances at which the curve fills the axis and stays inside [mm]."""


def clearance_numbers(by_set: dict[str, Reproduction]) -> Numbers:
    """Return the clearances allowed by each axis of the paper."""
    one = by_set["corrected"]
    constants, n = one.whirl.simulation.model.constants, one.numbers
    r0 = constants.contact.clearance * 1e3
    lever = constants.shaft.arm_disk / constants.shaft.arm_ring

    stated = {each.quantity: (each.low, each.high) for each in statements()}

    def make_axis(name: str, ours: float, quantity: str) -> PaperAxis:
        # At equal spin and R_S / r0, lengths and forces of the whirl are proportional to r0.
        low, high = stated[quantity]
        return PaperAxis(name, ours, low, high, (r0 * low / ours, r0 * high / ours))

    orbit = make_axis("orbit ±1 mm, in the ring, Fig. 12(a)", n["orbit_ring"], "orbit_ring")
    drop = make_axis("drop ±1 mm, in the ring, Fig. 10", r0, "drop_span")
    probes = make_axis("drop ±1 mm, at the probes, Fig. 10", r0 * lever, "drop_span")
    disk = make_axis("x(t) ±2 mm at the probes, Fig. 12(c)", n["orbit_disk"], "orbit_disk")
    measured = make_axis("E − W ±500 N, measured, Fig. 15(c)", n["sensed_x"], "peak_sensed")
    east = make_axis("EAST 0 to 900 N, Fig. 16", n["east"], "east")

    radius = next(entry for entry in free_values() if entry.key == "shaft.radius")

    def intersect(*axes: PaperAxis) -> tuple[float, float]:
        ends = [[round(end, 2) for end in each.allowed_mm] for each in axes]
        return max(low for low, _ in ends), min(high for _, high in ends)

    return {
        "r0_mm": r0,
        "spread_mm": [radius.at(part) / _PRINTED_RATIO for part in (0.0, 1.0)],
        "ratio": _PRINTED_RATIO,
        "axes": (orbit, drop, probes, disk, measured, east),
        "simulated": intersect(orbit, drop, disk, east),
        "at_probes": intersect(orbit, probes, disk, east),
    }
