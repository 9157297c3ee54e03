"""Quantities that models are compared by: one number or word per run, with unit and phase."""

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

SETTLED_SHARE = 0.25
"""Length of the settled phase, the last part of a run, as a fraction of the run."""
MAX_ROLLING_SLIP = 0.02
"""Largest ratio of sliding speed to surface speed of a rolling contact."""
MIN_SLIDING_SPEED = 1e-4
"""Sliding speed below which a contact counts as rolling even if the shaft stands still [m/s]."""
MIN_CONTACT_SHARE = 0.5
"""Contact share of the settled phase above which the motion is a whirl or rest, and below which it is bouncing."""
PERMANENT_CONTACT_SHARE = 0.95
"""Contact share of the settled phase above which contact is permanent, and below which it is a partial rub."""
MAX_SHARE_DIFFERENCE = 0.1
"""Largest difference of contact shares of equal outcomes."""
Value = float | str


class Trace(NamedTuple):
    """Record of a run: rows on a grid of 1 ms, and values accumulated by the engine."""

    times_s: np.ndarray
    """Times, shape (n,)."""
    rows: np.ndarray
    """Rows, shape (n, N_ROW)."""
    peak_force: float
    """Largest contact force at the engine's own steps [N]."""
    clearance: float
    """Clearance r0 [m]."""
    surface_radius: float
    """Surface radius R_S [m]."""
    first_impact_s: float
    """First impact, located between steps [s]; NaN if there is none or it was not requested."""
    rolls_s: float = math.nan
    """Start of lasting rolling [s]; NaN if there is none or it was not requested."""

    def column(self, name: str) -> np.ndarray:
        """Return one signal, shape (n,)."""
        return self.rows[:, COLUMN[name]]

    def settled_signal(self, name: str) -> np.ndarray:
        """Return one signal in the settled phase."""
        return self.column(name)[-self.settled_rows :]

    @property
    def settled_rows(self) -> int:
        """Number of rows in the settled phase."""
        return max(2, round(SETTLED_SHARE * len(self.times_s)))

    @property
    def settled_s(self) -> float:
        """Time between the first and the last row of the settled phase [s]."""
        return float(self.times_s[-1] - self.times_s[-self.settled_rows])


class Ending(NamedTuple):
    """Outcome of a run in its settled phase, which a simpler model has to preserve."""

    touches: bool
    contact_share: float
    """Part of the settled milliseconds with contact [1]."""
    turns: float
    """Turns of the shaft around the ring in the settled phase, forward positive [1]."""
    rolling_share: float
    """Part of the settled phase in which it rolls [1]."""

    @property
    def outcome(self) -> str:
        """Outcome in words: flight, bounces, partial rub, resting, or rolling or sliding whirl of either direction."""
        if not self.touches or self.contact_share <= MIN_CONTACT_SHARE:
            return "bounces" if self.touches else "flight"
        if self.contact_share < PERMANENT_CONTACT_SHARE:
            return "partial rub"
        rolls = "rolling" if self.rolling_share > 0.5 else "sliding"
        return f"{rolls} {'forward' if self.turns > 0.0 else 'backward'} whirl" if abs(self.turns) >= 1.0 else "resting"

    def is_alike(self, other: Ending) -> bool:
        """Return whether two outcomes are equal; near the limit of two names, a small difference is allowed."""
        if self.touches != other.touches or abs(self.contact_share - other.contact_share) > MAX_SHARE_DIFFERENCE:
            return False
        if min(self.contact_share, other.contact_share) <= MIN_CONTACT_SHARE:
            return True
        one, two = (math.copysign(abs(turns) >= 1.0, turns) for turns in (self.turns, other.turns))
        turned = one == two or abs(self.turns - other.turns) < 0.5
        return turned and abs(self.rolling_share - other.rolling_share) <= 0.5


def find_sliding(rows: np.ndarray, surface_radius: float) -> np.ndarray:
    """Return for each row whether the shaft would slide if it were in contact."""
    surface_speed = surface_radius * np.abs(rows[:, COLUMN["theta_rate"]])
    return np.abs(rows[:, COLUMN["sliding_speed"]]) > np.maximum(MAX_ROLLING_SLIP * surface_speed, MIN_SLIDING_SPEED)


def find_rolling_start(times_s: np.ndarray, rows: np.ndarray, surface_radius: float) -> float:
    """Return the start of lasting rolling in the rows of a whole run [s]; NaN if there is none."""
    loose = np.flatnonzero(find_sliding(rows, surface_radius) | (rows[:, COLUMN["penetration"]] <= 0.0))
    first = int(loose[-1]) + 1 if len(loose) else 0
    return float(times_s[first]) if first < len(times_s) else math.nan


def find_ending(trace: Trace) -> Ending:
    """Return the outcome of a run."""
    # Contact is detected by its impulse, because a contact of an impact law has no duration.
    pushed = np.diff(trace.settled_signal("contact_impulse")) > 0.0
    angle = phase(trace.settled_signal("ring_x"), trace.settled_signal("ring_y"))
    rolls = ~find_sliding(trace.rows[-trace.settled_rows :], trace.surface_radius)
    return Ending(
        touches=bool(pushed.any()),
        contact_share=float(np.mean(pushed)),
        turns=float(angle[-1] - angle[0]) / (2.0 * math.pi),
        rolling_share=float(np.mean(rolls)),
    )


@dataclass(frozen=True)
class Measurand:
    """A quantity of a run.

    Attributes:
        name: Name on the command line.
        unit: Unit, "" for a word.
        phase: Part of the run that it is computed from.
        title: Definition.
        read: Function that computes it from a run; NaN if the run has none.
        needs_force: True if a rigid impact, which has no force over time, cannot provide it.
        resolution: Resolution of the evaluation [unit].
    """

    name: str
    unit: str
    phase: str
    title: str
    read: Callable[[Trace], Value]
    needs_force: bool = False
    resolution: float = 0.0

    def error(self, value: Value, reference: Value) -> float:
        """Return the error of a value relative to the reference; infinite if one of the two is missing."""
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
    x, y = trace.settled_signal("ring_x"), trace.settled_signal("ring_y")
    return whirl_frequency(x, y, trace.times_s[-trace.settled_rows :], about=0.0)


def _contact_fraction_settled(trace: Trace) -> float:
    return float(np.mean(trace.settled_signal("penetration") > 0.0))


def _mean_force(trace: Trace) -> float:
    impulse = trace.settled_signal("contact_impulse")
    return float(impulse[-1] - impulse[0]) / trace.settled_s


def _ripple(trace: Trace) -> float:
    return float(np.std(trace.settled_signal("normal_force")))


def _reaction(trace: Trace) -> float:
    return float(math.sqrt(2.0) * np.std(trace.settled_signal("P_E") - trace.settled_signal("P_W")))


def _spin(trace: Trace) -> float:
    theta = trace.settled_signal("theta")
    return float(theta[-1] - theta[0]) / trace.settled_s / (2.0 * math.pi)


def _dissipation(trace: Trace) -> float:
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
        impulse = trace.settled_signal("contact_impulse")
        return "no contact" if impulse[-1] == impulse[0] else "bouncing"
    if share < 0.95:
        return "bouncing"
    angle = phase(trace.settled_signal("ring_x"), trace.settled_signal("ring_y"))
    if abs(angle[-1] - angle[0]) < 2.0 * math.pi:
        return "resting"
    return "forward whirl" if angle[-1] > angle[0] else "backward whirl"


def _fraction(trace: Trace) -> float:
    return float(np.mean(trace.column("penetration") > 0.0))


def _read_final(name: str) -> Callable[[Trace], float]:
    return lambda trace: float(trace.column(name)[-1])


_SETTLED = f"last {SETTLED_SHARE:.0%} of the run"
QUANTITIES = {
    quantity.name: quantity
    for quantity in (
        Measurand(
            "whirl_frequency", "Hz", _SETTLED, "slope of the phase of the shaft in the ring; negative is backward",
            _whirl_frequency,
        ),
        Measurand("spin", "Hz", _SETTLED, "turns of the shaft over time", _spin),
        Measurand("mean_normal_force", "N", _SETTLED, "the engine's own contact impulse over time", _mean_force),
        Measurand(
            "force_ripple", "N", _SETTLED, "RMS of the normal force about its mean, every 1 ms", _ripple,
            needs_force=True,
        ),
        Measurand(
            "reaction_amplitude", "N", _SETTLED, "sqrt(2) RMS of P_E - P_W about its mean, every 1 ms", _reaction,
            needs_force=True,
        ),
        Measurand(
            "peak_normal_force", "N", "whole run", "largest by the engine's own steps",
            lambda trace: trace.peak_force, needs_force=True,
        ),
        Measurand("contact_impulse", "N s", "whole run", "the engine's own integral of the normal force",
                 _read_final("contact_impulse")),
        Measurand("dissipated_energy", "J", "whole run", "the engine's own integrals of all losses", _dissipation),
        Measurand("contact_fraction", "1", "whole run", "share of instants in contact, every 1 ms", _fraction),
        Measurand(
            "time_to_roll", "s", "transient", f"until it rolls for good (slip below {MAX_ROLLING_SLIP:.0%}), to 50 us",
            lambda trace: trace.rolls_s, resolution=50e-6,
        ),
        Measurand(
            "first_impact_time", "s", "first impact", "located between two steps", lambda trace: trace.first_impact_s
        ),
        Measurand(
            "rebound_height", "m", "first impact", "top of the first rebound above the ring's lowest point", _rebound
        ),
        Measurand("outcome", "", _SETTLED, "no contact, bouncing, resting, forward whirl or backward whirl", _outcome),
    )
}  # fmt: skip


def parse_quantities(names: list[str], tolerances: list[float]) -> dict[str, float]:
    """Parse quantities and their allowed errors; a single tolerance applies to all.

    Raises:
        InputError: If a quantity is unknown or repeated, or a tolerance is invalid.
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
