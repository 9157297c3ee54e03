"""Picture of the packages and their imports for the README: `python -m tests.house.architecture`.

Boxes are modules or packages, rows are floors computed from the imports (`tests.house.layout`): a box may import the
boxes in lower rows. Arrows between packages are imports.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from html import escape
from math import fsum
from pathlib import Path

import grimp

from tests.house.layout import ROOTS, build_graph, find_floors

ROOT = Path(__file__).parents[2]
PICTURE = ROOT / "replays/figures/architecture.svg"
OPEN_PACKAGES = ("replays.recordings", "replays.studies")
"""Packages whose contents are drawn."""
COMMANDS = "rig.cli"
TITLES = {
    COMMANDS: "the commands; the only package that imports all others",
    "replays": "analysis of recordings, studies of methods",
    "recorder": "writes, reads and displays recordings",
    "drivers": "clients, instruments, CAN bus",
    "rig": "the simulator",
    "replays.recordings": "analysis of recordings",
    "replays.studies": "studies of methods, without recordings",
}
FILL = {"rig": "#dfe9f5", "drivers": "#e3f1e1", "recorder": "#fbeedb", "replays": "#eee4f3"}
STROKE = {"rig": "#3d6a9e", "drivers": "#4a8a44", "recorder": "#b9781f", "replays": "#7d559c"}
CHARACTER, LINE, PAD, GAP, GUTTER, STEP = 7.3, 26, 12, 8, 70.0, 46.0


@dataclass
class Box:
    """A module or package, optionally opened.

    Attributes:
        name: Of the module.
        label: Text in the box.
        rows: Boxes inside, from the highest layer to the lowest.
        left, top, width, height: Position and size [px].
    """

    name: str
    label: str
    rows: list[list[Box]] = field(default_factory=list)
    left: float = 0.0
    top: float = 0.0
    width: float = 0.0
    height: float = 0.0

    def measure(self, least: float = 0.0) -> None:
        """Compute width and height, contents first."""
        for box in itertools.chain(*self.rows):
            box.measure()
        inner = [fsum(box.width for box in row) + GAP * (len(row) - 1) for row in self.rows]
        self.width = max(least, len(self.label) * CHARACTER + 2 * PAD, max(inner, default=0.0) + 2 * PAD)
        self.height = float(LINE)
        if self.rows:
            self.height += fsum(max(box.height for box in row) + GAP for row in self.rows) + PAD - GAP / 2

    def place(self, left: float, top: float) -> None:
        """Set the positions of the box and of its contents, each row centred."""
        self.left, self.top = left, top
        at = top + LINE
        for row in self.rows:
            across = left + (self.width - fsum(box.width for box in row) - GAP * (len(row) - 1)) / 2
            for box in row:
                if box.rows:
                    box.height = max(beside.height for beside in row)
                box.place(across, at)
                across += box.width + GAP
            at += max(box.height for box in row) + GAP

    def drawn(self) -> list[str]:
        """Return the box and its contents as SVG."""
        root = self.name.partition(".")[0]
        opened = bool(self.rows) or self.name == COMMANDS
        shape = (
            f'<rect x="{self.left:.0f}" y="{self.top:.0f}" width="{self.width:.0f}" height="{self.height:.0f}" rx="5" '
            f'fill="{FILL[root] if opened else "#ffffff"}" stroke="{STROKE[root]}" '
            f'stroke-width="{1.6 if "." not in self.name or self.name == COMMANDS else 0.8}"/>'
        )
        weight = ' font-weight="bold"' if opened else ""
        middle, base = self.left + self.width / 2, self.top + LINE / 2 + 4.5
        text = f'<text x="{middle:.0f}" y="{base:.0f}"{weight}>{escape(self.label)}</text>'
        return [shape, text, *itertools.chain(*(box.drawn() for box in itertools.chain(*self.rows)))]


def build_box(name: str, graph: grimp.ImportGraph) -> Box:
    """Build the box of a package, with packages of `OPEN_PACKAGES` opened; the rig's own modules are named."""
    title = name.rpartition(".")[2] + ("/" if graph.find_children(name) else "")
    if name in ROOTS or name in OPEN_PACKAGES:
        rows = [[build_box(room, graph) for room in floor if room != COMMANDS] for floor in find_floors(graph, name)]
        return Box(name, f"{title}: {TITLES[name]}", [row for row in rows if row])
    if name.startswith("rig."):
        inside = sorted(room.rpartition(".")[2] for room in graph.find_children(name) if "__" not in room)
        title += f": {', '.join(inside)}"
    return Box(name, title)


def imports(graph: grimp.ImportGraph, importer: str, imported: str) -> bool:
    """Return whether one package imports another; the commands do not count as part of `rig`."""
    below = {imported, *graph.find_descendants(imported)} if imported in graph.modules else {imported}
    if imported == "rig":
        below -= {COMMANDS, *graph.find_descendants(COMMANDS)}
    return any(graph.find_modules_directly_imported_by(name) & below for name in graph.find_descendants(importer))


def draw_arrow(*points: tuple[float, float], root: str) -> str:
    """Return a line through points with an arrowhead at the last."""
    way = " ".join(f"{x:.0f},{y:.0f}" for x, y in points)
    return f'<polyline points="{way}" fill="none" stroke="{STROKE[root]}" stroke-width="2" marker-end="url(#{root})"/>'


def draw_picture() -> str:
    """Return the picture as SVG."""
    graph = build_graph()
    commands = Box(COMMANDS, f"rig/cli/: {TITLES[COMMANDS]}")
    boxes = {name: build_box(name, graph) for name in ROOTS}
    for box in boxes.values():
        box.measure()
    full = max(boxes["replays"].width, boxes["rig"].width, boxes["recorder"].width + boxes["drivers"].width + 2 * GAP)
    for box in (commands, boxes["replays"], boxes["rig"]):
        box.measure(full)
    boxes["recorder"].measure(full - boxes["drivers"].width - 2 * GAP)
    commands.place(GUTTER, 10)
    boxes["replays"].place(GUTTER, commands.top + commands.height + STEP)
    middle = boxes["replays"].top + boxes["replays"].height + STEP
    boxes["recorder"].place(GUTTER, middle)
    boxes["drivers"].place(GUTTER + full - boxes["drivers"].width, middle)
    boxes["rig"].place(GUTTER, middle + max(boxes["recorder"].height, boxes["drivers"].height) + STEP)
    width = full + 2 * GUTTER
    height = boxes["rig"].top + boxes["rig"].height + 12
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}"'
        f' height="{height:.0f}" font-family="Helvetica, Arial, DejaVu Sans, sans-serif"'
        ' font-size="12.5" text-anchor="middle">',
        "<!-- Generated by `python -m tests.house.architecture`; tests/house/test_architecture.py compares it. -->",
        "<defs>",
        *(
            f'<marker id="{root}" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" orient="auto">'
            f'<path d="M0,0 L10,5 L0,10 z" fill="{color}"/></marker>'
            for root, color in STROKE.items()
        ),
        "</defs>",
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
        *commands.drawn(),
        *itertools.chain(*(box.drawn() for box in boxes.values())),
        *draw_arrows(graph, commands, boxes),
        "</svg>",
        "",
    ])  # fmt: skip


def draw_arrows(graph: grimp.ImportGraph, commands: Box, boxes: dict[str, Box]) -> list[str]:
    """Draw imports between packages: straight down if the way is free, otherwise around the outside."""
    replays, recorder, drivers, rig = (boxes[name] for name in ("replays", "recorder", "drivers", "rig"))
    right, drawn = replays.left + replays.width, []

    def down(importer: Box, imported: Box, x: float) -> None:
        if imports(graph, importer.name, imported.name):
            root = importer.name.partition(".")[0]
            drawn.append(draw_arrow((x, importer.top + importer.height), (x, imported.top - 1), root=root))

    def around(importer: Box, imported: Box, x: float, edge: float, at: float) -> None:
        if imports(graph, importer.name, imported.name):
            root = importer.name.partition(".")[0]
            y, z = importer.top + importer.height / 2, imported.top + at
            drawn.append(draw_arrow((edge, y), (x, y), (x, z), (edge + (-1 if x < edge else 1), z), root=root))

    down(commands, replays, commands.left + commands.width / 2)
    down(replays, recorder, recorder.left + recorder.width / 2)
    down(replays, drivers, drivers.left + drivers.width / 2)
    down(recorder, rig, recorder.left + recorder.width / 2)
    down(drivers, rig, drivers.left + drivers.width / 2)
    around(commands, recorder, 46, replays.left, 40)
    around(commands, rig, 16, replays.left, 60)
    around(replays, rig, 31, replays.left, 40)
    around(commands, drivers, right + GUTTER - 46, right, 40)
    return drawn


if __name__ == "__main__":
    PICTURE.write_text(draw_picture(), encoding="utf-8")
