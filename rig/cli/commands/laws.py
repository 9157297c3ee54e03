"""`rig laws`: comparison of the normal contact laws and the restitution that each returns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.options import Changes, Law, Plot, SetName, override_parameters
from rig.cli.output.comparison import print_comparison
from rig.cli.output.tables import Form, Table, new_table

if TYPE_CHECKING:
    from rich.console import Console


def laws(
    name: SetName = "corrected",
    *,
    changes: Changes = None,
    law: Law = None,
    restitution: Annotated[
        float | None,
        typer.Option("--restitution", metavar="E", help="Requested restitution, 0 to 1; default: that of the set"),
    ] = None,
    plot: Plot = None,
    form: Form,
) -> None:
    """Compare all normal contact laws: requested and returned restitution, force, contact time, stiffness."""
    from replays.studies.forces.laws import compare, draw

    also = {} if restitution is None else {"contact.restitution": restitution}
    parameters = override_parameters(name, changes, also, law)
    print_comparison(parameters, compare=compare, draw=draw, show=_show, plot=plot, form=form)


def _show(document: dict[str, Any], console: Console) -> None:
    impact, used = document["impact"], document["in_use"]
    console.print(_damping_table(document))
    console.print(
        f"\none free impact: {impact['shaft_mass_kg']:.3f} kg (Ixx / l0A^2) against the inner housing's "
        f"{impact['house_mass_kg']:.2f} kg at {impact['speed_m_s']:.3f} m/s, no friction. A c depends on e "
        "alone, so the returned restitution does not depend on mass, speed, K or n, down to the minimum v0 of "
        f"{document['speed_floor_m_s']:g} m/s. Kelvin-Voigt's D holds for these two masses only, and its force "
        "jumps to D v0 at the onset.\n",
    )
    console.print(_stiffness_table(document))
    lean = document["lean"]
    console.print(
        "\nfit: largest error of K delta^n over 5 N to 3 kN, for laws other than a power law. Cylinder laws assume "
        f"parallel axes; here the shaft tilts by up to r0 / l0A = {lean['angle_mrad']:.1f} mrad, "
        f"{lean['over_width_um']:.0f} µm over the ring's assumed width: no law is validated on this rig.",
    )
    damping = used["damping_law"] or "given number"
    console.print(
        f"in use: {used['stiffness_law'] or 'given number'} with {damping}: K = {used['stiffness']:.4g} N/m^n, "
        f"n = {used['exponent']:.4g}, c = {used['damping_factor']:.4g}, D = {used['viscous_damping']:.4g} N s/m, "
        f"returns {used['returned']:.3f} for {document['restitution']:g} requested",
    )


def _damping_table(document: dict[str, Any]) -> Table:
    table = new_table(
        f"damping laws at e = {document['restitution']:g} ({document['set']})",
        *("law", ">c", ">D [N s/m]", ">returned", ">off by", ">peak [N]", ">contact [ms]", "in use"),
        *("formula", "source"),
        wrapped=("formula", "source"),
        spare=("source", "formula"),
    )
    for law in document["damping"]:
        table.add_row(
            law["name"],
            f"{law['damping_factor']:.4f}",
            f"{law['viscous_damping']:.0f}" if law["viscous_damping"] else "-",
            f"{law['returned']:.4f}",
            f"{round(law['returned'] - law['wanted'], 4) + 0.0:+.4f}",
            f"{law['peak_force_n']:.0f}",
            f"{law['contact_time_ms']:.4f}",
            "yes" if law["in_use"] else "",
            law["formula"],
            law["source"],
            style="bold" if law["in_use"] else "",
        )
    return table


def _stiffness_table(document: dict[str, Any]) -> Table:
    table = new_table(
        "stiffness laws",
        *("law", ">K [N/m^n]", ">n", ">fit", ">from - to [µm]", ">5 µm [N]", ">10 µm [N]", "in use"),
        *("holds for", "source"),
        wrapped=("holds for", "source"),
        spare=("source", "holds for", "from - to [µm]"),
    )
    for law in document["stiffness"]:
        if law["refused"]:
            table.add_row(law["name"], *["-"] * 6, "", law["refused"], "")
            continue
        forces = ("-" if law[f"force_{um}um_n"] is None else f"{law[f'force_{um}um_n']:.0f}" for um in (5, 10))
        table.add_row(
            law["name"],
            f"{law['stiffness']:.3e}",
            f"{law['exponent']:.4f}",
            f"{law['fit_error']:.1%}" if law["fit_error"] else "exact",
            f"{law['from_um']:.2f} - {law['to_um']:.1f}",
            *forces,
            "yes" if law["in_use"] else "",
            law["valid"],
            law["source"],
            style="bold" if law["in_use"] else "",
        )
    return table
