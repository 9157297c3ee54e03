"""Taylor engine; see `rig.physics.engines.taylor.march`."""

from rig.physics.engines.taylor.march import advance, start
from rig.physics.engines.taylor.memory import ORDER

__all__ = ["ORDER", "advance", "start"]
