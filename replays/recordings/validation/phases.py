"""Phases of a run, read off its recording, and the quantities of each; recorded and predicted are read alike."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from replays.estimate.runs import block_means, split_at
from replays.recordings.resimulation.prediction import Measured
from rig.channels.orbit import full_spectrum, whirl_frequency
from rig.channels.orbit import phase as phase_of

PHASES = ("free run", "impacts", "whirl", "rest", "decay")
"""Before the first contact; contact that comes and goes; lasting contact that goes round, or does not; after it."""
CONTACT = ("impacts", "whirl", "rest")
"""Those in which the shaft touches the ring."""
WINDOW_S = 0.05
"""Lasting contact is looked for in windows of this length [s]."""
LASTING = 0.95
"""Part of such a window in contact from which it lasts."""
TURNS = 0.5
"""Turns about the ring's centre within a window from which it goes round."""
_SHORTEST_S = 0.02
_CLEAR = 6.0
"""Contact is told from noise by so many floors."""
_LOUD = 10.0
"""A signal has a spectrum of its own above so many floors."""


@dataclass(frozen=True)
class Phase:
    """A stretch of a recording [s]."""

    name: str
    from_s: float
    to_s: float


@dataclass(frozen=True)
class View:
    """A phase of one set of channels, recorded or predicted, without gaps.

    Attributes:
        times_s: By channel [s], each shape (n,).
        values: By channel, in its unit, each shape (n,).
        base: What each force transducer shows at rest [N], by channel.
        touches: r0 as a contact shows it, from the ring's centre [mm]; nan where it is not known.
    """

    times_s: dict[str, np.ndarray]
    values: dict[str, np.ndarray]
    base: dict[str, float]
    touches: float

    def has(self, *names: str) -> bool:
        """Whether all of these channels are there, with samples."""
        return all(name in self.values and len(self.values[name]) > 1 for name in names)

    def force(self) -> np.ndarray:
        """Reaction as a vector, (P_E - P_W) + j (P_N - P_S), from its value at rest [N]."""
        v, b = self.values, self.base
        x = (v["P_E"] - v["P_W"]) - (b["P_E"] - b["P_W"])
        return x + 1j * ((v["P_N"] - v["P_S"]) - (b["P_N"] - b["P_S"]))

    def radius(self) -> np.ndarray:
        """Shaft from the ring's centre [mm]."""
        return np.hypot(self.values["ring_x"], self.values["ring_y"])

    def contact(self) -> np.ndarray:
        """Whether the shaft presses into the ring."""
        return self.radius() > self.touches


@dataclass(frozen=True)
class Reading:
    """One number of a phase."""

    unit: str
    title: str
    needs: tuple[str, ...]
    read: Callable[[View], float]
    phases: tuple[str, ...] = PHASES


_FORCES = ("P_N", "P_S", "P_E", "P_W")
_RING = ("ring_x", "ring_y")
_DISK = ("disk_x", "disk_y")


def _whirl(view: View) -> float:
    return whirl_frequency(view.values["ring_x"], view.values["ring_y"], view.times_s["ring_x"])


def _impacts(view: View) -> float:
    contact = view.contact()
    return float(np.count_nonzero(contact[1:] & ~contact[:-1]) + contact[0])


def _ripple(name_a: str, name_b: str) -> Callable[[View], float]:
    return lambda view: float(math.sqrt(2.0) * np.std(view.values[name_a] - view.values[name_b]))


def _impulse(view: View) -> float:
    times = view.times_s["P_E"]
    return float(np.abs(view.force()).mean() * (times[-1] - times[0]))


def _orbit(view: View) -> float:
    return float(math.sqrt(np.var(view.values["disk_x"]) + np.var(view.values["disk_y"])))


QUANTITIES = {
    "whirl_frequency": Reading("Hz", "phase slope of the shaft in the ring; negative is backward", _RING, _whirl,
                                ("whirl",)),
    "sense": Reading("", "1 forward, -1 backward", _RING, lambda view: math.copysign(1.0, _whirl(view)), ("whirl",)),
    "radius": Reading("mm", "mean radius in the ring", _RING, lambda view: float(view.radius().mean()),
                       ("whirl", "rest")),
    "contact_fraction": Reading("", "share of samples in contact", _RING,
                                 lambda view: float(view.contact().mean()), ("impacts", "whirl", "rest")),
    "impacts": Reading("", "contacts that begin", _RING, _impacts, ("impacts",)),
    "mean_force": Reading("N", "mean size of the reaction, both axes", _FORCES,
                           lambda view: float(np.abs(view.force()).mean()), ("impacts", "whirl", "rest")),
    "peak_force": Reading("N", "largest reaction", _FORCES, lambda view: float(np.abs(view.force()).max()),
                           ("impacts", "whirl", "rest")),
    "impulse": Reading("N s", "size of the reaction over time", _FORCES, _impulse, ("impacts",)),
    "ripple_x": Reading("N", "sqrt(2) RMS of P_E - P_W about its mean", _FORCES, _ripple("P_E", "P_W"),
                         ("impacts", "whirl")),
    "ripple_y": Reading("N", "sqrt(2) RMS of P_N - P_S about its mean", _FORCES, _ripple("P_N", "P_S"),
                         ("impacts", "whirl")),
    "orbit": Reading("mm", "RMS of the disk's orbit about its mean", _DISK, _orbit),
    "mean_x": Reading("mm", "mean of the disk, horizontal", _DISK, lambda view: float(view.values["disk_x"].mean()),
                       ("rest", "decay")),
    "mean_y": Reading("mm", "mean of the disk, vertical", _DISK, lambda view: float(view.values["disk_y"].mean()),
                       ("rest", "decay")),
    "spin": Reading("Hz", "mean of the tachometer", ("speed",), lambda view: float(view.values["speed"].mean())),
    "spin_lowest": Reading("Hz", "lowest of the tachometer, means over 5 ms", ("speed",),
                            lambda view: _lowest(view), ("impacts",)),
    # Read off two views at once: see `spectrum_distance`.
    "spectrum_ring": Reading("", "distance of the full spectra of the shaft in the ring", _RING, lambda _: 0.0),
    "spectrum_disk": Reading("", "distance of the full spectra of the disk", _DISK, lambda _: 0.0),
    "spectrum_force": Reading("", "distance of the full spectra of the reaction", _FORCES, lambda _: 0.0),
    # From the truth, where it was recorded.
    "dissipated": Reading("J", "dissipated within the phase (truth)", (), lambda _: math.nan),
    "drive_work": Reading("J", "work of the drive within the phase (truth)", (), lambda _: math.nan),
}  # fmt: skip
SPECTRA = {"spectrum_ring": _RING, "spectrum_disk": _DISK, "spectrum_force": _FORCES}


def _lowest(view: View) -> float:
    times, speed = view.times_s["speed"], view.values["speed"]
    n = max(1, round(5e-3 / (times[1] - times[0])))
    return float(block_means(speed, n).min(initial=math.inf) if len(speed) >= n else speed.mean())


def spectrum_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Distance of two two-sided amplitude spectra, as a part of their size: 0 equal, 1 nothing in common.

    Hellinger's distance of the two power spectra (of unit power each) with the ratio of their powers in it: half of
    the squared difference of the amplitudes, over their mean power. Phases do not count.

    Args:
        a: Complex signal x + j y, shape (n,).
        b: Another, shape (n,).
    """
    (_, x), (_, y) = (full_spectrum(signal.real, signal.imag, 1.0) for signal in (a, b))
    total = np.sum(x**2) + np.sum(y**2)
    return float(np.sqrt(np.sum((x - y) ** 2) / total)) if total > 0.0 else 0.0


def view_of(
    parts: dict[str, Measured],
    values: dict[str, np.ndarray],
    phase: Phase,
    *,
    base: dict[str, float],
    touches: float,
) -> View:
    """The rows of a phase, of the longest stretch without a gap."""
    times: dict[str, np.ndarray] = {}
    shown: dict[str, np.ndarray] = {}
    for name, part in parts.items():
        kept = slice(*np.searchsorted(part.times_s, (phase.from_s, phase.to_s)))
        if kept.stop - kept.start < 2:
            continue
        begin, end = max(split_at(np.diff(part.index[kept]) != 1), key=lambda pair: pair[1] - pair[0])
        stretch = slice(kept.start + begin, kept.start + end)
        for c, channel in enumerate(part.channels):
            times[channel.name] = part.times_s[stretch]
            shown[channel.name] = values[name][stretch, c]
    return View(times_s=times, values=shown, base=base, touches=touches)


def quantities(view: View, phase: str) -> dict[str, float]:
    """What can be read off one view; spectra are not in it."""
    found = {}
    for name, quantity in QUANTITIES.items():
        if phase in quantity.phases and quantity.needs and name not in SPECTRA and view.has(*quantity.needs):
            if quantity.needs == _RING and not math.isfinite(view.touches) and name in ("contact_fraction", "impacts"):
                continue
            found[name] = quantity.read(view)
    return found


def spectra(a: View, b: View, floors: dict[str, float]) -> dict[str, float]:
    """Distances of the full spectra of two views of the same rows.

    Args:
        a: One view.
        b: The other.
        floors: Noise of each signal x + j y, by the name of its spectrum.
    """
    found = {}
    for name, channels in SPECTRA.items():
        if a.has(*channels) and b.has(*channels) and len(a.values[channels[0]]) >= 64:
            pair = [
                view.force() if channels == _FORCES else view.values[channels[0]] + 1j * view.values[channels[1]]
                for view in (a, b)
            ]
            # Of a signal that stands still, only the spectrum of the noise would be compared.
            if all(signal.std() > _LOUD * floors[name] for signal in pair):
                found[name] = spectrum_distance(*pair)
    return found


def find_phases(view: View, *, floor_n: float) -> list[Phase]:
    """Phases of a whole recording.

    Contact is seen by the ring's probes; without them by the transducers, of which a contact in lasting whirl is not
    told from impacts; without either the whole recording is one free run.

    Args:
        view: All of it.
        floor_n: Noise of the reaction [N].
    """
    if view.has(*_RING) and math.isfinite(view.touches):
        times, contact = view.times_s["ring_x"], view.contact()
        angle = phase_of(view.values["ring_x"], view.values["ring_y"]) / (2.0 * math.pi)
    elif view.has(*_FORCES):
        times, contact = view.times_s["P_E"], np.abs(view.force()) > _CLEAR * floor_n
        angle = np.zeros(len(times))
    else:
        times = next(iter(view.times_s.values()))
        return [Phase("free run", float(times[0]), float(times[-1]) + 1e-9)]
    begin, end = float(times[0]), float(times[-1]) + 1e-9
    touching = np.flatnonzero(contact)
    if not len(touching):
        return [Phase("free run", begin, end)]
    first, last = float(times[touching[0]]), float(times[touching[-1]])
    phases = [Phase("free run", begin, first)]
    stretch, kind = _lasting(times, contact, angle)
    if kind:
        phases += [Phase("impacts", first, stretch[0]), Phase(kind, *stretch)]
        if stretch[1] < last - WINDOW_S:
            phases.append(Phase("impacts", stretch[1], last))
    else:
        phases.append(Phase("impacts", first, min(end, last + WINDOW_S)))
    phases.append(Phase("decay", phases[-1].to_s, end))
    return [phase for phase in phases if phase.to_s - phase.from_s > _SHORTEST_S]


def _lasting(times: np.ndarray, contact: np.ndarray, angle: np.ndarray) -> tuple[tuple[float, float], str]:
    """The longest run of windows with lasting contact of one kind, and its kind; "" where there is none."""
    n = max(2, round(WINDOW_S / (times[1] - times[0])))
    starts = range(0, len(times) - n + 1, n)
    kinds = []
    for s in starts:
        held = contact[s : s + n].mean() > LASTING
        round_ = abs(angle[s + n - 1] - angle[s]) > TURNS
        kinds.append(("whirl" if round_ else "rest") if held else "")
    alike = np.array(kinds)
    runs = [run for run in split_at(alike[1:] != alike[:-1]) if kinds and kinds[run[0]]]
    if not runs:
        return (0.0, 0.0), ""
    first, end = max(runs, key=lambda run: run[1] - run[0])
    stop = min(end * n, len(times) - 1)
    last_window = end == len(kinds)  # what is left behind the last window is too short to judge
    return (float(times[first * n]), float(times[-1] + 1e-9 if last_window else times[stop])), kinds[first]
