"""What the studies know of each engine beside what `rig.physics.engines` tells: one row an engine, read by every study.

A new engine needs no row here. Without one it is drawn in grey, charted about its own default, and held to what every
engine is held to; what theory or measurement says of it comes with its row.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from replays.report.canvas import BLUE, GREEN, ORANGE, PINK, RED, SKY
from replays.studies.common.closed_forms import (
    RUNGE_KUTTA_4_LIMIT,
    RUNGE_KUTTA_4_REAL_LIMIT,
    VERLET_LIMIT,
)
from rig.physics.engines import ENGINES

Steps = tuple[tuple[int, float], ...]
"""Pairs of a step [µs] and a tolerance (0: fixed steps), the coarsest first."""
FIXED_STEPS = (50, 40, 25, 20, 10, 5, 2)
"""Steps at which an engine of fixed step is charted [µs]."""


def _fixed(*steps_us: int) -> Steps:
    return tuple((step, 0.0) for step in steps_us)


def _tolerances(step_us: int, *exponents: int) -> Steps:
    return tuple((step_us, 10.0**-n) for n in exponents)


class Traits(NamedTuple):
    """One row."""

    colour: str = "#333333"
    marker: str = "d"
    settings: Steps = ()
    """Charted in full; empty: about its own default."""
    quick: Steps = ()
    """Charted in a quick chart; empty: every second of the full ones."""
    oscillator_limit: float | None = None
    """Largest h w of an undamped oscillator that stays bounded [1]; infinite where there is none, None if unknown."""
    damping_limit: float | None = None
    """Largest h lambda of a damping rate that its fixed step takes [1]; None if unknown."""
    damping_because: str = "explicit, and nothing shortens its steps"
    on_real_axis: bool = False
    """Whether that limit is the theory's on the real axis."""
    allowance: float = 1.0
    """By how much an engine of low order without corrections may be further off at its own step."""
    coarse_bounce: tuple[bool | None, str] = (None, "")
    """Whether it keeps an impact's energy at a step of 200 µs, and why."""
    warned_within_ticks: int = 60_000
    """How long a run with a step far too long goes on before it must have warned."""

    def limit(self) -> float:
        """Largest h w of an oscillator by theory; nan where there is none that is known."""
        return math.nan if self.oscillator_limit is None or math.isinf(self.oscillator_limit) else self.oscillator_limit


_SHORTENS = (True, "error control shortens the steps")
_FEW_STEPS = "no error control, an impact of 0.32 ms in a few steps; measured: "
_ROWS = {
    "split": Traits(
        RED, "o", _tolerances(25, 1, 2, 3, 4, 5, 6), _tolerances(25, 1, 2, 3, 5),
        oscillator_limit=math.inf, coarse_bounce=(True, "series take the impact, and do not follow the grid"),
    ),
    "rk8": Traits(
        BLUE, "s", _tolerances(25, *range(4, 13)), _tolerances(25, 6, 8, 10, 12),
        oscillator_limit=math.inf, coarse_bounce=_SHORTENS,
    ),
    "taylor": Traits(
        "#882255", "h", _tolerances(25, 4, 5, 6, 7, 8, 9, 10, 12, 14), _tolerances(25, 5, 7, 9, 11),
        oscillator_limit=math.inf, coarse_bounce=(True, "its own steps do not follow the grid's"),
    ),
    "tsit5": Traits(
        SKY, "D", _tolerances(500, *range(3, 11)), _tolerances(500, 4, 6, 8, 10),
        oscillator_limit=math.inf, coarse_bounce=_SHORTENS,
    ),
    "rk4": Traits(
        GREEN, "^", _fixed(*FIXED_STEPS), _fixed(50, 20, 10, 5),
        oscillator_limit=RUNGE_KUTTA_4_LIMIT, damping_limit=RUNGE_KUTTA_4_REAL_LIMIT, on_real_axis=True,
        coarse_bounce=(False, f"{_FEW_STEPS}0.5"),
    ),
    "verlet": Traits(
        ORANGE, "v", quick=_fixed(50, 10, 5),
        oscillator_limit=VERLET_LIMIT, damping_limit=2.0, allowance=20.0, coarse_bounce=(False, f"{_FEW_STEPS}35"),
    ),
    "semi-implicit-euler": Traits(
        "#4000b0", "<", quick=_fixed(50, 10, 5),
        oscillator_limit=VERLET_LIMIT, damping_limit=2.0, allowance=100.0, coarse_bounce=(False, f"{_FEW_STEPS}1"),
    ),
    "rosenbrock": Traits(PINK, "P", oscillator_limit=math.inf, coarse_bounce=_SHORTENS),
}  # fmt: skip


def traits(engine: str) -> Traits:
    """The row of an engine, or what holds for one that has none."""
    return _ROWS.get(engine, Traits())


def settings(engine: str, *, quick: bool) -> Steps:
    """Steps and tolerances at which an engine is charted."""
    own, method = traits(engine), ENGINES[engine]
    if method.tolerance:
        about = tuple((method.step_us, method.tolerance * 10.0**n) for n in (3, 2, 1, 0, -1, -2))
    else:
        about = _fixed(*FIXED_STEPS)
    full = own.settings or about
    return own.quick or full[1::2] if quick else full


def is_adaptive(engine: str) -> bool:
    """Whether error control chooses its steps."""
    return ENGINES[engine].tolerance > 0.0


def friction_of(engine: str) -> str:
    """The most exact friction law that an engine takes."""
    return next(law for law in ("exact", "smoothed", "switch", "none") if law in ENGINES[engine].frictions)
