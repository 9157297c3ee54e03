"""Normal contact laws, each resolved to the four numbers of the kernels.

F_n = K delta^n (1 + c delta'/v0) + D delta', clamped at 0 (`rig.physics.kernels.laws.contact.normal_force`). A
stiffness law gives K and n; a damping law gives c, or D for the law without memory. Stiffness laws other than powers of
delta are fitted over the rig's working range, and the fit reports its error.

A user-defined law is a formula in place of a law's name: c as a function of the restitution `e`, or the elastic force
[N] as a function of the penetration `delta` [m], with `R_S`, `r0`, `L` and `E` of `ContactPair` [m, Pa].

None of the laws is validated on this rig. The sphere laws treat shaft and ring as spheres. The cylinder laws treat them
as parallel cylinders in contact over the ring's whole width, although this shaft tilts by up to r0 / l0A. Two cylinder
laws are excluded: Goldsmith's, whose logarithm has a unit, and Radzimovsky's, as sources disagree on whether it
contains the contact's full or half width.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from rig.base.errors import InputError, Words
from rig.base.maths.expression import Grammar, value_of
from rig.base.maths.roots import find_root
from rig.base.text import printable
from rig.physics.parameters import load_parameters

WORKING_FORCES = (5.0, 3000.0)
"""Range of contact forces in the rig's scenes [N], over which other laws are fitted by a power of delta."""
LAW = "law"
"""Rule of exponent and viscous damping: the value of the selected laws."""
KELVIN_VOIGT = "kelvin-voigt"
_MIN_LOSS = 1e-4
"""Loss or factor below which the series replaces the restitution equation, which rounding dominates."""


class NormalLaw(NamedTuple):
    """F_n = K delta^n (1 + c delta'/v0) + D delta', clamped at 0."""

    stiffness: float  # K [N/m^n]
    exponent: float  # n [1]
    damping_factor: float  # c [1]
    viscous_damping: float  # D [N s/m]


class ContactPair(NamedTuple):
    """Shaft in its ring, as input of the stiffness laws."""

    shaft_radius: float  # R_S [m]
    clearance: float  # r0 [m]
    width: float  # L, axial length of the ring [m]
    modulus: float  # E* [Pa], 1/E* = (1-nu_S^2)/E_S + (1-nu_B^2)/E_B

    @property
    def ring_radius(self) -> float:
        """R_S + r0 [m]."""
        return self.shaft_radius + self.clearance


class ReferenceImpact(NamedTuple):
    """Free impact in which Kelvin-Voigt damping, and a changed exponent, are matched to the other laws."""

    shaft_mass: float  # Ixx / l0A^2 [kg]
    house_mass: float  # M_ih, free [kg]
    speed: float  # approach speed [m/s]

    @property
    def mass(self) -> float:
        """Reduced mass of the two [kg]."""
        return self.shaft_mass * self.house_mass / (self.shaft_mass + self.house_mass)


@dataclass(frozen=True)
class DampingLaw:
    """Damping law: c, or D, as a function of the required restitution e.

    Attributes:
        formula: Formula in the paper's symbols.
        source: Publication.
        factor: c as a function of e; None for Kelvin-Voigt, which has D instead.
    """

    formula: str
    source: str
    factor: Callable[[float], float] | None


class PowerFit(NamedTuple):
    """Power law K delta^n that represents a stiffness law."""

    stiffness: float  # K [N/m^n]
    exponent: float  # n [1]
    error: float  # largest relative error of the force over the range; 0 for a law that is a power itself
    low: float  # smallest penetration of the range [m]
    high: float  # largest [m]


@dataclass(frozen=True)
class StiffnessLaw:
    """Stiffness law: elastic force as a function of penetration.

    Attributes:
        formula: Formula in the paper's symbols; P = F/L is the force per width of the ring.
        source: Publication.
        valid: Assumptions.
        power: K [N/m^n] and n, for a power of delta.
        penetration: delta(F) [m], for other laws.
        elastic_force: F(delta) [N], for a user's formula.
    """

    formula: str
    source: str
    valid: str
    power: Callable[[ContactPair], tuple[float, float]] | None = None
    penetration: Callable[[float, ContactPair], float] | None = None
    elastic_force: Callable[[float, ContactPair], float] | None = None

    def depth(self, force: float, pair: ContactPair) -> float:
        """Return delta(F) [m] of the law itself, without its fit."""
        if self.penetration is not None:
            return self.penetration(force, pair)
        assert self.power is not None
        stiffness, exponent = self.power(pair)
        return (force / stiffness) ** (1.0 / exponent)

    def force(self, penetration: float, pair: ContactPair) -> float:
        """Return F(delta) [N] of the law itself, without its fit; nan beyond the penetration where the law fails."""
        if self.elastic_force is not None:
            return self.elastic_force(penetration, pair)
        if self.power is not None:
            stiffness, exponent = self.power(pair)
            return stiffness * penetration**exponent
        high = 1e-3
        while (depth := self.depth(high, pair)) < penetration:
            # The logarithms decrease above forces that no line contact can carry.
            if self.depth(2.0 * high, pair) <= depth:
                return math.nan
            high *= 2.0
        return find_root(lambda force: self.depth(force, pair) - penetration, 1e-9 * high, high, within=1e-12)


def restitution_factor(restitution: float) -> float:
    """Return the damping factor c that gives a restitution in a free impact, for any exponent.

    Solves c (1+e) = ln[(1+c)/(1-c e)]; c = 0.1665 at e = 0.9. The equation follows from integrating dv/ddelta over one
    impact of F = K delta^n (1 + c delta'/v0).

    Raises:
        InputError: e is below 0.04, where the factor is within rounding of its pole at 1/e, or above 1.

    Example:
        >>> round(restitution_factor(0.9), 4)
        0.1665
    """
    if not 0.04 <= restitution <= 1.0:
        raise InputError("contact.restitution", "from 0.04 to 1", restitution)
    loss = 1.0 - restitution
    if loss < _MIN_LOSS:
        return 1.5 * loss * (1.0 + loss)

    def residual(c: float) -> float:
        return c * (1.0 + restitution) - math.log1p(c) + math.log1p(-c * restitution)

    # The root lies between c = 0, which also solves the equation, and the pole at 1/e.
    return find_root(residual, loss, (1.0 - 1e-12) / restitution, within=1e-15)


def returned_restitution(factor: float) -> float:
    """Return the restitution e of F = K delta^n (1 + c delta'/v0) in a free impact, for any K, n, mass and speed.

    Solves the equation of `restitution_factor` for e. For an impact slower than the floor of v0, c v/floor replaces c.

    Args:
        factor: c [1], from 0.

    Example:
        >>> round(returned_restitution(restitution_factor(0.9)), 12)
        0.9
    """
    if factor < _MIN_LOSS:
        return 1.0 - 2.0 / 3.0 * factor * (1.0 - 2.0 / 3.0 * factor)

    def residual(e: float) -> float:
        return factor * (1.0 + e) - math.log1p(factor) + math.log1p(-factor * e)

    high = min(1.0, 1.0 / factor) * (1.0 - 1e-15)
    if residual(high) > 0.0:  # e equals 1/c to the last digit
        return high
    return find_root(residual, 0.0, high, within=1e-15)


def linear_damping_ratio(restitution: float) -> float:
    """Return the damping ratio of F = K delta + D delta', clamped at 0, that gives a restitution.

    The contact ends when the force, not the penetration, falls to 0. With zeta = cos(a) this is at the phase 2 a, so ln
    e = -2 a / tan(a). Below e = exp(-2) the contact is over-damped, with cosh and tanh. Schwager & Poeschel, Granular
    Matter 9 (2007) 465. The usual -ln e / sqrt(pi^2 + ln^2 e) applies to a contact that may pull.

    Args:
        restitution: e, above 0 and up to 1.

    Example:
        >>> round(linear_damping_ratio(0.9), 5)
        0.03427
    """
    if restitution == 1.0:
        return 0.0
    loss = -math.log(restitution)
    if loss < 2.0:
        root = find_root(lambda a: 2.0 * a / math.tan(a) - loss, 1e-9, 0.5 * math.pi, within=1e-15)
        return math.cos(root)
    if loss == 2.0:
        return 1.0
    root = find_root(lambda a: 2.0 * a / math.tanh(a) - loss, 1e-9, loss, within=1e-15)
    return math.cosh(root)


DAMPING: dict[str, DampingLaw] = {
    "exact": DampingLaw(
        "c (1+e) = ln[(1+c)/(1-c e)]",
        "one free impact integrated; Gonthier et al.'s implicit form, d = c e, is the same",
        restitution_factor,
    ),
    "none": DampingLaw("c = 0", "Hertz 1881, elastic", lambda e: 0.0),
    "hunt-crossley": DampingLaw(
        "3 (1-e) / 2", "Hunt & Crossley, J. Appl. Mech. 42 (1975) 440", lambda e: 1.5 * (1.0 - e)
    ),
    "herbert-mcwhannell": DampingLaw(
        "6 (1-e) / [(2e-1)^2 + 3]",
        "Herbert & McWhannell, J. Eng. Ind. 99 (1977) 794",
        lambda e: 6.0 * (1.0 - e) / ((2.0 * e - 1.0) ** 2 + 3.0),
    ),
    "lee-wang": DampingLaw(
        "3 (1-e) / 4", "Lee & Wang, J. Mech. Transm. Autom. Des. 105 (1983) 534", lambda e: 0.75 * (1.0 - e)
    ),
    "lankarani-nikravesh": DampingLaw(
        "3 (1-e^2) / 4",
        "Lankarani & Nikravesh, J. Mech. Des. 112 (1990) 369; the paper's eq. 44",
        lambda e: 0.75 * (1.0 - e**2),
    ),
    "gonthier": DampingLaw(
        "(1-e^2) / e",
        "Gonthier et al., Multibody Syst. Dyn. 11 (2004) 209, their closed approximation d = 1-e^2 with c = d/e",
        lambda e: (1.0 - e**2) / e,
    ),
    "zhiying-qishao": DampingLaw(
        "3 (1-e^2) exp[2 (1-e)] / 4",
        "Zhiying & Qishao, J. Dyn. Control 4 (2006) 294",
        lambda e: 0.75 * (1.0 - e**2) * math.exp(2.0 * (1.0 - e)),
    ),
    "flores": DampingLaw(
        "8 (1-e) / (5e)", "Flores et al., Multibody Syst. Dyn. 25 (2011) 357", lambda e: 1.6 * (1.0 - e) / e
    ),
    "hu-guo": DampingLaw(
        "3 (1-e) / (2e)", "Hu & Guo, Multibody Syst. Dyn. 35 (2015) 145", lambda e: 1.5 * (1.0 - e) / e
    ),
    KELVIN_VOIGT: DampingLaw(
        "c = 0, n = 1, D = 2 zeta sqrt(K m), ln e = -2 a / tan(a), zeta = cos(a)",
        "Schwager & Poeschel, Granular Matter 9 (2007) 465, clamp included; K keeps the stiffness law's "
        "penetration in the reference impact",
        None,
    ),
}
"""Damping laws by their name in `contact.damping_factor`."""


def _internal_sphere(pair: ContactPair) -> tuple[float, float]:
    reduced = pair.ring_radius * pair.shaft_radius / pair.clearance
    return 4.0 / 3.0 * pair.modulus * math.sqrt(reduced), 1.5


def _external_sphere(pair: ContactPair) -> tuple[float, float]:
    reduced = pair.ring_radius * pair.shaft_radius / (pair.ring_radius + pair.shaft_radius)
    return 4.0 / 3.0 * pair.modulus * math.sqrt(reduced), 1.5


def _johnson(force: float, pair: ContactPair) -> float:
    line = force / (math.pi * pair.modulus * pair.width)
    return line * (math.log(4.0 * pair.clearance / line) - 1.0)


def _esdu(force: float, pair: ContactPair) -> float:
    line = force / (math.pi * pair.modulus * pair.width)
    return line * (math.log(4.0 * pair.clearance / line) + 1.0)


def _dubowsky(force: float, pair: ContactPair) -> float:
    line = force / (math.pi * pair.modulus * pair.width)
    shape = pair.width**2 * pair.clearance / (pair.ring_radius * pair.shaft_radius)
    return line * (math.log(shape / line) + 1.0)


def _palmgren(pair: ContactPair) -> tuple[float, float]:
    return (1.36 / pair.modulus**0.9 / pair.width**0.8) ** (-10.0 / 9.0), 10.0 / 9.0


def _pereira(pair: ContactPair) -> tuple[float, float]:
    clearance = pair.clearance * 1e3
    if not 0.005 <= clearance <= 10.0:
        raise InputError("ring.clearance", "from 0.005 to 10 mm with the stiffness pereira-cylinder", clearance)
    shape = 1.51 * math.log(1000.0 * clearance) ** -0.151 if clearance < 0.34954 else 0.0151 * clearance + 1.151
    exponent = shape * clearance**-0.005
    # The paper has N, mm and MPa.
    stiffness = (0.965 * clearance + 0.0965) * (pair.width * 1e3) * (pair.modulus * 1e-6) / clearance
    return stiffness * 1e3**exponent, exponent


def _liu(force: float, pair: ContactPair) -> float:
    def residual(depth: float) -> float:
        share = depth / (2.0 * (pair.clearance + depth))
        return 0.5 * math.pi * pair.modulus * pair.width * depth * math.sqrt(share) - force

    return find_root(residual, 0.0, 10.0 * pair.ring_radius, within=1e-16)


_PARALLEL = "half-space, parallel axes, contact much narrower than R_S"
STIFFNESS: dict[str, StiffnessLaw] = {
    "internal-sphere": StiffnessLaw(
        "F = 4/3 E* sqrt(R*) delta^1.5, 1/R* = 1/R_S - 1/(R_S + r0)",
        "Hertz 1881",
        "half-space, point contact, frictionless; approximates shaft and ring by spheres",
        power=_internal_sphere,
    ),
    "external-sphere": StiffnessLaw(
        "F = 4/3 E* sqrt(R*) delta^1.5, 1/R* = 1/R_S + 1/(R_S + r0)",
        "Hertz 1881; a later code of the same laboratory",
        "as internal-sphere, for a shaft outside its ring",
        power=_external_sphere,
    ),
    "johnson-cylinder": StiffnessLaw(
        "delta = P / (pi E*) [ln(4 pi E* r0 / P) - 1]",
        "Johnson, Contact Mechanics (1985), section 5.6, both bodies; in this form Pereira et al. (2011)",
        f"{_PARALLEL}; P below 4 pi E* r0 / e^2",
        penetration=_johnson,
    ),
    "esdu-cylinder": StiffnessLaw(
        "delta = P / (pi E*) [ln(4 pi E* r0 / P) + 1]",
        "ESDU 78035 (1978), as reviewed by Flores et al. and Pereira et al. (2011), sigma = (1-nu^2) / (pi E)",
        _PARALLEL,
        penetration=_esdu,
    ),
    "dubowsky-freudenstein-cylinder": StiffnessLaw(
        "delta = P / (pi E*) {ln[pi E* L^2 r0 / (P R_S (R_S + r0))] + 1}",
        "Dubowsky & Freudenstein, J. Eng. Ind. 93 (1971) 305, sigma = (1-nu^2) / (pi E), exponent 3 of L",
        f"{_PARALLEL}; a datum at the distance L, unlike Johnson's at the axes",
        penetration=_dubowsky,
    ),
    "palmgren-cylinder": StiffnessLaw(
        "delta = 1.36 F^0.9 / (E*^0.9 L^0.8)",
        "Palmgren 1959, as in Harris, Rolling Bearing Analysis",
        "crowned steel rollers on raceways, measured; knows no clearance",
        power=_palmgren,
    ),
    "pereira-cylinder": StiffnessLaw(
        "F = (0.965 r0 + 0.0965) L E* / r0 delta^n in N, mm, MPa, n = (0.0151 r0 + 1.151) r0^-0.005 (r0 > 0.35 mm)",
        "Pereira, Ramalho & Ambrosio, Multibody Syst. Dyn. 35 (2015) 277, inside; fitted by them to Johnson",
        f"r0 from 0.005 to 10 mm; {_PARALLEL}",
        power=_pereira,
    ),
    "liu-cylinder": StiffnessLaw(
        "F = pi/2 E* L delta sqrt{delta / [2 (r0 + delta)]}",
        "Liu, Zhang & Yang, Mech. Mach. Theory 42 (2007) 183",
        "foundation model checked by finite elements for close fits; far softer than half-space theory here",
        penetration=_liu,
    ),
}
"""Stiffness laws by their name in `contact.stiffness`."""


_PENETRATIONS_M = (1e-7, 1e-2)
"""Range of penetrations [m] in which a formula must reach the largest working force. A numeric stiffness has the same
limit: 1e14 N/m^1.5 reaches 3 kN at 1e-7 m."""
_MAX_FIT_ERROR = 0.25
"""Largest relative error of the power fitted to a formula; a larger error would represent another law."""
_FIT_ROUNDING = 1e-8
"""Fit error below which it is rounding of the root finder, and the law is the power itself."""


def _limits(key: str) -> tuple[float, float]:
    """Return the limits of a contact law's parameter in the default set; they apply to formulas as well."""
    return load_parameters().entries[key].range


def damping_law(name: str) -> DampingLaw:
    """Return a damping law by its name or its formula of c.

    Raises:
        InputError: The text is not a formula of e.
    """
    field = "contact.damping_factor"
    if name in DAMPING:
        return DAMPING[name]
    formula = Grammar(("e",)).read(name, field)

    def factor(restitution: float) -> float:
        c = value_of(formula, e=restitution)
        low, high = _limits(field)
        if not low <= c <= high:
            raise InputError(field, f"from {low:g} to {high:g} at e = {restitution:g}", f"{name} = {c:g}")
        return c

    return DampingLaw(name, "given as a formula", factor)


def stiffness_law(name: str) -> StiffnessLaw:
    """Return a stiffness law by its name or its formula of the force.

    Raises:
        InputError: The text is not a formula of the penetration and the contact pair.
    """
    field = "contact.stiffness"
    if name in STIFFNESS:
        return STIFFNESS[name]
    formula = Grammar(("delta", "R_S", "r0", "L", "E")).read(name, field)

    def elastic_force(depth: float, pair: ContactPair) -> float:
        sizes = {"R_S": pair.shaft_radius, "r0": pair.clearance, "L": pair.width, "E": pair.modulus}
        return value_of(formula, delta=depth, **sizes)

    def penetration(force: float, pair: ContactPair) -> float:
        def missing(depth: float) -> float:
            return elastic_force(depth, pair) - float(force)

        if missing(0.0) < 0.0 < missing(_PENETRATIONS_M[1]):
            with contextlib.suppress(ValueError):  # the formula has no value at a penetration within the range
                return find_root(missing, 0.0, _PENETRATIONS_M[1], within=1e-22)
        must = f"a force that passes {force:g} N between penetrations of 0 and {_PENETRATIONS_M[1] * 1e3:g} mm"
        raise InputError(field, must, name)

    return StiffnessLaw(name, "given as a formula", "its author's assumptions", None, penetration, elastic_force)


@lru_cache(maxsize=64)  # a comparison of laws repeats the same fit many times
def fit_power(name: str, pair: ContactPair) -> PowerFit:
    """Fit K delta^n to a stiffness law over `WORKING_FORCES`, with the smallest maximum relative error.

    log F as a function of log delta is convex or concave, so the best line has the chord's slope and lies half-way to
    the largest deviation.

    Raises:
        InputError: The law does not apply to this pair.

    Example:
        >>> pair = ContactPair(shaft_radius=0.0125, clearance=0.9e-3, width=0.011, modulus=1e11)
        >>> fit = fit_power("johnson-cylinder", pair)
        >>> f"F = {fit.stiffness:.2e} delta^{fit.exponent:.2f}, to {100.0 * fit.error:.0f} %"
        'F = 1.69e+09 delta^1.11, to 3 %'
    """
    law = stiffness_law(name)
    low, high = WORKING_FORCES
    if law.power is not None:
        stiffness, exponent = law.power(pair)
        return PowerFit(stiffness, exponent, 0.0, law.depth(low, pair), law.depth(high, pair))
    forces = np.geomspace(low, high, 200)
    depths = np.array([law.depth(force, pair) for force in forces])
    if depths[0] <= 0.0 or np.any(np.diff(depths) <= 0.0):
        raise InputError("contact.stiffness", f"another law: with this ring, {name} fails below {high:g} N", name)
    x, y = np.log(depths), np.log(forces)
    slope = (y[-1] - y[0]) / (x[-1] - x[0])
    if law.elastic_force is not None and abs(slope - round(slope, 6)) < _FIT_ROUNDING:
        # Rounding must not give an n just below 1, where the stiffness at delta = 0 is infinite.
        slope = round(slope, 6)
    rest = y - slope * x
    error = float(np.expm1(0.5 * (rest.max() - rest.min())))
    fit = PowerFit(
        stiffness=float(np.exp(0.5 * (rest.max() + rest.min()))),
        exponent=float(slope),
        error=error if error > _FIT_ROUNDING else 0.0,
        low=float(depths[0]),
        high=float(depths[-1]),
    )
    if law.elastic_force is not None:
        _check_formula_fit(name, law, fit, pair)
    return fit


def _check_formula_fit(name: str, law: StiffnessLaw, fit: PowerFit, pair: ContactPair) -> None:
    """Raise an InputError where K delta^n does not represent a formula's force."""
    field, (low, high) = "contact.stiffness", WORKING_FORCES
    forces = np.array([law.force(depth, pair) for depth in np.geomspace(fit.low, fit.high, 200)])
    if not np.all(np.diff(forces) > 0.0):  # a nan fails as well
        raise InputError(field, f"a force that increases with delta from {low:g} N to {high:g} N", name)
    if fit.high < _PENETRATIONS_M[0]:
        must = f"a force that reaches {high:g} N at a penetration of at least {_PENETRATIONS_M[0] * 1e6:g} µm"
        raise InputError(field, must, Words(f"{printable(name, 80)}, which reaches it at {fit.high * 1e6:.2g} µm"))
    least, most = _limits("contact.exponent")
    if not (least <= fit.exponent <= most and fit.error <= _MAX_FIT_ERROR):
        must = (
            f"a force that K delta^n follows within {_MAX_FIT_ERROR:.0%} from {low:g} N to {high:g} N, "
            f"with n from {least:g} to {most:g}"
        )
        raise InputError(
            field, must, Words(f"{printable(name, 80)}: within {fit.error:.0%}, with n = {fit.exponent:.3g}")
        )


class ResolvedLaw(NamedTuple):
    """Resolved normal law, and its error against the selected stiffness law."""

    law: NormalLaw
    fit_error: float | None
    """Largest relative error of the elastic force over `WORKING_FORCES`; None where a changed exponent keeps only the
    penetration of the reference impact."""


def resolve_law(
    *,
    stiffness: float | str,
    exponent: float | str,
    damping: float | str,
    viscous: float | str,
    restitution: float,
    pair: ContactPair,
    impact: ReferenceImpact,
) -> ResolvedLaw:
    """Return K, n, c and D.

    Args:
        stiffness: K [N/m^n], the name of a stiffness law, or a formula of the force.
        exponent: n, or `LAW`: 1 for Kelvin-Voigt, else the stiffness law's own, else 1.5.
        damping: c, the name of a damping law, or a formula of c.
        viscous: D [N s/m], or `LAW`: Kelvin-Voigt's, else 0.
        restitution: Required restitution e.
        pair: Shaft and ring.
        impact: Impact in which Kelvin-Voigt gives e, and in which a changed exponent keeps the penetration.

    Raises:
        InputError: A law does not apply, or two laws exclude each other.
    """
    linear = damping == KELVIN_VOIGT
    if linear and exponent not in (LAW, 1.0):
        raise InputError("contact.exponent", f"1 or {LAW} with {KELVIN_VOIGT} damping", exponent)
    error: float | None = 0.0
    if isinstance(stiffness, str):
        fit = fit_power(stiffness, pair)
        k, n, error = fit.stiffness, fit.exponent, fit.error
        wanted = n if exponent == LAW else float(exponent)
        wanted = 1.0 if linear else wanted
        if wanted != n:
            k, n, error = match_depth(k, n, wanted, impact), wanted, None
    else:
        k = stiffness
        n = (1.0 if linear else 1.5) if exponent == LAW else float(exponent)
    d = 0.0
    if isinstance(damping, str):
        factor = damping_law(damping).factor
        c = 0.0 if factor is None else factor(restitution)
        if factor is None:
            d = 2.0 * linear_damping_ratio(restitution) * math.sqrt(k * impact.mass)
    else:
        c = damping
    return ResolvedLaw(NormalLaw(k, n, c, d if isinstance(viscous, str) else viscous), error)


def match_depth(stiffness: float, exponent: float, wanted: float, impact: ReferenceImpact) -> float:
    """Return K of another exponent with the same penetration in the undamped reference impact.

    K delta^(n+1) / (n+1) = m v^2 / 2 holds for both.
    """
    energy = 0.5 * impact.mass * impact.speed**2
    depth = ((exponent + 1.0) * energy / stiffness) ** (1.0 / (exponent + 1.0))
    return (wanted + 1.0) * energy / depth ** (wanted + 1.0)


class FreeImpact(NamedTuple):
    """Result of one impact of two free bodies."""

    restitution: float  # [1]
    peak_force: float  # [N]
    duration: float  # of contact [s]
    depth: float  # largest penetration [m]


def free_impact(law: NormalLaw, *, mass: float, speed: float, speed_floor: float = 0.0) -> FreeImpact:
    """Simulate one frictionless impact, which ends when the force falls to 0.

    Args:
        law: Normal law.
        mass: Reduced mass of the two bodies [kg].
        speed: Approach speed [m/s].
        speed_floor: Floor of v0 [m/s].

    Example:
        >>> law = NormalLaw(2.86e10, exponent=1.5, damping_factor=restitution_factor(0.9), viscous_damping=0.0)
        >>> impact = free_impact(law, mass=1.0, speed=0.145)
        >>> f"e = {impact.restitution:.3f}, {impact.peak_force:.0f} N, {1e3 * impact.duration:.3f} ms"
        'e = 0.900, 1628 N, 0.315 ms'
    """
    from scipy.integrate import solve_ivp

    # Scaled by the penetration and speed at which the elastic force is 1.
    n, scale = law.exponent, (mass * speed**2 / law.stiffness) ** (1.0 / (law.exponent + 1.0))
    c = law.damping_factor * speed / max(speed, speed_floor)
    d = law.viscous_damping * scale / (mass * speed)

    def force(y: np.ndarray) -> np.ndarray:
        return np.maximum(y[0], 0.0) ** n * (1.0 + c * y[1]) + d * y[1]

    def motion(_: float, y: np.ndarray) -> list[float]:
        return [y[1], -float(force(y))]

    def apart(_: float, y: np.ndarray) -> float:
        # Without D the force reaches 0 with the penetration, without changing sign.
        return float(force(y)) if d > 0.0 else y[0]

    apart.terminal, apart.direction = True, -1.0  # pyrefly: ignore[missing-attribute]
    path = solve_ivp(
        motion, (0.0, 1e6), [0.0, 1.0], method="DOP853", events=apart, dense_output=True, rtol=1e-10, atol=1e-12
    )
    dense: Any = path.sol
    states = dense(np.linspace(0.0, path.t[-1], 20_001))
    return FreeImpact(
        restitution=-float(path.y[1, -1]),
        peak_force=float(force(states).max()) * mass * speed**2 / scale,
        duration=float(path.t[-1]) * scale / speed,
        depth=float(states[0].max()) * scale,
    )
