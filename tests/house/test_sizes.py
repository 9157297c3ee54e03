"""Limits of the lines of code of each folder and each function, and a check that generated files are compared.

Blank lines, comments and docstrings are not counted. A budget is the size when it was set: a commit that needs more
explains why it raises the budget, and one that needs less lowers it. The docstring of a generated file contains "Made
by `command`" and names the test that compares it with the command's output; such files are not counted.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PRODUCT = ("rig", "drivers", "recorder", "replays")
LONGEST_FUNCTION = 120
SLACK = 50
"""Lines by which a budget may exceed the code before it must be lowered."""
BUDGETS = {
    "drivers": 714,
    "drivers/can": 4556,
    "drivers/daqmx": 1316,
    "drivers/examples": 86,
    "drivers/instruments": 845,
    "drivers/link": 572,
    "drivers/protection": 683,
    "drivers/sources": 1006,
    "recorder": 1358,
    "recorder/contents": 1268,
    "recorder/files": 831,
    "recorder/foxglove": 318,
    "recorder/output": 544,
    "recorder/viewer": 1928,
    "replays": 0,
    "replays/campaigns": 3323,
    "replays/estimate": 590,
    "replays/player": 822,
    "replays/plots": 1754,
    "replays/recordings": 12775,
    "replays/report": 531,
    "replays/score": 4253,
    "replays/sessions": 77,
    "replays/studies": 9981,
    "rig": 64,
    "rig/base": 1079,
    "rig/channels": 2600,
    "rig/cli": 6292,
    "rig/ensemble": 2039,
    "rig/physics": 5488,
    "rig/run": 1900,
    "rig/serve": 3080,
}
_NO_CODE = (
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
)  # fmt: skip


def paths() -> list[str]:
    return sorted(str(path.relative_to(ROOT)) for package in PRODUCT for path in (ROOT / package).rglob("*.py"))


def tree_of(path: str) -> ast.Module:
    return ast.parse((ROOT / path).read_text(encoding="utf-8"))


def get_summary(tree: ast.Module) -> str:
    """Return the summary of the docstring and the next paragraph, on one line."""
    return " ".join(" ".join((ast.get_docstring(tree) or "").split("\n\n")[:2]).split())


def is_generated(path: str) -> bool:
    return re.search(r"\b(Generated|Made) by `", get_summary(tree_of(path))) is not None


def code_lines(text: str) -> int:
    """Return the number of lines of code of a file."""
    texts: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            texts.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    used = (range(token.start[0], token.end[0] + 1) for token in tokens if token.type not in _NO_CODE)
    return len({line for lines in used for line in lines} - texts)


def get_folder(path: str) -> str:
    """Return the folder that a file counts for: the first two parts of its path, or the package alone."""
    package, *rest = Path(path).parent.parts
    return f"{package}/{rest[0]}" if rest else package


def count_sizes() -> Counter[str]:
    """Return the lines of code by folder."""
    found: Counter[str] = Counter()
    for path in paths():
        if not is_generated(path):
            found[get_folder(path)] += code_lines((ROOT / path).read_text(encoding="utf-8"))
    return found


def iterate_functions(node: ast.AST, name: str = "") -> Iterator[tuple[str, int]]:
    """Yield every function in a tree with its length, decorators and nested functions included."""
    for child in ast.iter_child_nodes(node):
        inner = name
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            inner = f"{name}.{child.name}" if name else child.name
            if not isinstance(child, ast.ClassDef):
                first = min([child.lineno, *(decorator.lineno for decorator in child.decorator_list)])
                yield inner, (child.end_lineno or first) - first + 1
        yield from iterate_functions(child, inner)


def test_functions_fit_on_two_screens() -> None:
    long = [
        f"{path}::{name} must have at most {LONGEST_FUNCTION} lines and has {length}"
        for path in paths()
        if not is_generated(path)
        for name, length in iterate_functions(tree_of(path))
        if length > LONGEST_FUNCTION
    ]
    assert not long, "\n".join(long)


def test_generated_files_name_the_test_that_compares_them() -> None:
    for path in filter(is_generated, paths()):
        named = re.search(r"tests/\S+\.py", get_summary(tree_of(path)))
        assert named, f"{path} must name the test that compares it with what its command makes"
        assert (ROOT / named[0]).is_file(), f"{path} names {named[0]}, which is no file"


def test_folders_keep_their_budgets() -> None:
    found = count_sizes()
    assert found.keys() == BUDGETS.keys(), "each folder of the product has a budget, and no other"
    wrong = [
        f"{folder} has {found[folder]} lines of code, and its budget is {budget}: "
        + ("save some, or raise it and say why in the commit" if found[folder] > budget else "lower it to that")
        for folder, budget in BUDGETS.items()
        if not budget - SLACK <= found[folder] <= budget
    ]
    assert not wrong, "\n".join(wrong)


def test_lines_of_code_are_neither_blank_nor_comments_nor_docstrings() -> None:
    text = '"""Summary.\n\nMore.\n"""\n\n# comment\nx = (\n    1,  # why\n)\n\n\n'
    text += 'def f():\n    """What."""\n    return """a\nb"""\n'
    assert code_lines(text) == 3 + 1 + 2
