"""`python -m rig` is the command `rig`."""

from __future__ import annotations

from rig.cli.main import entry

entry()
