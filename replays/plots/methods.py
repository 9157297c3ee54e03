"""All kinds of plots by name, and the object that has them as methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from replays.plots.orbits import centreline, orbit
from replays.plots.plot import Plot
from replays.plots.timebase import timebase
from rig.base.errors import UnknownNameError

KINDS: Mapping[str, Callable[..., Plot]] = {
    "timebase": timebase,
    "orbit": orbit,
    "centreline": centreline,
}
"""Functions by name, in the order of `rig plot`."""


class _UnknownKindError(UnknownNameError, AttributeError):
    """A kind of plot that does not exist, also for `hasattr`."""


class Plots:
    """The kinds of plots as methods, of one run, recording or table of samples."""

    def __init__(self, source: Any) -> None:
        self._source = source

    def __getattr__(self, name: str) -> Callable[..., Plot]:
        if name.startswith("_"):
            raise AttributeError(name)
        if name not in KINDS:
            raise _UnknownKindError("plot", "a kind of plot", name, KINDS)
        return partial(KINDS[name], self._source)

    def __dir__(self) -> list[str]:
        return list(KINDS)

    def __repr__(self) -> str:
        return f"Plots({', '.join(KINDS)})"
