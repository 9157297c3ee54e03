"""Who takes part in a chart: our engines and the peers, each with its ladder of settings."""

from __future__ import annotations

from dataclasses import dataclass

from replays.studies.common.engines import settings as engine_settings
from replays.studies.peers import PEERS, Setting
from rig.physics.engines import ENGINES

OURS = "rig"
"""Family of our own engines."""
ADDED = "added by file"
"""Family of solvers that are not part of the project, as `rig chart --add` adds them."""


@dataclass(frozen=True)
class Competitor:
    """A method and its ladder of settings, the coarsest first."""

    name: str
    title: str
    family: str
    settings: tuple[Setting, ...]
    quick: tuple[Setting, ...]
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


_QUICK_PEERS = 3
"""Settings of a peer in a quick chart."""


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
    def settings(*, quick: bool) -> tuple[Setting, ...]:
        return tuple(
            Setting(f"{tolerance:.0e}".replace("e-0", "e-") if tolerance else f"{step} us", tolerance, step_us=step)
            for step, tolerance in engine_settings(name, quick=quick)
        )

    return Competitor(name, name, OURS, settings(quick=False), settings(quick=True))


def _peer(name: str) -> Competitor:
    peer = PEERS[name]
    # The coarsest, one in the middle, and the finest that is worth its time.
    picks = sorted({0, len(peer.ladder) // 2, max(len(peer.ladder) - 2, 0)})
    quick = tuple(peer.ladder[i] for i in picks[:_QUICK_PEERS]) if peer.quick else ()
    title = peer.title.replace(", plain Python", ", as installed")
    return Competitor(name, title, peer.family, peer.ladder, quick, peer.known_failure)
