"""Packing of the model's constants and inputs into records, which kernels receive as a pointer.

A tuple would be a hundred arguments, which every call from Python unpacks and every kernel passes on.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Any, get_type_hints

import numpy as np

from rig.physics.kernels.constants import Constants, Inputs


@cache
def struct_dtype(kind: type) -> np.dtype:
    """Return the C struct of a NamedTuple class."""
    scalars = {float: np.float64, int: np.int64, bool: np.bool_}
    fields = [(name, scalars.get(hint) or struct_dtype(hint)) for name, hint in get_type_hints(kind).items()]
    return np.dtype((np.record, np.dtype(fields, align=True)))


def as_tuple(value: Any) -> Any:
    """Return a value as nested tuples without names, which numpy needs to fill a struct.

    -0 becomes 0: it is equal, but would have other bits.
    """
    if isinstance(value, tuple):
        return tuple(as_tuple(part) for part in value)
    return value + 0.0 if isinstance(value, float) else value


@lru_cache(maxsize=256)
def pack_record(value: Constants | Inputs) -> np.ndarray:
    """Return a tuple as a record with the same names, shape (1,). It is shared: do not write to it."""
    return np.array([as_tuple(value)], dtype=struct_dtype(type(value)))
