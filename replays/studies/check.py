"""Accuracy check of a run: the rows that were written, compared with a second run of the scene on another engine."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from replays.studies.common.run import bare_sensors, run_scene
from replays.studies.peers.common.problem import scaled_error
from rig.base.errors import InputError
from rig.channels.orbit import whirl_frequency
from rig.physics.engines import ENGINES
from rig.physics.kernels.signals import COLUMN
from rig.run.scenes import Scene, parse_scene
from rig.run.simulation import Frame, Simulation

MAX_BRANCH_ERROR = 0.1
"""Scaled error from which two runs no longer describe the same motion."""
_REFERENCE_TOLERANCE = 1e-12
"""Scaled error of a step of the reference run; its total error is then about 1e-9 in impacts and 1e-5 in bounces."""
_REFERENCES = ("taylor", "rk8", "tsit5", next(iter(ENGINES)))
"""Engines for the reference run, the most accurate first; the default engine alone supports rigid impacts."""
_SAME_ENGINE_REFINEMENT = 0.01
"""Factor on the tolerance if only the run's own engine supports the model."""
_SETTLED_SHARE, _MIN_SETTLED_ROWS = 0.25, 20
"""Last part of a run in which the whirl is measured, and its minimum number of rows."""
_MIN_WHIRL_RADIUS = 0.5
"""Smallest orbit radius that has a whirl frequency, as a share of the clearance."""


class Quantities(NamedTuple):
    """Quantities of a run: contacts, largest contact force [N], whirl frequency [Hz] and mean radius [um] at the end.

    Frequency and radius are NaN if the shaft does not whirl by a turn in the last quarter of the run.
    """

    contacts: int
    peak_force_n: float
    frequency_hz: float = math.nan
    radius_um: float = math.nan


@dataclass(frozen=True)
class Check:
    """Comparison of two runs of a scene.

    Attributes:
        reference: Engine and tolerance of the second run, in words.
        error: RMS distance of the scaled states at the truth's rate, as in the charts.
        parted_s: First time at which a scaled state differs by `MAX_BRANCH_ERROR`, or None.
        quantities: Quantities of the run and of the reference run.
    """

    reference: str
    error: float
    parted_s: float | None
    quantities: tuple[Quantities, Quantities]

    @property
    def informs(self) -> bool:
        """False if both runs are identical, so that their difference is no error estimate."""
        return self.error > 0.0

    @property
    def wrong_branch(self) -> bool:
        """True if the run probably follows another branch of motion than the model.

        Contacts alone do not decide: bounces that die out end in ever more and ever smaller contacts.
        """
        contacts = [each.contacts for each in self.quantities]
        miscounted = abs(contacts[0] - contacts[1]) > 0.2 * max(contacts)
        return self.error > MAX_BRANCH_ERROR or (miscounted and self.parted_s is not None)

    def line(self) -> str:
        """Return the result on one line."""
        if not self.informs:
            return f"no information: the run and {self.reference} are identical"
        one, other = self.quantities
        facts = f"scaled error {self.error:.1e} (1: as large as the motion); {one.contacts} and {other.contacts} "
        facts += f"contacts, peak force {one.peak_force_n:.6g} and {other.peak_force_n:.6g} N"
        if not math.isnan(one.radius_um + other.radius_um):
            facts += f"; in the last quarter whirl {one.frequency_hz:.6g} and {other.frequency_hz:.6g} Hz, "
            facts += f"radius {one.radius_um:.6g} and {other.radius_um:.6g} µm"
        if self.wrong_branch:
            since = f" after {self.parted_s:g} s" if self.parted_s is not None else ""
            return f"a wrong branch is suspected{since}: {self.reference} follows another motion ({facts})"
        return f"against {self.reference}: {facts}"


def choose_reference(scene: Scene) -> tuple[str, float]:
    """Return engine and tolerance of the reference run: another engine, if one supports the model.

    A finer tolerance of the same engine would be no check: where `engine.step_us` limits the steps, it has no effect.

    Raises:
        InputError: If there is none, or the scene has no model.
    """
    scene.check_physics()
    own, model = scene.engine, scene.model
    for name in _REFERENCES:
        method = ENGINES[name]
        if model.friction in method.frictions and model.contact in method.contacts:
            if name == _REFERENCES[-1]:
                return name, _SAME_ENGINE_REFINEMENT * min(own.tolerance or method.tolerance, method.tolerance)
            if name != own.name:
                return name, _REFERENCE_TOLERANCE
    raise InputError("--check", "left out for a model that only one engine supports", own.name)


def sample_rows(simulation: Simulation, frame: Frame) -> np.ndarray:
    """Return a copy of a frame's rows at the truth's rate, shape (n, N_ROW)."""
    return frame.rows[:: _count_rows(simulation)].copy()


def check(simulation: Simulation, frames: list[np.ndarray]) -> Check:
    """Compare a completed run with a reference run of its scene.

    Args:
        simulation: The simulation at its end.
        frames: Rows of all its frames, by `sample_rows`.

    Raises:
        InputError: If no engine can check the scene.
    """
    scene = simulation.scene
    name, tolerance = choose_reference(scene)
    document = scene.model_dump()
    document["sensors"] |= bare_sensors(scene.sensors.truth_rate_hz)
    document["channels"] = None
    engine = {"name": name, "tolerance": tolerance, "companion": False}
    other = Simulation(parse_scene({**document, "engine": engine, "fidelity": "given"}))
    rows, fine = np.concatenate(frames), run_scene(other, block_ticks=other.end_tick, every=_count_rows(other)).rows
    n = min(len(rows), len(fine))
    errors = np.array([scaled_error(a[None], b[None]) for a, b in zip(rows[:n], fine[:n], strict=True)])
    parted = np.flatnonzero(errors > MAX_BRANCH_ERROR)
    return Check(
        reference=f"{name} at tolerance {tolerance:.2g}",
        error=float(np.sqrt(np.mean(errors**2))),
        parted_s=float(parted[0]) / scene.sensors.truth_rate_hz if len(parted) else None,
        quantities=(_measure(simulation, rows), _measure(other, fine)),
    )


def _count_rows(simulation: Simulation) -> int:
    """Return the rows per row of the truth."""
    return simulation.tick_rate_hz // simulation.scene.sensors.truth_rate_hz // simulation.row_ticks


def _measure(simulation: Simulation, rows: np.ndarray) -> Quantities:
    health = simulation.health()
    found = Quantities(health["contacts"], health["peak_normal_force_n"])
    last = rows[-int(_SETTLED_SHARE * len(rows)) :, [COLUMN["ring_x"], COLUMN["ring_y"]]]
    radius = np.hypot(*last.T)
    clearance = simulation.model.constants.contact.clearance
    if len(last) < _MIN_SETTLED_ROWS or not radius.min() > _MIN_WHIRL_RADIUS * clearance:
        return found
    times_s = np.arange(len(last)) / simulation.scene.sensors.truth_rate_hz
    frequency = whirl_frequency(last[:, 0], last[:, 1], times_s, about=0j)
    if abs(frequency) * times_s[-1] < 1.0:
        return found
    return found._replace(frequency_hz=frequency, radius_um=1e6 * float(radius.mean()))
