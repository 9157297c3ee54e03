"""`rig map`: outcome or quantity over two keys of a scene, refined at the borders, as a picture and a table."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from rig.base.errors import InputError, Words
from rig.cli.options import Json, Wide
from rig.cli.output.folder import check_folder
from rig.cli.output.progress import reporting
from rig.cli.output.tables import echo, echo_json, fact_table, new_table, table_console

_ACTIONS = {"pick": ("FOLDER", "X", "Y"), "info": ("FOLDER",), "sobol": ("PLAN",)}
"""Arguments after the first, if that is an action."""


def map(
    arguments: Annotated[
        list[str] | None, typer.Argument(metavar="[PLAN|ACTION]...", help="Ready plan or file (.toml); or an action")
    ] = None,
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="PATH", help="Folder of the map; for `pick`, the scene")
    ] = None,
    panel: Annotated[float | None, typer.Option(help="Value of the panel, for `pick`")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Wider border cells, fewer runs")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Number of threads; default: the cores")] = None,
    listing: Annotated[bool, typer.Option("--list", help="List the ready plans")] = False,
    wide: Wide = False,
    as_json: Json = False,
) -> None:
    """Map the outcome of a scene over two of its values, with the borders found.

    Without arguments, the ready plans are listed. A folder of the same plan is continued. Actions: `pick FOLDER X Y
    -o scene.toml` writes the scene of a point (before negative numbers, write --), `info FOLDER` shows the summary,
    `sobol PLAN.toml` computes sensitivity indices for a plan of `rig sweep`.
    """
    first, *rest = arguments or [""]
    if listing or not first:
        _list_plans(wide=wide, as_json=as_json)
        return
    names = _ACTIONS.get(first, ())
    if len(rest) != len(names):
        raise InputError("arguments", f"{first} {' '.join(names)}".strip(), Words(" ".join((first, *rest))))
    if first == "info":
        _show_info(Path(rest[0]), wide=wide, as_json=as_json)
    elif first == "pick":
        _pick(Path(rest[0]), rest[1:], panel, output)
    elif first == "sobol":
        _show_indices(Path(rest[0]), workers, wide=wide, as_json=as_json)
    else:
        _make(first, output, workers, quick=quick, as_json=as_json)


def _make(name: str, output: Path | None, workers: int | None, *, quick: bool, as_json: bool) -> None:
    import time

    from replays.report.canvas import save
    from replays.studies.maps.band import find_band
    from replays.studies.maps.picture import draw_map
    from replays.studies.maps.plan import read_map_plan
    from replays.studies.maps.results import Map, simulate_points
    from rig.ensemble.ensemble import local_workers

    work = read_map_plan(name, quick=quick)
    if output is None:
        raise InputError("--output", "given: a folder for the map", None)
    check_folder(output, field="--output")
    begin = time.monotonic()
    with Map(work, output) as found, local_workers(workers) as pool, reporting(compiles=True) as reporter:
        reporter.begin(work.levels + 1)
        state = {"level": 0, "left": 0, "done": 0}

        def step(runs: int) -> None:
            state["left"] -= runs
            state["done"] += runs
            left = max(state["left"], 0) * (time.monotonic() - begin) / state["done"]
            reporter.show(f"level {state['level']}, {state['left']} runs and about {left:.0f} s left in it")

        def show(level: int, runs: int) -> None:
            state.update(level=level, left=runs)
            reporter.done = max(reporter.done, level)
            reporter.show_activity(f"level {level}, {runs} runs")

        simulate = partial(simulate_points, work.create_batch(work.keys), pool, step)
        found.run(simulate, show)
        band = find_band(work, pool, step) if work.plan.band_runs else None
        save(draw_map(found, band), *(output / f"map{suffix}" for suffix in (".png", ".svg")), source=work.plan.title)
        echo(f"{state['done']} runs in {time.monotonic() - begin:.0f} s, {found.resumed} found in {output}", err=True)
    _show_info(output, wide=False, as_json=as_json)


def _list_plans(*, wide: bool, as_json: bool) -> None:
    from replays.studies.maps.plan import plan_names, read_map_plan

    plans = {name: read_map_plan(name).plan for name in plan_names()}
    if as_json:
        echo_json({name: plan.title for name, plan in plans.items()})
        return
    table = new_table("ready plans: rig map PLAN -o FOLDER", "plan", "title", "x", "y", wrapped=("title",))
    for name, plan in plans.items():
        table.add_row(name, plan.title, plan.x.key, plan.y.key)
    table_console(wide=wide).print(table)


def _pick(folder: Path, place: list[str], panel: float | None, output: Path | None) -> None:
    from replays.studies.maps.plan import load_map_work
    from replays.studies.maps.results import pick_scene, read_map_text
    from replays.studies.maps.scene_file import write_scene

    try:
        x, y = (float(each) for each in place)
    except ValueError:
        raise InputError("X Y", "two numbers, in the units of the axes", Words(" ".join(place))) from None
    if output is None or output.suffix != ".toml":
        raise InputError("--output", "given: a .toml file for the scene", None if output is None else str(output))
    write_scene(pick_scene(load_map_work(read_map_text(folder)), x, y, panel), output)
    echo(f"{output}: rig run {output}")


def _show_info(folder: Path, *, wide: bool, as_json: bool) -> None:
    from replays.studies.maps.results import read_summary

    state = read_summary(folder)
    if as_json:
        echo_json(state)
        return
    rows = [("runs", f"{state['runs']}, of which untrusted: {state['untrusted']}")]
    if "panels" in state:
        rows[0] = ("runs", f"{rows[0][1]}; a full grid has {state['full_grid_runs']}, "
                           f"{state['full_grid_ratio']} times as many")  # fmt: skip
        rows.append(("border cells", f"{state['border_share']:.2%} of the map"))
    for name in ("x", "y"):
        side = state[name]
        width = (
            f"{side['cell_width']:.3g} {side['unit']}" if "cell_width" in side else f"{side['cell_ratio']:.4g} times"
        )
        rows.append((name, f"{side['key']}, border located to {width}"))
    for each in state.get("panels", ()):
        shares = ", ".join(f"{name} {share:.1%}" for name, share in each["shares"].items())
        rows.append(("" if each["value"] is None else f"at {each['value']:g}", shares))
    for each in state.get("marks", ()):
        at = "" if each["panel"] is None else f" at {each['panel']:g}"
        rows.append((each["label"] + at, each["class"] + ", in a border cell" * each["in_border"]))
    if check := state.get("check"):
        counts = (
            f"{check['errors_outside_border']} errors in {check['outside_border']} random runs outside border cells"
        )
        rows.append(("check", f"{counts}: share below {check['error_share_below_95']:.2%} (95 %)"))
    if "smallest" in state:
        rows.append((state["quantity"], f"{state['smallest']:.4g} to {state['largest']:.4g}"))
    table_console(wide=wide).print(fact_table(state["title"], rows))


def _show_indices(plan: Path, workers: int | None, *, wide: bool, as_json: bool) -> None:
    from replays.studies.maps.sobol import find_indices
    from rig.ensemble.ensemble import local_workers
    from rig.ensemble.plan import read_plan

    work = read_plan(plan)
    with local_workers(workers) as pool, reporting(compiles=True):
        found: dict[str, Any] = find_indices(work, pool)
    if as_json:
        echo_json(found)
        return
    title = f"Sobol indices of {found['quantity']}, {found['runs']} runs"
    table = new_table(title, "key", ">first", ">95 %", ">total", ">95 %", keys=1)
    for key, each in found["indices"].items():
        cells = [text for kind in ("first", "total") for low, high in [each[f"{kind}_95"]]
                 for text in (f"{each[kind]:.3f}", f"{low:.3f} to {high:.3f}")]  # fmt: skip
        table.add_row(key, *cells)
    table_console(wide=wide).print(table)
