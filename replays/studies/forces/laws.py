"""Comparison of the normal contact laws: returned restitution, impact force, stiffness, and a picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from replays.report.canvas import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PINK,
    RED,
    SKY,
    check_suffix,
    house_style,
    new_figure,
    save,
)
from rig.base.errors import InputError
from rig.physics.contacts import (
    DAMPING,
    KELVIN_VOIGT,
    LAW,
    STIFFNESS,
    WORKING_FORCES,
    ContactPair,
    DampingLaw,
    NormalLaw,
    ReferenceImpact,
    StiffnessLaw,
    damping_law,
    fit_power,
    free_impact,
    match_depth,
    resolve_law,
    returned_restitution,
    stiffness_law,
)
from rig.physics.model import contact_pair, normal_law, reference_impact
from rig.physics.parameters import ParameterSet

MIN_RESTITUTION = 0.05
"""Smallest restitution compared, equal to the smallest `contact.restitution`."""
SPEEDS = (1e-4, 1.0)
"""Range of approach speeds compared [m/s]."""
DEPTHS_UM = (5, 10)
"""Penetrations at which stiffness laws are compared [µm]."""

# Each law has a dash pattern in addition to its colour.
_STYLES: dict[str, tuple[str, Any]] = {
    "exact": (BLACK, "-"),
    KELVIN_VOIGT: (SKY, (0, (5, 4))),
    "none": ("0.55", "-"),
    "lee-wang": (GREEN, "-"),
    "lankarani-nikravesh": (RED, "-"),
    "hunt-crossley": (BLUE, (0, (1, 1.2))),
    "herbert-mcwhannell": (PINK, (0, (6, 2))),
    "zhiying-qishao": (BLUE, "-"),
    "gonthier": (ORANGE, "-"),
    "hu-guo": (PINK, "-"),
    "flores": (GREEN, (0, (4, 1.5, 1, 1.5))),
    "internal-sphere": (BLACK, "-"),
    "external-sphere": ("0.55", (0, (6, 2))),
    "johnson-cylinder": (BLUE, "-"),
    "esdu-cylinder": (ORANGE, "-"),
    "dubowsky-freudenstein-cylinder": (PINK, (0, (6, 2))),
    "palmgren-cylinder": (GREEN, (0, (4, 1.5, 1, 1.5))),
    "pereira-cylinder": (RED, "-"),
    "liu-cylinder": (SKY, "-"),
}
_DEFAULT_STYLE = ("#882255", (0, (3, 1)))
"""Style of a law without an entry above."""
_LEGEND_BELOW: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.47, -0.13), "ncols": 2}
"""Legend position below the axes."""


def compare(parameters: ParameterSet) -> dict[str, Any]:
    """Compare all damping laws and all stiffness laws at the parameters' restitution and ring.

    Damping laws use the parameters' own stiffness law in one free impact of the reference masses.

    Returns:
        A JSON document: `impact`, `damping` and `stiffness` (lists with one entry per law), `wanted` and `returned`
        (restitution from 0.05 to 1), `speed` and `returned_over_speed`, `lean`.

    Raises:
        InputError: If the parameters' own laws are invalid.
    """
    pair, impact = contact_pair(parameters), reference_impact(parameters)
    restitution, floor = parameters["contact.restitution"], parameters["contact.speed_floor"]
    own = normal_law(parameters)
    wanted = [round(MIN_RESTITUTION * n, 2) for n in range(1, 21)]
    speeds = [float(f"{v:.3g}") for v in np.geomspace(*SPEEDS, 17)]
    damping = damping_laws(parameters)
    return {
        "set": parameters.name,
        "title": parameters.title,
        "restitution": restitution,
        "speed_floor_m_s": floor,
        "impact": {
            "shaft_mass_kg": impact.shaft_mass,
            "house_mass_kg": impact.house_mass,
            "reduced_mass_kg": impact.mass,
            "speed_m_s": impact.speed,
        },
        "in_use": {
            "stiffness_law": parameters.rule("contact.stiffness"),
            "damping_law": parameters.rule("contact.damping_factor"),
            **own.law._asdict(),
            "fit_error": own.fit_error,
            **_impact(own.law, impact, floor),
        },
        "damping": [
            {
                "name": name,
                "formula": law.formula,
                "source": law.source,
                **_match_stiffness(parameters, pair, impact, name, restitution)._asdict(),
                "wanted": restitution,
                **_impact(_match_stiffness(parameters, pair, impact, name, restitution), impact, floor),
                "in_use": parameters.rule("contact.damping_factor") == name,
            }
            for name, law in damping.items()
        ],
        "stiffness": [_stiffness(parameters, pair, name) for name in stiffness_laws(parameters)],
        "wanted": wanted,
        "returned": {name: [_compute_restitution(law, e) for e in wanted] for name, law in damping.items()},
        "speed": speeds,
        "returned_over_speed": restitution_curves(parameters, speeds),
        "lean": {
            "angle_mrad": pair.clearance / parameters["shaft.arm_ring"] * 1e3,
            "over_width_um": pair.clearance / parameters["shaft.arm_ring"] * pair.width * 1e6,
        },
    }


def restitution_curves(parameters: ParameterSet, speeds: list[float]) -> dict[str, list[float]]:
    """Return the restitution over the approach speed [m/s] for three kinds of damping.

    A law with v0 (c from the exact rule) returns the same restitution above the lower limit of v0, and more below it. A
    linear law (Kelvin-Voigt) does not depend on speed. A constant D with Hertz's force, set at the reference impact,
    returns less at lower speeds.
    """
    pair, impact = contact_pair(parameters), reference_impact(parameters)
    restitution, floor = parameters["contact.restitution"], parameters["contact.speed_floor"]
    hertz = resolve_law(
        stiffness="internal-sphere", exponent=LAW, damping="exact", viscous=LAW,
        restitution=restitution, pair=pair, impact=impact,
    ).law  # fmt: skip
    linear = _match_stiffness(parameters, pair, impact, KELVIN_VOIGT, restitution)
    plain = _constant_damping(hertz, impact, restitution)
    return {
        "memory of v0 (exact)": [returned_restitution(hertz.damping_factor * v / max(v, floor)) for v in speeds],
        "Kelvin-Voigt": [free_impact(linear, mass=impact.mass, speed=v).restitution for v in speeds],
        "constant D on Hertz": [free_impact(plain, mass=impact.mass, speed=v).restitution for v in speeds],
    }


@house_style()
def draw(parameters: ParameterSet, path: Path) -> None:
    """Draw returned against set restitution, their difference, the restitution over speed, and the stiffness laws.

    Raises:
        InputError: If the file is neither .png nor .svg, or the parameters' own laws are invalid.
    """
    check_suffix(path, field="--plot")
    normal_law(parameters)
    figure = new_figure(
        10.6,
        "Normal contact laws in free impacts without friction\n"
        f"(parameters: {parameters.name}; not validated on a rig)",
    )
    (wanted, difference), (speed, stiffness) = figure.subplots(2, 2)
    _draw_restitution(wanted, difference, parameters)
    _draw_speed(speed, parameters)
    _draw_stiffness(stiffness, parameters)
    save(figure, path)


def _draw_restitution(wanted: Any, difference: Any, parameters: ParameterSet) -> None:
    settings = np.linspace(MIN_RESTITUTION, 1.0, 191)
    curves = {
        name: np.array([_compute_restitution(law, float(e)) for e in settings], float)
        for name, law in damping_laws(parameters).items()
    }
    # Sorted by the height of the curves at 0.5.
    for name in sorted(curves, key=lambda name: -float(curves[name][90])):
        color, dash = _STYLES.get(name, _DEFAULT_STYLE)
        style = {"color": color, "ls": dash, "lw": 3.4 if name == "exact" else 1.8, "label": name}
        style["zorder"] = 1 if name == "exact" else 2
        wanted.plot(settings, curves[name], **style)
        difference.plot(settings, curves[name] - settings, **style)
    restitution = parameters["contact.restitution"]
    for axes in (wanted, difference):
        axes.axvline(restitution, color="0.5", lw=0.9, ls=":")
        axes.set(xlabel="set restitution e [1]", xlim=(0, 1))
    wanted.annotate(
        f"set here: {restitution:g}", (restitution, 0.0), xytext=(-4, 5), textcoords="offset points",
        ha="right", va="bottom", rotation=90, color="0.4",
    )  # fmt: skip
    wanted.set(title="Restitution that each damping law returns", ylabel="restitution returned [1]", ylim=(0, 1.02))
    wanted.legend(**_LEGEND_BELOW, title="from the top down at 0.5")
    difference.set(
        title="Deviation from the set restitution", ylabel="returned − set restitution [1]", ylim=(-0.06, 0.06)
    )


def _draw_speed(axes: Any, parameters: ParameterSet) -> None:
    impact, restitution = reference_impact(parameters), parameters["contact.restitution"]
    floor = parameters["contact.speed_floor"]
    speeds = [float(v) for v in np.geomspace(*SPEEDS, 41)]
    curves = restitution_curves(parameters, speeds)
    for (name, values), style in zip(
        curves.items(),
        ({"color": BLACK, "lw": 3.4}, {"color": SKY, "ls": (0, (5, 4))}, {"color": RED}),
        strict=True,
    ):
        axes.semilogx(speeds, values, **{"lw": 1.8, "label": name.replace("v0", "v₀"), **style})
    low = max(0.0, min(min(values) for values in curves.values()) - 0.02)
    for place, text in (
        (floor, f"limit of v₀, {floor:g} m/s"),
        (impact.speed, f"reference, {impact.speed:g} m/s"),
    ):
        axes.axvline(place, color="0.5", lw=0.9, ls=":")
        axes.annotate(
            text, (place, low), xytext=(4, 5), textcoords="offset points", ha="left", va="bottom", rotation=90,
            color="0.4",
        )  # fmt: skip
    axes.set(
        title=f"Returned restitution over speed, set to {restitution:g}", xlabel="approach speed [m/s]",
        ylabel="restitution returned [1]", xlim=SPEEDS, ylim=(low, 1.01),
    )  # fmt: skip
    axes.legend(**_LEGEND_BELOW)


def _draw_stiffness(axes: Any, parameters: ParameterSet) -> None:
    pair = contact_pair(parameters)
    depths = np.geomspace(0.3e-6, 30e-6, 49)
    for name, law in stiffness_laws(parameters).items():
        entry = _stiffness(parameters, pair, name)
        if entry["refused"]:
            continue
        color, dash = _STYLES.get(name, _DEFAULT_STYLE)
        forces = np.array([law.force(float(depth), pair) for depth in depths])
        axes.loglog(depths * 1e6, forces / depths * 1e-6, color=color, ls=dash, lw=1.8, label=name)
        if entry["fit_error"]:
            fitted = entry["stiffness"] * depths ** entry["exponent"]
            within = (fitted >= WORKING_FORCES[0]) & (fitted <= WORKING_FORCES[1])
            axes.loglog(
                depths[within] * 1e6, (fitted / depths)[within] * 1e-6, color=color, ls="none", marker="o", ms=4,
                mfc="white", markevery=3,
            )  # fmt: skip
    axes.plot([], [], color="0.3", ls="none", marker="o", ms=4, mfc="white", label="K δⁿ in its place")
    low, high = (force / depths * 1e-6 for force in WORKING_FORCES)
    axes.fill_between(depths * 1e6, low, high, color="0.94", zorder=0, label="5 N to 3 kN")
    axes.set(
        title=f"Stiffness laws, ring {pair.width * 1e3:g} mm wide (assumed)", xlabel="penetration [µm]",
        ylabel="force / penetration [N/µm]", xlim=(0.3, 30), ylim=(2, 700),
    )  # fmt: skip
    axes.legend(**_LEGEND_BELOW)


def _match_stiffness(
    parameters: ParameterSet, pair: ContactPair, impact: ReferenceImpact, damping: str, restitution: float
) -> NormalLaw:
    """Return the parameters' own stiffness with another damping law; for a linear one, the stiffness of equal depth."""
    stiffness = parameters.rule("contact.stiffness") or parameters["contact.stiffness"]
    exponent = parameters.rule("contact.exponent") or parameters["contact.exponent"]
    if damping == KELVIN_VOIGT:
        own = normal_law(parameters).law
        if not isinstance(stiffness, str):
            stiffness = match_depth(own.stiffness, own.exponent, 1.0, impact)
        exponent = LAW
    return resolve_law(
        stiffness=stiffness,
        exponent=exponent,
        damping=damping,
        viscous=LAW,
        restitution=restitution,
        pair=pair,
        impact=impact,
    ).law


def damping_laws(parameters: ParameterSet) -> dict[str, DampingLaw]:
    """Return the rig's damping laws by name, with the one that the parameters define by a formula."""
    chosen = parameters.rule("contact.damping_factor")
    return DAMPING | ({} if chosen is None else {chosen: damping_law(chosen)})


def stiffness_laws(parameters: ParameterSet) -> dict[str, StiffnessLaw]:
    """Return the rig's stiffness laws by name, with the one that the parameters define by a formula."""
    chosen = parameters.rule("contact.stiffness")
    return STIFFNESS | ({} if chosen is None else {chosen: stiffness_law(chosen)})


def _compute_restitution(law: DampingLaw, restitution: float) -> float | None:
    """Return the restitution of a damping law above the lower limit of v0; that of Kelvin-Voigt equals the setting.

    Returns None if a formula gives no c for this restitution.
    """
    try:
        return restitution if law.factor is None else returned_restitution(law.factor(restitution))
    except InputError:
        return None


def _impact(law: NormalLaw, impact: ReferenceImpact, floor: float) -> dict[str, float]:
    done = free_impact(law, mass=impact.mass, speed=impact.speed, speed_floor=floor)
    return {
        "returned": done.restitution,
        "peak_force_n": done.peak_force,
        "contact_time_ms": done.duration * 1e3,
        "depth_um": done.depth * 1e6,
    }


def _constant_damping(law: NormalLaw, impact: ReferenceImpact, restitution: float) -> NormalLaw:
    """Return the same elastic force with the constant D that gives the restitution in the reference impact."""
    from scipy.optimize import brentq

    if restitution == 1.0:
        return law._replace(damping_factor=0.0)

    n = law.exponent
    unit = (law.stiffness * impact.mass**n * impact.speed ** (n - 1.0)) ** (1.0 / (n + 1.0))

    def plain(ratio: float) -> NormalLaw:
        return law._replace(damping_factor=0.0, viscous_damping=ratio * unit)

    def residual(ratio: float) -> float:
        return free_impact(plain(ratio), mass=impact.mass, speed=impact.speed).restitution - restitution

    root: Any = brentq(residual, 0.0, 10.0 / restitution, xtol=1e-6)
    return plain(float(root))


def _stiffness(parameters: ParameterSet, pair: ContactPair, name: str) -> dict[str, Any]:
    law = stiffness_law(name)
    entry: dict[str, Any] = {
        "name": name,
        "formula": law.formula,
        "source": law.source,
        "valid": law.valid,
        "in_use": parameters.rule("contact.stiffness") == name,
    }
    numbers = ("stiffness", "exponent", "fit_error", "from_um", "to_um", *(f"force_{um}um_n" for um in DEPTHS_UM))
    try:
        fit = fit_power(name, pair)
    except InputError as error:
        return {**entry, **dict.fromkeys(numbers), "refused": str(error)}
    forces = [law.force(um * 1e-6, pair) for um in DEPTHS_UM]
    values = [fit.stiffness, fit.exponent, fit.error, fit.low * 1e6, fit.high * 1e6, *forces]
    kept = [value if math.isfinite(value) else None for value in values]
    return {**entry, **dict(zip(numbers, kept, strict=True)), "refused": None}
