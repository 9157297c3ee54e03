"""Compiler settings of the kernels."""

from __future__ import annotations

from typing import Any, Final

from numba import njit

STAGE: Final[dict[str, Any]] = {"cache": True, "error_model": "numpy", "fastmath": False, "forceinline": True}
stage = njit(**STAGE)
"""Decorator of functions that the compiler inlines, at no cost compared with one long function. IEEE 754 without
reordering: a stage gives the same bits wherever it is called."""

kernel = njit(cache=True, error_model="numpy", fastmath=False)
"""Decorator of separate functions. Without explicit options, a function would inherit those of its first caller, and
with them its bits."""
