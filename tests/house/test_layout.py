"""No package has too many rooms or floors (defined in `tests.house.layout`)."""

from __future__ import annotations

import grimp
import pytest

from tests.house.layout import (
    LIKE_ENTRIES,
    MAX_FLOORS,
    MAX_ROOMS,
    ROOTS,
    build_graph,
    find_floors,
    find_rooms,
    list_packages,
)


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return build_graph()


def test_packages_have_few_rooms_on_few_floors(graph: grimp.ImportGraph) -> None:
    wrong = []
    for package in list_packages(graph):
        count = len(find_rooms(graph, package))
        if count > MAX_ROOMS and package not in LIKE_ENTRIES:
            wrong.append(f"{package} has {count} rooms, at most {MAX_ROOMS}: give those that belong together a folder")
        if (high := len(find_floors(graph, package))) > MAX_FLOORS:
            wrong.append(f"{package} has {high} floors, at most {MAX_FLOORS}: python -m tests.house.layout {package}")
    assert not wrong, "\n".join(wrong)


def test_entries_of_one_kind_do_not_import_each_other(graph: grimp.ImportGraph) -> None:
    for package in LIKE_ENTRIES:
        wrong = {name: beside for name, beside in find_rooms(graph, package).items() if beside}
        assert not wrong, "what two entries need stands in neither of them"


def test_the_rig_has_two_modules_at_its_top(graph: grimp.ImportGraph) -> None:
    assert not [name for name in graph.find_children("rig") if not graph.find_children(name) and "__" not in name]


def test_floors_are_counted_on_imports() -> None:
    graph = grimp.ImportGraph()
    for name in ("p", "p.a", "p.b", "p.b.c", "p.d", "p.__main__"):
        graph.add_module(name)
    graph.add_import(importer="p.a", imported="p.b.c")
    graph.add_import(importer="p.b.c", imported="p.d")
    assert find_floors(graph, "p") == [["p.a"], ["p.b"], ["p.d"]]
    graph.add_import(importer="p.d", imported="p.a")
    with pytest.raises(ValueError, match="circle"):
        find_floors(graph, "p")


def test_all_packages_are_counted(graph: grimp.ImportGraph) -> None:
    assert set(ROOTS) < set(list_packages(graph))
