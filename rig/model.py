"""The model: parameters resolved to the kernels' constants, the static equilibrium, and initial states."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from rig.errors import InputError
from rig.kernels.constants import Constants, Contact, House, Magnet, Shaft
from rig.kernels.signals import N_VECTOR
from rig.magnets import MagnetGeometry, RadialMap, fit_map
from rig.parameters import ParameterSet


def restitution_factor(restitution: float) -> float:
    """Damping factor c that returns the restitution asked for in a free impact, for any exponent of the normal law.

    Solves c (1+e) = ln[(1+c)/(1-c e)]; c = 0.1665 at e = 0.9. Follows from integrating dv/ddelta over one impact of
    F = K delta^n (1 + c delta'/v0).

    Raises:
        InputError: e is below 0.04, where the factor comes within rounding of its pole at 1/e, or above 1.
    """
    if not 0.04 <= restitution <= 1.0:
        raise InputError("contact.restitution", "from 0.04 to 1", restitution)
    if restitution == 1.0:
        return 0.0
    from scipy.optimize import brentq

    def residual(c: float) -> float:
        return c * (1.0 + restitution) - math.log((1.0 + c) / (1.0 - c * restitution))

    # c = 0 solves it as well; the wanted root lies between that and the pole at 1/e.
    root: Any = brentq(residual, 1e-9 + 0.5 * (1.0 - restitution), (1.0 - 1e-12) / restitution, xtol=1e-14)
    return float(root)


def contact_stiffness(parameters: ParameterSet, *, inside: bool) -> float:
    """K = 4/3 E* sqrt(R*) [N/m^1.5] of a sphere in a spherical seat (inside) or of two spheres (the Hertz formulas)."""
    compliance = sum(
        (1.0 - parameters[f"{body}.poisson_ratio"] ** 2) / parameters[f"{body}.young_modulus"]
        for body in ("shaft", "ring")
    )
    shaft = parameters["shaft.radius"]
    ring = shaft + parameters["ring.clearance"]
    reduced = ring * shaft / (ring - shaft) if inside else ring * shaft / (ring + shaft)
    return 4.0 / 3.0 / compliance * math.sqrt(reduced)


@dataclass(frozen=True)
class Model:
    """A rig ready to run.

    Attributes:
        parameters: Where its numbers come from.
        constants: What the kernels take.
        magnet_map: The fitted map with its error (its stiffness is that of eq. 35, `constants.magnet.stiffness` the
            one used).
        resolved: Numbers behind the parameters that are rules, in each parameter's unit.
        sag: Shaft at the ring in static equilibrium with the magnets on [m], vertical.
    """

    parameters: ParameterSet
    constants: Constants
    magnet_map: RadialMap
    resolved: dict[str, float]
    sag: float

    def state(self, *, ring_x: float | None = None, ring_y: float | None = None, spin: float = 0.0) -> np.ndarray:
        """A state at rest but for its spin, the houses at their rest.

        Args:
            ring_x: Shaft in the ring, horizontal, from the ring's centre [m]; None for the equilibrium on the magnets.
            ring_y: The same, vertical.
            spin: theta' [rad/s].

        Returns:
            Vector of state and integrals, shape (N_VECTOR,).

        Raises:
            InputError: The shaft is too short to reach there.
        """
        contact, arm = self.constants.contact, self.constants.shaft.arm_ring
        x = 0.0 if ring_x is None else ring_x + contact.offset_x
        y = self.sag if ring_y is None else ring_y + contact.offset_y
        if math.hypot(x, y) >= arm:
            raise InputError("shaft.arm_ring", f"above {math.hypot(x, y):g} m, to reach where it starts", arm)
        beta = math.asin(x / arm)
        gamma = math.asin(-y / (arm * math.cos(beta)))
        vector = np.zeros(N_VECTOR)
        vector[0], vector[1], vector[9] = gamma, beta, spin
        return vector


def build_model(parameters: ParameterSet) -> Model:
    """Resolve every rule, fit the magnet map, find the equilibrium."""
    p = parameters
    geometry = MagnetGeometry(
        number=round(p["magnet.count"]),
        length=p["magnet.length"],
        bearing_magnet_radius=p["magnet.bearing_magnet_radius"],
        shaft_magnet_radius=p["magnet.shaft_magnet_radius"],
        bearing_radius=p["magnet.bearing_radius"],
        magnetisation=p["magnet.magnetisation"],
    )
    if geometry.bearing_radius <= geometry.bearing_magnet_radius + geometry.shaft_magnet_radius:
        raise InputError(
            "magnet.bearing_radius", "above the sum of both magnets' radii", p.entries["magnet.bearing_radius"].value
        )
    radial = fit_map(geometry)
    resolved: dict[str, float] = {}

    stiffness = radial.stiffness if p.rule("magnet.stiffness") else p["magnet.stiffness"]
    mass = p["shaft.mass"]
    magnet = Magnet(
        stiffness=stiffness,
        a3=radial.a3,
        a5=radial.a5,
        a7=radial.a7,
        damping_x=2.0 * p["shaft.damping_ratio_x"] * math.sqrt(stiffness * mass),
        damping_y=2.0 * p["shaft.damping_ratio_y"] * math.sqrt(stiffness * mass),
    )
    shaft = Shaft(
        mass=mass,
        transverse_inertia=p["shaft.transverse_inertia"],
        polar_inertia=p["shaft.polar_inertia"],
        arm_ring=p["shaft.arm_ring"],
        arm_magnet=p["shaft.arm_magnet"],
        arm_centre=p["shaft.arm_centre"],
        arm_disk=p["shaft.arm_disk"],
        radius=p["shaft.radius"],
        unbalance=mass * p["shaft.unbalance_eccentricity"],
        unbalance_phase=p["shaft.unbalance_phase"],
        gravity=p["gravity.acceleration"],
    )
    sag = _sag(shaft, magnet)

    rule = p.rule("contact.stiffness")
    contact_k = contact_stiffness(p, inside=rule == "internal-sphere") if rule else p["contact.stiffness"]
    restitution = p["contact.restitution"]
    rule = p.rule("contact.damping_factor")
    if rule == "exact":
        factor = restitution_factor(restitution)
    elif rule == "lankarani-nikravesh":
        factor = 0.75 * (1.0 - restitution**2)
    else:
        factor = p["contact.damping_factor"]
    offset_y = sag if p.rule("ring.offset_y") else p["ring.offset_y"]
    contact = Contact(
        clearance=p["ring.clearance"],
        offset_x=p["ring.offset_x"],
        offset_y=offset_y,
        stiffness=contact_k,
        damping_factor=factor,
        friction=p["contact.friction"],
        smoothing_speed=p["contact.smoothing_speed"],
        speed_floor=p["contact.speed_floor"],
        gap_counts_outer=p["house.gap_counts_outer"],
    )
    house = House(
        inner_mass=p["house.inner_mass"],
        outer_mass=p["house.outer_mass"],
        inner_beam_stiffness=p["house.inner_beam_stiffness"],
        inner_beam_damping=p["house.inner_beam_damping"],
        outer_beam_stiffness=p["house.outer_beam_stiffness"],
        outer_beam_damping=p["house.outer_beam_damping"],
        pair_stiffness_vertical=p["house.pair_stiffness_vertical"],
        pair_stiffness_horizontal=p["house.pair_stiffness_horizontal"],
        preload=p["house.preload"],
    )
    for key, value, unit in (
        ("contact.stiffness", contact_k, 1.0),
        ("contact.damping_factor", factor, 1.0),
        ("ring.offset_y", offset_y, 1e-3),
        ("magnet.stiffness", stiffness, 1e3),
    ):
        if p.rule(key):
            resolved[key] = value / unit
    constants = Constants(shaft=shaft, magnet=magnet, contact=contact, house=house, torque_gain=p["drive.torque_gain"])
    return Model(parameters=p, constants=constants, magnet_map=radial, resolved=resolved, sag=sag)


def describe(model: Model) -> dict[str, Any]:
    """The parameters as a JSON document, rules beside the numbers they give."""
    document = model.parameters.document()
    for key, value in model.resolved.items():
        document["values"][key]["resolved"] = value
    document["derived"] = {
        "magnet_map_error": model.magnet_map.error,
        "magnet_stiffness_eq35_kn_m": model.magnet_map.stiffness * 1e-3,
        "sag_at_ring_mm": model.sag * 1e3,
    }
    return document


def _sag(shaft: Shaft, magnet: Magnet) -> float:
    """Height of the shaft at the ring at rest on the magnets [m], negative: torque balance about the pivot."""
    from scipy.optimize import brentq

    def torque(gamma: float) -> float:
        # Both forces are vertical and share the lever cos(Gamma), which drops out.
        r = shaft.arm_magnet * math.sin(gamma)
        s = r * r
        lift = magnet.stiffness * r * (1.0 + s * (magnet.a3 + s * (magnet.a5 + s * magnet.a7)))
        return shaft.arm_magnet * lift - shaft.arm_centre * shaft.mass * shaft.gravity

    if torque(0.02 / shaft.arm_magnet) < 0.0:
        raise InputError(
            "magnet.stiffness", "enough to carry the shaft within 20 mm of the magnets' centre", magnet.stiffness
        )
    root: Any = brentq(torque, 0.0, 0.02 / shaft.arm_magnet, xtol=1e-16)
    gamma = float(root)
    return -shaft.arm_ring * math.sin(gamma)
