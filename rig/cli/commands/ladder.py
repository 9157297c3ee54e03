"""`rig ladder`: the cheapest model, engine and step that give the requested quantities within a tolerance."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.base.files import write_file
from rig.cli.options import Changes, SceneChanges, SceneName
from rig.cli.output.folder import check_folder
from rig.cli.output.progress import reporting
from rig.cli.output.tables import Form, Table, echo, echo_json, new_table

if TYPE_CHECKING:
    from rich.console import Console


_COUNTS = "Quantity, e.g. whirl_frequency, outcome; 'list' shows all; repeatable"


def ladder(
    scene: SceneName,
    *,
    quantity: Annotated[list[str], typer.Option("--quantity", "-q", metavar="QUANTITY", help=_COUNTS)],
    tolerance: Annotated[
        list[float],
        typer.Option("--tolerance", "-t", metavar="PART", help="Relative error allowed: one for all, or one each"),
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="Folder for ladder.png, .svg and .json")
    ] = None,
    write: Annotated[
        Path | None, typer.Option(metavar="FILE.toml", help="Store the pick as [pick] in this scene file")
    ] = None,
    keep: Annotated[
        list[str] | None, typer.Option(metavar="LEVEL", help="Level that must not be simplified; repeatable")
    ] = None,
    changes: Changes = None,
    runs: Annotated[int, typer.Option(min=1, help="Timed runs of each candidate")] = 5,
    budget_s: Annotated[float, typer.Option(min=1.0, help="Time limit in s of wall time")] = 300.0,
    form: Form,
) -> None:
    """Find the cheapest model, engine and step within a tolerance: cost and error of each candidate."""
    import json

    from replays.studies.ladder.chart import draw
    from replays.studies.ladder.document import ladder_document, make_pick
    from replays.studies.ladder.pick import check_target, write_pick
    from replays.studies.ladder.quantity import parse_quantities
    from replays.studies.ladder.search import search
    from rig.run.scenes import load_scene

    tolerances = parse_quantities(quantity, tolerance)
    if output is not None:
        check_folder(output, field="--output")
    # A pick starts from the scene without its stored pick.
    loaded = load_scene(scene, {**SceneChanges(changes=changes).overrides(), "fidelity": "given"})
    loaded.check_physics()
    if write is not None:
        check_target(write, scene, loaded)
    with reporting(compiles=True) as reporter:
        result = search(
            loaded,
            tolerances,
            keep=tuple(keep or ()),
            runs=runs,
            budget_s=budget_s,
            progress=reporter.step,
        )
    document = ladder_document(result)
    paths: list[Path] = []
    if output is not None:
        paths = draw(result, output)
        paths.append(output / "ladder.json")
        write_file(paths[-1], json.dumps(document, indent=2, allow_nan=False) + "\n")
    if write is not None:
        write_pick(write, scene, make_pick(result))
    if form.as_json:
        echo_json(document)
        return
    _show(document, form.console())
    for path in paths:
        echo(f"written  {path}")
    if write is not None:
        echo(f'written  {write}: [pick], used with fidelity = "auto" at the top of the file')


def _show(document: dict[str, Any], console: Console) -> None:
    console.print(levels_table(document))
    console.print()
    console.print(engines_table(document))
    pick, names = document["pick"], [entry["name"] for entry in document["quantities"]]
    levels = ", ".join(f"{level} {pick[level]}" for level in ("magnet", "shaft", "stator", "contact", "friction"))
    echo(f"\npick: {levels}, drive {pick['drive']}, sensors {pick['sensors']}; {document['picked']['engine']}")
    for entry in pick["quantities"]:
        echo(
            f"  {entry['quantity']} = {entry['value']} {entry['unit']} against {entry['reference']}: "
            f"model {entry['model_error']:.1e}, numerical {entry['numerical_error']:.1e}, "
            f"total {entry['total_error']:.1e} of {entry['tolerance']:g} allowed "
            f"(the reference's own {entry['reference_error']:.1e})"
        )
    own = ", ".join(f"{entry['as_given_error']:.1e}" if entry["as_given_error"] is not None else "infinite"
                    for entry in document["quantities"])  # fmt: skip
    saved = ", ".join(f"{level} {pick[level]} saves {part:.0%}" for level, part in document["savings"].items())
    picked, scene = document["picked"], document["given"]
    same = (picked["engine"], picked["model"]) == (scene["engine"], scene["model"])
    none = "the scene unchanged" if same else "no simplification"
    echo(f"  {saved or none}; outcome {picked['outcome']} as in the full model")
    echo(
        f"  a simulated second takes {pick['cpu_s'] * 1e3:.3g} ms of processor time with the picked sensors, "
        f"{pick['cpu_given_s'] * 1e3:.3g} ms as the scene is given (errors {own} in {', '.join(names)}), "
        f"{pick['cpu_full_s'] * 1e3:.3g} ms on the full model by {document['full']['engine']}"
    )
    if pick["sensors"] == "ideal":
        echo("  sensors ideal: these quantities do not depend on the sensors; --keep sensors keeps the chain")
    if scene["engine"].endswith("companion") and not pick["companion"]:
        echo("  no companion: a run does not estimate its error; the errors above were measured here")
    echo(
        f"  reference: full model by {document['reference']['engine']}, its error estimated from "
        f"{document['reference']['unlike']}; seed {pick['seed']}, {pick['date']}, rig {pick['rig']} {pick['commit']}"
    )
    if not document["all_engines_tried"]:
        echo("  the time limit ended before every engine was tried")


def _error(value: float | None) -> str:
    return "-" if value is None else f"{value:.1e}"


def levels_table(document: dict[str, Any]) -> Table:
    """Return a table of cost and model error of each level of the model."""
    names = [entry["name"] for entry in document["quantities"]]
    table = new_table(
        f"Levels of the model in scene {document['scene']}: model error, each against the full model",
        *("level", *(f">{name}" for name in names), ">ms a second", ">ns a step", "on", "verdict", "remark"),
        wrapped=("level", "on", "remark"),
        spare=("remark", "ns a step", "on"),
    )
    for step in document["steps"]:
        if step["stage"] not in ("full", "single", "together"):
            continue
        errors = [_error(step["errors"]["model"].get(name)) if step["stage"] != "full" else "0" for name in names]
        table.add_row(
            ("together: " if step["stage"] == "together" else "") + step["label"],
            *errors,
            f"{step['cost']['cpu_s'] * 1e3:.2f}",
            f"{step['cost']['ns_a_step']:.0f}",
            step["cost"]["engine"],
            "passes" if step["passes"] else "fails",
            step["note"],
        )
    return table


def engines_table(document: dict[str, Any]) -> Table:
    """Return a table of cost and error of each engine and step on the picked model."""
    names = [entry["name"] for entry in document["quantities"]]
    table = new_table(
        "Engines and steps on the picked model: numerical error, total error",
        *("engine", *(f">{name}" for name in names), ">ms a second", ">ns a step", "verdict", "remark"),
        wrapped=("engine", "remark"),
        spare=("remark", "ns a step"),
    )
    for step in document["steps"]:
        if step["stage"] not in ("engine", "given"):
            continue
        errors = [
            f"{_error(step['errors']['numerical'][name])}, {_error(step['errors']['total'][name])}" for name in names
        ]
        cpu, ns = step["cpu_s"], step["ns_a_step"]
        table.add_row(
            step["label"],
            *errors,
            "-" if cpu is None else f"{cpu * 1e3:.2f}",
            "-" if ns is None else f"{ns:.0f}",
            "passes" if step["passes"] else "fails",
            step["note"],
        )
    return table
