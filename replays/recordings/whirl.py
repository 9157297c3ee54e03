"""Figures of a whirl from probes and transducers: frequency, sense of rotation, slip and reactions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recorder.contents.samples import Samples
from recorder.reader import Recording
from rig.base.errors import InputError, Words
from rig.channels.orbit import whirl_frequency


@dataclass(frozen=True)
class WhirlFigures:
    """Figures of an interval of whirl in a recording.

    Attributes:
        from_s: Start of the interval, simulated [s].
        to_s: End of the interval [s].
        frequency_hz: Phase slope of x + j y of the shaft in the ring; negative is backward [Hz].
        disk_frequency_hz: Phase slope of the probes at the disk [Hz].
        spin_hz: Mean spin from the keyphasor's edges [Hz].
        radius_m: Mean radius of the orbit in the ring [m].
        law_hz: -spin R_S / radius, rolling without slip [Hz].
        slip: 1 - frequency / law; 0 for rolling.
        reaction_x_n: Amplitude of P_E - P_W, half of peak to peak [N].
        reaction_y_n: Amplitude of P_N - P_S, half of peak to peak [N].
    """

    from_s: float
    to_s: float
    frequency_hz: float
    disk_frequency_hz: float
    spin_hz: float
    radius_m: float
    law_hz: float
    slip: float
    reaction_x_n: float
    reaction_y_n: float


def whirl_figures(recording: Recording, from_s: float, to_s: float) -> WhirlFigures:
    """Compute the figures of an interval.

    Raises:
        InputError: The interval has too few samples or turns.
    """
    probes, forces = recording.samples("probes"), recording.samples("forces")
    kept = (probes.times_s >= from_s) & (probes.times_s < to_s)
    edges = recording.edges()
    edges = edges[(edges >= from_s) & (edges < to_s)]
    if kept.sum() < 1000 or len(edges) < 3:
        raise InputError(
            "recording",
            "long enough for a whirl (three turns of the shaft)",
            Words(f"{from_s:.2f} to {to_s:.2f} s"),
        )
    times = probes.times_s[kept]
    ring_x, ring_y = (probes[name][kept] * 1e-3 for name in ("ring_x", "ring_y"))
    frequency = whirl_frequency(ring_x, ring_y, times)
    spin = (len(edges) - 1) / (edges[-1] - edges[0])
    radius = float(np.hypot(ring_x, ring_y).mean())
    law = -spin * shaft_radius_m(recording) / radius
    held = (forces.times_s >= from_s) & (forces.times_s < to_s)
    pairs = [reaction[held] for reaction in reactions(forces)]
    return WhirlFigures(
        from_s=from_s,
        to_s=to_s,
        frequency_hz=frequency,
        disk_frequency_hz=whirl_frequency(probes["disk_x"][kept], probes["disk_y"][kept], times),
        spin_hz=float(spin),
        radius_m=radius,
        law_hz=float(law),
        slip=float(1.0 - frequency / law),
        reaction_x_n=float(np.ptp(pairs[0]) / 2),
        reaction_y_n=float(np.ptp(pairs[1]) / 2),
    )


def reactions(forces: Samples) -> tuple[np.ndarray, np.ndarray]:
    """Return the differences of opposite transducers, P_E - P_W and P_N - P_S [N], each shape (n,)."""
    return forces["P_E"] - forces["P_W"], forces["P_N"] - forces["P_S"]


def parameter_si(recording: Recording, key: str) -> float:
    """Return a parameter of the recorded rig in SI units."""
    from rig.physics.parameters import SI

    entry = recording.parameters["values"][key]
    return float(entry.get("resolved", entry["value"])) * SI[entry["unit"]]


def shaft_radius_m(recording: Recording) -> float:
    """Return the shaft radius R_S of the recorded rig [m]."""
    return parameter_si(recording, "shaft.radius")
