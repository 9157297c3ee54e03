"""`rig params`: the parameters of the rig, their sources, and which of them are assumed."""

from __future__ import annotations

from rig.cli.options import Changes, SetName, override_parameters
from rig.cli.output.tables import Form, echo_json, new_table


def params(name: SetName = "corrected", *, changes: Changes = None, form: Form) -> None:
    """Show a parameter set: values, units, sources and kinds; assumed values are marked."""
    from rig.physics.model import build_model, describe
    from rig.physics.parameters import set_names

    document = describe(build_model(override_parameters(name, changes)))
    if form.as_json:
        echo_json(document)
        return
    table = new_table(
        f"{document['set']}: {document['title']}",
        *("parameter", ">value", "unit", "kind", "by rule", "symbol", "source"),
        wrapped=["source"],
        spare=("source", "symbol", "by rule"),
    )
    for key, entry in document["values"].items():
        rule = entry["value"] if isinstance(entry["value"], str) else ""
        value = f"{entry['resolved']:.5g}" if rule else f"{entry['value']:g}"
        assumed = entry["kind"] == "assumed"
        kind = "ASSUMED" if assumed else entry["kind"]
        row = (key, value, entry["unit"], kind, rule, entry["symbol"], entry["source"])
        table.add_row(*row, style="yellow" if assumed else "")
    console = form.console()
    console.print(table)
    derived = document["derived"]
    errors = {(error["model"], error["against"]): error for error in derived["magnet_errors"]}
    fit, shape = errors["far-field map", "far-field sum"], errors["far-field map", "exact cylinders"]
    console.print(
        f"\nderived: shaft sags {-derived['sag_at_ring_mm']:.3f} mm at the ring; with these magnets eq. 35 gives "
        f"{derived['magnet_stiffness_eq35_kn_m']:.3f} kN/m at the centre, exact cylinders "
        f"{derived['magnet_stiffness_cylinders_kn_m']:.3f} kN/m; the radial map follows the field sum within "
        f"{fit['over_reach']:.1%} over {derived['magnet_reach_mm']:.3g} mm and {fit['over_travel']:.1%} in the range "
        f"that the ring allows, and exact cylinders of equal stiffness within {shape['over_reach']:.0%} and "
        f"{shape['over_travel']:.0%} (see `rig magnets`)",
    )
    if derived["contact_fit_error"]:
        console.print(
            f"K and n fit the contact's stiffness law within {derived['contact_fit_error']:.1%} of its force "
            "(see `rig laws`)",
        )
    console.print(f"sets: {', '.join(set_names())}")
