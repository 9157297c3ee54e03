"""Static checks: ruff's rules and format, pyrefly's types. A failure shows the tool's output."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def check_tool(*command: str | Path) -> None:
    """Run a tool over the project, and fail with its output where it finds anything."""
    done = subprocess.run(
        command,
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout


def find_pyrefly() -> Path:
    """Return the path of pyrefly's program.

    `python -m pyrefly` searches only this environment's folder, and the package may be installed in another.
    """
    files = metadata.files("pyrefly") or ()
    return next(Path(str(file.locate())) for file in files if file.parent.name in ("bin", "Scripts"))


@pytest.mark.wallclock
def test_ruff_reports_nothing() -> None:
    check_tool(sys.executable, "-m", "ruff", "check", "--no-cache")


@pytest.mark.wallclock
def test_code_is_formatted() -> None:
    check_tool(sys.executable, "-m", "ruff", "format", "--check", "--no-cache")


@pytest.mark.wallclock
@pytest.mark.timeout(600)
def test_pyrefly_reports_nothing(pytestconfig: pytest.Config) -> None:
    # 15 s on one core, so the result is reused while files and packages are unchanged.
    digest = hashlib.sha256((ROOT / "pyproject.toml").read_bytes())
    for package in ("rig", "drivers", "recorder", "replays"):
        for path in sorted((ROOT / package).rglob("*.py")):
            digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes() + b"\0")
    for installed in sorted(f"{each.name} {each.version}" for each in metadata.distributions()):
        digest.update(installed.encode() + b"\0")
    cache = getattr(pytestconfig, "cache", None)  # not with -p no:cacheprovider
    if cache is not None and cache.get("house/right types", None) == digest.hexdigest():
        return
    # One thread takes a quarter less processor time than two.
    options = ("--threads", "1", "--summary=none", "--min-severity", "error", "--color", "never")
    check_tool(find_pyrefly(), "check", *options, "--python-interpreter-path", sys.executable)
    if cache is not None:
        cache.set("house/right types", digest.hexdigest())
