"""Rules for plain technical English in docstrings, comments and pages: `python -m tests.house.wording [PATH...]`.

Each pattern has a cure. The command lists the lines that match; a test limits their share.
"""

from __future__ import annotations

import ast
import functools
import io
import re
import sys
import tokenize
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]

_RULES = tomllib.loads((Path(__file__).parent / "wording.toml").read_text(encoding="utf-8"))
BASIC: dict[str, str] = {pattern: cure for cure, pattern in _RULES["basic"].items()}
COLLECTED: dict[str, str] = {pattern: cure for cure, pattern in _RULES["collected"].items()}
"""Patterns, each with its cure."""
VERBS = frozenset(_RULES["verbs"].split())

VAGUE = re.compile(
    r"^_?(ABOUT|ABOVE|ABSURD|AFTER|AHEAD|ALIKE|ALONE|ANOTHER|ANYTHING|APART|AROUND|ASKED|BAD|BEFORE|BEHIND|BESIDE|BETWEEN"
    r"|BEYOND|CERTAIN|CLEARLY|CROWDED|DONE|EARLY|ELSE|ELSEWHERE|ENOUGH|EVERY|FAR|FARTHEST|FEW|FEWEST|FINE|FINER|FINEST"
    r"|FORETOLD|FOUND|GONE|GOOD|HARDLY|HELD|HERE|HOW|KEPT|LARGE|LARGEST|LATE|LATELY|LATER|LEAST|LEFT|LONG|LONGER|LONGEST"
    r"|LOOSER|LOUD|MANY|MOST|NARROWER|NEAR|NEARLY|NEVER|NOTHING|NOW|ODD|OFTEN|ONCE|OTHER|OTHERWISE|OURS|OWN|PLAINER"
    r"|RARE|REST|ROUGH|SAID|SAME|SEEN|SELDOM|SEVERAL|SHARPER|SHORT|SHORTEST|SHOWN|SLIGHT|SLOWER|SMALL|SMALLEST|SOME"
    r"|SOMETHING|SOONER|SPARE|STEADY|STRAY|SUDDEN|SURE|TAKEN|TELLING|TINY|TOGETHER|TOLD|UNDER|UNTOLD|USUAL|WIDE|WORSE"
    r"|WORTH)(_[A-Z]{1,3})?$"
)
"""Constants named by an adverb, an adjective or a participle, with or without a unit."""


class Finding(NamedTuple):
    """A line that a rule matches."""

    path: Path
    line: int
    text: str
    cure: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.cure}: {self.text}"


@functools.cache
def prose_of(path: Path) -> tuple[tuple[int, str], ...]:
    """Return number and text of each line of prose: docstrings and comments of a module, text of a page."""
    return tuple((number, line.strip()) for number, line in _prose_lines(path) if line.strip())


def _prose_lines(path: Path) -> Iterator[tuple[int, str]]:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        in_code = False
        for number, line in enumerate(text.splitlines(), 1):
            if line.lstrip().startswith("```"):
                in_code = not in_code
            elif not in_code:
                yield number, line
        return
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        for each in body if isinstance(body, list) else ():
            match each:
                case ast.Expr(value=ast.Constant(value=str() as docstring)):
                    yield from enumerate(docstring.splitlines(), each.lineno)
    if "#" in text:
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                yield token.start[0], token.string.lstrip("# ")


def match_patterns(paths: Iterable[Path], patterns: dict[str, str]) -> tuple[list[Finding], int]:
    """Return the lines of prose that match a pattern, and the number of all lines of prose."""
    compiled = [(re.compile(pattern if pattern.startswith("^") else f"(?i:{pattern})"), cure)
                for pattern, cure in patterns.items()]  # fmt: skip
    any_pattern = re.compile("|".join(pattern.pattern for pattern, _ in compiled))
    findings, lines = [], 0
    for path in paths:
        for number, line in prose_of(path):
            lines += 1
            if any_pattern.search(line):
                cure = next(cure for pattern, cure in compiled if pattern.search(line))
                findings.append(Finding(path, number, line, cure))
    return findings, lines


def check_forms(paths: Iterable[Path]) -> list[Finding]:
    """Return docstrings of functions that do not begin with a verb, and constants with vague names."""
    findings = []
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                decorators = " ".join(map(ast.unparse, node.decorator_list))
                text = ast.get_docstring(node)
                if not text or re.search(r"property|setter|fixture", decorators) or node.name.startswith("test_"):
                    continue
                if text.split()[0].strip("`.,:;").lower() not in VERBS:
                    cure = "begin with a verb in the imperative"
                    findings.append(Finding(path, node.body[0].lineno, text.splitlines()[0], cure))
            elif isinstance(node, ast.Assign | ast.AnnAssign) and node.col_offset == 0:  # not the values of an enum
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                for target in targets:
                    if isinstance(target, ast.Name) and VAGUE.match(target.id):
                        findings.append(Finding(path, node.lineno, target.id, "name a constant by a noun"))
    return findings


def files(*paths: Path) -> list[Path]:
    """Return Python modules and pages of folders and files."""
    found = [each for path in paths for each in (sorted(path.rglob("*")) if path.is_dir() else [path])]
    return [each for each in found if each.suffix in (".py", ".md")]


if __name__ == "__main__":
    chosen = files(*(map(Path, sys.argv[1:]) if sys.argv[1:] else [ROOT / "rig"]))
    for found, lines in (match_patterns(chosen, BASIC), match_patterns(chosen, COLLECTED)):
        print(*found, f"{len(found)} of {lines} lines of prose", sep="\n")
    print(*check_forms(path for path in chosen if path.suffix == ".py"), sep="\n")
