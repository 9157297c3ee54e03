"""Quantities that a model can be judged by: each one number (or a word) of a run, with its unit and its phase."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rig.base.errors import InputError
from rig.channels.orbit import phase, whirl_frequency
from rig.physics.kernels.signals import COLUMN
from rig.run.motion import DISSIPATED

SETTLED = 0.25
"""The settled phase is this last part of a run."""
ROLLS = 0.02
"""A contact rolls while it slides by less than this part of the surface's speed ..."""
STILL = 1e-4
"""... or than this, as where the shaft stands and both are rounding [m/s]."""
LASTS = 0.5
"""Contact lasts where it is more than this part of the settled phase: then it turns, or rests, and rolls or slides."""
STAYS = 0.95
"""... and is for good from here on: a partial rub below."""
SAME_SHARE = 0.1
"""Parts of the settled phase in contact that are this close are the same outcome."""
Value = float | str


class Trace(NamedTuple):
    """What is kept of a run: rows on a grid of 1 ms, and what the engine has accumulated."""

    times_s: np.ndarray
    """Shape (n,)."""
    rows: np.ndarray
    """Shape (n, N_ROW)."""
    peak_force: float
    """By the engine's own steps [N]."""
    clearance: float
    """r0 [m]."""
    surface_radius: float
    """R_S [m]."""
    first_impact_s: float
    """Located between steps [s]; nan where there is none or where nobody asked."""
    rolls_s: float = math.nan
    """When it begins to roll for good [s]; nan alike."""

    def column(self, name: str) -> np.ndarray:
        """One signal, shape (n,)."""
        return self.rows[:, COLUMN[name]]

    def settled(self, name: str) -> np.ndarray:
        """One signal in the settled phase."""
        return self.column(name)[-self.settled_rows :]

    @property
    def settled_rows(self) -> int:
        """Rows of the settled phase."""
        return max(2, round(SETTLED * len(self.times_s)))

    @property
    def settled_s(self) -> float:
        """Time between the first and the last row of the settled phase [s]."""
        return float(self.times_s[-1] - self.times_s[-self.settled_rows])


class Ending(NamedTuple):
    """How a run ends: what its settled phase is like. A simpler model has to keep that, whatever it is asked for."""

    touches: bool
    contact_share: float
    """Part of the settled milliseconds with contact [1]."""
    turns: float
    """Turns of the shaft around the ring in the settled phase, forward positive [1]."""
    rolling_share: float
    """Part of the settled phase in which it rolls [1]."""

    @property
    def word(self) -> str:
        """Flight, bounces, partial rub, resting, or a rolling or sliding whirl of either direction."""
        if not self.touches or self.contact_share <= LASTS:
            return "bounces" if self.touches else "flight"
        if self.contact_share < STAYS:
            return "partial rub"
        rolls = "rolling" if self.rolling_share > 0.5 else "sliding"
        return f"{rolls} {'forward' if self.turns > 0.0 else 'backward'} whirl" if abs(self.turns) >= 1.0 else "resting"

    def alike(self, other: Ending) -> bool:
        """Whether both are one outcome; what lies on both sides of a word's limit, but close, is."""
        if self.touches != other.touches or abs(self.contact_share - other.contact_share) > SAME_SHARE:
            return False
        if min(self.contact_share, other.contact_share) <= LASTS:
            return True
        one, two = (math.copysign(abs(turns) >= 1.0, turns) for turns in (self.turns, other.turns))
        turned = one == two or abs(self.turns - other.turns) < 0.5
        return turned and abs(self.rolling_share - other.rolling_share) <= 0.5


def slides(rows: np.ndarray, surface_radius: float) -> np.ndarray:
    """In which of some rows it slides, were it in contact."""
    surface_speed = surface_radius * np.abs(rows[:, COLUMN["theta_rate"]])
    return np.abs(rows[:, COLUMN["sliding_speed"]]) > np.maximum(ROLLS * surface_speed, STILL)


def rolls_from(times_s: np.ndarray, rows: np.ndarray, surface_radius: float) -> float:
    """When it begins to roll for good, by the rows of a whole run [s]; nan where it does not."""
    loose = np.flatnonzero(slides(rows, surface_radius) | (rows[:, COLUMN["penetration"]] <= 0.0))
    first = int(loose[-1]) + 1 if len(loose) else 0
    return float(times_s[first]) if first < len(times_s) else math.nan


def ending(trace: Trace) -> Ending:
    """How a run ends."""
    # By the impulse: an impact law touches without being in contact at any instant.
    pushed = np.diff(trace.settled("contact_impulse")) > 0.0
    angle = phase(trace.settled("ring_x"), trace.settled("ring_y"))
    rolls = ~slides(trace.rows[-trace.settled_rows :], trace.surface_radius)
    return Ending(
        touches=bool(pushed.any()),
        contact_share=float(np.mean(pushed)),
        turns=float(angle[-1] - angle[0]) / (2.0 * math.pi),
        rolling_share=float(np.mean(rolls)),
    )


@dataclass(frozen=True)
class Quantity:
    """One quantity.

    Attributes:
        name: Its name on the command line.
        unit: Unit, "" for a word.
        phase: Part of the run that it belongs to.
        title: What it is and how it is read.
        read: Reads it off a run; nan where the run has none.
        needs_force: True where a rigid impact, which has no force over time, cannot give it.
        resolution: Of the reading itself [unit].
    """

    name: str
    unit: str
    phase: str
    title: str
    read: Callable[[Trace], Value]
    needs_force: bool = False
    resolution: float = 0.0

    def error(self, value: Value, reference: Value) -> float:
        """Distance of a value from the reference's as a part of the latter; infinite where one of them has none."""
        if isinstance(value, str) or isinstance(reference, str):
            return 0.0 if value == reference else math.inf
        if value == reference:
            return 0.0
        if not (math.isfinite(value) and math.isfinite(reference)) or reference == 0.0:
            return math.inf
        return abs(value - reference) / abs(reference)


def _whirl_frequency(trace: Trace) -> float:
    if _contact_fraction_settled(trace) < 0.5:
        return math.nan
    x, y = trace.settled("ring_x"), trace.settled("ring_y")
    return whirl_frequency(x, y, trace.times_s[-trace.settled_rows :], about=0.0)


def _contact_fraction_settled(trace: Trace) -> float:
    return float(np.mean(trace.settled("penetration") > 0.0))


def _mean_force(trace: Trace) -> float:
    impulse = trace.settled("contact_impulse")
    return float(impulse[-1] - impulse[0]) / trace.settled_s


def _ripple(trace: Trace) -> float:
    return float(np.std(trace.settled("normal_force")))


def _reaction(trace: Trace) -> float:
    return float(math.sqrt(2.0) * np.std(trace.settled("P_E") - trace.settled("P_W")))


def _spin(trace: Trace) -> float:
    theta = trace.settled("theta")
    return float(theta[-1] - theta[0]) / trace.settled_s / (2.0 * math.pi)


def _dissipated(trace: Trace) -> float:
    return float(sum(trace.column(name)[-1] for name in DISSIPATED))


def _rebound(trace: Trace) -> float:
    rises = np.flatnonzero(np.diff(trace.column("contact_impulse")) > 0.0)
    later = rises[1:][np.diff(rises) > 2]
    if not len(later):
        return math.nan
    begin = int(later[0])
    before = rises[rises < begin]
    y = trace.column("ring_y")[int(before[-1]) + 1 : begin + 1]
    top = int(np.argmax(y))
    if not 0 < top < len(y) - 1:
        return math.nan
    slope, bend = 0.5 * (y[top + 1] - y[top - 1]), y[top + 1] - 2.0 * y[top] + y[top - 1]
    return float(y[top] - 0.5 * slope * slope / bend + trace.clearance)


def _outcome(trace: Trace) -> str:
    share = _contact_fraction_settled(trace)
    if share == 0.0:
        impulse = trace.settled("contact_impulse")
        return "no contact" if impulse[-1] == impulse[0] else "bouncing"
    if share < 0.95:
        return "bouncing"
    angle = phase(trace.settled("ring_x"), trace.settled("ring_y"))
    if abs(angle[-1] - angle[0]) < 2.0 * math.pi:
        return "resting"
    return "forward whirl" if angle[-1] > angle[0] else "backward whirl"


def _fraction(trace: Trace) -> float:
    return float(np.mean(trace.column("penetration") > 0.0))


def _whole(name: str) -> Callable[[Trace], float]:
    return lambda trace: float(trace.column(name)[-1])


_LAST = f"last {SETTLED:.0%} of the run"
QUANTITIES = {
    quantity.name: quantity
    for quantity in (
        Quantity(
            "whirl_frequency", "Hz", _LAST, "slope of the phase of the shaft in the ring; negative is backward",
            _whirl_frequency,
        ),
        Quantity("spin", "Hz", _LAST, "turns of the shaft over time", _spin),
        Quantity("mean_normal_force", "N", _LAST, "the engine's own contact impulse over time", _mean_force),
        Quantity(
            "force_ripple", "N", _LAST, "RMS of the normal force about its mean, every 1 ms", _ripple,
            needs_force=True,
        ),
        Quantity(
            "reaction_amplitude", "N", _LAST, "sqrt(2) RMS of P_E - P_W about its mean, every 1 ms", _reaction,
            needs_force=True,
        ),
        Quantity(
            "peak_normal_force", "N", "whole run", "largest by the engine's own steps",
            lambda trace: trace.peak_force, needs_force=True,
        ),
        Quantity("contact_impulse", "N s", "whole run", "the engine's own integral of the normal force",
                 _whole("contact_impulse")),
        Quantity("dissipated_energy", "J", "whole run", "the engine's own integrals of all losses", _dissipated),
        Quantity("contact_fraction", "1", "whole run", "share of instants in contact, every 1 ms", _fraction),
        Quantity(
            "time_to_roll", "s", "transient", f"until it rolls for good (slip below {ROLLS:.0%}), to 50 us",
            lambda trace: trace.rolls_s, resolution=50e-6,
        ),
        Quantity(
            "first_impact_time", "s", "first impact", "located between two steps", lambda trace: trace.first_impact_s
        ),
        Quantity(
            "rebound_height", "m", "first impact", "top of the first rebound above the ring's lowest point", _rebound
        ),
        Quantity("outcome", "", _LAST, "no contact, bouncing, resting, forward whirl or backward whirl", _outcome),
    )
}  # fmt: skip


def parse_quantities(names: list[str], tolerances: list[float]) -> dict[str, float]:
    """Quantities and the error allowed to each; one tolerance serves all.

    Raises:
        InputError: No such quantity, one given twice, or a tolerance that is none.
    """
    for name in names:
        if name not in QUANTITIES:
            raise InputError("--quantity", f"one of {', '.join(QUANTITIES)}", name)
    if not names or len(set(names)) < len(names):
        raise InputError("--quantity", "given once for each quantity", names)
    for tolerance in tolerances:
        if not 0.0 < tolerance <= 1.0:
            raise InputError("--tolerance", "above 0 and at most 1, as a part of the quantity", tolerance)
    if len(tolerances) not in (1, len(names)):
        raise InputError("--tolerance", "given once, or once for each --quantity", tolerances)
    return dict(zip(names, tolerances * (len(names) // len(tolerances)), strict=True))
