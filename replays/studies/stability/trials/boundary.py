"""Boundary of lasting backward whirl over friction and pulse force, and the class found by every engine."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from replays.report.canvas import BLUE, ORANGE
from replays.studies.stability.trials.motion import hammer_run, move

FREE, BOUNCING, SLIDING, ROLLING = range(4)
"""Class at the end of a run: no contact; intermittent contact; permanent sliding contact; permanent rolling contact."""
NAMES = ("free", "bouncing", "sliding whirl", "rolling whirl")
STYLES = (("#F2F2F2", "o"), ("#F0E442", "s"), (ORANGE, "^"), (BLUE, "D"))
"""Colour and marker of each class, in every picture."""
_DURATION_S, _WINDOW_S = 0.6, 0.05
_MAX_ROLLING_SLIP = 1e-2
"""Sliding speed up to which a contact counts as rolling [m/s]; sliding at 6.2 Hz is 50 times as fast."""


class Boundary(NamedTuple):
    """Classes of one engine over the plane.

    Attributes:
        engine: Name of the engine.
        frictions: Friction mu, shape (n,).
        forces: Peak force of the pulse [N], shape (m,).
        classes: Classes, shape (m, n).
    """

    engine: str
    frictions: np.ndarray
    forces: np.ndarray
    classes: np.ndarray


def whirl_class(engine: str, mu: float, force_n: float, *, tolerance: float = 0.0) -> int:
    """Return the class over the last 50 ms of a run with a pulse of 5 ms at 6.2 Hz and Coulomb friction."""
    constants, inputs, y0 = hammer_run("exact", friction=mu, force_n=force_n)
    motion = move(engine, constants, inputs, y0, ticks=round(_DURATION_S * 1e6), every=1000, tolerance=tolerance)
    last = motion.times > _DURATION_S - _WINDOW_S
    touching = motion.column("penetration")[last] > 0.0
    if not touching.any():
        return FREE
    if not touching.all():
        return BOUNCING
    slip = np.abs(motion.column("sliding_speed")[last])
    return ROLLING if float(np.max(slip)) < _MAX_ROLLING_SLIP else SLIDING


def chart(engine: str, *, points: int, tolerance: float = 0.0) -> Boundary:
    """Return the classes of an engine over mu and pulse force, with `points` along each axis."""
    frictions, forces = np.linspace(0.02, 0.40, points), np.linspace(20.0, 200.0, points)
    pairs = [(mu, force) for force in forces.tolist() for mu in frictions.tolist()]
    classes = [whirl_class(engine, mu, force, tolerance=tolerance) for mu, force in pairs]
    return Boundary(engine, frictions, forces, np.reshape(classes, (points, points)))


def find_clear_points(reference: np.ndarray) -> np.ndarray:
    """Return points whose four neighbours have the same class; the error of no method should change them."""
    padded = np.pad(reference, 1, mode="edge")
    same = np.ones(reference.shape, dtype=bool)
    for rows, columns in ((slice(2, None), slice(1, -1)), (slice(None, -2), slice(1, -1)),
                          (slice(1, -1), slice(2, None)), (slice(1, -1), slice(None, -2))):  # fmt: skip
        same &= padded[rows, columns] == reference
    return same


QUICK_POINTS: tuple[tuple[float, float, int], ...] = (
    (0.20, 100.0, ROLLING),
    (0.05, 100.0, FREE),
    (0.30, 60.0, ROLLING),
    (0.10, 60.0, FREE),
    (0.12, 180.0, ROLLING),
    (0.03, 180.0, FREE),
)
"""Pairs of mu and force [N] on both sides of the boundary, with the class by tsit5 at a tolerance of 1e-9."""
