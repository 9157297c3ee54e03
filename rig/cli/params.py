"""`rig params`: the numbers of the rig, where they come from, and which of them are assumed."""

from __future__ import annotations

from typing import Annotated

import typer


def params(
    name: Annotated[str, typer.Argument(metavar="[SET]", help="A parameter set, by name or path.")] = "corrected",
    *,
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change one value; may be repeated.")
    ] = None,
    json_output: Annotated[bool, typer.Option("--json", help="As a JSON document.")] = False,
) -> None:
    """Show a parameter set: value, unit, source and kind of each; what is assumed is marked."""
    import json

    from rich.console import Console
    from rich.table import Table

    from rig.cli.run import scene_overrides
    from rig.model import build_model, describe
    from rig.parameters import load_parameters, set_names
    from rig.scenes import read_value

    values = {key: read_value(text) for key, text in scene_overrides(changes or []).items()}
    document = describe(build_model(load_parameters(name).override(values, source="--set")))
    if json_output:
        typer.echo(json.dumps(document, indent=2))
        return
    table = Table(title=f"{document['set']}: {document['title']}", box=None, header_style="bold", title_justify="left")
    table.add_column("parameter", no_wrap=True)
    table.add_column("symbol")
    table.add_column("value", justify="right")
    table.add_column("unit", no_wrap=True)
    table.add_column("kind", no_wrap=True)
    table.add_column("source")
    for key, entry in document["values"].items():
        value = entry["value"]
        shown = f"{value} = {entry['resolved']:.6g}" if isinstance(value, str) else f"{value:g}"
        assumed = entry["kind"] == "assumed"
        kind = "ASSUMED" if assumed else entry["kind"]
        table.add_row(
            key, entry["symbol"], shown, entry["unit"], kind, entry["source"], style="yellow" if assumed else None
        )
    console = Console(width=None if Console().is_terminal else 200)
    console.print(table)
    derived = document["derived"]
    console.print(
        f"\nderived: shaft sags {-derived['sag_at_ring_mm']:.3f} mm at the ring; eq. 35 with these magnets gives "
        f"{derived['magnet_stiffness_eq35_kn_m']:.3f} kN/m at the centre; the radial map follows the field sum within "
        f"{derived['magnet_map_error']:.1%} over 10 mm\nsets: {', '.join(set_names())}",
        highlight=False,
    )
