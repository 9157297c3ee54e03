"""What the default engine keeps between calls beside what the series keep, by position in the memory."""

from __future__ import annotations

from rig.physics.engines.taylor.place import SERIES_END

HARDEST = SERIES_END
"""Speed of the hardest rigid impact so far [m/s]."""

SHARE = 1e-4
"""Part of the tolerance that one step of the series may err by."""
