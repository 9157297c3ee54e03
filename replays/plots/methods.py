"""All kinds of plots by name, and the object that has them as methods."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import signature
from typing import Any

from replays.plots.campbell import campbell
from replays.plots.contact import contact, restitution, rolling
from replays.plots.modal import frequency_response, modes
from replays.plots.orbits import centreline, orbit
from replays.plots.plot import Plot
from replays.plots.signals import Signals
from replays.plots.spectra import cascade, full_spectrum, orders, waterfall
from replays.plots.synchronous import bode, polar, trend
from replays.plots.timebase import timebase
from rig.base.errors import UnknownNameError

KINDS: Mapping[str, Callable[..., Plot]] = {
    "orbit": orbit,
    "full_spectrum": full_spectrum,
    "timebase": timebase,
    "centreline": centreline,
    "waterfall": waterfall,
    "cascade": cascade,
    "orders": orders,
    "bode": bode,
    "polar": polar,
    "trend": trend,
    "frequency_response": frequency_response,
    "modes": modes,
    "campbell": campbell,
    "contact": contact,
    "restitution": restitution,
    "rolling": rolling,
}
"""Functions by name."""


def list_pictures(signals: Signals, kinds: Sequence[str] = ()) -> dict[str, Callable[[], Plot]]:
    """Return functions that draw all pictures of the data, by file name, in an order in which each group is read once.

    A kind with an option `pair` or `channels` has a picture for each pair of displacement probes, a timebase one for
    each group.

    Args:
        signals: The data.
        kinds: Kinds to draw; none for all.

    Raises:
        UnknownNameError: A kind does not exist.
    """
    for name in kinds:
        if name not in KINDS:
            raise UnknownNameError("--only", "kinds of plots", name, KINDS)
    pairs = list(signals.pairs)
    pairs = [name for name in pairs if signals.is_length(signals.pairs[name][0])] or pairs[:1]
    groups: dict[str, list[str]] = {}
    for name in signals.names:
        groups.setdefault(signals.channels[name][0], []).append(name)
    found: list[tuple[tuple[int, bool, str], str, Callable[[], Plot]]] = []
    places = {group: place for place, group in enumerate(groups)}
    for kind, function in KINDS.items():
        each: dict[str, dict[str, Any]] = {"": {}}
        if kind == "timebase":
            each = {group: {"channels": names} for group, names in groups.items()}
        elif pairs and (option := {"pair", "channels"} & signature(function).parameters.keys()):
            each = {
                pair: dict.fromkeys(option, pair)
                for pair in (signals.pairs if kind in ("frequency_response", "modes") else pairs)
            }
        for name, options in each.items() if kind in (kinds or KINDS) else ():
            # Pictures of one group, and of one pair, follow each other: the group is read once, and few are in memory.
            group = name if kind == "timebase" else signals.channels[signals.pairs[name][0]][0] if name else ""
            if kind in ("frequency_response", "modes") and "hammer" in signals.names:
                group = signals.channels["hammer"][0]
            place = (
                len(places) if kind == "rolling" else places.get(group, len(places)),
                kind not in ("orbit", "full_spectrum"),
                "" if kind == "timebase" else name,
            )
            file = re.sub(r"[^\w.-]+", "_", f"{kind}-{name}").rstrip("-")
            found.append((place, file, partial(function, signals, **options)))
    return {file: draw for _, file, draw in sorted(found, key=lambda each: each[0])}


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
