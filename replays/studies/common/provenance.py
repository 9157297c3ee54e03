"""Provenance of a result: date, commit, machine, versions of libraries."""

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
    """Return the date in UTC."""
    return datetime.now(UTC).strftime("%Y-%m-%d")


def digest(sources: Iterable[Path]) -> str:
    """Return a digest of Python code, independent of docstrings, comments, positions and file names.

    Args:
        sources: Files, in any order.
    """
    trees = []
    for path in sources:
        tree = ast.parse(path.read_bytes())
        # The imported names count, but not their modules or their order.
        imported = [name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for name in node.names]
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef):
                # A bare string documents the preceding statement.
                node.body = [each for each in node.body if not _is_text(each) and not isinstance(each, ast.ImportFrom)]
        trees.append(hashlib.sha256(repr((sorted(map(ast.dump, imported)), _fields(tree))).encode()).digest())
    return hashlib.sha256(b"".join(sorted(trees))).hexdigest()[:16]


def _fields(node: object) -> object:
    """Convert a syntax tree to tuples without empty fields, since `ast.dump` differs between versions of Python."""
    if isinstance(node, ast.AST):
        fields = ((name, _fields(value)) for name, value in ast.iter_fields(node) if value not in (None, []))
        return (type(node).__name__, *fields)
    return tuple(map(_fields, node)) if isinstance(node, list) else node


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def commit() -> str:
    """Return the commit of the sources, followed by "+" if they have changed; empty outside a repository."""
    command = ["git", "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude", "*"]
    here = Path(__file__).resolve().parent
    try:
        done = subprocess.run(command, cwd=here, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def processor() -> str:
    """Return the name of the processor, if the system provides it."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def machine() -> str:
    """Return processor and operating system."""
    return f"{processor()}, {platform.system()}"


def versions(*libraries: str) -> dict[str, str]:
    """Return the versions of those libraries that are installed."""
    installed = {}
    for library in libraries:
        try:
            installed[library] = version(library)
        except PackageNotFoundError:
            continue
    return installed
