"""Who takes part in a chart: our engines and the peers, each with its ladder of settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from replays.studies.peers import PEERS, Setting
from rig.engines import ENGINES

OURS = "rig"
"""Family of our own engines."""


class Rung(NamedTuple):
    """One setting of a method."""

    label: str
    step_us: int = 0
    """Of an engine of ours."""
    tolerance: float = 0.0
    setting: Setting | None = None
    """Of a peer."""


@dataclass(frozen=True)
class Competitor:
    """A method and its ladder, the coarsest rung first."""

    name: str
    title: str
    family: str
    rungs: tuple[Rung, ...]
    quick: tuple[Rung, ...]
    known_failure: str = ""

    @property
    def ours(self) -> bool:
        """Whether it is an engine of the rig."""
        return self.family == OURS

    def takes(self, friction: str) -> bool:
        """Whether it can run a friction law."""
        if self.ours:
            return friction in ENGINES[self.name].frictions
        return friction != "exact" or PEERS[self.name].exact_friction


_STEPS = (50, 40, 25, 20, 10, 5, 2)
_LADDERS: dict[str, tuple[tuple[int, float], ...]] = {
    "split": tuple((step, 0.0) for step in (100, *_STEPS, 1)),
    "rk8": tuple((25, 10.0**-n) for n in range(4, 13)),
    "taylor": tuple((25, 10.0**-n) for n in (4, 5, 6, 7, 8, 9, 10, 12, 14)),
    "tsit5": tuple((500, 10.0**-n) for n in range(3, 11)),
    "rk4": tuple((step, 0.0) for step in _STEPS),
}
_QUICK: dict[str, tuple[tuple[int, float], ...]] = {
    "split": tuple((step, 0.0) for step in (50, 40, 25, 20, 10, 5)),
    "rk8": tuple((25, 10.0**-n) for n in (6, 8, 10, 12)),
    "taylor": tuple((25, 10.0**-n) for n in (5, 7, 9, 11)),
    "tsit5": tuple((500, 10.0**-n) for n in (4, 6, 8, 10)),
    "rk4": tuple((step, 0.0) for step in (50, 20, 10, 5)),
    "verlet": tuple((step, 0.0) for step in (50, 10, 5)),
    "semi-implicit-euler": tuple((step, 0.0) for step in (50, 10, 5)),
}
"""Step [us] and tolerance of each rung; an engine that is not named gets one about its own default."""
_QUICK_PEERS = 3
"""Rungs of a peer in a quick chart."""


def competitors(*, peers: bool = True) -> dict[str, Competitor]:
    """Our engines, then the peers that are installed, by name."""
    found = {name: _engine(name) for name in ENGINES}
    if peers:
        found |= {name: _peer(name) for name, peer in PEERS.items() if peer.installed}
    return found


def missing_peers() -> list[str]:
    """Libraries of peers that are not installed."""
    return sorted({peer.module for peer in PEERS.values() if not peer.installed})


def _engine(name: str) -> Competitor:
    method = ENGINES[name]

    def rungs(pairs: tuple[tuple[int, float], ...]) -> tuple[Rung, ...]:
        return tuple(
            Rung(f"{tolerance:.0e}".replace("e-0", "e-") if tolerance else f"{step} us", step, tolerance)
            for step, tolerance in pairs
        )

    own = (
        tuple((method.step_us, method.tolerance * 10.0**n) for n in (3, 2, 1, 0, -1, -2))
        if method.tolerance
        else tuple((step, 0.0) for step in _STEPS)
    )
    ladder = _LADDERS.get(name, own)
    return Competitor(name, name, OURS, rungs(ladder), rungs(_QUICK.get(name, ladder[1::2])))


def _peer(name: str) -> Competitor:
    peer = PEERS[name]
    rungs = tuple(Rung(setting.label, setting=setting) for setting in peer.ladder)
    # The coarsest, one in the middle, and the finest that is worth its time.
    picks = sorted({0, len(rungs) // 2, max(len(rungs) - 2, 0)})
    quick = tuple(rungs[i] for i in picks[:_QUICK_PEERS])
    title = peer.title + (", as installed" if peer.build == "as installed" and "Python" in peer.title else "")
    return Competitor(name, title.replace(", plain Python, as installed", ", as installed"), peer.family, rungs, quick,
                      peer.known_failure)  # fmt: skip
