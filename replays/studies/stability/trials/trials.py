"""Trials T1 to T14, each a small system on which one engine is measured and compared with an expected verdict.

A trial yields one cell per case. Its value is a distance from the correct result, its limit the largest passing value,
and its expectation follows from theory: engines must pass, and known failures must fail. Engines without a row in
`replays.studies.common.engines` are tested by the general criteria only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from replays.studies.stability.trials import flight, hammer, impacts, whole_runs
from replays.studies.stability.trials.cell import Cell


class Trial(NamedTuple):
    """A trial."""

    name: str
    """Name, T1 to T14."""
    title: str
    """Title."""
    value: str
    """Measured quantity, in words."""
    cases: Callable[[str, bool], Iterator[Cell]]
    """Function that yields the cases of an engine; the flag selects a few of them."""

    def run(self, engine: str, quick: bool) -> Iterator[Cell]:
        """Yield the cells of one engine."""
        for cell in self.cases(engine, quick):
            yield cell._replace(trial=self.name, method=engine)


_ALL = (
    Trial("T1", "Undamped ring-down of the stiffest house mode", "|E/E0 - 1|, growth", flight.ring_down_cases),
    Trial("T2", "Elastic, frictionless bounce: 24 impacts", "energy drift", impacts.bounce_cases),
    Trial("T3", "Rolling at v_t = 0", "residual slip", hammer.rolling_cases),
    Trial("T4", "First impact against 1-D quadrature", "relative error", impacts.first_impact_cases),
    Trial("T5", "A hammer pulse out of rest: seen or missed", "|momentum / impulse - 1|", flight.pulse_cases),
    Trial("T6", "Free flight against the matrix exponential", "scaled error", flight.free_flight_cases),
    Trial("T7", "v_s ladder against the set-valued limit", "distance to exact Coulomb", hammer.smoothing_cases),
    Trial("T8", "Grazing onsets: v0 ladder and its lower limit", "relative error", impacts.grazing_cases),
    Trial("T9", "Whirl or no whirl at the boundary in (mu, impulse)", "wrong classes", hammer.boundary_cases),
    Trial("T10", "Drop to rest", "what is left, count", impacts.drop_cases),
    Trial("T11", "Step or tolerance ladder", "ratio of errors", hammer.ladder_cases),
    Trial("T12", "Frames of 1 ms and restart, bit for bit", "numbers that differ", whole_runs.bit_cases),
    Trial("T13", "What goes wrong says so", "0 warned, 1 silent", whole_runs.warning_cases),
    Trial("T14", "Lasting contact with a stale v0", "error of the depth", impacts.stale_cases),
)
TRIALS: dict[str, Trial] = {trial.name: trial for trial in _ALL}
"""All trials by name."""
