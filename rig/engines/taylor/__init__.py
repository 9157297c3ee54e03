"""The Taylor engine; see `rig.engines.taylor.march`."""

from rig.engines.taylor.march import advance, start
from rig.engines.taylor.place import ORDER

__all__ = ["ORDER", "advance", "start"]
