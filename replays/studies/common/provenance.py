"""What a number was measured with: date, commit, machine, versions of libraries."""

from __future__ import annotations

import ast
import hashlib
import platform
import subprocess
from collections.abc import Iterable
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

RIG = "rotor-stator-rig"


def today() -> str:
    """The date in UTC."""
    return datetime.now(UTC).strftime("%Y-%m-%d")


def digest(sources: Iterable[Path]) -> str:
    """Digest of what Python files do: of their syntax trees, without docstrings, comments, places and names of files.

    Args:
        sources: Files, in any order.
    """
    trees = []
    for path in sources:
        tree = ast.parse(path.read_bytes())
        # What is imported counts, and not where from or in which order.
        imported = [name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for name in node.names]
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef):
                # A text that stands alone says something of what is before it.
                node.body = [each for each in node.body if not _is_text(each) and not isinstance(each, ast.ImportFrom)]
        trees.append(hashlib.sha256(repr((sorted(map(ast.dump, imported)), _fields(tree))).encode()).digest())
    return hashlib.sha256(b"".join(sorted(trees))).hexdigest()[:16]


def _fields(node: object) -> object:
    """A syntax tree as tuples, without empty fields: `ast.dump` differs from one version of Python to the next."""
    if isinstance(node, ast.AST):
        found = ((name, _fields(value)) for name, value in ast.iter_fields(node) if value not in (None, []))
        return (type(node).__name__, *found)
    return tuple(map(_fields, node)) if isinstance(node, list) else node


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def commit() -> str:
    """Commit of the sources, "+" behind it where they have changed since; empty outside a repository."""
    command = ["git", "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude", "*"]
    here = Path(__file__).resolve().parent
    try:
        done = subprocess.run(command, cwd=here, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def processor() -> str:
    """Its name, as far as the system tells."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def machine() -> str:
    """Processor and system."""
    return f"{processor()}, {platform.system()}"


def versions(*libraries: str) -> dict[str, str]:
    """Versions of those libraries that are installed."""
    found = {}
    for library in libraries:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            continue
    return found
