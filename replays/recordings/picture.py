"""One picture of a hammer recording, in the manner of the paper's figures 12 to 16."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from recorder.reader import Recording
from replays.recordings.verdict import hammer_time_s
from replays.recordings.whirl import parameter_si, reactions, whirl_figures
from replays.report.canvas import new_figure, save
from rig.orbit import SPECTRUM_HZ, full_spectrum, waterfall

_BEFORE, _IMPACTS, _WHIRL = "#4c9f70", "#d1495b", "#30638e"


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
        (15.0, 10.0),
        f"Virtual rotor-stator rig: scene {scene}, parameters {parameters}, hammer at {hammer_s:.2f} s; "
        f"whirl {figures.frequency_hz:.2f} Hz at {figures.spin_hz:.3f} Hz spin (from the recorded samples)",
        title_size=13,
    )
    axes = figure.subplots(3, 3, width_ratios=[1, 1, 1])

    # Orbit of the disk within the clearance, as Fig. 12 a.
    ax = axes[0, 0]
    circle = 2 * math.pi * np.linspace(0, 1, 361)
    reach = (
        parameter_si(recording, "ring.clearance")
        * parameter_si(recording, "shaft.arm_disk")
        / parameter_si(recording, "shaft.arm_ring")
        * 1e3
    )
    ax.plot(reach * np.cos(circle), reach * np.sin(circle), "k--", lw=1, label="clearance at rest")
    for label, color, low, high in (
        ("impacts", _IMPACTS, hammer_s, hammer_s + 0.06),
        ("whirl", _WHIRL, end_s - 0.2, end_s),
        ("before", _BEFORE, hammer_s - 0.5, hammer_s),
    ):
        kept = (probes.times_s >= low) & (probes.times_s < high)
        ax.plot(probes.column("disk_x")[kept], probes.column("disk_y")[kept], color=color, lw=0.8, label=label)
    ax.set(title="Orbit at the disk", xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), fontsize=8)

    # Displacement, whole run and first impacts.
    for ax, low, high, title in (
        (axes[0, 1], probes.times_s[0], end_s, "Displacement at the disk"),
        (axes[0, 2], hammer_s - 0.01, hammer_s + 0.12, "First impacts"),
    ):
        kept = (probes.times_s >= low) & (probes.times_s < high)
        # Over the whole run a whirl is a band: both must show through.
        width, opacity = (0.5, 0.5) if high == end_s else (1.0, 1.0)
        for name, color in (("disk_x", _WHIRL), ("disk_y", _IMPACTS)):
            ax.plot(probes.times_s[kept], probes.column(name)[kept], color=color, lw=width, alpha=opacity, label=name)
        ax.set(title=title, xlabel="time [s]", ylabel="[mm]", xlim=(low, high))
        ax.legend(loc="lower right", fontsize=8)

    ax = axes[1, 0]
    ax.plot(drive.times_s[::20], drive.column("speed")[::20], color=_WHIRL, lw=0.8)
    ax.axvline(hammer_s, color="0.5", lw=0.8, ls=":")
    ax.set(title="Spin speed", xlabel="time [s]", ylabel="[Hz]", xlim=(drive.times_s[0], end_s))
    ax.set_ylim(bottom=0, top=1.1 * float(drive.column("speed").max()))

    pair_x, pair_y = reactions(forces)
    for ax, low, high, title in (
        (axes[1, 1], forces.times_s[0], end_s, "Reactions"),
        (axes[1, 2], hammer_s - 0.01, hammer_s + 0.12, "Reactions, first impacts"),
        (axes[2, 0], end_s - 0.05, end_s, "Reactions, settled whirl"),
    ):
        kept = (forces.times_s >= low) & (forces.times_s < high)
        width, opacity = (0.5, 0.5) if title == "Reactions" else (1.0, 1.0)
        ax.plot(forces.times_s[kept], pair_x[kept], color=_WHIRL, lw=width, alpha=opacity, label="E - W")
        ax.plot(forces.times_s[kept], pair_y[kept], color=_IMPACTS, lw=width, alpha=opacity, label="N - S")
        ax.set(title=title, xlabel="time [s]", ylabel="[N]", xlim=(low, high))
        ax.legend(loc="lower right", fontsize=8)

    ax = axes[2, 1]
    kept = probes.times_s >= end_s - 2.0
    disk_x, disk_y = probes.column("disk_x"), probes.column("disk_y")
    frequency, amplitude = full_spectrum(disk_x[kept], disk_y[kept], probes.rate_hz)
    near = np.abs(frequency) <= SPECTRUM_HZ
    ax.semilogy(frequency[near], np.maximum(amplitude[near], 1e-5), color=_WHIRL, lw=0.8)
    ax.axvline(figures.law_hz, color="0.4", ls=":", lw=1, label=f"-spin R_S/(r0+delta) = {figures.law_hz:.1f} Hz")
    ax.set(title="Full spectrum, settled whirl", xlabel="backward  -  frequency [Hz]  -  forward", ylabel="[mm]")
    ax.legend(loc="upper right", fontsize=8)

    ax = axes[2, 2]
    times, frequency, amplitude = waterfall(probes.times_s, disk_x, disk_y, probes.rate_hz)
    level = 20 * np.log10(np.maximum(amplitude * 1e3, 1e-2))
    mesh = ax.pcolormesh(frequency, times, level, shading="nearest", cmap="viridis", vmin=-20, vmax=65, rasterized=True)
    figure.colorbar(mesh, ax=ax, label="[dB re 1 µm]")
    ax.axhline(hammer_s, color="w", lw=0.8, ls=":")
    ax.set(title="Full-spectrum waterfall", xlabel="backward  -  frequency [Hz]  -  forward", ylabel="time [s]")
    save(figure, path)
