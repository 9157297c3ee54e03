"""Magnet models, from the paper's far-field sum to exact cylinders, and the fitted maps of the kernels.

| model           | description                                                                                     |
|-----------------|-------------------------------------------------------------------------------------------------|
| linear          | a spring with the stiffness at the centre                                                       |
| far-field map   | radial polynomial, fitted to the far-field sum                                                  |
| far-field sum   | the paper's eqs. 35, 38: point dipoles act on a current loop around the shaft magnet            |
| cylinder map    | radial polynomial and the first harmonic of the single magnets, fitted to the exact cylinders   |
| exact cylinders | uniformly magnetised finite cylinders, by charge on their ends (Derby & Olbert 2010)            |

`model_errors` gives the error of each model against the next better one. The paper does not give the number and length
of the magnets, nor their angular position: one magnet is assumed straight below the shaft, which makes the rig
symmetric about its vertical. Assumptions of the cylinders: uniform and rigid magnetisation, no iron, equal lengths,
parallel axes, middles in one plane. The shaft's tilt is neglected: the lateral force is even in it (0.1 % at 10 mm),
and the torque about the magnet's own middle is 0.1 % of K l0B^2.

The far-field form overestimates the force of the cylinders at this spacing (`model_errors` gives the factor). Therefore
`magnet.stiffness` alone sets the scale of both maps, and the models give only their shape. Eight such cylinders reach
at most 0.84 kN/m at any length, half of the rig's apparent stiffness, so the rig's magnets must differ. No measured
force of the rig's magnets is known: the exact cylinders are exact for their assumptions, not validated on the rig.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from rig.base.errors import InputError, Words
from rig.physics.kernels.constants import Magnet
from rig.physics.kernels.laws.magnet import LINEAR, RADIAL, RIPPLED, magnet_force

MU_0 = 4e-7 * np.pi
"""Permeability of vacuum, Table 1 [T m/A]."""
MAX_REACH_M = 0.010
"""Largest radius of the fitted maps [m]: the axes of Fig. 7."""

_QUADRATURE_TOLERANCE = 1e-7
"""Largest relative change of the force between two cylinders when the number of nodes is doubled."""
_NODE_LIMITS = (12, 96)
"""Smallest and largest number of Gauss nodes along the radius for that force."""
_CHEBYSHEV_DEGREE = 47
"""Degree of the Chebyshev series of the force's logarithm as a function of distance."""


class MagnetGeometry(NamedTuple):
    """Magnets of Table 1 in SI units."""

    number: int
    length: float
    bearing_magnet_radius: float
    shaft_magnet_radius: float
    bearing_radius: float
    magnetisation: float

    @property
    def gap(self) -> float:
        """Gap between the centred shaft magnet and the bearing magnets [m]."""
        return self.bearing_radius - self.bearing_magnet_radius - self.shaft_magnet_radius

    @property
    def reach(self) -> float:
        """Radius of the models' comparison and the maps' fit [m], below that at which the magnets touch."""
        return min(MAX_REACH_M, 0.92 * self.gap)


class MagnetMap(NamedTuple):
    """Map that the kernel evaluates (`rig.physics.kernels.laws.magnet`), and its error against the fitted model."""

    terms: int
    stiffness: float
    a3: float
    a5: float
    a7: float
    ripple: float
    growth: float
    number: int
    error: float
    """Largest deviation within the reach, in any direction, as a fraction of the largest force."""


class ModelError(NamedTuple):
    """Error of one magnet model against a better one: largest deviation over the better model's largest force."""

    model: str
    against: str
    equal: str
    """Property that both share: the stiffness at the centre, or the magnets."""
    over_reach: float
    over_travel: float


def field_sum_force(x: np.ndarray, y: np.ndarray, geometry: MagnetGeometry, *, points: int = 180) -> np.ndarray:
    """Return the force on the shaft magnet by eqs. 35 and 38.

    Every bearing magnet is a dipole loop of current M0 L (eq. 35); the force is the sum of I dl x B around the shaft
    magnet's own loop (eq. 38). All loops lie in one plane and repel. As a far-field form it is too strong within a few
    radii.

    Args:
        x: Horizontal displacement of the shaft magnet [m], shape (n,).
        y: Vertical displacement of the shaft magnet [m], shape (n,).
        geometry: Magnets.
        points: Number of points on the shaft magnet's loop.

    Returns:
        Force [N], shape (n, 2).

    Example:
        >>> table_1 = MagnetGeometry(8, 0.0169, 0.006, 0.008, 0.025, 7.05e5)
        >>> field_sum_force(np.array([1e-3]), np.array([0.0]), table_1).round(3) + 0.0
        array([[-1.678,  0.   ]])
    """
    current = geometry.magnetisation * geometry.length
    around = 2.0 * np.pi * np.arange(points) / points
    outward = np.stack([np.cos(around), np.sin(around)], axis=-1)
    loop = np.stack([x, y], axis=-1)[:, None, :] + geometry.shaft_magnet_radius * outward
    distance = np.linalg.norm(loop[:, :, None, :] - _centres(geometry), axis=-1)
    # Eq. 35 in the plane of the loops (psi = 90 deg): there the field of a dipole along +z points along -z.
    field = -MU_0 * current * geometry.bearing_magnet_radius**2 / (4.0 * distance**3)
    # dl x B with B = B z and dl = r_s dphi (-sin, cos) is r_s dphi B (cos, sin).
    # The force points inward where the field opposes: the magnets repel.
    width = geometry.shaft_magnet_radius * 2.0 * np.pi / points
    return current * width * np.einsum("npm,pk->nk", field, outward)


def field_sum_stiffness(geometry: MagnetGeometry) -> float:
    """Return K of the far-field sum at the centre [N/m], by a central difference (error about 1e-6)."""
    h = 1e-3 * geometry.reach
    force = field_sum_force(np.array([h, -h]), np.zeros(2), geometry)[:, 0]
    return float((force[1] - force[0]) / (2.0 * h))


def radial_field(rho: np.ndarray, z: np.ndarray | float, radius: float, length: float) -> np.ndarray:
    """Return the radial field of a uniformly, axially magnetised cylinder, over mu_0 M [1].

    Derby & Olbert, Am. J. Phys. 78 (2010) 229, eq. for B_rho; their C(k, 1, 1, -1) is ((m - 2) K(m) + 2 E(m)) / m with
    m = 1 - k^2. The rounding error is about eps/m^2, and m is small at large distances: 1e-10 at a hundred radii.

    Args:
        rho: Distance from the axis [m], above 0 and not on the rim of an end.
        z: Height above the middle [m].
        radius: Radius of the cylinder [m].
        length: Length of the cylinder [m].

    Returns:
        Field, the shape of `rho`.
    """
    from scipy.special import ellipe, ellipk

    field = np.zeros_like(rho)
    for sign in (1.0, -1.0):
        height = z + sign * length / 2.0
        square = height * height + (radius + rho) ** 2
        m = 4.0 * radius * rho / square
        field += sign * radius / (np.pi * np.sqrt(square)) * ((m - 2.0) * ellipk(m) + 2.0 * ellipe(m)) / m
    return field


@cache
def _gauss(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of Gauss quadrature from -1 to 1."""
    return np.polynomial.legendre.leggauss(nodes)


def pair_force(distance: float, geometry: MagnetGeometry, *, nodes: int = 24) -> float:
    """Return the repulsive force of one bearing magnet on the shaft magnet, by exact cylinders.

    The shaft magnet is two disks of magnetic charge +-M0 on its ends, both in the same lateral field. The quadrature is
    Gauss in the radius and uniform in the angle; both converge geometrically, faster for a wider gap.

    Args:
        distance: Distance between the axes [m], above the sum of the radii.
        geometry: Magnets.
        nodes: Number of Gauss nodes along the radius, and an eighth of the angles over half the circle.

    Returns:
        Force [N].

    Example:
        >>> table_1 = MagnetGeometry(8, 0.0169, 0.006, 0.008, 0.025, 7.05e5)
        >>> round(pair_force(0.025, table_1), 3)
        1.867
    """
    root, weight = _gauss(nodes)
    r = geometry.shaft_magnet_radius * (root[:, None] + 1.0) / 2.0
    area = np.pi * geometry.shaft_magnet_radius * weight[:, None] * r / (8 * nodes)
    phi = np.pi * (np.arange(8 * nodes) + 0.5) / (8 * nodes)
    along, across = distance + r * np.cos(phi), r * np.sin(phi)
    rho = np.hypot(along, across)
    field = radial_field(rho, geometry.length / 2.0, geometry.bearing_magnet_radius, geometry.length)
    return float(2.0 * MU_0 * geometry.magnetisation**2 * np.sum(area * field * along / rho))


def cylinder_force(x: np.ndarray, y: np.ndarray, geometry: MagnetGeometry) -> np.ndarray:
    """Return the force on the shaft magnet by exact cylinders, with an error of about 1e-8.

    With parallel axes the force of one magnet depends on the distance alone and acts along the line of centres. The
    integral is computed once for each geometry, at the nodes of a Chebyshev series.

    Args:
        x: Horizontal displacement of the shaft magnet [m], shape (n,).
        y: Vertical displacement of the shaft magnet [m], shape (n,).
        geometry: Magnets.

    Returns:
        Force [N], shape (n, 2).

    Raises:
        InputError: A displacement exceeds the reach.

    Example:
        >>> table_1 = MagnetGeometry(8, 0.0169, 0.006, 0.008, 0.025, 7.05e5)
        >>> cylinder_force(np.array([1e-3]), np.array([0.0]), table_1).round(3) + 0.0
        array([[-0.738,  0.   ]])
    """
    farthest = float(np.max(np.hypot(x, y), initial=0.0))
    if farthest > geometry.reach * (1.0 + 1e-9):
        raise InputError(
            "displacement", f"within the reach of {geometry.reach * 1e3:.4g} mm", Words(f"{farthest * 1e3:.4g}")
        )
    series, _ = _pair_series(geometry)
    away = np.stack([x, y], axis=-1)[:, None, :] - _centres(geometry)
    distance = np.linalg.norm(away, axis=-1)
    force = np.exp(chebyshev.chebval((distance - geometry.bearing_radius) / geometry.reach, series))
    return np.sum((force / distance)[:, :, None] * away, axis=1)


def cylinder_stiffness(geometry: MagnetGeometry) -> float:
    """Return K of the exact cylinders at the centre [N/m].

    It is half the sum, over the magnets, of -f' along and -f/R_b across each magnet's line.
    """
    series, _ = _pair_series(geometry)
    force = np.exp(chebyshev.chebval(0.0, series))
    slope = force * chebyshev.chebval(0.0, chebyshev.chebder(series)) / geometry.reach
    return float(-geometry.number / 2.0 * (slope + force / geometry.bearing_radius))


def quadrature_error(geometry: MagnetGeometry) -> float:
    """Return the largest relative change of the pair force by the last doubling of its quadrature nodes.

    The convergence is geometric: the remaining error is far smaller.
    """
    return _pair_series(geometry)[1]


@cache
def fit_map(geometry: MagnetGeometry) -> MagnetMap:
    """Fit the radial map to the field sum, by least squares over the reach and over directions between two magnets."""
    reach = geometry.reach
    x, y, r = _sector(geometry, reach)
    outward = np.stack([x, y], axis=-1) / r[:, None]
    force = _sector_field_sum(geometry, reach)
    radial = np.sum(force * outward, axis=-1)
    scaled = r / reach
    powers = np.stack([scaled, scaled**3, scaled**5, scaled**7], axis=-1)
    linear, cubic, quintic, septic = np.linalg.lstsq(powers, -radial, rcond=None)[0]
    fitted = MagnetMap(
        terms=RADIAL,
        stiffness=float(linear / reach),
        a3=float(cubic / linear / reach**2),
        a5=float(quintic / linear / reach**4),
        a7=float(septic / linear / reach**6),
        ripple=0.0,
        growth=0.0,
        number=geometry.number,
        error=0.0,
    )
    return fitted._replace(error=_deviation(map_force(x, y, fitted), force))


@cache
def fit_cylinder_map(geometry: MagnetGeometry) -> MagnetMap:
    """Fit the rippled map to the exact cylinders: K at the centre is exact, the rest by relative least squares.

    With few magnets the neglected higher harmonics are larger: check the map's error.
    """
    reach, n, stiffness = geometry.reach, geometry.number, cylinder_stiffness(geometry)
    x, y, r = _sector(geometry, reach)
    force = cylinder_force(x, y, geometry)
    outward = np.stack([x, y], axis=-1) / r[:, None]
    sideways = np.stack([-outward[:, 1], outward[:, 0]], axis=-1)
    u = r / reach
    angle = n * np.arctan2(x, -y)
    nothing = np.zeros_like(r)
    # Force of each term for a coefficient of 1 N: inward, and opposite to the angle's direction.
    inward = [u**3, u**5, u**7, n * u ** (n - 1) * np.cos(angle), (n + 2) * u ** (n + 1) * np.cos(angle)]
    against = [nothing, nothing, nothing, -n * u ** (n - 1) * np.sin(angle), -n * u ** (n + 1) * np.sin(angle)]
    wanted = np.stack([-np.sum(force * outward, axis=-1) - stiffness * r, -np.sum(force * sideways, axis=-1)])
    size = np.linalg.norm(force, axis=-1)
    columns = np.concatenate([np.stack(inward, axis=-1), np.stack(against, axis=-1)]) / np.tile(size, 2)[:, None]
    solved = np.linalg.lstsq(columns, (wanted / size).ravel(), rcond=None)[0]
    cubic, quintic, septic, ripple, grown = (float(c) / (stiffness * reach) for c in solved)
    # Many distant magnets have no ripple but rounding noise, whose power of a length underflows.
    rippled = abs(ripple) > 1e-9 and reach ** (n - 2) > 1e-250
    fitted = MagnetMap(
        terms=RIPPLED if rippled else RADIAL,
        stiffness=stiffness,
        a3=cubic / reach**2,
        a5=quintic / reach**4,
        a7=septic / reach**6,
        ripple=ripple / reach ** (n - 2) if rippled else 0.0,
        growth=grown / ripple / reach**2 if rippled else 0.0,
        number=n,
        error=0.0,
    )
    return fitted._replace(error=_deviation(map_force(x, y, fitted), force))


def linear_map(geometry: MagnetGeometry) -> MagnetMap:
    """Return the far-field map without its hardening, with its error against that map."""
    hardening = fit_map(geometry)
    spring = hardening._replace(terms=LINEAR, a3=0.0, a5=0.0, a7=0.0)
    x, y, _ = _sector(geometry, geometry.reach)
    return spring._replace(error=_deviation(map_force(x, y, spring), map_force(x, y, hardening)))


def map_force(x: np.ndarray, y: np.ndarray, magnet_map: MagnetMap | Magnet) -> np.ndarray:
    """Return the force of a map [N], shape (n, 2), at displacements [m], each of shape (n,)."""
    # The kernel's Python function takes arrays; without the JIT the kernel is that function.
    formula = getattr(magnet_force, "py_func", magnet_force)
    force_x, force_y, _ = formula(x, y, magnet_map)
    return np.stack([force_x, force_y], axis=-1)


def model_errors(geometry: MagnetGeometry, travel: float) -> tuple[ModelError, ...]:
    """Return the error of each model against the next better one, then of the cheap models against the best.

    Args:
        geometry: Magnets.
        travel: Largest distance of the shaft from the magnets' centre [m]; limited to the reach.
    """
    both = zip(_errors(geometry, geometry.reach), _errors(geometry, min(travel, geometry.reach)), strict=True)
    return tuple(ModelError(*names, *pair) for names, pair in zip(_COMPARISONS, both, strict=True))


_CENTRE_STIFFNESS, _SAME_MAGNETS = "stiffness at the centre", "magnets"
_COMPARISONS = (
    ("linear", "far-field map", _CENTRE_STIFFNESS),
    ("far-field map", "far-field sum", _SAME_MAGNETS),
    ("far-field sum", "exact cylinders", _CENTRE_STIFFNESS),
    ("far-field sum", "exact cylinders", _SAME_MAGNETS),
    ("cylinder map", "exact cylinders", _SAME_MAGNETS),
    ("linear", "exact cylinders", _CENTRE_STIFFNESS),
    ("far-field map", "exact cylinders", _CENTRE_STIFFNESS),
)
"""Pairs of models that are compared, and the property that both share."""


@cache
def _errors(geometry: MagnetGeometry, radius: float) -> tuple[float, ...]:
    """Return the errors of all comparisons within a radius [m]."""
    spring, radial, cylinders = linear_map(geometry), fit_map(geometry), fit_cylinder_map(geometry)
    x, y, _ = _sector(geometry, radius)
    exact, far = cylinder_force(x, y, geometry), _sector_field_sum(geometry, radius)
    in_radial, in_spring = map_force(x, y, radial), map_force(x, y, spring)
    return (
        _deviation(in_spring, in_radial),
        _deviation(in_radial, far),
        _deviation(far * cylinders.stiffness / field_sum_stiffness(geometry), exact),
        _deviation(far, exact),
        _deviation(map_force(x, y, cylinders), exact),
        _deviation(in_spring * cylinders.stiffness / spring.stiffness, exact),
        _deviation(in_radial * cylinders.stiffness / radial.stiffness, exact),
    )


def _centres(geometry: MagnetGeometry) -> np.ndarray:
    """Return the axes of the bearing magnets [m], shape (number, 2), the first straight below."""
    place = 2.0 * np.pi * np.arange(geometry.number) / geometry.number
    return geometry.bearing_radius * np.stack([np.sin(place), -np.cos(place)], axis=-1)


def _sector(geometry: MagnetGeometry, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points and their radii from a magnet half-way to the next; the rest is mirrored.

    Returns:
        x, y and radius [m], each of shape (n,).
    """
    r, angle = (
        grid.ravel()
        for grid in np.meshgrid(np.linspace(radius / 40, radius, 40), np.linspace(0.0, np.pi / geometry.number, 9))
    )
    return r * np.sin(angle), -r * np.cos(angle), r


@cache
def _sector_field_sum(geometry: MagnetGeometry, radius: float) -> np.ndarray:
    """Return the field sum over a sector [N], shape (n, 2), cached for the fit and its errors."""
    x, y, _ = _sector(geometry, radius)
    force = field_sum_force(x, y, geometry)
    force.setflags(write=False)
    return force


def _deviation(force: np.ndarray, better: np.ndarray) -> float:
    """Return the largest difference of two forces over the largest better force, each of shape (n, 2)."""
    return float(np.linalg.norm(force - better, axis=-1).max() / np.linalg.norm(better, axis=-1).max())


@cache
def _pair_series(geometry: MagnetGeometry) -> tuple[np.ndarray, float]:
    """Return the pair force's series and its quadrature error.

    Returns:
        Chebyshev series of ln(pair force) over (distance - R_b)/reach, and the largest last change of the quadrature.
    """
    nodes = np.cos(np.pi * (np.arange(_CHEBYSHEV_DEGREE + 1) + 0.5) / (_CHEBYSHEV_DEGREE + 1))
    forces, changes = [], []
    for node in nodes:
        distance = geometry.bearing_radius + geometry.reach * float(node)
        size, change = _NODE_LIMITS[0], np.inf
        force = pair_force(distance, geometry, nodes=size)
        # Only magnets with a very small gap need more than the first doubling.
        while change > _QUADRATURE_TOLERANCE and size < _NODE_LIMITS[1]:
            size *= 2
            finer = pair_force(distance, geometry, nodes=size)
            force, change = finer, abs(force / finer - 1.0)
        forces.append(force)
        changes.append(change)
    series = chebyshev.chebfit(nodes, np.log(forces), _CHEBYSHEV_DEGREE)
    series.setflags(write=False)
    return series, float(max(changes))
