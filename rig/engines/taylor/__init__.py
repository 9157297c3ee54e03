"""The Taylor engine; see `rig.engines.taylor.march`."""

from rig.engines.taylor.march import advance, start

__all__ = ["advance", "start"]
