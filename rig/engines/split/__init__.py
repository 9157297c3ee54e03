"""The default engine; see `rig.engines.split.method`."""

from rig.engines.split.method import ORDER, advance, start

__all__ = ["ORDER", "advance", "start"]
