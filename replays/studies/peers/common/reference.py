"""What a chart measures errors against: one run at the end of its tolerance, and its distance from an unlike second.

The first is heyoka's Taylor series on equations of its own, the second a Runge-Kutta or multistep method on the rig's
compiled right-hand side: another method, another derivation, another library. Where heyoka is missing or has no words
for a problem, the two others stand in, which then share the right-hand side.
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
        solution: The run to measure against.
        names: Names of both peers.
        error: Their distance, as `scaled_error`: the reference's error bar.
        compile_s: What compiling took for each [s].
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
        problem: The problem.
        quick: The second by CVODE Adams, ten times quicker than DOP853 and ten times less sharp.

    Returns:
        The reference, or None where no two codes got through.
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
