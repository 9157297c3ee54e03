"""Comparison of the magnet models: forces, errors, and a picture in the manner of Fig. 7."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from replays.report.canvas import BLACK, BLUE, GREEN, ORANGE, RED, SKY, check_suffix, house_style, new_figure, save
from rig.physics.magnets import (
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
    quadrature_error,
)
from rig.physics.model import Model

FRACTIONS = (0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Displacements compared, as fractions of the reach."""

Force = Callable[[np.ndarray, np.ndarray], np.ndarray]


class MagnetModel(NamedTuple):
    """A magnet model."""

    name: str
    force: Force
    """Force [N], shape (n, 2), at x, y [m], shape (n,)."""
    stiffness: float
    """Stiffness at the centre with these magnets [N/m]."""
    runs_as: str


def family(geometry: MagnetGeometry) -> tuple[MagnetModel, ...]:
    """Return the models for these magnets, from the simplest to the most exact."""

    def make_model(name: str, fitted: MagnetMap, runs_as: str) -> MagnetModel:
        return MagnetModel(name, lambda x, y: map_force(x, y, fitted), fitted.stiffness, runs_as)

    return (
        make_model("linear", linear_map(geometry), "level linear"),
        make_model("far-field map", fit_map(geometry), "level map"),
        MagnetModel(
            "far-field sum", lambda x, y: field_sum_force(x, y, geometry), field_sum_stiffness(geometry), "reference"
        ),
        make_model("cylinder map", fit_cylinder_map(geometry), "level cylinders"),
        MagnetModel(
            "exact cylinders", lambda x, y: cylinder_force(x, y, geometry), cylinder_stiffness(geometry), "reference"
        ),
    )


def compare(model: Model) -> dict[str, Any]:
    """Compare force and error of the models.

    Returns:
        A JSON document: `geometry`, `stiffness_used_n_m`, `reach_mm`, `travel_mm` (largest distance of the shaft from
        the magnets' centre in the ring), `quadrature_error`, `overstated` (far-field sum over exact cylinders, at
        `displacement_mm` toward a magnet and at the centre), `models` (a list: stiffness with these magnets, force
        toward a magnet and toward the gap between two, with these magnets and at the stiffness used), `errors`.
    """
    geometry, used = model.magnets, model.constants.magnet.stiffness
    places = [fraction * geometry.reach for fraction in FRACTIONS]
    models = family(geometry)
    toward = {each.name: _pull_n(each.force, geometry, np.array(places), 0.0) for each in models}
    between = {each.name: _pull_n(each.force, geometry, np.array(places), np.pi / geometry.number) for each in models}
    stiffness = {each.name: each.stiffness for each in models}
    return {
        "set": model.parameters.name,
        "geometry": geometry._asdict(),
        "stiffness_used_n_m": used,
        "reach_mm": geometry.reach * 1e3,
        "travel_mm": model.travel * 1e3,
        "quadrature_error": quadrature_error(geometry),
        "displacement_mm": [place * 1e3 for place in places],
        "overstated": {
            "at_centre": stiffness["far-field sum"] / stiffness["exact cylinders"],
            "toward_a_magnet": (toward["far-field sum"] / toward["exact cylinders"]).tolist(),
        },
        "models": [
            {
                "name": each.name,
                "runs_as": each.runs_as,
                "stiffness_n_m": each.stiffness,
                "force_toward_a_magnet_n": toward[each.name].tolist(),
                "force_between_two_n": between[each.name].tolist(),
                "force_at_stiffness_used_n": (toward[each.name] * used / each.stiffness).tolist(),
            }
            for each in models
        ],
        "errors": [error._asdict() for error in model_errors(geometry, model.travel)],
    }


@house_style()
def draw(model: Model, path: Path) -> None:
    """Draw force over displacement with these magnets and at the stiffness used, the errors, and the ripple.

    Raises:
        InputError: If the file is neither .png nor .svg.
    """
    check_suffix(path, field="--plot")
    geometry = model.magnets
    figure = new_figure(
        10.6,
        f"Magnet models (parameters: {model.parameters.name};\n{geometry.number} magnets of "
        f"{geometry.length * 1e3:g} mm are assumed; not validated on a rig)",
    )
    (magnets, scaled), (errors, ripple) = figure.subplots(2, 2)
    _draw_same_magnets(magnets, model)
    _draw_same_stiffness(scaled, model)
    _draw_errors(errors, model)
    _draw_ripple(ripple, model)
    save(figure, path)


_STYLES: dict[str, dict[str, Any]] = {
    "linear": {"color": "0.55", "lw": 1.6, "ls": (0, (1, 1.2))},
    "far-field map": {"color": ORANGE, "lw": 2.0, "ls": (0, (5, 3)), "zorder": 4},
    "far-field sum": {"color": RED, "lw": 2.6},
    "cylinder map": {"color": SKY, "lw": 2.0, "ls": (0, (5, 3)), "zorder": 4},
    "exact cylinders": {"color": BLACK, "lw": 2.6},
}
_DEFAULT_STYLE = {"color": "#882255", "lw": 1.6}
"""Style of a model without an entry above."""
_LEGEND_BELOW: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.47, -0.13)}
"""Legend position below the axes."""


def _draw_same_magnets(axes: Any, model: Model) -> None:
    """Draw the force over a line through the centre, from a magnet to the opposite side, with the same magnets."""
    geometry = model.magnets
    line = np.linspace(-geometry.reach, geometry.reach, 201)
    for each in family(geometry)[1:]:
        style = _STYLES.get(each.name, _DEFAULT_STYLE)
        toward = -_pull_n(each.force, geometry, line, 0.0)
        axes.plot(line * 1e3, toward, label=f"{each.name}, K = {each.stiffness / 1e3:.3f} kN/m", **style)
        if each.name in ("far-field sum", "exact cylinders"):
            between = -_pull_n(each.force, geometry, line, np.pi / geometry.number)
            axes.fill_between(line * 1e3, toward, between, color=style["color"], alpha=0.25, lw=0)
    axes.fill_between([], [], [], color="0.5", alpha=0.25, lw=0, label="between magnet and gap")
    axes.set(
        title="With the same magnets (axes as in Fig. 7)",
        xlabel="displacement toward a magnet [mm]", ylabel="force along the displacement [N]",
        xlim=(line[0] * 1e3, line[-1] * 1e3),
    )  # fmt: skip
    axes.legend(**_LEGEND_BELOW)


def _draw_same_stiffness(axes: Any, model: Model) -> None:
    """Draw the force over the same line with every model scaled to the stiffness of the rig."""
    geometry, used = model.magnets, model.constants.magnet.stiffness
    line = np.linspace(-geometry.reach, geometry.reach, 201)
    _shade_travel(axes, model, both=True)
    for each in family(geometry):
        force = -_pull_n(each.force, geometry, line, 0.0) * used / each.stiffness
        axes.plot(line * 1e3, force, label=each.name, **_STYLES.get(each.name, _DEFAULT_STYLE))
    axes.set(
        title=f"At the rig's stiffness at the centre, {used / 1e3:.3g} kN/m",
        xlabel="displacement toward a magnet [mm]", ylabel="force along the displacement [N]",
        xlim=(line[0] * 1e3, line[-1] * 1e3),
    )  # fmt: skip
    axes.legend(**_LEGEND_BELOW, ncols=2)


def _draw_errors(axes: Any, model: Model) -> None:
    """Draw the largest deviation of each model from the next better one, by radius."""
    geometry = model.magnets
    radii = np.linspace(geometry.reach / 60, geometry.reach, 60)
    angles = np.linspace(0.0, np.pi / geometry.number, 9)
    r, angle = np.meshgrid(radii, angles)
    x, y = (r * np.sin(angle)).ravel(), (-r * np.cos(angle)).ravel()
    models = {each.name: each for each in family(geometry)}
    forces = {name: each.force(x, y).reshape(len(angles), len(radii), 2) for name, each in models.items()}
    _shade_travel(axes, model)
    for name, better, same_stiffness, color, dash in (
        ("far-field sum", "exact cylinders", False, RED, "-"),
        ("far-field sum", "exact cylinders", True, RED, (0, (5, 3))),
        ("linear", "far-field map", True, "0.55", "-"),
        ("linear", "exact cylinders", True, "0.55", (0, (5, 3))),
        ("far-field map", "far-field sum", False, ORANGE, "-"),
        ("cylinder map", "exact cylinders", False, SKY, "-"),
    ):
        scale = models[better].stiffness / models[name].stiffness if same_stiffness else 1.0
        difference = np.linalg.norm(forces[name] * scale - forces[better], axis=-1).max(axis=0)
        size = np.linalg.norm(forces[better], axis=-1).max(axis=0)
        label = f"{name} − {better}" + (", same stiffness" if same_stiffness else ", same magnets")
        axes.semilogy(radii * 1e3, difference / size, color=color, ls=dash, lw=2.0, label=label)
    axes.set(
        title="Deviation from the better model, largest direction", xlabel="radius [mm]",
        ylabel="deviation / force there [1]", xlim=(0.0, geometry.reach * 1e3), ylim=(1e-8, 1e1),
    )  # fmt: skip
    axes.legend(**_LEGEND_BELOW)


def _draw_ripple(axes: Any, model: Model) -> None:
    """Draw the force over the direction on circles, which shows the single magnets."""
    geometry = model.magnets
    angle = np.linspace(0.0, 4.0 * np.pi / geometry.number, 121)
    peak = 0.0
    for fraction, color in ((1.0, BLACK), (0.8, BLUE), (0.5, GREEN)):
        r = fraction * geometry.reach
        x, y = r * np.sin(angle), -r * np.cos(angle)
        for each in family(geometry)[2:]:
            force = np.linalg.norm(each.force(x, y), axis=-1)
            peak = max(peak, float(np.abs(force / force.mean() - 1.0).max()))
            style = {"far-field sum": {"ls": (0, (1, 1.2)), "lw": 1.6}, "exact cylinders": {"ls": "-", "lw": 2.6}}
            dashed = {"ls": (0, (5, 3)), "lw": 2.0, "color": SKY, "zorder": 4}
            axes.plot(
                np.degrees(angle), force / force.mean() - 1.0,
                **{"color": color, **style.get(each.name, dashed)},
            )  # fmt: skip
        axes.plot([], [], color=color, lw=2.6, label=f"{r * 1e3:.3g} mm: exact cylinders")
    axes.plot([], [], color=SKY, lw=2.0, ls=(0, (5, 3)), label="cylinder map")
    axes.plot([], [], color="0.3", lw=1.6, ls=(0, (1, 1.2)), label="far-field sum, same radii")
    axes.set(
        title="Ripple of the force over the direction", xlabel="direction from a magnet [°]",
        ylabel="force / mean over directions − 1 [1]", xlim=(0.0, float(np.degrees(angle[-1]))),
        ylim=(-1.1 * peak, 1.1 * peak),
    )  # fmt: skip
    axes.legend(**_LEGEND_BELOW, ncols=2)


def _shade_travel(axes: Any, model: Model, *, both: bool = False) -> None:
    travel = min(model.travel, model.magnets.reach) * 1e3
    axes.axvspan(-travel if both else 0.0, travel, color="0.93", zorder=0, label="where the ring lets the shaft go")


def _pull_n(force: Force, geometry: MagnetGeometry, radii: np.ndarray, angle: float) -> np.ndarray:
    """Return the force toward the centre [N] at signed radii [m], shapes (n,), on a line at an angle to a magnet."""
    outward = np.array([np.sin(angle), -np.cos(angle)])
    return -force(radii * outward[0], radii * outward[1]) @ outward
