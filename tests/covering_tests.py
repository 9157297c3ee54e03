"""Tests that execute a line, cheapest first: a pytest plugin for `tests.mutants`.

Records the lines of given files that each test executes, and sorts tests as a list says. It imports nothing of the
product, so that a run under it imports what the tests import.
"""

from __future__ import annotations

import ast
import builtins
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Generator
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import CodeType
from typing import Any

import numpy as np
import pytest

TRACED, RECORD, ORDER = "RIG_TRACED_FILES", "RIG_TRACE_RECORD", "RIG_TEST_ORDER"
"""Environment: paths of files to trace and of the record to write, as JSON; path of a file of test ids, in order."""

_MARK = "rig_executes"
"""Name of the function that a traced module calls for each statement."""

_TURN_S = 2.0
"""Processor time of the tests of one file before the next file has its turn [s]."""

Record = dict[str, dict[str, Any]]
"""`cpu_s`, processor time [s], and `lines`, the lines that the test executes, by file; for each test id."""


class _Loader(SourceFileLoader):
    """Load a module whose functions report the statements that they execute."""

    def __init__(self, name: str, path: str, file: str) -> None:
        super().__init__(name, path)
        self._file = file

    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        return compile(self._marked(ast.parse(self.get_data(path))), path, "exec", dont_inherit=True)

    def _marked(self, tree: ast.Module) -> ast.Module:
        functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        nodes = {id(node): node for function in functions for node in ast.walk(function)}
        for node in nodes.values():
            for field in ("body", "orelse", "finalbody"):
                if isinstance(block := getattr(node, field, None), list) and not isinstance(node, ast.ClassDef):
                    block[:] = [each for statement in block for each in (self._mark(statement), statement)]
        return ast.fix_missing_locations(tree)

    def _mark(self, statement: ast.stmt) -> ast.stmt:
        body = getattr(statement, "body", None)
        last = max(statement.lineno, body[0].lineno - 1) if body else statement.end_lineno
        mark = ast.parse(f"{_MARK}(({self._file!r}, {statement.lineno}, {last}))").body[0]
        for node in ast.walk(mark):
            ast.copy_location(node, statement)
        return mark


class _Tracer(MetaPathFinder):
    """Collect executed lines of some files, which are not yet imported."""

    def __init__(self, files: list[str]) -> None:
        self._files = {file.removesuffix(".py").removesuffix("/__init__").replace("/", "."): file for file in files}
        self._seen = set[tuple[str, int, int]]()
        setattr(builtins, _MARK, self._seen.add)
        sys.meta_path.insert(0, self)

    def find_spec(self, fullname: str, _path: object, _target: object = None) -> ModuleSpec | None:
        if (file := self._files.get(fullname)) is None:
            return None
        path = str(Path.cwd() / file)
        return spec_from_file_location(fullname, path, loader=_Loader(fullname, path, file))

    @property
    def lines(self) -> set[tuple[str, int]]:
        """Lines executed since the last call of `take_lines`, with their files."""
        return {(file, line) for file, first, last in self._seen for line in range(first, last + 1)}

    def take_lines(self) -> set[tuple[str, int]]:
        """Return these lines and clear the record."""
        lines = self.lines
        self._seen.clear()
        return lines


class _Recording:
    """Write which lines each test executes."""

    def __init__(self, tracer: _Tracer) -> None:
        self._tracer, self._record = tracer, dict[str, dict[str, Any]]()
        self._shared: dict[str, set[tuple[str, int]]] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        self._tracer.take_lines()
        before_s = time.process_time()
        result = yield
        shared = self._shared.setdefault(item.nodeid.partition("::")[0], set())
        lines: dict[str, list[int]] = {}
        for file, line in sorted(self._tracer.take_lines() | shared):
            lines.setdefault(file, []).append(line)
        self._record[item.nodeid] = {"cpu_s": round(time.process_time() - before_s, 3), "lines": lines}
        return result

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Generator[None, object, object]:
        result = yield
        # The first test of a module sets up the module's fixtures; later tests use them.
        self._shared.setdefault(item.nodeid.partition("::")[0], set()).update(self._tracer.lines)
        return result

    def pytest_sessionfinish(self) -> None:
        Path(os.environ[RECORD]).write_text(json.dumps(self._record), encoding="utf-8")


def pytest_configure(config: pytest.Config) -> None:
    if RECORD in os.environ:
        config.pluginmanager.register(_Recording(_Tracer(json.loads(os.environ[TRACED]))))


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if ORDER in os.environ:
        ids = json.loads(Path(os.environ[ORDER]).read_text(encoding="utf-8"))
        places = {name: place for place, name in enumerate(ids)}
        items.sort(key=lambda item: places.get(item.nodeid, len(ids)))


def _relevant(text: str, first: int, last: int) -> tuple[set[int], str]:
    """Return the lines of the function around lines of a file, and the name of the constant or field they define.

    Args:
        text: Source of the file.
        first, last: Lines, from 1.

    Returns:
        The lines of the body of the innermost function, without nested ones; the name, or "".
    """
    lines, name = set[int](), ""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef) and node.body[0].lineno <= first and last <= (node.end_lineno or 0):
            lines = set(range(node.body[0].lineno, (node.end_lineno or 0) + 1))
    tree = ast.parse(text)
    blocks = [tree.body, *(node.body for node in ast.walk(tree) if isinstance(node, ast.ClassDef))]
    for node in (node for block in blocks for node in block):
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.lineno <= first and last <= (node.end_lineno or 0):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            name = next((each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)), "")
    return lines, name


def _uses(text: str, name: str) -> set[int]:
    """Return the lines of functions that read a name."""
    return {
        node.lineno
        for function in ast.walk(ast.parse(text))
        if isinstance(function, ast.FunctionDef)
        for node in ast.walk(function)
        if (isinstance(node, ast.Name) and node.id == name) or (isinstance(node, ast.Attribute) and node.attr == name)
    }


def _alternate(tests: list[str]) -> list[str]:
    """Return one case of each test function, then the second of each, and so on."""
    cases = Counter[str]()
    turns = {test: (cases.update([test.partition("[")[0]]), cases[test.partition("[")[0]])[1] for test in tests}
    return sorted(tests, key=lambda test: turns[test])


def order_tests(record: Record, texts: dict[str, str], file: str, first: int, last: int) -> list[str]:
    """Return tests in the order in which a mutant should meet them.

    Args:
        record: What the tests execute.
        texts: Source of all mutated files.
        file: File of the mutant; one without code is executed by no test in particular.
        first, last: Its lines.

    Returns:
        Ids of those that execute these lines (of a constant: that read it), else the function, else the file, else none
        of these. Of each the narrow ones come first, which execute few lines in all: they look most closely. A test
        file has 2 s of them, one case of each test function before the second of any; then come all the others.
    """
    body, name = _relevant(texts.get(file, ""), first, last)
    wanted = [{file: set(range(first, last + 1))} if not name else {f: _uses(t, name) for f, t in texts.items()}]
    wanted += [
        {file: body},
        {file: set(range(len(texts.get(file, ""))))},
        {f: set(range(len(t))) for f, t in texts.items()},
    ]
    widths = {test: sum(map(len, ran["lines"].values())) for test, ran in record.items()}
    ids: dict[str, None] = {}
    for lines in wanted:
        groups: dict[str, list[str]] = {}
        for test, ran in record.items():
            if test not in ids and any(f in lines and lines[f].intersection(n) for f, n in ran["lines"].items()):
                groups.setdefault(test.partition("::")[0], []).append(test)
        files = [_alternate(sorted(group, key=lambda test: widths[test])) for group in groups.values()]
        files.sort(key=lambda group: widths[group[0]])
        for whole in (False, True):
            for group in files:
                costs_s = np.cumsum([record[test]["cpu_s"] for test in group])
                ids.update(
                    (test, None) for test, cost_s in zip(group, costs_s, strict=True) if whole or cost_s < _TURN_S
                )
    return list(ids)
