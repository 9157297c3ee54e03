"""What is compiled ahead, in another process, is what a run would compile."""

from __future__ import annotations

from rig.cli.ahead import compile_last
from rig.engines.taylor.series import rolling, sliding
from rig.simulation import Simulation


def test_a_run_compiles_nothing_of_it_again() -> None:
    compile_last()
    ahead = {kernel: list(kernel.signatures) for kernel in (rolling, sliding)}
    assert all(len(signatures) == 1 for signatures in ahead.values())
    simulation = Simulation("hammer")
    simulation.advance(simulation.block_ticks)
    assert {kernel: list(kernel.signatures) for kernel in ahead} == ahead
