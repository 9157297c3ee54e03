"""Commands take effect at their own tick, independent of the row rate."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rig.physics.kernels.signals import N_STATE, STATE_SCALE
from rig.run.offline import Run, simulate
from rig.run.scenes import load_scene

HAMMER = {"command": "hammer", "force_n": 100.0, "duration_ms": 0.5}
SPEED = {"command": "speed", "speed_hz": 6.3}
RELEASE = {"command": "release"}
AT_S, LOOK_S = 0.0203, 0.03
"""Between two rows of 500 and of 100 Hz; and on a row of each."""


def run_with(rate_hz: int, *commands: dict[str, Any]) -> Run:
    # An accurate engine: the difference is the command's.
    changes = {
        "duration_s": 0.04, "engine.name": "rk8", "engine.tolerance": 1e-10, "sensors.chain": "ideal",
        "sensors.rate_hz": rate_hz, "sensors.truth_rate_hz": rate_hz,
        "commands": [{"at_s": AT_S, **command} for command in commands],
    }  # fmt: skip
    return simulate(load_scene("hammer", changes))


def measure_effect(rate_hz: int, command: dict[str, Any]) -> tuple[np.ndarray, float]:
    """Return the change of the scaled state by a command, shape (N_STATE,), and the hammer's work [J]."""
    look = round(LOOK_S * rate_hz)
    given, free = run_with(rate_hz, command), run_with(rate_hz)
    change = given.signals[look, :N_STATE] - free.signals[look, :N_STATE]
    return change / STATE_SCALE, float(given["hammer_work"][look])


@pytest.mark.parametrize("command", [HAMMER, SPEED, RELEASE], ids=lambda command: command["command"])
@pytest.mark.parametrize("rate_hz", [500, 100])
def test_a_low_row_rate_does_not_change_a_command(rate_hz: int, command: dict[str, Any]) -> None:
    change, work = measure_effect(rate_hz, command)
    true_change, true_work = measure_effect(20_000, command)
    assert np.abs(true_change).max() > 1e-6, "it has an effect"
    # The impulse, by all that it has set in motion, and the energy supplied with it.
    np.testing.assert_allclose(change, true_change, rtol=0.0, atol=1e-6 * np.abs(true_change).max())
    assert work == pytest.approx(true_work, rel=1e-6)
