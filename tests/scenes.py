"""Changes of scenes for several tests."""

from __future__ import annotations

QUIET = {
    "sensors.chain": "ideal",
    "sensors.groups": ["hammer"],
    "sensors.rate_hz": 1000,
    "sensors.truth_rate_hz": 1000,
    "sensors.noise": False,
}
"""Rows 1 ms apart: steps of every engine end on them."""
