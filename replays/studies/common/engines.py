"""Properties of the engines for the studies, in addition to `rig.physics.engines`: one row per engine.

A new engine needs no row. Without one it is drawn in grey, charted around its own default, and tested by the general
criteria; a row adds what theory or measurement predicts for it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from replays.report.canvas import BLUE, GREEN, ORANGE, PINK, RED, SKY
from replays.studies.common.closed_forms import RUNGE_KUTTA_4_LIMIT, RUNGE_KUTTA_4_REAL_LIMIT, VERLET_LIMIT
from rig.physics.engines import ENGINES

Steps = tuple[tuple[int, float], ...]
"""Pairs of a step [µs] and a tolerance (0: fixed steps), coarsest first."""
FIXED_STEPS = (50, 40, 25, 20, 10, 5, 2)
"""Steps at which a fixed-step engine is charted [µs]."""


def _fixed_steps(*steps_us: int) -> Steps:
    return tuple((step, 0.0) for step in steps_us)


def _tolerances(step_us: int, *exponents: int) -> Steps:
    return tuple((step_us, 10.0**-n) for n in exponents)


class Traits(NamedTuple):
    """Properties of an engine."""

    colour: str = "#333333"
    marker: str = "d"
    settings: Steps = ()
    """Settings of a full chart; empty: around the engine's own default."""
    quick: Steps = ()
    """Settings of a quick chart; empty: every second one of the full chart."""
    oscillator_limit: float | None = None
    """Largest stable h w of an undamped oscillator [1]; infinite if there is none, None if unknown."""
    damping_limit: float | None = None
    """Largest stable h lambda of a damping rate at fixed steps [1]; None if unknown."""
    damping_because: str = "explicit, and nothing shortens its steps"
    on_real_axis: bool = False
    """True if that limit is the theoretical one on the real axis."""
    allowance: float = 1.0
    """Factor on the allowed error of a low-order engine without corrections at its own step."""
    coarse_bounce: tuple[bool | None, str] = (None, "")
    """Expectation: True if it preserves an impact's energy at a step of 200 µs, and the reason."""
    warned_within_ticks: int = 60_000
    """Longest run with a much too long step before the engine must have warned [ticks]."""

    def limit(self) -> float:
        """Return the theoretical limit of h w of an oscillator; NaN if none is known."""
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
        GREEN, "^", _fixed_steps(*FIXED_STEPS), _fixed_steps(50, 20, 10, 5),
        oscillator_limit=RUNGE_KUTTA_4_LIMIT, damping_limit=RUNGE_KUTTA_4_REAL_LIMIT, on_real_axis=True,
        coarse_bounce=(False, f"{_FEW_STEPS}0.5"),
    ),
    "verlet": Traits(
        ORANGE, "v", quick=_fixed_steps(50, 10, 5),
        oscillator_limit=VERLET_LIMIT, damping_limit=2.0, allowance=20.0, coarse_bounce=(False, f"{_FEW_STEPS}35"),
    ),
    "semi-implicit-euler": Traits(
        "#4000b0", "<", quick=_fixed_steps(50, 10, 5),
        oscillator_limit=VERLET_LIMIT, damping_limit=2.0, allowance=100.0, coarse_bounce=(False, f"{_FEW_STEPS}1"),
    ),
    "rosenbrock": Traits(PINK, "P", oscillator_limit=math.inf, coarse_bounce=_SHORTENS),
}  # fmt: skip


def traits(engine: str) -> Traits:
    """Return the properties of an engine, or the defaults."""
    return _ROWS.get(engine, Traits())


def settings(engine: str, *, quick: bool) -> Steps:
    """Return the steps and tolerances at which an engine is charted."""
    own, method = traits(engine), ENGINES[engine]
    if method.tolerance:
        about = tuple((method.step_us, method.tolerance * 10.0**n) for n in (3, 2, 1, 0, -1, -2))
    else:
        about = _fixed_steps(*FIXED_STEPS)
    full = own.settings or about
    return own.quick or full[1::2] if quick else full


def is_adaptive(engine: str) -> bool:
    """Return whether error control chooses the engine's steps."""
    return ENGINES[engine].tolerance > 0.0


def supported_friction(engine: str) -> str:
    """Return the most exact friction law that an engine supports."""
    return next(law for law in ("exact", "smoothed", "switch", "none") if law in ENGINES[engine].frictions)
