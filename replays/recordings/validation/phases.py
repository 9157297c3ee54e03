"""Phases of a run, found in its recording, and their quantities, of recorded and predicted signals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from replays.estimate.runs import block_means, split_at_breaks
from replays.recordings.resimulation.prediction import Measured
from rig.channels.orbit import full_spectrum, whirl_frequency
from rig.channels.orbit import phase as phase_of

PHASES = ("free run", "impacts", "whirl", "rest", "decay")
"""Before the first contact; intermittent contact; lasting contact with and without whirl; after the last contact."""
CONTACT = ("impacts", "whirl", "rest")
"""Phases with contact between shaft and ring."""
WINDOW_S = 0.05
"""Length of the windows in which lasting contact is searched [s]."""
LASTING_PART = 0.95
"""Part of a window in contact above which contact is lasting."""
MIN_WHIRL_TURNS = 0.5
"""Turns about the ring's centre within a window above which lasting contact is whirl."""
_MIN_PHASE_S = 0.02
_CONTACT_FLOORS = 6.0
"""Reaction above which there is contact, in noise floors."""
_SIGNAL_FLOORS = 10.0
"""Standard deviation above which a signal has a spectrum other than that of noise, in floors."""


@dataclass(frozen=True)
class Phase:
    """A stretch of a recording [s]."""

    name: str
    from_s: float
    to_s: float


@dataclass(frozen=True)
class View:
    """Channels of a phase, recorded or predicted, without gaps.

    Attributes:
        times_s: Times by channel [s], each shape (n,).
        values: Values by channel, in its unit, each shape (n,).
        base: Force of each transducer at rest [N], by channel.
        touches: Distance from the ring's centre that shows contact [mm]; nan if unknown.
    """

    times_s: dict[str, np.ndarray]
    values: dict[str, np.ndarray]
    base: dict[str, float]
    touches: float

    def has(self, *names: str) -> bool:
        """Return whether all of these channels are present with samples."""
        return all(name in self.values and len(self.values[name]) > 1 for name in names)

    def force(self) -> np.ndarray:
        """Return the reaction as a vector, (P_E - P_W) + j (P_N - P_S), relative to rest [N]."""
        v, b = self.values, self.base
        x = (v["P_E"] - v["P_W"]) - (b["P_E"] - b["P_W"])
        return x + 1j * ((v["P_N"] - v["P_S"]) - (b["P_N"] - b["P_S"]))

    def radius(self) -> np.ndarray:
        """Return the distance of the shaft from the ring's centre [mm]."""
        return np.hypot(self.values["ring_x"], self.values["ring_y"])

    def contact(self) -> np.ndarray:
        """Return whether the shaft is in contact with the ring."""
        return self.radius() > self.touches


@dataclass(frozen=True)
class Reading:
    """A quantity of a phase."""

    unit: str
    title: str
    needs: tuple[str, ...]
    read: Callable[[View], float]
    phases: tuple[str, ...] = PHASES


FORCES = ("P_N", "P_S", "P_E", "P_W")
RING = ("ring_x", "ring_y")
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
    "whirl_frequency": Reading("Hz", "phase slope of the shaft in the ring; negative is backward", RING, _whirl,
                                ("whirl",)),
    "sense": Reading("", "1 forward, -1 backward", RING, lambda view: math.copysign(1.0, _whirl(view)), ("whirl",)),
    "radius": Reading("mm", "mean radius in the ring", RING, lambda view: float(view.radius().mean()),
                       ("whirl", "rest")),
    "contact_fraction": Reading("", "share of samples in contact", RING,
                                 lambda view: float(view.contact().mean()), ("impacts", "whirl", "rest")),
    "impacts": Reading("", "number of contacts", RING, _impacts, ("impacts",)),
    "mean_force": Reading("N", "mean size of the reaction, both axes", FORCES,
                           lambda view: float(np.abs(view.force()).mean()), ("impacts", "whirl", "rest")),
    "peak_force": Reading("N", "largest reaction", FORCES, lambda view: float(np.abs(view.force()).max()),
                           ("impacts", "whirl", "rest")),
    "impulse": Reading("N s", "size of the reaction over time", FORCES, _impulse, ("impacts",)),
    "ripple_x": Reading("N", "sqrt(2) RMS of P_E - P_W about its mean", FORCES, _ripple("P_E", "P_W"),
                         ("impacts", "whirl")),
    "ripple_y": Reading("N", "sqrt(2) RMS of P_N - P_S about its mean", FORCES, _ripple("P_N", "P_S"),
                         ("impacts", "whirl")),
    "orbit": Reading("mm", "RMS of the disk's orbit about its mean", _DISK, _orbit),
    "mean_x": Reading("mm", "mean of the disk, horizontal", _DISK, lambda view: float(view.values["disk_x"].mean()),
                       ("rest", "decay")),
    "mean_y": Reading("mm", "mean of the disk, vertical", _DISK, lambda view: float(view.values["disk_y"].mean()),
                       ("rest", "decay")),
    "spin": Reading("Hz", "mean of the tachometer", ("speed",), lambda view: float(view.values["speed"].mean())),
    "spin_lowest": Reading("Hz", "lowest of the tachometer, means over 5 ms", ("speed",),
                            lambda view: _lowest(view), ("impacts",)),
    # Computed from two views: see `spectrum_distance`.
    "spectrum_ring": Reading("", "distance of the full spectra of the shaft in the ring", RING, lambda _: 0.0),
    "spectrum_disk": Reading("", "distance of the full spectra of the disk", _DISK, lambda _: 0.0),
    "spectrum_force": Reading("", "distance of the full spectra of the reaction", FORCES, lambda _: 0.0),
    # From the truth, if recorded.
    "dissipated": Reading("J", "dissipated within the phase (truth)", (), lambda _: math.nan),
    "drive_work": Reading("J", "work of the drive within the phase (truth)", (), lambda _: math.nan),
}  # fmt: skip
SPECTRA = {"spectrum_ring": RING, "spectrum_disk": _DISK, "spectrum_force": FORCES}


def _lowest(view: View) -> float:
    times, speed = view.times_s["speed"], view.values["speed"]
    n = max(1, round(5e-3 / (times[1] - times[0])))
    return float(block_means(speed, n).min(initial=math.inf) if len(speed) >= n else speed.mean())


def spectrum_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the distance of two two-sided amplitude spectra, relative to their size: 0 equal, 1 nothing in common.

    This is Hellinger's distance of the two power spectra (of unit power each), including the ratio of their powers:
    half of the squared difference of the amplitudes, over their mean power. Phases are ignored.

    Args:
        a: Complex signal x + j y, shape (n,).
        b: Another one, shape (n,).
    """
    (_, x), (_, y) = (full_spectrum(signal.real, signal.imag, 1.0) for signal in (a, b))
    total = np.sum(x**2) + np.sum(y**2)
    return float(np.sqrt(np.sum((x - y) ** 2) / total)) if total > 0.0 else 0.0


def select_view(
    parts: dict[str, Measured],
    values: dict[str, np.ndarray],
    phase: Phase,
    *,
    base: dict[str, float],
    touches: float,
) -> View:
    """Return the rows of a phase, in the longest stretch without a gap."""
    times: dict[str, np.ndarray] = {}
    shown: dict[str, np.ndarray] = {}
    for name, part in parts.items():
        kept = slice(*np.searchsorted(part.times_s, (phase.from_s, phase.to_s)))
        if kept.stop - kept.start < 2:
            continue
        begin, end = max(split_at_breaks(np.diff(part.index[kept]) != 1), key=lambda pair: pair[1] - pair[0])
        stretch = slice(kept.start + begin, kept.start + end)
        for c, channel in enumerate(part.channels):
            times[channel.name] = part.times_s[stretch]
            shown[channel.name] = values[name][stretch, c]
    return View(times_s=times, values=shown, base=base, touches=touches)


def quantities(view: View, phase: str) -> dict[str, float]:
    """Return the quantities of a view, except for spectra."""
    values = {}
    for name, quantity in QUANTITIES.items():
        if phase in quantity.phases and quantity.needs and name not in SPECTRA and view.has(*quantity.needs):
            if quantity.needs == RING and not math.isfinite(view.touches) and name in ("contact_fraction", "impacts"):
                continue
            values[name] = quantity.read(view)
    return values


def spectra(a: View, b: View, floors: dict[str, float]) -> dict[str, float]:
    """Return the distances of the full spectra of two views of the same rows.

    Args:
        a: One view.
        b: The other.
        floors: Noise of each signal x + j y, by the name of its spectrum.
    """
    distances = {}
    for name, channels in SPECTRA.items():
        if a.has(*channels) and b.has(*channels) and len(a.values[channels[0]]) >= 64:
            pair = [
                view.force() if channels == FORCES else view.values[channels[0]] + 1j * view.values[channels[1]]
                for view in (a, b)
            ]
            # For a constant signal only the spectra of the noise would be compared.
            if all(signal.std() > _SIGNAL_FLOORS * floors[name] for signal in pair):
                distances[name] = spectrum_distance(*pair)
    return distances


def find_phases(view: View, *, floor_n: float) -> list[Phase]:
    """Return the phases of a whole recording.

    Contact is detected by the ring's probes; without them by the transducers, which do not distinguish lasting whirl
    from impacts; without either the whole recording is one free run.

    Args:
        view: The whole recording.
        floor_n: Noise of the reaction [N].
    """
    if view.has(*RING) and math.isfinite(view.touches):
        times, contact = view.times_s["ring_x"], view.contact()
        angle = phase_of(view.values["ring_x"], view.values["ring_y"]) / (2.0 * math.pi)
    elif view.has(*FORCES):
        times, contact = view.times_s["P_E"], np.abs(view.force()) > _CONTACT_FLOORS * floor_n
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
    stretch, kind = _find_lasting_contact(times, contact, angle)
    if kind:
        phases += [Phase("impacts", first, stretch[0]), Phase(kind, *stretch)]
        if stretch[1] < last - WINDOW_S:
            phases.append(Phase("impacts", stretch[1], last))
    else:
        phases.append(Phase("impacts", first, min(end, last + WINDOW_S)))
    phases.append(Phase("decay", phases[-1].to_s, end))
    return [phase for phase in phases if phase.to_s - phase.from_s > _MIN_PHASE_S]


def _find_lasting_contact(times: np.ndarray, contact: np.ndarray, angle: np.ndarray) -> tuple[tuple[float, float], str]:
    """Return the longest run of windows with lasting contact of one kind, and this kind or ""."""
    n = max(2, round(WINDOW_S / (times[1] - times[0])))
    starts = range(0, len(times) - n + 1, n)
    kinds = []
    for s in starts:
        held = contact[s : s + n].mean() > LASTING_PART
        round_ = abs(angle[s + n - 1] - angle[s]) > MIN_WHIRL_TURNS
        kinds.append(("whirl" if round_ else "rest") if held else "")
    labels = np.array(kinds)
    runs = [run for run in split_at_breaks(labels[1:] != labels[:-1]) if kinds and kinds[run[0]]]
    if not runs:
        return (0.0, 0.0), ""
    first, end = max(runs, key=lambda run: run[1] - run[0])
    stop = min(end * n, len(times) - 1)
    last_window = end == len(kinds)  # the rest after the last window is too short to judge
    return (float(times[first * n]), float(times[-1] + 1e-9 if last_window else times[stop])), kinds[first]
