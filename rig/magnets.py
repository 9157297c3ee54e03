"""The paper's magnet model (eqs. 26-38), and the radial map that the kernels use instead.

Every magnet is a dipole loop of current M0 L (eq. 35); the force on the shaft magnet sums I dl x B around its own
loop (eq. 38). All loops lie in one plane and repel. Unvalidated at this spacing: the far-field form overstates the
force of real cylinders several times, which is why `magnet.stiffness` sets the scale of the map by itself and the sum
gives only its shape.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

MU_0 = 4e-7 * np.pi
"""Permeability of vacuum, Table 1 [T m/A]."""
REACH = 0.010
"""The map is fitted over this radius [m], the axes of Fig. 7."""


class MagnetGeometry(NamedTuple):
    """The magnets of Table 1, SI."""

    number: int
    length: float
    bearing_magnet_radius: float
    shaft_magnet_radius: float
    bearing_radius: float
    magnetisation: float


class RadialMap(NamedTuple):
    """F = -stiffness (r + a3 r^3 + a5 r^5 + a7 r^7), and how well it follows the sum it was fitted to."""

    stiffness: float
    a3: float
    a5: float
    a7: float
    error: float
    """Largest deviation over the reach in any direction, as a fraction of the largest force."""


def field_sum_force(x: np.ndarray, y: np.ndarray, geometry: MagnetGeometry, *, points: int = 180) -> np.ndarray:
    """Force on the shaft magnet by eqs. 35 and 38.

    Args:
        x: Displacement of the shaft magnet, horizontal [m], shape (n,).
        y: The same, vertical [m], shape (n,).
        geometry: The magnets.
        points: Points on the shaft magnet's loop.

    Returns:
        Force [N], shape (n, 2).
    """
    current = geometry.magnetisation * geometry.length
    around = 2.0 * np.pi * np.arange(points) / points
    outward = np.stack([np.cos(around), np.sin(around)], axis=-1)
    loop = np.stack([x, y], axis=-1)[:, None, :] + geometry.shaft_magnet_radius * outward
    place = 2.0 * np.pi * np.arange(geometry.number) / geometry.number
    centres = geometry.bearing_radius * np.stack([np.cos(place), np.sin(place)], axis=-1)
    distance = np.linalg.norm(loop[:, :, None, :] - centres, axis=-1)
    # Eq. 35 in the plane of the loops (psi = 90 deg): the field of a dipole that points along +z is along -z beside it.
    field = -MU_0 * current * geometry.bearing_magnet_radius**2 / (4.0 * distance**3)
    # dl x B with B = B z and dl = r_s dphi (-sin, cos) is r_s dphi B (cos, sin).
    # That points inward where the field opposes: the magnets repel.
    width = geometry.shaft_magnet_radius * 2.0 * np.pi / points
    return current * width * np.einsum("npm,pk->nk", field, outward)


def fit_map(geometry: MagnetGeometry) -> RadialMap:
    """Fit the radial map to the field sum, by least squares over the reach and all directions between two magnets."""
    radius = np.linspace(REACH / 40, REACH, 40)
    angle = np.linspace(0.0, np.pi / geometry.number, 9)
    r, a = (grid.ravel() for grid in np.meshgrid(radius, angle))
    force = field_sum_force(r * np.cos(a), r * np.sin(a), geometry)
    radial = force[:, 0] * np.cos(a) + force[:, 1] * np.sin(a)
    scaled = r / REACH
    powers = np.stack([scaled, scaled**3, scaled**5, scaled**7], axis=-1)
    linear, cubic, quintic, septic = np.linalg.lstsq(powers, -radial, rcond=None)[0]
    fitted = -(powers @ np.array([linear, cubic, quintic, septic]))
    sideways = -force[:, 0] * np.sin(a) + force[:, 1] * np.cos(a)
    error = np.max(np.hypot(radial - fitted, sideways)) / np.max(np.abs(radial))
    return RadialMap(
        stiffness=float(linear / REACH),
        a3=float(cubic / linear / REACH**2),
        a5=float(quintic / linear / REACH**4),
        a7=float(septic / linear / REACH**6),
        error=float(error),
    )
