"""Rooms and floors of every package, computed from its imports: `python -m tests.house.layout [PACKAGE]`.

A room is a module or a folder directly inside a package. Its floor is one above the highest room of the same package
that it imports. A folder of entries of one kind, which do not import each other, counts as one room.
"""

from __future__ import annotations

import sys

import grimp

ROOTS = ("rig", "drivers", "recorder", "replays")
MAX_ROOMS, MAX_FLOORS = 10, 6
LIKE_ENTRIES = frozenset({"rig.cli.commands"})
"""Folders of entries of one kind, without a limit of their number."""


def build_graph() -> grimp.ImportGraph:
    """Build the graph of all imports of the product, those inside functions included."""
    return grimp.build_graph(*ROOTS, cache_dir=None)


def find_rooms(graph: grimp.ImportGraph, package: str) -> dict[str, set[str]]:
    """Return the rooms of a package, each with the rooms of this package that it imports; without `__main__`."""
    found = sorted(name for name in graph.find_children(package) if not name.endswith(".__main__"))
    inside = {name: {name, *graph.find_descendants(name)} for name in found}
    imported = {
        name: {each for module in inside[name] for each in graph.find_modules_directly_imported_by(module)}
        for name in found
    }
    return {name: {each for each in found if each != name and imported[name] & inside[each]} for name in found}


def find_floors(graph: grimp.ImportGraph, package: str) -> list[list[str]]:
    """Return the rooms of a package by floor, the highest first.

    Raises:
        ValueError: Rooms import each other in a circle.
    """
    waiting, found = find_rooms(graph, package), list[list[str]]()
    while waiting:
        floor = [name for name, imported in waiting.items() if not imported & waiting.keys()]
        if not floor:
            raise ValueError(f"{package}: {', '.join(waiting)} import each other in a circle")
        found.insert(0, floor)
        for name in floor:
            del waiting[name]
    return found


def list_packages(graph: grimp.ImportGraph) -> list[str]:
    """Return all packages of the product."""
    return sorted(name for name in graph.modules if graph.find_children(name))


def _tell(package: str) -> None:
    for number, floor in enumerate(reversed(find_floors(build_graph(), package)), 1):
        print(number, *(name.rpartition(".")[2] for name in floor))


if __name__ == "__main__":
    for asked in sys.argv[1:] or ROOTS:
        print(asked)
        _tell(asked)
