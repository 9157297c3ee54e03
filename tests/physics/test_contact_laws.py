"""The normal contact laws against things that are not their own code.

| the rig's                            | must agree with                             | because                       |
|--------------------------------------|---------------------------------------------|-------------------------------|
| restitution each damping law returns | two bodies in absolute coordinates          | Newton's law; definition of e |
| the same, at other masses and K, n   | itself                                      | v0 makes the law scale-free   |
| exact rule                           | Gonthier et al.'s implicit equation         | the same integral, by others  |
| c near e = 1                         | 3/2 (1-e), where a law is right there       | energy lost to first order    |
| Kelvin-Voigt's damping ratio         | Schwager & Poeschel's arctan form           | oscillator that may not pull  |
| time and depth of an elastic impact  | closed forms, Hertz and linear              | beta function; half a period  |
| sphere stiffness                     | Hertz by way of the contact radius          | elastostatics                 |
| Johnson's cylinder law               | sum of two bodies' compressions             | Johnson's own, other form     |
| Palmgren's law                       | 3.84e-5 F^0.9 / L^0.8 mm for steel          | published number              |
| Pereira et al.'s law                 | Johnson's, to 12 %; no step in its exponent | they fitted it to that        |
| logarithmic laws, d(delta/P)/d ln P  | -1/(pi E*)                                  | plane elasticity's line load  |
| fit                                  | the law, on points it was not fitted to     | it claims its largest error   |
| kernel's force                       | the formula                                 | it is what the engines run    |
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from rig import InputError, load_parameters
from rig.physics.contacts import (
    DAMPING,
    KELVIN_VOIGT,
    LAW,
    STIFFNESS,
    WORKING_FORCES,
    ContactPair,
    NormalLaw,
    ReferenceImpact,
    fit_power,
    free_impact,
    linear_damping_ratio,
    match_depth,
    resolve_law,
    restitution_factor,
    returned_restitution,
)
from rig.physics.kernels.laws.contact import normal_force
from rig.physics.model import build_model, contact_pair, normal_law, reference_impact

DEFAULT = load_parameters()
PAIR = contact_pair(DEFAULT)
IMPACT = reference_impact(DEFAULT)
LINE_LAWS = ["johnson-cylinder", "esdu-cylinder", "dubowsky-freudenstein-cylinder"]


def chosen(damping: float | str, restitution: float, *, stiffness: float | str = "internal-sphere") -> NormalLaw:
    return resolve_law(
        stiffness=stiffness, exponent=LAW, damping=damping, viscous=LAW,
        restitution=restitution, pair=PAIR, impact=IMPACT,
    ).law  # fmt: skip


def two_bodies(law: NormalLaw, masses: tuple[float, float], speed: float) -> float:
    """Return the restitution of two colliding bodies, integrated in absolute coordinates until well after separation
    [1].
    """
    from scipy.integrate import solve_ivp

    def motion(_: float, y: np.ndarray) -> list[float]:
        x1, x2, v1, v2 = y
        depth, rate = x1 - x2, v1 - v2
        force = 0.0
        if depth > 0.0:
            elastic = law.stiffness * depth**law.exponent
            force = max(0.0, elastic * (1.0 + law.damping_factor * rate / speed) + law.viscous_damping * rate)
        return [v1, v2, -force / masses[0], force / masses[1]]

    start = [-1e-9, 0.0, speed, 0.0]
    # Ten elastic contacts: strongly damped bodies separate slowly.
    mass = masses[0] * masses[1] / sum(masses)
    long = 40.0 * (mass * speed**2 / law.stiffness) ** (1.0 / (law.exponent + 1.0)) / speed
    end = solve_ivp(motion, (0.0, long), start, method="LSODA", rtol=1e-9, atol=1e-13, max_step=long / 400).y[:, -1]
    assert end[0] < end[1], "they must have come apart"
    return float(end[3] - end[2]) / speed


@pytest.mark.parametrize("restitution", [0.05, 0.3, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("name", DAMPING)
def test_returned_restitution_agrees_with_two_free_bodies(name: str, restitution: float) -> None:
    law = chosen(name, restitution)
    collided = two_bodies(law, (IMPACT.shaft_mass, IMPACT.house_mass), IMPACT.speed)
    assert free_impact(law, mass=IMPACT.mass, speed=IMPACT.speed).restitution == pytest.approx(collided, abs=2e-5)
    if name == KELVIN_VOIGT:
        assert collided == pytest.approx(restitution, abs=2e-5)
    else:
        assert returned_restitution(law.damping_factor) == pytest.approx(collided, abs=2e-5)
    if name == "exact":
        assert collided == pytest.approx(restitution, abs=2e-5)


@pytest.mark.parametrize("stiffness", STIFFNESS)
def test_memory_of_v0_returns_the_same_for_any_mass_speed_and_exponent(stiffness: str) -> None:
    law = chosen("flores", 0.6, stiffness=stiffness)
    assert two_bodies(law, (0.3, 7.0), 0.02) == pytest.approx(returned_restitution(law.damping_factor), abs=2e-5)


def test_lankarani_nikravesh_returns_its_published_restitution() -> None:
    assert returned_restitution(chosen("lankarani-nikravesh", 0.9).damping_factor) == pytest.approx(0.913, abs=5e-4)
    assert returned_restitution(chosen("lankarani-nikravesh", 0.5).damping_factor) == pytest.approx(0.725, abs=5e-4)


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("none", 0.0), ("hunt-crossley", 0.75), ("herbert-mcwhannell", 1.0), ("lee-wang", 0.375),
        ("lankarani-nikravesh", 0.5625), ("gonthier", 1.5), ("zhiying-qishao", 0.5625 * math.e), ("flores", 1.6),
        ("hu-guo", 1.5), ("exact", 1.4328),
    ],
)  # fmt: skip
def test_factors_at_half_worked_out_by_hand(name: str, factor: float) -> None:
    assert chosen(name, 0.5).damping_factor == pytest.approx(factor, abs=5e-5)


def test_accuracy_of_the_laws_near_elastic_impacts() -> None:
    # Losses to first order: 1 - e = 2 c / 3 for any exponent.
    slope = {name: chosen(name, 1.0 - 1e-6).damping_factor / 1e-6 for name in DAMPING}
    right = {name for name, value in slope.items() if value == pytest.approx(1.5, rel=1e-4)}
    assert right == {
        "exact", "hunt-crossley", "herbert-mcwhannell", "lankarani-nikravesh", "zhiying-qishao", "hu-guo",
    }  # fmt: skip
    assert slope["lee-wang"] == pytest.approx(0.75, rel=1e-4)
    assert slope["flores"] == pytest.approx(1.6, rel=1e-4)
    assert slope["gonthier"] == pytest.approx(2.0, rel=1e-4)


@pytest.mark.parametrize("restitution", [0.1, 0.5, 0.9])
def test_exact_rule_solves_the_implicit_equation_of_gonthier(restitution: float) -> None:
    e = restitution
    d = restitution_factor(e) * e
    assert (1 + d / e) / (1 - d) == pytest.approx(math.exp(d * (1 + 1 / e)), rel=1e-9)


def test_factor_and_returned_restitution_are_inverse() -> None:
    wanted = np.linspace(0.05, 1.0, 96)
    returned = [returned_restitution(restitution_factor(float(e))) for e in wanted]
    np.testing.assert_allclose(returned, wanted, atol=1e-9)
    assert returned_restitution(100.0) == pytest.approx(0.01, rel=1e-12)
    # A series replaces the equation where cancellation would spoil it: no step there.
    for low, high in ((0.9999e-4, 1.0001e-4), (1e-9, 1.0002e-9)):
        steps = (
            returned_restitution(low) - returned_restitution(high),
            restitution_factor(1 - high) - restitution_factor(1 - low),
        )
        assert steps == pytest.approx((2 / 3 * (high - low), 1.5 * (high - low)), rel=0.01)


@pytest.mark.parametrize("restitution", [0.0, 0.039, 1.01])
def test_restitution_out_of_reach_is_refused(restitution: float) -> None:
    with pytest.raises(InputError, match=r"contact\.restitution must be"):
        restitution_factor(restitution)


@pytest.mark.parametrize("ratio", [0.01, 0.1, 0.5, 0.7])
def test_damping_ratio_against_the_printed_form(ratio: float) -> None:
    # Schwager & Poeschel, beta < omega_0 / sqrt(2), in units of omega_0.
    beta, omega = ratio, math.sqrt(1.0 - ratio**2)
    printed = math.exp(-beta / omega * (math.pi - math.atan(2 * beta * omega / (omega**2 - beta**2))))
    assert linear_damping_ratio(printed) == pytest.approx(ratio, rel=1e-9)


def test_damping_ratio_is_critical_at_the_known_restitution() -> None:
    assert linear_damping_ratio(math.exp(-2.0)) == pytest.approx(1.0, abs=1e-9)
    assert linear_damping_ratio(math.exp(-2.0) * 1.001) < 1.0 < linear_damping_ratio(math.exp(-2.0) * 0.999)
    assert linear_damping_ratio(1.0) == 0.0


def test_elastic_impacts_in_closed_form() -> None:
    mass, speed = IMPACT.mass, IMPACT.speed
    hertz = chosen("none", 0.9)
    done = free_impact(hertz, mass=mass, speed=speed)
    depth = (5.0 * mass * speed**2 / (4.0 * hertz.stiffness)) ** 0.4
    time = 0.8 * math.sqrt(math.pi) * math.gamma(0.4) / math.gamma(0.9) * depth / speed
    assert done.depth == pytest.approx(depth, rel=1e-7)
    assert done.peak_force == pytest.approx(hertz.stiffness * depth**1.5, rel=1e-7)
    assert done.duration == pytest.approx(time, rel=1e-7)
    assert time == pytest.approx(2.943 * depth / speed, rel=1e-3)
    spring = free_impact(NormalLaw(5e7, 1.0, 0.0, 0.0), mass=mass, speed=speed)
    assert spring.duration == pytest.approx(math.pi * math.sqrt(mass / 5e7), rel=1e-7)
    assert spring.peak_force == pytest.approx(speed * math.sqrt(mass * 5e7), rel=1e-7)


def test_floor_of_v0_makes_slow_impacts_more_elastic() -> None:
    law = chosen("exact", 0.5)
    slow = free_impact(law, mass=IMPACT.mass, speed=2e-4, speed_floor=1e-3)
    assert slow.restitution == pytest.approx(returned_restitution(0.2 * law.damping_factor), abs=1e-6)
    assert slow.restitution > 0.8


def test_kelvin_voigt_has_the_depth_of_the_law_it_replaces() -> None:
    for name in STIFFNESS:
        linear, own = chosen(KELVIN_VOIGT, 0.9, stiffness=name), chosen("none", 0.9, stiffness=name)
        assert linear.exponent == 1.0
        assert linear.damping_factor == 0.0
        depths = [
            free_impact(law._replace(viscous_damping=0.0), mass=IMPACT.mass, speed=IMPACT.speed).depth
            for law in (linear, own)
        ]
        assert depths[0] == pytest.approx(depths[1], rel=1e-6)


def test_sphere_stiffness_by_way_of_the_contact_radius() -> None:
    for name, sign in (("internal-sphere", -1.0), ("external-sphere", 1.0)):
        curvature = 1.0 / 12.5e-3 + sign / 13.426e-3
        modulus = 1.0 / ((1 - 0.33**2) / 70e9 + (1 - 0.33**2) / 125e9)
        for depth in (1e-6, 1e-5):
            radius = math.sqrt(depth / curvature)  # delta = a^2 / R
            force = 4.0 * modulus * radius**3 * curvature / 3.0  # a^3 = 3 F R / (4 E*)
            assert STIFFNESS[name].force(depth, PAIR) == pytest.approx(force, rel=1e-9)
    assert fit_power("internal-sphere", PAIR).stiffness == pytest.approx(2.86e10, rel=2e-3)
    assert fit_power("external-sphere", PAIR).stiffness == pytest.approx(5.40e9, rel=2e-3)


@pytest.mark.parametrize("force", [5.0, 200.0, 3000.0])
def test_johnson_is_the_sum_of_both_bodies_compressions(force: float) -> None:
    line = force / PAIR.width
    reduced = PAIR.shaft_radius * PAIR.ring_radius / PAIR.clearance
    half_width = math.sqrt(4.0 * line * reduced / (math.pi * PAIR.modulus))
    # Equal materials: each body has half the compliance 1 / E*.
    each = [
        line / (2.0 * math.pi * PAIR.modulus) * (2.0 * math.log(4.0 * radius / half_width) - 1.0)
        for radius in (PAIR.shaft_radius, PAIR.ring_radius)
    ]
    assert STIFFNESS["johnson-cylinder"].depth(force, PAIR) == pytest.approx(sum(each), rel=1e-12)
    assert half_width < 0.1 * PAIR.shaft_radius, "what the half-space takes for granted"


@pytest.mark.parametrize("name", LINE_LAWS)
def test_logarithmic_laws_have_the_slope_of_a_line_load(name: str) -> None:
    low, high = (STIFFNESS[name].depth(force, PAIR) / (force / PAIR.width) for force in WORKING_FORCES)
    slope = (high - low) / math.log(WORKING_FORCES[1] / WORKING_FORCES[0])
    assert slope == pytest.approx(-1.0 / (math.pi * PAIR.modulus), rel=1e-9)


def test_palmgren_for_steel_is_the_published_number() -> None:
    steel = ContactPair(shaft_radius=5e-3, clearance=1e-3, width=10e-3, modulus=206e9 / 2 / (1 - 0.3**2))
    depth = STIFFNESS["palmgren-cylinder"].depth(1000.0, steel)
    assert depth * 1e3 == pytest.approx(3.84e-5 * 1000.0**0.9 / 10.0**0.8, rel=5e-3)


def test_pereira_approximates_johnson() -> None:
    depths = np.geomspace(0.5e-6, 12e-6, 12)
    for clearance in (0.3e-3, 0.926e-3, 2e-3):
        pair = PAIR._replace(clearance=clearance)
        ratio = [
            STIFFNESS["pereira-cylinder"].force(d, pair) / STIFFNESS["johnson-cylinder"].force(d, pair) for d in depths
        ]
        np.testing.assert_allclose(ratio, 1.0, atol=0.12)
    below, above = (
        fit_power("pereira-cylinder", PAIR._replace(clearance=r0)).exponent for r0 in (0.34953e-3, 0.34955e-3)
    )
    assert below == pytest.approx(above, abs=1e-4)


def test_liu_is_a_power_of_three_halves_in_a_wide_ring() -> None:
    wide = PAIR._replace(clearance=0.02)
    fit = fit_power("liu-cylinder", wide)
    assert fit.exponent == pytest.approx(1.5, abs=1e-3)
    # F = pi/2 E* L delta^1.5 / sqrt(2 r0) for delta << r0.
    plain = 0.5 * math.pi * PAIR.modulus * PAIR.width * 1e-6**1.5 / math.sqrt(2 * 0.02)
    assert STIFFNESS["liu-cylinder"].force(1e-6, wide) == pytest.approx(plain, rel=1e-4)


@pytest.mark.parametrize("name", STIFFNESS)
def test_fit_has_the_reported_error(name: str) -> None:
    fit, law = fit_power(name, PAIR), STIFFNESS[name]
    depths = np.geomspace(fit.low, fit.high, 777)
    ratio = fit.stiffness * depths**fit.exponent / np.array([law.force(float(depth), PAIR) for depth in depths])
    off = max(ratio.max() - 1.0, 1.0 / ratio.min() - 1.0)
    assert off == pytest.approx(fit.error, abs=2e-5)
    assert fit.error < 0.04
    assert [law.force(depth, PAIR) for depth in (fit.low, fit.high)] == pytest.approx(list(WORKING_FORCES), rel=1e-9)
    if fit.error:
        # No straight line in the logarithms is better: the error is equal in both directions, three times.
        assert ratio.max() == pytest.approx(1.0 / ratio.min(), rel=1e-4)
        assert ratio[0] == pytest.approx(ratio[-1], rel=1e-6)


@pytest.mark.parametrize("name", DAMPING)
def test_kernel_runs_the_formula(name: str) -> None:
    contact = build_model(DEFAULT.override({"contact.damping_factor": name})).constants.contact
    law = chosen(name, 0.9)
    assert (contact.stiffness, contact.exponent, contact.damping_factor, contact.viscous_damping) == law
    rng = np.random.default_rng(5)
    for depth, rate in zip(rng.uniform(-1e-5, 3e-5, 50), rng.uniform(-0.3, 0.3, 50), strict=True):
        force, elastic = normal_force(depth, rate, 0.145, contact)
        plain = law.stiffness * max(depth, 0.0) ** law.exponent
        whole = plain * (1 + law.damping_factor * rate / 0.145) + law.viscous_damping * rate * (depth > 0)
        assert elastic == pytest.approx(plain, rel=1e-12)
        assert force == pytest.approx(max(0.0, whole), rel=1e-12)


@pytest.mark.parametrize("name", STIFFNESS)
def test_model_takes_every_stiffness_law(name: str) -> None:
    parameters = DEFAULT.override({"contact.stiffness": name})
    contact = build_model(parameters).constants.contact
    fit = fit_power(name, PAIR)
    assert (contact.stiffness, contact.exponent) == (fit.stiffness, fit.exponent)
    assert normal_law(parameters).fit_error == fit.error


def test_wider_ring_is_stiffer_for_cylinders_only() -> None:
    wide = PAIR._replace(width=2 * PAIR.width)
    for name in STIFFNESS:
        ratio = STIFFNESS[name].force(5e-6, wide) / STIFFNESS[name].force(5e-6, PAIR)
        if name.endswith("sphere"):
            assert ratio == 1.0
        elif name in ("pereira-cylinder", "liu-cylinder", "johnson-cylinder", "esdu-cylinder"):
            assert ratio == pytest.approx(2.0, rel=1e-9)
        else:
            assert 1.5 < ratio < 2.0


def test_given_numbers_are_used_unchanged() -> None:
    given = {
        "contact.stiffness": 3e10,
        "contact.exponent": 1.4,
        "contact.damping_factor": 0.2,
        "contact.viscous_damping": 7.0,
    }
    assert normal_law(DEFAULT.override(given)).law == (3e10, 1.4, 0.2, 7.0)
    assert normal_law(DEFAULT.override({"contact.stiffness": 3e10})).law[:2] == (3e10, 1.5)
    linear = normal_law(DEFAULT.override({"contact.stiffness": 9e7, "contact.damping_factor": KELVIN_VOIGT})).law
    assert linear[:2] == (9e7, 1.0)
    assert two_bodies(linear, (IMPACT.shaft_mass, IMPACT.house_mass), 0.03) == pytest.approx(0.9, abs=2e-5)


def test_another_exponent_keeps_the_depth_and_reports_the_lost_fit() -> None:
    resolved = normal_law(DEFAULT.override({"contact.exponent": 1.2}))
    assert resolved.fit_error is None
    own = chosen("none", 0.9)
    assert resolved.law.stiffness == match_depth(own.stiffness, 1.5, 1.2, IMPACT)
    depths = [
        free_impact(law._replace(damping_factor=0.0), mass=IMPACT.mass, speed=IMPACT.speed).depth
        for law in (resolved.law, own)
    ]
    assert depths[0] == pytest.approx(depths[1], rel=1e-6)


def test_reference_masses_are_the_shafts_and_the_inner_houses() -> None:
    assert IMPACT.shaft_mass == pytest.approx(1.987, abs=1e-3)
    assert IMPACT.house_mass == 1.70
    assert IMPACT.mass == pytest.approx(0.916, abs=1e-3)
    assert ReferenceImpact(2.0, 2.0, 0.1).mass == 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"contact.damping_factor": KELVIN_VOIGT, "contact.exponent": 1.5}, r"^contact\.exponent must be 1 or law"),
        ({"contact.stiffness": "pereira-cylinder", "ring.clearance": 12.0}, r"^ring\.clearance must be from 0\.005 to"),
        (
            {"contact.stiffness": "johnson-cylinder", "ring.clearance": 0.01, "ring.young_modulus": 1e8},
            r"^contact\.stiffness must be another law",
        ),
    ],
)  # fmt: skip
def test_incompatible_laws_are_refused_by_name(changes: dict[str, float | str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        build_model(DEFAULT.override(changes))
