"""The rig's own channel table; other tests in this process run with tests/channels.toml."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rig.channels import table
from tests.conftest import SHIPPED_TABLE

ROOT = Path(__file__).parents[2]
MODULES = ("tests/unit/test_channels.py", "tests/unit/test_channels_everywhere.py")
"""Tests that hold for any table, except those of a bus: docs/daq24.toml sets no rate for a new group, a bus has one."""
SHIPPED = ROOT / "rig/channels/channels.toml"


def test_tests_for_any_table_pass_with_the_rigs_own() -> None:
    tables = [table.parse_table(path.read_text(encoding="utf-8")) for path in (SHIPPED, table.TABLE)]
    if tables[0] == tables[1]:
        pytest.skip("the two tables are equal")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-k", "not bus", *MODULES]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, SHIPPED_TABLE: "1"}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-3000:]
