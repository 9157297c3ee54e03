"""Picture of a hammer recording, in the style of the paper's figures 12 to 16."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from recorder.reader import Recording
from replays.plots.spectra import full_spectrum, waterfall
from replays.recordings.verdict import hammer_time_s
from replays.recordings.whirl import parameter_si, reactions, whirl_figures
from replays.report.canvas import BLACK, BLUE, GREEN, RED, draw_signals, house_style, new_figure, save
from rig.channels.orbit import SPECTRUM_HZ

_BEFORE, _IMPACTS, _WHIRL = GREEN, RED, BLUE
_X, _Y = BLUE, RED


@house_style()
def draw(recording: Recording, path: Path) -> None:
    """Draw the picture and write it as PNG or SVG.

    Raises:
        InputError: There is no hammer pulse in the recording, or the file is neither .png nor .svg.
    """
    probes, forces, drive = recording.samples("probes"), recording.samples("forces"), recording.samples("drive")
    hammer_s = hammer_time_s(recording)
    end_s = float(probes.times_s[-1])
    figures = whirl_figures(recording, max(hammer_s + 0.5, end_s - 2.0), end_s)
    scene, parameters = recording.scene["name"], recording.parameters["set"]
    figure = new_figure(
        9.6,
        f"Scene {scene}, parameter set {parameters}, hammer at {hammer_s:.2f} s:\nwhirl "
        f"at {figures.frequency_hz:.2f} Hz, spin at {figures.spin_hz:.3f} Hz, read off the recording",
    )
    axes = figure.subplots(3, 3)
    impacts, whole = (hammer_s - 0.01, hammer_s + 0.12), (float(probes.times_s[0]), end_s)
    _draw_orbit(axes[0, 0], recording, hammer_s, end_s)
    disk = (probes["disk_x"], probes["disk_y"])
    for ax, window, title in (
        (axes[0, 1], whole, "Displacement"),
        (axes[0, 2], impacts, "Displacement, first impacts"),
    ):
        _draw_pair(ax, probes.times_s, disk, window, ("x", "y"))
        ax.set(title=title, ylabel="displacement at the disk [mm]")

    ax = axes[1, 0]
    kept = (drive.times_s >= hammer_s - 0.5) & (drive.times_s < hammer_s + 2.5)
    draw_signals(ax, drive.times_s[kept], (drive["speed"][kept], BLACK, "speed"))
    ax.axvline(hammer_s, color="0.5", lw=0.9, ls=":", label="hammer")
    ax.set(title="Spin, around the hammer", xlabel="time [s]", ylabel="spin speed [Hz]")
    ax.legend(loc="lower right")

    pairs = reactions(forces)
    settled = (end_s - 0.05, end_s)
    # The housings vibrate at some kilohertz, which a longer panel would not resolve.
    largest = np.abs(pairs).max(axis=0)
    onset_s = float(forces.times_s[int(np.argmax((largest > 0.1 * largest.max()) & (forces.times_s > hammer_s)))])
    for ax, window, title in (
        (axes[1, 1], whole, "Reactions"),
        (axes[1, 2], (onset_s - 0.002, onset_s + 0.018), "Reactions, first impacts"),
        (axes[2, 0], settled, "Reactions, settled whirl"),
    ):
        _draw_pair(ax, forces.times_s, pairs, window, ("E − W", "N − S"))
        ax.set(title=title, ylabel="force [N]")

    (panel,), _ = full_spectrum(recording, pair="disk", last_s=2.0, max_hz=SPECTRUM_HZ, axes=axes[2, 1])
    for text in list(panel.texts):
        text.remove()  # the law has its place
    law = panel.axvline(
        figures.law_hz, color=RED, ls="--", lw=1.4, label=f"−Ω Rₛ/(r₀ + δ) = −{abs(figures.law_hz):.1f} Hz"
    )
    panel.set(title="Full spectrum, settled whirl", ylim=(panel.get_ylim()[0], 100.0))
    panel.legend(handles=[law], loc="upper right")
    waterfall(recording, pair="disk", max_hz=SPECTRUM_HZ, window_s=0.2, axes=axes[2, 2])
    axes[2, 2].axhline(hammer_s, color="w", lw=0.9, ls=":")
    axes[2, 2].set(title="Full-spectrum waterfall")
    save(figure, path)


def _draw_orbit(ax: Any, recording: Recording, hammer_s: float, end_s: float) -> None:
    """Draw the orbit of the disk within the clearance, as in Fig. 12 a."""
    probes = recording.samples("probes")
    circle = 2 * math.pi * np.linspace(0, 1, 361)
    reach = (
        parameter_si(recording, "ring.clearance")
        * parameter_si(recording, "shaft.arm_disk")
        / parameter_si(recording, "shaft.arm_ring")
        * 1e3
    )
    ax.plot(reach * np.cos(circle), reach * np.sin(circle), color=BLACK, ls="--", lw=1, label="clearance")
    for label, color, low, high in (
        ("before", _BEFORE, hammer_s - 0.5, hammer_s),
        ("impacts", _IMPACTS, hammer_s, hammer_s + 0.06),
        ("whirl", _WHIRL, end_s - 0.2, end_s),
    ):
        kept = (probes.times_s >= low) & (probes.times_s < high)
        ax.plot(probes["disk_x"][kept], probes["disk_y"][kept], color=color, lw=1.0, label=label)
    ax.set(title="Orbit at the disk", xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    # Empty area above the orbit for the legend.
    ax.set_ylim(top=1.75 * ax.get_ylim()[1])
    ax.legend(loc="upper center", ncols=2, handlelength=1.2, columnspacing=1.0)


def _draw_pair(
    ax: Any,
    times_s: np.ndarray,
    pair: tuple[np.ndarray, np.ndarray],
    window: tuple[float, float],
    names: tuple[str, str],
) -> None:
    """Draw two perpendicular signals over a window."""
    kept = (times_s >= window[0]) & (times_s < window[1])
    draw_signals(ax, times_s[kept], (pair[0][kept], _X, names[0]), (pair[1][kept], _Y, names[1]))
    ax.set(xlabel="time [s]", xlim=window)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.35 * (high - low))
    found = {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    ax.legend(found.values(), found.keys(), loc="upper center", ncols=2, handlelength=1.2, columnspacing=1.0)
