"""How long a product file and a function may be, and that a generated file is marked as such.

A file may be longer than 500 lines if the paragraph below its summary says why: "It is long because ...". One that is
made by a command says there "Made by `command`" and names the test that compares it with what the command makes.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PRODUCT = ("rig", "drivers", "recorder", "replays")
LONGEST_FILE, LONGEST_FUNCTION = 500, 120

# Still to be mended. What is short enough by now has to leave these lists.
LONG_FILES = {
    "drivers/can/bus/kernels.py",
}
UNCOMPARED: set[str] = set()
LONG_FUNCTIONS: set[str] = set()


def paths() -> list[str]:
    return sorted(str(path.relative_to(ROOT)) for package in PRODUCT for path in (ROOT / package).rglob("*.py"))


def tree_of(path: str) -> ast.Module:
    return ast.parse((ROOT / path).read_text(encoding="utf-8"))


def beginning(tree: ast.Module) -> str:
    """Summary of the docstring and the paragraph below it, on one line."""
    return " ".join(" ".join((ast.get_docstring(tree) or "").split("\n\n")[:2]).split())


def functions(node: ast.AST, name: str = "") -> Iterator[tuple[str, int]]:
    """Every function in a tree with its length, decorators included, one within another counted with both."""
    for child in ast.iter_child_nodes(node):
        inner = name
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            inner = f"{name}.{child.name}" if name else child.name
            if not isinstance(child, ast.ClassDef):
                first = min([child.lineno, *(decorator.lineno for decorator in child.decorator_list)])
                yield inner, (child.end_lineno or first) - first + 1
        yield from functions(child, inner)


def faults(path: str) -> Iterator[str]:
    """What is too long in a file, and what is excepted and need not be."""
    tree = tree_of(path)
    said = beginning(tree)
    if re.search(r"\b(Generated|Made) by `", said):
        named = re.search(r"tests/\S+\.py", said)
        if (named is None or not (ROOT / named[0]).is_file()) != (path in UNCOMPARED):
            yield f"{path} must name the test that compares it with what the command makes, or else be no exception"
        return
    lines = len((ROOT / path).read_text(encoding="utf-8").splitlines())
    long = lines > LONGEST_FILE and "long because" not in said.lower()
    if long != (path in LONG_FILES):
        yield f"{path} must have at most {LONGEST_FILE} lines, or say why, or else be no exception; it has {lines}"
    for name, length in functions(tree):
        where = f"{path}::{name}"
        if (length > LONGEST_FUNCTION) != (where in LONG_FUNCTIONS):
            yield f"{where} must have at most {LONGEST_FUNCTION} lines, or else be no exception; it has {length}"


def test_files_and_functions_fit_on_few_screens() -> None:
    found = [fault for path in paths() for fault in faults(path)]
    assert not found, "\n".join(found)


def test_exceptions_are_files_and_functions_that_are_there() -> None:
    there = {f"{path}::{name}" for path in paths() for name, _ in functions(tree_of(path))}
    assert not LONG_FUNCTIONS - there
    assert not LONG_FILES - set(paths())
