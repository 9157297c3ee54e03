"""`rig magnets`: comparison of the magnet models, each with its error against a more accurate one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rig.cli.options import Changes, Plot, SetName, override_parameters
from rig.cli.output.comparison import print_comparison
from rig.cli.output.tables import Form, Table, new_table

if TYPE_CHECKING:
    from rich.console import Console


def magnets(
    name: SetName = "corrected",
    *,
    changes: Changes = None,
    plot: Plot = None,
    form: Form,
) -> None:
    """Compare the magnet models: spring, far-field sum, exact cylinders, and the maps used in a run."""
    from replays.studies.forces.magnets import compare, draw
    from rig.physics.model import build_model

    model = build_model(override_parameters(name, changes))
    print_comparison(model, compare=compare, draw=draw, show=_show, plot=plot, form=form)


def _show(document: dict[str, Any], console: Console) -> None:
    geometry, overstated = document["geometry"], document["overstated"]
    console.print(
        _force_table(document, "force_toward_a_magnet_n", f"force toward the centre, same magnets ({document['set']})")
    )
    console.print(
        f"\n{geometry['number']} magnets of {geometry['length'] * 1e3:g} mm: number and length are assumed. Displaced "
        f"toward a magnet. The far-field sum overstates the force of the cylinders {overstated['at_centre']:.2f} times "
        f"at the centre and {overstated['toward_a_magnet'][-1]:.2f} times at {document['reach_mm']:.3g} mm.\n",
    )
    used = document["stiffness_used_n_m"] / 1e3
    console.print(_force_table(document, "force_at_stiffness_used_n", f"force at {used:.3g} kN/m, as in use"))
    console.print()
    console.print(_error_table(document))
    console.print(
        "\nerror: largest deviation over largest force of the reference model, in any direction. The ring limits the "
        f"shaft to {document['travel_mm']:.2f} mm from the magnets' centre. Exact: rigid, uniform magnetisation, "
        f"parallel axes, no iron (quadrature to {document['quadrature_error']:.0e}); no measured force is available.",
    )


def _force_table(document: dict[str, Any], column: str, title: str) -> Table:
    places = (f">{place:.3g} mm [N]" for place in document["displacement_mm"])
    table = new_table(title, "model", "runs as", ">K [kN/m]", *places, keys=2)
    scaled = column == "force_at_stiffness_used_n"
    for model in document["models"]:
        stiffness = document["stiffness_used_n_m"] if scaled else model["stiffness_n_m"]
        forces = (f"{force:.3f}" for force in model[column])
        table.add_row(model["name"], model["runs_as"], f"{stiffness / 1e3:.3f}", *forces)
    return table


def _error_table(document: dict[str, Any]) -> Table:
    travel = min(document["travel_mm"], document["reach_mm"])
    radii = (f">over {radius:.3g} mm" for radius in (travel, document["reach_mm"]))
    table = new_table("errors", "model", "against", "with the same", *radii)
    for error in document["errors"]:
        numbers = (f"{error[key]:.3%}" for key in ("over_travel", "over_reach"))
        table.add_row(error["model"], error["against"], error["equal"], *numbers)
    return table
