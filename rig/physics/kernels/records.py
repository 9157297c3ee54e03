"""The model's numbers as engines are handed them: the one record of an array, for kernels a pointer.

A tuple is a hundred arguments, which every call from Python takes apart one by one, and every kernel's code hands on.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Any, get_type_hints

import numpy as np

from rig.physics.kernels.constants import Constants, Inputs


@cache
def layout(kind: type) -> np.dtype:
    """One of these tuples as a C struct."""
    scalars = {float: np.float64, int: np.int64, bool: np.bool_}
    fields = [(name, scalars.get(hint) or layout(hint)) for name, hint in get_type_hints(kind).items()]
    return np.dtype((np.record, np.dtype(fields, align=True)))


def plain(value: Any) -> Any:
    """The same as tuples without names, as numpy fills a struct, and without -0: it equals 0 and gives other bits."""
    if isinstance(value, tuple):
        return tuple(plain(part) for part in value)
    return value + 0.0 if isinstance(value, float) else value


@lru_cache(maxsize=256)
def packed(value: Constants | Inputs) -> np.ndarray:
    """One of these tuples as a record with the same names, not to be written to, shape (1,)."""
    return np.array([plain(value)], dtype=layout(type(value)))
