"""Memory of the default engine between calls, after that of the series."""

from __future__ import annotations

from rig.physics.engines.taylor.memory import SERIES_END

MAX_IMPACT_SPEED = SERIES_END
"""Speed of the hardest rigid impact [m/s]."""

STEP_SHARE = 1e-4
"""Error of one step of the series as a share of the run's tolerance: impacts amplify errors about a thousandfold."""
