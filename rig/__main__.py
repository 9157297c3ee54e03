"""`python -m rig`: the command `rig`."""

from __future__ import annotations

from rig.cli.main import entry

entry()
