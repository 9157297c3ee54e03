"""Default engine; see `rig.physics.engines.split.method`."""

from rig.physics.engines.split.method import MEMORY, ORDER, advance, start, warm_up

__all__ = ["MEMORY", "ORDER", "advance", "start", "warm_up"]
