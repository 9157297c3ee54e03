"""Methods of a chart: our engines and the peers, each with its ladder of settings."""

from __future__ import annotations

from dataclasses import dataclass

from replays.studies.common.engines import settings as engine_settings
from replays.studies.peers import PEERS, Setting
from rig.physics.engines import ENGINES

RIG_FAMILY = "rig"
"""Family of our own engines."""
ADDED_FAMILY = "added by file"
"""Family of solvers outside the project, as added by `rig chart --add`."""


@dataclass(frozen=True)
class Competitor:
    """A method and its ladder of settings, coarsest first."""

    name: str
    title: str
    family: str
    settings: tuple[Setting, ...]
    quick: tuple[Setting, ...]
    known_failure: str = ""

    @property
    def ours(self) -> bool:
        """True for an engine of the rig."""
        return self.family == RIG_FAMILY

    def takes(self, friction: str) -> bool:
        """Return whether the method supports a friction law."""
        if self.ours:
            return friction in ENGINES[self.name].frictions
        return friction != "exact" or PEERS[self.name].exact_friction


_QUICK_PEERS = 3
"""Number of settings of a peer in a quick chart."""


def competitors(*, peers: bool = True) -> dict[str, Competitor]:
    """Return our engines and the installed peers by name."""
    methods = {name: _engine(name) for name in ENGINES}
    if peers:
        methods |= {name: _peer(name) for name, peer in PEERS.items() if peer.installed}
    return methods


def missing_peers() -> list[str]:
    """Return the libraries of peers that are not installed."""
    return sorted({peer.module for peer in PEERS.values() if not peer.installed})


def _engine(name: str) -> Competitor:
    def settings(*, quick: bool) -> tuple[Setting, ...]:
        return tuple(
            Setting(f"{tolerance:.0e}".replace("e-0", "e-") if tolerance else f"{step} us", tolerance, step_us=step)
            for step, tolerance in engine_settings(name, quick=quick)
        )

    return Competitor(name, name, RIG_FAMILY, settings(quick=False), settings(quick=True))


def _peer(name: str) -> Competitor:
    peer = PEERS[name]
    # The coarsest setting, one in the middle, and the finest with a reasonable run time.
    picks = sorted({0, len(peer.ladder) // 2, max(len(peer.ladder) - 2, 0)})
    quick = tuple(peer.ladder[i] for i in picks[:_QUICK_PEERS]) if peer.quick else ()
    title = peer.title.replace(", plain Python", ", as installed")
    return Competitor(name, title, peer.family, peer.ladder, quick, peer.known_failure)
