"""Agreement of the magnet models with other results.

| the rig's                   | must agree with                      | because                                  |
|-----------------------------|--------------------------------------|------------------------------------------|
| field of a cylinder         | magpylib                             | another code, other integrals            |
| force between two cylinders | surface currents in magpylib's field | charge or current: two views of a magnet |
| the same                    | integral of three Bessel functions   | Fourier transform of charged disks       |
| the same                    | itself, the two radii swapped        | action and reaction                      |
| the same, far apart         | force between two dipoles            | far field                                |
| the same, more nodes        | geometric convergence                | smooth integrand                         |
| exact cylinders             | sum of the pairs; eq. 38 far away    | superposition; far field                 |
| K of exact cylinders        | slope of the force                   | definition                               |
| far-field map               | field sum of eqs. 35, 38             | it is fitted to it                       |
| cylinder map                | exact cylinders                      | it is fitted to them                     |
| force of every map          | minus the gradient of its potential  | energy ledger                            |
| the same                    | itself, turned by one magnet         | the magnets are equal                    |
| sag                         | lever rule with exact cylinders      | statics                                  |
| energy ledger of a run      | zero residual                        | first law                                |
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import get_args

import numpy as np
import pytest

from rig import InputError, load_parameters, load_scene, simulate
from rig.physics.kernels import signals as S
from rig.physics.kernels.laws.magnet import LINEAR, RADIAL, RIPPLED, magnet_force
from rig.physics.levels import ModelLevels
from rig.physics.magnets import (
    MAX_REACH_M,
    MU_0,
    MagnetGeometry,
    MagnetMap,
    cylinder_force,
    cylinder_stiffness,
    field_sum_force,
    field_sum_stiffness,
    fit_cylinder_map,
    fit_map,
    linear_map,
    map_force,
    model_errors,
    pair_force,
    quadrature_error,
    radial_field,
)
from rig.physics.model import Model, build_model, describe
from rig.run.motion import energy_balance
from rig.run.simulation import Simulation

S_MAGNET = S.COLUMN["magnet_energy"]
TABLE_1 = MagnetGeometry(8, 16.9e-3, 6e-3, 8e-3, 25e-3, 705e3)
FLAT = TABLE_1._replace(length=4e-3, bearing_magnet_radius=9e-3, shaft_magnet_radius=3e-3)
LEVELS = get_args(ModelLevels.model_fields["magnet"].annotation)


def model_of(level: str, **changes: float | str) -> Model:
    parameters = load_parameters().override({key.replace("__", "."): value for key, value in changes.items()})
    return build_model(parameters, ModelLevels.model_validate({"magnet": level}))


def sample_disc(
    geometry: MagnetGeometry, radius: float, *, points: int = 400, seed: int = 5
) -> tuple[np.ndarray, np.ndarray]:
    """Return random places on a disc, its rim included."""
    rng = np.random.default_rng(seed)
    r = radius * np.sqrt(np.concatenate([rng.uniform(size=points), np.ones(points // 4)]))
    angle = rng.uniform(-math.pi, math.pi, size=r.size)
    return r * np.cos(angle), r * np.sin(angle)


def test_field_is_magpylibs() -> None:
    import magpylib as magpy

    rng = np.random.default_rng(1)
    rho, z = rng.uniform(1e-3, 40e-3, size=300), rng.uniform(-30e-3, 30e-3, size=300)
    cylinder = magpy.magnet.Cylinder(magnetization=(0, 0, 705e3), dimension=(12e-3, 16.9e-3))
    theirs = cylinder.getB(np.stack([rho, np.zeros(300), z], axis=-1))[:, 0]
    outside = (rho > 6e-3) | (np.abs(z) > 8.45e-3)
    assert 100 < outside.sum() < 300, "inside as well"
    ours = MU_0 * 705e3 * radial_field(rho, z, 6e-3, 16.9e-3)
    np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("geometry", [TABLE_1, FLAT])
@pytest.mark.parametrize("distance", [15e-3, 20e-3, 35e-3])
def test_force_agrees_with_surface_currents_in_magpylibs_field(geometry: MagnetGeometry, distance: float) -> None:
    import magpylib as magpy

    bearing = magpy.magnet.Cylinder(
        magnetization=(0, 0, geometry.magnetisation),
        dimension=(2 * geometry.bearing_magnet_radius, geometry.length),
    )
    # Current M0 around the shaft magnet's mantle: dF = M0 dz dl x B; its lateral part along the line of centres.
    root, weight = np.polynomial.legendre.leggauss(60)
    z, dz = root * geometry.length / 2, weight * geometry.length / 2
    phi = 2 * np.pi * (np.arange(240) + 0.5) / 240
    radius = geometry.shaft_magnet_radius
    points = np.stack(
        np.broadcast_arrays(distance + radius * np.cos(phi), radius * np.sin(phi), z[:, None]), axis=-1
    ).reshape(-1, 3)
    field = bearing.getB(points)[:, 2].reshape(60, 240)
    force = geometry.magnetisation * radius * 2 * np.pi / 240 * np.sum(dz[:, None] * field * np.cos(phi))
    assert pair_force(distance, geometry) == pytest.approx(force, rel=1e-6)


@pytest.mark.parametrize("geometry", [TABLE_1, FLAT])
def test_force_is_the_bessel_integral(geometry: MagnetGeometry) -> None:
    from scipy.integrate import quad
    from scipy.special import j1

    a, b, length, distance = *geometry[2:4], geometry.length, 18e-3

    # Two disks of charge a height h apart: 2D Fourier transforms 2 pi a J1(ka)/k, and exp(-kh)/(2k) between them.
    def integrand(k: float) -> float:
        return j1(k * distance) * j1(k * a) * j1(k * b) * -math.expm1(-k * length) / k

    value = quad(integrand, 0.0, 1e5, limit=4000, epsabs=1e-9)[0]
    force = 2 * math.pi * MU_0 * geometry.magnetisation**2 * a * b * value
    # The integral is truncated where its tail is a few millionths.
    assert pair_force(distance, geometry) == pytest.approx(force, rel=1e-5)


@pytest.mark.parametrize("geometry", [TABLE_1, FLAT])
def test_action_is_reaction(geometry: MagnetGeometry) -> None:
    swapped = geometry._replace(
        bearing_magnet_radius=geometry.shaft_magnet_radius, shaft_magnet_radius=geometry.bearing_magnet_radius
    )
    for distance in (15.5e-3, 25e-3, 60e-3):
        assert pair_force(distance, geometry) == pytest.approx(pair_force(distance, swapped), rel=1e-10)


def test_far_apart_magnets_are_dipoles() -> None:
    volumes = math.pi * TABLE_1.length * np.array([TABLE_1.bearing_magnet_radius, TABLE_1.shaft_magnet_radius]) ** 2
    moments = TABLE_1.magnetisation * volumes
    errors = []
    for distance in (0.2, 0.4, 0.8):
        dipoles = 3 * MU_0 * moments.prod() / (4 * math.pi * distance**4)
        errors.append(abs(pair_force(distance, TABLE_1) / dipoles - 1))
        field_sum = field_sum_force(np.zeros(1), np.zeros(1), TABLE_1._replace(number=1, bearing_radius=distance))
        assert field_sum[0, 1] == pytest.approx(dipoles, rel=0.01), "eq. 35 pushes up from below"
    assert errors[0] < 0.02
    # The next term of the multipole series is of order 1/d^2.
    np.testing.assert_allclose(np.array(errors[:2]) / errors[1:], 4.0, rtol=0.05)


def test_quadrature_converges_geometrically() -> None:
    # The narrowest gap of the family: 1 mm, at the end of the reach.
    distance = TABLE_1.bearing_radius - MAX_REACH_M
    exact = pair_force(distance, TABLE_1, nodes=96)
    errors = [abs(pair_force(distance, TABLE_1, nodes=nodes) / exact - 1) for nodes in (4, 8, 12, 16)]
    assert errors[0] < 1e-3
    assert all(finer < coarser / 50 for coarser, finer in pairwise(errors))
    assert errors[-1] < 1e-10
    assert quadrature_error(TABLE_1) < 1e-7


@pytest.mark.parametrize("gap", [1e-3, 0.2e-3])
def test_quadrature_is_refined_at_small_gaps(gap: float) -> None:
    tight = TABLE_1._replace(bearing_radius=14e-3 + gap)
    assert tight.reach < gap
    nearest = tight.bearing_radius - tight.reach
    x, y = np.zeros(1), np.array([-tight.reach])
    alone = tight._replace(number=1)
    assert cylinder_force(x, y, alone)[0, 1] == pytest.approx(pair_force(nearest, tight, nodes=160), rel=1e-7)
    assert abs(pair_force(nearest, tight, nodes=12) / pair_force(nearest, tight, nodes=160) - 1) > 1e-7


@pytest.mark.parametrize("geometry", [TABLE_1, FLAT._replace(number=5), TABLE_1._replace(number=3)])
def test_cylinders_add_up(geometry: MagnetGeometry) -> None:
    x, y = sample_disc(geometry, geometry.reach, points=20)
    expected = np.zeros((x.size, 2))
    for n in range(geometry.number):
        # The first magnet is directly below.
        place = geometry.bearing_radius * np.exp(1j * (2 * math.pi * n / geometry.number - math.pi / 2))
        for i, away in enumerate(x + 1j * y - place):
            force = pair_force(abs(away), geometry) * away / abs(away)
            expected[i] += force.real, force.imag
    np.testing.assert_allclose(cylinder_force(x, y, geometry), expected, atol=1e-7 * np.abs(expected).max())


def test_places_beyond_the_reach_are_refused() -> None:
    with pytest.raises(InputError, match=r"displacement must be within the reach of 10 mm; received '?10\.1"):
        cylinder_force(np.array([10.1e-3]), np.zeros(1), TABLE_1)


def test_stiffness_is_the_slope_at_the_centre() -> None:
    h = 1e-4
    for geometry in (TABLE_1, FLAT._replace(number=3)):
        for axis in ((1.0, 0.0), (0.0, 1.0)):
            x, y = (np.array([h, -h]) * component for component in axis)
            for force, stiffness in (
                (cylinder_force, cylinder_stiffness(geometry)),
                (field_sum_force, field_sum_stiffness(geometry)),
            ):
                pulled = force(x, y, geometry) @ axis
                assert (pulled[1] - pulled[0]) / (2 * h) == pytest.approx(stiffness, rel=1e-3)


def test_field_sum_is_the_far_field_of_cylinders() -> None:
    geometry = MagnetGeometry(3, 5e-3, 3e-3, 2e-3, 0.12, 705e3)
    x, y = np.array([4e-3, 0.0, -3e-3]), np.array([0.0, 4e-3, 2e-3])
    exact = cylinder_force(x, y, geometry)
    np.testing.assert_allclose(field_sum_force(x, y, geometry), exact, atol=0.05 * np.abs(exact).max())


def test_field_sum_overstates_the_cylinders_of_table_1() -> None:
    # Toward a magnet, by 2.27 at the centre and 3.61 at 10 mm; between the single magnets 1.6 (25 mm) to 3.5 (15 mm).
    assert field_sum_stiffness(TABLE_1) == pytest.approx(1.667e3, rel=1e-3), "eq. 35 gives 1.67 kN/m"
    assert field_sum_stiffness(TABLE_1) / cylinder_stiffness(TABLE_1) == pytest.approx(2.266, abs=0.005)
    x, y = np.zeros(1), np.array([-MAX_REACH_M])
    ratio = field_sum_force(x, y, TABLE_1)[0, 1] / cylinder_force(x, y, TABLE_1)[0, 1]
    assert ratio == pytest.approx(3.611, abs=0.005)
    assert field_sum_force(x, y, TABLE_1)[0, 1] == pytest.approx(40.0, abs=1.0), "Fig. 7"


def test_no_length_of_eight_cylinders_reaches_the_stiffness_of_the_rig() -> None:
    lengths = [5e-3, 10e-3, 20e-3, 25e-3, 30e-3, 40e-3, 60e-3, 0.2]
    stiffness = [cylinder_stiffness(TABLE_1._replace(length=length)) for length in lengths]
    assert max(stiffness) == stiffness[4] == pytest.approx(836.0, abs=1.0)
    # The far-field sum keeps growing with the square of the length.
    long, longer = (field_sum_stiffness(TABLE_1._replace(length=length)) for length in (0.1, 0.2))
    assert longer == pytest.approx(4 * long)


def test_far_field_map_follows_the_field_sum() -> None:
    fitted = fit_map(TABLE_1)
    assert fitted.terms == RADIAL
    assert fitted.error < 0.08
    assert fitted.stiffness == pytest.approx(1670.0, rel=0.02)
    hardening = 1 + fitted.a3 * MAX_REACH_M**2 + fitted.a5 * MAX_REACH_M**4 + fitted.a7 * MAX_REACH_M**6
    assert hardening == pytest.approx(2.3, abs=0.15), "Fig. 7 hardens by that much"
    constants = model_of("map").constants.magnet
    assert constants.stiffness * MAX_REACH_M * hardening == pytest.approx(40.0, abs=3.0)
    far = fit_map(MagnetGeometry(16, 16.9e-3, 6e-3, 8e-3, 40e-3, 705e3))
    assert far.error < 1e-3, "many magnets far apart are rotationally symmetric"


@pytest.mark.parametrize(
    ("number", "over_reach", "over_4_mm"), [(8, 2e-3, 4e-4), (12, 2e-3, 4e-4), (5, 0.02, 2e-3), (3, 0.25, 0.03)]
)
def test_cylinder_map_follows_the_cylinders(number: int, over_reach: float, over_4_mm: float) -> None:
    geometry = TABLE_1._replace(number=number)
    fitted = fit_cylinder_map(geometry)
    assert fitted.terms == RIPPLED
    assert fitted.stiffness == cylinder_stiffness(geometry)
    errors = []
    for radius in (MAX_REACH_M, 4e-3):
        x, y = sample_disc(geometry, radius)
        exact = np.asarray(cylinder_force(x, y, geometry))
        missed = np.linalg.norm(map_force(x, y, fitted) - exact, axis=-1).max()
        errors.append(missed / np.linalg.norm(exact, axis=-1).max())
    assert errors[0] < over_reach
    assert errors[1] < over_4_mm
    # An independent set of places, all around, shows no more than the reported error.
    assert errors[0] == pytest.approx(fitted.error, rel=0.1)


def test_ripple_is_worth_its_term() -> None:
    fitted = fit_cylinder_map(TABLE_1)
    x, y = sample_disc(TABLE_1, MAX_REACH_M)
    exact = cylinder_force(x, y, TABLE_1)

    def missed(magnet_map: MagnetMap) -> float:
        return float(np.linalg.norm(map_force(x, y, magnet_map) - exact, axis=-1).max())

    assert missed(fitted._replace(terms=RADIAL)) > 10 * missed(fitted)
    assert missed(fitted._replace(growth=0.0)) > 2 * missed(fitted)


def test_ripple_at_rounding_level_is_omitted() -> None:
    geometry = TABLE_1._replace(number=64, bearing_radius=0.5)
    assert fit_cylinder_map(geometry).terms == RADIAL
    assert fit_cylinder_map(geometry).error < 1e-8


@pytest.fixture(
    params=[(linear_map, 8), (fit_map, 8), *((fit_cylinder_map, number) for number in (3, 4, 5, 8, 12))],
    ids=lambda made: f"{made[0].__name__}-{made[1]}",
)
def magnet_map(request: pytest.FixtureRequest) -> MagnetMap:
    fit, number = request.param
    return fit(TABLE_1._replace(number=number))


def test_force_is_the_gradient_of_the_potential(magnet_map: MagnetMap) -> None:
    m = magnet_map
    terms = [1.0, m.a3, m.a5, m.a7]
    h = 1e-6
    for x, y in zip(*sample_disc(TABLE_1, 0.9 * MAX_REACH_M, points=40), strict=True):
        r, angle = math.hypot(x, y), math.atan2(x, -y)
        potential = sum(a * r ** (2 * i + 2) / (2 * i + 2) for i, a in enumerate(terms))
        potential += m.ripple * r**m.number * (1 + m.growth * r * r) * math.cos(m.number * angle)
        force_x, force_y, stored = magnet_force(x, y, m)
        assert stored == pytest.approx(m.stiffness * potential, rel=1e-10)
        slope_x = (magnet_force(x + h, y, m)[2] - magnet_force(x - h, y, m)[2]) / (2 * h)
        slope_y = (magnet_force(x, y + h, m)[2] - magnet_force(x, y - h, m)[2]) / (2 * h)
        size = m.stiffness * r
        assert -force_x == pytest.approx(slope_x, abs=1e-6 * size)
        assert -force_y == pytest.approx(slope_y, abs=1e-6 * size)
    assert magnet_force(0.0, 0.0, m) == (0.0, 0.0, 0.0)


def test_force_turns_with_the_magnets(magnet_map: MagnetMap) -> None:
    x, y = sample_disc(TABLE_1, MAX_REACH_M, points=40)
    plain = map_force(x, y, magnet_map) @ [1.0, 1j]
    turn = np.exp(2j * math.pi / magnet_map.number)
    there = turn * (x + 1j * y)
    turned = map_force(there.real, there.imag, magnet_map) @ [1.0, 1j]
    np.testing.assert_allclose(turned, turn * plain, atol=1e-11 * np.abs(plain).max())
    # At half the angle the force differs, unless the magnets are equal.
    half = np.sqrt(turn)
    there = half * (x + 1j * y)
    between = map_force(there.real, there.imag, magnet_map) @ [1.0, 1j]
    alike = np.allclose(between, half * plain, atol=1e-9 * np.abs(plain).max())
    assert alike == (magnet_map.terms != RIPPLED)


def test_levels_use_their_maps() -> None:
    magnets = {level: model_of(level).constants.magnet for level in LEVELS}
    assert {level: magnet.terms for level, magnet in magnets.items()} == {
        "linear": LINEAR,
        "map": RADIAL,
        "cylinders": RIPPLED,
    }
    assert {magnet.stiffness for magnet in magnets.values()} == {1700.0}, "a number sets K of every level"
    slopes = {level: -magnet_force(1e-6, 0.0, magnet)[0] / 1e-6 for level, magnet in magnets.items()}
    assert all(slope == pytest.approx(1700.0, rel=1e-6) for slope in slopes.values())
    assert magnets["cylinders"].ripple == fit_cylinder_map(TABLE_1).ripple, "the shape does not depend on K"


@pytest.mark.parametrize("level", LEVELS)
def test_rules_of_stiffness(level: str) -> None:
    eq35 = model_of(level, magnet__stiffness="eq35")
    exact = model_of(level, magnet__stiffness="cylinders")
    assert eq35.constants.magnet.stiffness == fit_map(TABLE_1).stiffness
    assert exact.constants.magnet.stiffness == cylinder_stiffness(TABLE_1)
    assert exact.resolved["magnet.stiffness"] == pytest.approx(0.7354, abs=1e-4)


@pytest.mark.parametrize(("number", "tolerance"), [(8, 1e-3), (5, 5e-3), (12, 1e-3)])
def test_sag_on_exact_cylinders(number: int, tolerance: float) -> None:
    # Stronger magnets than the paper's, so that five of them hold the shaft well within the reach.
    model = model_of("cylinders", magnet__stiffness="cylinders", magnet__count=number, magnet__magnetisation=1000.0)
    shaft = model.constants.shaft
    depth = model.sag * shaft.arm_magnet / shaft.arm_ring
    assert -0.9 * MAX_REACH_M < depth < 0.0
    lift = cylinder_force(np.zeros(1), np.array([depth]), model.magnets)[0]
    share = shaft.mass * shaft.gravity * shaft.arm_centre / shaft.arm_magnet
    assert lift[1] == pytest.approx(share, rel=tolerance)
    assert abs(lift[0]) < 1e-9 * share, "one magnet is straight below: nothing pushes aside"
    sideways, held, _ = magnet_force(0.0, depth, model.constants.magnet)
    assert abs(sideways) < 1e-12 * share
    assert held == pytest.approx(share, rel=1e-9)


@pytest.mark.parametrize("level", LEVELS)
def test_ledger_closes_on_every_level_and_through_a_release(level: str) -> None:
    # Few, strong magnets and a wide ring: the ripple does work.
    changes = {
        "model.magnet": level,
        "magnet.count": 5,
        "ring.clearance": 2.0,
        "initial.position": "given",
        "initial.x_mm": 1.6,
        "initial.y_mm": 0.9,
        "sensors.noise": False,
        "drive.speed_hz": 3.0,
    }
    simulation = Simulation(load_scene("stable-run", changes))
    first = simulation.first_row.copy()
    rows = simulation.advance(200_000).rows.copy()
    assert np.ptp(rows[:, S_MAGNET]) > 1e-3, "the magnets take and give"
    simulation.submit("release", {})
    last = simulation.advance(20_000).rows[-1:]
    stored = float(np.abs(rows[:, S_MAGNET]).max())
    for balance in (energy_balance(rows, first), energy_balance(last, first)):
        assert np.abs(balance["residual"]).max() < 1e-7 * stored
    assert last[0, S_MAGNET] == 0.0


def test_runs_on_cylinders_and_map_differ_like_their_forces() -> None:
    scene = {"sensors.noise": False}
    held = {
        level: simulate(load_scene("stable-run", {**scene, "model.magnet": level}), duration_s=0.05) for level in LEVELS
    }
    sags = {level: run.simulation.model.sag for level, run in held.items()}
    # Harder magnets hold it higher; eq. 35 hardens more than cylinders do.
    assert sags["linear"] < sags["cylinders"] < sags["map"] < 0.0


@pytest.mark.parametrize("number", [8, 5])
def test_errors_are_found_nowhere_else_larger(number: int) -> None:
    geometry = TABLE_1._replace(number=number)
    travel = 4e-3
    far_field, cylinders = fit_map(geometry), fit_cylinder_map(geometry)
    sum_k, exact_k = field_sum_stiffness(geometry), cylinder_stiffness(geometry)
    for index, radius in enumerate((MAX_REACH_M, travel)):
        x, y = sample_disc(geometry, radius, points=2000)
        r, place = np.hypot(x, y), np.stack([x, y], axis=-1)
        hard = 1 + far_field.a3 * r**2 + far_field.a5 * r**4 + far_field.a7 * r**6
        shape = {
            "linear": -place,
            "far-field map": -place * hard[:, None],
            "far-field sum": field_sum_force(x, y, geometry),
            "exact cylinders": cylinder_force(x, y, geometry),
            "cylinder map": map_force(x, y, cylinders),
        }
        k = {"linear": 1.0, "far-field map": 1.0, "far-field sum": sum_k, "exact cylinders": exact_k}
        k["cylinder map"] = exact_k
        for error in model_errors(geometry, travel):
            one, better = shape[error.model], shape[error.against]
            if error.equal == "magnets":
                one = one * (far_field.stiffness if error.model == "far-field map" else 1.0)
            else:
                one, better = one / k[error.model], better / k[error.against]
            found = np.linalg.norm(one - better, axis=-1).max() / np.linalg.norm(better, axis=-1).max()
            stated = (error.over_reach, error.over_travel)[index]
            assert found == pytest.approx(stated, rel=0.03), error


def test_model_carries_its_errors() -> None:
    document = describe(model_of("cylinders"))["derived"]
    errors = {(error["model"], error["against"], error["equal"]): error for error in document["magnet_errors"]}
    chain = errors["cylinder map", "exact cylinders", "magnets"]
    assert chain["over_reach"] == document["magnet_map_error"] < 2e-3
    assert chain["over_travel"] < 4e-4
    assert document["magnet_stiffness_cylinders_kn_m"] == pytest.approx(0.7354, abs=1e-4)
    assert document["magnet_reach_mm"] == 10.0
    # The shaft's bottom in the ring, projected to the magnets.
    assert document["magnet_travel_mm"] == pytest.approx((1.619 + 0.926) * 391 / 197, abs=2e-3)
    # At equal stiffness a spring is nearer to the cylinders than the far field's hardening is.
    spring = errors["linear", "exact cylinders", "stiffness at the centre"]
    hardening = errors["far-field map", "exact cylinders", "stiffness at the centre"]
    for key in ("over_reach", "over_travel"):
        assert spring[key] < hardening[key]


def test_overlapping_magnets_are_refused() -> None:
    with pytest.raises(InputError, match=r"magnet\.count must be at most 12, or the magnets would overlap"):
        model_of("map", magnet__count=13)
    assert model_of("map", magnet__count=12).magnets.number == 12
    with pytest.raises(InputError, match=r"magnet\.bearing_radius must be above the sum"):
        model_of("map", magnet__bearing_radius=14.0)
