"""Reference of a chart's errors: one run at its finest tolerance, and its distance from an independent second run.

The first is heyoka's Taylor series on its own equations, the second a Runge-Kutta or multistep method on the rig's
compiled right-hand side: method, derivation and library differ. Where heyoka is missing or cannot represent a problem,
two other methods are used, which share the right-hand side.
"""

from __future__ import annotations

from dataclasses import dataclass

from replays.studies.peers import PEERS, Setting, Solution
from replays.studies.peers.common.problem import Problem, scaled_error

_CANDIDATES = (("heyoka", 1e-15), ("scipy-dop853", 1e-13), ("cvode-adams", 1e-14))


@dataclass(frozen=True)
class Reference:
    """Reference of one problem.

    Attributes:
        solution: Reference solution.
        names: Names of both peers.
        error: Their distance, as `scaled_error`: the reference's error estimate.
        compile_s: Compile time of each [s].
        independent: Whether the two share neither method nor derivation.
    """

    solution: Solution
    names: tuple[str, str]
    error: float
    compile_s: tuple[float, float]
    independent: bool


def find_reference(problem: Problem, *, quick: bool = False) -> Reference | None:
    """Solve a problem twice for reference.

    Args:
        problem: Problem.
        quick: Use CVODE Adams as the second method, ten times faster and ten times less accurate than DOP853.

    Returns:
        Reference, or None if fewer than two methods solve the problem.
    """
    first, *others = _CANDIDATES
    found: list[tuple[str, Solution]] = []
    for name, tolerance in (first, *(reversed(others) if quick else others)):
        if len(found) < 2 and PEERS[name].installed:
            solution = PEERS[name].solve(problem, Setting(f"{tolerance:g}", tolerance), budget_s=300.0)
            if solution.failure is None:
                found.append((name, solution))
    if len(found) < 2:
        return None
    (name, solution), (other, second) = found
    return Reference(
        solution=solution,
        names=(name, other),
        error=scaled_error(solution.states, second.states),
        compile_s=(solution.compile_s, second.compile_s),
        independent=name == first[0],
    )
