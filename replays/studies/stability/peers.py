"""Known silent errors of other solvers, in cases short enough to run every time."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from replays.studies.peers import PEERS, Problem, Setting
from replays.studies.peers.common.window import cut_window
from replays.studies.stability.trials.cell import Cell
from replays.studies.stability.trials.flight import house_energy, house_oscillator
from replays.studies.stability.trials.motion import quiet_inputs, state
from rig.physics.kernels.laws.contact import FLIGHT
from rig.physics.kernels.signals import N_STATE
from rig.run.scenes import load_scene


def peer_cells(trial: str) -> Iterator[Cell]:
    """Yield the cells of other solvers in one trial; those not installed are skipped with a reason."""
    for name, case, tolerance, expected, because in _KNOWN.get(trial, ()):
        peer = PEERS[name]
        value = _RUNS[trial](name, tolerance) if peer.installed else math.nan
        missing = "" if peer.installed else f"needs {peer.module}: pip install 'rotor-stator-rig[peers]'"
        yield Cell(case, value, _LIMIT, because, expected, trial=trial, method=name, skipped=missing)


def _ring_down(name: str, tolerance: float) -> float:
    """Return |E/E0 - 1| of the undamped housing mode after 0.2 s."""
    constants, mode = house_oscillator()
    y0 = state(y_ih=1e-5 * mode.inner, y_oh=1e-5 * mode.outer)
    problem = _problem("ring-down", constants, quiet_inputs(), y0, 0.2)
    states = PEERS[name].solve(problem, Setting(f"{tolerance:g}", tolerance), budget_s=20.0).states
    energy = house_energy(constants, states)
    return abs(float(energy[-1] / energy[0]) - 1.0)


def _hammer(name: str, tolerance: float) -> float:
    """Return the missing part of the pulse's work for a pulse at 0.5 s on a rig at a standstill."""
    scene = load_scene("hammer", {"drive.speed_hz": 0.0, "duration_s": 0.6})
    command = scene.commands[0].model_copy(update={"at_s": 0.5})
    scene = scene.model_copy(update={"commands": (command,)})
    problem = cut_window(scene, end_s=0.5051, sample_s=1e-3, friction="smoothed")
    states = PEERS[name].solve(problem, Setting(f"{tolerance:g}", tolerance), budget_s=20.0).states
    right = PEERS["scipy-dop853"].solve(problem, Setting("1e-8", 1e-8), budget_s=20.0).states
    return abs(float(states[-1, 8] / right[-1, 8]) - 1.0)


def _problem(name: str, constants, inputs, y0: np.ndarray, duration_s: float) -> Problem:
    return Problem(
        name=name, constants=constants, inputs=inputs, y0=y0[:N_STATE], phase=FLIGHT,
        onset_speed=constants.contact.speed_floor, times=np.linspace(0.0, duration_s, 201),
    )  # fmt: skip


_RUNS = {"T1": _ring_down, "T5": _hammer}
_LIMIT = 0.01
_KNOWN: dict[str, tuple[tuple[str, str, float, bool, str], ...]] = {
    "T1": (
        (
            "scipy-lsoda",
            "tolerance 1e-3",
            1e-3,
            False,
            "multistep methods grow or damp what is near the imaginary axis",
        ),
        ("cvode-bdf", "tolerance 1e-4", 1e-4, False, "BDF of order 3 and up is unstable near the imaginary axis"),
        ("scipy-dop853", "tolerance 1e-8", 1e-8, True, "a one-step method of order 8 at a fine tolerance"),
    ),
    "T5": (
        ("scipy-bdf-no-stops", "no stop at the corners", 1e-3, False, "steps over the pulse"),
        ("scipy-bdf", "stops at the corners", 1e-6, True, "restarts at the pulse's corners"),
    ),
}
"""Peer, case, tolerance, expected verdict and its reason, by trial."""
