"""Model of a rig: kernel constants resolved from parameters, the static equilibrium, and initial states."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from rig.base.errors import InputError
from rig.base.maths.roots import find_root
from rig.physics.contacts import ContactPair, ReferenceImpact, ResolvedLaw, resolve_law
from rig.physics.kernels.constants import Constants, Contact, House, Magnet, Shaft
from rig.physics.kernels.signals import N_VECTOR
from rig.physics.levels import ModelLevels
from rig.physics.magnets import (
    MagnetGeometry,
    MagnetMap,
    cylinder_stiffness,
    fit_cylinder_map,
    fit_map,
    linear_map,
    map_force,
    model_errors,
)
from rig.physics.parameters import ParameterSet


def contact_pair(parameters: ParameterSet) -> ContactPair:
    """Return the geometry and contact modulus of shaft and ring for the stiffness laws."""
    compliance = sum(
        (1.0 - parameters[f"{body}.poisson_ratio"] ** 2) / parameters[f"{body}.young_modulus"]
        for body in ("shaft", "ring")
    )
    return ContactPair(
        shaft_radius=parameters["shaft.radius"],
        clearance=parameters["ring.clearance"],
        width=parameters["ring.width"],
        modulus=1.0 / compliance,
    )


def reference_impact(parameters: ParameterSet) -> ReferenceImpact:
    """Return the reference impact: shaft mass at the ring against the inner housing, both free."""
    return ReferenceImpact(
        shaft_mass=parameters["shaft.transverse_inertia"] / parameters["shaft.arm_ring"] ** 2,
        house_mass=parameters["house.inner_mass"],
        speed=parameters["contact.reference_speed"],
    )


def normal_law(parameters: ParameterSet) -> ResolvedLaw:
    """Resolve the normal contact law's rules and numbers to K, n, c and D.

    Raises:
        InputError: A law does not apply to this rig, or two laws exclude each other.
    """
    p = parameters
    chosen = {
        field: p.rule(f"contact.{key}") or p[f"contact.{key}"]
        for field, key in (
            ("stiffness", "stiffness"),
            ("exponent", "exponent"),
            ("damping", "damping_factor"),
            ("viscous", "viscous_damping"),
        )
    }
    return resolve_law(**chosen, restitution=p["contact.restitution"], pair=contact_pair(p), impact=reference_impact(p))


@dataclass(frozen=True)
class Model:
    """Rig model that is ready to run.

    Attributes:
        parameters: Source of all numbers.
        constants: Constants of the kernels.
        magnets: Geometry of the magnets that the map was fitted to.
        magnet_map: Map of the selected level, with its error against the fitted model. Its stiffness is the fitted
            model's; a run uses `constants.magnet.stiffness`.
        travel: Largest distance of the shaft from the magnets' centre inside a ring at rest [m].
        resolved: Values of the parameters that are given by rules, in each parameter's unit.
        sag: Vertical position of the shaft at the ring in static equilibrium on the magnets [m].
    """

    parameters: ParameterSet
    constants: Constants
    magnets: MagnetGeometry
    magnet_map: MagnetMap
    travel: float
    resolved: dict[str, float]
    sag: float

    def state(
        self,
        *,
        ring_x: float | None = None,
        ring_y: float | None = None,
        velocity: tuple[float, float] = (0.0, 0.0),
        spin: float = 0.0,
        angle: float = 0.0,
    ) -> np.ndarray:
        """Return a state of the shaft, with the housings at rest.

        Args:
            ring_x: Horizontal position of the shaft from the ring's centre [m]; None for the equilibrium on the
                magnets.
            ring_y: Vertical position, as `ring_x`.
            velocity: Horizontal and vertical velocity of the shaft centre at the ring [m/s].
            spin: theta' [rad/s].
            angle: theta [rad].

        Returns:
            State and integrals, shape (N_VECTOR,).

        Raises:
            InputError: The position is beyond the shaft's length.
        """
        contact, arm = self.constants.contact, self.constants.shaft.arm_ring
        x = 0.0 if ring_x is None else ring_x + contact.offset_x
        y = self.sag if ring_y is None else ring_y + contact.offset_y
        if math.hypot(x, y) >= arm:
            raise InputError("shaft.arm_ring", f"above {math.hypot(x, y):g} m, to reach the start position", arm)
        beta, gamma = x / arm, -y / arm
        if self.constants.levels.euler:
            beta = math.asin(x / arm)
            gamma = math.asin(-y / (arm * math.cos(beta)))
        vector = np.zeros(N_VECTOR)
        vector[:3] = gamma, beta, angle
        level = self.constants.levels.euler
        sG, cG, sb, cb = np.sin(gamma), np.cos(gamma), np.sin(beta), np.cos(beta)
        beta_rate = velocity[0] / arm / (cb if level else 1.0)
        vector[7:10] = -(velocity[1] / arm - level * sG * sb * beta_rate) / (cG * cb if level else 1.0), beta_rate, spin
        return vector


def magnet_geometry(parameters: ParameterSet) -> MagnetGeometry:
    """Return the magnets of a parameter set.

    Raises:
        InputError: The magnets overlap.
    """
    p = parameters
    geometry = MagnetGeometry(
        number=round(p["magnet.count"]),
        length=p["magnet.length"],
        bearing_magnet_radius=p["magnet.bearing_magnet_radius"],
        shaft_magnet_radius=p["magnet.shaft_magnet_radius"],
        bearing_radius=p["magnet.bearing_radius"],
        magnetisation=p["magnet.magnetisation"],
    )
    if geometry.gap <= 0.0:
        raise InputError(
            "magnet.bearing_radius", "above the sum of both magnets' radii", p.entries["magnet.bearing_radius"].value
        )
    most = int(math.pi / math.asin(geometry.bearing_magnet_radius / geometry.bearing_radius))
    if geometry.number > most:
        raise InputError("magnet.count", f"at most {most}, or the magnets would overlap", geometry.number)
    return geometry


def build_model(parameters: ParameterSet, levels: ModelLevels | None = None) -> Model:
    """Resolve every rule, fit the magnet map, and find the static equilibrium.

    Args:
        parameters: Parameter set.
        levels: Model levels; None for the full model.
    """
    levels = levels or ModelLevels()
    p = parameters
    geometry = magnet_geometry(p)
    magnet_map = _MAPS[levels.magnet](geometry)
    resolved: dict[str, float] = {}

    rule = p.rule("magnet.stiffness")
    if rule == "eq35":
        stiffness = fit_map(geometry).stiffness
    elif rule == "cylinders":
        stiffness = cylinder_stiffness(geometry)
    else:
        stiffness = p["magnet.stiffness"]
    mass = p["shaft.mass"]
    magnet = Magnet(
        terms=magnet_map.terms,
        stiffness=stiffness,
        a3=magnet_map.a3,
        a5=magnet_map.a5,
        a7=magnet_map.a7,
        ripple=magnet_map.ripple,
        growth=magnet_map.growth,
        number=magnet_map.number,
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

    law = normal_law(p).law
    offset_y = sag if p.rule("ring.offset_y") else p["ring.offset_y"]
    contact = Contact(
        clearance=p["ring.clearance"],
        offset_x=p["ring.offset_x"],
        offset_y=offset_y,
        stiffness=law.stiffness,
        exponent=law.exponent,
        damping_factor=law.damping_factor,
        viscous_damping=law.viscous_damping,
        restitution=p["contact.restitution"],
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
        ("contact.stiffness", law.stiffness, 1.0),
        ("contact.exponent", law.exponent, 1.0),
        ("contact.damping_factor", law.damping_factor, 1.0),
        ("contact.viscous_damping", law.viscous_damping, 1.0),
        ("ring.offset_y", offset_y, 1e-3),
        ("magnet.stiffness", stiffness, 1e3),
    ):
        if p.rule(key):
            resolved[key] = value / unit
    constants = Constants(
        levels=levels.constants(),
        shaft=shaft,
        magnet=magnet,
        contact=contact,
        house=house,
        torque_gain=p["drive.torque_gain"],
    )
    return Model(
        parameters=p,
        constants=constants,
        magnets=geometry,
        magnet_map=magnet_map,
        travel=(math.hypot(contact.offset_x, contact.offset_y) + contact.clearance) * shaft.arm_magnet / shaft.arm_ring,
        resolved=resolved,
        sag=sag,
    )


def describe(model: Model) -> dict[str, Any]:
    """Return the parameters as a JSON document, with the resolved value of each rule."""
    document = model.parameters.document()
    for key, value in model.resolved.items():
        document["values"][key]["resolved"] = value
    document["derived"] = {
        "magnet_map_error": model.magnet_map.error,
        "magnet_stiffness_eq35_kn_m": fit_map(model.magnets).stiffness * 1e-3,
        "magnet_stiffness_cylinders_kn_m": cylinder_stiffness(model.magnets) * 1e-3,
        "magnet_reach_mm": model.magnets.reach * 1e3,
        "magnet_travel_mm": model.travel * 1e3,
        "magnet_errors": [error._asdict() for error in model_errors(model.magnets, model.travel)],
        "sag_at_ring_mm": model.sag * 1e3,
        "contact_fit_error": normal_law(model.parameters).fit_error,
    }
    return document


_MAPS = {"linear": linear_map, "map": fit_map, "cylinders": fit_cylinder_map}
"""Fit of the magnet map by level."""


@lru_cache(maxsize=64)  # most parameters do not change it
def _sag(shaft: Shaft, magnet: Magnet) -> float:
    """Return the height of the shaft at the ring at rest on the magnets [m], negative, by torque balance."""

    def torque(gamma: float) -> float:
        # Both forces are vertical, as one magnet is straight below; their common lever cos(Gamma) cancels.
        depth = np.array([-shaft.arm_magnet * math.sin(gamma)])
        lift = float(map_force(np.zeros(1), depth, magnet)[0, 1])
        return shaft.arm_magnet * lift - shaft.arm_centre * shaft.mass * shaft.gravity

    deepest = 0.02 / shaft.arm_magnet
    if torque(deepest) < 0.0:
        raise InputError(
            "magnet.stiffness", "enough to carry the shaft within 20 mm of the magnets' centre", magnet.stiffness
        )
    return -shaft.arm_ring * math.sin(find_root(torque, 0.0, deepest, within=1e-16))
