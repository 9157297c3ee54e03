"""How kernels are compiled."""

from __future__ import annotations

from typing import Any, Final

from numba import njit

STAGE: Final[dict[str, Any]] = {"cache": True, "error_model": "numpy", "fastmath": False, "forceinline": True}
stage = njit(**STAGE)
"""Put in place by the compiler wherever it is called: a stage and its tuples cost nothing over the same lines in one
long function. IEEE 754 as it stands, no reordering: a stage gives the same bits wherever it is called."""

kernel = njit(cache=True, error_model="numpy", fastmath=False)
"""A function of its own. Options that a function does not name it would inherit from whichever caller comes first, and
with them its bits."""
