"""What the paper leaves open, each with the numbers that there are on it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from replays.studies.paper.blow import Blow
from replays.studies.paper.claim import Groups, Results, median
from replays.studies.paper.condition import oscillator
from replays.studies.paper.reproduction import Reproduction, drop_impact, drop_impulse
from replays.studies.paper.spread import phases
from replays.studies.paper.statement import number
from replays.studies.stability.closed_forms import Impact, impact, stiffest_mode
from rig.kernels.constants import Constants
from rig.magnets import cylinder_stiffness, field_sum_stiffness
from rig.model import magnet_geometry, reference_impact
from rig.offline import simulate
from rig.parameters import load_parameters
from rig.scenes import load_scene

PAPER_DROP_N = 100.0
OUTER_MASSES_KG = (7.18, 8.88, 10.58)
PAIR_STIFFNESS = (0.5, 1.0, 2.0)
"""Of one transducer's K_ft."""
K_FT = 8.88e7
STIFFNESSES_KN_M = (0.74, 1.0, 1.3, 1.7, 2.5)
_LENGTHS_MM = (10.0, 16.9, 25.0, 35.0, 50.0)


@dataclass(frozen=True)
class Question:
    """What there is on one open question; the report's template says what it means.

    Attributes:
        headings: Of the table.
        rows: What is known, with its number.
        numbers: What the answer is made of.
    """

    headings: tuple[str, ...]
    rows: list[tuple[str, ...]]
    numbers: dict[str, Any]


def question_groups(*, ensemble: int) -> Groups:
    """Blows for the questions on the houses."""
    groups: Groups = {}
    for mass in OUTER_MASSES_KG:
        blow = Blow(label=f"M_oh {mass:g} kg", changes={"house.outer_mass": mass})
        groups[f"mass {mass:g}"] = phases(blow, ensemble)
    for factor in PAIR_STIFFNESS:
        keys = ("house.pair_stiffness_vertical", "house.pair_stiffness_horizontal")
        blow = Blow(label=f"k_T {factor:g} K_ft", changes=dict.fromkeys(keys, factor * K_FT))
        groups[f"pair {factor:g}"] = phases(blow, ensemble)
    return groups


def fall(constants: Constants) -> tuple[float, float]:
    """Time [s] and speed at the ring [m/s] of a fall through the whole clearance, from rest, small angles.

    About the pivot I_xx Gamma'' = M g l_0C: the ring's height falls by a = M g l_0C l_0A / I_xx.
    """
    shaft = constants.shaft
    a = shaft.mass * shaft.gravity * shaft.arm_centre * shaft.arm_ring / shaft.transverse_inertia
    height = 2.0 * constants.contact.clearance
    return math.sqrt(2.0 * height / a), math.sqrt(2.0 * a * height)


def weight_at_ring(constants: Constants) -> float:
    """What the shaft weighs on the ring [N]: all that a drop pushes with, on the mean from release to rest."""
    shaft = constants.shaft
    return shaft.mass * shaft.gravity * shaft.arm_centre / shaft.arm_ring


def _impact(constants: Constants, *, mass: float, speed: float, stiffness: float | None = None) -> Impact:
    contact = constants.contact
    return impact(
        mass=mass,
        speed=speed,
        stiffness=stiffness or contact.stiffness,
        exponent=contact.exponent,
        factor=contact.damping_factor,
        floor=contact.speed_floor,
    )


def drop_question(found: dict[str, Reproduction]) -> Question:
    """The drop's 100 N against the momentum that must be turned round."""
    from scipy.optimize import brentq

    one = found["corrected"]
    constants = one.drop.simulation.model.constants
    masses = reference_impact(one.drop.simulation.model.parameters)
    time_s, speed = fall(constants)
    fixed = _impact(constants, mass=masses.shaft_mass, speed=speed)
    free = _impact(constants, mass=masses.mass, speed=speed)

    def excess(logarithm: float) -> float:
        soft = _impact(constants, mass=masses.shaft_mass, speed=speed, stiffness=math.exp(logarithm))
        return math.log(soft.peak / PAPER_DROP_N)

    root: Any = brentq(excess, math.log(1e4), math.log(1e12), xtol=1e-6)
    soft = _impact(constants, mass=masses.shaft_mass, speed=speed, stiffness=math.exp(float(root)))

    def slow_excess(logarithm: float) -> float:
        return math.log(_impact(constants, mass=masses.mass, speed=math.exp(logarithm)).peak / PAPER_DROP_N)

    slow: Any = brentq(slow_excess, math.log(2e-3), math.log(1.0), xtol=1e-6)
    slow_speed = math.exp(float(slow))
    height_um = 1e6 * 2.0 * constants.contact.clearance * (slow_speed / speed) ** 2
    half_sine_ms = 1e3 * math.pi / 2.0 * free.impulse / PAPER_DROP_N
    rows = [
        ("fall through 2 r0, closed form", f"{time_s * 1e3:.2f} ms, {speed:.4f} m/s"),
        *(
            (f"the same, {name}", f"{drop_impact(each.drop)[0] * 1e3:.2f} ms, {drop_impact(each.drop)[1]:.4f} m/s")
            for name, each in found.items()
        ),
        ("impulse, house free, closed form", f"{free.impulse:.3f} N s in {free.duration * 1e3:.2f} ms, peak "
        f"{free.peak:.0f} N"),
        ("impulse, house fixed, closed form", f"{fixed.impulse:.3f} N s in {fixed.duration * 1e3:.2f} ms, peak "
        f"{fixed.peak:.0f} N"),
        *(
            (f"impulse of the first contact, {name}", f"{drop_impulse(each.drop):.3f} N s, largest normal force "
             f"{each.drop['normal_force'].max():.0f} N, reaction {each.numbers['drop_reaction']:.0f} N")
            for name, each in found.items()
        ),
        ("time that a half-sine of 100 N needs for the smaller impulse", f"{half_sine_ms:.1f} ms"),
        ("K at which Hertz's peak would be 100 N", f"{math.exp(float(root)):.2e} N/m^1.5, "
        f"{constants.contact.stiffness / math.exp(float(root)):.0f} "
         f"times softer; it would sink in by {soft.depth * 1e3:.2f} mm of r0 = "
         f"{constants.contact.clearance * 1e3:.3f} mm (assumed)"),
        ("fall at which our K would give 100 N", f"{height_um:.0f} um instead of "
        f"{2e6 * constants.contact.clearance:.0f} um"),
        ("mean force from release to rest: the weight at the ring, closed form", f"{weight_at_ring(constants):.2f} N"),
        *(
            (f"the same, {name}", f"{each.drop['contact_impulse'][-1] / each.drop.times_s[-1]:.2f} N")
            for name, each in found.items()
        ),
        ("100 m/s^2 (Fig. 10(d), unit assumed) of the inner house",
         f"{PAPER_DROP_N * constants.house.inner_mass:.0f} N"),
    ]  # fmt: skip
    contact_ms = free.duration * 1e3
    numbers = {"half_sine_ms": half_sine_ms, "contact_ms": contact_ms, "ratio": half_sine_ms / contact_ms}
    return Question(("quantity", "value"), rows, numbers)


def _house_row(name: str, results: Results, group: str, *, mass: float, link: float) -> tuple[str, ...]:
    house = load_parameters("corrected")
    vertical = stiffest_mode(
        inner=house["house.inner_mass"], outer=mass, link=link, support=house["house.outer_beam_stiffness"]
    )
    values = (median(results[group], key) for key in ("reaction_x_n", "reaction_y_n", "peak_x_n", "peak_y_n"))
    return (name, f"{vertical.frequency_hz:.0f}", *(f"{value:.0f}" for value in values))


_HOUSE_HEADINGS = (
    "reading", "stiffest vertical mode [Hz]", "E - W in whirl [N]", "N - S in whirl [N]", "highest E - W [N]",
    "highest N - S [N]",
)  # fmt: skip


def _spreads(rows: list[tuple[str, ...]]) -> dict[str, float]:
    """By how much the readings differ in the force in whirl, E - W, and in its highest value."""
    columns = {"whirl_spread": 2, "highest_spread": 4}
    values = {name: [float(row[place]) for row in rows] for name, place in columns.items()}
    return {name: max(each) / min(each) - 1.0 for name, each in values.items()}


def mass_question(results: Results) -> Question:
    """Is 8.88 kg the outer house alone or both houses?"""
    p = load_parameters("corrected")
    link = p["house.pair_stiffness_vertical"]
    rows = [
        _house_row(f"M_oh = {mass:g} kg", results, f"mass {mass:g}", mass=mass, link=link) for mass in OUTER_MASSES_KG
    ]
    zeta, stiffness, damping = 0.054, p["house.outer_beam_stiffness"], p["house.outer_beam_damping"]
    implied = (damping / (2.0 * zeta)) ** 2 / stiffness
    numbers = {"damping": damping, "zeta": zeta, "implied_kg": implied, **_spreads(rows)}
    return Question(_HOUSE_HEADINGS, rows, numbers)


def pair_question(results: Results) -> Question:
    """K_ft / 2 or 2 K_ft?"""
    mass = load_parameters("corrected")["house.outer_mass"]
    rows = [
        _house_row(f"{factor:g} K_ft", results, f"pair {factor:g}", mass=mass, link=factor * K_FT)
        for factor in PAIR_STIFFNESS
    ]
    return Question(_HOUSE_HEADINGS, rows, _spreads(rows))


def magnet_question() -> Question:
    """Can the magnets give the stiffness?"""
    base = load_parameters("corrected")
    used = base["magnet.stiffness"]
    rows, best = [], 0.0
    most = int(math.pi / math.asin(base["magnet.bearing_magnet_radius"] / base["magnet.bearing_radius"]))
    for count in (8, most):
        for length in _LENGTHS_MM:
            geometry = magnet_geometry(base.override({"magnet.count": float(count), "magnet.length": length}))
            exact = cylinder_stiffness(geometry)
            if (count, length) == (8, 16.9):
                best = exact
            rows.append(
                (f"{count} magnets of {length:g} mm", f"{field_sum_stiffness(geometry) / 1e3:.2f}",
                 f"{exact / 1e3:.2f}",
                 f"{exact / used:.0%}")
            )  # fmt: skip
    enough = [row[0] for row in rows if float(row[2]) * 1e3 >= used]
    numbers = {
        "used_kn_m": used / 1e3,
        "best_kn_m": best / 1e3,
        "share": best / used,
        "enough": enough[0] if enough else "",
    }
    headings = ("magnets (number and length assumed)", "K by eq. 35 [kN/m]", "K of exact cylinders [kN/m]", "of K_mag")
    return Question(headings, rows, numbers)


def running_question() -> Question:
    """Which stiffness does running free of contact ask for?"""
    rows, free = [], []
    for stiffness in STIFFNESSES_KN_M:
        changes = {"duration_s": 3.0, "magnet.stiffness": stiffness, "sensors.chain": "ideal", "sensors.rate_hz": 2000}
        run = simulate(load_scene("stable-run", {**changes, "sensors.groups": ["hammer"]}))
        gap_mm = -1e3 * float(run["penetration"].max())
        if gap_mm > 0.0:
            free.append(stiffness)
        natural_hz = oscillator(run.simulation.model.constants).natural / (2.0 * math.pi)
        rows.append((f"{stiffness:g}", f"{natural_hz:.2f}", number(gap_mm), "no" if gap_mm > 0.0 else "yes"))
    headings = ("K_mag [kN/m]", "w_n, linear [Hz]", "least gap in 3 s from rest [mm]", "touches")
    return Question(headings, rows, {"free": free, "tried": len(STIFFNESSES_KN_M)})


def clearance_question(found: dict[str, Reproduction]) -> Question:
    """Which clearance does each axis of the paper allow?"""
    one = found["corrected"]
    constants = one.whirl.simulation.model.constants
    r0 = constants.contact.clearance * 1e3
    lever = constants.shaft.arm_disk / constants.shaft.arm_ring

    def scaled(name: str, ours: float, low: float, high: float) -> tuple[str, ...]:
        # Lengths and forces of the whirl go with r0 at equal spin and R_S / r0.
        ends = [r0 * level / ours for level in (low, high)]
        allowed = [
            " to ".join(f"{factor * end:.{places}f}" for end in ends) for factor, places in ((1.0, 2), (13.5, 1))
        ]
        return (name, number(ours), f"{low:g} to {high:g}", *allowed, "yes" if ends[0] <= r0 <= ends[1] else "no")

    n = one.numbers
    rows = [
        scaled("orbit +-1 mm, in the ring, Fig. 12(a)", n["orbit_ring"], 0.4, 1.0),
        scaled("drop +-1 mm, in the ring, Fig. 10", r0, 0.4, 1.0),
        scaled("the same, at the probes", r0 * lever, 0.4, 1.0),
        scaled("x(t) +-2 mm at the probes, Fig. 12(c)", n["orbit_disk"], 0.8, 2.0),
        scaled("E - W +-500 N, measured, Fig. 15(c)", n["sensed_x"], 200.0, 500.0),
        scaled("EAST 0 to 900 N, Fig. 16", n["east"], 360.0, 900.0),
    ]

    def together(*left_out: str) -> tuple[float, float]:
        ends = [row[3].split(" to ") for row in rows if not any(text in row[0] for text in left_out)]
        return max(float(low) for low, _ in ends), min(float(high) for _, high in ends)

    numbers = {"r0_mm": r0, "simulated": together("the same", "measured"), "with_measured": together("the same")}
    headings = ("axis", "ours", "the axis", "r0 allowed [mm]", "R_S allowed [mm]", "ours inside")
    return Question(headings, rows, numbers)


def all_questions(found: dict[str, Reproduction], results: Results) -> dict[str, Question]:
    """All open questions by the name that the report's template has for them.

    Args:
        found: The paper's runs by parameter set.
        results: Outcomes of the scans by group.
    """
    return {
        "drop": drop_question(found),
        "mass": mass_question(results),
        "pair": pair_question(results),
        "magnet": magnet_question(),
        "running": running_question(),
        "clearance": clearance_question(found),
    }
