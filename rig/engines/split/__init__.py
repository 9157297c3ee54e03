"""The default engine; see `rig.engines.split.method`."""

from rig.engines.split.method import MEMORY, ORDER, advance, start, warm_up

__all__ = ["MEMORY", "ORDER", "advance", "start", "warm_up"]
